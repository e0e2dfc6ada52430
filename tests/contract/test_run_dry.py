"""Test the dry run of `lapgs run`: it changes nothing, and what fails in it is one line with its place."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from lapgs_plugin.errors import DeviceMemoryError, UserInputError
from lapgs_plugin.hooks import StageContext, StageHook
from lapgs_plugin.rasterizers.signed_color import signed_degree
from lapgs_plugin.runner import dry_run
from lapgs_plugin.runner.stage_views import StageViews
from lapgs_plugin.runs.archive import RunArchive
from tests.contract.stub_runs import (
    CHECKOUTS,
    NAMES,
    STUBS,
    Result,
    StopAt,
    captured,
    drive,
    edited_graphdeco,
    loaded,
    run_bare,
)

SHORT = ("--iterations", 15)


class Points(NamedTuple):
    """Points of a fork that has no normals, and a number of each point besides."""

    points: np.ndarray
    colors: np.ndarray
    normals: None
    seen: list[int]


def test_it_starts_from_some_points_whatever_a_fork_has_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dry_run, "MOST_POINTS", 3)
    points = Points(np.arange(21).reshape(7, 3), np.ones((7, 3)), None, list(range(7)))
    some = dry_run._some(points)
    assert (some.points[:, 0].tolist(), len(some.colors), some.normals, some.seen) == ([0, 9, 18], 3, None, [0, 3, 6])


@pytest.mark.parametrize("name", NAMES)
def test_a_run_after_a_dry_run_is_the_bare_run(name: str, scene: Path, tmp_path: Path) -> None:
    """Random numbers, arguments, printed output and TensorBoard's log are as without it."""
    bare = run_bare(STUBS[name], scene, tmp_path / "bare", *SHORT)
    results: list[Result] = []
    with captured(tmp_path, results), loaded(STUBS[name], scene, tmp_path / "run", *SHORT) as adapter:
        drive(adapter, levels=1, dry_run=True)
    assert results[0].losses == bare.losses
    assert RunArchive.open(tmp_path / "run").manifest.complete
    printed = [line for line in results[0].lines if "initialisation" in line]
    assert len(printed) == 1, "the dry run prints nothing"


def test_the_line_of_an_error_is_in_the_checkout_or_in_a_packages_adapter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    modules = {}
    for name in ("checkout/scene", "site/tiny_adapter", "site/elsewhere"):
        path = tmp_path / f"{name}.py"
        path.parent.mkdir(exist_ok=True)
        path.write_text("class Adapter:\n    pass\n\n\ndef call(function):\n    function()\n")
        modules[name] = module = ModuleType(path.stem)
        module.__file__ = str(path)
        monkeypatch.setitem(sys.modules, path.stem, module)
        exec(compile(path.read_text(), path, "exec"), vars(module))
    checkout, site, elsewhere = (module.call for module in modules.values())
    adapter = modules["site/tiny_adapter"].Adapter()
    adapter.root = tmp_path / "checkout"

    def line_of(function: Callable[[], object]) -> str:
        with pytest.raises(ZeroDivisionError) as caught:
            function()
        return dry_run.source_line(caught.value, adapter)

    def fails() -> None:
        elsewhere(lambda: 1 / 0)

    assert line_of(lambda: checkout(lambda: site(fails))) == "tiny_adapter.py:6"
    assert line_of(lambda: site(lambda: checkout(fails))) == "scene.py:6"
    assert line_of(fails).startswith("test_run_dry.py:"), "the innermost, where neither takes part"


