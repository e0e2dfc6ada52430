"""What a user can choose for a built-in training run, and what each stage's schedule makes of it."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from typing import Any

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

ADAM_EPS = 1e-15
"""Epsilon of Adam, 3DGS's."""
LATE_SHARE = 0.25
"""Of a stage, its last, in which the gradients of some views make one step, once densification has ended. Positions
hardly move any more, and what single views disagree about is noise; earlier, steps are what is short."""
MOST_VIEWS = 8
"""Of one step, where the size of the images decides how many."""
PIXELS_OF_A_STEP = 1 << 20
"""Of all its views together, where that decides: about what it takes to keep a GPU busy while it is given its work."""
PIXELS_OF_A_LAUNCH = 1 << 22
"""Of views that are rendered at once. More of them would take memory and no less time."""
ROOT_SCALING = True
"""Whether steps for several views are longer and remember less, see `StepScale`. False is for measurements: then
gradients are averaged, and rates and moments are those of one view."""
LEAST_STEPS = 40
"""In that share. Shorter stages step with every view: on the sample scene, 1,000 iterations, 40 steps of fewer views
lost 0.08 dB, of one field 0.13."""
REFERENCE_ITERATIONS = 30_000
"""Length of the run that 3DGS's published schedule was made for; shorter runs shrink its constants in proportion."""

STRATEGIES = ("default", "mcmc", "multiview")
ABSGRAD_THRESHOLD = 8e-4
"""What `grow_grad2d` becomes for absolute gradients, which do not cancel and are larger: gsplat's recommendation."""

AUTO = "auto"
"""Where predictions are kept and how precisely, left to the device."""

_KIND = {"--densify-threshold": "gradient", "--split-threshold": "gradient", "--error-pixels": "number"}

IN_MANIFEST = ("levels", "grid", "supervision", "inherit", "sh_degree", "seed")
"""Settings that the manifest has fields of its own for."""


@dataclass(frozen=True)
class LearningRates:
    """Adam step sizes, as 3DGS publishes them. Positions are in units of the scene's extent."""

    means_first: float = 1.6e-4
    means_last: float = 1.6e-6
    sh: float = 2.5e-3  # coefficients above degree 0 take a twentieth of it, times the factor below
    residual_sh: float = 1e-2  # the same for residual fields, which start from zero colour and have fewer iterations
    opacities: float = 5e-2
    scales: float = 5e-3
    quats: float = 1e-3
    sh_rest_factor: float = 1.0  # on the twentieth
    sh_rest_decay: bool = False  # whether that factor goes exponentially to 1 within each stage


@dataclass(frozen=True)
class StepScale:
    """How Adam's step for the summed gradients of several views differs from a step for one.

    For v views this is the square-root scaling of Malladi et al. 2022, which Grendel-GS uses (Zhao et al. 2024): step
    sizes times sqrt(v), betas to the power of v, epsilon over sqrt(v), with the mean of the gradients. Here the sum
    over sqrt(v) takes the place of the mean, and epsilon stays as it is. That is the same step, and its moments have
    the size of one view's, so v may change from step to step. Adam's count rises by v, so its bias correction is that
    of beta to the power of all views so far.

    Attributes:
        views: how many views of progress the step is: the power of the betas, and by how much Adam's count rises.
        gradient: factor on the sum of the views' gradients.
        rate: factor on step sizes.
    """

    views: int = 1
    gradient: float = 1.0
    rate: float = 1.0

    @classmethod
    def of(cls, views: int) -> StepScale:
        """For the sum of so many views' gradients."""
        if not ROOT_SCALING:
            return cls(gradient=1 / views)
        return cls(views, 1 / math.sqrt(views), math.sqrt(views))


ONE_VIEW = StepScale()


