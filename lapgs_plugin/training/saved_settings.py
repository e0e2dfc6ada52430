"""Read the settings of a run from its manifest. Imports no torch."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.hierarchy.plan import Hierarchy
from lapgs_plugin.hierarchy.supervision import SUPERVISIONS
from lapgs_plugin.training.settings import IN_MANIFEST, TrainSettings
from lapgs_plugin.training.strategies import STRATEGIES
from lapgs_plugin.untrusted import StrictWithMore, checked

if TYPE_CHECKING:
    from lapgs_plugin.runs.manifest import Manifest

NEUTRAL = {"coarse_threshold": None, "residual_resets": False}
"""Settings that some strategies leave unused, with the values that choose nothing; manifests have the resolved ones."""


def settings_from_manifest(manifest: Manifest, name: str = "the run's manifest") -> TrainSettings:
    """Return the settings that a run was started with.

    Args:
        manifest: of the run.
        name: of the manifest in messages.

    Raises:
        RunFolderError: they hold a key this version does not know, lack one, or one has another type.
    """
    if "densification" not in manifest.settings:
        raise RunFolderError(
            f"{name}: the run was not started by `lapgs train`, which continues its own runs alone; continue it with "
            "the program that made it, or train again with --overwrite"
        )
    advice = "restore it or train again with --overwrite"
    values = {**manifest.settings, **{field: getattr(manifest, field) for field in IN_MANIFEST}}
    values.pop("raster", None)  # `antialiased` says it
    values["distorted"] = manifest.scene.distorted
    if difference := sorted(set(values) ^ {f.name for f in fields(TrainSettings)}):
        raise RunFolderError(
            f"{name}: the run was not started by `lapgs train` of this version (settings {', '.join(difference)} "
            f"do not match); continue it with {manifest.created_by}"
        )
    checked(values, _Saved, name, error=RunFolderError, advice=advice)
    density = dict(values["densification"])
    options = density.pop("options")
    try:
        unused = STRATEGIES[density["strategy"]].unused
        SUPERVISIONS[values["supervision"]]
    except UserInputError as error:
        raise RunFolderError(f"{name}: {error}; install the package that brings it") from error
    values |= {"densification": density, **{setting: NEUTRAL[setting] for setting in NEUTRAL.keys() & set(unused)}}
    if values["hierarchy"] == Hierarchy.NESTED.value:
        values["inherit"] = None  # the same
    settings: TrainSettings = checked(values, TrainSettings, name, error=RunFolderError, advice=advice)
    chosen = settings.densification
    saved = checked(options, type(chosen.options), f"{name}: {chosen.strategy}", error=RunFolderError, advice=advice)
    try:
        return replace(settings, densification=replace(chosen, options=saved))
    except UserInputError as error:
        raise RunFolderError(f"{name} is damaged: {error}; {advice}") from error


class _SavedDensification(StrictWithMore):
    strategy: str
    options: dict[str, Any]


class _Saved(StrictWithMore):
    """The part of the settings that is read before the types of the strategy's options are known."""

    densification: _SavedDensification
    hierarchy: str
    supervision: str
