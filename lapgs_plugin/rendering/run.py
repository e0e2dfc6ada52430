"""Load a run to render it: its fields, its scene, cameras of a path, and a rasterizer."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import torch

from lapgs_plugin.errors import RunFolderError, SceneError, errors_about
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.pose import corrected
from lapgs_plugin.files import MANIFEST, is_folder
from lapgs_plugin.hierarchy.plan import level_size
from lapgs_plugin.limits import FRAMES
from lapgs_plugin.rasterizers.choice import rasterizer_for
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.rig import Rig
from lapgs_plugin.rendering.trajectory import orbit, read_trajectory, spline, walking_order
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.manifest import SceneReference
from lapgs_plugin.runs.neighbours import predicted_poses
from lapgs_plugin.scenes.masks import ALPHA, NONE
from lapgs_plugin.scenes.scene import Scene, View, load_cameras, load_scene, smallest_of

PATHS = ("orbit", "spline")


def run_renderer(
    archive: RunArchive, device: str = "auto", rasterizer: str = "auto", *, finest: int = 0
) -> HierarchyRenderer:
    """Return a renderer of a run's finished levels down to `finest`; device and rasterizer as `rasterizer_for`.

    Raises:
        RunFolderError: no level is finished, or a field is damaged.
        UserInputError, MissingExtraError: as `rasterizer_for`.
    """
    placed = rasterizer_for(archive.manifest, device, rasterizer)
    return HierarchyRenderer.from_archive(archive, placed.rasterizer, placed.device, finest=finest)


def load_reference(
    reference: SceneReference,
    check: Callable[[tuple[int, int], int], None] | None = None,
    hold: bool = True,
    read: bool = True,
) -> Scene:
    """Load the scene that a manifest names, as the manifest says; `check`, `hold` and `read` as `load_scene`."""
    return load_scene(
        reference.path,
        resolution=reference.resolution,
        images=reference.images,
        eval=reference.eval,
        masks=reference.masks,
        sky=reference.sky,
        background=reference.background,
        distorted=reference.distorted,
        check=check,
        hold=hold,
        read=read,
    )


def run_scene(archive: RunArchive, moved_to: Path | None = None) -> Scene:
    """Load the scene of a run with the settings of the training. Its images are read when they are used.

    Args:
        moved_to: current folder of the scene; None if it is where the manifest says.

    Raises:
        RunFolderError: it or its masks are missing, or it is not the scene that the run was trained on.
        SceneError: it cannot be read.
    """
    reference, path = _scene_folder(archive, moved_to)
    for masks in {reference.masks, reference.sky} - {NONE, ALPHA}:
        if not is_folder(path / masks):
            otherwise = "" if moved_to is None else " or give the scene of this run with --scene"
            raise RunFolderError(
                f"{archive.path()} was trained with the masks in {path / masks}, which are not there any more; "
                f"put them back{otherwise}"
            )
    with _errors_about_scene(archive, moved_to):
        scene = load_reference(replace(reference, path=str(path)), hold=False)
    require_same_scene(archive, scene.path, scene.smallest_size)
    views = {view.name: view for view in (*scene.train, *scene.test)}
    cameras = _as_rendered(archive, moved_to, _by_name(scene.train), _by_name(scene.test))
    train, test = (tuple(views[name].at(camera) for name, camera in each.items()) for each in cameras)
    return replace(scene, train=train, test=test)


def _errors_about_scene(archive: RunArchive, moved_to: Path | None) -> AbstractContextManager[None]:
    """Begin the messages of a block with where the scene's folder is said: in the run, or by the user."""
    return errors_about(archive.path(MANIFEST) if moved_to is None else "--scene")


def is_other_scene(archive: RunArchive, moved_to: Path | None, cameras: Mapping[str, Camera] | None = None) -> bool:
    """Return whether a folder has none of the photos that a run was trained on, by their names and poses.

    False if those are missing now: the scene was moved.

    Args:
        archive: of the run.
        moved_to: current folder of the scene; None if it is where the manifest says.
        cameras: of that folder by view name, as its files have them; None reads them.
    """
    reference = archive.manifest.scene
    trained_on = Path(reference.path)
    # Of the folder that the run was trained on, such as `lapgs train` gives at its end, files need not be read again.
    if moved_to is None or moved_to.absolute() == trained_on or not is_folder(trained_on):
        return False
    try:
        own = _scene_cameras(reference, trained_on)
        here = _scene_cameras(reference, moved_to) if cameras is None else (cameras,)
    except SceneError:
        return False
    trained = {name: camera for part in own for name, camera in part.items()}
    return not any(
        name in trained and torch.allclose(trained[name].world_to_camera, camera.world_to_camera)
        for part in here
        for name, camera in part.items()
    )


def run_cameras(archive: RunArchive, moved_to: Path | None = None) -> tuple[dict[str, Camera], dict[str, Camera]]:
    """Load the training and held-out cameras of a run by view name, without reading images.

    Args, Raises:
        As `run_scene`.
    """
    reference, path = _scene_folder(archive, moved_to)
    with _errors_about_scene(archive, moved_to):
        train, test = _scene_cameras(reference, path)
    require_same_scene(archive, path, smallest_of([*train.values(), *test.values()]))
    return _as_rendered(archive, moved_to, train, test)


