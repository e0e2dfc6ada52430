"""Test the order of hooks in a checkout's training, and the log of replaced symbols."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pytest
from torch import Tensor

from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hooks import StageContext, StageHook
from tests.contract.stub_runs import FORKS, NAMES, STUBS, THIRDS, captured, drive, loaded, run_hierarchy, run_residuals

# Two stages of 3 and 6 iterations that densify at 2, and at 2 and 4.
TINY = ("--iterations", 9, "--densify_from_iter", 0, "--densification_interval", 2, "--densify_until_iter", 8)


class Recording(StageHook):
    """Record every call with its level and iteration."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    def on_stage_start(self, stage: Stage) -> None:
        self.calls.append(f"start {stage.level}")

    def before_render(self, context: StageContext) -> None:
        self.calls.append(f"render {context.stage.level} {context.iteration}")

    def compose(self, context: StageContext, image: Tensor) -> Tensor:
        self.calls.append("compose")
        return image

    def loss(self, context: StageContext, image: Tensor) -> None:
        self.calls.append("loss")

    def after_backward(self, context: StageContext) -> None:
        self.calls.append("backward")

    def on_densify(self, context: StageContext) -> None:
        self.calls.append(f"densify {context.stage.level} {context.iteration}")

    def on_stage_end(self, stage: Stage) -> None:
        self.calls.append(f"end {stage.level}")


def iteration(level: int, number: int, densifies: int = 0) -> list[str]:
    calls = [f"render {level} {number}", "compose", "loss", "backward"]
    return calls + [f"densify {level} {number}"] * densifies


def test_the_order_of_calls(scene: Path, tmp_path: Path) -> None:
    hook = Recording()
    run_hierarchy(STUBS["graphdeco"], scene, tmp_path / "run", *TINY, hooks=(hook,), **THIRDS)
    assert hook.calls == [
        "start 1",
        *("render 1 1", "compose", "loss", "backward"),
        *("render 1 2", "compose", "loss", "backward", "densify 1 2"),
        *("render 1 3", "compose", "loss", "backward"),
        "end 1",
        "start 0",  # hooks count within a level, the checkout over the run: it densifies at 2, 4 and 6
        *("render 0 1", "compose", "loss", "backward", "densify 0 1"),
        *("render 0 2", "compose", "loss", "backward"),
        *("render 0 3", "compose", "loss", "backward", "densify 0 3"),
        *("render 0 4", "compose", "loss", "backward"),
        *("render 0 5", "compose", "loss", "backward"),
        *("render 0 6", "compose", "loss", "backward"),
        "end 0",
    ]


@pytest.mark.parametrize("name", ["fastgs", "taming", "speedy"])
def test_renders_for_scores_are_no_iterations(name: str, scene: Path, tmp_path: Path) -> None:
    hook = Recording()
    more = ("--iterations", 18, *TINY[2:-1], 12)
    if name == "speedy":  # its scores are gradients
        more += ("--prune_from_iter", 4, "--prune_interval", 4, "--densify_prune_ratio", 0.1)
    run_residuals((STUBS | FORKS)[name], scene, tmp_path / "run", *more, hooks=(hook,), split="1/2,1/2")
    calls = [call for call in hook.calls if not call.startswith("densify")]
    expected = []
    for level in (1, 0):
        expected += [f"start {level}", *(c for i in range(1, 10) for c in iteration(level, i)), f"end {level}"]
    assert calls == expected
    densified = [call for call in hook.calls if call.startswith("densify")]
    assert {"densify 1 2", "densify 1 4"} <= set(densified)  # the residual has nothing to densify at first


class Term(StageHook):
    """Add a loss that prefers dark images."""

    def loss(self, context: StageContext, image: Tensor) -> Tensor:
        return 100 * image.mean()


@pytest.mark.parametrize("name", NAMES)
def test_a_hooks_term_trains_as_if_the_loop_had_added_it(name: str, scene: Path, tmp_path: Path) -> None:
    """The first gradients are equal with a hook's term and with that term added to the loop's L1."""
    gradients = {}
    for how in ("hook", "loop"):
        folder = tmp_path / how
        with captured(folder, []), loaded(STUBS[name], scene, folder, *TINY) as adapter:
            model, found = adapter.train.GaussianModel, gradients.setdefault(how, [])
            update = model.add_densification_stats

            def spy(self: Any, points: Tensor, visible: Tensor, found: Any = found, update: Any = update) -> None:
                found.append([part.grad.clone() for part in (self._xyz, self._opacity, self._features_dc, points)])
                update(self, points, visible)

            model.add_densification_stats = spy
            if how == "loop":
                l1_loss = adapter.train.l1_loss
                # The loop gives its L1 a weight of 0.8.
                adapter.train.l1_loss = lambda image, photo, l1=l1_loss: l1(image, photo) + 100 / 0.8 * image.mean()
            drive(adapter, levels=1, hooks=(Term(),) if how == "hook" else ())
    for a, b in zip(gradients["hook"][0], gradients["loop"][0], strict=True):
        assert a.abs().max() > 0
        assert (a - b).abs().max() < 1e-5 * b.abs().max()  # 2.1e-7 seen: rounding of the sums


CAMERAS = {"fastgs": "utils.plain_camera", "taming": "utils.plain_camera", "graphdeco": "scene.cameras"}
"""Modules that define the cameras of the stubs."""


@pytest.mark.parametrize("name", NAMES)
def test_every_replaced_symbol_is_logged_once(
    name: str, scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "lapgs_plugin.checkouts.attachment")
    run_hierarchy(STUBS[name], scene, tmp_path / "run", *TINY, levels=1)
    lines = [record.getMessage() for record in caplog.records if record.getMessage().startswith("replaced ")]
    assert all("; used by " in line for line in lines)
    names = [line.split()[1].rstrip(";") for line in lines]
    assert len(names) == len(set(names))
    for symbol in (
        "__main__.training",
        "__main__.Scene",
        f"{CAMERAS[name]}.Camera.__init__",
        "gaussian_renderer.GaussianRasterizationSettings",
        "gaussian_renderer.GaussianRasterizer",
        "scene.gaussian_model.GaussianModel.update_learning_rate",
    ):
        assert symbol in names
