"""Merge a run's levels into one ordinary field: fit a field to the images that the run composes."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import torch
from scipy.spatial import cKDTree

from lapgs_plugin.errors import TrainingStoppedError, UserInputError
from lapgs_plugin.evaluation.metrics import color_fitted_psnr, psnr
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.units import in_unit
from lapgs_plugin.hierarchy.settings import AUTO
from lapgs_plugin.jit.threads import one_pool
from lapgs_plugin.ops.vignetting import vignette
from lapgs_plugin.progress import item_progress
from lapgs_plugin.rasterizers.choice import PlacedRasterizer
from lapgs_plugin.registry import NONE
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.run import run_renderer, run_scene
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.manifest import Manifest
from lapgs_plugin.runs.run_files import Falloffs
from lapgs_plugin.scenes.scene import Scene, View
from lapgs_plugin.scenes.source import HOLD_OUT_EVERY
from lapgs_plugin.training.backend import choose_rasterizer, training_rasterizer
from lapgs_plugin.training.monitor import Monitor
from lapgs_plugin.training.prepared_run import PreparedRun
from lapgs_plugin.training.settings import Densification, LearningRates, TrainSettings
from lapgs_plugin.training.strategies import GRADIENTS
from lapgs_plugin.training.trainer import Trainer

ITERATIONS = 3000
FAINT = 0.3
"""Factor on the opacities of residuals in the first field: they refine the base, and do not cover it."""
MEANS_RATE = 4e-5
"""First learning rate of positions, a quarter of 3DGS's: they are nearly right."""


@dataclass(frozen=True)
class Merged:
    """The field that approximates a run.

    Attributes:
        field: an ordinary field.
        kept: PSNR in dB of its images against the run's, mean over views that it was not fitted to.
        views: number of these views.
        photo_psnr: PSNR in dB of the run and of the field against the held-out photos, inside of masks; None without
            held-out views.
        colors_fitted: whether these two were measured after a colour fit, as `lapgs eval` prints them, because the run
            compensates exposure.
    """

    field: GaussianField
    kept: float
    views: int
    photo_psnr: tuple[float, float] | None
    colors_fitted: bool


def merge_levels(
    archive: RunArchive, moved_to: Path | None = None, *, iterations: int = ITERATIONS, monitor: Monitor | None = None
) -> Merged:
    """Fit an ordinary field to a run's composed images of its training views.

    Args:
        archive: a complete run with residuals.
        moved_to: the scene's folder now; None if it did not move.
        iterations: number of views to fit.
        monitor: shows progress.

    Raises:
        UserInputError: the run has no residuals, and needs no merging, or its base has no Gaussians.
        RunFolderError, SceneError: a field or the scene cannot be read.
        TrainingStoppedError: the user asked to stop.
    """
    manifest = archive.manifest
    fields = {level: archive.field(level) for level in range(manifest.levels - 1, -1, -1)}
    if not fields[0].signed:
        raise UserInputError(
            f"{archive.path()}: level 0 is an ordinary field already, which needs no --merge; leave it out"
        )
    if len(fields[max(fields)]) == 0:
        raise UserInputError(
            f"{archive.path()}: level {max(fields)} has no Gaussians, expected some for --merge to start from; train "
            "the run again"
        )
    with one_pool(), tempfile.TemporaryDirectory(prefix="lapgs-merge-") as scratch:
        renderer, scene = run_renderer(archive), run_scene(archive, moved_to)
        teacher = _composed(renderer, scene)
        start = first_field(fields)
        name = choose_rasterizer(AUTO)
        settings = _settings(manifest, start.sh_degree, iterations)
        reference = replace(manifest.scene, eval=True, distorted=False)  # other programs render pinholes
        placed = training_rasterizer(name, settings)
        empty = Manifest(reference, rasterizer=placed.rasterizer.name, **settings.for_manifest())
        with RunArchive.create(Path(scratch) / "run", empty) as fitted:
            run = PreparedRun.of(teacher, settings, fitted, placed, first_field=start)
            try:
                Trainer(run, monitor=monitor or Monitor()).run()
            except TrainingStoppedError:  # its message offers a checkpoint, which goes with the temporary folder
                raise TrainingStoppedError(
                    f"the fit to {archive.path()} was stopped and nothing is written; repeat the command to start it "
                    "again, with fewer --iterations if it takes too long"
                ) from None
            field = fitted.field(0)
        colors_fitted = archive.exposure(archive.available_levels[-1]) is not None
        placed = replace(placed, rasterizer=in_unit(placed.rasterizer, manifest.scene.unit))
        return _measured(field, teacher, scene, placed, colors_fitted, archive.vignetting())


