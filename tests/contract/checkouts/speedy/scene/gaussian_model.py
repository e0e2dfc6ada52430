"""Speedy-Splat's Gaussians: the share with the least scores can be pruned."""

from utils import plain_model
from utils.gaussian_base import GaussianBase


class GaussianModel(GaussianBase):
    create_from_pcd = plain_model.create_from_pcd
    densify_and_prune = plain_model.densify_and_prune

    def training_setup(self, training_args):
        plain_model.training_setup(self, training_args)

    def prune_gaussians(self, percent, import_score):
        ordered = import_score.sort(dim=0).values
        least = ordered[int(percent * (len(ordered) - 1))]
        self.prune_points((import_score <= least)[:, 0])