def _scene_cameras(reference: SceneReference, path: Path) -> tuple[dict[str, Camera], dict[str, Camera]]:
    """Load the training and held-out cameras by view name as a scene's files have them."""
    return load_cameras(
        path,
        resolution=reference.resolution,
        images=reference.images,
        eval=reference.eval,
        distorted=reference.distorted,
    )


def _as_rendered(
    archive: RunArchive, moved_to: Path | None, train: Mapping[str, Camera], test: Mapping[str, Camera]
) -> tuple[dict[str, Camera], dict[str, Camera]]:
    """Return the cameras of a scene's files by view name as the run has them: its script's, and `refined`.

    Photos of another scene keep their cameras. What the run learned of a photo says nothing about one of the same name.

    Raises:
        RunFolderError: as `_as_trained` and `refined`.
    """
    if is_other_scene(archive, moved_to, {**train, **test}):
        return dict(train), dict(test)
    train, test = _as_trained(archive, train, test)
    return refined(archive, train), refined(archive, test)


def _by_name(views: Sequence[View]) -> dict[str, Camera]:
    return {view.name: view.camera for view in views}


def _as_trained(
    archive: RunArchive, train: Mapping[str, Camera], test: Mapping[str, Camera]
) -> tuple[dict[str, Camera], dict[str, Camera]]:
    """Return cameras by view name as the run's script had them, where they are not those of the scene.

    Raises:
        RunFolderError: the scene lacks a view of the run, or the file is damaged.
    """
    own = archive.cameras()
    if own is None:
        return dict(train), dict(test)
    if missing := next((name for name in {**own.train, **own.test} if name not in {**train, **test}), None):
        raise RunFolderError(
            f"{archive.path()} was trained on {missing}, which its scene does not have any more; give the scene of the "
            "run with --scene"
        )
    return dict(own.train), dict(own.test)


def refined(archive: RunArchive, cameras: Mapping[str, Camera]) -> dict[str, Camera]:
    """Return cameras by view name at the poses to which the run refined them, if it did.

    Held-out views are moved as their neighbours are if these predict each other, see `runs.neighbours`.

    Raises:
        RunFolderError: the file of its corrections is damaged.
    """
    levels = archive.available_levels
    learned = (archive.poses(levels[-1]) if levels else None) or {}
    moved = {**predicted_poses(learned, cameras.keys() - learned.keys()), **learned}
    return {name: corrected(camera, moved[name]) if name in moved else camera for name, camera in cameras.items()}


def refined_views(archive: RunArchive, views: Sequence[View]) -> tuple[View, ...]:
    """Return views with `refined` cameras."""
    cameras = refined(archive, {view.name: view.camera for view in views})
    return tuple(view.at(cameras[view.name]) for view in views)


def path_cameras(
    archive: RunArchive, trajectory: str, frames: int | None, default: int, scene: Path | None
) -> list[Camera]:
    """Return the cameras of a path, one per frame.

    Args:
        archive: of the run whose training cameras the path surrounds or follows.
        trajectory: "orbit", "spline" or a file for `trajectory.read_trajectory`.
        frames: number of frames; None for `default`, or each camera of a file once.
        default: frames of an orbit or a spline.
        scene: current folder of the run's scene; None if it is where the run was trained.

    Raises:
        UserInputError: the file or one of its cameras cannot be used, or there are more frames than `limits.FRAMES`.
        RunFolderError, SceneError: the scene is missing or not the run's.
    """
    if frames is not None:
        FRAMES.check(frames, f"--frames {frames}")
    if trajectory not in PATHS:
        cameras = read_trajectory(Path(trajectory))
        return cameras if frames is None else spline(cameras, frames)
    train = list(run_cameras(archive, scene)[0].values())
    count = default if frames is None else frames
    return orbit(Rig.of(train), count) if trajectory == "orbit" else spline(walking_order(train), count)


def _scene_folder(archive: RunArchive, moved_to: Path | None) -> tuple[SceneReference, Path]:
    """Return how a run read its scene, and the current folder of the scene."""
    reference = archive.manifest.scene
    path = Path(reference.path) if moved_to is None else moved_to
    if moved_to is None and not path.is_dir():
        raise RunFolderError(
            f"{archive.path()} was trained on {path}, which is not there any more; say where it is now with --scene"
        )
    return reference, path


def require_same_scene(archive: RunArchive, path: Path, smallest: tuple[int, int]) -> None:
    """Check that a scene's images, of `Scene.smallest_size`, have the size that was trained; else metrics are wrong.

    Raises:
        RunFolderError: a finished level had another size.
    """
    for record in archive.manifest.records:
        size = level_size(smallest, record.level)
        if size != record.image_size:
            raise RunFolderError(
                f"{path}: level {record.level} would be {size[0]}x{size[1]} pixels, the run was trained at "
                f"{record.image_size[0]}x{record.image_size[1]}; give the scene of {archive.path()} with --scene"
            )