@dataclass(frozen=True)
class Densification:
    """When Gaussians are cloned, split, pruned and reset, in iterations of a whole run (see `StageSchedule`).

    None takes 3DGS's constant for 30,000 iterations (500, 15,000, 3,000), shrunk in proportion for shorter runs; for
    "mcmc" the second is 25,000. `every` never shrinks: its statistics need about that many views.

    Opacities of residual stages, and of nested levels after the first, are reset only where `reset_every` is given: the
    base was rid of floaters already, and what is left is to be refined.
    """

    start: int | None = None
    until: int | None = None
    every: int = 100
    reset_every: int | None = None  # 0: never
    grow_grad2d: float = 2e-4  # threshold on the screen-space gradient, in normalised device coordinates
    coarse_threshold: float | None = None  # factor on it each time that images are halved; None: by the hierarchy
    residual_threshold: float = 1.0  # factor on it in residual stages
    base_share: float | None = None  # of the base's iterations, in which it densifies; None: as all stages do
    strategy: str = "default"  # 3DGS's heuristics, "mcmc" (Kheradmand et al. 2024), or "multiview", see `multiview`
    absgrad: bool = False  # threshold the sum of absolute gradients instead (AbsGS)
    cap_max: int = 1_000_000  # most Gaussians of a field, for "mcmc"
    base_cap_max: int | None = None  # of the base; None: the same
    split_absgrad2d: float = ABSGRAD_THRESHOLD  # threshold for splits, on absolute gradients, for "multiview"
    error_threshold: float = 0.1  # of a view's largest error: a pixel above it is badly shown, for "multiview"
    error_pixels: float = 0.1  # that a Gaussian must make up in a view, on average, to be cloned or split
    prune: float = 0.0  # share of what is seen that goes when densification ends, see `pruning`


