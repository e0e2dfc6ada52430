"""What a user can choose for a built-in training run, and what each stage's schedule makes of it. Imports no torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.hierarchy.plan import (
    REFERENCE_DENSIFY_FROM,
    REFERENCE_ITERATIONS,
    Hierarchy,
    Stage,
    nested_densify_until,
)
from lapgs_plugin.hierarchy.settings import AUTO, HierarchySettings
from lapgs_plugin.options import check_bounds, option
from lapgs_plugin.runs.options import PANEL as RUN
from lapgs_plugin.runs.options import MeasuringOptions
from lapgs_plugin.untrusted import STRICT, checked

if TYPE_CHECKING:
    from lapgs_plugin.runs.archive import Manifest

LATE_SHARE = 0.25
"""Of a stage, its last, in which the gradients of some views make one step, once densification has ended. Positions
hardly move any more, and what single views disagree about is noise; earlier, steps are what is short."""
VIEWS_OF_RATE = 32
MOST_RATE = 8.0
"""SH above degree 0 learn faster in proportion to training views, from the first number on and up to the second: few
views do not determine how colours depend on direction."""
MOST_VIEWS = 8
"""Of one step, where the size of the images decides how many."""
PIXELS_OF_A_STEP = 1 << 22
"""Of all its views together, where that decides."""
STEPS_OF_A_STAGE = 900
"""The fewest, where that decides: a short stage steps for fewer views."""
PIXELS_OF_A_LAUNCH = 1 << 22
"""Of views that are rendered at once. More of them would take memory and no less time."""
LEAST_STEPS = 40
"""In that share. Shorter stages step with every view: on the sample scene, 1,000 iterations, 40 steps of fewer views
lost 0.08 dB, of one field 0.13."""

STRATEGIES = ("default", "mcmc", "multiview")
GROW_THRESHOLD = 2e-4
"""Threshold of densification on screen-space gradients, in normalised device coordinates: 3DGS's."""
ABSGRAD_THRESHOLD = 8e-4
"""What `grow_grad2d` becomes for absolute gradients, which do not cancel and are larger: gsplat's recommendation."""

ANTIALIASING = "antialiasing"
"""Key of `TrainSettings.raster`, as rasterizers and manifests call it."""

SCHEDULE = "Schedule"
GSPLAT = "gsplat"

IN_MANIFEST = ("levels", "grid", "supervision", "inherit", "sh_degree", "seed")
"""Settings that the manifest has fields of its own for."""


@dataclass(frozen=True)
class LearningRates:
    """Adam step sizes, as 3DGS publishes them. Positions are in units of the scene's extent."""

    __pydantic_config__: ClassVar[Any] = STRICT

    means_first: float = 1.6e-4
    means_last: float = 1.6e-6
    sh: float = 2.5e-3  # coefficients above degree 0 take a twentieth of it, times the factor below
    residual_sh: float = 1e-2  # the same for residual fields: `TrainSettings.rates` sets it
    opacities: float = 5e-2
    scales: float = 5e-3
    quats: float = 1e-3

    def check(self) -> None:
        """Raise a UserInputError about a rate that is not positive."""
        for each in fields(self):
            if not getattr(self, each.name) > 0:
                raise UserInputError(f"{each.name} {getattr(self, each.name)}: expected a positive learning rate")


