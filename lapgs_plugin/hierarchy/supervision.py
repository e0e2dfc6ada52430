"""Decide which two images the loss of a residual stage compares."""

from __future__ import annotations

from enum import Enum

from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import Stage


class Supervision(str, Enum):
    """How a residual stage is supervised (the paper's section on loss design). The base has only one way.

    Notation: I^l is level l of the ground truth's Gaussian pyramid, I_hat^l the composed prediction, R_hat^l the
    rendered residual, I_hat^l = Up(I_hat^(l+1)) + R_hat^l.
    """

    RECONSTRUCTED = "reconstructed"
    """I_hat^l against I^l: the default. Later levels mend the errors of earlier ones."""
    ONLINE_RESIDUAL = "online_residual"
    """R_hat^l against I^l - Up(I_hat^(l+1)), the residual of what was predicted so far."""
    GT_LAPLACIAN = "gt_laplacian"
    """R_hat^l against I^l - Up(I^(l+1)), the ground truth's own Laplacian."""


def parse_supervision(name: str) -> Supervision:
    """The supervision called `name`.

    Raises:
        UserInputError: there is none of that name.
    """
    try:
        return Supervision(name)
    except ValueError as error:
        known = ", ".join(supervision.value for supervision in Supervision)
        raise UserInputError(f"--supervision {name}: expected {known}") from error


def supervised_pair(
    supervision: Supervision,
    image: Tensor,
    target: Tensor,
    accumulated: Tensor | None = None,
    coarse_target: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """The two images that the photometric loss compares.

    Args:
        supervision: which of the three.
        image: (3, h, w) composed prediction I_hat^l.
        target: (3, h, w) ground truth I^l.
        accumulated: (3, h, w) Up(I_hat^(l+1)), None for the base field, which is always compared with its target.
        coarse_target: (3, h, w) Up(I^(l+1)), looked at by GT_LAPLACIAN alone.

    Returns:
        Prediction and target, both (3, h, w); for the residual supervisions both are signed.
    """
    if accumulated is None or supervision is Supervision.RECONSTRUCTED:
        return image, target
    if supervision is Supervision.ONLINE_RESIDUAL:
        return image - accumulated, target - accumulated
    assert coarse_target is not None, "gt_laplacian needs Up of the coarser target"
    return image - accumulated, target - coarse_target


def joint_from(stage: Stage, share: float, supervision: Supervision) -> int | None:
    """The first iteration of a stage's last `share`, in which the finished fields are trained along; counted from 1.

    None when there is none: in the base's stage, where the share is less than an iteration, and where residuals are
    supervised alone, since nothing is composed there.

    >>> joint_from(Stage(0, (800, 533), 20_000, signed=True), 0.25, Supervision.RECONSTRUCTED)
    15001
    """
    if not stage.signed or supervision is not Supervision.RECONSTRUCTED:
        return None
    first = stage.iterations - round(stage.iterations * share) + 1
    return first if first <= stage.iterations else None
