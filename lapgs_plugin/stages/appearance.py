"""Learn how each training photo differs from the scene: `--appearance`.

The composed image of a view is transformed before the loss, so that fields need not explain why the same surface is
brighter in one photo than in the next. Renders and the viewer apply no transform: they show the scene as a photo of
mean exposure would.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.hierarchy.settings import AFFINE, BILATERAL
from lapgs_plugin.ops.bilateral_grid import add_variation, grid_nodes, slice_grids, uniform_grids
from lapgs_plugin.ops.bilateral_grid import triton_works as grids_in_triton
from lapgs_plugin.ops.color_transform import transform_colors, triton_works
from lapgs_plugin.ops.mixed_sizes import Sizes
from lapgs_plugin.runs.archive import Exposures, Grids, RunArchive
from lapgs_plugin.runs.layout import GRIDS
from lapgs_plugin.stages.view_transforms import ViewTransforms

if TYPE_CHECKING:
    from typing_extensions import Self

DIFFERENT = 0.08
"""Spread of exposure in stops, see `MeasuredExposure`, from which on photos count as different."""
FIRST_RATE = 1e-2
"""Adam's step size at the start of a run; its logarithm decays linearly.

nerfstudio and gsplat have 2e-3 for grids, but step in each iteration. Adam moves a value that gets its gradient in one
of v steps by sqrt(v) of a step's size in these v steps, so that 1e-2 in each pass is theirs with 25 views.
"""
LAST_RATE = 1e-3
"""The same at the end of a run."""
VARIATION_WEIGHT = 3.0
"""Weight of the grids' mean total variation beside the loss of a view."""


class ViewAppearance(ViewTransforms):
    """Hold and optimize a transform of each training view's composed image."""

    @property
    def _rates(self) -> tuple[float, float]:
        return FIRST_RATE, LAST_RATE

    @classmethod
    def create(cls, names: Sequence[str], start: Tensor, device: torch.device, done: int, total: int) -> Self:
        """Start a stage with empty moments.

        Args:
            names: of the views.
            start: (v, ...) transforms, which are copied: a result of `uniform` or `read`.
            device: of training.
            done, total: see `ViewTransforms`.
        """
        return cls(names, torch.nn.Parameter(start.detach().clone().to(device)), done, total)

    @staticmethod
    @abstractmethod
    def uniform(colors: Tensor, size: tuple[int, int]) -> Tensor:
        """Return transforms (v, ...) that are the same as colour transforms (v, 3, 4) of whole images.

        Args:
            colors: of the views.
            size: (width, height) of their photos at full size, the largest of each.
        """

    @staticmethod
    @abstractmethod
    def read(archive: RunArchive, level: int, names: Sequence[str]) -> Tensor | None:
        """Return the transforms (v, ...) of a finished level for views, unchanging ones for views that it lacks.

        None if the level was trained without.

        Raises:
            RunFolderError: their file is damaged.
        """

    @abstractmethod
    def apply(self, names: Sequence[str], image: Tensor, sizes: Sizes | None = None) -> Tensor:
        """Transform the image (3, h, w) of a view, or those of several, (b, 3, h, w), differentiably.

        Args:
            names, image: of the views.
            sizes: of views whose sizes differ, see `mixed_sizes`; None if images are whole.
        """

    def archived_grids(self) -> Grids | None:
        """Return the grids by view on the CPU; None without grids."""
        return None

    def _chosen(self, names: Sequence[str]) -> Tensor:
        """Return the transforms (b, ...) of some views, whose gradients are added to theirs alone.

        Autograd's gradient of an indexed tensor is as large as those of all views, zeros but for the chosen ones.
        """
        if self.transforms.grad is None:
            self.transforms.grad = torch.zeros_like(self.transforms)
        chosen = []
        for index in (self._index[name] for name in names):
            leaf = self.transforms.detach()[index].requires_grad_()
            leaf.grad = self.transforms.grad[index]  # which autograd adds to in place
            chosen.append(leaf)
        return chosen[0][None] if len(chosen) == 1 else torch.stack(chosen)


