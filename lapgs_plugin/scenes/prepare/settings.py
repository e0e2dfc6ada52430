"""Declare the options of a scene that is made from photos. Imports neither torch nor pycolmap."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.options import check_values, option

AUTO = "auto"
EXHAUSTIVE, SEQUENTIAL, RETRIEVAL = "exhaustive", "sequential", "retrieval"
INCREMENTAL, GLOBAL = "incremental", "global"
CAMERA_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"),
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
        "COLMAP's camera model to fit, such as SIMPLE_RADIAL (few photos) or OPENCV_FISHEYE (fisheye lens). auto: "
        "OPENCV, and SIMPLE_RADIAL if the result is doubtful.",
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
    single_camera: bool | None = option(
        None,
        "Fit one camera to all photos, or one to each group of photos with the same EXIF data. Default: one camera if "
        "all photos have the same size and camera.",
        names=("--single-camera/--own-cameras",),
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
