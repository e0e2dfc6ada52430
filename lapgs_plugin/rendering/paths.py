"""The cameras of a path, as the command line names it."""

from __future__ import annotations

from pathlib import Path

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.limits import FRAMES
from lapgs_plugin.rendering.rig import Rig
from lapgs_plugin.rendering.run import run_cameras
from lapgs_plugin.rendering.trajectory import orbit, read_trajectory, spline, walking_order
from lapgs_plugin.runs.archive import RunArchive

PATHS = ("orbit", "spline")


def path_cameras(
    archive: RunArchive, trajectory: str, frames: int | None, default: int, scene: Path | None
) -> list[Camera]:
    """The cameras of a path, one a frame.

    Args:
        archive: of the run whose training cameras it goes around or through.
        trajectory: "orbit", "spline" or a file, as `trajectory.read_trajectory` reads it.
        frames: how many; None for `default`, or each camera of a file once.
        default: frames of an orbit or a spline.
        scene: where the run's scene is now; None where it was trained.

    Raises:
        UserInputError: the file or one of its cameras is not usable, or there are more frames than `limits.FRAMES`.
        RunFolderError, SceneError: the scene is not there or not the run's.
    """
    if frames is not None:
        FRAMES.check(frames, f"--frames {frames}")
    if trajectory not in PATHS:
        cameras = read_trajectory(Path(trajectory))
        return cameras if frames is None else spline(cameras, frames)
    train = list(run_cameras(archive, scene)[0].values())
    count = default if frames is None else frames
    return orbit(Rig.of(train), count) if trajectory == "orbit" else spline(walking_order(train), count)