@dataclass(frozen=True)
class Densification:
    """When Gaussians are cloned, split, pruned and reset, in iterations of a whole run (see `StageSchedule`).

    None takes 3DGS's constant for 30,000 iterations (500, 15,000, 3,000), shrunk in proportion for shorter runs; for
    "mcmc" the second is 25,000. `every` never shrinks: its statistics need about that many views.
    """

    __pydantic_config__: ClassVar[Any] = STRICT

    start: int | None = option(
        None,
        f"First densification. Default: {REFERENCE_DENSIFY_FROM} of {REFERENCE_ITERATIONS}.",
        panel=SCHEDULE,
        names=("--densify-from",),
        least=0,
    )
    until: int | None = option(
        None,
        "Last densification, of the whole run; stages scale it. Default: 15000 of 30000.",
        panel=SCHEDULE,
        names=("--densify-until",),
        least=0,
    )
    base_share: float | None = option(
        None,
        "Share of the coarsest level's iterations in which it densifies, from 0 to 1. Default: as all stages, half.",
        panel=SCHEDULE,
        names=("--base-densify-share",),
    )
    every: int = option(
        100, "Iterations between two densifications.", panel=SCHEDULE, names=("--densify-every",), least=1
    )
    reset_every: int | None = option(
        None,
        "Iterations between two resets of all opacities, in every stage; 0 never resets. Default: 3000 of 30000, in "
        "the coarsest level alone.",
        panel=SCHEDULE,
        names=("--opacity-reset-every",),
    )
    grow_grad2d: float | None = option(
        None,
        "Screen-space gradient above which a Gaussian is cloned or split, in normalised device coordinates. Default: "
        f"{GROW_THRESHOLD:g}, and {ABSGRAD_THRESHOLD:g} with --absgrad.",
        panel=SCHEDULE,
        names=("--densify-threshold",),
    )
    strategy: str = option(
        "default",
        "Density control: default (3DGS's heuristics), mcmc (Kheradmand et al. 2024), or multiview (only where several "
        "views have large errors).",
        panel=SCHEDULE,
    )
    absgrad: bool = option(False, "Densify by absolute gradients (AbsGS).", panel=SCHEDULE)
    split_absgrad2d: float = option(
        ABSGRAD_THRESHOLD,
        "Absolute gradient above which --strategy multiview splits a large Gaussian.",
        panel=SCHEDULE,
        names=("--split-threshold",),
    )
    error_threshold: float = option(
        0.1,
        "Share of a view's largest error above which a pixel counts, for --strategy multiview.",
        panel=SCHEDULE,
    )
    error_pixels: float = option(
        0.1,
        "Counted pixels of a view that a Gaussian must make up to be cloned or split, for --strategy multiview.",
        panel=SCHEDULE,
    )
    cap_max: int = option(1_000_000, "Most Gaussians of a level, for --strategy mcmc.", panel=SCHEDULE, least=1)
    base_cap_max: int | None = option(
        None, "Most Gaussians of the coarsest level. Default: --cap-max.", panel=SCHEDULE, least=1
    )

    def check(self) -> None:
        """Raise a UserInputError about a value that is none of what it can be, or that the strategy ignores."""
        check_bounds(self)
        if self.strategy not in STRATEGIES:
            raise UserInputError(
                f"--strategy {self.strategy}: expected {', '.join(STRATEGIES[:-1])} or {STRATEGIES[-1]}"
            )
        for name, value, kind in (
            ("--densify-threshold", self.grow_grad2d, "gradient"),
            ("--split-threshold", self.split_absgrad2d, "gradient"),
            ("--error-pixels", self.error_pixels, "number"),
        ):
            if value is not None:
                _require_positive(name, value, kind)
        if self.base_share is not None and not 0.0 <= self.base_share <= 1.0:
            raise UserInputError(
                f"--base-densify-share {self.base_share}: expected a share of the base's iterations from 0 to 1"
            )
        if self.reset_every is not None and self.reset_every < 0:
            raise UserInputError(
                f"--opacity-reset-every {self.reset_every}: expected a number of iterations, or 0 for never"
            )
        self._refuse_what_the_strategy_ignores()

    def _refuse_what_the_strategy_ignores(self) -> None:
        only = {
            "mcmc": {"cap_max": "has a limit", "base_cap_max": "has a limit"},
            "multiview": dict.fromkeys(("split_absgrad2d", "error_threshold", "error_pixels"), "looks at it"),
        }
        names = {"split_absgrad2d": "split_threshold"}
        for strategy, settings in only.items():
            for each in fields(self):
                value = getattr(self, each.name)
                if self.strategy != strategy and each.name in settings and value != each.default:
                    shown = names.get(each.name, each.name).replace("_", "-")
                    raise UserInputError(
                        f"--{shown} {value}: only --strategy {strategy} {settings[each.name]}; leave it out"
                    )
        if self.strategy == "multiview":
            if not 0.0 <= self.error_threshold < 1.0:
                raise UserInputError(
                    f"--error-threshold {self.error_threshold}: expected a share of a view's largest error from 0 to "
                    "below 1, such as 0.1"
                )
            if self.absgrad:
                raise UserInputError("--absgrad with --strategy multiview: it splits by absolute gradients as it is")


def _require_positive(name: str, value: float, kind: str) -> None:
    """Raise a UserInputError about a number that is not positive and finite."""
    if not (value > 0.0 and math.isfinite(value)):
        raise UserInputError(f"{name} {value}: expected a positive {kind}")


