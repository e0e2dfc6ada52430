"""Measure a finished run: the figures that `lapgs eval` writes into metrics.json."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any

from torch import Tensor

from lapgs_plugin.environment import versions
from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.evaluation.lpips import LPIPS_KEY, LpipsMetrics, LpipsRequest, lpips_metrics
from lapgs_plugin.evaluation.metrics import color_fitted_psnr, psnr, ssim
from lapgs_plugin.hierarchy.masks import fill_outside, masked_gaussian
from lapgs_plugin.jit.threads import one_pool
from lapgs_plugin.ops.color_transform import transform_colors
from lapgs_plugin.ops.composition import Composition, to_full_size
from lapgs_plugin.progress import item_progress
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.options import WHERE_TRAINED, RenderOptions
from lapgs_plugin.rendering.run import is_other_scene, run_renderer, run_scene
from lapgs_plugin.rendering.speed import composed_speed
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import METRICS
from lapgs_plugin.runs.manifest import LevelRecord, Manifest
from lapgs_plugin.runs.neighbours import predicted_exposures
from lapgs_plugin.runs.results import MEASURED
from lapgs_plugin.runs.training_figures import training_figures
from lapgs_plugin.scenes.scene import View

METRIC_KEYS = {
    *("psnr", "ssim", "lpips_missing", "fps", "split", "num_views", "views", "levels"),
    *("train_seconds", "overhead_seconds", "breakdown_seconds"),
    *("num_gaussians", "weighted_gaussians"),
    *("mean_gaussians", "peak_gaussians", "peak_memory_bytes", "peak_memory_without_images_bytes"),
    *("rasterizer", "versions"),
}
"""Keys of metrics.json; `run_figures` describes them."""

FPS_VIEWS, FPS_ROUNDS = 16, 3
"""Views and repetitions of each over which frames a second are measured, at most."""


@dataclass(frozen=True)
class ViewMetrics:
    """Quality of one rendered view.

    Attributes:
        name: name of the view's image.
        psnr, ssim: of the composition at full resolution; PSNR in dB.
        fitted_psnr: PSNR in dB of its right half after a colour fit on its left half.
        lpips: the measured distances, by variant.
        level_psnr: by level, PSNR in dB of I_hat^l against level l of the photo's Gaussian pyramid, both at the
            level's size.
        upsampled_psnr: by level, PSNR in dB of I_hat^l upsampled to full resolution, against the photo: the quality
            without the finer levels.
    """

    name: str
    psnr: float
    fitted_psnr: float
    ssim: float
    lpips: dict[str, float]
    level_psnr: dict[int, float]
    upsampled_psnr: dict[int, float]


def measure_view(
    view: View,
    composition: Composition,
    renderer: HierarchyRenderer,
    lpips: LpipsMetrics,
    exposure: Tensor | None = None,
) -> ViewMetrics:
    """Compare a rendered view with its photo at every level, inside of its mask, on the renderer's device.

    Args:
        exposure: (3, 4) colour transform from renders to this photo; None for renders as they are.
    """
    if exposure is not None:
        transform = exposure.to(renderer.device)
        composed = {level: transform_colors(image, transform) for level, image in composition.composed.items()}
        composition = replace(composition, composed=composed)
    photo, mask = view.image.to(renderer.device), None
    targets: list[tuple[Tensor, Tensor | None]]
    if view.mask is None:
        targets = [(each, None) for each in renderer.pyramid.gaussian(photo, renderer.levels)]
    else:
        mask = view.mask.to(renderer.device)
        targets = [*masked_gaussian(renderer.pyramid, photo, mask, renderer.levels)]
    level_psnr = {level: psnr(image, *targets[level]) for level, image in composition.composed.items()}
    upsampled = {
        level: psnr(to_full_size(image, view.camera.size, level, renderer.pyramid), photo, mask)
        for level, image in composition.composed.items()
    }
    whole = composition.composed[0]
    distances = lpips.measure(fill_outside(whole, photo, mask), photo)
    fitted = color_fitted_psnr(whole, photo, mask)
    return ViewMetrics(view.name, level_psnr[0], fitted, ssim(whole, photo, mask), distances, level_psnr, upsampled)


def evaluate_run(
    archive: RunArchive, options: RenderOptions = WHERE_TRAINED, lpips: LpipsRequest | None = None
) -> dict[str, Any]:
    """Measure a complete run on its held-out views, or on its training views when none were held out.

    All views are measured of a scene that the run was not trained on.

    Show a progress bar and write the result to the run's metrics.json.

    Args:
        archive: the run.
        options: where the scene is, and what renders the run.
        lpips: distances to measure, those of VGG by default. Distances without weights are left out, and
            "lpips_missing" says so.

    Returns:
        The content of metrics.json, see `run_figures`.

    Raises:
        RunFolderError: the run is not complete, or its scene is missing.
        UserInputError: a file of LPIPS weights cannot be used.
    """
    require_complete(archive)
    renderer = run_renderer(archive, options.device, options.rasterizer)
    with one_pool():
        scene = run_scene(archive, options.scene)
        split, views = ("test", scene.test) if scene.test else ("train", scene.train)
        if options.scene is not None and is_other_scene(archive, scene):
            split, views = "other", tuple(sorted((*scene.train, *scene.test), key=lambda view: view.name))
        smallest = min(min(view.camera.size) for view in views)
        distances = lpips_metrics(lpips or LpipsRequest(), smallest, renderer.device)
        learned = archive.exposure(archive.available_levels[-1])
        exposures = {} if learned is None else predicted_exposures(learned, [view.name for view in views])
        with item_progress("views") as progress:
            measured = [
                measure_view(view, renderer.render(view.camera), renderer, distances, exposures.get(view.name))
                for view in progress.track(views, description=f"Measuring {MEASURED[split]} views")
            ]
        speed = composed_speed(renderer, [view.camera for view in views[:FPS_VIEWS]], FPS_ROUNDS)
    metrics = {
        **run_figures(archive.manifest, split, measured, renderer.rasterizer.name),
        "lpips_missing": dict(distances.missing),
        "fps": speed.fps,
        "masked": any(view.mask is not None for view in views),
        "exposure_compensated": learned is not None,
        "exposure_predicted": bool(exposures),
    }
    archive.write_metrics(metrics)
    return metrics


def run_metrics(archive: RunArchive, options: RenderOptions) -> dict[str, Any]:
    """Return the run's metrics.json, or measure it with `evaluate_run` when it does not exist.

    Raises:
        RunFolderError: see `evaluate_run`; or another program wrote the file.
    """
    require_complete(archive)
    metrics = archive.metrics()
    if metrics is None:
        return evaluate_run(archive, options)
    if missing := METRIC_KEYS - metrics.keys():
        raise RunFolderError(
            f"{archive.path(METRICS)} lacks {', '.join(sorted(missing))}; write it again with `lapgs eval`"
        )
    if not metrics["views"]:
        raise RunFolderError(
            f"{archive.path(METRICS)} has no views, expected one at least; write it again with `lapgs eval`"
        )
    return metrics


def require_complete(archive: RunArchive) -> None:
    """Refuse a run with unfinished levels.

    Raises:
        RunFolderError: a level is not finished.
    """
    manifest = archive.manifest
    if not manifest.complete:
        raise RunFolderError(
            f"{archive.path()}: only {len(manifest.records)} of {manifest.levels} levels are trained; finish the run "
            "with its own command and --resume, or look at what is there with `lapgs render`"
        )


def run_figures(manifest: Manifest, split: str, views: Sequence[ViewMetrics], rasterizer: str) -> dict[str, Any]:
    """Return the figures of a complete run as JSON, except those that `evaluate_run` adds.

    Keys, with levels as text as JSON requires:
        psnr, ssim, lpips_<variant>: means over the views, at full resolution.
        fitted_psnr: mean PSNR after a colour fit, see `color_fitted_psnr`; absent in older files.
        lpips_missing: by variant, why it could not be measured; added by `evaluate_run`.
        fps: frames a second of the composed image, the median over some views; added by `evaluate_run`.
        exposure_compensated: whether the run learned colour transforms of its photos, so that its renders have
            their mean exposure; added by `evaluate_run`, absent in older files.
        exposure_predicted: whether they were measured with the exposure that neighbouring photos predict, see
            `predicted_exposures`; added by `evaluate_run`, absent in older files.
        masked: whether pixels outside of masks were left out; added by `evaluate_run`, absent in older files.
        split, num_views: the measured views, "test", "train" or "other" (of a scene that was not trained on), and their
            number.
        train_seconds and other figures of training: see `training_figures`.
        levels: by level, psnr and upsampled_psnr (see `ViewMetrics`), iterations, image_size, train_seconds,
            num_gaussians, mean_gaussians, peak_gaussians, breakdown_seconds, gpu_busy_seconds, memory_bytes.
        views: name, psnr, ssim and lpips_<variant> of each view, in the scene's order.
        rasterizer, versions: the rasterizer and the versions of packages that rendered the views.
    """
    records = manifest.records
    return {
        "psnr": fmean(view.psnr for view in views),
        "fitted_psnr": fmean(view.fitted_psnr for view in views),
        "ssim": fmean(view.ssim for view in views),
        **{LPIPS_KEY.format(name): fmean(view.lpips[name] for view in views) for name in views[0].lpips},
        "split": split,
        "num_views": len(views),
        **training_figures(records),
        "levels": {str(record.level): _level_figures(record, views) for record in records},
        "views": [_view_figures(view) for view in views],
        "rasterizer": rasterizer,
        "versions": versions(),
    }


def _level_figures(record: LevelRecord, views: Sequence[ViewMetrics]) -> dict[str, Any]:
    return {
        "psnr": fmean(view.level_psnr[record.level] for view in views),
        "upsampled_psnr": fmean(view.upsampled_psnr[record.level] for view in views),
        "iterations": record.iterations,
        "image_size": list(record.image_size),
        "train_seconds": record.train_seconds,
        "num_gaussians": record.num_gaussians,
        "mean_gaussians": record.mean_gaussians,
        "peak_gaussians": record.peak_gaussians,
        "breakdown_seconds": record.breakdown_seconds,
        "gpu_busy_seconds": record.gpu_busy_seconds,
        "memory_bytes": record.memory_bytes,
    }


def _view_figures(view: ViewMetrics) -> dict[str, Any]:
    distances = {LPIPS_KEY.format(name): value for name, value in view.lpips.items()}
    return {"name": view.name, "psnr": view.psnr, "fitted_psnr": view.fitted_psnr, "ssim": view.ssim, **distances}
