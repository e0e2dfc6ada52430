"""Test mistakes with `lapgs run`: one line each, before training starts, and nothing is overwritten."""

from __future__ import annotations

import importlib
import logging
import math
import os
import re
import shutil
import subprocess
import sys
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from lapgs_plugin.adapters.registry import adapter_class
from lapgs_plugin.checkouts.cpu_device import cuda_on_cpu
from lapgs_plugin.checkouts.script import loaded_script, require_script
from lapgs_plugin.checkouts.source import CheckoutSource
from lapgs_plugin.cli import app
from lapgs_plugin.errors import (
    DeviceMemoryError,
    LapgsError,
    RunFolderError,
    SceneError,
    TrainingDivergedError,
    UserInputError,
)
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hooks import StageHook
from lapgs_plugin.runner.installed_packages import explain_import_error
from lapgs_plugin.runner.manifest import require_same_run
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import CACHE
from lapgs_plugin.runs.manifest import Manifest, SceneReference
from lapgs_plugin.viewer.preview import read_preview
from tests.contract.stub_runs import (
    CHECKOUTS,
    NAMES,
    SHORT,
    STUBS,
    StopAt,
    Stub,
    arguments,
    captured,
    drive,
    drive_residuals,
    forgetting_stubs,
    loaded,
    run_bare,
    run_hierarchy,
    run_residuals,
)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Copy the stub checkouts for a test to change."""
    return Path(shutil.copytree(CHECKOUTS, tmp_path / "checkouts", ignore=shutil.ignore_patterns("__pycache__")))


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def one_line(error: LapgsError) -> str:
    text = str(error)
    assert "\n" not in text
    return text


def nothing_written(folder: Path) -> bool:
    return not folder.exists() or not any(folder.iterdir())


OTHER_NAMES = {
    "train.py": {"dataset": "scene_args", "opt": "settings", "densify_and_prune": "densify_more"},
    "scene/gaussian_model.py": {"iteration": "step", "densify_and_prune": "densify_more"},
    "gaussian_renderer/__init__.py": {
        "import GaussianRasterizationSettings, GaussianRasterizer": "import GaussianRasterizationSettings as Settings, "
        "GaussianRasterizer as Rasterizer",
        "= GaussianRasterizationSettings": "= Settings",
        "= GaussianRasterizer": "= Rasterizer",
    },
}


def test_a_scene_that_does_not_exist_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match=r"nowhere does not exist; give the script its folder") as caught:
        run_residuals(STUBS["graphdeco"], tmp_path / "nowhere", tmp_path / "run")
    one_line(caught.value)


def test_a_scene_without_points_is_one_line(scene: Path, tmp_path: Path) -> None:
    """AbsGS writes such a PLY from a model whose points have no tracks."""
    shutil.copytree(scene, tmp_path / "scene")
    ply = tmp_path / "scene" / "sparse" / "0" / "points3D.ply"
    names = ("x", "y", "z", "red", "green", "blue")
    PlyData([PlyElement.describe(np.empty(0, [(name, "f4") for name in names]), "vertex")]).write(str(ply))
    with pytest.raises(SceneError, match=rf"{ply}: no points in it, expected the \d+ of the model; ") as caught:
        run_residuals(STUBS["graphdeco"], tmp_path / "scene", tmp_path / "run")
    assert f"lapgs train {tmp_path / 'scene'}" in one_line(caught.value)
    assert nothing_written(tmp_path / "run")


def test_a_file_of_points_that_is_not_there_is_one_line(scene: Path, tmp_path: Path) -> None:
    shutil.copytree(scene, tmp_path / "scene")
    model = tmp_path / "scene" / "sparse" / "0"
    for file in model.glob("points3D.*"):
        file.unlink()
    with pytest.raises(
        SceneError, match=rf"^{model}: the sparse model is incomplete, .* expected .*points3D"
    ) as caught:
        run_residuals(STUBS["graphdeco"], tmp_path / "scene", tmp_path / "run")
    one_line(caught.value)
    assert nothing_written(tmp_path / "run")


def test_a_checkout_with_other_names_trains_to_the_same_bits(copy: Path, scene: Path, tmp_path: Path) -> None:
    plys = []
    for name in ("as it is", "other names"):
        if name != "as it is":
            for file, names in OTHER_NAMES.items():
                path = copy / "graphdeco" / file
                text = path.read_text(encoding="utf-8")
                for old, new in names.items():
                    text = re.sub(rf"(?<![\w.'\"]){old}\b|(?<=gaussians\.){old}\b", new, text)
                path.write_text(text, encoding="utf-8")
            # Some keep an argument of the model in a local variable.
            edit(
                copy / "graphdeco" / "train.py",
                "    gaussians = GaussianModel(",
                "    kind = settings.optimizer_type\n    gaussians = GaussianModel(",
            )
        folder, script = tmp_path / name, copy / "graphdeco" / "train.py"
        more = ("--iterations", 15)
        with captured(folder, []), loaded(STUBS["graphdeco"], scene, folder, *more, script=script) as adapter:
            assert ("densify_more" in adapter.profile.density_control) == (name == "other names")
            drive_residuals(adapter)
        plys.append([RunArchive.open(folder).field_path(level).read_bytes() for level in (1, 0)])
    assert plys[0] == plys[1]


def test_a_model_without_a_role_is_named_with_its_place(copy: Path) -> None:
    script = copy / "graphdeco" / "train.py"
    edit(copy / "graphdeco" / "scene/gaussian_model.py", "def training_setup", "def setup_training")
    with pytest.raises(UserInputError, match="has a class with get_xyz and training_setup") as caught:
        CheckoutSource.read(script)
    assert "lapgs run --off" in one_line(caught.value)
    model = "class GaussianModel:\n    def training_setup(self): ...\n    def get_anchor(self): ...\n"
    (copy / "graphdeco" / "scene/gaussian_model.py").write_text(model)
    with pytest.raises(UserInputError, match=r"GaussianModel in scene/gaussian_model.py:1 lacks get_xyz"):
        CheckoutSource.read(script)


def test_folders_that_are_no_checkout(tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match="is not a file; expected the training script") as caught:
        require_script(tmp_path / "train.py")
    one_line(caught.value)
    (tmp_path / "train.py").write_text("print('no main block')\n")
    with pytest.raises(UserInputError, match="not the root of a 3DGS checkout: none of its train") as caught:
        adapter_class(tmp_path)
    one_line(caught.value)
    with pytest.raises(UserInputError, match="no `if __name__ ==") as caught, loaded_script(tmp_path / "train.py", []):
        pass
    one_line(caught.value)
    (tmp_path / "train.py").write_text("def (:\n")
    with pytest.raises(UserInputError, match="not a Python script") as caught, loaded_script(tmp_path / "train.py", []):
        pass
    one_line(caught.value)
    with pytest.raises(UserInputError, match=r"--backbone nerf: expected .*, generic$") as caught:
        adapter_class(tmp_path, "nerf")
    one_line(caught.value)
    with pytest.raises(UserInputError, match=r"--backbone taming: .* has no utils/taming_utils\.py") as caught:
        adapter_class(tmp_path, "taming")
    one_line(caught.value)


@pytest.mark.parametrize(
    ("name", "stand_in", "message"),
    [
        ("graphdeco", "graphdeco", "not the one of graphdeco 3DGS: it takes no antialiasing, expected"),
        ("graphdeco", "taming", "takes no antialiasing and wants pixel_weights, expected"),
        ("taming", "graphdeco-aa", "not the one of Taming-3DGS: it takes no pixel_weights and wants antialiasing"),
        ("taming", "taming-rasterizer", "takes no pixel_weights"),
    ],
)
def test_the_wrong_rasterizer_is_said_before_training(
    name: str, stand_in: str, message: str, scene: Path, tmp_path: Path
) -> None:
    """Several code bases have different rasterizers of one name."""
    with (
        captured(tmp_path, []),
        loaded(STUBS[name], scene, tmp_path / "run", stand_in=stand_in) as adapter,
        pytest.raises(UserInputError, match="the installed diff_gaussian_rasterization is") as caught,
    ):
        drive(adapter)
    assert message in one_line(caught.value)
    assert nothing_written(tmp_path / "run")


@pytest.mark.parametrize(
    ("absent", "purpose"),
    [
        ("diff_gaussian_rasterization_fastgs", "rasterizer of FastGS"),
        ("simple_knn._C", "nearest neighbours"),
        ("fused_ssim", "fast SSIM"),
    ],
)
def test_no_rasterizer_at_all(absent: str, purpose: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without stand-ins, where the extension is not installed or was built for another PyTorch."""
    monkeypatch.setitem(sys.modules, absent, None)  # which makes importing it fail
    with pytest.raises(ImportError) as caught:
        importlib.import_module(absent)
    line = explain_import_error(caught.value, Path("train.py"), on_cpu=False)
    assert line is not None
    for part in (f"train.py needs {absent.partition('.')[0]}", purpose, "--device cpu"):
        assert part in one_line(line)
    assert explain_import_error(ModuleNotFoundError("no", name="numpy"), Path("train.py"), on_cpu=False) is None


