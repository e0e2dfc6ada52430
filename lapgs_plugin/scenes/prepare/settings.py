"""Declare the options of a scene that is made from photos. Imports neither torch nor pycolmap."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.options import check_values, option

AUTO = "auto"
EXHAUSTIVE, SEQUENTIAL, RETRIEVAL = "exhaustive", "sequential", "retrieval"
ONE, FOLDER, IMAGE, RIG = "one", "folder", "image", "rig"
PER_GROUP, SINGLE, PER_FOLDER, PER_IMAGE = "AUTO", "SINGLE", "PER_FOLDER", "PER_IMAGE"
"""COLMAP's names for photos that share a camera: those of a group by EXIF, all, those of a folder, none."""
INCREMENTAL, GLOBAL = "incremental", "global"
CAMERA_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE", "EQUIRECTANGULAR"),
)
MIN_SIDE = 64  # features need room


@dataclass(frozen=True)
class PrepareSettings:
    """Choose how photos are matched, which cameras are fitted, and the size of the scene's images.

    Raises:
        UserInputError: a value is unknown or out of range.
    """

    max_size: int | None = option(
        None, "Longest side of the scene's images in pixels. Default: that of the photos.", least=MIN_SIDE
    )
    frames: int | None = option(
        None, "Frames to pick from a video. Default: 2 a second, clamped to [40, 240].", least=2
    )
    masks: Path | None = option(
        None,
        "Folder of masks: white where a photo shows the scene, black where it is ignored (a.jpg.png, a.png or "
        "a_mask.png for a.jpg). Default: transparent pixels of the photos, if there are any.",
    )
    tripod: float = option(
        0.0,
        "Ignore what panoramas show within this many degrees of straight down, such as a tripod: 30. Default: 0, "
        "ignore nothing.",
        least=0.0,
        most=90.0,
    )
    camera_model: str = option(
        AUTO,
        "COLMAP's camera model to fit, such as SIMPLE_RADIAL (few photos) or OPENCV_FISHEYE (fisheye lens), or "
        "EQUIRECTANGULAR for panoramas. auto: EQUIRECTANGULAR for photos twice as wide as high without a focal length, "
        "else OPENCV, and SIMPLE_RADIAL if the result is doubtful.",
    )
    matcher: str = option(
        AUTO,
        "Pairs of photos to match. exhaustive: all pairs, for up to a few hundred photos. sequential: neighbours in "
        "name order, for frames of a video. retrieval: each photo with those that look most like it. auto: sequential "
        "for a video, retrieval for more than 500 photos, else exhaustive.",
        choices=(AUTO, EXHAUSTIVE, SEQUENTIAL, RETRIEVAL),
    )
    mapper: str = option(
        INCREMENTAL,
        "How cameras are placed. incremental: one after the other. global: all at once.",
        choices=(INCREMENTAL, GLOBAL),
    )
    camera_per: str = option(
        AUTO,
        "Photos that share a lens. one: all. folder: those of a subfolder, for several cameras. rig: the same, of "
        "cameras that are fixed to each other; photos of one name in all subfolders are of one moment. image: each has "
        "its own. auto: those of the same size, maker and focal lengths by EXIF.",
        choices=(AUTO, ONE, FOLDER, RIG, IMAGE),
    )
    model: Path | None = option(
        None,
        "Folder of a COLMAP model of the photos, such as sparse/0, or of another program's export: take its cameras "
        "and only undistort. Default: the model or export in PHOTOS, if there is one.",
    )

    def __post_init__(self) -> None:
        if self.camera_model != AUTO:
            object.__setattr__(self, "camera_model", self.camera_model.upper())
            if self.camera_model not in CAMERA_MODELS:
                raise UserInputError(
                    f"--camera-model {self.camera_model!r}: expected auto or one of {', '.join(CAMERA_MODELS)}"
                )
        check_values(self)
