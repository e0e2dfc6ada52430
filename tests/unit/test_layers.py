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
    assert "1 kept, 0 broken" in result.stdout


def test_an_import_upwards_fails(tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").write_text((ROOT / "pyproject.toml").read_text())
    package = tmp_path / "lapgs_plugin"
    for room in sorted(path for path in (ROOT / "lapgs_plugin").iterdir() if path.suffix == ".py" or path.is_dir()):
        if room.suffix == ".py":
            (package / room.name).parent.mkdir(exist_ok=True)
            (package / room.name).write_text("")
        elif (room / "__init__.py").exists():
            (package / room.name).mkdir(parents=True)
            (package / room.name / "__init__.py").write_text("")
    (package / "hierarchy" / "plan.py").write_text("from lapgs_plugin import training")
    result = _lint(tmp_path)
    assert result.returncode == 1
    assert "lapgs_plugin.hierarchy is not allowed to import lapgs_plugin.training" in result.stdout
