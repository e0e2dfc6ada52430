"""Test the expansion of experiments: all runs once, in a fair order, and their commands."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import pytest
import typer
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from lapgs_bench.experiments.commands import Locations, Step, run_steps
from lapgs_bench.experiments.execution import prepare
from lapgs_bench.experiments.expansion import plan_runs, scenes_of
from lapgs_bench.experiments.mistakes import Mistakes
from lapgs_bench.experiments.run import option_names
from lapgs_bench.experiments.schema import Experiment
from lapgs_bench.experiments.settings import Selection
from lapgs_bench.experiments.standard import PRESETS
from lapgs_plugin.cli.app import app
from lapgs_plugin.errors import UserInputError
from tests.experiments.examples import SMALL, run_spec


def experiment(**changes: Any) -> Experiment:
    return Experiment.model_validate({**SMALL, **changes})


@settings(deadline=None, max_examples=30)
@given(
    scenes=st.integers(1, 4),
    variants=st.integers(1, 4),
    backbones=st.integers(1, 3),
    seeds=st.lists(st.integers(0, 99), min_size=1, max_size=3, unique=True),
)
def test_every_combination_once_and_variants_in_turn(
    scenes: int, variants: int, backbones: int, seeds: list[int]
) -> None:
    built = experiment(
        seeds=seeds,
        scenes=[{"name": f"s{i}", "path": "x"} for i in range(scenes)],
        backbones={f"b{i}": {"rasterizer": f"r{i}"} for i in range(backbones)},
        variants=[{"name": f"v{i}", "options": {"levels": i}} for i in range(variants)],
    )
    planned = plan_runs(built, Selection())
    runs = [(run.spec.seed, run.spec.scene, run.variant, run.spec.backbone) for run in planned]
    names = ([f"{letter}{i}" for i in range(n)] for letter, n in (("s", scenes), ("v", variants), ("b", backbones)))
    assert sorted(runs) == sorted(product(seeds, *names))
    assert len({run.spec.run_id for run in planned}) == len(runs)
    # No variant runs twice in the same position before every other one did.
    pairs = variants * backbones
    for start in range(0, len(runs), pairs):
        block = runs[start : start + pairs]
        assert len({(seed, scene) for seed, scene, _, _ in block}) == 1
    order = [(variant, backbone) for _, _, variant, backbone in runs[:pairs]]
    beginnings = [(variant, backbone) for _, _, variant, backbone in runs[::pairs]]
    assert beginnings == [order[i % pairs] for i in range(len(beginnings))]


def test_variants_trained_alike_share_their_runs_and_a_new_name_repeats_none() -> None:
    alike = [
        {"name": "xyz", "options": {"inherit": "xyz"}},
        {"name": "rho = 1", "options": {"inherit": "xyz"}},
        {"name": "other", "options": {"inherit": "full"}},
    ]
    ids = {
        run.variant: run.spec.run_id
        for run in plan_runs(experiment(variants=alike), Selection(scenes=["a"], seeds="0", backbones=["cpu"]))
    }
    assert ids["xyz"] == ids["rho = 1"] != ids["other"]


def test_a_run_says_which_hierarchy_it_trains() -> None:
    """A changed default must not reuse the results of the old one."""
    variants = [
        {"name": "nested", "options": {"hierarchy": "nested"}},
        {"name": "default"},
        {"name": "residuals", "options": {"hierarchy": "laplacian"}},
    ]
    planned = plan_runs(experiment(variants=variants), Selection(scenes=["a"], seeds="0"))
    for backbone in ("cpu", "fast"):
        specs = {run.variant: run.spec for run in planned if run.spec.backbone == backbone}
        kinds = {name: spec.options["hierarchy"] for name, spec in specs.items()}
        assert kinds == {"nested": "nested", "default": "laplacian", "residuals": "laplacian"}
        assert specs["residuals"].run_id == specs["default"].run_id != specs["nested"].run_id


def test_another_sample_scene_is_trained_anew_in_a_folder_of_its_own(tmp_path: Path) -> None:
    ids, folders = set(), set()
    for views in (8, 9):
        changed = experiment(scenes=[{"name": "a", "sample": {"size": "64x48", "views": views}}])
        planned = plan_runs(changed, Selection(seeds="0", backbones=["cpu"], variants=["bare"]))
        mistakes, places = Mistakes(tmp_path / "x.toml", changed, Selection()), Locations({}, tmp_path)
        jobs, scenes = prepare(planned, scenes_of(changed, Selection()), places, tmp_path, None, mistakes)
        mistakes.refuse()
        ids.add(jobs[0].run_id)
        folders.add(scenes["a"][1])
        assert str(scenes["a"][1]) in jobs[0].steps[0].command
    assert len(ids) == len(folders) == 2


def test_a_variant_may_have_a_preset_of_its_own() -> None:
    variants = [
        {"name": "bare", "method": "bare"},
        {"name": "own", "preset": {"fast": "graphdeco.ours"}, "options": {"sh_rate": 3.0}},
    ]
    planned = plan_runs(experiment(variants=variants), Selection(backbones=["fast"], scenes=["a"], seeds="0"))
    bare, own = (run.spec for run in planned)
    assert bare.arguments == list(PRESETS["fastgs.big"].common)
    assert own.arguments == list(PRESETS["graphdeco.ours"].common)
    assert bare.options == {}
    assert own.options == {"hierarchy": "laplacian", "prune_by_size": False, "sh_rate": 3.0}, "the variant's own last"


def test_only_selected_runs_are_planned() -> None:
    selection = Selection(scenes=["b"], backbones=["fast"], variants=["bare"], seeds="7", iterations=9)
    (run,) = plan_runs(experiment(), selection)
    spec = run.spec
    assert (spec.scene, spec.backbone, spec.seed, spec.iterations) == ("b", "fast", 7, 9)
    assert spec.options == {}, "a script by itself takes no options of `lapgs run`"
    assert spec.arguments[:2] == ["--densification_interval", "100"]
    with pytest.raises(UserInputError, match="--scene c: not in the experiment"):
        plan_runs(experiment(), Selection(scenes=["c"]))
    with pytest.raises(UserInputError, match="no run is left"):
        plan_runs(experiment(), Selection(backbones=["cpu"], variants=["fast alone"]))


def test_fewer_iterations_are_fewer_for_all() -> None:
    variants = [{"name": "usual"}, {"name": "longer", "iterations": 60}]
    planned = plan_runs(
        experiment(variants=variants), Selection(iterations=10, scenes=["a"], seeds="0", backbones=["cpu"])
    )
    assert {run.variant: run.spec.iterations for run in planned} == {"usual": 10, "longer": 15}, "of 40 and 60"


def test_data_sets_know_their_scenes_and_image_folders() -> None:
    built = experiment(scenes=[{"dataset": "mipnerf360", "only": ["garden", "room"], "images": "downscaled"}])
    assert [(scene.name, scene.images) for scene in scenes_of(built, Selection())] == [
        ("garden", "images_4"),
        ("room", "images_2"),
    ]


def words_after(command: tuple[str, ...], *options: str) -> list[str]:
    return [command[command.index(option) + 1] for option in options]


def test_commands_of_the_built_in_trainer(tmp_path: Path) -> None:
    hierarchy, measuring = run_steps(run_spec(3), tmp_path, None, tmp_path / "r", ["--lpips", "none"])
    assert words_after(hierarchy.command, "--levels", "--seed", "--iterations") == ["2", "3", "10"]
    assert measuring.command[-4:] == ("eval", str(tmp_path / "r"), "--lpips", "none")
    (bare,) = run_steps(run_spec(method="bare"), tmp_path, None, tmp_path / "r", None)
    assert words_after(bare.command, "--levels") == ["1"]


@pytest.mark.parametrize("checkout", [None, "fastgs"])
def test_experiments_choose_hooks(tmp_path: Path, checkout: str | None) -> None:
    (scene := tmp_path / "scene" / "images").mkdir(parents=True)
    Image.new("RGB", (64, 48)).save(scene / "0.jpg")
    assert all("hooks" in names for names in option_names().values()), "experiment files may set it"
    spec = run_spec(checkout=checkout, rasterizer=None if checkout else "cpu", options={"hooks": "none"})
    step = run_steps(spec, scene.parent, tmp_path, tmp_path / "r", None)[0]
    assert words_after(step.command, "--hooks") == ["none"]


@pytest.mark.parametrize("command", ["train", "run"])
def test_flags_on_and_off_are_words_that_the_command_knows(command: str, tmp_path: Path) -> None:
    parameters = typer.main.get_command(app).commands[command].params
    allowed = option_names()[command]
    flags = [option for option in parameters if option.name in allowed and getattr(option, "is_flag", False)]
    assert flags
    checkout = "fastgs" if command == "run" else None

    def words(**options: bool) -> list[str]:
        spec = run_spec(checkout=checkout, rasterizer=None if checkout else "cpu", options=options, resolution="1/2")
        steps = run_steps(spec, tmp_path, tmp_path if checkout else None, tmp_path / "r", None)
        return list(steps[0].command)

    for flag in flags:
        assert [word for word in words(**{flag.name: True}) if word not in words()] == [flag.opts[0]]
        assert [word for word in words(**{flag.name: False}) if word not in words()] == flag.secondary_opts


def test_commands_of_a_checkout(tmp_path: Path) -> None:
    spec = run_spec(checkout="fastgs", rasterizer=None, iterations=7000, arguments=["--mult", "0.7", "--dense", "0.1"])
    (scene := tmp_path / "scene" / "images").mkdir(parents=True)
    Image.new("RGB", (640, 480)).save(scene / "0.jpg")
    (step, _) = run_steps(spec, scene.parent, tmp_path, tmp_path / "r", [])
    script = step.command.index(str(tmp_path / "train.py"))
    before, after = step.command[:script], step.command[script:]
    assert "--levels" in before
    assert "--levels" not in after
    assert words_after(after, "--iterations", "--position_lr_max_steps", "--densify_until_iter") == [
        "7000",
        "7000",
        "3500",
    ]
    assert after.index("--dense") > after.index("--densify_until_iter"), "the experiment's own words win"

    training, importing, _ = bare_steps(tmp_path, ["--mult", "0.7"], options={"gpu_busy": True})
    assert training.command[3:9] == ("run", "--off", "--record", "--seed", "0", "--gpu-busy")
    assert "--iterations" not in training.command, "30,000 is what the script does by itself"
    assert words_after(importing.command, "--set", "--out") == ["mult=0.7", str(tmp_path / "r" / "lapgs")]


def test_checkouts_have_scripts_in_folders(tmp_path: Path) -> None:
    (tmp_path / "ms").mkdir()
    (tmp_path / "ms" / "train.py").write_text("")
    built = experiment(
        backbones={"mini": {"checkout": "mini", "script": "ms/train.py"}, "gs": {"checkout": "mini"}},
        variants=[{"name": "bare", "method": "bare"}],
        scenes=[{"name": "a", "path": "a", "resolution": "1/2"}],
    )
    mini, plain = (run.spec for run in plan_runs(built, Selection(seeds="0")))
    assert mini.run_id != plain.run_id
    places = Locations({"mini": tmp_path}, tmp_path)
    assert places.checkout("mini", mini.script) == tmp_path
    step = run_steps(mini, tmp_path, tmp_path, tmp_path / "r", None)[0]
    assert str(tmp_path / "ms/train.py") in step.command
    assert step.cwd == str(tmp_path)
    with pytest.raises(UserInputError, match=r"has no train\.py"):
        places.checkout("mini", plain.script)


def test_published_schedules_scale_with_the_length_of_a_run() -> None:
    built = experiment(
        backbones={"dash": {"checkout": "dash", "script": "train_dash.py", "preset": "dashgaussian.fast"}},
        variants=[{"name": "bare", "method": "bare"}, {"name": "short", "iterations": 10_000}],
        iterations=30_000,
    )
    spec, short = (run.spec for run in plan_runs(built, Selection(seeds="0", scenes=["a"])))
    assert words_after(tuple(spec.arguments), "--densify_until_iter") == ["27000"]
    assert words_after(tuple(short.arguments), "--densify_until_iter") == ["9000"]


def test_bare_runs_measure_held_out_views_along_the_way(tmp_path: Path) -> None:
    options = {"test_every": 1000, "prune": 0.01}
    built = experiment(
        backbones={"fast": {"checkout": "fastgs", "options": options}}, variants=[{"name": "bare", "method": "bare"}]
    )
    spec = plan_runs(built, Selection(seeds="0", scenes=["a"]))[0].spec
    assert spec.options == {"test_every": 1000}, "a script by itself prunes nothing"
    training = bare_steps(tmp_path, [], options=spec.options)[0]
    assert training.command[3:10] == ("run", "--off", "--record", "--seed", "0", "--test-every", "1000")


def bare_steps(folder: Path, arguments: list[str], **changes: Any) -> list[Step]:
    """Return the steps of a checkout's script by itself, evaluated."""
    spec = {"method": "bare", "resolution": "1/2", "iterations": 30_000, "options": {}, **changes}
    run = run_spec(checkout="fastgs", rasterizer=None, arguments=arguments, **spec)
    return run_steps(run, folder / "scene", folder, folder / "r", [])


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], []),
        (["--mult", "0.7", "--mult", "0.5"], ["--set", "mult=0.5"]),
        (["--mult=0.7", "--dense=0.1"], ["--set", "mult=0.7"]),
        (["--antialiasing", "-r", "2"], ["--set", "antialiasing=true"]),
        (["--antialiasing"], ["--set", "antialiasing=true"]),
        (["--dense", "mult"], []),
    ],
)
def test_arguments_that_change_how_a_field_is_rendered(
    arguments: list[str], expected: list[str], tmp_path: Path
) -> None:
    importing = bare_steps(tmp_path, arguments)[1].command
    assert list(importing[importing.index("--overwrite") + 1 :]) == expected