@dataclass(frozen=True)
class TrainSettings(HierarchySettings):
    """Everything that decides the result of a run besides the scene."""

    __pydantic_config__: ClassVar[Any] = STRICT

    iterations: int = option(
        REFERENCE_ITERATIONS, "Views trained on, all stages together. The 3DGS schedule shrinks with it.", least=1
    )
    gather: int = option(
        8,
        "Views whose gradients are added up for each optimizer step in the last quarter of a stage, once densification "
        "has ended and if 40 such steps fit; 1 steps after every view, as 3DGS does.",
        panel=SCHEDULE,
        names=("--accumulate-views", "--gather"),
    )
    views_per_step: str = option(
        AUTO,
        "Training views of one optimizer step, rendered together on a GPU; step sizes grow with the root of their "
        f"number. auto: up to {MOST_VIEWS} on a GPU, fewer of large images and in short stages; 1 on a CPU. Iterations "
        "count views.",
        panel=SCHEDULE,
    )
    sh_degree: int = option(3, "Highest SH degree, 0 to 3.", panel=SCHEDULE)
    base_sh_degree: int | None = option(
        None,
        "With residuals: highest SH degree of the base, at most --sh-degree, which is the default.",
        panel=SCHEDULE,
    )
    sh_rate_factor: float | None = option(
        None,
        "Factor on the learning rate of SH above degree 0, which is a twentieth of degree 0's, in the base or a single "
        "field. It falls exponentially to 1 within each stage. Default: by the number of training views, from 1 for up "
        f"to {VIEWS_OF_RATE} to {MOST_RATE:g}.",
        panel=SCHEDULE,
    )
    sh_every: int | None = None  # iterations between two rises of the SH degree; None: 1000 of 30,000
    ssim_weight: float = 0.2
    learning_rates: LearningRates = field(default_factory=LearningRates)
    densification: Densification = field(default_factory=Densification)
    antialiased: bool = option(False, "Dim Gaussians that are smaller than a pixel.", panel=GSPLAT)
    packed: bool = option(False, "Less memory where a view sees little; slower.", panel=GSPLAT)
    sparse_adam: bool = option(False, "Step only the Gaussians that the view shows.", panel=GSPLAT)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_bounds(self)
        self.learning_rates.check()
        self.densification.check()
        if not 0 <= self.sh_degree <= 3:
            raise UserInputError(f"--sh-degree {self.sh_degree}: expected 0, 1, 2 or 3")
        if self.sh_every is not None and self.sh_every < 1:
            raise UserInputError(f"sh_every {self.sh_every}: expected at least 1")
        self._check_base()
        self._check_mcmc()
        if self.gather < 1:
            raise UserInputError(f"--accumulate-views {self.gather}: expected at least 1, the views of one step")
        _ = self.asked_views
        if self.sh_rate_factor is not None:
            _require_positive("--sh-rate-factor", self.sh_rate_factor, "factor")
        if not 0.0 <= self.ssim_weight <= 1.0:
            raise UserInputError(f"--ssim-weight {self.ssim_weight}: expected 0 (only L1) to 1 (only SSIM)")

    def _check_base(self) -> None:
        """Refuse settings of a base that there is none of, or that inheritance cannot honour."""
        if (share := self.densification.base_share) is not None and self.levels == 1:
            raise UserInputError(f"--base-densify-share {share}: one level has no base; give --densify-until")
        if (degree := self.base_sh_degree) is None:
            return
        if self.nested:
            raise UserInputError(
                f"--base-sh-degree {degree}: is about residuals, and nested levels have none; leave it out, or add "
                "--hierarchy laplacian to train residuals"
            )
        if not 0 <= degree <= self.sh_degree:
            raise UserInputError(f"--base-sh-degree {degree}: expected 0 to --sh-degree, {self.sh_degree}")
        if self.levels == 1:
            raise UserInputError(f"--base-sh-degree {degree}: one level has no base; give --sh-degree")
        if self.inherit_mode == "full" and degree != self.sh_degree:
            raise UserInputError(
                f"--base-sh-degree {degree} with --inherit full: what takes over all coefficients has as many; "
                "inherit geometry or xyz"
            )

    def _check_mcmc(self) -> None:
        """Refuse settings that "mcmc" has no use for."""
        given = self.densification
        if given.strategy != "mcmc":
            return
        idle = {
            "--prune": self.prune,
            "--absgrad": given.absgrad,
            "--coarse-threshold": self.coarse_threshold,
            "--residual-threshold": self.residual_threshold != 1.0,
            "--densify-threshold": given.grow_grad2d is not None,
            "--opacity-reset-every": given.reset_every,
        }
        if options := [name for name, value in idle.items() if value]:
            raise UserInputError(
                f"{', '.join(options)} with --strategy mcmc: it moves transparent Gaussians, looks at no gradient and "
                "resets nothing; leave one out"
            )

    @property
    def asked_views(self) -> int | None:
        """Views of one step as asked for; None: by the size of the images, on a GPU."""
        if self.views_per_step == AUTO:
            return None
        try:
            views = int(self.views_per_step)
        except ValueError as error:
            raise UserInputError(
                f"--views-per-step {self.views_per_step}: expected auto, or a number of views"
            ) from error
        if views < 1:
            raise UserInputError(f"--views-per-step {views}: expected auto, or at least 1")
        return views

    @property
    def raster(self) -> dict[str, Any]:
        """Settings of the rasterizer that images depend on, as the manifest has them."""
        return {ANTIALIASING: True} if self.antialiased else {}

    def densification_of(self, stage: Stage) -> Densification:
        """Return density control of a stage: as set, with thresholds and a limit of its own."""
        given = self.densification
        whole = given.grow_grad2d or (ABSGRAD_THRESHOLD if given.absgrad else GROW_THRESHOLD)
        factor = self.threshold_factor(stage)
        changes: dict[str, Any] = {"grow_grad2d": whole * factor}
        if given.strategy == "multiview":
            changes["split_absgrad2d"] = given.split_absgrad2d * factor
        if given.base_cap_max is not None and self._is_base(stage):
            changes["cap_max"] = given.base_cap_max
        return replace(given, **changes)

    def sh_rate_factor_of(self, stage: Stage, training_views: int) -> float:
        """Return the factor on the rate of SH above degree 0 that a stage starts with."""
        if stage.signed:
            return 1.0  # their rate is raised already, see `residual_color_rate`
        if self.sh_rate_factor is not None:
            return self.sh_rate_factor
        return min(MOST_RATE, max(1.0, training_views / VIEWS_OF_RATE))

    @property
    def paper_settings(self) -> Mapping[str, object]:
        """See `HierarchySettings.paper_settings`."""
        return {**super().paper_settings, "gather": 1, "views_per_step": "1", "sh_rate_factor": 1.0}

    def sh_degree_of(self, stage: Stage) -> int:
        """Return the highest SH degree of a stage's field."""
        return self.base_sh_degree if self._is_base(stage) and self.base_sh_degree is not None else self.sh_degree

    def densify_share_of(self, stage: Stage) -> float | None:
        """Return the share of its iterations in which a stage densifies, where it has one of its own."""
        return self.densification.base_share if self._is_base(stage) else None

    def _is_base(self, stage: Stage) -> bool:
        """Whether finer levels follow, and none came before."""
        return self.levels > 1 and stage.level == self.levels - 1

    @property
    def rates(self) -> LearningRates:
        """Learning rates with that of residual colours, which is a factor on the others'."""
        return replace(self.learning_rates, residual_sh=self.learning_rates.sh * self.color_factor)

    def for_manifest(self) -> dict[str, Any]:
        """Return the settings as keyword arguments of `Manifest`: those it names itself, and the rest as "settings"."""
        values = {**self.resolved(), "raster": self.raster}
        return {**{name: values.pop(name) for name in IN_MANIFEST}, "settings": values}

    @classmethod
    def from_manifest(cls, manifest: Manifest, name: str = "the run's manifest") -> TrainSettings:
        """Return the settings that a run was started with.

        Raises:
            RunFolderError: they hold a key this version does not know, lack one, or one has another type.
        """
        values = {**manifest.settings, **{name: getattr(manifest, name) for name in IN_MANIFEST}}
        values = _of_this_version(values)
        values.pop("raster", None)  # `antialiased` says it
        if difference := sorted(set(values) ^ {f.name for f in fields(cls)}):
            raise RunFolderError(
                f"{name}: the run was not started by `lapgs train` of this version (settings {', '.join(difference)} "
                f"do not match); continue it with {manifest.created_by}"
            )
        settings: TrainSettings = checked(
            values, cls, name, error=RunFolderError, advice="restore it or train again with --overwrite"
        )
        return settings


