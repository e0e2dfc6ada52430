"""graphdeco's Gaussians, with the exposure of each photo."""

import contextlib

import numpy as np
import torch
from simple_knn._C import distCUDA2
from torch import nn
from utils.gaussian_base import GaussianBase
from utils.general_utils import get_expon_lr_func
from utils.graphics_utils import BasicPointCloud
from utils.sh_utils import RGB2SH

with contextlib.suppress(ImportError):
    from diff_gaussian_rasterization import SparseGaussianAdam


class GaussianModel(GaussianBase):
    @property
    def get_exposure(self):
        return self._exposure

    def get_exposure_from_name(self, image_name):
        if self.pretrained_exposures is None:
            return self._exposure[self.exposure_mapping[image_name]]
        return self.pretrained_exposures[image_name]

    def create_from_pcd(self, pcd: BasicPointCloud, cam_infos: int, spatial_lr_scale: float):
        self.spatial_lr_scale = spatial_lr_scale
        points, colors = (torch.tensor(np.asarray(values)).float().cuda() for values in (pcd.points, pcd.colors))
        print("Number of points at initialisation : ", len(points))
        self._start(points, RGB2SH(colors), torch.clamp_min(distCUDA2(points), 0.0000001))
        self.exposure_mapping = {info.image_name: index for index, info in enumerate(cam_infos)}
        self.pretrained_exposures = None
        exposure = torch.eye(3, 4, device="cuda")[None].repeat(len(cam_infos), 1, 1)
        self._exposure = nn.Parameter(exposure.requires_grad_(True))

    def training_setup(self, training_args):
        self.percent_dense = training_args.percent_dense
        self._forget_statistics()
        rates = {
            "xyz": training_args.position_lr_init * self.spatial_lr_scale,
            "f_dc": training_args.feature_lr,
            "f_rest": training_args.feature_lr / 20.0,
            "opacity": training_args.opacity_lr,
            "scaling": training_args.scaling_lr,
            "rotation": training_args.rotation_lr,
        }
        kind = SparseGaussianAdam if self.optimizer_type == "sparse_adam" else torch.optim.Adam
        self.optimizer = kind(self._groups(rates), lr=0.0, eps=1e-15)
        self.exposure_optimizer = torch.optim.Adam([self._exposure])
        self._schedule_positions(training_args)
        self.exposure_scheduler_args = get_expon_lr_func(
            training_args.exposure_lr_init,
            training_args.exposure_lr_final,
            lr_delay_steps=training_args.exposure_lr_delay_steps,
            lr_delay_mult=training_args.exposure_lr_delay_mult,
            max_steps=training_args.iterations,
        )

    def update_learning_rate(self, iteration):
        if self.pretrained_exposures is None:
            for group in self.exposure_optimizer.param_groups:
                group["lr"] = self.exposure_scheduler_args(iteration)
        for group in self.optimizer.param_groups:
            if group["name"] == "xyz":
                group["lr"] = self.xyz_scheduler_args(iteration)
                return group["lr"]
        return None

    def densify_and_split(self, grads, grad_threshold, scene_extent, N=2):
        large = self.get_scaling.max(dim=1).values[: len(grads)] > self.percent_dense * scene_extent
        self._split(large & (grads[:, 0] >= grad_threshold), N)

    def densify_and_clone(self, grads, grad_threshold, scene_extent):
        large = self.get_scaling.max(dim=1).values > self.percent_dense * scene_extent
        self._clone(~large & (grads[:, 0] >= grad_threshold))

    def densify_and_prune(self, max_grad, min_opacity, extent, max_screen_size, radii):
        grads = (self.xyz_gradient_accum / self.denom).nan_to_num(0.0)
        self.tmp_radii = radii
        self.densify_and_clone(grads, max_grad, extent)
        self.densify_and_split(grads, max_grad, extent)
        self.prune_points(self._useless(min_opacity, extent, max_screen_size))
        self.tmp_radii = None
        torch.cuda.empty_cache()
