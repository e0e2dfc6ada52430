"""Choose how a stage adds and removes Gaussians: strategies by name, with their own options. Imports no torch.

Each strategy here says what differs between strategies in the rest of training; the work is done by the
`densification.DensityControl` that it makes for a stage.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.settings import AUTO, RESIDUAL_OPACITY
from lapgs_plugin.options import check_values, option, option_name, require_positive
from lapgs_plugin.registry import Registry
from lapgs_plugin.untrusted import STRICT

if TYPE_CHECKING:
    from typing_extensions import Self

    from lapgs_plugin.fields.gaussian_field import GaussianField
    from lapgs_plugin.training.densification import DensityControl
    from lapgs_plugin.training.schedule import StageSchedule

PANEL = "Density control"
GROW_THRESHOLD = 2e-4
"""Threshold of densification on screen-space gradients, in normalised device coordinates: 3DGS's."""
ABSGRAD_THRESHOLD = 8e-4
"""Default threshold on absolute gradients, which do not cancel and are larger: gsplat's recommendation."""

PIXELS_A_GAUSSIAN = 16
"""Pixels of the photos for each Gaussian of MCMC: they have about as many values as it has parameters, 48 and 59."""
MOST_GAUSSIANS = 1_000_000
"""Most Gaussians of MCMC by default."""
FEW_PHOTOS = 40
"""Fewer training photos than that leave room for floaters."""
USUAL_EXTENT = 5.0
"""Extent of COLMAP's scenes, on which constants with a length were chosen. A fifth of the scene's extent is their unit,
so that a scene trains alike in any units."""
LONG_RUN = 5_000
"""Iterations from which MCMC is better than 3DGS's heuristics: it starts from tiny Gaussians, and short runs end before
they have grown."""
LONG_RUN_OF_LARGE = 2_500
"""The same for large photos, on which it is sharper by a sixth and more after the same seconds (fox, gold-cape,
south-building on GPUs)."""


@dataclass(frozen=True)
class StagePart:
    """Describe the part of a run that one stage is.

    Attributes:
        threshold_factor: on densification thresholds.
        pixels: of all training images of its level together.
        base: whether it is the coarsest of several levels.
        finest: whether it trains at full size.
        signed: whether it trains a residual.
    """

    threshold_factor: float = 1.0
    pixels: int = 1
    base: bool = False
    finest: bool = True
    signed: bool = False