@dataclass(frozen=True)
class TrainSettings:
    """Everything that decides the result of a run besides the scene."""

    iterations: int = 30_000
    levels: int = 2
    hierarchy: str = DEFAULT_HIERARCHY.value
    split: tuple[str, ...] | None = None  # shares as text ("1/3"), so that the manifest keeps them exactly
    grid: str = "camera"
    supervision: str = "reconstructed"
    inherit: str = "geometry"
    inherit_ratio: float = 1.0
    joint: float = 0.0  # share of a residual stage, its last, in which finished fields are trained along
    gather: int = 8  # views whose gradients make one step late in a stage
    views_per_step: int | None = 1  # before that; None: by the size of the images, on a GPU
    sh_degree: int = 3
    base_sh_degree: int | None = None  # of the field that residuals are added to; None: the same
    sh_every: int | None = None  # iterations between two rises of the SH degree; None: 1000 of 30,000
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
            raise UserInputError(
                f"--strategy {self.densification.strategy}: expected {', '.join(STRATEGIES[:-1])} or {STRATEGIES[-1]}"
            )
        if not 0 <= self.sh_degree <= 3:
            raise UserInputError(f"--sh-degree {self.sh_degree}: expected 0, 1, 2 or 3")
        self._check_base_sh_degree()
        check_seed(self.seed)
        check_inheritance(self.inherit, self.inherit_ratio)
        check_joint_share(self.joint)
        if parse_hierarchy(self.hierarchy) is Hierarchy.NESTED:
            require_no_residuals(
                {
                    "--supervision": (self.supervision, "reconstructed"),
                    "--inherit": (f"{self.inherit}:{self.inherit_ratio:g}", "geometry:1"),
                    "--joint": (self.joint, 0.0),
                    "--base-sh-degree": (self.base_sh_degree, None),
                    "--residual-threshold": (self.densification.residual_threshold, 1.0),
                }
            )
        for option, factor in (
            ("--coarse-threshold", self.densification.coarse_threshold),
            ("--residual-threshold", self.densification.residual_threshold),
            ("--sh-rate-factor", self.learning_rates.sh_rest_factor),
            ("--densify-threshold", self.densification.grow_grad2d),
            ("--split-threshold", self.densification.split_absgrad2d),
            ("--error-pixels", self.densification.error_pixels),
        ):
            if factor is not None and not (factor > 0.0 and math.isfinite(factor)):
                raise UserInputError(f"{option} {factor}: expected a positive {_KIND.get(option, 'factor')}")
        if self.learning_rates.sh_rest_decay and self.learning_rates.sh_rest_factor == 1.0:
            raise UserInputError("--sh-rate-decay: there is nothing to decay from; give --sh-rate-factor, such as 8")
        self._check_base_share()
        check_prune_share(self.densification.prune)
        if (resets := self.densification.reset_every) is not None and resets < 0:
            raise UserInputError(f"--opacity-reset-every {resets}: expected a number of iterations, or 0 for never")
        self._check_strategy()
        if self.gather < 1:
            raise UserInputError(f"--gather {self.gather}: expected at least 1, the views of one step")
        if self.views_per_step is not None and self.views_per_step < 1:
            raise UserInputError(f"--views-per-step {self.views_per_step}: expected auto, or at least 1")
        if not 0.0 <= self.ssim_weight <= 1.0:
            raise UserInputError(f"--ssim-weight {self.ssim_weight}: expected 0 (only L1) to 1 (only SSIM)")

    def _check_base_sh_degree(self) -> None:
        degree = self.base_sh_degree
        if degree is None:
            return
        if not 0 <= degree <= self.sh_degree:
            raise UserInputError(f"--base-sh-degree {degree}: expected 0 to --sh-degree, {self.sh_degree}")
        if self.levels == 1:
            raise UserInputError(f"--base-sh-degree {degree}: one level has no base; give --sh-degree")
        if self.inherit == "full" and degree != self.sh_degree:
            raise UserInputError(
                f"--base-sh-degree {degree} with --inherit full: what takes over all coefficients has as many; "
                "inherit geometry or xyz"
            )

    def _check_base_share(self) -> None:
        share = self.densification.base_share
        if share is None:
            return
        if not 0.0 <= share <= 1.0:
            raise UserInputError(f"--base-densify-share {share}: expected a share of the base's iterations from 0 to 1")
        if self.levels == 1:
            raise UserInputError(f"--base-densify-share {share}: one level has no base; give --densify-until")

    def _check_strategy(self) -> None:
        """Refuse what the strategy has no use for."""
        given = self.densification
        if given.strategy != "mcmc":
            for option, value, left_out in (
                ("--cap-max", given.cap_max, Densification.cap_max),
                ("--base-cap-max", given.base_cap_max, None),
            ):
                if value != left_out:
                    raise UserInputError(f"{option} {value}: only --strategy mcmc has a limit; leave it out")
        if given.strategy != "multiview":
            for option, setting, default in (
                ("--split-threshold", given.split_absgrad2d, Densification.split_absgrad2d),
                ("--error-threshold", given.error_threshold, Densification.error_threshold),
                ("--error-pixels", given.error_pixels, Densification.error_pixels),
            ):
                if setting != default:
                    raise UserInputError(f"{option} {setting}: only --strategy multiview looks at it; leave it out")
        elif not 0.0 <= given.error_threshold < 1.0:
            raise UserInputError(
                f"--error-threshold {given.error_threshold}: expected a share of a view's largest error from 0 to "
                "below 1, such as 0.1"
            )
        elif given.absgrad:
            raise UserInputError("--absgrad with --strategy multiview: it splits by absolute gradients as it is")
        if given.strategy != "mcmc":
            return
        idle = {
            "--prune": given.prune,
            "--absgrad": given.absgrad,
            "--coarse-threshold": given.coarse_threshold,
            "--residual-threshold": given.residual_threshold != 1.0,
            "--densify-threshold": given.grow_grad2d != Densification.grow_grad2d and not given.absgrad,
            "--opacity-reset-every": given.reset_every,
        }
        if options := [option for option, value in idle.items() if value]:
            raise UserInputError(
                f"{', '.join(options)} with --strategy mcmc: it moves transparent Gaussians, looks at no gradient and "
                "resets nothing; leave one out"
            )

    def densification_of(self, stage: Stage) -> Densification:
        """Density control of a stage: as set, with thresholds and a limit of its own."""
        given = self.densification
        factor: float = coarse_factor(given.coarse_threshold, parse_hierarchy(self.hierarchy)) ** stage.level
        if stage.signed:
            factor *= given.residual_threshold
        limit = given.base_cap_max if self._is_base(stage) and given.base_cap_max is not None else given.cap_max
        return replace(
            given,
            grow_grad2d=given.grow_grad2d * factor,
            split_absgrad2d=given.split_absgrad2d * factor,
            cap_max=limit,
        )

    def sh_degree_of(self, stage: Stage) -> int:
        """The highest SH degree of a stage's field."""
        return self.base_sh_degree if self._is_base(stage) and self.base_sh_degree is not None else self.sh_degree

    def densify_share_of(self, stage: Stage) -> float | None:
        """The share of its iterations in which a stage densifies, where it has one of its own."""
        return self.densification.base_share if self._is_base(stage) else None

    def _is_base(self, stage: Stage) -> bool:
        """Whether finer levels follow on it, and none came before."""
        return self.levels > 1 and stage.level == self.levels - 1

    def joint_from(self, stage: Stage) -> int | None:
        """The iteration of a stage from which the finished fields are trained along; None when they never are."""
        return joint_from(stage, self.joint, parse_supervision(self.supervision))

    def for_manifest(self) -> dict[str, Any]:
        """The settings as keyword arguments of `Manifest`: those it names itself, and the rest under "settings"."""
        values = asdict(self)
        return {**{name: values.pop(name) for name in IN_MANIFEST}, "settings": values}

    @classmethod
    def from_manifest(cls, manifest: Manifest) -> TrainSettings:
        """The settings a run was started with.

        Raises:
            RunFolderError: they hold a key this version does not know or lack one.
        """
        # Runs of the first weeks know nothing of what came with gsplat, of joint training, gathered views and nesting.
        later: dict[str, Any] = {
            **{"packed": False, "sparse_adam": False, "joint": 0.0, "gather": 1, "hierarchy": "laplacian"},
            **{"base_sh_degree": None, "views_per_step": 1},
        }
        values = {**later, "raster": {}, **manifest.settings, **{name: getattr(manifest, name) for name in IN_MANIFEST}}
        if difference := sorted(set(values) ^ {f.name for f in fields(cls)}):
            raise RunFolderError(
                f"the run was not started by `lapgs train` of this version (settings {', '.join(difference)} do not "
                f"match); continue it with {manifest.created_by}"
            )
        values["learning_rates"] = LearningRates(**values["learning_rates"])
        values["densification"] = Densification(**{"coarse_threshold": None, "prune": 0.0, **values["densification"]})
        values["split"] = None if values["split"] is None else tuple(values["split"])
        return cls(**values)


