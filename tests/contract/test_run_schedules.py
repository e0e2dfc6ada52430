"""Test schedules of the whole run, scaled or mapped to stages: a stage's arguments, and what its training does."""

from __future__ import annotations

import ast
import shutil
import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from plyfile import PlyData

from lapgs_plugin.checkouts.schedule import Schedule
from lapgs_plugin.checkouts.training_call import StageWindow, TrainingCall
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import Stage
from tests.contract.stub_runs import (
    CHECKOUTS,
    KINDS,
    NAMES,
    SHORT,
    STUBS,
    STUBS_AND_KINDS,
    THIRDS,
    captured,
    drive,
    edited_graphdeco,
    loaded,
    run_hierarchy,
    run_residuals,
)

TOTAL = 30_000
BASE = StageWindow(Stage(1, (400, 300), 10_000, False), 0, TOTAL, 2, 4.0, 1.5)
FINEST = StageWindow(Stage(0, (800, 600), 20_000, True), 10_000, TOTAL, 2, 4.0, 1.0)


def published_call(name: str, adapter: Any, **changes: Any) -> TrainingCall:
    """Return the call that a checkout's main block makes with its defaults, parsed by its own parser."""
    arguments = sys.modules["arguments"]
    parser = ArgumentParser()
    groups = [kind(parser) for kind in (arguments.ModelParams, arguments.OptimizationParams, arguments.PipelineParams)]
    dataset, opt, pipe = (group.extract(parser.parse_args([])) for group in groups)
    values: dict[str, Any] = {
        "dataset": dataset,
        "opt": opt,
        "pipe": pipe,
        "testing_iterations": [7_000, 30_000],
        "saving_iterations": [7_000, 15_000, 30_000, 30_000],
        "checkpoint_iterations": [10_000, 10_001],
        "checkpoint": None,
        "debug_from": -1,
    }
    if name != "graphdeco":
        values["websockets"] = False
    if name == "taming":
        defaults = {"budget": 20.0, "mode": "multiplier", "ho_iteration": 15_000, "benchmark_dir": None}
        values |= {"score_coefficients": {}, "args": Namespace(**defaults)}
    return TrainingCall.bind(adapter.train.training, (), {**values, **changes})


def test_local_variables_that_hold_options_and_numbers_are_read() -> None:
    """As in GaussianPro: one bound is compared as the option, the other as a copy of it."""

    class Options:
        begin, end, every = 9_000, 12_000, 20

    (tree,) = ast.parse(
        """
def training(opt):
    end, late = 1, 2
    stop = opt.end
    prune_at = 24_000
    last = 0
    for iteration in range(1, 30_001):
        if iteration > opt.begin and iteration < stop and iteration % opt.every == 0:
            gaussians.densify()
        if iteration == prune_at:
            gaussians.prune()
        if iteration > last:
            last = iteration
"""
    ).body
    assert isinstance(tree, ast.FunctionDef)
    schedule, variables = Schedule(tree), {"opt": Options()}
    lines = schedule.describe(variables)
    assert "iteration > 9000 and iteration < 12000 and" in lines[0]
    assert lines[1].endswith("iteration == 24000 (prune)")
    changed = schedule.for_stage(variables, variables, FINEST)
    assert changed.options == {("opt", "begin"): 6_000, ("opt", "end"): 8_000}
    assert "24000 -> 16000" in changed.notes
    pruned: list[int] = []
    counting = SimpleNamespace(
        densify=lambda: None, prune=lambda: pruned.append(sys._getframe(1).f_locals["iteration"])
    )
    names: dict[str, Any] = {"gaussians": counting}
    exec(ast.unparse(tree), names)
    changed.function(names["training"])(Options())
    assert pruned == [16_000]


