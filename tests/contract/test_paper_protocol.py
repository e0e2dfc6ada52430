"""Test `--protocol paper` against the paper authors' release: what each stage gets, scripts without options included.

The figures are those of SorenZhang574/Laplacian-GS, commit acfc560, read from `train_lap.py` with the options of
`run_mipnerf360_1k_fastgs.sh` (bonsai) and `run_mipnerf360_1k_taming.sh` and the defaults of `arguments/__init__.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import wraps
from pathlib import Path
from typing import Any

import pytest

from lapgs_bench.experiments.standard import PRESETS
from lapgs_plugin.checkouts.schedule import Schedule
from lapgs_plugin.checkouts.training_call import StageWindow, TrainingCall
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import StagePlan
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.training.schedule import StageSchedule
from lapgs_plugin.training.settings import TrainSettings
from tests.contract.stub_runs import STUBS, THIRDS, captured, drive, loaded
from tests.contract.test_run_schedules import published_call

TOTAL = 30_000
SCHEDULE = {
    "iterations": (10_000, 20_000),  # --iter_plan 10000_20000
    "densify_from_iter": (500, 500),
    "densify_until_iter": (5_000, 10_000),  # 15,000 times the stage's share
    "densification_interval": (100, 100),
    "opacity_reset_interval": (3_000, 3_000),
    "position_lr_init": (0.00016, 0.00016),
    "position_lr_final": (0.0000016, 0.0000016),
    "position_lr_max_steps": (10_000, 20_000),
    "opacity_lr": (0.025, 0.025),
    "scaling_lr": (0.005, 0.005),
    "rotation_lr": (0.001, 0.001),
    "lambda_dssim": (0.2, 0.2),
}
"""What the coarse and the fine stage get of both backbones."""
FASTGS = {
    "loss_thresh": (0.05, 0.05),  # times --decay_loss_thresh, 1.0
    "dense": (0.001, 0.001),  # times --decay_dense, 1.0
    "grad_thresh": (0.0002, 0.0002),
    "grad_abs_thresh": (0.00015, 0.00015),
    "lowfeature_lr": (0.0025, 0.0025),
    "highfeature_lr": (0.02, 0.02),  # divided by 20 for SH above degree 0
    "mult": (0.5, 0.5),
}
TAMING = {
    "densify_grad_threshold": (0.0002, 0.0002),
    "percent_dense": (0.01, 0.01),
    "feature_lr": (0.0025, 0.0025),  # there lowfeature_lr
}
TAMING_SH_RATE = 0.005 / 20  # highfeature_lr, where graphdeco takes feature_lr / 20
RESETS = ([3_000], [3_000, 6_000, 9_000])  # in each stage, while it densifies
LATE_PRUNING = ([6_000, 7_000, 8_000, 9_000], [12_000, 14_000, 16_000, 18_000])
SH_EVERY = 1_000  # iterations of a stage between two degrees


def stage_calls(name: str, preset: str, scene: Path, folder: Path) -> list[TrainingCall]:
    """Return the calls of `training` of both stages, with the published options for bonsai."""
    settings = RunSettings(protocol="paper", **PRESETS[preset].options)
    with loaded(STUBS[name], scene, folder) as adapter:
        call = published_call(name, adapter)
        words = iter(PRESETS[preset].arguments("bonsai"))
        for option, value in zip(words, words, strict=True):
            kind = type(getattr(call.opt, option.removeprefix("--")))
            setattr(call.opt, option.removeprefix("--"), kind(value))
        plan = StagePlan.create((1600, 1066), TOTAL, settings.levels, settings.shares, settings.kind)
        calls, start = [], 0
        for stage in plan:
            factors = settings.color_factor, settings.threshold_factor(stage)
            calls.append(adapter.stage_call(call, StageWindow(stage, start, TOTAL, plan.levels, *factors), "run"))
            start += stage.iterations
    return calls


@pytest.mark.parametrize(("name", "own"), [("fastgs", FASTGS), ("graphdeco", TAMING)])
def test_each_stage_of_a_checkout_gets_what_the_release_gives_it(
    name: str, own: Mapping[str, tuple[float, float]], scene: Path, tmp_path: Path
) -> None:
    calls = stage_calls(name, f"{name}.ours", scene, tmp_path)
    expected = SCHEDULE | own
    assert {option: tuple(getattr(call.opt, option) for call in calls) for option in expected} == {
        option: pytest.approx(values) for option, values in expected.items()
    }


def test_every_stage_resets_prunes_late_and_starts_as_in_the_release(scene: Path, tmp_path: Path) -> None:
    paper = RunSettings(protocol="paper")
    assert (paper.residual_resets, paper.joint_share, paper.prune) == (True, 0.0, 0.0)
    assert (paper.inherit_mode, paper.inherit_ratio) == ("xyz", 1.0)  # --inherit_state only_xyz --inherit_ratio 1.0
    with loaded(STUBS["fastgs"], scene, tmp_path) as adapter:
        schedule, call = Schedule(adapter.profile.source.training), published_call("fastgs", adapter)
    for stage, due in zip(
        StagePlan.create((1600, 1066), TOTAL, 2, paper.shares, paper.kind), LATE_PRUNING, strict=True
    ):
        notes = schedule.for_stage(call.values, call.values, StageWindow(stage, 0, TOTAL, 2, 1.0, 1.0)).notes
        numbers = {int(before): int(after) for before, after in (note.split(" -> ") for note in notes)}
        assert [
            i
            for i in range(1, stage.iterations + 1)
            if i % numbers[3_000] == 0 and numbers[15_000] < i < numbers[30_000]
        ] == due


def test_each_stage_of_our_own_trainer_gets_what_the_release_gives_it() -> None:
    settings = TrainSettings(protocol="paper")
    plan = StagePlan.create((1600, 1066), TOTAL, settings.levels, settings.shares, settings.kind)
    stages = [StageSchedule.create(settings, stage) for stage in plan]
    schedules = {
        "iterations": [stage.iterations for stage in stages],
        "densify_from_iter": [stage.densify_start for stage in stages],
        "densify_until_iter": [stage.densify_until for stage in stages],
        "densification_interval": [stage.densify_every for stage in stages],
        "opacity_reset_interval": [stage.reset_every for stage in stages],
        "position_lr_init": [stage.means_first for stage in stages],
        "position_lr_final": [stage.means_last for stage in stages],
        "lambda_dssim": [settings.ssim_weight] * 2,
    }
    assert schedules == {name: pytest.approx(SCHEDULE[name]) for name in schedules}
    for stage, resets in zip(stages, RESETS, strict=True):
        assert [i for i in range(1, stage.densify_until) if i % stage.reset_every == 0] == resets
        assert stage.sh_every == SH_EVERY
        assert {stage.views_of_step(done) for done in (0, 5_000, stage.iterations - 1)} == {1}
    assert (settings.color_factor, [settings.threshold_factor(stage) for stage in plan]) == (1.0, [1.0, 1.0])


def test_the_releases_rate_of_sh_and_no_pruning_by_size(scene: Path, tmp_path: Path) -> None:
    """What the release changes in graphdeco's code, and the script has no option for."""
    limits, rates = [], []
    more = ("--opacity_reset_interval", 8)  # the script passes a limit on the size after that many iterations
    with captured(tmp_path, []), loaded(STUBS["graphdeco"], scene, tmp_path / "run", *more) as adapter:
        model = adapter.train.GaussianModel
        densify = model.densify_and_prune

        @wraps(densify)  # density control is known by what it does
        def densify_and_prune(
            self: Any, max_grad: float, min_opacity: float, extent: float, max_screen_size: Any, radii: Any
        ) -> None:
            limits.append(max_screen_size)
            rates.append({group["name"]: group["lr"] for group in self.optimizer.param_groups})
            densify(self, max_grad, min_opacity, extent, max_screen_size, radii)

        model.densify_and_prune = densify_and_prune
        drive(adapter, hierarchy="laplacian", residual_color_rate=1.0, **PRESETS["graphdeco.ours"].options, **THIRDS)
    assert len(limits) > 2
    assert set(limits) == {None}
    for rate in rates:
        assert rate["f_rest"] == pytest.approx(TAMING_SH_RATE)
        assert rate["f_dc"] == pytest.approx(TAMING["feature_lr"][0])


