"""FastGS's Gaussians: scored by several views, with an optimizer of their own for the higher SH."""

import contextlib

import numpy as np
import torch
from simple_knn._C import distCUDA2
from utils.gaussian_base import GaussianBase
from utils.general_utils import identity_gate, inverse_sigmoid
from utils.graphics_utils import BasicPointCloud
from utils.sh_utils import RGB2SH

with contextlib.suppress(ImportError):
    from diff_gaussian_rasterization import SparseGaussianAdam


class GaussianModel(GaussianBase):
    statistics = ("xyz_gradient_accum", "xyz_gradient_accum_abs", "denom")

    def __init__(self, sh_degree, optimizer_type="default"):
        super().__init__(sh_degree, optimizer_type)
        self.shoptimizer = None

    def modify_functions(self):
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
            "f_dc": training_args.lowfeature_lr,
            "opacity": training_args.opacity_lr,
            "scaling": training_args.scaling_lr,
            "rotation": training_args.rotation_lr,
            "f_rest": training_args.highfeature_lr / 20.0,
        }
        groups = self._groups(rates)
        if self.optimizer_type == "default":
            self.optimizer = torch.optim.Adam(groups[:-1], lr=0.0, eps=1e-15)
            self.shoptimizer = torch.optim.Adam(groups[-1:], lr=0.0, eps=1e-15)
        elif self.optimizer_type == "sparse_adam":
            self.optimizer = SparseGaussianAdam(groups, lr=0.0, eps=1e-15)
        self._schedule_positions(training_args)

    def optimizer_step(self, iteration):
        """Steps become rare after iterations 15000 and 20000; those of the higher SH are from the start."""
        if iteration <= 15000:
            period, sh_period = 1, 16
        elif iteration <= 20000:
            period = sh_period = 32
        else:
            period = sh_period = 64
        for optimizer, every in ((self.optimizer, period), (self.shoptimizer, sh_period)):
            if iteration % every == 0:
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)

    def densify_and_split_fastgs(self, metric_mask, filter, N=2):
        self._split(metric_mask & filter, N)

    def densify_and_clone_fastgs(self, metric_mask, filter):
        self._clone(metric_mask & filter)

    def densify_and_prune_fastgs(
        self, max_screen_size, min_opacity, extent, radii, args, importance_score=None, pruning_score=None
    ):
        """Clone small and split large Gaussians that move and are rendered badly; prune half of the useless ones."""
        grads = (self.xyz_gradient_accum / self.denom).nan_to_num(0.0)[:, 0]
        grads_abs = (self.xyz_gradient_accum_abs / self.denom).nan_to_num(0.0)[:, 0]
        self.tmp_radii = radii
        large = self.get_scaling.max(dim=1).values > args.dense * extent
        metric_mask = importance_score > 5
        self.densify_and_clone_fastgs(metric_mask, ~large & (grads >= args.grad_thresh))
        self.densify_and_split_fastgs(metric_mask, large & (grads_abs >= args.grad_abs_thresh))
        self._prune_half(self._useless(min_opacity, extent, max_screen_size), 1 - pruning_score)
        opacities_new = inverse_sigmoid(self.get_opacity.clamp(max=0.8))
        self._adopt(self.replace_tensor_to_optimizer(opacities_new, "opacity"))
        self.tmp_radii = None
        torch.cuda.empty_cache()

    def add_densification_stats(self, viewspace_point_tensor, update_filter):
        points = viewspace_point_tensor
        self.xyz_gradient_accum[update_filter] += torch.norm(points.grad[update_filter, :2], dim=-1, keepdim=True)
        self.xyz_gradient_accum_abs[update_filter] += torch.norm(points.grad[update_filter, 2:], dim=-1, keepdim=True)
        self.denom[update_filter] += 1

    def final_prune_fastgs(self, min_opacity, pruning_score=None):
        """Prune what is faint or to blame."""
        self.prune_points((self.get_opacity < min_opacity)[:, 0] | (pruning_score > 0.9))