def _of_this_version(given: dict[str, Any]) -> dict[str, Any]:
    """Bring settings of an older run to their present names and places."""
    # Before there was a choice, residual stages reset opacities.
    values = {**LEFT_OUT_ONCE, "residual_resets": given.get("hierarchy", "laplacian") == "laplacian", **given}
    density, rates = dict(values["densification"]), dict(values["learning_rates"])
    rates.pop("sh_rest_factor", None)
    rates.pop("sh_rest_decay", None)
    for name in ("coarse_threshold", "prune"):
        values.setdefault(name, density.pop(name, None if name == "coarse_threshold" else 0.0))
    for old, new in (("cache", "images_on"), ("cache_precision", "prediction_precision")):
        if old in values:
            values[new] = values.pop(old)
    if (ratio := values.pop("inherit_ratio", 1.0)) != 1.0:
        values["inherit"] = f"{values['inherit']}:{ratio:g}"
    if isinstance(values["split"], (list, tuple)):
        values["split"] = ",".join(values["split"])
    elif values["split"] is None and "cache" in given and values["levels"] == 2:
        values["split"] = "1/2,1/2"  # what None meant then, of residuals too
    if density.get("strategy") == "mcmc":
        values["coarse_threshold"] = None  # it has no threshold, whatever the hierarchy's is
    if values["hierarchy"] == Hierarchy.NESTED.value:
        values["inherit"] = None  # manifests name a mode all the same
    values.setdefault("antialiased", bool(values.get("raster")))
    values.setdefault("residual_color_rate", None)
    return {**values, "densification": density, "learning_rates": rates}


