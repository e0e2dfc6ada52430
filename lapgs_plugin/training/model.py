"""Optimize a field: named parameters with one optimizer each, as densification strategies edit them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.fields.gaussian_field import SPLAT_NAMES, GaussianField, field_from_splats, splats_from_field
from lapgs_plugin.ops.adam import (
    ADAM_EPS,
    ONE_VIEW,
    GpuFieldAdam,
    StepScale,
    step_together,
    triton_works,
)
from lapgs_plugin.ops.adam.on_cpu import FieldAdam
from lapgs_plugin.training.settings import LearningRates

SH_REST_SCALE = 1 / 20
"""SH coefficients above degree 0 learn at a twentieth of the rate of degree 0, as in 3DGS."""


@dataclass
class TrainableField:
    """Optimize a field. Densification edits `params` and `optimizers` in place.

    Attributes:
        params: by gsplat's names, each (n, ...) with gradients. With our own Adam, which has a rate for each column, SH
            are one tensor, "sh". With PyTorch's or gsplat's, which has one rate for a tensor, they are two, "sh0" and
            "shN".
        optimizers: one Adam for each of them.
        signed: whether the field is a residual.
        sparse: whether a step moves only Gaussians that have a gradient.
        sh_rest_rate: step size of SH above degree 0 before a step's factor.
    """

    params: dict[str, torch.nn.Parameter]
    optimizers: dict[str, Any]
    signed: bool
    sparse: bool = False
    sh_rest_rate: float = 0.0

    @classmethod
    def create(
        cls, field: GaussianField, rates: LearningRates, extent: float, *, sparse: bool = False
    ) -> TrainableField:
        """Start optimizing `field`, where it is, with empty Adam moments.

        Args:
            field: to start from; copied.
            rates: step sizes.
            extent: of the scene, in world units; scales the steps of positions.
            sparse: with gsplat's `SelectiveAdam`, on a GPU.
        """
        on_gpu = field.means.device.type != "cpu"
        if sparse or (on_gpu and not triton_works()):
            return cls._in_two(field, rates, extent, sparse)
        names = {**SPLAT_NAMES, "sh": "sh"}
        params = {
            name: torch.nn.Parameter(getattr(field, attribute).detach().clone().contiguous())
            for name, attribute in names.items()
        }
        make = GpuFieldAdam if on_gpu else _cpu_adam
        rate = _rates(field, rates, extent)
        optimizers = {
            name: make(param, rate[name], SH_REST_SCALE if name == "sh" else 1.0) for name, param in params.items()
        }
        return cls(params, optimizers, field.signed, sh_rest_rate=rate["sh"] * SH_REST_SCALE)

    @classmethod
    def _in_two(cls, field: GaussianField, rates: LearningRates, extent: float, sparse: bool) -> TrainableField:
        splats = splats_from_field(field)
        if field.sh_degree == 0:
            del splats["shN"]  # no coefficients, nothing to optimize
            splats["sh"] = splats.pop("sh0")
        params = {name: torch.nn.Parameter(value.detach().clone().contiguous()) for name, value in splats.items()}
        rate = _rates(field, rates, extent)
        rate |= {"sh0": rate["sh"], "shN": rate["sh"] * SH_REST_SCALE}
        optimizers = {name: _gpu_adam(param, rate[name], sparse) for name, param in params.items()}
        return cls(params, optimizers, field.signed, sparse, rate["shN"])

    def __len__(self) -> int:
        return int(self.params["means"].shape[0])

    @property
    def field(self) -> GaussianField:
        """The current parameters; memory and gradients are shared."""
        return field_from_splats(self.params, self.signed)

    def step(
        self,
        means_rate: float,
        active_coefficients: int | None = None,
        sh_rest_factor: float = 1.0,
        scale: StepScale = ONE_VIEW,
    ) -> None:
        """Make one Adam step on every parameter, then clear the gradients.

        Args:
            means_rate: step size of the positions for one view, already scaled by the extent. The positions' optimizer
                keeps it, scaled for this step.
            active_coefficients: SH coefficients in use; a CPU skips higher ones, which must never have had a gradient.
                None: all.
            sh_rest_factor: on the step size of SH above degree 0.
            scale: how the step differs from one for a single view.
        """
        means = self.optimizers["means"].param_groups[0]
        means["lr"] = means_rate
        self._scale_rest_of_sh(sh_rest_factor)
        if isinstance(self.optimizers["means"], GpuFieldAdam):
            step_together(list(self.optimizers.values()), scale)
        else:
            self._step_one_by_one(active_coefficients, scale)
        means["lr"] = means_rate * scale.rate
        for param in self.params.values():
            param.grad = None  # faster than the optimizers' own `zero_grad`

    def _step_one_by_one(self, active_coefficients: int | None, scale: StepScale) -> None:
        if isinstance(self.optimizers.get("sh"), FieldAdam):
            every = self.params["sh"].shape[1]
            self.optimizers["sh"].param_groups[0]["active_columns"] = active_coefficients or every
        if scale.gradient != 1.0:
            torch._foreach_mul_([p.grad for p in self.params.values() if p.grad is not None], scale.gradient)
        for optimizer in self.optimizers.values():
            group = optimizer.param_groups[0]
            rate = group["lr"]
            group["lr"] = rate * scale.rate
            if isinstance(optimizer, FieldAdam):
                group["views"] = scale.views
                optimizer.step()
            else:
                self._step_counting_views(optimizer, scale.views)
            group["lr"] = rate

    def _step_counting_views(self, optimizer: Any, views: int) -> None:
        """Make a step for several views of PyTorch's or gsplat's Adam, whose betas and count are those of one view."""
        group, states = optimizer.param_groups[0], optimizer.state.values()
        betas = group["betas"]
        group["betas"] = tuple(beta**views for beta in betas)
        for state in filter(None, states) if views > 1 else ():
            state["step"] /= views
        optimizer.step(*([self._touched] if self.sparse else []))
        for state in filter(None, states) if views > 1 else ():
            state["step"] *= views
        group["betas"] = betas

    def _scale_rest_of_sh(self, factor: float) -> None:
        """Set the step size of SH above degree 0 to its rate times `factor`."""
        if "shN" in self.optimizers:
            self.optimizers["shN"].param_groups[0]["lr"] = self.sh_rest_rate * factor
            return
        optimizer, scale = self.optimizers["sh"], SH_REST_SCALE * factor
        if isinstance(optimizer, GpuFieldAdam):
            optimizer.param_groups[0]["rest_scale"] = scale
        elif isinstance(optimizer, FieldAdam):
            optimizer.param_groups[0]["column_scale"][1:] = scale

    @property
    def _touched(self) -> Tensor:
        """(n,) whether a view has shown each Gaussian since the last step."""
        gradient = self.params["means"].grad  # opacities and scales have one of regularization, too
        assert gradient is not None, "no backward pass since the last step"
        return (gradient != 0).any(-1)

    @torch.no_grad()
    def overwrite(self, rows: Tensor, source: Tensor) -> None:
        """Make Gaussians `rows` (k,) copies of Gaussians `source` (k,). They keep their moments."""
        for param in self.params.values():
            param[rows] = param[source]

    @torch.no_grad()
    def append(self, source: Tensor) -> None:
        """Add copies of Gaussians `source` (k,), without moments."""
        for name, optimizer in self.optimizers.items():
            param = self.params[name]
            grown = torch.nn.Parameter(torch.cat([param, param[source]]))
            state = optimizer.state.pop(param, {})
            optimizer.state[grown] = {
                key: value if key == "step" else torch.cat([value, value.new_zeros(len(source), *value.shape[1:])])
                for key, value in state.items()
            }
            optimizer.param_groups[0]["params"] = [grown]
            self.params[name] = grown

    @torch.no_grad()
    def forget_moments(self, rows: Tensor) -> None:
        """Set Adam's moments of Gaussians `rows` (k,) to zero."""
        for name, optimizer in self.optimizers.items():
            for key, value in optimizer.state.get(self.params[name], {}).items():
                if key != "step":
                    value[rows] = 0

    def optimizer_moments(self) -> dict[str, dict[str, Tensor]]:
        """Return Adam's state of every parameter by its name: step and both moments."""
        states = {name: optimizer.state[self.params[name]] for name, optimizer in self.optimizers.items()}
        return {name: {key: torch.as_tensor(value) for key, value in state.items()} for name, state in states.items()}

    def adopt_moments(self, moments: dict[str, dict[str, Tensor]], kept: Tensor) -> None:
        """Continue with the Adam moments of rows `kept` (m,) of an earlier field: full inheritance.

        Their SH may be one tensor where this field has two, or the reverse.
        """
        moments = _moments_of("sh" in self.optimizers, moments)
        for name, optimizer in self.optimizers.items():
            device = self.params[name].device
            state: dict[str, Any] = {
                key: (value if key == "step" else value[kept]).to(device, copy=True)
                for key, value in moments[name].items()
            }
            if isinstance(optimizer, GpuFieldAdam):
                state["step"] = float(moments[name]["step"])
            optimizer.state[self.params[name]] = state

    def state(self) -> dict[str, Any]:
        """Return everything needed to continue later, as plain tensors."""
        return {
            "params": {name: param.detach() for name, param in self.params.items()},
            "moments": self.optimizer_moments(),
            "signed": self.signed,
        }