@pytest.mark.parametrize("name", NAMES)
def test_schedules_are_scaled_to_the_stage(name: str, scene: Path, tmp_path: Path) -> None:
    with loaded(STUBS[name], scene, tmp_path) as adapter:
        adapter.first_points(1_000)
        call = published_call(name, adapter)
        base, finest = (adapter.stage_call(call, window, f"run/{window.stage.level}") for window in (BASE, FINEST))
        assert (call.opt.iterations, call.dataset.model_path) == (TOTAL, ""), "the script's own call is left alone"
    assert (base.opt.iterations, finest.opt.iterations) == (10_000, 20_000)
    assert (base.opt.densify_until_iter, finest.opt.densify_until_iter) == (5_000, 10_000)
    assert (base.opt.position_lr_max_steps, finest.opt.position_lr_max_steps) == (10_000, 20_000)
    assert (base.dataset.model_path, finest.dataset.model_path) == ("run/1", "run/0")
    for stage in (base, finest):
        opt = stage.opt
        kept = (opt.densify_from_iter, opt.densification_interval, opt.opacity_reset_interval)
        assert kept == (500, 100, 3_000)
    thresholds = [
        name for name in vars(call.opt) if name.endswith(("grad_threshold", "grad_thresh", "grad_abs_thresh"))
    ]
    assert thresholds
    for threshold in adapter.densify_thresholds(call.opt):
        assert threshold in thresholds
        whole = getattr(call.opt, threshold)
        assert getattr(base.opt, threshold) == pytest.approx(1.5 * whole), "its images are halved once"
        assert getattr(finest.opt, threshold) == whole


@pytest.mark.parametrize("name", NAMES)
def test_iterations_of_the_whole_run_fall_into_stages(name: str, scene: Path, tmp_path: Path) -> None:
    with loaded(STUBS[name], scene, tmp_path) as adapter:
        adapter.first_points(1_000)
        call = published_call(name, adapter, debug_from=12_000)
        base, finest = (adapter.stage_call(call, window, "run").values for window in (BASE, FINEST))
    assert (base["testing_iterations"], finest["testing_iterations"]) == ([7_000], [20_000])
    assert (base["saving_iterations"], finest["saving_iterations"]) == ([7_000], [5_000, 20_000, 20_000])
    assert (base["checkpoint_iterations"], finest["checkpoint_iterations"]) == ([10_000], [1])
    assert not 0 <= base["debug_from"] < 10_000
    assert finest["debug_from"] == 2_000


@pytest.mark.parametrize("name", NAMES)
def test_only_residuals_lose_the_background_and_learn_colour_faster(name: str, scene: Path, tmp_path: Path) -> None:
    rates = {"fastgs": ("lowfeature_lr", "highfeature_lr"), "taming": ("feature_lr", "shfeature_lr")}
    with loaded(STUBS[name], scene, tmp_path) as adapter:
        adapter.first_points(1_000)
        call = published_call(name, adapter)
        call.dataset.white_background = call.pipe.convert_SHs_python = True
        base, finest = (adapter.stage_call(call, window, "run") for window in (BASE, FINEST))
    assert (base.dataset.white_background, base.pipe.convert_SHs_python) == (True, True)
    assert (finest.dataset.white_background, finest.pipe.convert_SHs_python) == (False, False)
    for rate in rates.get(name, ("feature_lr",)):
        assert getattr(base.opt, rate) == getattr(call.opt, rate)
        assert getattr(finest.opt, rate) == 4 * getattr(call.opt, rate)
    assert finest.opt.opacity_lr == call.opt.opacity_lr