LEFT_OUT_ONCE: dict[str, Any] = {
    **{"packed": False, "sparse_adam": False, "joint": 0.0, "gather": 1, "hierarchy": "laplacian"},
    **{"base_sh_degree": None, "views_per_step": "1", "residual_threshold": 1.0, "sh_rate_factor": 1.0},
    "protocol": "default",
}
"""Settings that runs of the first weeks do not name, and what they were."""


@dataclass(frozen=True)
class TrainingControl(MeasuringOptions):
    """How a run is carried out and watched; its result does not depend on it, but for the rasterizer's rounding."""

    rasterizer: str = option(
        AUTO,
        "gsplat (CUDA), cpu, or oracle (slow, plain PyTorch, for checking). auto: gsplat where there is a CUDA device, "
        "else cpu.",
        panel=RUN,
    )
    threads: int | None = option(
        None, "Processor threads. Default: all this process may use.", panel=RUN, least=1, most=1024
    )
    checkpoint_every: int | None = option(
        None,
        "Iterations between checkpoints; by default one is written every minute. Ctrl-C writes one too.",
        panel=RUN,
        least=1,
    )


def views_per_step(settings: TrainSettings, stage: Stage, training_views: int, batches: bool) -> int:
    """How many views make a step of a stage.

    Args:
        settings: what the user asked for.
        stage: by the size of whose images is decided what is left open.
        training_views: how many there are, which what is decided here does not exceed.
        batches: whether the rasterizer takes several views at once; where it does not, one is what is decided.
    """
    asked = settings.asked_views
    if asked is None:
        pixels = stage.image_size[0] * stage.image_size[1]
        limits = round(PIXELS_OF_A_STEP / pixels), stage.iterations // STEPS_OF_A_STAGE
        asked = max(1, min(MOST_VIEWS, training_views, *limits)) if batches else 1
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
    gather_from: int
    gather: int
    before: int
    views: int = 1

    @classmethod
    def create(
        cls, settings: TrainSettings, stage: Stage, before: int = 0, views: int = 1, training_views: int = 1
    ) -> StageSchedule:
        shrink = min(1.0, settings.iterations / REFERENCE_ITERATIONS)
        given = settings.densification

        def constant(chosen: int | None, reference: int, smallest: int) -> int:
            return chosen if chosen is not None else max(smallest, round(reference * shrink))

        resets = constant(given.reset_every, 3000, 300)
        if given.reset_every == 0 or (
            (before or (stage.signed and not settings.residual_resets)) and given.reset_every is None
        ):
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
            densify_start=constant(given.start, REFERENCE_DENSIFY_FROM, 1),
            densify_until=densify_until,
            densify_every=given.every,
            reset_every=resets,
            sh_every=constant(settings.sh_every, 1000, 1),
            sh_degree=settings.sh_degree_of(stage),
            means_first=settings.learning_rates.means_first,
            means_last=settings.learning_rates.means_last,
            sh_rest_factor=settings.sh_rate_factor_of(stage, training_views),
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
        """Return the factor on the rate of SH above degree 0, which falls exponentially to 1 at the stage's end."""
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
