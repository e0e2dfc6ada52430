"""Declare how a scene's images are read. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.options import option

BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


@dataclass(frozen=True)
class SceneOptions:
    """Choose the images of a scene, their size and their background.

    Raises:
        UserInputError: the background is no colour.
    """

    eval: bool = option(False, "Hold out every eighth view for `lapgs eval`; of a Blender scene its test views.")
    resolution: str = option(
        "full",
        "Image size: 1k, 2k or 4k as in the paper, full, a width such as 800, a fraction such as 1/4, or 3dgs:N as the "
        "option -r N of 3DGS codebases.",
    )
    images: str = option("images", "Image folder of the scene, such as images_4.")
    masks: str = option(
        "auto",
        "Masks of the photos: a folder of images that are black where a photo is ignored, alpha (the photos' own alpha "
        "channels), none, or auto (the scene's folder masks/, or mask_path of transforms.json, or none).",
    )
    sky: str = option(
        "none",
        "Masks of the sky: a folder of images that are white where a photo shows sky, or none. All levels are trained "
        "to be transparent there, and the photos' sky is left out as by --masks.",
    )
    background: str = option(
        "black", "Background of renders and of transparent pixels: black, white or R,G,B from 0 to 1."
    )

    def __post_init__(self) -> None:
        _ = self.background_color

    @property
    def background_color(self) -> tuple[float, float, float]:
        """RGB in [0, 1]."""
        text = self.background
        if text in BACKGROUNDS:
            return BACKGROUNDS[text]
        try:
            red, green, blue = (float(part) for part in text.split(","))
        except ValueError as error:
            raise UserInputError(
                f"--background {text!r}: expected black, white or R,G,B such as 0.5,0.5,0.5"
            ) from error
        if not all(0.0 <= value <= 1.0 for value in (red, green, blue)):
            raise UserInputError(f"--background {text!r}: expected three values from 0 to 1")
        return red, green, blue
