"""What a user can choose for a built-in training run, and what each stage's schedule makes of it."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, ClassVar

from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.hierarchy.inheritance import check_inheritance
from lapgs_plugin.hierarchy.plan import (
    DEFAULT_HIERARCHY,
    Hierarchy,
    Stage,
    check_joint_share,
    check_prune_share,
    check_seed,
    coarse_factor,
    nested_densify_until,
    parse_hierarchy,
    require_no_residuals,
)
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.hierarchy.supervision import joint_from, parse_supervision
from lapgs_plugin.runs.archive import Manifest
from lapgs_plugin.untrusted import STRICT, checked

ADAM_EPS = 1e-15
"""Epsilon of Adam, 3DGS's."""
LATE_SHARE = 0.25
"""Of a stage, its last, in which the gradients of some views make one step, once densification has ended. Positions
hardly move any more, and what single views disagree about is noise; earlier, steps are what is short."""
LEAST_STEPS = 40
"""In that share. Shorter stages step with every view: on the sample scene, 1,000 iterations, 40 steps of fewer views
lost 0.08 dB, of one field 0.13."""
REFERENCE_ITERATIONS = 30_000
"""Length of the run that 3DGS's published schedule was made for; shorter runs shrink its constants in proportion."""

STRATEGIES = ("default", "mcmc")
ABSGRAD_THRESHOLD = 8e-4
"""What `grow_grad2d` becomes for absolute gradients, which do not cancel and are larger: gsplat's recommendation."""

AUTO = "auto"
"""Where predictions are kept and how precisely, left to the device."""

IN_MANIFEST = ("levels", "grid", "supervision", "inherit", "sh_degree", "seed")
"""Settings that the manifest has fields of its own for."""


@dataclass(frozen=True)
class LearningRates:
    """Adam step sizes, as 3DGS publishes them. Positions are in units of the scene's extent."""

    __pydantic_config__: ClassVar[Any] = STRICT

    means_first: PositiveFloat = 1.6e-4
    means_last: PositiveFloat = 1.6e-6
    sh: PositiveFloat = 2.5e-3  # coefficients above degree 0 take a twentieth of it
    residual_sh: PositiveFloat = 1e-2  # of residual fields, which start from zero colour and have fewer iterations
    opacities: PositiveFloat = 5e-2
    scales: PositiveFloat = 5e-3
    quats: PositiveFloat = 1e-3


@dataclass(frozen=True)
class Densification:
    """When Gaussians are cloned, split, pruned and reset, in iterations of a whole run (see `StageSchedule`).

    None takes 3DGS's constant for 30,000 iterations (500, 15,000, 3,000), shrunk in proportion for shorter runs; for
    "mcmc" the second is 25,000. `every` never shrinks: its statistics need about that many views.
    """

    __pydantic_config__: ClassVar[Any] = STRICT

    start: NonNegativeInt | None = None
    until: NonNegativeInt | None = None
    every: PositiveInt = 100
    reset_every: NonNegativeInt | None = None  # 0: never
    grow_grad2d: NonNegativeFloat = 2e-4  # threshold on the screen-space gradient, in normalised device coordinates
    coarse_threshold: float | None = None  # factor on it each time that images are halved; None: by the hierarchy
    strategy: str = "default"  # 3DGS's heuristics, or "mcmc" (Kheradmand et al. 2024)
    absgrad: bool = False  # threshold the sum of absolute gradients instead (AbsGS)
    cap_max: PositiveInt = 1_000_000  # most Gaussians of a field, for "mcmc"
    prune: float = 0.0  # share of what is seen that goes when densification ends, see `pruning`


