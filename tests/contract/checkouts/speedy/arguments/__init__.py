"""Options: the 2023 release's, and the schedule and shares of pruning."""

from utils import plain_options
from utils.plain_options import ModelParams, PipelineParams

__all__ = ["ModelParams", "OptimizationParams", "PipelineParams"]


class OptimizationParams(plain_options.OptimizationParams):
    def __init__(self, parser):
        self.prune_from_iter = 6_000
        self.prune_until_iter = 30_000
        self.prune_interval = 3000
        self.densify_prune_ratio = 0.80
        self.after_densify_prune_ratio = 0.30
        super().__init__(parser)
