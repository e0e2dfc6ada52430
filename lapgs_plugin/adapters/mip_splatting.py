"""Drive Mip-Splatting: each Gaussian has a filter in space, which its render adds to scales and opacities."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lapgs_plugin.adapters.base import BackboneAdapter, logits_of
from lapgs_plugin.adapters.info import BackboneInfo
from lapgs_plugin.checkouts.source import readable_source
from lapgs_plugin.checkouts.training_call import TrainingCall

if TYPE_CHECKING:
    from lapgs_plugin.fields.gaussian_field import GaussianField

FILTER = "filter_3D"
"""Attribute of its model, (n, 1) standard deviations, and property of its PLY files."""

FILTERED = {FILTER, "get_scaling_with_3D_filter", "get_opacity_with_3D_filter"}
"""Attributes by which its forks are recognised."""


class Adapter(BackboneAdapter):
    """Drive a Mip-Splatting checkout; its fields are archived and imported with their filters applied."""

    info = BackboneInfo(
        name="mip_splatting",
        title="Mip-Splatting",
        rasterizer="diff_gaussian_rasterization",
        own_files=("create_fused_ply.py",),
        family_files=("train.py",),
        fork_of=("graphdeco",),
        raster_defaults={"kernel_size": 0.1},
    )

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        """Return whether a folder is a checkout, or a fork that kept its filters and not its files."""
        if super().recognises(folder):
            return True
        source, settings = readable_source(folder), cls.info.raster_defaults.keys()
        if source is None or not any(use.settings >= settings for use in source.rasterizers):
            return False
        return source.attributes >= FILTERED

    @classmethod
    def saved_field(cls, path: Path) -> GaussianField:
        import torch
        from plyfile import PlyData

        field = super().saved_field(path)
        vertices = PlyData.read(path)["vertex"]
        if FILTER not in vertices.data.dtype.names:  # written by its create_fused_ply.py
            return field
        filters = torch.from_numpy(vertices[FILTER].astype("float32"))[:, None]  # (n, 1)
        scales = torch.hypot(field.log_scales.exp(), filters).log()
        dimmed = field.opacity_logits.sigmoid() * (field.log_scales - scales).sum(1).exp()
        field = field.with_parameters({"log_scales": scales, "opacity_logits": logits_of(dimmed)})
        field.require_finite()
        return field

    def snapshot(self, gaussians: Any, signed: bool) -> GaussianField:
        import torch

        field = super().snapshot(gaussians, signed)
        if not hasattr(gaussians, FILTER):
            return field
        with torch.no_grad():
            opacities = gaussians.get_opacity_with_3D_filter.squeeze(-1)
            return field.with_parameters(
                {
                    "log_scales": torch.log(gaussians.get_scaling_with_3D_filter),
                    "opacity_logits": logits_of(opacities),
                }
            )

    def new_model(self, call: TrainingCall) -> Any:
        import torch

        gaussians = super().new_model(call)
        # Training computes the filters; archived fields have them applied.
        setattr(gaussians, FILTER, torch.zeros(1, 1, device="cuda"))
        return gaussians

    def model_of(self, call: TrainingCall, field: GaussianField) -> Any:
        import torch

        gaussians = super().model_of(call, field)
        # Our kernels read one for each Gaussian, which joint training would else make in each iteration.
        setattr(gaussians, FILTER, torch.zeros(len(field), 1, device="cuda"))
        return gaussians
