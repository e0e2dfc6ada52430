"""Choose the two images that the loss of a residual stage compares. Imports no torch."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar

from lapgs_plugin.registry import Registry

if TYPE_CHECKING:
    from torch import Tensor


class Supervision(ABC):
    """Supervise a residual stage (the paper's section on loss design). A base is always compared with its target.

    Notation: I^l is level l of the ground truth's Gaussian pyramid, I_hat^l the composed prediction, R_hat^l the
    rendered residual, I_hat^l = Up(I_hat^(l+1)) + R_hat^l.

    Attributes:
        needs_coarse: whether `pair` needs Up(I^(l+1)) of the ground truth.
        composes: whether the loss sees the composed image, so that coarser fields can be trained as well.
    """

    needs_coarse: ClassVar[bool] = False
    composes: ClassVar[bool] = False

    @abstractmethod
    def pair(
        self, image: Tensor, target: Tensor, accumulated: Tensor, coarse_target: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return the prediction and the target that the photometric loss compares, both (3, h, w).

        Args:
            image: (3, h, w) composed prediction I_hat^l.
            target: (3, h, w) ground truth I^l.
            accumulated: (3, h, w) Up(I_hat^(l+1)).
            coarse_target: (3, h, w) Up(I^(l+1)), None unless `needs_coarse`.
        """


class Reconstructed(Supervision):
    """Compare I_hat^l with I^l, the default. Finer levels correct the errors of coarser ones."""

    composes = True

    def pair(
        self, image: Tensor, target: Tensor, accumulated: Tensor, coarse_target: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        return image, target


class OnlineResidual(Supervision):
    """Compare R_hat^l with I^l - Up(I_hat^(l+1)), the residual of the prediction so far; both are signed."""

    def pair(
        self, image: Tensor, target: Tensor, accumulated: Tensor, coarse_target: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        return image - accumulated, target - accumulated


class GtLaplacian(Supervision):
    """Compare R_hat^l with I^l - Up(I^(l+1)), the ground truth's Laplacian; both are signed."""

    needs_coarse = True

    def pair(
        self, image: Tensor, target: Tensor, accumulated: Tensor, coarse_target: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        assert coarse_target is not None, "`needs_coarse` asks for it"
        return image - accumulated, target - coarse_target


RECONSTRUCTED = "reconstructed"
SUPERVISIONS: Registry[Supervision] = Registry(
    "--supervision",
    "lapgs_plugin.supervisions",
    Supervision,
    {RECONSTRUCTED: Reconstructed(), "online_residual": OnlineResidual(), "gt_laplacian": GtLaplacian()},
)
"""Supervisions by name. Other packages add instances of `Supervision` as entry points of this group."""