class ViewColors(ViewAppearance):
    """Hold and optimize an affine colour transform (3, 4) of each training view; their mean stays at `centre`.

    Attributes:
        centre: (3, 4), by default the identity.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        self.centre = torch.eye(3, 4, device=self.transforms.device)
        triton_works(self.transforms)  # compiles its kernels now, not in the first iteration

    @staticmethod
    def uniform(colors: Tensor, size: tuple[int, int]) -> Tensor:
        """See `ViewAppearance.uniform`."""
        return colors

    @staticmethod
    def read(archive: RunArchive, level: int, names: Sequence[str]) -> Tensor | None:
        """See `ViewAppearance.read`."""
        learned = archive.exposure(level)
        return None if learned is None else start_from(learned, names)

    def apply(self, names: Sequence[str], image: Tensor, sizes: Sizes | None = None) -> Tensor:
        """See `ViewAppearance.apply`."""
        chosen = self._chosen(names)
        return transform_colors(image, chosen[0] if image.ndim == 3 else chosen)

    def _recentre(self) -> None:
        self.transforms.sub_(self.transforms.mean(dim=0) - self.centre)


class ViewGrids(ViewAppearance):
    """Hold and optimize a bilateral grid (y, x, l, 12) of each training view.

    At each brightness, the mean over all views and places is the identity: a tone curve that all photos share can be
    the field's. A pattern over the image that they share cannot, and stays.
    """

    WARM_UP: ClassVar[float] = 1 / 30  # 1,000 of 30,000 iterations, as in nerfstudio and gsplat
    EPSILON: ClassVar[float] = 1e-15  # a node has a small part of the loss's gradient

    def __post_init__(self) -> None:
        super().__post_init__()
        grids_in_triton(self.transforms)  # compiles its kernels now, not in the first iteration

    @staticmethod
    def uniform(colors: Tensor, size: tuple[int, int]) -> Tensor:
        """See `ViewAppearance.uniform`."""
        return uniform_grids(colors, grid_nodes(size))

    @staticmethod
    def read(archive: RunArchive, level: int, names: Sequence[str]) -> Tensor | None:
        """See `ViewAppearance.read`; a level without grids is damaged, because a run has them from its start."""
        learned = archive.grids(level)
        if not learned:
            path = archive.path(f"level_{level}", GRIDS)
            raise RunFolderError(f"{path} does not exist, and the next level continues from it; train with --overwrite")
        *nodes, _ = next(iter(learned.values())).shape
        (unchanged,) = uniform_grids(identities(1), (nodes[0], nodes[1], nodes[2]))
        return torch.stack([learned.get(name, unchanged) for name in names])

    def apply(self, names: Sequence[str], image: Tensor, sizes: Sizes | None = None) -> Tensor:
        """See `ViewAppearance.apply`."""
        return slice_grids(image, self._chosen(names), sizes)

    def archived(self) -> Exposures:
        """Return the mean colour transform of each grid by view: what is known of a photo's exposure as a whole."""
        means = self.transforms.detach().mean(dim=(1, 2, 3)).view(-1, 3, 4)
        return dict(zip(self.names, means.cpu().tolist(), strict=True))

    def archived_grids(self) -> Grids:
        """See `ViewAppearance.archived_grids`."""
        return dict(zip(self.names, self.transforms.detach().cpu().clone().unbind(), strict=True))

    def _step(self) -> None:
        assert self.transforms.grad is not None, "of the pass that ends here"
        # The mean over all grids in each of v iterations: the sum over them in a pass.
        add_variation(self.transforms.detach(), self.transforms.grad, VARIATION_WEIGHT)
        super()._step()

    def _recentre(self) -> None:
        common = self.transforms.mean(dim=(0, 1, 2))  # (l, 12)
        self.transforms.sub_(common - torch.eye(3, 4, device=common.device).flatten())


KINDS: Mapping[str, type[ViewAppearance]] = {AFFINE: ViewColors, BILATERAL: ViewGrids}
"""What is learned of each photo, by the choices of --appearance."""


def identities(views: int) -> Tensor:
    """Return (v, 3, 4) transforms that change nothing."""
    return torch.eye(3, 4).repeat(views, 1, 1)


def from_gains(gains: Tensor) -> Tensor:
    """Return (v, 3, 4) transforms that multiply channels by 2 to the power of (v, 3) gains; their mean is (I, 0)."""
    factors = gains.exp2()
    transforms = identities(len(gains))
    transforms[:, :, :3] *= (factors / factors.mean(dim=0))[:, :, None]
    return transforms


def start_from(archived: Exposures, names: Sequence[str]) -> Tensor:
    """Return the (v, 3, 4) transforms of a finished level for views; the identity for views that it does not have."""
    unchanged = torch.eye(3, 4).tolist()
    return torch.tensor([archived.get(name, unchanged) for name in names])
