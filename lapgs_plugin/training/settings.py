"""Declare what a user can choose about a run of the built-in trainer. Imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import REFERENCE_DENSIFY_FROM, REFERENCE_ITERATIONS, Stage
from lapgs_plugin.hierarchy.settings import APPEARANCES, AUTO, HierarchySettings, is_large, require_composed
from lapgs_plugin.options import check_values, option, option_name, options_of, require_positive
from lapgs_plugin.registry import NONE
from lapgs_plugin.runs.options import PANEL as RUN
from lapgs_plugin.runs.options import MeasuringOptions
from lapgs_plugin.training.strategies import (
    FEW_PHOTOS,
    GRADIENTS,
    LONG_RUN,
    LONG_RUN_OF_LARGE,
    MCMC,
    PANEL,
    STRATEGIES,
    Auto,
    Mcmc,
    StagePart,
    Strategy,
)
from lapgs_plugin.training.time_budget import parse_duration
from lapgs_plugin.untrusted import STRICT

SH_RATE_VIEWS = 32
"""The rate of SH above degree 0 is multiplied by (training views / SH_RATE_VIEWS), clamped to 1 ... MOST_SH_RATE: few
views do not determine how colours depend on direction."""
MOST_SH_RATE = 8.0
"""Largest factor on the rate of SH above degree 0."""
MOST_VIEWS = 8
"""Most views of one step if --views-per-step is auto."""

LAST = "last"
"""Choice of --keep: the state after the last iteration."""
BEST = "best"
"""Choice of --keep: the state whose held-out views were best."""

PLANNED = "planned"
"""Choice of --stop: after the iterations that a stage was planned with."""

SCHEDULE = "Schedule"
GSPLAT = "gsplat"

IN_MANIFEST = ("levels", "grid", "supervision", "inherit", "sh_degree", "seed")
"""Settings that are fields of the manifest itself."""


PASSES = 130
"""Passes over the training photos in a run whose iterations are left open, unless they are more than 3DGS's 30,000.

More passes sharpen renders a little, and cost PSNR where photos are few or their exposure changes."""
MOST_PASSES = 300
"""The same with --stop auto, which may end the run earlier."""


def enough_iterations(photos: int, passes: int = PASSES) -> int:
    """Return the iterations after which more gain little on so many training photos, and no fewer than a long run has.

    >>> enough_iterations(43), enough_iterations(10)
    (5590, 5000)
    """
    return max(LONG_RUN, passes * photos)


@dataclass(frozen=True)
class LearningRates:
    """Set Adam's step sizes, by default 3DGS's. Those of positions are in units of the scene's extent."""

    __pydantic_config__: ClassVar[Any] = STRICT

    means_first: float = 1.6e-4
    means_last: float = 1.6e-6
    sh: float = 2.5e-3  # a twentieth for coefficients above degree 0, times `TrainSettings.sh_rate_factor`
    residual_sh: float = 1e-2  # the same for residual fields: `TrainSettings.rates` sets it
    opacities: float = 5e-2
    scales: float = 5e-3
    quats: float = 1e-3

    def check(self) -> None:
        """Raise a UserInputError about a rate that is not positive."""
        for rate in fields(self):
            require_positive(rate.name, getattr(self, rate.name), "learning rate")