@dataclass(frozen=True)
class Strategy:
    """Describe one strategy of density control. Subclasses are frozen dataclasses whose fields are its options.

    Fields that are declared with `options.option` become options of `lapgs train`. Two strategies have the same option
    only where one inherits it from the other.

    Attributes:
        densify_until: last densification of a run of `plan.REFERENCE_ITERATIONS`, unless --densify-until says it.
        unused: settings of a run, by field name, that have no effect with it; a user who sets one is told.
        few_dropout: default of `TrainSettings.dropout` for fewer than `FEW_PHOTOS` training photos.
        residual_joint: default of `TrainSettings.joint`; None for the hierarchy's.
        residual_color_rate: default of `TrainSettings.residual_color_rate`; None for the hierarchy's.
        large_split: default of `TrainSettings.split` of two levels for large images; None for that of all others.
        shards: whether it can edit shards of a field, each by itself, and at the same iterations.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    densify_until: ClassVar[int] = 15_000
    unused: ClassVar[tuple[str, ...]] = ()
    few_dropout: ClassVar[float] = 0.0
    residual_joint: ClassVar[float | None] = None
    residual_color_rate: ClassVar[float | None] = None
    large_split: ClassVar[str | None] = None
    shards: ClassVar[bool] = False

    @property
    def needs_absgrad(self) -> bool:
        """Whether the rasterizer has to compute `RenderResult.absgrad2d`."""
        return False

    def check(self) -> None:
        """Raise a UserInputError about an option that is out of range."""
        check_values(self)

    def of_stage(self, part: StagePart) -> Self:
        """Return the options of one stage."""
        return self

    def of_shard(self, shards: int) -> Self:
        """Return the options of one of so many equal shards of a field, given the result of `of_stage`."""
        return self

    @property
    def most(self) -> int | None:
        """Limit on the Gaussians of a stage, of the result of `of_stage`; None without one."""
        return None

    def start(self, field: GaussianField, photos: int) -> GaussianField:
        """Return the field to train on so many photos, given one that was made from points."""
        return field

    def density_control(self, schedule: StageSchedule, extent: float) -> DensityControl:
        """Return the density control of one stage. Called on the result of `of_stage`.

        Args:
            schedule: of the stage.
            extent: of the scene, in world units.

        Raises:
            UserInputError: a subclass does not override it.
        """
        raise UserInputError(f"strategy {type(self).__qualname__} has no method density_control; it has to make one")


@dataclass(frozen=True)
class Regularized(Strategy):
    """Add the mean opacity and the mean standard deviation of Gaussians to the loss."""

    default_weight: ClassVar[float] = 0.0

    opacity_regularization: float | None = option(
        None,
        "Weight of the mean opacity in the loss, which makes Gaussians transparent that are not needed. Default: 0.01 "
        f"with --strategy mcmc, and {RESIDUAL_OPACITY} times that in its residual levels; else 0. "
        "Residual levels with mcmc leave it out in the first fiftieth of their densification, and multiply it by the "
        "share of their Gaussians that are left.",
        panel=PANEL,
        least=0.0,
    )
    scale_regularization: float | None = option(
        None,
        "Weight of the mean standard deviation of Gaussians in the loss, in fifths of the scene's extent. Default: "
        "0.01 with --strategy mcmc, else 0.",
        panel=PANEL,
        least=0.0,
    )

    @property
    def opacity_weight(self) -> float:
        """Weight of the mean opacity in the loss."""
        return self.default_weight if self.opacity_regularization is None else self.opacity_regularization

    @property
    def scale_weight(self) -> float:
        """Weight of the mean standard deviation in the loss."""
        return self.default_weight if self.scale_regularization is None else self.scale_regularization


@dataclass(frozen=True)
class Gradients(Regularized):
    """Clone and split by screen-space gradients, prune by opacity and size: 3DGS's heuristics, by gsplat."""

    shards: ClassVar[bool] = True

    grow_grad2d: float | None = option(
        None,
        "Screen-space gradient, in normalised device coordinates, above which --strategy 3dgs clones or splits a "
        f"Gaussian, and multiview clones it. Default: {GROW_THRESHOLD:g}, and {ABSGRAD_THRESHOLD:g} with --absgrad.",
        panel=PANEL,
        names=("--densify-threshold",),
    )
    absgrad: bool = option(False, "With --strategy 3dgs: densify by absolute gradients (AbsGS).", panel=PANEL)

    @property
    def needs_absgrad(self) -> bool:
        return self.absgrad

    def check(self) -> None:
        super().check()
        if self.grow_grad2d is not None:
            require_positive("--densify-threshold", self.grow_grad2d, "gradient")

    def of_stage(self, part: StagePart) -> Self:
        whole = self.grow_grad2d or (ABSGRAD_THRESHOLD if self.absgrad else GROW_THRESHOLD)
        return replace(self, grow_grad2d=whole * part.threshold_factor)

    def density_control(self, schedule: StageSchedule, extent: float) -> DensityControl:
        from lapgs_plugin.training.densification import Densifier

        return Densifier(schedule, self, extent)


@dataclass(frozen=True)
class Multiview(Gradients):
    """Clone and split only where several views have large errors: the idea of FastGS (Ren et al. 2025)."""

    shards: ClassVar[bool] = False  # scores are of views that other ranks have

    split_absgrad2d: float = option(
        ABSGRAD_THRESHOLD,
        "Absolute gradient above which --strategy multiview splits a large Gaussian.",
        panel=PANEL,
        names=("--split-threshold",),
    )
    error_threshold: float = option(
        0.1, "Share of the range of a view's errors above which --strategy multiview counts a pixel.", panel=PANEL
    )
    error_pixels: float = option(
        0.1,
        "Counted pixels, mean over views, that a Gaussian must make up for --strategy multiview to clone or split it.",
        panel=PANEL,
    )

    @property
    def needs_absgrad(self) -> bool:
        return True

    def check(self) -> None:
        super().check()
        require_positive("--split-threshold", self.split_absgrad2d, "gradient")
        require_positive("--error-pixels", self.error_pixels, "number")
        if not 0.0 <= self.error_threshold < 1.0:
            raise UserInputError(
                f"--error-threshold {self.error_threshold}: expected a share of the range of a view's errors "
                "from 0 to below 1, such as 0.1"
            )
        if self.absgrad:
            raise UserInputError("--absgrad with --strategy multiview: it splits by absolute gradients anyway")

    def of_stage(self, part: StagePart) -> Self:
        split = self.split_absgrad2d * part.threshold_factor
        return replace(super().of_stage(part), split_absgrad2d=split)

    def density_control(self, schedule: StageSchedule, extent: float) -> DensityControl:
        from lapgs_plugin.training.multiview import MultiviewDensifier

        return MultiviewDensifier(schedule, self, extent)


