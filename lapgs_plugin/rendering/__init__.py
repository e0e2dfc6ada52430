"""Rendering finished hierarchies: composing their levels, and writing the images."""

from lapgs_plugin.rendering.compose import Composition, HierarchyRenderer

__all__ = ["Composition", "HierarchyRenderer"]
