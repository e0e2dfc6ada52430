"""Test the slot of the running stage."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch

from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.rasterizers.signed_color import ColorPath
from lapgs_plugin.runner.running_stage import RunningStage, Stages
from lapgs_plugin.runner.stage_rendering import StageRendering
from lapgs_plugin.stages.record import LoopRecord


def rendering() -> StageRendering:
    return StageRendering(False, ColorPath.NATIVE, {})


class Plain(RunningStage):
    """Do nothing, and turn what fails inside into another error."""

    has_more = False

    def __init__(self) -> None:
        super().__init__(Stage(0, (8, 6), 20, signed=False), rendering(), LoopRecord(torch.device("cpu")))
        self.released = False

    @contextmanager
    def entered(self) -> Iterator[None]:
        try:
            yield
        except ZeroDivisionError as error:
            raise ValueError("explained") from error
        finally:
            self.released = True

    def scene_for(self, gaussians: Any) -> Any:
        raise NotImplementedError

    def iteration_begins(self, gaussians: Any) -> None:
        raise NotImplementedError


def test_a_stage_answers_inside_of_its_block_alone() -> None:
    stages, stage, other = Stages(), Plain(), rendering()
    with stages.run(stage):
        assert stages.running is stage
        with stages.rendering_as(other):
            assert (stages.running, stages.rendering) == (stage, other)
        assert stages.rendering is stage.rendering
    assert (stages.running, stages.rendering, stage.released) == (None, None, True)


def test_a_stage_explains_what_fails_and_leaves_the_slot_empty() -> None:
    stages, stage = Stages(), Plain()
    with pytest.raises(ValueError, match="explained"), stages.run(stage), stages.rendering_as(rendering()):
        raise ZeroDivisionError
    assert (stages.running, stages.rendering, stage.released) == (None, None, True)


def test_one_stage_runs_at_a_time() -> None:
    stages, stage, second = Stages(), Plain(), Plain()
    with stages.run(stage):
        with pytest.raises(AssertionError, match="one stage"), stages.run(second):
            raise NotImplementedError
        assert stages.running is stage
    assert not second.released