@pytest.mark.parametrize(("mode", "budget"), [("multiplier", 20), ("final_count", 20_000)])
def test_tamings_budget_is_shared_in_both_modes(mode: str, budget: float, scene: Path, tmp_path: Path) -> None:
    with loaded(STUBS["taming"], scene, tmp_path) as adapter:
        adapter.first_points(1_000)
        args = Namespace(budget=budget, mode=mode, ho_iteration=15_000, benchmark_dir=None)
        call = published_call("taming", adapter, args=args)
        stages = [adapter.stage_call(call, window, "run") for window in (BASE, FINEST)]
        count_array = sys.modules["utils.taming_utils"].get_count_array
        budgets = []
        for start, stage in zip((1_000, 10_000), stages, strict=True):
            stage_args = stage.values["args"]
            counts = count_array(start, stage_args.budget, stage.opt, mode=stage_args.mode)
            # Densification number i looks up entry i + 1.
            times = range(stage.opt.densify_from_iter + 1, stage.opt.densify_until_iter)
            densifications = sum(i % stage.opt.densification_interval == 0 for i in times)
            assert densifications < len(counts)
            assert sorted(counts) == counts
            budgets.append((stage_args.budget, counts[-1] > 0.95 * stage_args.budget, stage_args.ho_iteration))
    assert budgets == [(10_000, True, 15_000), (20_000, True, 15_000)]


def test_tamings_table_of_counts_covers_uneven_intervals(scene: Path, tmp_path: Path) -> None:
    """In a bare run, a start between two intervals makes the last densification read past the table's end."""
    schedule = ("--densify_from_iter", 7, "--densification_interval", 5, "--densify_until_iter", 60)
    archive, _ = run_residuals(STUBS["taming"], scene, tmp_path / "run", *schedule)
    assert archive.manifest.complete


@pytest.mark.parametrize(("hierarchy", "expected"), [("laplacian", [25, 25]), ("nested", [25])])
def test_taming_releases_opacities_at_the_iteration_of_each_call(
    hierarchy: str, expected: list[int], scene: Path, tmp_path: Path
) -> None:
    released: list[int] = []
    now = [0]
    with captured(tmp_path, []), loaded(STUBS["taming"], scene, tmp_path / "run", "--ho_iteration", 25) as adapter:
        model = adapter.train.GaussianModel
        update, modify = model.update_learning_rate, model.modify_functions

        def spy_update(self: Any, iteration: int) -> Any:
            now[0] = iteration
            return update(self, iteration)

        def spy_modify(self: Any) -> None:
            released.append(now[0])
            modify(self)

        model.update_learning_rate, model.modify_functions = spy_update, spy_modify
        drive(adapter, hierarchy=hierarchy)
    assert released == expected


PUBLISHED = "iteration % 3000 == 0 and iteration > 15_000 and iteration < 30_000"


def record_fastgs(scene: Path, folder: Path, *more: Any, **options: Any) -> dict[str, list[tuple[int, int]]]:
    """Collect (iterations of the stage, iteration) of calls of FastGS's model. Its training function's numbers for
    30,000 iterations are divided by 100."""
    checkouts = Path(shutil.copytree(CHECKOUTS, folder / "checkouts", ignore=shutil.ignore_patterns("__pycache__")))
    script = checkouts / "fastgs" / "train.py"
    text = script.read_text(encoding="utf-8")
    assert PUBLISHED in text
    script.write_text(text.replace(PUBLISHED, "iteration % 30 == 0 and iteration > 150 and iteration < 300"))
    iterations: dict[str, list[tuple[int, int]]] = {"prune": [], "step": [], "sh_step": []}
    with captured(folder, []), loaded(STUBS["fastgs"], scene, folder / "run", *more, script=script) as adapter:
        model = adapter.train.GaussianModel
        setup, prune = model.training_setup, model.final_prune_fastgs
        now = [0, 0]

        def training_setup(self: Any, training_args: Any) -> None:
            setup(self, training_args)
            now[:] = [training_args.iterations, 0]
            for name, optimizer in (("step", self.optimizer), ("sh_step", self.shoptimizer)):
                optimizer.register_step_post_hook(lambda *_, name=name: iterations[name].append((now[0], now[1])))

        def update_learning_rate(self: Any, iteration: int, update: Any = model.update_learning_rate) -> Any:
            now[1] = iteration
            return update(self, iteration)

        def final_prune_fastgs(self: Any, min_opacity: float, pruning_score: Any = None) -> None:
            iterations["prune"].append((now[0], now[1]))
            assert min_opacity == 0.1
            prune(self, min_opacity, pruning_score)

        model.training_setup, model.update_learning_rate = training_setup, update_learning_rate
        model.final_prune_fastgs = final_prune_fastgs
        drive(adapter, **options)
    return iterations


