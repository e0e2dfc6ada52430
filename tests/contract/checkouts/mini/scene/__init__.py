"""The scene."""

from utils.plain_scene import Scene

from scene.gaussian_model import GaussianModel

__all__ = ["GaussianModel", "Scene"]
