"""Write and compare the manifests of runs over checkouts."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.checkouts.training_call import TrainingCall
from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.hierarchy.plan import StagePlan
from lapgs_plugin.rasterizers.choice import RASTER_SETTINGS
from lapgs_plugin.runner.rasterizer_choice import CHOICE, Decision
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.runs.manifest import Manifest, SceneReference
from lapgs_plugin.scenes.masks import resolve_masks

COMPARED_OTHERWISE = {
    *("-s", "--source_path", "-i", "--images", "-r", "--resolution", "-w", "--white_background"),
    *("--eval", "--iterations", "--sh_degree"),
}
"""Options of a script whose values stand in the manifest by other names."""
OF_NO_EFFECT = {
    *("-m", "--model_path", "--ip", "--port", "--quiet", "--disable_viewer", "--websockets", "--data_device"),
    *("--save_iterations", "--test_iterations", "--checkpoint_iterations", "--benchmark_dir"),
    *("--debug", "--debug_from", "--detect_anomaly"),
}
"""Options of a script that change nothing of what it trains."""


def scene_reference(path: Path, dataset: Any, masks: str = "none", holds_out: bool = False) -> SceneReference:
    """Return the scene of a run of a 3DGS code base.

    Args:
        path: of the scene.
        dataset: the code base's options of its model.
        masks: as of `SceneReference`.
        holds_out: whether views are held out where the code base has no option for it.
    """
    return SceneReference(
        path=str(path.absolute()),
        resolution=f"3dgs:{dataset.resolution}",
        eval=bool(getattr(dataset, "eval", holds_out)),
        background=(1.0, 1.0, 1.0) if getattr(dataset, "white_background", False) else (0.0, 0.0, 0.0),
        kind="colmap" if (path / "sparse").is_dir() else "transforms",
        images=getattr(dataset, "images", None) or "images",
        masks=masks,
    )


def make_manifest(
    adapter: BackboneAdapter,
    settings: RunSettings,
    call: TrainingCall,
    plan: StagePlan,
    holds_out: bool,
    rasterizer: Decision | None = None,
) -> Manifest:
    """Return the manifest of a run before its first stage.

    Args:
        adapter, settings, plan: of the run.
        call: the script's, for the whole run.
        holds_out: whether its scene has held-out views.
        rasterizer: whose trains it; None on a CPU.
    """
    dataset, path = call.dataset, Path(call.dataset.source_path)
    return Manifest(
        scene=scene_reference(path, dataset, resolve_masks(path, settings.masks), holds_out),
        levels=plan.levels,
        grid=settings.grid,
        supervision=settings.supervision,
        inherit=settings.resolved()["inherit"],
        sh_degree=dataset.sh_degree,
        rasterizer=adapter.rasterizer,
        seed=settings.seed,
        settings={
            "backbone": {
                "name": adapter.info.name,
                "checkout": str(adapter.root),
                "arguments": sys.argv[1:],
            },
            RASTER_SETTINGS: adapter.raster_settings(call),
            **({} if rasterizer is None else {CHOICE: rasterizer.for_manifest()}),
            "iterations": plan.iterations,
            **settings.for_manifest(),
        },
    )


def require_same_run(begun: Manifest, wanted: Manifest) -> None:
    """Refuse to continue a run with other settings: its levels would not belong together.

    Raises:
        RunFolderError: a setting differs.
    """
    before, now = _identity(begun), _identity(wanted)
    for name in {**before, **now}:
        if before.get(name) != now.get(name):
            named = name in ("hierarchy", "split") and before.get(name)
            same = f"--{name} {before[name]}" if named else "the same options"
            raise RunFolderError(
                f"this run was started with another {name} ({before.get(name)!r}, now {now.get(name)!r}); "
                f"resume with {same}, or start again with --overwrite"
            )
    first, second = (
        _script_options(manifest.settings.get("backbone", {}).get("arguments", ())) for manifest in (begun, wanted)
    )
    for name in {**first, **second}:
        if first.get(name) != second.get(name):
            was = "without it" if name not in first else f"with {' '.join((name, *first[name]))}"
            raise RunFolderError(
                f"{' '.join((name, *second.get(name, ())))}: this run was started {was}; resume with the same options, "
                "or start again with --overwrite"
            )


def _script_options(arguments: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the options of a script that change what it trains, each with its values as they were typed."""
    options: dict[str, tuple[str, ...]] = {}
    name = ""
    for word in arguments:
        if re.match(r"--?[A-Za-z]", word):
            name, equals, value = word.partition("=")
            options[name] = (value,) if equals else ()
        else:
            options[name] = (*options.get(name, ()), word)
    return {name: values for name, values in options.items() if name not in COMPARED_OTHERWISE | OF_NO_EFFECT}


def _identity(manifest: Manifest) -> dict[str, Any]:
    """Return the values that must stay while a run is continued.

    Where images lie, and what makes a loop faster, may change: to save memory, or after a failure.
    """
    values = asdict(manifest)
    for name in ("records", "created", "created_by"):
        values.pop(name)
    scene = {f"{name} of the scene": value for name, value in values.pop("scene").items()}
    settings = values.pop("settings")
    backbone = {name: value for name, value in settings.pop("backbone", {}).items() if name != "arguments"}
    for name in ("images_on", "run_ahead", "fused_adam", "fused_ssim", CHOICE):
        settings.pop(name, None)
    decisive = {
        name: settings.get(name) for name in ("hierarchy", "protocol")
    }  # first: other defaults follow from them
    return {**decisive, **scene, **values, **settings, **backbone}
