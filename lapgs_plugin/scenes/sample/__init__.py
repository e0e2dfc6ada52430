"""A procedural scene with exact cameras: `lapgs sample`."""

from lapgs_plugin.scenes.sample.scene import check_sample_scene, make_sample_scene

__all__ = ["check_sample_scene", "make_sample_scene"]
