"""Decide which rasterizer trains a checkout, its own or ours, by what both were measured to do in its dry run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from lapgs_plugin.checkouts.compiled_modules import CompiledModules
from lapgs_plugin.checkouts.packages import AUTO, OURS, OWN
from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.runs.manifest import Manifest

GAIN = 1.05
"""Times as fast as the checkout's own that ours has to be: less may be chance, and its own needs no reason."""

CHOICE = "rasterizer_choice"
"""Setting of a manifest: whose rasterizer trained the run, and why."""


@dataclass(frozen=True)
class Times:
    """Hold the median milliseconds of a rasterizer's forward and backward pass."""

    forward: float
    backward: float

    @property
    def total(self) -> float:
        return self.forward + self.backward


@dataclass(frozen=True)
class Trial:
    """Hold the measurements of one view.

    Attributes:
        view: its name.
        size: (width, height).
        count: Gaussians.
        own, ours: times of both rasterizers.
        difference: where their results differ by more than rounding, as a clause; empty if they agree.
    """

    view: str
    size: tuple[int, int]
    count: int
    own: Times
    ours: Times
    difference: str = ""


@dataclass(frozen=True)
class Decision:
    """Say whose rasterizer trains, `OWN` or `OURS`, and why in one line."""

    rasterizer: str
    why: str

    def for_manifest(self) -> dict[str, str]:
        """Return what the manifest has under `CHOICE`."""
        return {"taken": self.rasterizer, "why": self.why}


def decide(module: str, trials: Sequence[Trial]) -> Decision:
    """Take ours if it agrees with the checkout's own in all trials, and takes less time for all of them together.

    Args:
        module: name of the checkout's own.
        trials: at least one.
    """
    for trial in trials:
        if trial.difference:
            where = f"view {trial.view} at {trial.size[0]}x{trial.size[1]} with {trial.count} Gaussians"
            return Decision(OWN, f"the checkout's own {module}: ours differs in {where}: {trial.difference}")
    own, ours = (_mean([getattr(trial, name) for trial in trials]) for name in ("own", "ours"))
    times = (
        f"forward {ours.forward:.2f} instead of {own.forward:.2f} ms, backward {ours.backward:.2f} instead of "
        f"{own.backward:.2f} ms, the mean of {len(trials)} renders with up to {max(t.count for t in trials)} Gaussians"
    )
    ratio = own.total / ours.total
    if ratio >= GAIN:
        why = f"that of lapgs: {ratio:.2f} times as fast as {module}, with the same image, radii and gradients"
        return Decision(OURS, f"{why} ({times}); --rasterizer checkout keeps its own")
    needed = f", not the {GAIN:g} times for which its own is left"
    return Decision(OWN, f"the checkout's own {module}: that of lapgs is {ratio:.2f} times as fast ({times}){needed}")


def _mean(times: Sequence[Times]) -> Times:
    return Times(*(sum(getattr(one, name) for one in times) / len(times) for name in ("forward", "backward")))


def decided_without_trials(modules: CompiledModules, kept: Manifest | None, *, tries: bool) -> Decision | None:
    """Return the decision that needs no measurement; None if both rasterizers are there and nothing chooses one.

    Args:
        modules: whose the checkout imports.
        kept: manifest of the run to continue; None for a new run.
        tries: whether there is a dry run.

    Raises:
        RunFolderError: the run was trained with a rasterizer that is not to be had now.
    """
    if kept is not None and (decision := _kept(modules, kept)) is not None:
        return decision
    if modules.rasterizer == OURS:
        return Decision(OURS, modules.why)
    if modules.wanted != AUTO:
        return Decision(OWN, f"--rasterizer {modules.wanted}")
    if modules.hindrance or not modules.beside:
        return Decision(OWN, f"the checkout's own: {modules.hindrance or 'part of its sources'}")
    return None if tries else Decision(OWN, "the checkout's own: without a dry run it is compared with none")


def _kept(modules: CompiledModules, manifest: Manifest) -> Decision | None:
    """Return the decision of the run to continue; None if it had none, as before the choice and on a CPU."""
    before, both = recorded_choice(manifest), bool(modules.beside)
    if before is None:
        return Decision(OWN, "the checkout's own, with which the run began") if both else None
    if both or before.rasterizer == modules.rasterizer:
        return before
    titles = {OWN: "the checkout's own rasterizer", OURS: "the rasterizer of lapgs"}
    raise RunFolderError(
        f"this run was started with {titles[before.rasterizer]}, which is not to be had now "
        f"({modules.why or f'--rasterizer {modules.wanted}'}); resume with --rasterizer {before.rasterizer} where that "
        "works, or start again with --overwrite"
    )


def recorded_choice(manifest: Manifest) -> Decision | None:
    """Return the choice that a run was trained with; None for runs on a CPU."""
    recorded: Any = manifest.settings.get(CHOICE)
    if not isinstance(recorded, dict) or recorded.get("taken") not in (OWN, OURS):
        return None
    return Decision(recorded["taken"], str(recorded.get("why", "")))
