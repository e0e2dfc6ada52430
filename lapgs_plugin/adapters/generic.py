"""Drive any checkout of the 3DGS family that no other adapter recognises."""

from __future__ import annotations

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.adapters.info import BackboneInfo


class Adapter(BackboneAdapter):
    """Drive a checkout by its profile alone."""

    info = BackboneInfo(name="generic", title="3DGS, a checkout of its own", rasterizer="diff_gaussian_rasterization")
