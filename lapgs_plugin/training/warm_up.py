"""Compile and load every kernel before the clock of training starts."""

from __future__ import annotations

from dataclasses import replace

import torch

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.hierarchy.inheritance import field_from_points
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops import densification_statistics, position_noise, regularization
from lapgs_plugin.ops.adam import StepScale
from lapgs_plugin.ops.mixed_sizes import if_mixed
from lapgs_plugin.ops.photometric_loss import photometric_loss
from lapgs_plugin.ops.upsample import upsample_add
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.prepared_run import PreparedRun


def _pairs(camera: Camera, mixes: bool) -> list[list[Camera]]:
    """Return cameras to render together: of one size, and of two if launches of the run mix sizes."""
    return [[camera] * 2, *([[camera, replace(camera, height=15)]] if mixes else [])]


def warm_up(run: PreparedRun) -> None:
    """Run every kernel of an iteration once, so that compilation is not measured as training."""
    settings, rasterizer, device = run.settings, run.rasterizer, run.device
    residuals = any(stage.signed for stage in run.plan)
    joint = any(settings.joint_from(stage) is not None for stage in run.plan)
    blue = torch.tensor([[0.0, 0.0, 1.0]])
    first = field_from_points(blue * run.archive.manifest.scene.unit, blue, settings.sh_degree).to(device)
    model = TrainableField.create(first, settings.rates, extent=1.0, sparse=settings.sparse_adam)
    camera, black = Camera(16, 16, 16.0, 16.0, 8.0, 8.0, torch.eye(4)), torch.zeros(3, device=device)
    result = rasterizer(model.field, camera, background=black)
    # Kernels of the loss are compiled for the types that targets and predictions are stored in.
    on_gpu = device.type == "cuda"
    target_types = (torch.uint8, torch.float16) if on_gpu else (result.image.dtype,)
    coarse = torch.zeros(3, 8, 8, device=device)
    rendered = [result.image, rasterizer.render_image(model.field, camera, background=black)]
    if residuals:
        rendered.append(upsample_add(Pyramid(), coarse.to(target_types[-1]), rendered[1]))
    if joint:
        below = torch.zeros(8, 8, 3, device=device, requires_grad=True).permute(2, 0, 1)  # interleaved as renders are
        rendered.append(upsample_add(Pyramid(), below, rendered[1]))
    targets = [torch.zeros(3, 16, 16, dtype=dtype, device=device) for dtype in target_types]
    losses = [photometric_loss(image, target) for image in rendered for target in targets]
    torch.stack(losses).sum().backward()  # type: ignore[no-untyped-call]  # torch's
    model.step(means_rate=0.0, active_coefficients=1)
    groups = run.size_groups(level=0)
    mixes = len(groups) > len(set(groups.values()))
    for pair in _pairs(camera, mixes) if rasterizer.can_batch else ():
        sizes = if_mixed([one.size for one in pair])
        for with_geometry in (True, False):  # rasterizers may take other kernels for images alone
            images = rasterizer.render_batch(model.field, pair, background=black, with_geometry=with_geometry).image
            none = torch.zeros(images.shape, dtype=target_types[0], device=device)
            photometric_loss(images, none, sizes=sizes).backward()  # type: ignore[no-untyped-call]  # torch's
            model.step(0.0, 1, scale=StepScale.of(2))
    if on_gpu:
        for operation in (densification_statistics, position_noise, regularization):
            operation.triton_works()
