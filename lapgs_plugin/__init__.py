"""Train 3D Gaussian Splatting codebases faster with Laplacian frequency hierarchies.

The names below are for programs; `lapgs help python` shows how to use them together. Each is imported at its first use,
so that importing this package, and with it `lapgs --help`, imports neither torch nor a backbone.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lapgs_plugin.fields.camera import Camera
    from lapgs_plugin.fields.gaussian_field import GaussianField, field_from_splats, splats_from_field
    from lapgs_plugin.hierarchy.cameras import level_camera, level_intrinsics
    from lapgs_plugin.hierarchy.inheritance import field_from_points, inherit
    from lapgs_plugin.hierarchy.plan import Hierarchy, Stage, StagePlan, level_size
    from lapgs_plugin.hierarchy.pyramid import Pyramid
    from lapgs_plugin.ops.composition import Composition, compose
    from lapgs_plugin.ops.photometric_loss import photometric_loss
    from lapgs_plugin.reference_raster import CpuRasterizer
    from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
    from lapgs_plugin.rendering.run import run_renderer, run_scene
    from lapgs_plugin.runs.archive import RunArchive
    from lapgs_plugin.runs.image_store import ImageStore
    from lapgs_plugin.runs.manifest import LevelRecord, Manifest, SceneReference
    from lapgs_plugin.scenes import load_scene
    from lapgs_plugin.training.merge import merge_levels

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Composition",
    "CpuRasterizer",
    "GaussianField",
    "Hierarchy",
    "HierarchyRenderer",
    "ImageStore",
    "LevelRecord",
    "Manifest",
    "Pyramid",
    "RunArchive",
    "SceneReference",
    "Stage",
    "StagePlan",
    "compose",
    "field_from_points",
    "field_from_splats",
    "inherit",
    "level_camera",
    "level_intrinsics",
    "level_size",
    "load_scene",
    "merge_levels",
    "photometric_loss",
    "run_renderer",
    "run_scene",
    "splats_from_field",
]

_MODULES = {
    "runs.archive": ("RunArchive",),
    "runs.manifest": ("LevelRecord", "Manifest", "SceneReference"),
    "fields.camera": ("Camera",),
    "hierarchy.cameras": ("level_camera", "level_intrinsics"),
    "fields.gaussian_field": ("GaussianField", "field_from_splats", "splats_from_field"),
    "runs.image_store": ("ImageStore",),
    "hierarchy.inheritance": ("field_from_points", "inherit"),
    "hierarchy.plan": ("Hierarchy", "Stage", "StagePlan", "level_size"),
    "hierarchy.pyramid": ("Pyramid",),
    "ops.composition": ("Composition", "compose"),
    "ops.photometric_loss": ("photometric_loss",),
    "reference_raster": ("CpuRasterizer",),
    "rendering.hierarchy_renderer": ("HierarchyRenderer",),
    "rendering.run": ("run_renderer", "run_scene"),
    "scenes": ("load_scene",),
    "training.merge": ("merge_levels",),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
