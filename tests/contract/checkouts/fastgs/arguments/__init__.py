"""Options: the 2023 release's, and those of scores, optimizers and the rasterizer."""

from utils import plain_options
from utils.plain_options import ModelParams

__all__ = ["ModelParams", "OptimizationParams", "PipelineParams"]


class PipelineParams(plain_options.PipelineParams):
    def __init__(self, parser):
        self.separate_sh = True
        self.antialiasing = False
        super().__init__(parser)


class OptimizationParams(plain_options.OptimizationParams):
    def __init__(self, parser):
        self.shfeature_lr = 0.005
        self.loss_thresh = 0.1
        self.grad_abs_thresh = 0.0012
        self.highfeature_lr = 0.005
        self.lowfeature_lr = 0.0025
        self.grad_thresh = 0.0002
        self.dense = 0.001
        self.mult = 0.5
        self.optimizer_type = "default"
        super().__init__(parser)
        parser.set_defaults(opacity_lr=0.025, percent_dense=0.001)
