"""Taming-3DGS's Gaussians: grown to a budget by scores, their opacities without an upper limit towards the end."""

import contextlib

import numpy as np
import torch
from simple_knn._C import distCUDA2
from utils.gaussian_base import GaussianBase
from utils.general_utils import identity_gate
from utils.graphics_utils import BasicPointCloud
from utils.sh_utils import RGB2SH

with contextlib.suppress(ImportError):
    from diff_gaussian_rasterization import SparseGaussianAdam


class GaussianModel(GaussianBase):
    def __init__(self, sh_degree, optimizer_type="default", rendering_mode=None):
        self.render_mode = rendering_mode
        super().__init__(sh_degree, optimizer_type)
        self.shoptimizer = None

    def modify_functions(self):
        """Opacities become plain values; nothing optimizes them any more, as the optimizer keeps the old parameter."""
        old_opacities = self.get_opacity.clone()
        self.opacity_activation = torch.abs
        self.inverse_opacity_activation = identity_gate
        self._opacity = self.opacity_activation(old_opacities)

    def create_from_pcd(self, pcd: BasicPointCloud, spatial_lr_scale: float):
        self.spatial_lr_scale = spatial_lr_scale
        points, colors = (torch.tensor(np.asarray(values)).float().cuda() for values in (pcd.points, pcd.colors))
        print("Number of points at initialisation : ", len(points))
        self._start(points, RGB2SH(colors), torch.clamp_min(distCUDA2(points), 0.0000001))

    def training_setup(self, training_args):
        self.percent_dense = training_args.percent_dense
        self._forget_statistics()
        rates = {
            "xyz": training_args.position_lr_init * self.spatial_lr_scale,
            "f_dc": training_args.feature_lr,
            "opacity": training_args.opacity_lr,
            "scaling": training_args.scaling_lr,
            "rotation": training_args.rotation_lr,
            "f_rest": training_args.shfeature_lr / 20.0,
        }
        groups = self._groups(rates)
        if self.optimizer_type == "default":
            self.optimizer = torch.optim.Adam(groups[:-1], lr=0.0, eps=1e-15)
            self.shoptimizer = torch.optim.Adam(groups[-1:], lr=0.0, eps=1e-15)
        elif self.optimizer_type == "sparse_adam":
            self.optimizer = SparseGaussianAdam(groups, lr=0.0, eps=1e-15)
        self._schedule_positions(training_args)

    def densify_and_split_taming(self, grads, budget, filter, N=2):
        grads[~filter] = 0
        self._split(self._drawn(grads, budget), N)

    def densify_and_clone_taming(self, grads, budget, filter):
        grads[~filter] = 0
        self._clone(self._drawn(grads, budget))

    def _drawn(self, weights, count):
        """(n,) bool with `count` of them true; fails for a count of none."""
        mask = torch.zeros(len(weights), dtype=bool, device="cuda")
        mask[torch.multinomial(weights, count, replacement=False)] = True
        return mask

    def densify_with_score(self, scores, max_screen_size, min_opacity, extent, budget, radii, iter_num=None):
        """Clone and split moving Gaussians in proportion until there are `budget`; prune half of the useless ones."""
        grads = (self.xyz_gradient_accum / self.denom).nan_to_num(0.0)[:, 0]
        self.tmp_radii = radii
        moving = grads >= 0.0002
        large = self.get_scaling.max(dim=1).values > self.percent_dense * extent
        all_clones, all_splits = moving & ~large, moving & large
        total_clones, total_splits = int(all_clones.sum()), int(all_splits.sum())
        curr_points = len(self.get_xyz)
        growth = min(budget, total_clones + total_splits + curr_points) - curr_points
        clone_budget = (growth * total_clones) // (total_clones + total_splits)
        split_budget = (growth * total_splits) // (total_clones + total_splits)
        self.densify_and_clone_taming(scores.clone(), clone_budget, all_clones)
        self.densify_and_split_taming(scores.clone(), split_budget, all_splits)
        if iter_num < 27:
            self._prune_half(self._useless(min_opacity, extent, max_screen_size), scores)
        self.tmp_radii = None
        torch.cuda.empty_cache()