def test_numbers_in_the_training_function_keep_their_share_of_each_residual_stage(scene: Path, tmp_path: Path) -> None:
    """FastGS prunes late at 18,000, 21,000, 24,000 and 27,000 of 30,000 iterations. The numbers of its optimizer, which
    are in another file, stay: all iterations until 15,000 step, higher SH every 16th. A stage's last does not."""
    more = ("--iterations", 300, "--densify_until_iter", 36, "--sh_degree", 0)
    iterations = record_fastgs(scene, tmp_path, *more, hierarchy="laplacian", joint=0.0, **THIRDS)
    assert iterations["prune"] == [*((100, i) for i in (60, 70, 80, 90)), *((200, i) for i in (120, 140, 160, 180))]
    assert iterations["step"] == [(n, i) for n in (100, 200) for i in range(1, n)]
    assert iterations["sh_step"] == [(n, i) for n in (100, 200) for i in range(16, n, 16)]


@pytest.mark.parametrize("name", NAMES)
def test_nested_levels_keep_the_schedule_but_for_thresholds(name: str, scene: Path, tmp_path: Path) -> None:
    """Coarse levels densify by twice the threshold, as `--coarse-threshold` says; the script's own options stay."""
    seen: dict[int, dict[str, Any]] = {}
    with captured(tmp_path, []), loaded(STUBS[name], scene, tmp_path / "run", *SHORT) as adapter:
        model = adapter.train.GaussianModel
        setup, update = model.training_setup, model.update_learning_rate

        def training_setup(self: Any, training_args: Any) -> None:
            self.options_given = training_args
            setup(self, training_args)

        def update_learning_rate(self: Any, iteration: int) -> Any:
            seen[iteration] = dict(vars(self.options_given))
            return update(self, iteration)

        model.training_setup, model.update_learning_rate = training_setup, update_learning_rate
        drive(adapter, **THIRDS)
        thresholds = adapter.densify_thresholds(Namespace(**seen[10]))
    kept = {name: value for name, value in seen[11].items() if name not in thresholds}
    assert {name: value for name, value in seen[10].items() if name not in thresholds} == kept
    assert kept["iterations"] == 30
    for threshold in thresholds:
        assert seen[10][threshold] == 2 * seen[11][threshold]


def test_a_nested_level_ends_before_the_reset_that_comes_at_its_end(scene: Path, tmp_path: Path) -> None:
    more = ("--opacity_reset_interval", 30, "--densify_until_iter", 60)
    archive, _ = run_hierarchy(STUBS["graphdeco"], scene, tmp_path / "run", *more, **THIRDS)
    assert [record.iterations for record in archive.manifest.records] == [29, 61]
    opacities = torch.sigmoid(archive.field(1).opacity_logits)
    assert float(opacities.max()) > 0.05, "a reset leaves 0.01"


