"""Options: the 2023 release's, and those of depths, exposure, antialiasing and optimizers."""

from utils import plain_options

__all__ = ["ModelParams", "OptimizationParams", "PipelineParams"]


class ModelParams(plain_options.ModelParams):
    def __init__(self, parser, sentinel=False):
        self._depths = ""
        self.train_test_exp = False
        super().__init__(parser, sentinel)


class PipelineParams(plain_options.PipelineParams):
    def __init__(self, parser):
        self.antialiasing = False
        super().__init__(parser)


class OptimizationParams(plain_options.OptimizationParams):
    def __init__(self, parser):
        self.exposure_lr_init = 0.01
        self.exposure_lr_final = 0.001
        self.exposure_lr_delay_steps = 0
        self.exposure_lr_delay_mult = 0.0
        self.depth_l1_weight_init = 1.0
        self.depth_l1_weight_final = 0.01
        self.optimizer_type = "default"
        super().__init__(parser)
        parser.set_defaults(opacity_lr=0.025)