def first_field(fields: dict[int, GaussianField]) -> GaussianField:
    """Return base and residuals as one ordinary field to start from.

    Residuals keep their geometry, get a lower opacity, and add their colour to that of the nearest Gaussian of the
    base.
    """
    base = fields[max(fields)]
    count = max(field.sh.shape[1] for field in fields.values())
    tree = cKDTree(base.means.numpy())
    parts = [replace(base, sh=_padded(base.sh, count))]
    for level in range(max(fields) - 1, -1, -1):
        residual = fields[level]
        nearest = torch.from_numpy(tree.query(residual.means.numpy())[1])
        faint = torch.logit((FAINT * torch.sigmoid(residual.opacity_logits)).clamp(1e-4, 1 - 1e-4))
        sh = _padded(residual.sh, count) + _padded(base.sh[nearest], count)
        parts.append(replace(residual, opacity_logits=faint, sh=sh, signed=False))
    return parts[0].with_parameters(
        {name: torch.cat([part.parameters[name] for part in parts]) for name in parts[0].parameters}
    )


def _padded(sh: torch.Tensor, count: int) -> torch.Tensor:
    """Return coefficients (n, k, 3) with zeros up to (n, count, 3)."""
    return torch.cat([sh, sh.new_zeros(len(sh), count - sh.shape[1], 3)], dim=1)


def _settings(manifest: Manifest, sh_degree: int, iterations: int) -> TrainSettings:
    """Return the settings of the fit: without antialiasing, of which most viewers and a PLY file know nothing."""
    return TrainSettings(
        iterations=iterations,
        levels=1,
        sh_degree=sh_degree,
        sh_every=1,
        sh_rate_factor=1.0,
        appearance=NONE,  # what the run learned of its photos' exposure is part of its images
        seed=manifest.seed,
        learning_rates=LearningRates(means_first=MEANS_RATE),
        densification=Densification(until=0, reset_every=0, strategy=GRADIENTS),  # the field stays as it is
    )


def _composed(renderer: HierarchyRenderer, scene: Scene) -> Scene:
    """Return the scene with the run's images of pinholes; some training views are held out if none were."""
    train, test = list(scene.train), list(scene.test)
    if not test:
        test = train[::HOLD_OUT_EVERY]
        train = [view for index, view in enumerate(train) if index % HOLD_OUT_EVERY] or train

    def rendered(views: Sequence[View], title: str) -> tuple[View, ...]:
        with item_progress("views") as bar, torch.no_grad():
            return tuple(
                View(view.name, camera := view.camera.straight(), renderer.images([camera], 0)[0].clamp(0, 1).cpu())
                for view in bar.track(views, description=title)
            )

    return replace(scene, train=rendered(train, "Rendering views"), test=rendered(test, "Held-out views"))


@torch.no_grad()
def _measured(
    field: GaussianField, teacher: Scene, scene: Scene, placed: PlacedRasterizer, colors_fitted: bool,
    falloffs: Falloffs,
) -> Merged:  # fmt: skip
    on_device = field.to(placed.device)
    photos = {view.name: view for view in scene.test if view.camera.lens is None}  # of others there are no pinholes
    background = torch.tensor(scene.background, device=placed.device)
    to_photo = color_fitted_psnr if colors_fitted else psnr
    kept, against_photos = [], []
    for view in teacher.test:
        image = placed.rasterizer.render_image(on_device, view.camera, background=background).cpu()
        kept.append(psnr(image, view.image))
        if (photo := photos.get(view.name)) is not None:
            both = (vignette(shown, [falloffs.get(view.name, 0.0)]) for shown in (view.image, image))
            run_and_field = (to_photo(shown, photo.image, photo.mask) for shown in both)
            against_photos.append(tuple(run_and_field))
    means = tuple(map(fmean, zip(*against_photos, strict=True)))
    return Merged(field, fmean(kept), len(kept), (means[0], means[1]) if means else None, colors_fitted)
