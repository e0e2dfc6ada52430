"""Declare the options of a hierarchy, which `lapgs train` and `lapgs run` share. Imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from fractions import Fraction
from typing import Any

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import DEFAULT_HIERARCHY, DEFAULT_SPLITS, Hierarchy, Stage, require_shares
from lapgs_plugin.hierarchy.supervision import RECONSTRUCTED, SUPERVISIONS
from lapgs_plugin.options import check_values, option, option_name, require_positive
from lapgs_plugin.registry import ALL, HOOKS, chosen_entries

GRIDS = ("camera", "even")
"""Pixel grids of a pyramid; see `pyramid`."""
INHERIT_MODES = ("geometry", "xyz", "full")
DEFAULT_INHERITANCE = "geometry"
PLACES = ("gpu", "memory", "disk")
"""Where images of a stage can be kept; see `runs.image_store`."""
PRECISIONS = ("float32", "float16", "uint8")
AUTO = "auto"
"""Chosen by the device and the images' size."""
AFFINE, BILATERAL = "affine", "bilateral"
APPEARANCES = (AFFINE, BILATERAL)
"""What can be learned of each photo with --appearance: a colour transform, or a bilateral grid of them."""

COARSE_THRESHOLD = {Hierarchy.NESTED: 2.0, Hierarchy.LAPLACIAN: 1.0}
"""Default factor on densification thresholds for each halving of the images. Coarse levels would otherwise grow more
Gaussians than their detail needs, and nested levels keep every one of them to the end."""
JOINT_SHARE = {Hierarchy.NESTED: 0.0, Hierarchy.LAPLACIAN: 0.25}
"""Default share of a residual stage, at its end, in which the finished coarser fields are trained as well: a frozen
coarse level cannot correct errors that the finer level is unable to represent."""
LARGE_IMAGE = 1_500_000
"""Pixels from which on an image is large: some defaults differ there, because a view of a residual takes much longer
than one of its base."""
LARGE = f"{LARGE_IMAGE / 1e6:g} megapixels"
RESIDUAL_COLOR_RATE = 4.0
"""Default factor on SH learning rates in residual stages, which start from zero colour and have fewer iterations."""
RESIDUAL_OPACITY = 0.1
"""Share of the weight of the mean opacity in a loss that residuals keep. The gradient of an opacity by the other losses
is in proportion to the colour behind it, which is about that share of a picture's; with the whole weight residuals lose
detail."""

PANEL = "Hierarchy"
STORAGE = "Memory and speed"

IDLE_WITHOUT_RESIDUALS: Mapping[str, object] = {
    "supervision": RECONSTRUCTED,
    "inherit": None,
    "joint": 0.0,
    "residual_color_rate": None,
    "residual_threshold": 1.0,
    "residual_resets": False,
}
"""Settings that mean nothing for nested levels, with the value that they may have there besides None."""

PAPER: Mapping[str, object] = {
    "hierarchy": Hierarchy.LAPLACIAN.value,
    "supervision": RECONSTRUCTED,
    "inherit": "xyz",
    "joint": 0.0,
    "residual_color_rate": 1.0,
    "residual_threshold": 1.0,
    "residual_resets": True,
    "coarse_threshold": 1.0,
    "prune": 0.0,
}
"""Settings of the paper's main tables, except the split of two levels. Other settings classes add their own."""
PAPER_SPLIT = "1/3,2/3"


