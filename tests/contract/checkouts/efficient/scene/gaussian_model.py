"""EfficientGS's Gaussians: their higher SH come in mid-training, each with a degree of its own."""

import torch
from torch import nn
from utils import plain_model
from utils.gaussian_base import GaussianBase


class GaussianModel(GaussianBase):
    create_from_pcd = plain_model.create_from_pcd
    densify_and_prune = plain_model.densify_and_prune
    sparse_shs_degree = None

    def training_setup(self, training_args):
        plain_model.training_setup(self, training_args)

    def set_shs_memory(self, sh_degree):
        self.max_sh_degree = sh_degree
        self.active_sh_degree = 0
        rest = torch.zeros((len(self._xyz), (sh_degree + 1) ** 2 - 1, 3)).cuda()
        self._features_rest = nn.Parameter(rest.requires_grad_(True))
        for group in self.optimizer.param_groups:
            if group["name"] == "f_rest":
                self.optimizer.state.pop(group["params"][0], None)
                group["params"][0] = self._features_rest

    def prune_points(self, mask):
        GaussianBase.prune_points(self, mask)
        if self.sparse_shs_degree is not None:
            self.sparse_shs_degree = self.sparse_shs_degree[~mask]