def views_per_step(settings: TrainSettings, stage: Stage, training_views: int, batches: bool) -> int:
    """How many views make a step of a stage.

    Args:
        settings: what the user asked for.
        stage: by the size of whose images is decided what is left open.
        training_views: how many there are, which what is decided here does not exceed.
        batches: whether the rasterizer takes several views at once; where it does not, one is what is decided.
    """
    asked = settings.views_per_step
    if asked is None:
        pixels = stage.image_size[0] * stage.image_size[1]
        asked = min(MOST_VIEWS, training_views, max(1, round(PIXELS_OF_A_STEP / pixels))) if batches else 1
    return asked


@dataclass(frozen=True)
class StageSchedule:
    """The schedule of one stage: an iteration in, small answers out, no state.

    Inside a stage of n of N iterations densification stops at `until` scaled by n/N and the position learning rate
    decays to its last value at n; the other constants stay as the user set them. Iterations count from 1 in each stage.
    From `gather_from` on the gradients of `gather` views make one step, before that those of `views`: fewer where
    something is due before so many are through.

    A field that was trained before, in `before` iterations of coarser nested levels, keeps its SH degree and stops
    densifying earlier (`plan.nested_densify_until`). Its opacities are not reset unless the user says when: what
    resets are for, floaters near the cameras, was done at the coarser size, and recovering takes iterations. The same
    holds for residuals, which start from the base's geometry or positions.
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
    sh_rest_factor: float
    sh_rest_decay: bool
    gather_from: int
    gather: int
    before: int
    views: int = 1

    @classmethod
    def create(cls, settings: TrainSettings, stage: Stage, before: int = 0, views: int = 1) -> StageSchedule:
        shrink = min(1.0, settings.iterations / REFERENCE_ITERATIONS)
        given = settings.densification

        def constant(chosen: int | None, reference: int, smallest: int) -> int:
            return chosen if chosen is not None else max(smallest, round(reference * shrink))

        resets = constant(given.reset_every, 3000, 300)
        if given.reset_every == 0 or ((before or stage.signed) and given.reset_every is None):
            resets = stage.iterations + 1  # never
        until = constant(given.until, REFERENCE_ITERATIONS * 5 // 6 if given.strategy == "mcmc" else 15_000, 1)
        of_stage = round(until * stage.iterations / settings.iterations)
        if (share := settings.densify_share_of(stage)) is not None:
            of_stage = round(share * stage.iterations)
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
            sh_degree=settings.sh_degree_of(stage),
            means_first=settings.learning_rates.means_first,
            means_last=settings.learning_rates.means_last,
            sh_rest_factor=settings.learning_rates.sh_rest_factor,
            sh_rest_decay=settings.learning_rates.sh_rest_decay,
            gather_from=stage.iterations - late + 1,
            gather=settings.gather if late >= LEAST_STEPS * settings.gather else 1,
            before=before,
            views=views,
        )

    def gathers(self, iteration: int) -> bool:
        """Whether the step that this iteration is part of is one of the late ones, with rates as they are."""
        return self.gather > 1 and iteration >= self.gather_from

    def views_of_step(self, done: int) -> int:
        """How many views the step takes that comes after `done` iterations; at least 1."""
        if self.gathers(done + 1):
            within = (done + 1 - self.gather_from) % self.gather
            return min(self.gather - within, self.iterations - done)
        return 1 if self.views == 1 else min(self.views, self._next_due(done) - done)

    def _next_due(self, done: int) -> int:
        """The first iteration after `done` that ends a step: statistics begin or end with it, or the field changes."""
        due = [self.iterations]
        if done < self.densify_until:
            # Of the iteration `densify_until` no statistics are taken any more, and pruning comes after it.
            due += [(done // every + 1) * every for every in (self.densify_every, self.reset_every)]
            due += [self.densify_until - 1, self.densify_until]
        if self.gather > 1:
            due.append(self.gather_from - 1)
        return min(each for each in (*due, *self.late_prunes) if each > done)

    @property
    def prunes_after(self) -> int | None:
        """The iteration that ends densification; None where there is none, or nothing comes after it."""
        return self.densify_until if self.densify_start < self.densify_until < self.iterations else None

    def means_learning_rate(self, iteration: int) -> float:
        """Log-linear decay from the first iteration to the last, in units of the scene's extent."""
        progress = min(max(iteration / self.iterations, 0.0), 1.0)
        return math.exp((1 - progress) * math.log(self.means_first) + progress * math.log(self.means_last))

    def sh_rest_factor_at(self, iteration: int) -> float:
        """Factor on the rate of SH above degree 0: as set, or from that exponentially to 1 at the stage's end."""
        if not self.sh_rest_decay:
            return self.sh_rest_factor
        left: float = 1.0 - min(iteration / self.iterations, 1.0)
        factor: float = self.sh_rest_factor**left
        return factor

    @cached_property
    def late_prunes(self) -> frozenset[int]:
        """The iterations in which "multiview" prunes once more: every tenth of the stage in its second half, or what
        ends a step after that where views are gathered."""
        found = set()
        for tenth in range(6, 10):
            due = max(round(self.iterations * tenth / 10), self.densify_until + 1)
            if self.gathers(due):
                due += (self.gather_from - 1 - due) % self.gather
            found.add(due)
        return frozenset(due for due in found if due < self.iterations)

    def active_sh_degree(self, iteration: int) -> int:
        return min(self.sh_degree, (self.before + iteration) // self.sh_every)