@dataclass(frozen=True)
class HierarchySettings:
    """Choose the levels of a run and how they are trained. None stands for the hierarchy's default.

    Raises:
        UserInputError: a value is unknown or out of range, or about residuals although levels are nested.
    """

    hierarchy: str = option(
        DEFAULT_HIERARCHY.value,
        "Kind of hierarchy. laplacian: each level trains a signed residual, which is added to the upsampled coarser "
        "image, as in the paper. nested: each level continues training the coarser level's field at the finer size; "
        "the result is one ordinary field.",
        panel=PANEL,
        choices=tuple(kind.value for kind in Hierarchy),
    )
    protocol: str = option(
        "default",
        "default: the settings of this program. paper: exactly those of the paper's main tables; options that "
        "contradict them are refused.",
        panel=PANEL,
        choices=("default", "paper"),
    )
    levels: int = option(
        2,
        "Number of resolutions, each half of the next finer one; 1 trains a single field at full size, the baseline.",
        panel=PANEL,
        least=1,
    )
    split: str | None = option(
        None,
        "Share of the iterations for each level, coarsest first, such as 1/3,2/3. Default for two levels: 1/2,1/2, "
        f"and 2/3,1/3 for residuals of photos from {LARGE} on with --strategy mcmc; under `lapgs run` 1/3,2/3.",
        panel=PANEL,
    )
    supervision: str = option(
        RECONSTRUCTED,
        "Loss of residual levels. reconstructed: compare the composed image with the photo. online_residual, "
        "gt_laplacian: compare the residual alone (ablations of the paper).",
        panel=PANEL,
    )
    inherit: str | None = option(
        None,
        "What a residual field copies from the coarser level: geometry (everything but colour), xyz (positions, as in "
        "the paper) or full (all parameters and the optimizer's state). A ratio in (0, 1] keeps that share of the "
        f"Gaussians: 0.5 or xyz:0.5. Default: {DEFAULT_INHERITANCE}.",
        panel=PANEL,
    )
    joint: float | None = option(
        None,
        "Share of each residual level's iterations, at the end, in which the coarser fields are optimized as well; 0 "
        "freezes them, as in the paper. Default: 0.5 in `lapgs train` with --strategy mcmc and under `lapgs run` with "
        f"photos below {LARGE}, else {JOINT_SHARE[Hierarchy.LAPLACIAN]:g}.",
        panel=PANEL,
    )
    residual_color_rate: float | None = option(
        None,
        f"Factor on the SH learning rates of residual levels. Default: {RESIDUAL_COLOR_RATE:g}; in `lapgs train` with "
        "--strategy mcmc 1, as in the paper.",
        panel=PANEL,
    )
    coarse_threshold: float | None = option(
        None,
        "Factor on the gradient thresholds of densification for each halving of the images; above 1 coarse levels get "
        f"fewer Gaussians. Default: {COARSE_THRESHOLD[Hierarchy.NESTED]:g} nested, "
        f"{COARSE_THRESHOLD[Hierarchy.LAPLACIAN]:g} laplacian.",
        panel=PANEL,
    )
    residual_threshold: float = option(
        1.0, "Factor on the gradient thresholds of densification in residual levels.", panel=PANEL
    )
    residual_resets: bool = option(
        False, "Reset opacities in residual levels as well as in the base, as in the paper.", panel=PANEL
    )
    grid: str = option(
        "camera",
        "Pixel grid of the image pyramid: camera (aligned with the cameras) or even (every second pixel, as OpenCV).",
        panel=PANEL,
        choices=GRIDS,
    )
    prune: float = option(
        0.0,
        "When a level's densification ends, remove the least visible Gaussians, together this share of total "
        "visibility in the training views, such as 0.005; 0 removes none.",
        panel=PANEL,
    )
    images_on: str = option(
        AUTO,
        "Where training images and cached predictions of coarser levels are kept: gpu, memory or disk. auto: by their "
        "size.",
        panel=STORAGE,
        choices=(AUTO, *PLACES),
    )
    prediction_precision: str = option(
        AUTO,
        "Precision of cached predictions of coarser levels: float32, float16 or uint8. auto: float16 on a GPU, float32 "
        "on a CPU.",
        panel=STORAGE,
        choices=(AUTO, *PRECISIONS),
    )
    hooks: str = option(
        ALL, "Hooks of installed packages that take part: all, none, or their names, such as smooth,depth.", panel="Run"
    )
    seed: int = option(0, "Seed of all random choices; added to the seeds that a checkout's script sets.", panel="Run")

    def __post_init__(self) -> None:
        check_values(self)
        if self.protocol == "paper":
            self._follow_the_paper()
        SUPERVISIONS[self.supervision]  # raises for an unknown name, as the next check does
        if self.hooks != ALL:
            chosen_entries("--hooks", HOOKS, self.hooks)
        if not 0 <= self.seed < 2**32:
            raise UserInputError(f"--seed {self.seed}: expected 0 to {2**32 - 1}")
        if self.split is not None:
            require_shares(parse_split(self.split), self.levels)
        parse_inheritance(self.inherit or DEFAULT_INHERITANCE)
        if not 0.0 <= self.joint_share <= 1.0:
            raise UserInputError(
                f"--joint {self.joint_share}: expected a share of each residual stage from 0 to 1, such as 0.25"
            )
        if not 0.0 <= self.prune < 1.0:
            raise UserInputError(
                f"--prune {self.prune}: expected a share from 0, where nothing is pruned, to below 1, such as 0.005"
            )
        for name, factor in (
            ("--residual-color-rate", self.color_factor),
            ("--coarse-threshold", self.coarse_factor),
            ("--residual-threshold", self.residual_threshold),
        ):
            require_positive(name, factor, "factor")
        if self.nested:
            self._refuse_residual_settings()

    @property
    def paper_settings(self) -> Mapping[str, object]:
        """Values of `--protocol paper` by field."""
        return {**PAPER, **({"split": PAPER_SPLIT} if self.levels == 2 else {})}

    def _follow_the_paper(self) -> None:
        """Set the paper's values.

        Raises:
            UserInputError: another value was given.
        """
        declared = {field.name: field for field in fields(self)}
        for name, paper in self.paper_settings.items():
            if (value := getattr(self, name)) not in (declared[name].default, paper):
                raise UserInputError(
                    f"{option_name(declared[name])} {value} with --protocol paper: the paper has {paper}; leave one out"
                )
            object.__setattr__(self, name, paper)  # the dataclass is frozen

    def _refuse_residual_settings(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in IDLE_WITHOUT_RESIDUALS and value not in (None, IDLE_WITHOUT_RESIDUALS[field.name]):
                raise UserInputError(
                    f"{option_name(field)} {value}: is about residuals, and nested levels have none; leave it out, or "
                    f"add --hierarchy {Hierarchy.LAPLACIAN.value} to train residuals"
                )

    @property
    def kind(self) -> Hierarchy:
        """The kind of hierarchy."""
        return Hierarchy(self.hierarchy)

    @property
    def nested(self) -> bool:
        """Whether each level continues training the coarser level's field."""
        return self.kind is Hierarchy.NESTED

    @property
    def joint_share(self) -> float:
        """Share of each residual stage, at its end, that also trains the coarser fields; 0 to 1."""
        return JOINT_SHARE[self.kind] if self.joint is None else self.joint

    @property
    def color_factor(self) -> float:
        """Factor on the SH learning rates of residual stages."""
        return RESIDUAL_COLOR_RATE if self.residual_color_rate is None else self.residual_color_rate

    @property
    def coarse_factor(self) -> float:
        """Factor on densification thresholds for each halving."""
        return COARSE_THRESHOLD[self.kind] if self.coarse_threshold is None else self.coarse_threshold

    def threshold_factor(self, stage: Stage) -> float:
        """Return the factor on densification thresholds in a stage."""
        factor: float = self.coarse_factor**stage.level
        return factor * self.residual_threshold if stage.signed else factor

    @property
    def inherit_mode(self) -> str:
        """Mode of `inheritance.inherit`; "full" with nested levels."""
        return "full" if self.nested else parse_inheritance(self.inherit or DEFAULT_INHERITANCE)[0]

    @property
    def inherit_ratio(self) -> float:
        """Share of the coarser level's Gaussians that a level inherits."""
        return parse_inheritance(self.inherit or DEFAULT_INHERITANCE)[1]

    @property
    def shares(self) -> tuple[Fraction, ...] | None:
        """Share of each stage in the iterations, coarsest first; None for the default of `StagePlan`."""
        if self.split is not None:
            return parse_split(self.split)
        return DEFAULT_SPLITS.get(self.levels)

    def resolved(self) -> dict[str, Any]:
        """Return all fields for manifests, with the hierarchy's defaults filled in: these may change later."""
        values = asdict(self)
        values["split"] = None if self.shares is None else ",".join(map(str, self.shares))
        values["joint"], values["coarse_threshold"] = self.joint_share, self.coarse_factor
        values["inherit"] = self.inherit or DEFAULT_INHERITANCE
        values["residual_color_rate"] = None if self.nested else self.color_factor
        return values

    def joint_from(self, stage: Stage) -> int | None:
        """Return the first iteration, from 1, of a stage's joint training; None if it has none.

        The base has none, and neither have residuals that are supervised alone: no image is composed then.

        >>> HierarchySettings(hierarchy="laplacian", joint=0.25).joint_from(Stage(0, (800, 533), 20_000, signed=True))
        15001
        """
        if not stage.signed or not SUPERVISIONS[self.supervision].composes:
            return None
        first = stage.iterations - round(stage.iterations * self.joint_share) + 1
        return first if first <= stage.iterations else None


def require_composed(appearance: str, supervision: str) -> None:
    """Refuse transforms of an image that is not compared with the photo.

    Raises:
        UserInputError: `appearance` is one of `APPEARANCES`, and `supervision` compares residuals alone.
    """
    if appearance in APPEARANCES and not SUPERVISIONS[supervision].composes:
        raise UserInputError(
            f"--appearance {appearance} with --supervision {supervision}: that compares residuals, which have no "
            "exposure; leave one out"
        )


def parse_split(text: str) -> tuple[Fraction, ...]:
    """Parse shares such as "1/3,2/3" or "0.25,0.75".

    Raises:
        UserInputError: a share is not a number, or has an exponent: 1e99999999 would take hours.
    """
    try:
        if "e" in text.lower():
            raise ValueError("an exponent")
        return tuple(Fraction(part.strip()) for part in text.split(","))
    except (ValueError, ZeroDivisionError) as error:
        raise UserInputError(f"--split {text!r}: expected fractions separated by commas, such as 1/3,2/3") from error


def parse_inheritance(text: str) -> tuple[str, float]:
    """Parse --inherit into mode and ratio: MODE, RATIO or MODE:RATIO.

    >>> parse_inheritance("xyz:0.5"), parse_inheritance("0.25")
    (('xyz', 0.5), ('geometry', 0.25))

    Raises:
        UserInputError: it is none of these, or the ratio is outside (0, 1].
    """
    mode, _, ratio = text.partition(":")
    if mode not in INHERIT_MODES:
        mode, ratio = "geometry", text
    try:
        share = float(ratio or 1.0)
    except ValueError as error:
        raise UserInputError(
            f"--inherit {text!r}: expected {', '.join(INHERIT_MODES)}, a ratio in (0, 1], or both as in xyz:0.5"
        ) from error
    if not 0.0 < share <= 1.0:
        raise UserInputError(f"--inherit {text}: expected a ratio above 0 and at most 1 (1 inherits every Gaussian)")
    return mode, share


def is_large(size: tuple[int, int]) -> bool:
    """Return whether an image (width, height) is a `LARGE_IMAGE`."""
    return size[0] * size[1] >= LARGE_IMAGE
