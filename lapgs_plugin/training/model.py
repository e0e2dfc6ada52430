"""The field under training: named parameters with one optimizer each, as densification strategies edit them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.field import GaussianField
from lapgs_plugin.reference_raster.adam import FieldAdam
from lapgs_plugin.training.settings import LearningRates

STRATEGY_NAMES = {
    "means": "means",
    "quats": "quaternions",
    "scales": "log_scales",
    "opacities": "opacity_logits",
    "sh": "sh",
}
"""gsplat's densification strategies know parameters by these names; right of each, ours."""

ADAM_EPS = 1e-15
SH_REST_SCALE = 1 / 20
"""SH coefficients above degree 0 learn at a twentieth of the rate of degree 0, as in 3DGS."""


@dataclass
class TrainableField:
    """A field being optimized. `params` and `optimizers` are edited in place by densification.

    Attributes:
        params: by strategy name, each (n, ...) with gradients.
        optimizers: one Adam for each of them.
        signed: whether the field is a residual.
    """

    params: dict[str, torch.nn.Parameter]
    optimizers: dict[str, FieldAdam]
    signed: bool

    @classmethod
    def create(cls, field: GaussianField, rates: LearningRates, extent: float) -> TrainableField:
        """Start optimizing `field` with empty Adam moments; position steps are scaled by the scene's `extent`."""
        params = {
            name: torch.nn.Parameter(getattr(field, attribute).detach().clone().contiguous())
            for name, attribute in STRATEGY_NAMES.items()
        }
        sh_scale = torch.full(params["sh"].shape[1:], SH_REST_SCALE)
        sh_scale[0] = 1.0
        rate = {
            "means": rates.means_first * extent,
            "quats": rates.quats,
            "scales": rates.scales,
            "opacities": rates.opacities,
            "sh": rates.residual_sh if field.signed else rates.sh,
        }
        optimizers = {
            name: FieldAdam([param], lr=rate[name], eps=ADAM_EPS, column_scale=sh_scale if name == "sh" else None)
            for name, param in params.items()
        }
        return cls(params, optimizers, field.signed)

    def __len__(self) -> int:
        return int(self.params["means"].shape[0])

    @property
    def field(self) -> GaussianField:
        """The current parameters, sharing their memory and gradients."""
        return GaussianField(
            **{attribute: self.params[name] for name, attribute in STRATEGY_NAMES.items()}, signed=self.signed
        )

    def step(self, means_rate: float, active_coefficients: int) -> None:
        """One Adam step on every parameter, then clear the gradients.

        Args:
            means_rate: step size of the positions, already scaled by the extent.
            active_coefficients: SH coefficients in use; higher ones have no gradient and are skipped.
        """
        self.optimizers["means"].param_groups[0]["lr"] = means_rate
        self.optimizers["sh"].param_groups[0]["active_columns"] = active_coefficients
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)

    def optimizer_moments(self) -> dict[str, dict[str, Tensor]]:
        """Adam's state of every parameter, by strategy name: step and both moments."""
        return {name: dict(opt.state[self.params[name]]) for name, opt in self.optimizers.items()}

    def adopt_moments(self, moments: dict[str, dict[str, Tensor]], kept: Tensor) -> None:
        """Continue with the Adam moments of rows `kept` (m,) of an earlier field: full inheritance."""
        for name, optimizer in self.optimizers.items():
            optimizer.state[self.params[name]] = {
                key: value.clone() if key == "step" else value[kept].clone() for key, value in moments[name].items()
            }

    def state(self) -> dict[str, Any]:
        """Everything needed to go on later, as plain tensors."""
        return {
            "params": {name: param.detach() for name, param in self.params.items()},
            "moments": self.optimizer_moments(),
            "signed": self.signed,
        }

    @classmethod
    def from_state(cls, state: dict[str, Any], rates: LearningRates, extent: float) -> TrainableField:
        field = GaussianField(
            **{attribute: state["params"][name] for name, attribute in STRATEGY_NAMES.items()}, signed=state["signed"]
        )
        model = cls.create(field, rates, extent)
        model.adopt_moments(state["moments"], torch.arange(len(field)))
        return model
