"""DashGaussian's Gaussians: pruned first, then as many of the largest gradients densified as the rate allows."""

import torch
from utils import plain_model
from utils.gaussian_base import GaussianBase


class GaussianModel(GaussianBase):
    create_from_pcd = plain_model.create_from_pcd

    def training_setup(self, training_args):
        plain_model.training_setup(self, training_args)

    def prune_and_densify(self, max_grad, min_opacity, extent, max_screen_size, radii, densify_rate=1.0):
        before = len(self.get_xyz)
        self.tmp_radii = radii
        self.prune_points(self._useless(min_opacity, extent, None))
        count = min(int(before * (1 + densify_rate)) - len(self.get_xyz), len(self.get_xyz))
        grads = (self.xyz_gradient_accum / self.denom).nan_to_num(0.0)[:, 0]
        chosen = torch.zeros(len(grads), dtype=torch.bool)
        chosen[grads.topk(max(count, 0)).indices] = True
        self._clone(chosen & (grads >= max_grad))
        self.tmp_radii = None
        return (grads >= max_grad).sum()
