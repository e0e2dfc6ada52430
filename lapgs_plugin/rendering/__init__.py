"""Render finished hierarchies and write the images."""