@dataclass(frozen=True)
class Densification:
    """Set when and how Gaussians are cloned, split, pruned and reset. `StageSchedule` divides iterations of the run.

    None takes 3DGS's constant for 30,000 iterations (500, 15,000, 3,000) or the strategy's, in proportion for shorter
    runs. `every` does not shrink: its statistics need about that many views.

    Attributes:
        options: those of the strategy; None takes its defaults.
    """

    __pydantic_config__: ClassVar[Any] = STRICT

    strategy: str = option(
        AUTO,
        "How Gaussians are added and removed: mcmc (Kheradmand et al. 2024), 3dgs (clone, split and prune as 3DGS "
        "does), multiview (the same, only where several views have large errors), or one of an installed package. "
        f"auto: mcmc from {LONG_RUN} iterations on, with large photos from {LONG_RUN_OF_LARGE}, else 3dgs; an option "
        "that only one of the two has chooses it.",
        panel=PANEL,
    )
    start: int | None = option(
        None,
        "Iteration of each stage after which densification begins. Default: "
        f"{REFERENCE_DENSIFY_FROM} of {REFERENCE_ITERATIONS}, in proportion in shorter runs.",
        panel=PANEL,
        names=("--densify-from",),
        least=0,
    )
    until: int | None = option(
        None,
        "Iteration of the run at which densification ends; each stage stops at the same share of its own iterations. "
        "Default: 25000 of 30000 with --strategy mcmc, else 15000.",
        panel=PANEL,
        names=("--densify-until",),
        least=0,
    )
    base_share: float | None = option(
        None,
        "Share of the coarsest level's iterations in which it densifies, from 0 to 1. Default: by --densify-until.",
        panel=PANEL,
        names=("--base-densify-share",),
    )
    every: int = option(100, "Iterations between two densifications.", panel=PANEL, names=("--densify-every",), least=1)
    reset_every: int | None = option(
        None,
        "Iterations between two resets of all opacities, in every stage; 0 never resets. Default: 3000 of 30000, in "
        "the coarsest level alone. No option of --strategy mcmc.",
        panel=PANEL,
        names=("--opacity-reset-every",),
    )
    options: Strategy = options_of(STRATEGIES, "strategy")

    def __post_init__(self) -> None:
        if self.options is None:
            object.__setattr__(self, "options", STRATEGIES[self.strategy])

    def check(self) -> None:
        """Raise a UserInputError about a value out of range, or options of another strategy."""
        check_values(self)
        if type(self.options) is not type(STRATEGIES[self.strategy]):
            raise UserInputError(f"--strategy {self.strategy} with options of {type(self.options).__name__}")
        self.options.check()
        if self.base_share is not None and not 0.0 <= self.base_share <= 1.0:
            raise UserInputError(
                f"--base-densify-share {self.base_share}: expected a share of the base's iterations from 0 to 1"
            )
        if self.reset_every is not None and self.reset_every < 0:
            raise UserInputError(
                f"--opacity-reset-every {self.reset_every}: expected a number of iterations, or 0 for never"
            )