FAILURES = {
    "the loop": (
        "train.py",
        "        loss = (1.0 - opt.lambda_dssim)",
        "        1 / 0\n        loss = (1.0 - opt.lambda_dssim)",
        r"dry run: the first iteration failed at train.py:\d+: ZeroDivisionError: division by zero; expected",
    ),
    "no step": (
        "train.py",
        "        gaussians.update_learning_rate(iteration)\n",
        "        gaussians.optimizer.step = lambda: None\n",
        r"train.py:\d+: training\(\) began no iteration, expected one call of update_learning_rate",
    ),
    "residuals whose colours the renderer clamps": (
        "gaussian_renderer/__init__.py",
        "    elif pipe.convert_SHs_python:\n",
        "    elif pc is not None:\n",
        r"train.py:\d+: colours of both signs do not come out of the checkout's renderer, .* --hierarchy nested",
    ),
    "residuals of a model that has more than a field's parameters": (
        "gaussian_renderer/__init__.py",
        "    screenspace_points = ",
        "    len(pc.exposure_mapping)\n    screenspace_points = ",
        r"no residuals: its Gaussians \(scene/gaussian_model.py:\d+\) are rendered with exposure_mapping, which "
        r"create_from_pcd\(\) makes and fields do not have; .* --hierarchy nested",
    ),
    "residuals at another size": (
        "gaussian_renderer/__init__.py",
        "image_height=int(viewpoint_camera.image_height)",
        "image_height=int(viewpoint_camera.image_height) // 2",
        r"the checkout renders view .* at 64x24, expected 64x48, .* --hierarchy nested",
    ),
}


@pytest.mark.parametrize("failure", FAILURES)
def test_what_fails_is_one_line_with_its_place(failure: str, scene: Path, tmp_path: Path) -> None:
    file, old, new, message = FAILURES[failure]
    checkouts = Path(shutil.copytree(CHECKOUTS, tmp_path / "c", ignore=shutil.ignore_patterns("__pycache__")))
    path = checkouts / "graphdeco" / file
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    script = checkouts / "graphdeco" / "train.py"
    with (
        captured(tmp_path, []),
        loaded(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT, script=script) as adapter,
        pytest.raises(UserInputError, match=message) as caught,
    ):
        drive(adapter, dry_run=True, hierarchy="laplacian" if failure.startswith("residuals") else "nested")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("whole", [True, False])
