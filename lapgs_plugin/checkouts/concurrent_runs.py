"""Let runs of a checkout train beside each other on one machine, as `lapgs bench` starts them on several GPUs.

Scripts of the family listen for 3DGS's viewer at `--port`, 6009 unless it is given, at which a second run would fail.
At their first start on a scene they write `points3D.ply` into its folder, unless it exists, and read it. A second run
would read a file that the first has not finished.
"""

from __future__ import annotations

import errno
import inspect
import logging
import os
import socket
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

from plyfile import PlyData

from lapgs_plugin.checkouts.attachment import Replacement
from lapgs_plugin.checkouts.profile import Profile
from lapgs_plugin.files import whole_file

logger = logging.getLogger(__name__)

MODULE = "network_gui"
"""The family's module for its viewer."""
LISTEN = "init"
"""That module's function of host and port, which opens the viewer's socket."""


def beside_other_runs(profile: Profile) -> list[Replacement]:
    """Return the replacements of `PlyData.write`, and of the functions that listen for a viewer."""
    modules = [module for module, _ in profile.named([LISTEN]) if module.__name__.endswith(f".{MODULE}")]
    listening = [module for module in modules if inspect.isfunction(getattr(module, LISTEN))]
    return [
        Replacement(PlyData, "write", _whole, "the scene's loader and Scene.save"),
        *(Replacement(module, LISTEN, _at_a_free_port, "the main block, for a viewer") for module in listening),
    ]


def _whole(original: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
    """Return a function that writes PLY files, which appear when they are complete."""

    @wraps(original)
    def write(ply: Any, stream: Any) -> None:
        if not isinstance(stream, (str, os.PathLike)):
            original(ply, stream)
            return
        with whole_file(Path(stream), "PLY file") as unfinished:
            original(ply, str(unfinished))

    return write


def _at_a_free_port(original: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that listens for a viewer: a port that is taken costs the viewer, not the run."""

    @wraps(original)
    def init(host: str, port: int) -> Any:
        try:
            return original(host, port)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
        result = original(host, 0)  # any port that is free
        sockets = [value for value in original.__globals__.values() if isinstance(value, socket.socket)]
        at = ", ".join(str(listening.getsockname()[1]) for listening in sockets)
        logger.warning("port %s is taken, perhaps by another run; the checkout's viewer finds this run at %s", port, at)
        return result

    return init