@dataclass(frozen=True)
class Mcmc(Regularized):
    """Move transparent Gaussians to opaque ones and add some up to a limit (Kheradmand et al. 2024)."""

    densify_until: ClassVar[int] = 25_000
    default_weight: ClassVar[float] = 0.01
    few_dropout: ClassVar[float] = 0.2
    residual_joint: ClassVar[float | None] = 0.5
    residual_color_rate: ClassVar[float | None] = 1.0
    large_split: ClassVar[str | None] = "2/3,1/3"
    shards: ClassVar[bool] = True
    unused: ClassVar[tuple[str, ...]] = (
        *("prune", "coarse_threshold", "residual_threshold", "residual_resets", "reset_every"),
    )

    cap_max: int | None = option(
        None,
        f"Most Gaussians of a level, for --strategy mcmc. Default: one for each {PIXELS_A_GAUSSIAN} pixels of the "
        f"level's training images, at most {MOST_GAUSSIANS}, in coarser levels {MOST_GAUSSIANS // 2}. A level that "
        "starts with more keeps them.",
        panel=PANEL,
        least=1,
    )
    base_cap_max: int | None = option(
        None,
        "Most Gaussians of the coarsest level, for --strategy mcmc. Default: that of --cap-max.",
        panel=PANEL,
        least=1,
    )

    @property
    def needs_absgrad(self) -> bool:
        return True

    def of_stage(self, part: StagePart) -> Self:
        own = self.base_cap_max if part.base and self.base_cap_max is not None else self.cap_max
        most = MOST_GAUSSIANS if part.finest else MOST_GAUSSIANS // 2
        limit = own or max(1, min(most, part.pixels // PIXELS_A_GAUSSIAN))
        weight = self.opacity_regularization
        if weight is None and part.signed:
            weight = RESIDUAL_OPACITY * self.default_weight
        return replace(self, cap_max=limit, opacity_regularization=weight)

    def of_shard(self, shards: int) -> Self:
        assert self.cap_max is not None, "`of_stage` sets it"
        return replace(self, cap_max=max(1, self.cap_max // shards))

    @property
    def most(self) -> int | None:
        return self.cap_max

    def start(self, field: GaussianField, photos: int) -> GaussianField:
        from lapgs_plugin.training.mcmc import START_SCALE, mcmc_start

        # Few photos do not correct what tiny Gaussians with space between them grow into.
        return mcmc_start(field, 1.0 if photos < FEW_PHOTOS else START_SCALE)

    def density_control(self, schedule: StageSchedule, extent: float) -> DensityControl:
        from lapgs_plugin.training.mcmc import McmcDensifier

        return McmcDensifier(schedule, self, extent)


@dataclass(frozen=True)
class Auto(Mcmc, Gradients):
    """Choose between MCMC and 3DGS's heuristics by the length of a run, and by options that only one of them has."""

    def choose(self, iterations: int, heuristics: Sequence[str]) -> str:
        """Return the name of the strategy to train with.

        Args:
            iterations: of the run.
            heuristics: options that were given and that only 3DGS's heuristics have, besides those declared here.

        Raises:
            UserInputError: options of both were given.
        """
        values = {declared.name: (option_name(declared), getattr(self, declared.name)) for declared in fields(self)}
        asked = {name: shown for name, (shown, value) in values.items() if value is not None and value is not False}
        limits = [asked[name] for name in ("cap_max", "base_cap_max") if name in asked]
        heuristics = [*(asked[name] for name in ("grow_grad2d", "absgrad") if name in asked), *heuristics]
        if limits and heuristics:
            raise UserInputError(
                f"{limits[0]} is an option of --strategy {MCMC}, which does not take {', '.join(heuristics)}; leave "
                "one out"
            )
        if heuristics:
            return GRADIENTS
        return MCMC if limits or iterations >= LONG_RUN else GRADIENTS

    def options_for(self, name: str) -> Strategy:
        """Return those options that a strategy has."""
        kind = type(STRATEGIES[name])
        return kind(**{declared.name: getattr(self, declared.name) for declared in fields(kind)})


MCMC, GRADIENTS = "mcmc", "3dgs"
STRATEGIES: Registry[Strategy] = Registry(
    "--strategy",
    "lapgs_plugin.strategies",
    Strategy,
    {AUTO: Auto(), MCMC: Mcmc(), GRADIENTS: Gradients(), "multiview": Multiview()},
)
"""Strategies by name. Other packages add instances of `Strategy` as entry points of this group."""
