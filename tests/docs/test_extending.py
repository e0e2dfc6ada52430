"""The code blocks of docs/extending.md do what the page says."""

from __future__ import annotations

import copy
import importlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor
from typer.testing import CliRunner

import lapgs_plugin
from lapgs_plugin import ops
from lapgs_plugin.adapters.registry import adapter_class
from lapgs_plugin.cli.app import app
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.spherical_harmonics import SH_C0
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hierarchy.settings import HierarchySettings
from lapgs_plugin.hierarchy.supervision import SUPERVISIONS
from lapgs_plugin.hooks import FieldInTraining, HookDispatcher, StageContext, entry_point_hooks, hooks_line
from lapgs_plugin.patching.engine import Target, plan_apply
from lapgs_plugin.patching.recipe import load_recipes
from lapgs_plugin.rasterizers.choice import RASTERIZERS
from lapgs_plugin.scenes import load_scene
from lapgs_plugin.scenes.sample import make_sample_scene
from tests.cli.run_folder import write_run, write_scene
from tests.docs.documents import ROOT, blocks
from tests.plugin_package import REGISTRIES

try:
    import tomllib
except ModuleNotFoundError:  # before Python 3.11
    import tomli as tomllib

PAGE = ROOT / "docs/extending.md"
FILES = {block.title: block.text for block in blocks(PAGE) if block.title}


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Install the package that the page describes, as pip would."""
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "my_extension/__init__.py").touch()
    project = tomllib.loads(FILES["pyproject.toml"])["project"]
    info = tmp_path / f"my_extension-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    lines: list[str] = []
    for group, entries in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {value}" for name, value in entries.items())]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    monkeypatch.syspath_prepend(tmp_path)
    for registry in REGISTRIES:
        vars(registry).pop("entries", None)
    yield tmp_path
    for registry in REGISTRIES:
        vars(registry).pop("entries", None)
    for name in [name for name in sys.modules if name.split(".")[0] == "my_extension"]:
        del sys.modules[name]


def context(signed: bool) -> StageContext:
    stage = Stage(0 if signed else 1, (8, 6), 10, signed=signed)
    image = torch.rand(3, 6, 8)
    return StageContext(stage, 1, "view", image, accumulated=image / 2 if signed else None)


@pytest.mark.parametrize("name", FILES)
def test_each_is_under_forty_lines(name: str) -> None:
    assert len(FILES[name].splitlines()) < 40


@pytest.mark.usefixtures("installed")
def test_the_hook_adds_to_the_loss_of_residual_stages() -> None:
    hook = entry_point_hooks()[1]
    assert type(hook).__name__ == "Smooth"
    both = "depth (my_extension.depth:Depth), smooth (my_extension.hooks:Smooth)"
    assert hooks_line() == f"hooks of installed packages: {both}"
    image = torch.zeros(3, 6, 8)
    image[:, 3:] = 1.0  # one edge, across 8 of 5 * 8 vertical steps
    term = HookDispatcher([hook]).extra_loss(context(signed=True), image)
    assert isinstance(term, Tensor)
    assert term.item() == pytest.approx(1e-3 / 5)
    assert HookDispatcher([hook]).extra_loss(context(signed=False), image) is None


@pytest.mark.usefixtures("installed")
def test_the_hook_compares_depths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One Gaussian at depth 2; known is 4 in the upper half of the image."""
    monkeypatch.chdir(tmp_path)
    hook = entry_point_hooks()[0]
    means = torch.tensor([[0.0, 0.0, 2.0]], requires_grad=True)
    points = lapgs_plugin.field_from_points(means.detach(), torch.full((1, 3), 0.5), 0)
    field = points.with_parameters({"means": means, "log_scales": torch.zeros(1, 3)})
    camera = lapgs_plugin.Camera(8, 6, 8.0, 8.0, 4.0, 3.0, torch.eye(4))
    shown = FieldInTraining(field, camera, lapgs_plugin.CpuRasterizer())
    here, image = replace(context(signed=False), field=shown), torch.rand(3, 6, 8)
    assert hook.loss(here, image) is None
    known = np.zeros((12, 16), np.float32)
    known[:6] = 4.0
    (tmp_path / "depths").mkdir()
    np.save(tmp_path / "depths" / f"{here.view}.npy", known)
    term = hook.loss(here, image)
    assert term is not None
    half = shown.depth()[1][:3].sum().item()  # a blended depth of twice the opacity, where four times is known
    assert term.item() == pytest.approx(0.1 * half * (4 - 2) / 4 / 48)
    term.backward()
    assert means.grad is not None
    assert means.grad[0, 2] < 0  # farther away it is better
    assert hook.loss(replace(here, field=None), image) is None
    assert hook.loss(replace(here, stage=context(signed=True).stage), image) is None


