"""Find the reader of an export among those of this package and of others, and read it as a model of COLMAP."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lapgs_plugin.errors import SceneError
from lapgs_plugin.registry import Registry
from lapgs_plugin.scenes.colmap import refuse_distorted, source_of, with_lenses
from lapgs_plugin.scenes.colmap_model import Model, model_of
from lapgs_plugin.scenes.colmap_records import Points
from lapgs_plugin.scenes.exports.base import Export, PhotoFinder, SceneReader
from lapgs_plugin.scenes.exports.points import SEEN, seen_share
from lapgs_plugin.scenes.source import SceneSource, hold_out

NO_POINTS = np.empty((0, 3))

SCENE_READERS: Registry[type[SceneReader]] = Registry(
    "exports of other programs",
    "lapgs.scenes",
    SceneReader,
    {
        name.lower(): f"lapgs_plugin.scenes.exports.{name.lower()}:{name}"
        for name in ("Metashape", "RealityCapture", "Bundler", "Record3D", "Polycam", "OpenSfM", "ARKitScenes")
    },
    classes=True,
)
"""Readers of exports by the name of the program."""


@dataclass(frozen=True)
class FoundExport:
    """An export in a folder: the name of its reader, and its file or folder of cameras."""

    name: str
    source: Path

    def read(self, root: Path, images: str = "images") -> tuple[Model, SceneSource]:
        """Read the export as a model, and as frames with pinhole cameras.

        Args:
            root: folder of the scene, or of the photos.
            images: folder of the photos in it.

        Raises:
            SceneError: it cannot be read.
        """
        export = SCENE_READERS[self.name]().read(self.source, PhotoFinder(root, images))
        model = _model_of(export, root)
        source = source_of(model, root)
        paths = dict(zip([image.name for image in model.images.values()], export.shots, strict=True))
        frames = tuple(replace(frame, path=paths[frame.name].photo) for frame in source.train)
        return model, replace(source, kind=self.name, train=frames)


def _model_of(export: Export, root: Path) -> Model:
    """Return an export as a model, whose photos are named relative to `root`, or without folders if not in it."""
    named = [
        (
            (shot.photo.relative_to(root) if shot.photo.is_relative_to(root) else Path(shot.photo.name)).as_posix(),
            shot.camera,
            shot.world_to_camera,
        )
        for shot in export.shots
    ]
    cloud, warnings = export.points, list(export.warnings)
    if cloud and len(cloud.xyz) and seen_share(cloud.xyz, export.shots) < SEEN:
        warnings.append(
            f"{export.source}: its cameras see few of its points, which are not used; export both in the same "
            "coordinate system"
        )
        cloud = None
    warnings += [cloud.warning] if cloud and cloud.warning else []
    points = Points(NO_POINTS, NO_POINTS) if cloud is None else Points(cloud.xyz, 255.0 * cloud.rgb)
    return replace(model_of(export.source, named, points), warnings=tuple(warnings))


def find_export(folder: Path) -> FoundExport | None:
    """Return the export in a folder; None without one.

    Raises:
        SceneError: there are several.
    """
    exports = [(name, source) for name in SCENE_READERS if (source := SCENE_READERS[name]().find(folder)) is not None]
    if len(exports) > 1:
        some = " and ".join(f"{source.name} ({SCENE_READERS[name].title})" for name, source in exports[:2])
        raise SceneError(f"{folder}: it holds {some}, expected one of them; move the other elsewhere")
    return FoundExport(*exports[0]) if exports else None


def read_export(export: FoundExport, path: Path, images: str, evaluate: bool, distorted: bool = False) -> SceneSource:
    """Read the frames and points of an export, of which `evaluate` holds out every eighth.

    With `distorted` cameras have their lenses.

    Raises:
        SceneError: it cannot be read, or a camera is distorted.
    """
    model, source = export.read(path, images)
    if distorted:
        source = with_lenses(source, model, path)
    else:
        refuse_distorted(model, path)
    train, test = hold_out(source.train, evaluate)
    return replace(source, train=train, test=test)
