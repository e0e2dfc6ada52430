"""A training loop on gsplat with a hierarchy: `gsplat_before.py` and two dozen lines.

    python examples/gsplat_after.py SCENE -o RUN --resolution 1/4 --iterations 3000

lapgs_plugin reads the scene and computes the loss; any loader and any L1 + SSIM would do. `lapgs eval RUN` works.
Without a CUDA device, `--rasterizer cpu` takes gsplat's two functions from a stand-in.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import gsplat
import torch
from torch import Tensor

import lapgs_plugin as lapgs
from lapgs_plugin.reference_raster import gsplat as gsplat_on_cpu
from lapgs_plugin.scenes import load_scene

SH_DEGREE = 3
RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 2.5e-3 / 20}


@dataclass(frozen=True)
class View:
    name: str
    viewmat: Tensor  # (4, 4) world to camera
    K: Tensor  # (3, 3) intrinsics
    image: Tensor  # (3, h, w)

    def to(self, device: torch.device) -> View:
        return View(self.name, self.viewmat.to(device), self.K.to(device), self.image.to(device))


class Runner:
    """Fit splats to a scene."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.device = torch.device("cpu" if args.rasterizer == "cpu" else "cuda")
        self.gsplat = gsplat_on_cpu if args.rasterizer == "cpu" else gsplat
        self.args = args
        self.scene = load_scene(args.scene, resolution=args.resolution, eval=True, progress=False)
        self.train_views, self.test_views = (
            [View(v.name, v.camera.world_to_camera, v.camera.intrinsics, v.image).to(self.device) for v in views]
            for views in (self.scene.train, self.scene.test)
        )
        self.pyramid, self.cache = lapgs.Pyramid(), lapgs.ImageStore("memory", "float32", device=self.device)
        scene = lapgs.SceneReference.of(self.scene, resolution=args.resolution)
        self.archive = lapgs.RunArchive.create(args.out, lapgs.Manifest.of_loop(scene, 2, args.rasterizer))
        self.set_splats(
            lapgs.splats_from_field(lapgs.field_from_points(self.scene.points, self.scene.colors, SH_DEGREE))
        )

    def set_splats(self, splats: dict[str, Tensor]) -> None:
        """Start with these parameters and fresh optimizers."""
        rates = {**RATES, "means": RATES["means"] * self.scene.extent}
        self.splats = {name: torch.nn.Parameter(value.detach().to(self.device)) for name, value in splats.items()}
        self.optimizers = {
            name: torch.optim.Adam([value], lr=rates[name], eps=1e-15, fused=self.device.type == "cuda")
            for name, value in self.splats.items()
        }

    def render(self, view: View, sh_degree: int = SH_DEGREE) -> tuple[Tensor, dict]:
        """Return the image (3, h, w) and gsplat's information about it."""
        colors = torch.cat([self.splats["sh0"], self.splats["shN"]], 1)
        directions = self.splats["means"] + view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
        colors = self.gsplat.spherical_harmonics(sh_degree, directions, colors)
        images, _, info = self.gsplat.rasterization(
            self.splats["means"],
            self.splats["quats"],
            self.splats["scales"].exp(),
            self.splats["opacities"].sigmoid(),
            colors if view.name in self.cache else (colors + 0.5).clamp_min(0),
            view.viewmat[None],
            view.K[None],
            view.image.shape[2],
            view.image.shape[1],
            packed=False,
        )
        image = images[0].permute(2, 0, 1)
        return image + self.cache.get(view.name) if view.name in self.cache else image, info

    def at_level(self, view: View, level: int) -> View:
        K = lapgs.level_intrinsics(view.K, (view.image.shape[2], view.image.shape[1]), level)
        return View(view.name, view.viewmat, K, self.pyramid.gaussian(view.image, level + 1)[level])

    @torch.no_grad()
    def finish(self, stage: lapgs.Stage) -> None:
        field = lapgs.field_from_splats(self.splats, stage.signed).detach()
        self.archive.finish_level(lapgs.LevelRecord.of(stage, field), field)
        if stage.level > 0:
            for view in [*self.train_views, *self.test_views]:
                size = lapgs.level_size(view.image.shape[1:], stage.level - 1)
                self.cache.put(view.name, self.pyramid.up(self.render(self.at_level(view, stage.level))[0], size))
            self.set_splats(lapgs.splats_from_field(lapgs.inherit(field).field))

    def train(self, views: list[View], iterations: int) -> list[float]:
        """Fit the splats to the views and return the loss of every iteration."""
        shrink = min(1.0, self.args.iterations / 30_000)
        strategy = gsplat.DefaultStrategy(
            refine_start_iter=round(500 * shrink),
            refine_stop_iter=iterations // 2,
            reset_every=max(300, round(3000 * shrink)),
        )
        state = strategy.initialize_state(scene_scale=self.scene.extent)
        decay = torch.optim.lr_scheduler.ExponentialLR(self.optimizers["means"], gamma=0.01 ** (1 / iterations))
        losses = []
        for iteration in range(iterations):
            view = views[int(torch.randint(len(views), ()))]
            degree = min(SH_DEGREE, iteration // max(1, round(1000 * shrink)))
            image, info = self.render(view, degree)
            loss = lapgs.photometric_loss(image, view.image)
            strategy.step_pre_backward(self.splats, self.optimizers, state, iteration, info)
            loss.backward()
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            decay.step()
            strategy.step_post_backward(self.splats, self.optimizers, state, iteration, info)
            losses.append(loss.detach())
        return torch.stack(losses).tolist()

    @torch.no_grad()
    def psnr(self) -> float:
        """Return the mean PSNR of the held-out views in dB."""
        errors = [(self.render(view)[0].clamp(0, 1) - view.image).square().mean() for view in self.test_views]
        return float((-10 * torch.stack(errors).log10()).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--resolution", default="full")
    parser.add_argument("--iterations", type=int, default=30_000)
    parser.add_argument("--rasterizer", choices=("gsplat", "cpu"), default="gsplat")
    args = parser.parse_args()
    torch.manual_seed(0)
    runner = Runner(args)
    for stage in lapgs.StagePlan.create(runner.scene.smallest_size, args.iterations, levels=2):
        views = [runner.at_level(view, stage.level) for view in runner.train_views]
        losses = runner.train(views, stage.iterations)
        runner.finish(stage)
    print(f"loss {losses[0]:.4f} to {losses[-1]:.4f}, {len(runner.splats['means'])} Gaussians")
    print(f"held-out PSNR {runner.psnr():.2f} dB")
    args.out.mkdir(parents=True, exist_ok=True)
    torch.save(runner.splats, args.out / "splats.pt")


if __name__ == "__main__":
    main()
