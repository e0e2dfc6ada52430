"""Let a checkout's PLY files appear when they are complete.

3DGS's scripts write `points3D.ply` into a scene's folder at their first start there, unless it exists, and read it.
Runs may start together on a new scene, as `lapgs bench` starts them on several GPUs. Then one would read a file that
another has not finished: a part of the points, or none.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

from plyfile import PlyData

from lapgs_plugin.checkouts.attachment import Replacement
from lapgs_plugin.files import whole_file


def writing_whole_files() -> Replacement:
    """Return the replacement of `PlyData.write`."""
    return Replacement(PlyData, "write", _whole, "the scene's loader and Scene.save")


def _whole(original: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
    @wraps(original)
    def write(ply: Any, stream: Any) -> None:
        if not isinstance(stream, (str, os.PathLike)):
            original(ply, stream)
            return
        with whole_file(Path(stream), "PLY file") as unfinished:
            original(ply, str(unfinished))

    return write
