"""Train splats as gsplat's simple_trainer does: its classes, names and order of calls, in a fraction of its text."""

import json
import math
import time
from dataclasses import dataclass, field
from pathlib import Path

import torch
import torch.nn.functional as F
import tqdm
from datasets.colmap import Dataset, Parser
from fused_ssim import fused_ssim
from gsplat.distributed import cli
from gsplat.rendering import rasterization
from gsplat.strategy import DefaultStrategy, MCMCStrategy
from options import overridable


@dataclass
class Config:
    disable_viewer: bool = False
    ckpt: str = None
    data_dir: str = "data/garden"
    data_factor: int = 1
    result_dir: str = "results/garden"
    test_every: int = 8
    patch_size: int = None
    normalize_world_space: bool = True
    camera_model: str = "pinhole"
    batch_size: int = 1
    max_steps: int = 90
    eval_steps: list = field(default_factory=lambda: [90])
    save_steps: list = field(default_factory=lambda: [90])
    sh_degree: int = 2
    sh_degree_interval: int = 20
    init_opa: float = 0.1
    ssim_lambda: float = 0.2
    near_plane: float = 0.01
    far_plane: float = 1e10
    strategy: DefaultStrategy | MCMCStrategy = field(default_factory=DefaultStrategy)
    packed: bool = False
    antialiased: bool = False
    random_bkgd: bool = False
    sh0_lr: float = 2.5e-3
    shN_lr: float = 2.5e-3 / 20
    opacity_reg: float = 0.0
    pose_opt: bool = False
    app_opt: bool = False
    depth_loss: bool = False


def create_splats_with_optimizers(parser, config, scene_scale, device):
    points = torch.from_numpy(parser.points).float()
    rgbs = torch.from_numpy(parser.points_rgb / 255.0).float()
    nearest = torch.cdist(points, points).topk(4, largest=False).values[:, 1:]
    n, terms = len(points), (config.sh_degree + 1) ** 2
    params = {
        "means": (points, 1.6e-4 * scene_scale),
        "scales": (nearest.mean(-1).log()[:, None].repeat(1, 3), 5e-3),
        "quats": (torch.rand(n, 4), 1e-3),
        "opacities": (torch.logit(torch.full((n,), config.init_opa)), 5e-2),
    }
    if config.app_opt:
        params["features"] = torch.rand(n, 4), config.sh0_lr
        params["colors"] = torch.logit(rgbs.clamp(0.01, 0.99)), config.sh0_lr
    else:
        params["sh0"] = ((rgbs - 0.5) / 0.28209479177387814)[:, None], config.sh0_lr
        params["shN"] = torch.zeros(n, terms - 1, 3), config.shN_lr
    splats = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, (value, _) in params.items()}).to(device)
    optimizers = {
        name: torch.optim.Adam([{"params": splats[name], "lr": rate, "name": name}], eps=1e-15)
        for name, (_, rate) in params.items()
    }
    return splats, optimizers


class AppearanceModule(torch.nn.Module):
    def __init__(self, count):
        super().__init__()
        self.embeds, self.head = torch.nn.Embedding(count, 4), torch.nn.Linear(11, 3)

    def forward(self, features, embed_ids, dirs, sh_degree):
        n = len(features)
        embeds = torch.zeros(1, 4) if embed_ids is None else self.embeds(embed_ids)
        parts = features, embeds.expand(n, -1), F.normalize(dirs[0], dim=-1)
        return self.head(torch.cat(parts, -1))[None]


class PoseModule(torch.nn.Module):
    def __init__(self, count):
        super().__init__()
        self.embeds = torch.nn.Embedding(count, 3)
        torch.nn.init.zeros_(self.embeds.weight)

    def forward(self, camtoworlds, embed_ids):
        return camtoworlds + F.pad(self.embeds(embed_ids)[:, :, None], (3, 0, 0, 1))


