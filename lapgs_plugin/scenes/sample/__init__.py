"""A procedural scene with exact cameras: `lapgs sample`."""

from lapgs_plugin.scenes.sample.scene import make_sample_scene

__all__ = ["make_sample_scene"]
