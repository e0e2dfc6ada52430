"""Options: the 2023 release's, and the modes of the two schedules."""

from utils import plain_options
from utils.plain_options import ModelParams

__all__ = ["ModelParams", "OptimizationParams", "PipelineParams"]


class PipelineParams(plain_options.PipelineParams):
    def __init__(self, parser):
        self.max_n_gaussian = -1
        self.densify_mode = "free"
        self.resolution_mode = "const"
        super().__init__(parser)


class OptimizationParams(plain_options.OptimizationParams):
    def __init__(self, parser):
        self.optimizer_type = "default"
        super().__init__(parser)
