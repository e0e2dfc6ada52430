"""A run folder put back together: its fields, its scene, and a rasterizer for them."""

from __future__ import annotations

from pathlib import Path

from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.hierarchy.plan import level_size
from lapgs_plugin.rasterizers.choice import rasterizer_for
from lapgs_plugin.rendering.compose import HierarchyRenderer
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.manifest import SceneReference
from lapgs_plugin.scenes.scene import Scene, load_cameras, load_scene


def run_renderer(
    archive: RunArchive, device: str = "auto", rasterizer: str = "auto", *, finest: int = 0
) -> HierarchyRenderer:
    """A renderer of a run's finished levels.

    Args:
        archive: the run.
        device, rasterizer: as `rasterizer_for` takes them; what is left to it is the rasterizer of the training, or the
            nearest that runs here.
        finest: the finest level that is wanted; fields of finer ones are not read.

    Raises:
        RunFolderError: no level is finished, or a field is damaged.
        UserInputError, MissingExtraError: as `rasterizer_for`.
    """
    placed = rasterizer_for(archive.manifest, device, rasterizer)
    return HierarchyRenderer.from_archive(archive, placed.rasterizer, placed.device, finest=finest)


def run_scene(archive: RunArchive, moved_to: Path | None = None) -> Scene:
    """The scene a run was trained on, read as it was then.

    Args:
        moved_to: where the scene is now; None when it is still where the manifest says.

    Raises:
        RunFolderError: it is not there, or not the scene that the run was trained on.
        SceneError: it cannot be read.
    """
    reference, path = _scene_place(archive, moved_to)
    scene = load_scene(
        path,
        resolution=reference.resolution,
        images=reference.images,
        eval=reference.eval,
        background=reference.background,
    )
    require_same_scene(archive, scene.path, scene.smallest_size)
    return scene


def run_cameras(archive: RunArchive, moved_to: Path | None = None) -> tuple[dict[str, Camera], dict[str, Camera]]:
    """The cameras a run was trained on and those held out, by view name, without reading their images.

    Args, Raises:
        As `run_scene`.
    """
    reference, path = _scene_place(archive, moved_to)
    train, test = load_cameras(path, resolution=reference.resolution, images=reference.images, eval=reference.eval)
    cameras = [*train.values(), *test.values()]
    smallest = min(camera.width for camera in cameras), min(camera.height for camera in cameras)
    require_same_scene(archive, path, smallest)
    return train, test


def _scene_place(archive: RunArchive, moved_to: Path | None) -> tuple[SceneReference, Path]:
    """How a run read its scene, and where that is now."""
    reference = archive.manifest.scene
    path = Path(reference.path) if moved_to is None else moved_to
    if moved_to is None and not path.is_dir():
        raise RunFolderError(
            f"{archive.path()} was trained on {path}, which is not there any more; say where it is now with --scene"
        )
    return reference, path


def require_same_scene(archive: RunArchive, path: Path, smallest: tuple[int, int]) -> None:
    """Refuse a scene whose images are not of the size that was trained, before figures of it mislead.

    Args:
        archive: the run.
        path: of the scene, for the message.
        smallest: its `Scene.smallest_size`.

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