@pytest.mark.parametrize("stub", [Stub("graphdeco", "graphdeco-aa", ("--disable_viewer",)), STUBS["fastgs"]])
def test_sparse_adam_that_is_not_installed(stub: Stub, scene: Path, tmp_path: Path) -> None:
    """FastGS imports it from a module that is not its own rasterizer."""
    with pytest.raises(UserInputError, match="found no SparseGaussianAdam to import") as caught:
        run_hierarchy(stub, scene, tmp_path / "run", "--optimizer_type", "sparse_adam")
    one_line(caught.value)
    assert nothing_written(tmp_path / "run")


@pytest.mark.parametrize("name", ["taming", "graphdeco"])
def test_lpips_of_a_report_is_tried_before_training(name: str, scene: Path, tmp_path: Path) -> None:
    """Networks are downloaded at the first report; without a connection hours of training would be lost."""
    tried: list[str] = []

    def lpips(image: torch.Tensor, photo: torch.Tensor, net_type: str) -> torch.Tensor:
        tried.append(net_type)
        torch.rand(7)
        raise OSError("no route to host\nsecond line")

    more = ("--test_iterations", 7_000, 60)
    with captured(tmp_path, []), loaded(STUBS[name], scene, tmp_path / "run", *more) as adapter:
        vars(adapter.train)["lpips"] = lpips
        with pytest.raises(UserInputError, match=r"--test_iterations 60: .*OSError: no route to host") as caught:
            drive(adapter)
    assert tried == ["vgg"]
    assert "--test_iterations -1" in one_line(caught.value)
    assert nothing_written(tmp_path / "run")


