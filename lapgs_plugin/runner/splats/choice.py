"""Choose whose rasterizer renders a script that trains splats: gsplat's, which it imports, or ours in its place."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.packages import OURS, OWN
from lapgs_plugin.environment import triton_missing
from lapgs_plugin.errors import MissingExtraError, UserInputError, first_line
from lapgs_plugin.gpu_raster.bindings import is_compiled
from lapgs_plugin.rasterizers.gsplat.rasterization import rasterization, refusal
from lapgs_plugin.rasterizers.gsplat.rasterizer import gsplat_missing
from lapgs_plugin.rasterizers.gsplat.self_check import direct_works
from lapgs_plugin.runner.dry_run import undisturbed
from lapgs_plugin.runner.rasterizer_choice import Decision, decide
from lapgs_plugin.runner.rasterizer_trial import RasterizerCall, trials_of
from lapgs_plugin.runner.splats.signed import FinishedField, Rasterize, Rasterizer
from lapgs_plugin.runner.splats.views import SplatView, camera_inputs

logger = logging.getLogger(__name__)

TRIED_VIEWS = 3
"""Views that are rendered with both, at the size of each level."""
NAMES = {
    "means": "means3D",
    "quats": "rotations",
    "scales": "scales",
    "opacities": "opacities",
    "colors": "shs",
}
"""Inputs with gradients, and their names where rasterizers are compared."""


@dataclass(frozen=True)
class OurRasterizer(Rasterizer):
    """Render by our kernels the calls that they can do, and the others with the script's own functions."""

    _said: set[str] = field(default_factory=set)

    @classmethod
    def instead_of(cls, own: Rasterizer) -> OurRasterizer:
        """Return the rasterizer that takes the place of a script's own."""
        return cls(own.rasterization, own.spherical_harmonics)

    def render(self, **inputs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """See `Rasterizer.render`."""
        return super().render(**inputs) if self._refuses(inputs) else rasterization(**inputs)

    def signed(self, **inputs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """See `Rasterizer.signed`."""
        if self._refuses(inputs):
            return super().signed(**inputs)
        return rasterization(signed=True, **{**inputs, "backgrounds": None})

    def _refuses(self, inputs: Mapping[str, Any]) -> bool:
        why = refusal(inputs)
        if why and (missing := gsplat_missing()):
            raise MissingExtraError(
                f"the rasterizer of lapgs cannot render calls with {why}, and {missing}; leave out the option of the "
                "script that asks for them, or build gsplat"
            )
        if why and why not in self._said:
            self._said.add(why)
            logger.info("rasterizer: gsplat's own renders calls with %s", why)
        return bool(why)


def sample_calls(
    trainer: Any, views: Sequence[SplatView], levels: Sequence[int], device: torch.device
) -> dict[str, dict[str, Any]]:
    """Return inputs of `rasterization` as a script passes them in training, by view and level.

    Args:
        trainer: of the script, with its first splats.
        views: for training; some are taken.
        levels: of the run.
        device: that renders.
    """
    config, splats = trainer.cfg, dict(trainer.splats.items())
    if "sh0" not in splats:  # a network makes colours
        none = splats["means"].new_zeros(len(splats["means"]), 1, 3)
        splats |= {"sh0": none, "shN": none[:, :0]}
    of_script = {name: getattr(config, name, False) for name in ("sparse_grad", "with_ut", "with_eval3d")}
    of_script["absgrad"] = bool(getattr(config.strategy, "absgrad", False))
    if getattr(config, "depth_loss", False):
        of_script["render_mode"] = "RGB+ED"
    calls = {}
    for level in levels:
        for view in views[:: -(-len(views) // TRIED_VIEWS)]:
            inputs = camera_inputs(view, level, config, device)
            inputs["viewmats"].requires_grad_(bool(getattr(config, "pose_opt", False)))
            calls[f"{view.name} of level {level}"] = {
                **inputs, **of_script, **FinishedField(level, False, splats).inputs()
            }  # fmt: skip
    return calls


def decided(wanted: str, own: Rasterizer, calls: Mapping[str, dict[str, Any]], *, tries: bool = True) -> Decision:
    """Decide whose rasterizer trains.

    Args:
        wanted: one of `packages.CHOICES`.
        own: the script's.
        calls: at least one, as `sample_calls` returns them.
        tries: whether there is a dry run.

    Raises:
        UserInputError: ours is wanted, and cannot render what the script trains.
    """
    if wanted == OWN:
        return Decision(OWN, f"--rasterizer {OWN}")
    refused = next(filter(None, map(refusal, calls.values())), "")
    why = triton_missing() or (refused and f"it cannot render calls with {refused}")
    if wanted == OURS:
        if why:
            raise UserInputError(f"--rasterizer {OURS}: {why}; leave it out, or leave out the script's option for it")
        return Decision(OURS, f"--rasterizer {OURS}")
    if why:
        return Decision(OWN, f"the checkout's own gsplat: that of lapgs cannot take its place ({why})")
    if not is_compiled():
        return _without_gsplats()
    if not tries:
        return Decision(OWN, "the checkout's own gsplat: without a dry run it is compared with none")
    return _compared(own, calls)


def _without_gsplats() -> Decision:
    if direct_works():
        return Decision(OURS, "that of lapgs: gsplat's CUDA part is not built")
    return Decision(OWN, "the checkout's own gsplat: our kernels do not work here (the log says why)")


def _compared(own: Rasterizer, calls: Mapping[str, dict[str, Any]]) -> Decision:
    """Return whose rasterizer is to be taken, after both rendered some views."""
    device = next(iter(calls.values()))["means"].device
    with undisturbed(device):
        try:
            trials = list(trials_of((_call(view, own, inputs) for view, inputs in calls.items()), device))
        except Exception as error:  # what a rasterizer cannot do is in its message
            why = f"that of lapgs cannot take its place ({first_line(error)})"
            return Decision(OWN, f"the checkout's own gsplat: {why}")
    return decide("gsplat", trials)


def _call(view: str, own: Rasterizer, inputs: Mapping[str, Any]) -> RasterizerCall:
    """Return a view's call as rasterizers are compared: with the inputs that have gradients, by the family's names."""
    fixed = {name: value for name, value in inputs.items() if name not in NAMES}
    settings = SimpleNamespace(image_width=inputs["width"], image_height=inputs["height"])
    learned = {NAMES[name]: inputs[name] for name in NAMES}
    return RasterizerCall(view, _renders(own.render, fixed), _renders(rasterization, fixed), learned, settings)


def _renders(render: Rasterize, fixed: Mapping[str, Any]) -> Any:
    """Return a function of the inputs with gradients to the first image (3, h, w) and radii (n,) of a call."""

    def rendered(**learned: Tensor) -> tuple[Tensor, Tensor]:
        images, _, info = render(**fixed, **{name: learned[other] for name, other in NAMES.items()})
        radii: Tensor = info["radii"][0]
        if radii.ndim == 2:
            radii = torch.where((radii > 0).all(-1), radii.amax(-1), 0)
        return images[0].permute(2, 0, 1), radii.int()

    return rendered
