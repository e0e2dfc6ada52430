"""The examples run, their loss falls, and their run folder renders what they measured."""

from __future__ import annotations

import argparse
import ast
import difflib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

import lapgs_plugin as lapgs
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.scenes import load_scene
from lapgs_plugin.scenes.sample import make_sample_scene

EXAMPLES = Path(__file__).parents[2] / "examples"
ITERATIONS = 80


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "sample"
    make_sample_scene(path, width=96, height=64, views=12, points=500, progress=False)
    return path


def fell(losses: list[float]) -> bool:
    """Compare tenths of the run, because single views differ too much."""
    tenth = len(losses) // 10
    return sum(losses[-tenth:]) < sum(losses[:tenth])


def code_lines(name: str) -> list[str]:
    """Return an example's lines without its docstring and empty ones."""
    text = (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")
    docstring = ast.parse(text).body[0]
    return [line for line in text.splitlines()[docstring.end_lineno :] if line.strip()]


@pytest.mark.parametrize("loop", ["gsplat", "vanilla"])
def test_the_hierarchy_costs_fewer_than_25_lines(loop: str) -> None:
    before, after = code_lines(f"{loop}_before"), code_lines(f"{loop}_after")
    changes = difflib.SequenceMatcher(None, before, after, autojunk=False).get_opcodes()
    assert sum(max(j - i, n - m) for tag, i, j, m, n in changes if tag != "equal") < 25


def arguments(scene: Path, out: Path) -> argparse.Namespace:
    return argparse.Namespace(scene=scene, out=out, resolution="full", iterations=ITERATIONS, rasterizer="cpu")


def test_gsplat_before(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    example = load("gsplat_before")
    torch.manual_seed(0)
    runner = example.Runner(arguments(scene, tmp_path))
    assert fell(runner.train(runner.train_views, ITERATIONS))
    options = ["-o", tmp_path / "run", "--iterations", "3", "--rasterizer", "cpu"]
    monkeypatch.setattr(sys, "argv", ["gsplat_before.py", str(scene), *map(str, options)])
    example.main()
    assert "held-out PSNR" in capsys.readouterr().out
    assert set(torch.load(tmp_path / "run" / "splats.pt")) == {"means", "quats", "scales", "opacities", "sh0", "shN"}


def test_gsplat_after_composes_what_its_run_folder_renders(scene: Path, tmp_path: Path) -> None:
    example = load("gsplat_after")
    torch.manual_seed(0)
    runner = example.Runner(arguments(scene, tmp_path / "run"))
    view, composed = runner.test_views[0], []
    for stage in lapgs.StagePlan.create(runner.scene.smallest_size, 2 * ITERATIONS, levels=2):
        views = [runner.at_level(each, stage.level) for each in runner.train_views]
        losses = runner.train(views, stage.iterations)
        assert fell(losses)
        with torch.no_grad():
            composed.append(runner.render(runner.at_level(view, stage.level))[0])
        runner.finish(stage)
    runner.archive.close()
    renderer = lapgs.HierarchyRenderer.from_archive(lapgs.RunArchive.open(tmp_path / "run"), CpuRasterizer())
    expected = renderer.render(runner.scene.test[0].camera).composed
    # Colours pass through SH of degree 0 in one and not in the other; worst seen 4e-6.
    torch.testing.assert_close(composed[0], expected[1], rtol=0, atol=1e-4)
    torch.testing.assert_close(composed[1], expected[0], rtol=0, atol=1e-4)
    assert (expected[0] - renderer.pyramid.up(expected[1], expected[0].shape[1:])).abs().max() > 0.01


@pytest.mark.parametrize("name", ["vanilla_before", "vanilla_after"])
def test_vanilla(scene: Path, name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    example = load(name)
    monkeypatch.setattr(sys, "argv", [name, str(scene), "--iterations", "40"])
    example.main()
    assert "held-out PSNR" in capsys.readouterr().out
    views = list(load_scene(scene, progress=False).train)
    field = lapgs.field_from_points(torch.randn(200, 3), torch.rand(200, 3), 1)
    trained, losses = example.train(field, views, ITERATIONS)
    assert fell(losses)
    assert len(trained) == 200
