"""Methods of the 2023 release's GaussianModel, for classes to adopt: one optimizer, densification by gradients."""

import numpy as np
import torch
from simple_knn._C import distCUDA2
from utils.sh_utils import RGB2SH


def create_from_pcd(self, pcd, spatial_lr_scale):
    self.spatial_lr_scale = spatial_lr_scale
    points, colors = (torch.tensor(np.asarray(values)).float().cuda() for values in (pcd.points, pcd.colors))
    self.tmp_radii = None
    self._start(points, RGB2SH(colors), torch.clamp_min(distCUDA2(points), 0.0000001))


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
    self.optimizer = torch.optim.Adam(self._groups(rates), lr=0.0, eps=1e-15)
    self._schedule_positions(training_args)


def densify_and_prune(self, max_grad, min_opacity, extent, max_screen_size):
    grads = (self.xyz_gradient_accum / self.denom).nan_to_num(0.0)[:, 0]
    self.tmp_radii = torch.zeros(len(grads))
    large = self.get_scaling.max(dim=1).values > self.percent_dense * extent
    self._clone(~large & (grads >= max_grad))
    self._split(large & (grads >= max_grad), 2)
    self.prune_points(self._useless(min_opacity, extent, max_screen_size))
    self.tmp_radii = None
