"""Options: the 2023 release's, and when SH are unlocked and Gaussians pruned."""

from utils import plain_options

__all__ = ["ModelParams", "OptimizationParams", "PipelineParams"]


class ModelParams(plain_options.ModelParams):
    def __init__(self, parser, sentinel=False):
        self.no_gui = False
        self.ignore_check_output = False
        super().__init__(parser, sentinel)


class PipelineParams(plain_options.PipelineParams):
    def __init__(self, parser):
        self.gs_radius = 3.0
        super().__init__(parser)


class OptimizationParams(plain_options.OptimizationParams):
    def __init__(self, parser):
        self.shs_lr_rate = 20
        self.prune_by_max_weight = False
        self.prune_way = ""
        self.top_k = 1
        self.oneupSHdegree_from_iter = 0
        self.oneupSHdegree_interval = 1000
        self.use_sparse_shs = False
        self.sparse_rate = 0.1
        self.sparse_cnt = 3
        self.load_from_h5 = False
        super().__init__(parser)