@dataclass(frozen=True)
class TrainSettings:
    """Everything that decides the result of a run besides the scene."""

    __pydantic_config__: ClassVar[Any] = STRICT

    iterations: PositiveInt = 30_000
    levels: int = 2
    hierarchy: str = DEFAULT_HIERARCHY.value
    split: tuple[str, ...] | None = None  # shares as text ("1/3"), so that the manifest keeps them exactly
    grid: str = "camera"
    supervision: str = "reconstructed"
    inherit: str = "geometry"
    inherit_ratio: float = 1.0
    joint: float = 0.0  # share of a residual stage, its last, in which finished fields are trained along
    gather: int = 8  # views whose gradients make one step late in a stage
    sh_degree: int = 3
    sh_every: PositiveInt | None = None  # iterations between two rises of the SH degree; None: 1000 of 30,000
    ssim_weight: float = 0.2
    seed: int = 0
    cache: str = AUTO
    cache_precision: str = AUTO
    learning_rates: LearningRates = field(default_factory=LearningRates)
    densification: Densification = field(default_factory=Densification)
    packed: bool = False  # gsplat: keep what is computed of visible Gaussians alone
    sparse_adam: bool = False  # gsplat: step visible Gaussians alone
    raster: dict[str, Any] = field(default_factory=dict)  # what images depend on, as {"antialiasing": True}

    def __post_init__(self) -> None:
        parse_supervision(self.supervision)
        Pyramid(self.grid)
        if self.densification.strategy not in STRATEGIES:
            raise UserInputError(f"--strategy {self.densification.strategy}: expected {' or '.join(STRATEGIES)}")
        if not 0 <= self.sh_degree <= 3:
            raise UserInputError(f"--sh-degree {self.sh_degree}: expected 0, 1, 2 or 3")
        check_seed(self.seed)
        check_inheritance(self.inherit, self.inherit_ratio)
        check_joint_share(self.joint)
        if parse_hierarchy(self.hierarchy) is Hierarchy.NESTED:
            require_no_residuals(
                {
                    "--supervision": (self.supervision, "reconstructed"),
                    "--inherit": (f"{self.inherit}:{self.inherit_ratio:g}", "geometry:1"),
                    "--joint": (self.joint, 0.0),
                }
            )
        factor = self.densification.coarse_threshold
        if factor is not None and not (factor > 0.0 and math.isfinite(factor)):
            raise UserInputError(f"--coarse-threshold {factor}: expected a positive factor")
        check_prune_share(self.densification.prune)
        if (resets := self.densification.reset_every) is not None and resets < 0:
            raise UserInputError(f"--opacity-reset-every {resets}: expected a number of iterations, or 0 for never")
        self._check_strategy()
        if self.gather < 1:
            raise UserInputError(f"--gather {self.gather}: expected at least 1, the views of one step")
        if not 0.0 <= self.ssim_weight <= 1.0:
            raise UserInputError(f"--ssim-weight {self.ssim_weight}: expected 0 (only L1) to 1 (only SSIM)")

    def _check_strategy(self) -> None:
        """Refuse what the strategy has no use for."""
        given = self.densification
        if given.strategy != "mcmc":
            if given.cap_max != Densification.cap_max:
                raise UserInputError(f"--cap-max {given.cap_max}: only --strategy mcmc has a limit; leave it out")
            return
        idle = {
            "--prune": given.prune,
            "--absgrad": given.absgrad,
            "--coarse-threshold": given.coarse_threshold,
            "--opacity-reset-every": given.reset_every,
        }
        if options := [option for option, value in idle.items() if value]:
            raise UserInputError(
                f"{', '.join(options)} with --strategy mcmc: it moves transparent Gaussians, looks at no gradient and "
                "resets nothing; leave one out"
            )

    def densification_of(self, stage: Stage) -> Densification:
        """Density control of a stage: as set, with a threshold for its size."""
        factor = coarse_factor(self.densification.coarse_threshold, parse_hierarchy(self.hierarchy))
        return replace(self.densification, grow_grad2d=self.densification.grow_grad2d * factor**stage.level)

    def joint_from(self, stage: Stage) -> int | None:
        """The iteration of a stage from which the finished fields are trained along; None when they never are."""
        return joint_from(stage, self.joint, parse_supervision(self.supervision))

    def for_manifest(self) -> dict[str, Any]:
        """The settings as keyword arguments of `Manifest`: those it names itself, and the rest under "settings"."""
        values = asdict(self)
        return {**{name: values.pop(name) for name in IN_MANIFEST}, "settings": values}

    @classmethod
    def from_manifest(cls, manifest: Manifest, name: str = "the run's manifest") -> TrainSettings:
        """The settings a run was started with.

        Raises:
            RunFolderError: they hold a key this version does not know, lack one, or one has another type.
        """
        # Runs of the first weeks know nothing of what came with gsplat, of joint training, gathered views and nesting.
        later = {"packed": False, "sparse_adam": False, "joint": 0.0, "gather": 1, "hierarchy": "laplacian"}
        values = {**later, "raster": {}, **manifest.settings, **{name: getattr(manifest, name) for name in IN_MANIFEST}}
        if difference := sorted(set(values) ^ {f.name for f in fields(cls)}):
            raise RunFolderError(
                f"{name}: the run was not started by `lapgs train` of this version (settings {', '.join(difference)} "
                f"do not match); continue it with {manifest.created_by}"
            )
        settings: TrainSettings = checked(
            {**values, "split": list(split) if isinstance(split := values["split"], tuple) else split},
            cls,
            name,
            error=RunFolderError,
            advice="restore it or train again with --overwrite",
        )
        return settings