class Runner:
    """Engine for training and testing."""

    def __init__(self, local_rank, world_rank, world_size, cfg):
        torch.manual_seed(42 + local_rank)
        self.cfg, self.world_size, self.device = cfg, world_size, f"cuda:{local_rank}"
        self.ckpt_dir, self.stats_dir = f"{cfg.result_dir}/ckpts", f"{cfg.result_dir}/stats"
        for folder in (self.ckpt_dir, self.stats_dir):
            Path(folder).mkdir(parents=True, exist_ok=True)
        self.parser = Parser(
            data_dir=cfg.data_dir,
            factor=cfg.data_factor,
            normalize=cfg.normalize_world_space,
            test_every=cfg.test_every,
        )
        self.trainset = Dataset(self.parser, "train", cfg.patch_size, cfg.depth_loss)
        self.valset = Dataset(self.parser, "val")
        self.scene_scale = self.parser.scene_scale * 1.1
        self.splats, self.optimizers = create_splats_with_optimizers(self.parser, cfg, self.scene_scale, self.device)
        # As the stage of gsplat 1.6.0: it keeps the method and passes the splats.
        self.stage = {"scene": self.rasterize_splats}
        print("Model initialized. Number of GS:", len(self.splats["means"]))
        cfg.strategy.check_sanity(self.splats, self.optimizers)
        known = {"scene_scale": self.scene_scale} if isinstance(cfg.strategy, DefaultStrategy) else {}
        self.strategy_state = cfg.strategy.initialize_state(**known)
        self.other_optimizers = []
        if cfg.pose_opt:
            self.pose_adjust = PoseModule(len(self.trainset)).to(self.device)
            self.other_optimizers.append(torch.optim.Adam(self.pose_adjust.parameters(), lr=1e-3))
        if cfg.app_opt:
            self.app_module = AppearanceModule(len(self.trainset)).to(self.device)
            self.other_optimizers.append(torch.optim.Adam(self.app_module.parameters(), lr=1e-3))
        if not cfg.disable_viewer:
            self.viewer = Viewer(self._viewer_render_fn)

    def rasterize_splats(self, camtoworlds, Ks, width, height, masks=None, splats=None, **kwargs):
        splats = self.splats if splats is None else splats
        image_ids = kwargs.pop("image_ids", None)
        if self.cfg.app_opt:
            colors = self.app_module(
                features=splats["features"],
                embed_ids=image_ids,
                dirs=splats["means"][None] - camtoworlds[:, None, :3, 3],
                sh_degree=kwargs.pop("sh_degree", self.cfg.sh_degree),
            )
            colors = torch.sigmoid(colors + splats["colors"])
        else:
            colors = torch.cat([splats["sh0"], splats["shN"]], 1)
        render_colors, render_alphas, info = rasterization(
            means=splats["means"],
            quats=splats["quats"],
            scales=torch.exp(splats["scales"]),
            opacities=torch.sigmoid(splats["opacities"]),
            colors=colors,
            viewmats=torch.linalg.inv(camtoworlds),
            Ks=Ks,
            width=width,
            height=height,
            packed=self.cfg.packed,
            absgrad=getattr(self.cfg.strategy, "absgrad", False),
            rasterize_mode="antialiased" if self.cfg.antialiased else "classic",
            distributed=self.world_size > 1,
            camera_model=self.cfg.camera_model,
            **kwargs,
        )
        if masks is not None:
            render_colors[~masks] = 0
        return render_colors, render_alphas, info

    def train(self):
        cfg, device, max_steps = self.cfg, self.device, self.cfg.max_steps
        Path(cfg.result_dir, "cfg.json").write_text(json.dumps({name: str(value) for name, value in vars(cfg).items()}))
        schedulers = [torch.optim.lr_scheduler.ExponentialLR(self.optimizers["means"], gamma=0.01 ** (1.0 / max_steps))]
        trainloader = torch.utils.data.DataLoader(
            self.trainset,
            batch_size=cfg.batch_size,
            shuffle=True,
            num_workers=4,
            persistent_workers=True,
            pin_memory=True,
        )
        trainloader_iter = iter(trainloader)
        global_tic = time.time()
        for step in tqdm.tqdm(range(max_steps)):
            if not cfg.disable_viewer:
                self.viewer.update(step)
            try:
                data = next(trainloader_iter)
            except StopIteration:
                trainloader_iter = iter(trainloader)
                data = next(trainloader_iter)
            camtoworlds = data["camtoworld"].to(device)
            Ks = data["K"].to(device)
            pixels = data["image"].to(device) / 255.0
            image_ids = data["image_id"].to(device)
            masks = data["mask"].to(device) if "mask" in data else None
            height, width = pixels.shape[1:3]
            if cfg.pose_opt:
                camtoworlds = self.pose_adjust(camtoworlds, image_ids)
            sh_degree_to_use = min(step // cfg.sh_degree_interval, cfg.sh_degree)
            renders, alphas, info = self.stage["scene"](
                splats=self.splats,
                camtoworlds=camtoworlds,
                Ks=Ks,
                width=width,
                height=height,
                sh_degree=sh_degree_to_use,
                near_plane=cfg.near_plane,
                far_plane=cfg.far_plane,
                image_ids=image_ids,
                render_mode="RGB+ED" if cfg.depth_loss else "RGB",
                masks=masks,
            )
            colors = renders[..., :3]
            if cfg.random_bkgd:
                colors = colors + torch.rand(1, 3, device=device) * (1.0 - alphas)
            cfg.strategy.step_pre_backward(
                params=self.splats, optimizers=self.optimizers, state=self.strategy_state, step=step, info=info
            )
            l1loss = F.l1_loss(colors, pixels)
            ssimloss = 1.0 - fused_ssim(colors.permute(0, 3, 1, 2), pixels.permute(0, 3, 1, 2), padding="valid")
            loss = l1loss * (1.0 - cfg.ssim_lambda) + ssimloss * cfg.ssim_lambda
            if cfg.depth_loss:
                size = torch.tensor([width - 1, height - 1], device=device)
                grid = (data["points"].to(device) / size * 2 - 1).unsqueeze(2)
                depths = F.grid_sample(renders[..., 3:].permute(0, 3, 1, 2), grid, align_corners=True)[:, 0, :, 0]
                loss = loss + 1e-2 * F.l1_loss(1 / depths.clamp_min(1e-3), 1 / data["depths"].to(device))
            if cfg.opacity_reg > 0.0:
                loss = loss + cfg.opacity_reg * torch.sigmoid(self.splats["opacities"]).mean()
            loss.backward()
            if step in [i - 1 for i in cfg.save_steps] or step == max_steps - 1:
                self.save(step, time.time() - global_tic)
            for optimizer in [*self.optimizers.values(), *self.other_optimizers]:
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            for scheduler in schedulers:
                scheduler.step()
            own = {"lr": schedulers[0].get_last_lr()[0]} if isinstance(cfg.strategy, MCMCStrategy) else {}
            cfg.strategy.step_post_backward(
                params=self.splats, optimizers=self.optimizers, state=self.strategy_state, step=step, info=info, **own
            )
            if step in [i - 1 for i in cfg.eval_steps]:
                self.eval(step)

    def save(self, step, seconds):
        stats = {"ellipse_time": seconds, "num_GS": len(self.splats["means"])}
        Path(self.stats_dir, f"train_step{step:04d}_rank0.json").write_text(json.dumps(stats))
        torch.save({"step": step, "splats": self.splats.state_dict()}, f"{self.ckpt_dir}/ckpt_{step}_rank0.pt")

    @torch.no_grad()
    def eval(self, step, stage="val"):
        valloader = torch.utils.data.DataLoader(self.valset, batch_size=1, shuffle=False, num_workers=1)
        psnrs = []
        for data in valloader:
            pixels = data["image"].to(self.device) / 255.0
            colors = self.render(data["camtoworld"].to(self.device), data["K"].to(self.device), *pixels.shape[2:0:-1])
            psnrs.append(-10 * math.log10(F.mse_loss(colors.clamp(0, 1), pixels).item()))
        stats = {"psnr": sum(psnrs) / len(psnrs), "num_GS": len(self.splats["means"])}
        Path(self.stats_dir, f"{stage}_step{step:04d}.json").write_text(json.dumps(stats))

    def render(self, camtoworlds, Ks, width, height):
        return self.stage["scene"](
            splats=self.splats,
            camtoworlds=camtoworlds,
            Ks=Ks,
            width=width,
            height=height,
            sh_degree=self.cfg.sh_degree,
            near_plane=self.cfg.near_plane,
            far_plane=self.cfg.far_plane,
        )[0]

    @torch.no_grad()
    def _viewer_render_fn(self, camtoworld, K, width, height):
        return self.render(camtoworld[None], K[None], width, height)[0]


class Viewer:
    """Look from the first camera, at a size that is no level's, every thirty steps."""

    made = 0

    def __init__(self, render_fn):
        Viewer.made += 1
        self.render_fn, self.images = render_fn, []

    def update(self, step):
        if step % 30 == 0:
            K = torch.tensor([[40.0, 0, 25.5], [0, 40.0, 17.5], [0, 0, 1]])
            self.images.append(self.render_fn(torch.eye(4), K, 51, 35))


def main(local_rank, world_rank, world_size, cfg):
    runner = Runner(local_rank, world_rank, world_size, cfg)
    if cfg.ckpt is not None:
        runner.splats.load_state_dict(torch.load(cfg.ckpt)["splats"])
        runner.eval(step=0)
    else:
        runner.train()
    print("Finished with", len(runner.splats["means"]), "GS")


if __name__ == "__main__":
    own = {"refine_start_iter": 5, "refine_every": 10, "refine_stop_iter": 60}
    configs = {
        "default": Config(strategy=DefaultStrategy(**own)),
        "mcmc": Config(strategy=MCMCStrategy(cap_max=400, **own), init_opa=0.5, opacity_reg=0.01),
    }
    cli(main, overridable(configs), verbose=True)
