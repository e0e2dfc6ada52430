"""Rendering finished hierarchies."""