@dataclass(frozen=True)
class StageSchedule:
    """The schedule of one stage: an iteration in, small answers out, no state.

    Inside a stage of n of N iterations densification stops at `until` scaled by n/N and the position learning rate
    decays to its last value at n; the other constants stay as the user set them. Iterations count from 1 in each stage.
    From `gather_from` on the gradients of `gather` views make one step.

    A field that was trained before, in `before` iterations of coarser nested levels, keeps its SH degree and stops
    densifying earlier (`plan.nested_densify_until`). Its opacities are not reset unless the user says when: what
    resets are for, floaters near the cameras, was done at the coarser size, and recovering takes iterations.
    """

    iterations: int
    densify_start: int
    densify_until: int
    densify_every: int
    reset_every: int
    sh_every: int
    sh_degree: int
    means_first: float
    means_last: float
    gather_from: int
    gather: int
    before: int

    @classmethod
    def create(cls, settings: TrainSettings, stage: Stage, before: int = 0) -> StageSchedule:
        shrink = min(1.0, settings.iterations / REFERENCE_ITERATIONS)
        given = settings.densification

        def constant(chosen: int | None, reference: int, smallest: int) -> int:
            return chosen if chosen is not None else max(smallest, round(reference * shrink))

        resets = constant(given.reset_every, 3000, 300)
        if given.reset_every == 0 or (before and given.reset_every is None):
            resets = stage.iterations + 1  # never
        until = constant(given.until, REFERENCE_ITERATIONS * 5 // 6 if given.strategy == "mcmc" else 15_000, 1)
        of_stage = round(until * stage.iterations / settings.iterations)
        densify_until = nested_densify_until(of_stage) if before else of_stage
        # A refinement replaces parameters, and with them the gradients that wait for those of other views.
        late = max(0, min(round(stage.iterations * LATE_SHARE), stage.iterations - densify_until))
        return cls(
            iterations=stage.iterations,
            densify_start=constant(given.start, 500, 1),
            densify_until=densify_until,
            densify_every=given.every,
            reset_every=resets,
            sh_every=constant(settings.sh_every, 1000, 1),
            sh_degree=settings.sh_degree,
            means_first=settings.learning_rates.means_first,
            means_last=settings.learning_rates.means_last,
            gather_from=stage.iterations - late + 1,
            gather=settings.gather if late >= LEAST_STEPS * settings.gather else 1,
            before=before,
        )

    def steps(self, iteration: int) -> bool:
        """Whether the optimizers step after this iteration."""
        late = iteration - self.gather_from + 1
        return late < 1 or late % self.gather == 0 or iteration == self.iterations

    @property
    def prunes_after(self) -> int | None:
        """The iteration that ends densification; None where there is none, or nothing comes after it."""
        return self.densify_until if self.densify_start < self.densify_until < self.iterations else None

    def means_learning_rate(self, iteration: int) -> float:
        """Log-linear decay from the first iteration to the last, in units of the scene's extent."""
        progress = min(max(iteration / self.iterations, 0.0), 1.0)
        return math.exp((1 - progress) * math.log(self.means_first) + progress * math.log(self.means_last))

    def active_sh_degree(self, iteration: int) -> int:
        return min(self.sh_degree, (self.before + iteration) // self.sh_every)
