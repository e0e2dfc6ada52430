"""Options: the 2023 release's, and those of its optimizers; those of its budget are in train.py."""

from utils import plain_options
from utils.plain_options import ModelParams

__all__ = ["ModelParams", "OptimizationParams", "PipelineParams"]


class PipelineParams(plain_options.PipelineParams):
    def __init__(self, parser):
        self.separate_sh = True
        super().__init__(parser)


class OptimizationParams(plain_options.OptimizationParams):
    def __init__(self, parser):
        self.shfeature_lr = 0.005
        self.optimizer_type = "default"
        super().__init__(parser)
        parser.set_defaults(opacity_lr=0.025)