@pytest.mark.parametrize(
    ("resolution", "width", "expected"),
    [
        *(("1k", 4000, "1600"), ("1k", 800, "1"), ("2k", 4000, "2800"), ("4k", 4000, "1"), ("full", 4000, "1")),
        *(("1/4", 4000, "4"), ("800", 4000, "800"), ("3dgs:-1", 4000, "-1")),
    ],
)
def test_resolutions_as_scripts_take_them(tmp_path: Path, resolution: str, width: int, expected: str) -> None:
    (tmp_path / "images").mkdir()
    Image.new("RGB", (width, 8)).save(tmp_path / "images" / "0.png")
    spec = run_spec(checkout="fastgs", rasterizer=None, resolution=resolution)
    (step,) = run_steps(spec, tmp_path, tmp_path, tmp_path / "r", None)
    assert words_after(step.command, "-r") == [expected]


def test_a_fraction_that_scripts_cannot_read_is_refused(tmp_path: Path) -> None:
    spec = run_spec(checkout="fastgs", rasterizer=None, resolution="1/3")
    with pytest.raises(UserInputError, match="resolution '1/3'"):
        run_steps(spec, tmp_path, tmp_path, tmp_path / "r", None)


def test_folders_of_scenes_and_checkouts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built = experiment(scenes=[{"dataset": "mipnerf360", "only": ["garden"]}])
    (garden,) = scenes_of(built, Selection())
    for name in ("GARDEN", "MIPNERF360", "FASTGS"):
        monkeypatch.delenv(f"LAPGS_{name}", raising=False)
    with pytest.raises(
        UserInputError, match=r"scene garden.*--path garden=FOLDER \(LAPGS_GARDEN\) or --path mipnerf360"
    ):
        Locations({}, tmp_path).scene(garden)
    (tmp_path / "360" / "garden").mkdir(parents=True)
    monkeypatch.setenv("LAPGS_MIPNERF360", str(tmp_path / "360"))
    with pytest.raises(UserInputError, match="garden has no image folder images"):
        Locations({}, tmp_path).scene(garden)
    (tmp_path / "360" / "garden" / "images").mkdir()
    assert Locations({}, tmp_path).scene(garden) == tmp_path / "360" / "garden"
    with pytest.raises(UserInputError, match="nowhere is not a folder"):
        Locations({"garden": tmp_path / "nowhere"}, tmp_path).scene(garden)
    with pytest.raises(UserInputError, match=r"has no train\.py"):
        Locations({"fastgs": tmp_path}, tmp_path).checkout("fastgs", "train.py")
