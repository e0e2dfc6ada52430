"""Mini-Splatting's Gaussians: they can be replaced by points in mid-training."""

import torch
from simple_knn._C import distCUDA2
from utils import plain_model
from utils.gaussian_base import GaussianBase
from utils.sh_utils import RGB2SH


class GaussianModel(GaussianBase):
    create_from_pcd = plain_model.create_from_pcd

    def training_setup(self, training_args):
        plain_model.training_setup(self, training_args)

    def densify_and_prune_split(self, max_grad, min_opacity, extent, max_screen_size, mask):
        plain_model.densify_and_prune(self, max_grad, min_opacity, extent, max_screen_size)

    def reinitial_pts(self, pts, rgb):
        self._start(pts.detach(), RGB2SH(rgb.detach()), torch.clamp_min(distCUDA2(pts.detach()), 0.0000001))