@pytest.mark.usefixtures("installed")
def test_the_supervision_is_chosen_by_its_name() -> None:
    settings = HierarchySettings(hierarchy="laplacian", supervision="clamped")
    prediction, target = SUPERVISIONS[settings.supervision].pair(
        torch.tensor([[[-0.5, 0.5, 1.5]]]), torch.ones(1, 1, 3), torch.zeros(1, 1, 3), None
    )
    assert prediction.tolist() == [[[0.0, 0.5, 1.0]]]
    assert target.tolist() == [[[1.0, 1.0, 1.0]]]
    assert settings.joint_from(Stage(0, (8, 6), 100, signed=True)) == 76  # it composes


def test_the_backbone_is_recognised_by_its_files(installed: Path, tmp_path: Path) -> None:
    checkout = tmp_path / "checkout"
    shutil.copytree(ROOT / "tests/contract/checkouts/graphdeco", checkout)
    assert adapter_class(checkout).info.name == "graphdeco"
    (checkout / "utils/my_scores.py").touch()
    adapter = adapter_class(checkout)
    assert (adapter.info.name, adapter) == ("my_fork", adapter_class(checkout, "my_fork"))
    assert "my_threshold" in adapter.info.densify_thresholds
    original = SimpleNamespace(image_width=80, blur=4.0, alpha_mask=None, invdepthmap=None)
    view = copy.copy(original)
    script: Any = SimpleNamespace(module=SimpleNamespace(SPARSE_ADAM_AVAILABLE=False))
    adapter(script).level_view(view, original, (40, 30), signed=False)
    assert (view.blur, original.blur) == (2.0, 4.0)
    opt = SimpleNamespace(densify_grad_threshold=1.0)
    call: Any = SimpleNamespace(dataset=SimpleNamespace(), opt=opt, pipe=None, copied=lambda parsed: call)
    window: Any = SimpleNamespace(stage=Stage(1, (40, 30), 10, signed=False), threshold_factor=2.0)
    with pytest.raises(UserInputError, match="--backbone my_fork: the script has no option my_threshold"):
        adapter(script).stage_call(call, window, "folder")