def test_a_rasterizer_whose_backward_pass_is_not_patched_gets_colours(
    whole: bool, scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes the degree of a signed call for 0, as one that does not know the flag."""
    with captured(tmp_path, []), loaded(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT) as adapter:
        kind = sys.modules["diff_gaussian_rasterization"].GaussianRasterizer
        forward = kind.forward

        def half_patched(self: Any, *arguments: Any, **inputs: Any) -> Any:
            image, *others = forward(self, *arguments, **inputs)
            if whole or self.raster_settings.sh_degree >= 0:
                return image, *others
            constant = kind(self.raster_settings._replace(sh_degree=signed_degree(0)))
            differentiable = forward(constant, *arguments, **inputs)[0]
            return image.detach() + differentiable - differentiable.detach(), *others

        monkeypatch.setattr(kind, "forward", half_patched)
        with pytest.raises(KeyboardInterrupt):
            drive(adapter, hooks=(StopAt(1),), hierarchy="laplacian")
    warned = ["diff_gaussian_rasterization has no signed colour" in record.getMessage() for record in caplog.records]
    assert any(warned) is not whole


def test_a_gpu_that_is_full_already_costs_no_run(scene: Path, tmp_path: Path) -> None:
    checkouts = Path(shutil.copytree(CHECKOUTS, tmp_path / "c", ignore=shutil.ignore_patterns("__pycache__")))
    script = checkouts / "graphdeco" / "train.py"
    text, line = script.read_text(encoding="utf-8"), "        loss = (1.0 - opt.lambda_dssim)"
    full = 'raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")'
    assert line in text
    script.write_text(text.replace(line, f"        {full}\n{line}"), encoding="utf-8")
    with (
        captured(tmp_path, []),
        loaded(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT, script=script) as adapter,
        pytest.raises(DeviceMemoryError, match=r"^dry run: out of GPU memory, .* --levels .* 2\.00 GiB\]$") as caught,
    ):
        drive(adapter, dry_run=True)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_an_evaluation_that_fails_costs_no_run(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: Any) -> None:
        assert RunArchive.open(tmp_path / "run").manifest.complete, "archived before"
        raise RuntimeError("no image\nat all")

    monkeypatch.setattr(StageViews, "held_out_qualities", broken)
    with captured(tmp_path, []), loaded(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT) as adapter:
        drive(adapter, levels=1)
    assert RunArchive.open(tmp_path / "run").field(0).means.isfinite().all()
    (warning,) = [each.getMessage() for each in caplog.records if each.levelname == "WARNING"]
    assert "held-out views of level 0 could not be measured (RuntimeError: no image); " in warning


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("hierarchy", ["nested", "laplacian"])
def test_what_is_rendered_has_to_be_what_is_archived(
    hierarchy: str, late: bool, scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As of forks whose renderers apply a filter or a mask to the parameters of their models, or quantize them late."""
    checkouts = Path(shutil.copytree(CHECKOUTS, tmp_path / "c", ignore=shutil.ignore_patterns("__pycache__")))
    renderer = checkouts / "graphdeco" / "gaussian_renderer" / "__init__.py"
    text = renderer.read_text(encoding="utf-8")
    for name in ("get_scaling,", "get_opacity,"):
        assert text.count(name) == 1
        text = text.replace(name, f"{name[:-1]} * (0.98 if getattr(pc, 'late', {not late}) else 1),")
    renderer.write_text(text, encoding="utf-8")
    script, signed = checkouts / "graphdeco" / "train.py", hierarchy == "laplacian"
    if late:
        text, call = script.read_text(encoding="utf-8"), "        gaussians.update_learning_rate(iteration)\n"
        assert text.count(call) == 1
        script.write_text(text.replace(call, f"{call}        gaussians.late = iteration > 2\n"), encoding="utf-8")
    message = r"scene/gaussian_model.py:\d+: the checkout renders other scales and opacities than its model has as par"
    refused = pytest.raises(UserInputError, match=f"{message}.* --hierarchy nested") if signed else nullcontext()
    with (
        captured(tmp_path, []),
        loaded(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT, script=script) as adapter,
        refused,
    ):
        drive(adapter, dry_run=True, hierarchy=hierarchy)
    warnings = [each.getMessage() for each in caplog.records if each.levelname == "WARNING"]
    assert sum(bool(re.match(message, each)) for each in warnings) == (not signed)
    assert (tmp_path / "run").exists() == (late or not signed)
    if late and signed:
        assert RunArchive.open(tmp_path / "run").available_levels == (1,)


def test_what_a_renderer_does_in_training_alone_is_left_out_of_predictions_and_measurements(
    scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As DropGaussian's, which leaves Gaussians out at random, more of them with each iteration."""
    checkouts = Path(shutil.copytree(CHECKOUTS, tmp_path / "c", ignore=shutil.ignore_patterns("__pycache__")))
    edits = {
        "gaussian_renderer/__init__.py": [
            ("    use_trained_exp=False,\n", "    use_trained_exp=False,\n    is_train=False,\n    iteration=None,\n"),
            ("opacities=pc.get_opacity,", "opacities=pc.get_opacity * (0.9 ** (iteration / 2) if is_train else 1),"),
        ],
        "train.py": [
            ("            bg,\n", "            bg,\n            is_train=True,\n            iteration=iteration,\n")
        ],
    }
    for file, changes in edits.items():
        text = (checkouts / "graphdeco" / file).read_text(encoding="utf-8")
        for old, new in changes:
            assert text.count(old) == 1
            text = text.replace(old, new)
        (checkouts / "graphdeco" / file).write_text(text, encoding="utf-8")
    script, results = checkouts / "graphdeco" / "train.py", list[Result]()
    with captured(tmp_path, results), loaded(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT, script=script) as one:
        drive(one, levels=1, dry_run=True)
    assert RunArchive.open(tmp_path / "run").manifest.complete
    assert not [each.getMessage() for each in caplog.records if each.levelname == "WARNING"]


LATER = {
    "a loss of depths": "        if iteration > 8:\n            loss = loss + render_pkg['depth'].mean()\n",
    "what an earlier iteration made": (
        "        if iteration == 6:\n            gaussians.made = 0.0\n"
        "        if iteration > 8:\n            loss = loss + gaussians.made\n"
    ),
}


@pytest.mark.parametrize("later", LATER)
def test_what_begins_later_is_tried_before_the_base_is_trained(later: str, scene: Path, tmp_path: Path) -> None:
    """As of forks that regularise normals from the middle of a run on."""
    line = "        Ll1depth = 0\n"
    script = edited_graphdeco(tmp_path / "c", "train.py", line, line + LATER[later])
    message = r"train.py:\d+: the loop trains on an image of other colours .* --hierarchy nested"
    trains = later != "a loss of depths"
    with (
        captured(tmp_path, []),
        loaded(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT, script=script) as adapter,
        nullcontext() if trains else pytest.raises(UserInputError, match=message),
    ):
        drive(adapter, dry_run=True, hierarchy="laplacian")
    assert (tmp_path / "run").exists() == trains


@pytest.mark.parametrize("hierarchy", ["nested", "laplacian"])
def test_depths_that_are_rasterized_before_the_image_change_no_iteration(
    hierarchy: str, scene: Path, tmp_path: Path
) -> None:
    """Before a stage trains it is known which of the renderer's colours are the model's, without a dry run, too."""
    checkouts = Path(shutil.copytree(CHECKOUTS, tmp_path / "c", ignore=shutil.ignore_patterns("__pycache__")))
    renderer, call = checkouts / "graphdeco" / "gaussian_renderer" / "__init__.py", "    rendered_image, radii, depth_"
    text = renderer.read_text(encoding="utf-8")
    depths = """\
    depths = (pc.get_xyz @ viewpoint_camera.world_view_transform[:3, 2:3] + 1).repeat(1, 3).detach()
    rasterizer(
        means3D=pc.get_xyz,
        means2D=torch.zeros_like(pc.get_xyz),
        opacities=pc.get_opacity,
        colors_precomp=depths,
        scales=pc.get_scaling,
        rotations=pc.get_rotation,
    )
"""
    assert text.count(call) == 1
    edited, calls = text.replace(call, depths + call), list[int]()

    class Counting(StageHook):
        def before_render(self, context: StageContext) -> None:
            calls.append(context.iteration)

    for folder, sources in (("plain", text), ("with_depths", edited)):
        renderer.write_text(sources, encoding="utf-8")
        script, options = checkouts / "graphdeco" / "train.py", ("--iterations", 6)
        with (
            captured(tmp_path, []),
            loaded(STUBS["graphdeco"], scene, tmp_path / folder, *options, script=script) as one,
        ):
            drive(one, hierarchy=hierarchy, hooks=(Counting(),), split="1/3,2/3")
    plain, other = (RunArchive.open(tmp_path / name).field(0) for name in ("plain", "with_depths"))
    for name, value in plain.parameters.items():
        torch.testing.assert_close(other.parameters[name], value)  # worst seen: equal
    assert calls == [1, 2, 1, 2, 3, 4] * 2


@pytest.mark.parametrize("hierarchy", ["nested", "laplacian"])
def test_a_model_without_the_parameters_of_a_field(hierarchy: str, scene: Path, tmp_path: Path) -> None:
    """As of forks whose colours come from a network; their models have none of SH."""
    checkouts = Path(shutil.copytree(CHECKOUTS, tmp_path / "c", ignore=shutil.ignore_patterns("__pycache__")))
    for path in (*(checkouts / "graphdeco").rglob("*.py"), *(checkouts / "shared").rglob("*.py")):
        path.write_text(path.read_text(encoding="utf-8").replace("_features_rest", "_table"), encoding="utf-8")
    script = checkouts / "graphdeco" / "train.py"
    with (
        captured(tmp_path, []),
        loaded(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT, script=script) as adapter,
        pytest.raises(UserInputError, match=r"the model has no _features_rest; `lapgs run --off`") as caught,
    ):
        drive(adapter, dry_run=True, hierarchy=hierarchy)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_a_model_that_computes_its_parameters_has_no_residuals(scene: Path, tmp_path: Path) -> None:
    """As EAGLES', which decodes them; a residual's model starts from a finished field."""
    line = "class GaussianModel(GaussianBase):\n"
    computed = """\
    def __setattr__(self, name, value):
        super().__setattr__("latents" if name == "_rotation" else name, value)

    @property
    def _rotation(self):
        return self.latents

"""
    script = edited_graphdeco(tmp_path / "c", "scene/gaussian_model.py", line, line + computed)
    with (
        captured(tmp_path, []),
        loaded(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT, script=script) as adapter,
        pytest.raises(
            UserInputError, match=r"scene/gaussian_model.py:\d+: the model computes _rotation of other v"
        ) as e,
    ):
        drive(adapter, dry_run=True, hierarchy="laplacian")
    assert "\n" not in str(e.value)
