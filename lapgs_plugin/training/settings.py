"""What a user can choose for a built-in training run, and what each stage's schedule makes of it. Imports no torch."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar

from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.hierarchy.plan import Hierarchy, Stage, nested_densify_until
from lapgs_plugin.hierarchy.settings import AUTO, HierarchySettings
from lapgs_plugin.options import check_bounds, option
from lapgs_plugin.untrusted import STRICT, checked

if TYPE_CHECKING:
    from lapgs_plugin.runs.archive import Manifest

LATE_SHARE = 0.25
"""Of a stage, its last, in which the gradients of some views make one step, once densification has ended. Positions
hardly move any more, and what single views disagree about is noise; earlier, steps are what is short."""
LEAST_STEPS = 40
"""In that share. Shorter stages step with every view: on the sample scene, 1,000 iterations, 40 steps of fewer views
lost 0.08 dB, of one field 0.13."""
REFERENCE_ITERATIONS = 30_000
"""Length of the run that 3DGS's published schedule was made for; shorter runs shrink its constants in proportion."""

STRATEGIES = ("default", "mcmc")
GROW_THRESHOLD = 2e-4
"""Threshold of densification on screen-space gradients, in normalised device coordinates: 3DGS's."""
ABSGRAD_THRESHOLD = 8e-4
"""What `grow_grad2d` becomes for absolute gradients, which do not cancel and are larger: gsplat's recommendation."""

ANTIALIASING = "antialiasing"
"""Key of `TrainSettings.raster`, as rasterizers and manifests call it."""

SCHEDULE = "Schedule"
GSPLAT = "gsplat"
RUN = "Run"

IN_MANIFEST = ("levels", "grid", "supervision", "inherit", "sh_degree", "seed")
"""Settings that the manifest has fields of its own for."""


@dataclass(frozen=True)
class LearningRates:
    """Adam step sizes, as 3DGS publishes them. Positions are in units of the scene's extent."""

    __pydantic_config__: ClassVar[Any] = STRICT

    means_first: float = 1.6e-4
    means_last: float = 1.6e-6
    sh: float = 2.5e-3  # coefficients above degree 0 take a twentieth of it
    residual_sh: float = 1e-2  # the same for residual fields: `TrainSettings.rates` sets it
    opacities: float = 5e-2
    scales: float = 5e-3
    quats: float = 1e-3

    def __post_init__(self) -> None:
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
        None, "First densification. Default: 500 of 30000.", panel=SCHEDULE, names=("--densify-from",), least=0
    )
    until: int | None = option(
        None,
        "Last densification, of the whole run; stages scale it. Default: 15000 of 30000.",
        panel=SCHEDULE,
        names=("--densify-until",),
        least=0,
    )
    every: int = option(
        100, "Iterations between two densifications.", panel=SCHEDULE, names=("--densify-every",), least=1
    )
    reset_every: int | None = option(
        None,
        "Iterations between two resets of all opacities; 0 never resets. Default: 3000 of 30000, and of nested levels "
        "in the base alone.",
        panel=SCHEDULE,
        names=("--opacity-reset-every",),
    )
    grow_grad2d: float | None = None
    """Threshold on the screen-space gradient, in normalised device coordinates; None: 2e-4, `ABSGRAD_THRESHOLD` of
    absolute gradients."""
    strategy: str = option(
        "default", "Density control: default (3DGS's heuristics) or mcmc (Kheradmand et al. 2024).", panel=SCHEDULE
    )
    absgrad: bool = option(False, "Densify by absolute gradients (AbsGS).", panel=SCHEDULE)
    cap_max: int = option(1_000_000, "Most Gaussians of a level, for --strategy mcmc.", panel=SCHEDULE, least=1)


@dataclass(frozen=True)
class TrainSettings(HierarchySettings):
    """Everything that decides the result of a run besides the scene."""

    __pydantic_config__: ClassVar[Any] = STRICT

    iterations: int = option(
        30_000, "Optimizer steps, all stages together. The 3DGS schedule shrinks with it.", least=1
    )
    gather: int = option(
        8,
        "Views whose gradients are added up for each optimizer step in the last quarter of a stage, once densification "
        "has ended and if 40 such steps fit; 1 steps after every view, as 3DGS does.",
        panel=SCHEDULE,
        names=("--accumulate-views", "--gather"),
    )
    sh_degree: int = option(3, "Highest SH degree, 0 to 3.", panel=SCHEDULE)
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
        check_bounds(self.densification)
        if self.densification.strategy not in STRATEGIES:
            raise UserInputError(f"--strategy {self.densification.strategy}: expected {' or '.join(STRATEGIES)}")
        if not 0 <= self.sh_degree <= 3:
            raise UserInputError(f"--sh-degree {self.sh_degree}: expected 0, 1, 2 or 3")
        if (resets := self.densification.reset_every) is not None and resets < 0:
            raise UserInputError(f"--opacity-reset-every {resets}: expected a number of iterations, or 0 for never")
        self._check_strategy()
        if self.gather < 1:
            raise UserInputError(f"--accumulate-views {self.gather}: expected at least 1, the views of one step")
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
            "--prune": self.prune,
            "--absgrad": given.absgrad,
            "--coarse-threshold": self.coarse_threshold,
            "--opacity-reset-every": given.reset_every,
        }
        if options := [option for option, value in idle.items() if value]:
            raise UserInputError(
                f"{', '.join(options)} with --strategy mcmc: it moves transparent Gaussians, looks at no gradient and "
                "resets nothing; leave one out"
            )

    @property
    def raster(self) -> dict[str, Any]:
        """Settings of the rasterizer that images depend on, as the manifest has them."""
        return {ANTIALIASING: True} if self.antialiased else {}

    def densification_of(self, stage: Stage) -> Densification:
        """Return density control of a stage: as set, with a threshold for its size."""
        given = self.densification
        whole = given.grow_grad2d or (ABSGRAD_THRESHOLD if given.absgrad else GROW_THRESHOLD)
        return replace(given, grow_grad2d=whole * self.coarse_factor**stage.level)

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
    values = {**LEFT_OUT_ONCE, **given}
    density, rates = dict(values["densification"]), dict(values["learning_rates"])
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


LEFT_OUT_ONCE = {"packed": False, "sparse_adam": False, "joint": 0.0, "gather": 1, "hierarchy": "laplacian"}
"""Settings that runs of the first weeks do not name, and what they were."""


@dataclass(frozen=True)
class TrainingControl:
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
    test_every: int | None = option(
        None, "Measure held-out PSNR this often. Default: at the end of each stage.", panel=RUN, least=1
    )
    breakdown: bool = option(
        False,
        "Measure where the time of iterations goes: forward, loss, backward, densification, optimizer, other.",
        panel=RUN,
    )
    checkpoint_every: int | None = option(
        None,
        "Iterations between checkpoints; by default one is written every minute. Ctrl-C writes one too.",
        panel=RUN,
        least=1,
    )


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
