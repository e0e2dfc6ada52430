"""Test that `lapgs run --device cpu` trains levels in gsplat's real simple_trainer, at a tiny size.

LAPGS_GSPLAT, or the folder gsplat in LAPGS_UPSTREAM, is a checkout of gsplat 1.5 or later. LAPGS_GSPLAT_PACKAGES is a
folder of packages that its examples import and that are not installed here, such as

    pip install --no-deps --target FOLDER tyro typeguard docstring_parser nerfview narwhals scikit-learn joblib \
        threadpoolctl matplotlib contourpy cycler fonttools kiwisolver pyparsing packaging python-dateutil six \
        splines piexif
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from lapgs_plugin.evaluation.metrics import psnr
from lapgs_plugin.rendering.run import run_renderer, run_scene
from lapgs_plugin.runs.archive import RunArchive
from tests.upstream.checkouts import checkout

pytestmark = pytest.mark.upstream

SITE = Path(__file__).parent / "simple_trainer_site"
SCHEDULE = (
    "--data_factor 1 --max_steps 120 --eval_steps 120 --save_steps 120 --disable_viewer --disable_video "
    "--strategy.refine_start_iter 20 --strategy.refine_every 20 --strategy.refine_stop_iter 90"
)
CASES = [("nested", "default"), ("laplacian", "default"), ("laplacian", "mcmc"), ("laplacian", "default --pose_opt")]


def run(scene: Path, folder: Path, hierarchy: str, words: str) -> None:
    """Run the command with gsplat's own Python files where those of the checkout need them."""
    root = checkout("LAPGS_GSPLAT")
    own = [root] if (root / "gsplat" / "losses.py").is_file() else []  # 1.6 is not the gsplat that is installed here
    path = os.pathsep.join(map(str, [SITE, *own, os.environ.get("LAPGS_GSPLAT_PACKAGES", SITE)]))
    command = [sys.executable, "-m", "lapgs_plugin", "run", "--device", "cpu", "--hierarchy", hierarchy]
    command += ["simple_trainer.py", *words.split(), *SCHEDULE.split(), "--data_dir", scene, "--result_dir", folder]
    done = subprocess.run(
        [str(word) for word in command],
        cwd=root / "examples",
        env={**os.environ, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.mark.parametrize(("hierarchy", "words"), CASES)
def test_levels_of_simple_trainer(hierarchy: str, words: str, scene: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    run(scene, folder, hierarchy, words)
    archive = RunArchive.open(folder)
    assert [(each.level, each.iterations) for each in archive.manifest.records] == [(1, 40), (0, 80)]
    assert [each.signed for each in archive.manifest.records] == [False, hierarchy == "laplacian"]
    render, views = run_renderer(archive, "cpu"), run_scene(archive).test
    rendered = [psnr(render.render(view.camera).image.clamp(0, 1), view.image) for view in views]
    last = 119 if hierarchy == "nested" else 79
    own = json.loads((folder / "stats" / f"val_step{last:04d}.json").read_text())["psnr"]
    assert sum(rendered) / len(rendered) == pytest.approx(own, abs=1e-4)  # 2e-7 was seen