def test_the_strategy_and_the_rasterizer_train_by_name(installed: Path, tmp_path: Path) -> None:
    scene, run = tmp_path / "scene", tmp_path / "run"
    make_sample_scene(scene, width=32, height=24, views=6, points=60, progress=False)
    words = (
        "--iterations",
        "40",
        "--levels",
        "1",
        "--densify-every",
        "10",
        "--strategy",
        "opaque",
        "--duplicates",
        "7",
        "--rasterizer",
        "discs",
    )
    done = subprocess.run(
        [sys.executable, "-m", "lapgs_plugin", "train", scene, "-o", run, *words],
        env={**os.environ, "PYTHONPATH": str(installed)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "smooth (my_extension.hooks:Smooth)" in done.stdout + done.stderr
    manifest = lapgs_plugin.RunArchive.open(run).manifest
    assert manifest.rasterizer == "discs"
    added = manifest.record(0).num_gaussians - 60
    assert added > 0
    assert added % 7 == 0


@pytest.mark.usefixtures("installed")
def test_the_rasterizer_blends_front_to_back_and_leaves_statistics() -> None:
    camera = lapgs_plugin.Camera(5, 3, 10.0, 10.0, 2.5, 1.5, torch.eye(4))
    far, near = (0.0, 0.0, 2.0), (0.0, 0.0, 1.0)  # both in the middle of the middle pixel
    field = lapgs_plugin.GaussianField(
        means=torch.tensor([far, near], requires_grad=True),
        quaternions=torch.tensor([[1.0, 0, 0, 0]] * 2),
        log_scales=torch.zeros(2, 3),
        opacity_logits=torch.zeros(2),
        sh=torch.tensor([[[1.0, 0, 0]], [[0, 1.0, 0]]]) / SH_C0,
        signed=True,
    )
    result = RASTERIZERS["discs"]()(field, camera, background=torch.tensor([0.0, 0.0, 1.0]))
    torch.testing.assert_close(result.image[:, 1, 2], torch.tensor([0.25, 0.5, 0.25]))
    assert result.radii.tolist() == [16, 31]  # three times 10 / 2 + 0.3 and 10 / 1 + 0.3
    result.image[:, :, 3:].sum().backward()
    assert result.means2d.grad is not None
    assert result.means2d.grad.shape == (2, 2)


@pytest.mark.usefixtures("installed")
def test_the_reader_makes_a_scene(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    for name in ("a.png", "b.png"):
        Image.new("RGB", (64, 48), (90, 120, 150)).save(tmp_path / "images" / name)
    (tmp_path / "capture.csv").write_text("a,0,0,0\nb,0.5,0.25,-1\n")
    scene = load_scene(tmp_path, progress=False)
    assert scene.kind == "capture_csv"
    assert [view.camera.position.tolist() for view in scene.train] == [[0, 0, 0], [0.5, 0.25, -1]]
    (tmp_path / "capture.csv").write_text("a,0,0,0\nb,0,nan,0\n")
    with pytest.raises(UserInputError, match="b is '0 nan 0', expected 3 finite numbers"):
        load_scene(tmp_path, progress=False)


@pytest.mark.usefixtures("installed")
def test_the_command_prints_the_levels_of_a_run(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", write_scene(tmp_path / "scene"), levels=2)
    records = lapgs_plugin.RunArchive.open(run).manifest.records
    printed = CliRunner().invoke(app, ["sizes", str(run)]).stdout
    assert printed == "".join(f"{record.level} {record.num_gaussians}\n" for record in records)
    assert "--least 0: expected at least 1" in str(
        CliRunner().invoke(app, ["sizes", str(run), "--least", "0"]).exception
    )
    assert "Print the number of Gaussians" in CliRunner().invoke(app, ["--help"]).stdout


@pytest.mark.usefixtures("installed")
def test_the_report_is_made_for_a_folder_with_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "runs/hall"
    folder.mkdir(parents=True)
    (folder / "capture.txt").write_text("f < 8")
    monkeypatch.chdir(tmp_path)
    for words in ([str(folder)], []):  # the newest in runs/
        assert "report.html shows the capture" in CliRunner().invoke(app, ["report", *words]).stdout
        assert (folder / "report.html").read_text() == "<pre>f &lt; 8</pre>"
        (folder / "report.html").unlink()


@pytest.fixture
def tone(installed: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The page's operation, as if its folder were in the package."""
    monkeypatch.setattr(ops, "__path__", [*ops.__path__, str(installed / "lapgs_plugin/ops")])
    yield importlib.import_module("lapgs_plugin.ops.tone")
    for name in [name for name in sys.modules if name.startswith("lapgs_plugin.ops.tone")]:
        del sys.modules[name]


def test_the_operation_is_pytorchs_on_a_cpu(tone: Any) -> None:
    assert tone.tone(torch.tensor([0.0, 1.0]), 2.0, 0.5).tolist() == [0.5, 2.5]
    assert not tone.triton_works(torch.zeros(1))
    assert not tone.triton_works.passes_on(torch.device("cpu"))  # no Triton, or none for CPUs


@pytest.mark.gpu
def test_the_operation_is_one_kernel_on_a_gpu(tone: Any) -> None:
    image = torch.rand(3, 50, 70, device="cuda")
    assert tone.triton_works(image)
    torch.testing.assert_close(tone.tone(image, 2.0, 0.5), image * 2 + 0.5, rtol=0, atol=1e-6)


def test_no_file_on_the_page_is_without_a_test() -> None:
    package = {
        "pyproject.toml",
        *(
            f"my_extension/{name}.py"
            for name in (
                "hooks",
                "depth",
                "supervision",
                "backbone",
                "strategy",
                "rasterizer",
                "scenes",
                "sizes",
                "report",
            )
        ),
    }
    operation = {f"lapgs_plugin/ops/tone/{name}.py" for name in ("__init__", "in_torch", "in_triton")}
    assert FILES.keys() == package | operation | {"patches/my-rasterizer.toml"}


def test_the_recipe_recognises_and_patches_its_rasterizer(installed: Path) -> None:
    source = installed / "my_rasterizer.cu"
    source.write_text(
        '#include "my_rasterizer.h"\n__device__ float blend(float colour, int degree) {\n'
        "\treturn max(colour + 0.5f, 0.0f);\n}\n"
    )
    (recipe,) = load_recipes(installed / "patches")
    assert recipe.recognises(installed)
    (change,) = plan_apply(Target(recipe, installed), {"signed-color", "build-cuda13"})
    text = change.after.decode()
    assert "#include <cfloat>" in text
    assert "degree < 0 ? colour : max(colour + 0.5f, 0.0f)" in text
