"""A view to train on."""

from utils.plain_camera import Camera

__all__ = ["Camera"]
