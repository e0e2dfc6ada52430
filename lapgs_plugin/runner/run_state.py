"""What the stages of a run over a checkout share, and what each hands on to the next."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from fractions import Fraction
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.adapters.base import BackboneAdapter, TrainingCall
from lapgs_plugin.checkouts.level_views import PhotoAlbum
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.inheritance import check_inheritance
from lapgs_plugin.hierarchy.plan import (
    DEFAULT_HIERARCHY,
    RESIDUAL_COLOR_RATE,
    Hierarchy,
    Stage,
    check_joint_share,
    check_prune_share,
    check_seed,
    coarse_factor,
    joint_share,
    parse_hierarchy,
    parse_split,
    require_no_residuals,
)
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.hierarchy.supervision import joint_from, parse_supervision
from lapgs_plugin.runner.hooking import HookCaller
from lapgs_plugin.runner.iteration_parts import IterationParts
from lapgs_plugin.runner.shim import RasterizerShim, StageRendering
from lapgs_plugin.runs.image_store import PLACES, PRECISIONS
from lapgs_plugin.runs.upsampled_images import UpsampledImages
from lapgs_plugin.runs.watching import Watcher

PAPER_SPLIT = (Fraction(1, 3), Fraction(2, 3))
"""10k and 20k of 30k iterations for a base and a residual, as in the paper's main tables; others take `StagePlan`'s."""

IN_MANIFEST = ("levels", "grid", "supervision", "inherit", "seed")
"""Options that the manifest has fields of its own for."""


@dataclass(frozen=True)
class HierarchyOptions:
    """What a user can choose about the hierarchy; everything else is the backbone's.

    Attributes:
        hierarchy: "nested", where nothing is to be chosen about residuals, or "laplacian".
        levels: number of levels; 1 is the plain backbone, archived as a run.
        split: share of the iterations of each stage, coarsest first, as text; None takes `StagePlan`'s, and of a base
            with one residual the paper's.
        grid: of the pyramid.
        supervision, inherit, inherit_ratio: see their modules.
        joint: share of each residual stage, its last, in which the finished fields are trained along, 0 to 1. Ablations
            that supervise residuals alone have no use for it: nothing is composed there. None: by the hierarchy.
        residual_color_rate: factor on the SH learning rates of residual stages, above 0.
        residual_resets: let the backbone reset opacities in residual stages as well as in the base's.
        coarse_threshold: factor on densification thresholds for each time that a level's images are halved, above 0.
            None: by the hierarchy.
        prune: share of what is seen whose Gaussians are removed when a stage's densification ends, see `pruning`; 0 for
            none.
        images_on: "gpu", "memory", "disk", or "auto" to let their size decide.
        prediction_precision: what cached predictions are stored as before Up, a key of `imagestore.PRECISIONS`.
        fused_adam: let PyTorch's Adam step each tensor in one kernel.
        seed: of the draw of inherited Gaussians.

    Raises:
        UserInputError: one of them is none of what it can be.
    """

    hierarchy: str = DEFAULT_HIERARCHY.value
    levels: int = 2
    split: str | None = None
    grid: str = "camera"
    supervision: str = "reconstructed"
    inherit: str = "geometry"
    inherit_ratio: float = 1.0
    joint: float | None = None
    residual_color_rate: float = RESIDUAL_COLOR_RATE
    residual_resets: bool = False
    coarse_threshold: float | None = None
    prune: float = 0.0
    images_on: str = "auto"
    prediction_precision: str = "float16"
    fused_adam: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        parse_hierarchy(self.hierarchy)
        parse_supervision(self.supervision)
        Pyramid(self.grid)
        self.shares()
        check_seed(self.seed)
        check_inheritance(self.inherit, self.inherit_ratio)
        check_joint_share(self.joint_share)
        check_prune_share(self.prune)
        for option, factor in (
            ("--residual-color-rate", self.residual_color_rate),
            ("--coarse-threshold", self.coarse_factor),
        ):
            if factor <= 0 or not math.isfinite(factor):
                raise UserInputError(f"{option} {factor}: expected a positive factor")
        if self.images_on not in ("auto", *PLACES):
            raise UserInputError(f"--images-on {self.images_on}: expected {', '.join(('auto', *PLACES))}")
        if self.prediction_precision not in PRECISIONS:
            raise UserInputError(
                f"--prediction-precision {self.prediction_precision}: expected {', '.join(PRECISIONS)}"
            )
        if self.nested:
            require_no_residuals(
                {
                    "--supervision": (self.supervision, "reconstructed"),
                    "--inherit": (f"{self.inherit}:{self.inherit_ratio:g}", "geometry:1"),
                    "--joint": (self.joint_share, 0.0),
                    "--residual-color-rate": (self.residual_color_rate, RESIDUAL_COLOR_RATE),
                    "--residual-resets": (self.residual_resets, False),
                }
            )

    @property
    def nested(self) -> bool:
        """Whether each level trains the field of the coarser one on."""
        return parse_hierarchy(self.hierarchy) is Hierarchy.NESTED

    @property
    def joint_share(self) -> float:
        """Of each residual stage, 0 to 1."""
        return joint_share(self.joint, parse_hierarchy(self.hierarchy))

    @property
    def coarse_factor(self) -> float:
        """On densification thresholds, for each halving."""
        return coarse_factor(self.coarse_threshold, parse_hierarchy(self.hierarchy))

    @property
    def inheritance(self) -> str:
        """What a level starts from, a mode of `inheritance.inherit`."""
        return "full" if self.nested else self.inherit

    def joint_from(self, stage: Stage) -> int | None:
        """The iteration of a stage from which the finished fields are trained along; None when they never are."""
        return joint_from(stage, self.joint_share, parse_supervision(self.supervision))

    def shares(self) -> tuple[Fraction, ...] | None:
        """Of the iterations for each stage, coarsest first; None leaves them to `StagePlan`."""
        if self.split is not None:
            return parse_split(self.split)
        return PAPER_SPLIT if self.levels == len(PAPER_SPLIT) and not self.nested else None

    def for_manifest(self) -> dict[str, Any]:
        """What the manifest has under "settings", with nothing left to the hierarchy."""
        values = {**asdict(self), "joint": self.joint_share, "coarse_threshold": self.coarse_factor}
        return {name: value for name, value in values.items() if name not in IN_MANIFEST}


@dataclass(frozen=True)
class RunContext:
    """What all stages of a run share.

    Attributes:
        adapter: of the checkout.
        options: of the hierarchy.
        device: where the checkout renders.
        album: the images of its scene.
        shim: between its render and its rasterizer.
        hooks: of the user.
        parts: told which part of an iteration begins.
        test_every: iterations between two measurements of held-out views; None measures them at the end of the run.
        watcher: may look at the fields between iterations.
    """

    adapter: BackboneAdapter
    options: HierarchyOptions
    device: torch.device
    album: PhotoAlbum
    shim: RasterizerShim
    hooks: HookCaller
    parts: IterationParts
    watcher: Watcher
    test_every: int | None

    def image(
        self, rendering: StageRendering, call: TrainingCall, view: Any, gaussians: Any, background: Tensor
    ) -> Tensor:
        """(3, h, w) what the checkout's render makes of a view, before exposure or clamping.

        Args:
            rendering: takes the running stage's place meanwhile; it captures.
            call: of the script's `training`, as the stage of these Gaussians made it.
            view: the checkout's camera at that stage's level.
            gaussians: the checkout's model.
            background: (3,) behind them.
        """
        outer, self.shim.stage = self.shim.stage, rendering
        try:
            self.adapter.render(call, view, gaussians, background)
        finally:
            self.shim.stage = outer
        image, rendering.captured = rendering.captured, None
        assert image is not None, "a rendering that captures"
        return image


@dataclass(frozen=True)
class LoadedScene:
    """A checkout's scene, its cameras without images."""

    scene: Any
    points: Any  # the checkout's BasicPointCloud
    others: tuple[Any, ...]  # what create_from_pcd takes after the points

    @property
    def train(self) -> list[Any]:
        return list(self.scene.getTrainCameras())

    @property
    def test(self) -> list[Any]:
        return list(self.scene.getTestCameras())


@dataclass(frozen=True)
class Finished:
    """What a stage leaves for the next one.

    Attributes:
        field: its Gaussians, on the CPU.
        predictions: Up(I_hat^l) of every view by key; None after the finest level, and where levels are nested.
        carried: attributes for the next model.
        moments: optimizer state by parameter group, for full inheritance.
    """

    field: GaussianField
    predictions: UpsampledImages | None
    carried: Mapping[str, Any]
    moments: Mapping[str, dict[str, Tensor]]