@dataclass(frozen=True)
class TrainSettings(HierarchySettings):
    """Set everything besides the scene that decides the result of a run."""

    __pydantic_config__: ClassVar[Any] = STRICT

    iterations: int = option(
        REFERENCE_ITERATIONS,
        "Views trained on, all stages together. The 3DGS schedule shrinks with it. If it is left out, fewer than "
        f"{REFERENCE_ITERATIONS // PASSES} training photos get {PASSES} for each, but at least {LONG_RUN}.",
        least=1,
    )
    time: str | None = option(
        None,
        "Train for so long instead of --iterations, such as 20s, 2m or 1h: everything from the command's start to the "
        "last level's end. Each level gets its --split of the seconds.",
        metavar="DURATION",
    )
    stop: str = option(
        PLANNED,
        "When levels end. planned: each after its --split of --iterations. auto: the coarsest when training views that "
        "are set aside, one of 10, stop gaining PSNR, and after its --split at the latest; finer ones in proportion. "
        "Once that is decided, the views are trained on, too.",
        choices=(PLANNED, AUTO),
    )
    accumulate_views: int = option(
        8,
        "Views whose gradients are added up for each optimizer step in the last quarter of a stage, once densification "
        "has ended and if 40 such steps fit; 1 steps after every view, as 3DGS does.",
        panel=SCHEDULE,
        least=1,
    )
    views_per_step: str = option(
        AUTO,
        "Training views of one optimizer step, rendered together on a GPU; step sizes grow with the root of their "
        f"number. auto: up to {MOST_VIEWS} on a GPU, fewer of large images and in short stages; 1 on a CPU. Iterations "
        "count views.",
        panel=SCHEDULE,
    )
    decay: float = option(
        1.0,
        "Share of each stage, at its end, in which the step size of positions falls to a hundredth; before that it is "
        "constant. By default it falls over the whole stage. 0.2 pays for small images and few Gaussians on a CPU, and "
        "loses at full size on a GPU.",
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
        "Factor on the learning rate of SH above degree 0, which is a twentieth of degree 0's, in all levels but "
        "residuals. It falls exponentially to 1 within each stage. Default: the number of training views divided by "
        f"{SH_RATE_VIEWS}, from 1 to {MOST_SH_RATE:g}.",
        panel=SCHEDULE,
    )
    dropout: float | None = option(
        None,
        "Share of the Gaussians to leave out at random in each step, growing from 0 to this over a stage: fewer "
        f"floaters where photos are few. Default: {Mcmc.few_dropout:g} for fewer than {FEW_PHOTOS} training photos "
        "with --strategy mcmc, else 0.",
        panel=SCHEDULE,
    )
    appearance: str = option(
        AUTO,
        "Learn how each training photo differs from the scene. affine: a colour transform, against changes of exposure "
        "and white balance. bilateral: a grid of them over the image and brightness, also against local tone mapping. "
        "auto: affine if the photos' exposure is measured to differ, else none. Both kinds compensate measured "
        "vignetting, too. Renders show the mean exposure.",
        panel=SCHEDULE,
        choices=(AUTO, NONE, *APPEARANCES),
    )
    depth: str = option(
        NONE,
        "Supervise depth in all levels but residuals: a folder of depth maps named as the photos (16-bit PNG, EXR, "
        "NPY), points (those of COLMAP that a photo sees), auto (depth_file_path of transforms.json, the scene's "
        "folder depth/ or that of an export, or none of them), or none.",
        panel=SCHEDULE,
    )
    normals: str = option(
        "none",
        "Supervise normals beside --depth, in all levels but residuals: a folder of normal maps named as the photos, "
        "in the axes of their cameras (PNG with (n + 1) / 2 as colours, EXR, NPY), or none.",
        panel=SCHEDULE,
    )
    refine_poses: bool = option(
        False,
        "Refine the pose of each training photo while the field trains, for inaccurate poses. Views are then rendered "
        "one by one, which takes longer on a GPU.",
        panel=SCHEDULE,
    )
    distorted: bool = option(
        False,
        "Train on the photos of fisheye and distorted lenses as they are, instead of undistorting them, by gsplat's "
        "unscented transform, or on a CPU by a slow reference. Only with --strategy mcmc.",
        panel=SCHEDULE,
    )
    keep: str = option(
        LAST,
        "State of each level to archive: last, or best as measured on a few training views, which are then not trained "
        "on.",
        panel=SCHEDULE,
        choices=(LAST, BEST),
    )
    sh_every: int | None = None  # iterations between two rises of the SH degree; None: 1000 of 30,000
    ranks: int = 1  # that the run was started on, which its sums depend on; see `training.ranks.shards`
    extended: int = 0  # iterations of the finest stage after its schedule's end, by --resume --iterations
    ssim_weight: float = 0.2
    learning_rates: LearningRates = field(default_factory=LearningRates)
    densification: Densification = field(default_factory=Densification)
    antialiased: bool = option(False, "Dim Gaussians that are smaller than a pixel.", panel=GSPLAT)
    packed: bool = option(False, "Use less memory where a view sees little of the scene; slower.", panel=GSPLAT)
    sparse_adam: bool = option(False, "Step only the Gaussians that the view shows.", panel=GSPLAT)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._choose_strategy()
        self.learning_rates.check()
        self.densification.check()
        if not 0 <= self.sh_degree <= 3:
            raise UserInputError(f"--sh-degree {self.sh_degree}: expected 0, 1, 2 or 3")
        if not 0 <= self.extended < self.iterations:
            raise UserInputError(f"extended {self.extended}: expected 0 to below the iterations, {self.iterations}")
        if self.ranks < 1:
            raise UserInputError(f"ranks {self.ranks}: expected at least 1")
        if self.sh_every is not None and self.sh_every < 1:
            raise UserInputError(f"sh_every {self.sh_every}: expected at least 1")
        self._check_base()
        self._check_unused()
        self._check_distorted()
        require_composed(self.appearance, self.supervision)
        _ = self.asked_views
        if self.sh_rate_factor is not None:
            require_positive("--sh-rate-factor", self.sh_rate_factor, "factor")
        if self.time is not None:
            parse_duration(self.time)
            if self.densification.until is not None:
                raise UserInputError(
                    f"--densify-until {self.densification.until} with --time: names an iteration of a run whose length "
                    "is not known; leave one out"
                )
        if self.stops_early:
            self._check_open_end()
        if not 0.0 < self.decay <= 1.0:
            raise UserInputError(f"--decay {self.decay}: expected a share of each stage above 0 and at most 1")
        if self.dropout is not None and not 0.0 <= self.dropout < 1.0:
            raise UserInputError(f"--dropout {self.dropout}: expected a share from 0 to below 1, such as 0.2")
        if not 0.0 <= self.ssim_weight <= 1.0:
            raise UserInputError(f"ssim_weight is {self.ssim_weight}, expected 0 (only L1) to 1 (only SSIM)")

    def _check_open_end(self) -> None:
        """Refuse settings that contradict levels whose length views that are set aside decide."""
        if (until := self.densification.until) is not None:
            raise UserInputError(
                f"--densify-until {until} with --stop auto: names an iteration of a run whose length is not known; "
                "leave one out"
            )
        if self.keep == BEST:
            raise UserInputError("--keep best with --stop auto: both set training views aside; leave one out")
        if self.extended:
            raise UserInputError(f"extended {self.extended}: expected 0 with --stop auto")

    def _choose_strategy(self) -> None:
        """Replace the strategy auto by the one that it means here.

        Raises:
            UserInputError: another one than 3DGS's with the paper's settings.
        """
        density = self.densification
        if isinstance(density.options, Auto):
            # Along rays there is MCMC alone, which long runs choose.
            length = max(self.scheduled, LONG_RUN) if self.distorted else self.scheduled
            object.__setattr__(self, "densification", self._chosen(density.options, length))  # the dataclass is frozen
        elif self.protocol == "paper" and density.strategy != GRADIENTS:
            raise UserInputError(
                f"--strategy {density.strategy} with --protocol paper: the paper has {GRADIENTS}; leave one out"
            )

    def _chosen(self, options: Auto, length: int) -> Densification:
        """Return density control with the strategy that auto means for a run of so many iterations."""
        heuristics = ["--protocol paper"] if self.protocol == "paper" else self._idle(STRATEGIES[MCMC])
        name = options.choose(length, heuristics)
        return replace(self.densification, strategy=name, options=options.options_for(name))

    @property
    def _as_auto(self) -> Auto:
        """The strategy's options, as if it was to be chosen."""
        options = self.densification.options
        return Auto(**{each.name: getattr(options, each.name) for each in fields(options)})

    def _check_base(self) -> None:
        """Refuse settings of a base if there is none, or if the next level inherits all of its coefficients."""
        if (share := self.densification.base_share) is not None and self.levels == 1:
            raise UserInputError(f"--base-densify-share {share}: one level has no base; give --densify-until")
        if (most := getattr(self.densification.options, "base_cap_max", None)) is not None and self.levels == 1:
            raise UserInputError(f"--base-cap-max {most}: one level has no base; give --cap-max")
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
                f"--base-sh-degree {degree} with --inherit full: a level that inherits all coefficients has as "
                "many; inherit geometry or xyz"
            )

    def _check_distorted(self) -> None:
        """Refuse settings that need pinholes or projected centres, or are not tried along rays."""
        if not self.distorted:
            return
        reasons = {
            "--protocol paper": (self.protocol == "paper", "the paper has no lenses, and adds Gaussians by gradients"),
            f"--strategy {self.densification.strategy} or an option of it": (
                self.densification.strategy != MCMC,
                "along rays only mcmc is tried; others have thresholds for gradients by projected centres",
            ),
            "--antialiased": (self.antialiased, "Gaussians are evaluated along rays, without a blur"),
            "--packed": (self.packed, "gsplat does not pack what it evaluates along rays"),
            "--sparse-adam": (self.sparse_adam, "it is not tried along rays"),
            f"--depth {self.depth}": (self.depth != NONE, "maps and points are those of pinholes"),
            f"--normals {self.normals}": (self.normals != NONE, "they are those of pinholes"),
            "--refine-poses": (self.refine_poses, "it is not tried along rays"),
        }
        for other, (chosen, reason) in reasons.items():
            if chosen:
                raise UserInputError(f"--distorted with {other}: {reason}; leave one out")

    def _check_unused(self) -> None:
        """Refuse settings that have no effect with the strategy."""
        density = self.densification
        if idle := self._idle(density.options):
            raise UserInputError(
                f"{', '.join(idle)} with --strategy {density.strategy}: no effect there; leave it out, or add "
                f"--strategy {GRADIENTS}"
            )

    def _idle(self, strategy: Strategy) -> list[str]:
        """Return the options that were given and have no effect with a strategy."""
        return [
            option_name(declared)
            for owner in (self, self.densification)
            for declared in fields(owner)
            if declared.name in strategy.unused and getattr(owner, declared.name) not in (declared.default, 0)
        ]

    def for_photos(self, count: int) -> TrainSettings:
        """Return settings with `PASSES` over the photos, but no shorter than a long run and no longer than these.

        With --stop auto they are `MOST_PASSES`.

        Settings of the paper, and of a schedule in iterations of the run, stay.
        """
        enough, control = enough_iterations(count, MOST_PASSES if self.stops_early else PASSES), self.densification
        timed = control.start is not None or control.until is not None or bool(control.reset_every)  # 0: never
        if enough >= self.iterations or timed or self.protocol == "paper" or self.time is not None:
            return self
        return replace(self, iterations=enough)

    def lasting(self, iterations: int, choose: bool = False) -> TrainSettings:
        """Return settings of a run of so many iterations.

        Args:
            iterations: of all stages together.
            choose: choose the strategy by them, as auto does.
        """
        control = self.densification
        if choose:
            control = replace(control, strategy=AUTO, options=self._as_auto)
        return replace(self, iterations=iterations, densification=control)

    def for_size(self, size: tuple[int, int], choose: bool = False) -> TrainSettings:
        """Return settings whose residuals, if they have two levels and no split was given, are split for their images.

        Args:
            size: (width, height) of the smallest photo.
            choose: choose the strategy by the size, too, as auto does.
        """
        if not is_large(size):
            return self
        settings = self
        if choose and LONG_RUN_OF_LARGE <= self.scheduled < LONG_RUN:
            settings = replace(self, densification=self._chosen(self._as_auto, LONG_RUN))
        large = settings.densification.options.large_split
        if large is None or settings.split is not None or settings.nested or settings.levels != 2:
            return settings
        return replace(settings, split=large)

    @property
    def stops_early(self) -> bool:
        """Whether views that are set aside decide the lengths of levels; a run that gets a time ends with that."""
        return self.stop == AUTO and self.time is None

    @property
    def scheduled(self) -> int:
        """Iterations of the run's schedule, all stages together, without those that extended the finished run."""
        return self.iterations - self.extended

    def extension_of(self, stage: Stage) -> int:
        """Return the iterations of a stage after its schedule's end."""
        return self.extended if stage.level == 0 else 0

    @property
    def asked_views(self) -> int | None:
        """The number of views of one step; None if it is "auto"."""
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

    def strategy_of(self, stage: Stage, pixels: int) -> Strategy:
        """Return the strategy of density control with the options of a stage.

        Args:
            stage: of this run's plan.
            pixels: of all training images of the stage's level together.
        """
        part = StagePart(
            self.threshold_factor(stage),
            pixels,
            base=self._is_base(stage.level),
            finest=stage.level == 0,
            signed=stage.signed,
        )
        return self.densification.options.of_stage(part)

    def sh_rate_factor_of(self, stage: Stage, training_views: int) -> float:
        """Return the factor on the rate of SH above degree 0 that a stage starts with."""
        if stage.signed:
            return 1.0  # `residual_color_rate` is a factor on these, too
        if self.sh_rate_factor is not None:
            return self.sh_rate_factor
        return min(MOST_SH_RATE, max(1.0, training_views / SH_RATE_VIEWS))

    @property
    def joint_share(self) -> float:
        """See `HierarchySettings.joint_share`; a strategy may have a default of its own."""
        own = self.densification.options.residual_joint
        return super().joint_share if own is None or self.nested or self.joint is not None else own

    @property
    def color_factor(self) -> float:
        """See `HierarchySettings.color_factor`; a strategy may have a default of its own."""
        own = self.densification.options.residual_color_rate
        return super().color_factor if own is None or self.residual_color_rate is not None else own

    def dropout_for(self, training_photos: int) -> float:
        """Return the share of Gaussians that the last steps of a stage leave out."""
        if self.dropout is not None:
            return self.dropout
        return self.densification.options.few_dropout if training_photos < FEW_PHOTOS else 0.0

    @property
    def paper_settings(self) -> Mapping[str, object]:
        """See `HierarchySettings.paper_settings`."""
        return {
            **super().paper_settings,
            **{
                "accumulate_views": 1,
                "views_per_step": "1",
                "sh_rate_factor": 1.0,
                "decay": 1.0,
                "stop": PLANNED,
                "appearance": NONE,
                "depth": NONE,
                "normals": NONE,
                "refine_poses": False,
            },
            "dropout": 0.0,
        }

    def sh_degree_of(self, level: int) -> int:
        """Return the highest SH degree of a level's field."""
        return self.base_sh_degree if self._is_base(level) and self.base_sh_degree is not None else self.sh_degree

    def densify_share_of(self, stage: Stage) -> float | None:
        """Return the share of its iterations in which a stage densifies; None if the schedule decides."""
        return self.densification.base_share if self._is_base(stage.level) else None

    def _is_base(self, level: int) -> bool:
        """Return whether a level is the coarsest of several."""
        return level == self.levels - 1 > 0

    @property
    def rates(self) -> LearningRates:
        """Learning rates with the rate of residual colours, which is a factor on the others'."""
        return replace(self.learning_rates, residual_sh=self.learning_rates.sh * self.color_factor)

    def for_manifest(self) -> dict[str, Any]:
        """Return the settings as arguments of `Manifest`: its own fields by name, the others in "settings"."""
        # What rendering the run needs to know of the rasterizer, as `rasterizers.choice` reads it.
        values = {**self.resolved(), "raster": {"antialiasing": True} if self.antialiased else {}}
        del values["distorted"]  # the manifest's scene says it
        return {**{name: values.pop(name) for name in IN_MANIFEST}, "settings": values}


@dataclass(frozen=True)
class TrainingControl(MeasuringOptions):
    """Set how a run is executed and observed, which does not change its result except for the rasterizer's rounding."""

    rasterizer: str = option(
        AUTO,
        "gsplat (CUDA), cpu, oracle (slow, plain PyTorch, for checking), or one of an installed package. auto: gsplat "
        "where there is a CUDA device, else cpu.",
        panel=RUN,
    )
    threads: int | None = option(
        None, "Processor threads. Default: all that this process may use.", panel=RUN, least=1, most=1024
    )
    checkpoint_every: int | None = option(
        None,
        "Iterations between checkpoints. Default: one a minute, fewer where writing one takes long. Ctrl-C writes one, "
        "too.",
        panel=RUN,
        least=1,
    )
    log: str | None = option(
        None,
        "tensorboard: write the figures of history.jsonl for TensorBoard as well, into the run folder.",
        panel=RUN,
    )

    def __post_init__(self) -> None:
        if self.log not in (None, "tensorboard"):
            raise UserInputError(f"--log {self.log}: expected tensorboard; history.jsonl is always written")
