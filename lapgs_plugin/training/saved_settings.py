"""Read the settings of a run from its manifest, whichever version wrote it. Imports no torch."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

from typing_extensions import NotRequired

from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.hierarchy.plan import Hierarchy
from lapgs_plugin.hierarchy.supervision import SUPERVISIONS
from lapgs_plugin.training.settings import IN_MANIFEST, LAST, OFF, TrainSettings
from lapgs_plugin.training.strategies import GRADIENTS, STRATEGIES
from lapgs_plugin.untrusted import StrictWithMore, checked

if TYPE_CHECKING:
    from lapgs_plugin.runs.manifest import Manifest

LEFT_OUT_ONCE: dict[str, Any] = {
    **{"packed": False, "sparse_adam": False, "joint": 0.0, "gather": 1, "hierarchy": "laplacian"},
    **{"base_sh_degree": None, "views_per_step": "1", "residual_threshold": 1.0, "sh_rate_factor": 1.0, "dropout": 0.0},
    **{"protocol": "default", "exposure": OFF, "keep": LAST, "extended": 0, "refine_poses": False},
}
"""Settings that older manifests do not name, with the values they had."""


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
    values = {**manifest.settings, **{each: getattr(manifest, each) for each in IN_MANIFEST}}
    checked(values, _OldSettings, name, error=RunFolderError, advice=advice)
    try:
        values, options = _of_this_version(values)
        SUPERVISIONS[values["supervision"]]
    except UserInputError as error:
        raise RunFolderError(f"{name}: {error}; install the package that brings it") from error
    values.pop("raster", None)  # `antialiased` says it
    if difference := sorted(set(values) ^ {f.name for f in fields(TrainSettings)}):
        raise RunFolderError(
            f"{name}: the run was not started by `lapgs train` of this version (settings {', '.join(difference)} "
            f"do not match); continue it with {manifest.created_by}"
        )
    settings: TrainSettings = checked(values, TrainSettings, name, error=RunFolderError, advice=advice)
    density = settings.densification
    chosen = checked(options, type(density.options), f"{name}: {density.strategy}", error=RunFolderError, advice=advice)
    try:
        return replace(settings, densification=replace(density, options=chosen))
    except UserInputError as error:
        raise RunFolderError(f"{name} is damaged: {error}; {advice}") from error


class _OldDensification(StrictWithMore):
    strategy: NotRequired[str]


class _OldSettings(StrictWithMore):
    """Settings of a run of any version that `_of_this_version` converts."""

    densification: _OldDensification
    inherit_ratio: NotRequired[float]
    learning_rates: dict[str, Any]
    split: str | list[str] | None


def _of_this_version(given: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return settings of an older run by their present names and places, and the options of its strategy."""
    # Residual stages reset opacities before there was a choice.
    values = {**LEFT_OUT_ONCE, "residual_resets": given.get("hierarchy", "laplacian") == "laplacian", **given}
    density, rates = dict(values["densification"]), dict(values["learning_rates"])
    rates.pop("sh_rest_factor", None)
    rates.pop("sh_rest_decay", None)
    for name in ("coarse_threshold", "prune"):
        values.setdefault(name, density.pop(name, None if name == "coarse_threshold" else 0.0))
    for old, new in (("cache", "images_on"), ("cache_precision", "prediction_precision")):
        if old in values:
            values[new] = values.pop(old)
    if (ratio := values.pop("inherit_ratio", 1.0)) != 1.0:
        values["inherit"] = f"{values['inherit']}:{ratio:g}"
    if isinstance(values["split"], list):
        values["split"] = ",".join(values["split"])
    elif values["split"] is None and "cache" in given and values["levels"] == 2:
        values["split"] = "1/2,1/2"  # the default then, of residuals too
    if density.get("strategy", "default") == "default":  # its name once
        density["strategy"] = GRADIENTS
    strategy = STRATEGIES[density["strategy"]]
    options = density.pop("options", None)
    if options is None:  # older runs list those of all strategies beside the rest
        every = {each.name for name in ("multiview", "mcmc") for each in fields(STRATEGIES[name])}
        listed = {name: density.pop(name) for name in every & density.keys()}
        options = {each.name: listed[each.name] for each in fields(strategy) if each.name in listed}
    for name, neutral in (("coarse_threshold", None), ("residual_resets", False)):
        if name in strategy.unused:
            values[name] = neutral  # manifests name the hierarchy's all the same
    if values["hierarchy"] == Hierarchy.NESTED.value:
        values["inherit"] = None  # the same
    values.setdefault("antialiased", bool(values.get("raster")))
    values.setdefault("residual_color_rate", None)
    return {**values, "densification": density, "learning_rates": rates}, options
