"""A training loop in plain PyTorch on the CPU rasterizer with a hierarchy: `vanilla_before.py` and a dozen lines.

    python examples/vanilla_after.py SCENE --resolution 1/2 --iterations 500

The shortest loop that trains, without densification and schedules. lapgs_plugin reads the scene, renders and computes
the loss.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import torch
from torch import Tensor

import lapgs_plugin as lapgs
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.scenes import View, load_scene

RATES = {"means": 2e-4, "quaternions": 1e-3, "log_scales": 5e-3, "opacity_logits": 5e-2, "sh": 2.5e-3}


PYRAMID, CACHE = lapgs.Pyramid(), lapgs.ImageStore("memory", "float32")


def train(field: lapgs.GaussianField, views: list[View], iterations: int) -> tuple[lapgs.GaussianField, list[float]]:
    """Return the fitted field and the loss of every iteration."""
    rasterizer, background, losses = CpuRasterizer(), torch.zeros(3), []
    field = field.with_parameters({k: torch.nn.Parameter(v.detach()) for k, v in field.parameters.items()})
    optimizer = torch.optim.Adam([{"params": [v], "lr": RATES[k]} for k, v in field.parameters.items()], eps=1e-15)
    for _ in range(iterations):
        view = views[int(torch.randint(len(views), ()))]
        image = rasterizer(field, view.camera, background=background).image
        image = image + CACHE.get(view.name) if field.signed else image
        loss = lapgs.photometric_loss(image, view.image)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        losses.append(loss.item())
    return field.detach(), losses


@torch.no_grad()
def predict(field: lapgs.GaussianField, view: View) -> Tensor:
    """Return the image (3, h, w)."""
    image = CpuRasterizer()(field, view.camera, background=torch.zeros(3)).image
    return image + CACHE.get(view.name) if field.signed else image


def at_level(view: View, level: int) -> View:
    image = PYRAMID.gaussian(view.image, level + 1)[level]
    return replace(view, camera=lapgs.level_camera(view.camera, level), image=image)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene")
    parser.add_argument("--resolution", default="full")
    parser.add_argument("--iterations", type=int, default=500)
    args = parser.parse_args()
    torch.manual_seed(0)
    scene = load_scene(args.scene, resolution=args.resolution, eval=True, progress=False)
    field = lapgs.field_from_points(scene.points, scene.colors, sh_degree=1)
    for stage in lapgs.StagePlan.create(scene.smallest_size, args.iterations, levels=2):
        views = [at_level(view, stage.level) for view in scene.train]
        field, losses = train(field, views, stage.iterations)
        for view in [*scene.train, *scene.test] if stage.level > 0 else []:
            size = lapgs.level_size((view.camera.height, view.camera.width), stage.level - 1)
            CACHE.put(view.name, PYRAMID.up(predict(field, at_level(view, stage.level)), size))
        field = lapgs.inherit(field).field if stage.level > 0 else field
    errors = [(predict(field, view).clamp(0, 1) - view.image).square().mean() for view in scene.test]
    print(f"loss {losses[0]:.4f} to {losses[-1]:.4f}, {len(field)} Gaussians")
    print(f"held-out PSNR {float((-10 * torch.stack(errors).log10()).mean()):.2f} dB")


if __name__ == "__main__":
    main()
