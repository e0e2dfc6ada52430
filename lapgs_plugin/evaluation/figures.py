"""Measure a finished run: the figures that `lapgs eval` writes into metrics.json.

Its keys, with levels as text as JSON requires:
    psnr, ssim, lpips_<variant>: means over the views, at full resolution; PSNR in dB.
    fitted_psnr: mean PSNR after a colour fit, see `color_fitted_psnr`.
    lpips_missing: by variant, why it could not be measured.
    fps: frames a second of the composed image, the median over some views.
    split, num_views: the measured views, "test", "train" or "other" (of a scene that was not trained on), and their
        number.
    masked: whether pixels outside of masks were left out.
    exposure_compensated: whether the run learned colour transforms of its photos, so that its renders have their mean
        exposure.
    exposure_predicted: whether held-out views were measured with the exposure that neighbouring photos predict, see
        `predicted_exposures`. Training views are measured with their own.
    train_seconds and other figures of training: see `training_figures`.
    levels: by level, the figures of `OF_LEVELS` and two means over the views: psnr of I_hat^l against level l of the
        photo's Gaussian pyramid, both at the level's size; and upsampled_psnr of I_hat^l upsampled to full resolution
        against the photo, which is the quality without the finer levels. view_psnr has the latter of each view.
    views: name, psnr, fitted_psnr, ssim and lpips_<variant> of each view, in the scene's order.
    rasterizer, versions: the rasterizer and the versions of packages that rendered the views.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from lapgs_plugin.environment import versions
from lapgs_plugin.errors import RunFolderError, counted
from lapgs_plugin.evaluation.lpips import LPIPS_KEY, LpipsMetrics, LpipsRequest, lpips_metrics
from lapgs_plugin.evaluation.metrics import color_fitted_psnr, means, psnr, ssim
from lapgs_plugin.hierarchy.masks import fill_outside, masked_gaussian
from lapgs_plugin.jit.threads import one_pool
from lapgs_plugin.ops.color_transform import transform_colors
from lapgs_plugin.ops.composition import Composition, to_full_size
from lapgs_plugin.ops.vignetting import vignette
from lapgs_plugin.progress import item_progress
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.options import WHERE_TRAINED, RenderOptions
from lapgs_plugin.rendering.run import is_other_scene, run_renderer, run_scene
from lapgs_plugin.rendering.speed import composed_speed
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import METRICS
from lapgs_plugin.runs.neighbours import predicted_exposures
from lapgs_plugin.runs.results import MEASURED
from lapgs_plugin.runs.training_figures import VIEW_PSNR, training_figures
from lapgs_plugin.scenes.scene import View, with_pixels

METRIC_KEYS = {
    *("psnr", "fitted_psnr", "ssim", "lpips_missing", "fps", "split", "num_views", "views", "levels"),
    *("masked", "exposure_compensated", "exposure_predicted"),
    *("train_seconds", "overhead_seconds", "breakdown_seconds"),
    *("num_gaussians", "weighted_gaussians"),
    *("mean_gaussians", "peak_gaussians", "peak_memory_bytes", "peak_memory_without_images_bytes"),
    *("rasterizer", "versions"),
}
"""Keys that every file has."""

OF_LEVELS = (
    *("iterations", "image_size", "train_seconds", "num_gaussians", "mean_gaussians", "peak_gaussians"),
    "start_gaussians",
    *("breakdown_seconds", "gpu_busy_seconds", "memory_bytes"),
)
"""Figures of a level that are those of its record."""

FPS_VIEWS = 16
"""Most views over which frames a second are measured."""
FPS_ROUNDS = 3
"""Repetitions of each of these views."""


def evaluate_run(
    archive: RunArchive, options: RenderOptions = WHERE_TRAINED, lpips: LpipsRequest | None = None
) -> dict[str, Any]:
    """Measure a complete run on its held-out views, or on its training views when none were held out.

    All views are measured of a scene that the run was not trained on. Show a progress bar; write the result to the
    run's metrics.json and return it. Without a request the LPIPS distances are those of VGG. Distances without weights
    are left out, and "lpips_missing" says so.

    Raises:
        RunFolderError: the run is not complete, or its scene is missing.
        UserInputError: a file of LPIPS weights cannot be used.
    """
    require_complete(archive)
    renderer = run_renderer(archive, options.device, options.rasterizer)
    with one_pool():
        scene = run_scene(archive, options.scene)
        split, photos = ("test", scene.test) if scene.test else ("train", scene.train)
        if is_other_scene(archive, options.scene):
            split, photos = "other", tuple(sorted((*scene.train, *scene.test), key=lambda view: view.name))
        smallest = min(min(view.camera.size) for view in photos)
        distances = lpips_metrics(lpips or LpipsRequest(), smallest, renderer.device)
        names = [view.name for view in photos]
        looks = measured_looks(archive, split, names)
        with item_progress("views") as progress:
            measured = [
                _measure_view(view, renderer.render(view.camera), renderer, distances, looks[view.name])
                for view in progress.track(
                    with_pixels(photos), total=len(photos), description=f"Measuring {MEASURED[split]} views"
                )
            ]
        speed = composed_speed(renderer, [view.camera for view in photos[:FPS_VIEWS]], FPS_ROUNDS)
    views, records = [figures for figures, _ in measured], archive.manifest.records
    metrics = {
        **means([{key: value for key, value in view.items() if key != "name"} for view in views]),
        "split": split,
        "num_views": len(views),
        **training_figures(records),
        "levels": {
            str(record.level): {
                **means([levels[record.level] for _, levels in measured]),
                VIEW_PSNR: [levels[record.level]["upsampled_psnr"] for _, levels in measured],
                **{key: getattr(record, key) for key in OF_LEVELS},
            }
            for record in records
        },
        "views": views,
        "rasterizer": renderer.rasterizer.name,
        "versions": versions(),
        "lpips_missing": dict(distances.missing),
        "fps": speed.fps,
        "masked": any(view.masked for view in photos),
        "exposure_compensated": archive.exposure(archive.available_levels[-1]) is not None,
        "exposure_predicted": split == "test" and any(look.exposure is not None for look in looks.values()),
    }
    archive.write_metrics(metrics)
    return metrics


def _measure_view(
    view: View, composition: Composition, renderer: HierarchyRenderer, lpips: LpipsMetrics, look: PhotoLook
) -> tuple[dict[str, Any], dict[int, dict[str, float]]]:
    """Compare a rendered view with its photo at every level, inside of its mask, on the renderer's device.

    The render first gets the photo's look.

    Returns:
        The view's entry of "views", and its figures for "levels" by level.
    """
    composed, targets = _photographed(composition, look), _targets(view, renderer)
    photo, mask = view.image.to(renderer.device), None if view.mask is None else view.mask.to(renderer.device)
    levels = {
        level: {
            "psnr": psnr(image, *targets[level]),
            "upsampled_psnr": psnr(to_full_size(image, view.camera.size, level, renderer.pyramid), photo, mask),
        }
        for level, image in composed.items()
    }
    whole = composed[0]
    distances = lpips.measure(fill_outside(whole, photo, mask), photo)
    figures = {
        "name": view.name,
        "psnr": levels[0]["psnr"],
        "fitted_psnr": color_fitted_psnr(whole, photo, mask),
        "ssim": ssim(whole, photo, mask),
        **{LPIPS_KEY.format(name): value for name, value in distances.items()},
    }
    return figures, levels


def level_psnrs(view: View, renderer: HierarchyRenderer, look: PhotoLook) -> dict[int, float]:
    """Return the PSNR in dB of a view's composed image at each level, against the photo at the level's size.

    The render first gets the photo's look.
    """
    composed, targets = _photographed(renderer.render(view.camera, renderer.finest), look), _targets(view, renderer)
    return {level: psnr(image, *targets[level]) for level, image in composed.items()}


@dataclass(frozen=True)
class PhotoLook:
    """Hold how a photo differs from a render of its view.

    Attributes:
        falloff: brightness of its corners in stops, see `measure_vignetting`.
        exposure: (3, 4) colour transform; None if it is not known.
    """

    falloff: float
    exposure: Tensor | None

    @property
    def remark(self) -> str:
        """What a caption adds for a render with this look; empty where it is as rendered."""
        known = ["exposure"] * (self.exposure is not None) + ["falloff of the corners"] * (self.falloff != 0.0)
        return f", with the photo's {' and '.join(known)} as measured" if known else ""

    def of(self, image: Tensor) -> Tensor:
        """Return a rendered image (3, h, w) as it is photographed."""
        image = vignette(image, [self.falloff])
        return image if self.exposure is None else transform_colors(image, self.exposure.to(image))


AS_RENDERED = PhotoLook(0.0, None)
"""The look of photos of which a run knows nothing."""


def photo_looks(archive: RunArchive, views: Iterable[str]) -> dict[str, PhotoLook]:
    """Return the looks that a run learned, or predicts, of views."""
    views, falloffs = list(views), archive.vignetting()
    learned = archive.exposure(archive.available_levels[-1])
    exposures = {} if learned is None else predicted_exposures(learned, views)
    return {name: PhotoLook(falloffs.get(name, 0.0), exposures.get(name)) for name in views}


def measured_looks(archive: RunArchive, split: str, views: Iterable[str]) -> dict[str, PhotoLook]:
    """Return the looks with which views of a split are measured, see "split" of the module's docstring."""
    if split == "other":  # what the run learned of a photo says nothing about one of the same name in another scene
        return dict.fromkeys(views, AS_RENDERED)
    return photo_looks(archive, views)