@pytest.mark.parametrize("hierarchy", KINDS)
def test_what_densification_would_add_in_the_last_iteration_is_not_archived(
    hierarchy: str, scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A quick run of 7,000 iterations ends while a script still densifies: it saves its model before that."""
    options = ("--densify_until_iter", 180, "--save_iterations", 90)
    with caplog.at_level("INFO"):
        archive, _ = run_hierarchy(STUBS["graphdeco"], scene, tmp_path / "run", *options, hierarchy=hierarchy, **THIRDS)
    lines = [line for line in caplog.messages if "densify_and_prune() of its last iteration is left out" in line]
    levels = ["level 0"] if hierarchy == "nested" else ["level 1", "level 0"]  # one call of nested levels ends once
    assert [line.partition(":")[0] for line in lines] == levels
    (saved,) = (tmp_path / "run" / "level_0").glob("point_cloud/iteration_*/point_cloud.ply")
    assert len(PlyData.read(str(saved))["vertex"]) == len(archive.field(0))


@pytest.mark.parametrize(("name", "hierarchy"), STUBS_AND_KINDS)
def test_residuals_reset_no_opacities(name: str, hierarchy: str, scene: Path, tmp_path: Path) -> None:
    """Resets are skipped at the interval and, over white, where densification begins. Nested levels are reset when the
    checkout does it: every 8 iterations until 60, and at iteration 5."""
    more = ("--opacity_reset_interval", 8, "--white_background")
    asked: list[int] = []
    with captured(tmp_path, []), loaded(STUBS[name], scene, tmp_path / "run", *more) as adapter:
        model = adapter.train.GaussianModel
        update, now = model.update_learning_rate, [0]

        def update_learning_rate(self: Any, iteration: int) -> Any:
            now[0] += 1
            return update(self, iteration)

        model.update_learning_rate = update_learning_rate
        model.reset_opacity = lambda self: asked.append(now[0])
        drive(adapter, hierarchy=hierarchy, **THIRDS)
    until = 20 if hierarchy == "laplacian" else 60
    assert asked == sorted([5, *range(8, until, 8)])


def test_residuals_reset_opacities_where_that_is_asked_for(scene: Path, tmp_path: Path) -> None:
    more = ("--opacity_reset_interval", 8)
    reset: set[int] = set()
    with captured(tmp_path, []), loaded(STUBS["graphdeco"], scene, tmp_path / "run", *more) as adapter:
        model = adapter.train.GaussianModel
        setup = model.training_setup

        def training_setup(self: Any, training_args: Any) -> None:
            self.stage_iterations = training_args.iterations
            setup(self, training_args)

        def reset_opacity(self: Any) -> None:
            reset.add(self.stage_iterations)

        model.training_setup, model.reset_opacity = training_setup, reset_opacity
        drive(adapter, hierarchy="laplacian", residual_resets=True, **THIRDS)
    assert reset == {30, 60}


def test_residuals_weigh_the_mean_opacity_less_and_the_option_comes_back(scene: Path, tmp_path: Path) -> None:
    """A loss reads the weight of the script's parsed options, a global; its main block's are as before afterwards."""
    loss = "loss = loss + args.opacity_reg * gaussians.get_opacity.mean(); WEIGHTS.append(args.opacity_reg)\n"
    script = edited_graphdeco(tmp_path / "c", "train.py", "loss.backward()", f"{loss}        loss.backward()")
    option = 'parser.add_argument("--opacity_reg", type=float, default=0.5)\n    args = parsed(parser)'
    text = script.read_text(encoding="utf-8").replace("args = parsed(parser)", option)
    script.write_text(text.replace("\n\ndef training(", "\n\nWEIGHTS = []\n\n\ndef training(", 1), encoding="utf-8")
    more = ("--densify_until_iter", 75)
    with (
        captured(tmp_path, []),
        loaded(STUBS["graphdeco"], scene, tmp_path / "run", *more, script=script) as adapter,
    ):
        drive(adapter, hierarchy="laplacian", **THIRDS)
        module = adapter.train
    assert module.args.opacity_reg == 0.5
    assert module.WEIGHTS[:30] == [0.5] * 30
    assert module.WEIGHTS[30:] == [0.0] + [0.05] * 59  # none in a fiftieth of 50 iterations


def test_taming_says_when_a_stage_is_too_short_for_its_budget(scene: Path, tmp_path: Path) -> None:
    more = ("--densify_from_iter", 50, "--densification_interval", 5)
    with pytest.raises(UserInputError, match="level 1 would stop densifying at iteration 20 and start after 50"):
        run_residuals(STUBS["taming"], scene, tmp_path / "run", *more)
