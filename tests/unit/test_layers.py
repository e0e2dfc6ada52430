"""The map of the code is true: rooms import only rooms below them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
LINT = "from importlinter.cli import lint_imports; raise SystemExit(lint_imports(no_cache=True))"


def _lint(folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", LINT], cwd=folder, capture_output=True, text=True, check=False)


def test_rooms_import_only_what_is_below_them(tmp_path: Path) -> None:
    result = _lint(ROOT)
    assert result.returncode == 0, result.stdout
    assert "3 kept, 0 broken" in result.stdout


def test_an_import_upwards_fails(tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").write_text((ROOT / "pyproject.toml").read_text())
    for package in ("lapgs_plugin", "lapgs_bench"):
        for file in (*ROOT.glob(f"{package}/*.py"), *ROOT.glob(f"{package}/*/__init__.py")):
            copy = tmp_path / file.relative_to(ROOT)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_text("")
    (tmp_path / "lapgs_plugin/hierarchy/plan.py").write_text("from lapgs_plugin import training")
    (tmp_path / "lapgs_plugin/cli/app.py").write_text("from lapgs_bench import app")
    result = _lint(tmp_path)
    assert result.returncode == 1
    assert "lapgs_plugin.hierarchy is not allowed to import lapgs_plugin.training" in result.stdout
    assert "lapgs_plugin is not allowed to import lapgs_bench" in result.stdout
