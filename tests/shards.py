"""Renders and runs of ranks with a share of the Gaussians each. As a program this is one of the ranks.

RANK=0 WORLD_SIZE=2 ... python -m tests.shards FOLDER render DEVICE | train NAME | resume NAME | stop NAME
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.errors import TrainingStoppedError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.rasterizers.gsplat.rasterizer import GsplatRasterizer
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.training.densification import add_gradients
from lapgs_plugin.training.monitor import Monitor
from lapgs_plugin.training.prepared_run import PreparedRun
from lapgs_plugin.training.ranks.archive import open_for
from lapgs_plugin.training.ranks.group import Ranks, joined
from lapgs_plugin.training.ranks.sharding import sharding_of
from lapgs_plugin.training.settings import Densification, TrainingControl, TrainSettings
from lapgs_plugin.training.strategies import Gradients, Mcmc
from lapgs_plugin.training.trainer import Trainer
from tests.training_runs import StopAt, placed, ring_manifest
from tests.training_scene import blob_field, ring_camera, ring_scene

STOPPED_AT = 160
"""Iteration at which "stop" stops."""
RENDERS = 3
"""Renders of each rank, each from another camera."""


def settings(strategy: Any, name: str, **values: Any) -> TrainSettings:
    until = values.pop("until", 300)
    density = Densification(strategy=name, options=strategy, start=20, until=until, every=40)
    defaults = {"iterations": 400, "sh_degree": 1, "levels": 1, "sh_every": 100, "accumulate_views": 4, "ranks": 2}
    return TrainSettings(densification=density, **{**defaults, **values})


CASES = {
    "fixed": settings(Gradients(), "3dgs", until=1),
    "3dgs": settings(Gradients(), "3dgs", appearance="affine"),
    "mcmc": settings(Mcmc(cap_max=200), "mcmc", dropout=0.2),
    "laplacian": settings(Mcmc(cap_max=200), "mcmc", levels=2, hierarchy="laplacian", joint=0.5),
    "nested": settings(Gradients(), "3dgs", levels=2, hierarchy="nested"),
}


def rendered_field(signed: bool) -> GaussianField:
    """A field of more colours than one in each direction, some of whose channels are clamped."""
    field, random = blob_field(), torch.Generator().manual_seed(1)
    sh = torch.cat([field.sh, 0.5 * torch.randn(len(field), 8, 3, generator=random)], 1)
    return replace(field, sh=sh, signed=signed)


def rendered_camera(number: int) -> Camera:
    """Cameras around the field and close to it, whose images differ in size; the last one looks away."""
    camera = ring_camera(number * 0.9, 56 + 8 * (number % 2), 40)
    pose = camera.world_to_camera.clone()
    if number == 2 * RENDERS - 1:
        pose[1:3] *= -1
    else:
        pose[2, 3] -= 2.5 * (number % 3)
    return replace(camera, world_to_camera=pose)


@dataclass(frozen=True)
class Rendered:
    """Hold renders of a field, their summed gradients, and statistics of density control."""

    images: list[Tensor]
    gradients: dict[str, Tensor]
    statistics: Mapping[str, Tensor]


def render(field: GaussianField, ranks: Ranks, device: str, *, shard: bool) -> Rendered:
    """Render the cameras of this rank, and of every rank that is not there to do it; results are on the CPU."""
    sharding = sharding_of(ranks, shard)
    rasterizer = sharding.rasterizer(CpuRasterizer() if device == "cpu" else GsplatRasterizer(own_radii=True))
    own = sharding.dealt(field).to(device).detach()
    for value in own.parameters.values():
        value.requires_grad_()
    state: dict[str, Any] = {"grad2d": None, "count": None}
    images, background = [], torch.full((3,), 0.0 if field.signed else 0.3, device=device)
    for number in range(ranks.rank, 2 * RENDERS, ranks.size):
        camera = rendered_camera(number)
        result = rasterizer(own, camera, background=background, sh_degree=2)
        weights = torch.rand(result.image.shape, generator=torch.Generator().manual_seed(number))
        (result.image * weights.to(device)).sum().backward()  # type: ignore[no-untyped-call]  # torch's
        assert result.means2d.grad is not None
        add_gradients(state, ("grad2d", "count"), result.means2d.grad, result, camera)
        images.append(result.image.detach().cpu())
    gradients = {name: value.grad.cpu() for name, value in own.parameters.items() if value.grad is not None}
    return Rendered(images, gradients, {name: value.cpu() for name, value in state.items()})


def train(path: Path, name: str, ranks: Ranks, *, shard: bool, monitor: Monitor | None = None) -> None:
    """Train a case into a new folder."""
    asked = CASES[name]
    with open_for(ranks, path, lambda kind: kind.create(path, ring_manifest(asked))) as archive:
        run(archive, asked, ranks, shard=shard, monitor=monitor)


def resume(path: Path, name: str, ranks: Ranks, *, shard: bool) -> None:
    """Train a stopped run to its end."""
    with open_for(ranks, path, lambda kind: kind.open(path, resume=True)) as archive:
        run(archive, CASES[name], ranks, shard=shard, resumes=True)


def run(
    archive: Any, asked: TrainSettings, ranks: Ranks, *, shard: bool, monitor: Monitor | None = None, **decided: Any
) -> None:
    scene, control = ring_scene(train=13, test=3), TrainingControl(checkpoint_every=80)
    prepared = PreparedRun.of(
        scene, asked, archive, placed(CpuRasterizer()), control, ranks=ranks, shard=shard, **decided
    )
    Trainer(prepared, monitor=Monitor() if monitor is None else monitor).run()


def main() -> None:
    """Be one of the ranks."""
    folder, words, ranks = Path(sys.argv[1]), sys.argv[2:], joined()
    if words[0] == "render":
        ranks.use(torch.device(words[1]))
        for signed in (False, True):
            rendered = render(rendered_field(signed), ranks, words[1], shard=True)
            torch.save(vars(rendered), folder / f"{signed}_{ranks.rank}.pt")
    elif words[0] == "resume":
        resume(folder, words[1], ranks, shard=True)
    else:
        at = STOPPED_AT if words[0] == "stop" else 0
        try:
            train(folder, words[1], ranks, shard=True, monitor=StopAt(0, at))
        except TrainingStoppedError:
            assert words[0] == "stop"
    ranks.close()


if __name__ == "__main__":
    main()
