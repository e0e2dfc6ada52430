"""Render finished hierarchies and write the images."""

from lapgs_plugin.ops.composition import Composition
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer

__all__ = ["Composition", "HierarchyRenderer"]