def test_a_densification_that_knows_no_size_has_none_to_leave_out(scene: Path, tmp_path: Path) -> None:
    with loaded(STUBS["graphdeco"], scene, tmp_path / "run") as adapter:
        adapter.train.GaussianModel.densify_and_prune = lambda self, radii: None
        with pytest.raises(UserInputError, match="--no-prune-by-size: densification of graphdeco 3DGS has no max_scr"):
            drive(adapter, hierarchy="laplacian", prune_by_size=False, **THIRDS)


def test_a_rate_of_sh_needs_the_familys_parameter_group(scene: Path, tmp_path: Path) -> None:
    with loaded(STUBS["graphdeco"], scene, tmp_path / "run") as adapter:
        model = adapter.train.GaussianModel
        setup = model.training_setup

        def training_setup(self: Any, training_args: Any) -> None:
            setup(self, training_args)
            for group in self.optimizer.param_groups:
                group["name"] = group["name"].replace("f_rest", "sh")

        model.training_setup = training_setup
        with pytest.raises(UserInputError, match="--sh-rate 2: the checkout's optimizers have no parameter gr"):
            drive(adapter, hierarchy="laplacian", sh_rate=2.0, **THIRDS)


def test_a_rate_of_sh_holds_for_optimizers_that_a_loop_makes_again(scene: Path, tmp_path: Path) -> None:
    rates: list[float] = []
    more = ("--iterations", 12)
    with captured(tmp_path, []), loaded(STUBS["graphdeco"], scene, tmp_path / "run", *more) as adapter:
        model = adapter.train.GaussianModel
        setup, update = model.training_setup, model.update_learning_rate

        def training_setup(self: Any, training_args: Any) -> None:
            self.given = training_args
            setup(self, training_args)

        def update_learning_rate(self: Any, iteration: int) -> Any:
            rates.append(next(group["lr"] for group in self.optimizer.param_groups if group["name"] == "f_rest"))
            if iteration == 6:
                self.training_setup(self.given)
            return update(self, iteration)

        model.training_setup, model.update_learning_rate = training_setup, update_learning_rate
        drive(adapter, levels=1, sh_rate=2.0)
    assert rates == pytest.approx([2 * 0.0025 / 20] * 12)


def test_a_rate_of_sh_is_a_positive_factor() -> None:
    with pytest.raises(UserInputError, match=r"--sh-rate 0.0: expected a positive factor"):
        RunSettings(sh_rate=0.0)
