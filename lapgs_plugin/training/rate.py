"""Measure how many views a second a machine trains on, before a run begins."""

from __future__ import annotations

import time

import torch

from lapgs_plugin.fields.units import in_unit
from lapgs_plugin.hierarchy.inheritance import field_from_points
from lapgs_plugin.ops.photometric_loss import photometric_loss
from lapgs_plugin.rasterizers.choice import PlacedRasterizer
from lapgs_plugin.scenes.scene import Scene
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.planning import make_plan
from lapgs_plugin.training.settings import MOST_VIEWS, TrainSettings

SECONDS = 0.5
"""Duration of the measurement."""
LEAST_STEPS = 3
"""Fewest steps of the measurement, however long they take."""


def views_per_second(scene: Scene, settings: TrainSettings, placed: PlacedRasterizer) -> float:
    """Return the rate at which a field is rendered, compared with photos and stepped at full size.

    The field has the scene's points, each as often as it takes to reach half of the strategy's limit of Gaussians,
    about as many as a stage has on average, and more of them in one place. The first step, which compiles, is not
    measured.
    """
    rasterizer, device = in_unit(placed.rasterizer, scene.unit), placed.device
    stage = make_plan(scene.smallest_size, settings)[0]
    pixels = sum(view.camera.width * view.camera.height for view in scene.train)
    limit = settings.strategy_of(stage, pixels).most or 0
    points = field_from_points(scene.points, scene.colors, settings.sh_degree)
    rows = torch.arange(max(limit // 2, len(points))) % len(points)
    field = points.with_parameters({name: values[rows] for name, values in points.parameters.items()}).to(device)
    model = TrainableField.create(field, settings.rates, scene.extent, sparse=settings.sparse_adam)
    camera, background = scene.train[0].camera, torch.tensor(scene.background).to(device)
    views = min(MOST_VIEWS, len(scene.train)) if rasterizer.can_batch and not settings.refine_poses else 1
    target = torch.zeros(3, camera.height, camera.width, device=device).expand(views, -1, -1, -1)

    def step() -> None:
        if views == 1:
            image = rasterizer.render_image(model.field, camera, background=background)
            loss = photometric_loss(image, target[0])
        else:
            image = rasterizer.render_batch(model.field, [camera] * views, background=background).image
            loss = photometric_loss(image, target.contiguous())
        loss.backward()  # type: ignore[no-untyped-call]  # torch's
        model.step(means_rate=0.0, active_coefficients=1)
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    step()
    began, steps = time.perf_counter(), 0
    while steps < LEAST_STEPS or time.perf_counter() - began < SECONDS:
        step()
        steps += 1
    return steps * views / (time.perf_counter() - began)
