"""Options."""

from utils.plain_options import ModelParams, OptimizationParams, PipelineParams

__all__ = ["ModelParams", "OptimizationParams", "PipelineParams"]