def _photographed(composition: Composition, look: PhotoLook) -> Mapping[int, Tensor]:
    """Return the composed images by level with a photo's look."""
    return {level: look.of(image) for level, image in composition.composed.items()}


def _targets(view: View, renderer: HierarchyRenderer) -> list[tuple[Tensor, Tensor | None]]:
    """Return the photo and its mask at each level, the finest first, on the renderer's device."""
    photo = view.image.to(renderer.device)
    if view.mask is None:
        return [(image, None) for image in renderer.pyramid.gaussian(photo, renderer.levels)]
    mask = view.mask.to(renderer.device)
    return [*masked_gaussian(renderer.pyramid, photo, mask, renderer.levels)]


def run_metrics(archive: RunArchive, options: RenderOptions | None) -> dict[str, Any]:
    """Return the run's metrics.json; if it does not exist, measure the run unless `options` is None.

    Raises:
        RunFolderError: see `evaluate_run`; another program wrote the file; or it does not exist and `options` is None.
    """
    require_complete(archive)
    metrics = archive.metrics()
    if metrics is None:
        if options is None:
            advice = f"measure the run with `lapgs eval {shlex.quote(str(archive.path()))}`"
            raise RunFolderError(f"{archive.path(METRICS)} does not exist; {advice}")
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
    if manifest.complete:
        return
    finish = "finish the run with its own command and --resume"
    if not manifest.records:
        raise RunFolderError(f"{archive.path()}: none of {counted(manifest.levels, 'level')} is trained; {finish}")
    raise RunFolderError(
        f"{archive.path()}: only {len(manifest.records)} of {manifest.levels} levels are trained; {finish}, or look at "
        "what is there with `lapgs render`"
    )