@pytest.mark.parametrize("name", NAMES)
def test_a_field_that_is_pruned_away_is_one_line(name: str, scene: Path, tmp_path: Path) -> None:
    """Every Gaussian turns transparent in the second stage, just before the backbone prunes."""
    folder = tmp_path / "run"
    method = {"fastgs": "densify_and_prune_fastgs", "taming": "densify_with_score", "graphdeco": "densify_and_prune"}[
        name
    ]
    with captured(tmp_path, []), loaded(STUBS[name], scene, folder, "--iterations", 60) as adapter:
        model = adapter.train.GaussianModel
        original = getattr(model, method)

        @wraps(original)
        def spy(self: Any, *args: Any, **kwargs: Any) -> None:
            original(self, *args, **kwargs)
            if RunArchive.open(folder).available_levels:
                self.prune_points(torch.ones(len(self.get_xyz), dtype=torch.bool))

        setattr(model, method, spy)
        with pytest.raises(TrainingDivergedError, match=r"no Gaussian at level 0, iteration [0-9]+ of 40") as caught:
            drive_residuals(adapter)
    assert "finished levels (1) are kept" in one_line(caught.value)
    assert RunArchive.open(folder).available_levels == (1,)


def test_a_field_that_diverges_is_one_line(scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A position becomes NaN before iteration 11 of the first level."""
    folder = tmp_path / "run"
    with captured(tmp_path, []), loaded(STUBS["graphdeco"], scene, folder, "--densify_until_iter", 0) as adapter:
        model = adapter.profile.model
        original = model.update_learning_rate

        @wraps(original)
        def spy(self: Any, iteration: int) -> Any:
            if iteration == 10:
                self._xyz.data[3, 0] = math.nan
            return original(self, iteration)

        model.update_learning_rate = spy
        with pytest.raises(TrainingDivergedError, match="level 1, iteration 30 of 30, first seen after") as caught:
            drive(adapter, split="1/3,2/3")
    assert "after iteration 10: x is NaN or inf for 1 of" in one_line(caught.value)
    assert caplog.text.count("positions of NaN or inf after iteration 10;") == 1
    assert RunArchive.open(folder).available_levels == ()


REFUSED: list[tuple[str, tuple[Any, ...], str]] = [
    *((name, ("--start_checkpoint", "chkpnt.pth"), "a checkpoint holds one field, not a hierarchy") for name in NAMES),
    *((name, ("--random_background",), "rendered over one background") for name in NAMES),
    *((name, ("--convert_SHs_python",), "fails without lapgs too") for name in NAMES),
    ("taming", ("--benchmark_dir", "times"), "would write every stage's timings over the last one's"),
]


@pytest.mark.parametrize(("name", "options", "message"), REFUSED)
def test_options_that_a_hierarchy_cannot_honour(
    name: str, options: tuple[Any, ...], message: str, scene: Path, tmp_path: Path
) -> None:
    with pytest.raises(UserInputError) as caught:
        run_residuals(STUBS[name], scene, tmp_path / "run", *options)
    assert message in one_line(caught.value)
    assert str(options[0]) in str(caught.value)
    assert nothing_written(tmp_path / "run")


def test_one_level_takes_a_random_background(scene: Path, tmp_path: Path) -> None:
    more = ("--random_background", "--iterations", 4)
    archive, _ = run_hierarchy(STUBS["graphdeco"], scene, tmp_path / "run", *more, levels=1)
    assert archive.manifest.complete


def test_a_hierarchy_that_does_not_fit_the_scene(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match="level 2 of 3 would be 16x12 pixels") as caught:
        run_residuals(STUBS["graphdeco"], scene, tmp_path / "run", levels=3)
    one_line(caught.value)


@pytest.mark.skipif(sys.platform != "linux", reason="a folder in /proc cannot be made")
@pytest.mark.parametrize(
    ("folder", "message"), [("/proc/run", "^-m /proc/run"), ("r\udcff", r"^-m r\\udcff: not UTF-8")]
)
def test_an_output_folder_that_cannot_be_used_is_refused_before_the_photos_are_read(
    folder: str, message: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserInputError, match=message):
        run_hierarchy(STUBS["graphdeco"], scene / "gone", Path(folder), *SHORT)
    assert list(tmp_path.iterdir()) == []


def test_two_runs_into_one_folder(scene: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    archive, _ = run_hierarchy(STUBS["graphdeco"], scene, folder, *SHORT)
    before = {level: archive.field_path(level).read_bytes() for level in (1, 0)}
    for name in ("graphdeco", "taming"):
        with pytest.raises(RunFolderError, match=r"already holds a run; continue it with --resume .* or replace it"):
            run_hierarchy(STUBS[name], scene, folder, *SHORT)
    with pytest.raises(RunFolderError, match="started with another"):
        run_hierarchy(STUBS["graphdeco"], scene, folder, *SHORT, resume=True, grid="even")
    assert {level: archive.field_path(level).read_bytes() for level in (1, 0)} == before


def test_a_run_that_failed_before_its_first_iteration_does_not_block_its_folder(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run_hierarchy(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT, hooks=[StopAt(1)])
    assert (tmp_path / "run" / "manifest.json").exists()
    archive, _ = run_hierarchy(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT)
    assert archive.available_levels == (1, 0)


def test_a_folder_of_the_backbone_itself_is_not_written_over(scene: Path, tmp_path: Path) -> None:
    run_bare(STUBS["graphdeco"], scene, tmp_path / "run", "--iterations", 2)
    with pytest.raises(RunFolderError, match="is not empty and not a run"):
        run_hierarchy(STUBS["graphdeco"], scene, tmp_path / "run")


def test_files_that_the_script_has_just_written_are_no_others(copy: Path, scene: Path, tmp_path: Path) -> None:
    """As of forks whose main blocks save their arguments before they train, and take what training returns."""
    script, folder = copy / "graphdeco" / "train.py", tmp_path / "run"
    call = "    training(\n        lp.extract(args)"
    edit(script, call, f"    os.makedirs(args.model_path + '/log/args', exist_ok=True)\n    taken, = {call.lstrip()}")
    edit(script, "\n\n\ndef prepare_output_and_logger", "\n    return [iteration]\n\n\ndef prepare_output_and_logger")

    def run() -> None:
        with captured(folder, []), loaded(STUBS["graphdeco"], scene, folder, "--iterations", 4, script=script) as own:
            drive(own, levels=1)

    (folder / "log").mkdir(parents=True)
    (folder / "log" / "mine").touch()
    os.utime(folder / "log" / "mine", (0, 0))
    with pytest.raises(RunFolderError, match=r"is not empty and not a run \(it holds log\)"):
        run()
    shutil.rmtree(folder)
    run()
    assert RunArchive.open(folder).manifest.complete


def test_a_run_is_resumed_with_the_same_options_only(scene: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        run_residuals(STUBS["graphdeco"], scene, folder, hooks=(StopAt(0),))
    for more, options, named in (
        (("--iterations", 120), {}, r"another iterations \("),
        ((), {"inherit": "xyz"}, r"another inherit \("),
        (("-r", 60), {}, r"another resolution of the scene \('3dgs:-1', now '3dgs:60'\)"),
        (("--lambda_dssim", 0.5), {}, "--lambda_dssim 0.5: this run was started without it"),
    ):
        with pytest.raises(RunFolderError, match=named) as caught:
            run_residuals(STUBS["graphdeco"], scene, folder, *more, resume=True, **options)
        one_line(caught.value)


def test_a_run_with_the_split_of_an_earlier_default_is_told_which() -> None:
    scene = SceneReference("scene", "3dgs:-1", True, (0.0, 0.0, 0.0), "colmap")

    def manifest(split: str | None) -> Manifest:
        settings = RunSettings(hierarchy="nested", split=split).for_manifest()
        return Manifest(scene, 2, "camera", "reconstructed", "xyz", 3, "cpu", 0, settings)

    with pytest.raises(RunFolderError, match="resume with --split 1/2,1/2, or") as caught:
        require_same_run(manifest("1/2,1/2"), manifest(None))
    one_line(caught.value)
    require_same_run(manifest("1/2,1/2"), manifest("1/2,1/2"))


class FillsTheGpu(StageHook):
    def on_stage_start(self, stage: Stage) -> None:
        if stage.level == 0:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.\nGPU 0 has ...")


def test_out_of_gpu_memory_names_the_stage_and_keeps_the_others(scene: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with pytest.raises(DeviceMemoryError) as caught:
        run_hierarchy(STUBS["graphdeco"], scene, folder, *SHORT, hooks=(FillsTheGpu(),))
    message = one_line(caught.value)
    for part in ("out of GPU memory at level 0", "finished levels (1) are kept", "--resume", "images", "2.00 GiB"):
        assert part in message
    assert RunArchive.open(folder).available_levels == (1,)
    # The message suggests another place for images.
    faster = {"run_ahead": False, "fused_adam": False, "fused_ssim": False}
    archive, _ = run_hierarchy(STUBS["graphdeco"], scene, folder, *SHORT, resume=True, images_on="disk", **faster)
    assert archive.manifest.complete
    assert not archive.path(CACHE).exists()


def test_from_the_command_line(scene: Path, tmp_path: Path) -> None:
    """`lapgs run` inside a checkout passes on the script's arguments and output."""
    stub = STUBS["graphdeco"]
    words = arguments(stub, scene, tmp_path / "run", ("--iterations", 30))
    command = [sys.executable, "-c", "from lapgs_plugin.cli import main; main()", "run", "--device", "cpu"]
    done = subprocess.run(
        [*command, "train.py", *words], capture_output=True, text=True, check=False, cwd=stub.script.parent
    )
    assert done.returncode == 0, done.stderr
    assert "Training complete." in done.stdout
    assert RunArchive.open(tmp_path / "run").manifest.complete
    assert read_preview(tmp_path / "run") is not None, "the picture that `lapgs view` shows first"


@pytest.fixture
def lapgs_run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Return a function that runs `lapgs run` in this process and returns exit code and lines of stderr."""
    root = logging.getLogger()
    before = root.handlers[:], logging.getLogger("lapgs_plugin").level
    choice = logging.getLogger("lapgs_plugin.rasterizers.choice")
    of_choice = choice.level

    def run(*words: Any) -> tuple[int, list[str]]:
        monkeypatch.setattr(sys, "argv", ["lapgs", "run", *map(str, words)])
        with forgetting_stubs(), pytest.raises(SystemExit) as caught:
            app.run()
        return int(caught.value.code or 0), capsys.readouterr().err.strip().splitlines()

    yield run
    root.handlers[:] = before[0]
    logging.getLogger("lapgs_plugin").setLevel(before[1])
    choice.setLevel(of_choice)


def test_mistakes_are_one_line_and_exit_code_2(lapgs_run: Any, scene: Path, tmp_path: Path) -> None:
    run_bare(STUBS["taming"], scene, tmp_path / "run", "--iterations", 2, "--densify_from_iter", 10)
    words = arguments(STUBS["taming"], scene, tmp_path / "run")
    code, lines = lapgs_run("--device", "cpu", STUBS["taming"].script, *words)
    assert code == 2
    assert lines[-1].startswith("lapgs: ")
    assert "is not empty and not a run" in lines[-1]
    assert not any("Traceback" in line for line in lines)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--hierarchy", "flat"], "--hierarchy flat: expected nested or laplacian"),
        (
            ["--hierarchy", "nested", "--inherit", "geometry"],
            "--inherit geometry: is about residuals, and nested levels have none; leave it out, or add --hierarchy lap",
        ),
    ],
)
def test_what_nested_levels_cannot_honour_is_refused(
    words: list[str], message: str, lapgs_run: Any, scene: Path, tmp_path: Path
) -> None:
    of_script = arguments(STUBS["graphdeco"], scene, tmp_path / "run")
    code, lines = lapgs_run("--device", "cpu", *words, STUBS["graphdeco"].script, *of_script)
    assert code == 2
    (line,) = lines
    assert line.startswith(f"lapgs: {message}")
    assert nothing_written(tmp_path / "run")


@pytest.mark.parametrize(
    ("words", "settings", "iterations"),
    [
        ((), {"hierarchy": "laplacian", "joint": 0.5, "coarse_threshold": 1.0}, [10, 20]),
        (("--hierarchy", "nested"), {"hierarchy": "nested", "joint": 0.0, "coarse_threshold": 2.0}, [10, 20]),
        (("--protocol", "paper"), {"joint": 0.0, "residual_color_rate": 1.0, "inherit": "xyz"}, [10, 20]),
        (
            ("--joint", "0", "--coarse-threshold", "2", "--residual-color-rate", "1"),
            {"joint": 0.0, "coarse_threshold": 2.0, "residual_color_rate": 1.0},
            [10, 20],
        ),
    ],
)
def test_defaults_go_with_the_hierarchy(
    words: tuple[str, ...],
    settings: dict[str, Any],
    iterations: list[int],
    lapgs_run: Any,
    scene: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The manifest has the defaults of the hierarchy. Residuals are the default hierarchy."""
    monkeypatch.chdir(tmp_path)
    of_script = arguments(STUBS["graphdeco"], scene, Path("run"), ("--iterations", 30))
    code, _ = lapgs_run("--device", "cpu", *words, STUBS["graphdeco"].script, *of_script)
    assert code == 0
    assert caplog.messages[-1] == "run folder: run; next: `lapgs eval run`", "as it was named; the preview says nothing"
    manifest = RunArchive.open(tmp_path / "run").manifest
    assert {name: {"inherit": manifest.inherit, **manifest.settings}[name] for name in settings} == settings
    assert [record.iterations for record in manifest.records] == iterations
    assert [record.signed for record in manifest.records] == [False, "nested" not in words]
    code, lines = lapgs_run("--device", "cpu", *words, STUBS["graphdeco"].script, *of_script)
    assert (code, lines[-1].partition(" already holds a run")[0]) == (2, "lapgs: run")


@pytest.mark.parametrize(("words", "joint"), [((), 0.25), (("--joint", "0.75"), 0.75)])
def test_less_of_a_stage_is_joint_where_photos_are_large(
    words: tuple[str, ...],
    joint: float,
    lapgs_run: Any,
    scene: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("lapgs_plugin.hierarchy.settings.LARGE_IMAGE", 1)
    of_script = arguments(STUBS["graphdeco"], scene, tmp_path / "run", ("--iterations", 30))
    code, _ = lapgs_run("--device", "cpu", *words, STUBS["graphdeco"].script, *of_script)
    assert code == 0
    assert RunArchive.open(tmp_path / "run").manifest.settings["joint"] == joint


def test_the_scripts_own_mistakes_are_its_own(lapgs_run: Any, tmp_path: Path) -> None:
    code, lines = lapgs_run("--device", "cpu", STUBS["taming"].script, "--no_such_option", "-m", tmp_path / "run")
    assert code == 2
    assert "unrecognized arguments: --no_such_option" in lines[-1], "argparse's own words"
    (tmp_path / "empty").mkdir()
    code, lines = lapgs_run("--device", "cpu", STUBS["taming"].script, "-s", tmp_path / "empty", "-m", tmp_path / "run")
    assert code == 1
    assert lines[-1] == "AssertionError: Could not recognize scene type!", "with its traceback"


@pytest.mark.parametrize("word", ["--hierarchy", "--hierarchy=nested"])
def test_our_option_after_the_script_is_told_its_place(word: str, lapgs_run: Any, scene: Path, tmp_path: Path) -> None:
    script = STUBS["taming"].script
    code, lines = lapgs_run("--device", "cpu", script, "-s", scene, "-m", tmp_path / "run", word)
    assert code == 2
    assert "unrecognized arguments: --hierarchy" in lines[-2], "argparse's own words"
    assert lines[-1] == f"lapgs: --hierarchy is an option of `lapgs run`: if it is meant, give it before {script}"
    assert not (tmp_path / "run").exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_a_cpu_that_nobody_asked_for_is_said(lapgs_run: Any, caplog: pytest.LogCaptureFixture) -> None:
    lapgs_run("--device", "cpu", STUBS["taming"].script, "--no_such_option")
    assert "no CUDA device" not in caplog.text
    lapgs_run(STUBS["taming"].script, "--no_such_option")
    assert "no CUDA device: the script runs on the CPU" in caplog.text


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_cuda_that_is_not_there(lapgs_run: Any, scene: Path) -> None:
    code, lines = lapgs_run("--device", "cuda", STUBS["taming"].script, "-s", scene)
    assert code == 2
    assert lines[-1].startswith("lapgs: --device cuda: PyTorch finds no CUDA device")


def test_nothing_is_left_of_a_refused_run(scene: Path, tmp_path: Path) -> None:
    """After an error the same process can run another checkout."""
    with pytest.raises(UserInputError):
        run_residuals(STUBS["taming"], scene, tmp_path / "run", "--random_background")
    archive, _ = run_hierarchy(STUBS["graphdeco"], scene, tmp_path / "run", "--iterations", 30)
    assert archive.manifest.settings["backbone"]["name"] == "graphdeco"
    with cuda_on_cpu("fastgs"):
        pass