def _rates(field: GaussianField, rates: LearningRates, extent: float) -> dict[str, float]:
    """Return step sizes by the name of the parameter."""
    return {
        "means": rates.means_first * extent,
        "quats": rates.quats,
        "scales": rates.scales,
        "opacities": rates.opacities,
        "sh": rates.residual_sh if field.signed else rates.sh,
    }


def _moments_of(sh_in_one: bool, moments: dict[str, dict[str, Tensor]]) -> dict[str, dict[str, Tensor]]:
    """Adam's state of SH as one tensor or as two, whichever way it is given; a field of degree 0 has one, always."""
    others = {name: state for name, state in moments.items() if not name.startswith("sh")}
    if sh_in_one and "shN" in moments:
        sh0, rest = moments["sh0"], moments["shN"]
        both = {key: value if key == "step" else torch.cat([value, rest[key]], 1) for key, value in sh0.items()}
        return {**others, "sh": both}
    if not sh_in_one and "sh" in moments:
        parts = {"sh0": slice(0, 1), "shN": slice(1, None)}
        both = moments["sh"]
        for name, part in parts.items():
            others[name] = {key: value if key == "step" else value[:, part] for key, value in both.items()}
        return others
    return moments


def _cpu_adam(param: torch.nn.Parameter, rate: float, rest_scale: float) -> FieldAdam:
    scale = None
    if rest_scale != 1.0:
        scale = torch.full(param.shape[1:], rest_scale)
        scale[0] = 1.0
    return FieldAdam([param], lr=rate, eps=ADAM_EPS, column_scale=scale)


def _gpu_adam(param: Tensor, rate: float, sparse: bool) -> torch.optim.Optimizer:
    """Return an Adam that updates a tensor on a GPU in one kernel."""
    if not sparse:
        return torch.optim.Adam([param], lr=rate, eps=ADAM_EPS, fused=True)
    from gsplat.optimizers import SelectiveAdam

    optimizer: torch.optim.Optimizer = SelectiveAdam([param], eps=ADAM_EPS, betas=(0.9, 0.999))
    optimizer.param_groups[0]["lr"] = rate  # its constructor takes none
    return optimizer
