"""Test `lapgs run --off` and one level: both equal the bare run to the bit, and no symbol stays replaced."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import pytest
import torch
import typer
from torch import Tensor

from lapgs_plugin.checkouts.script import loaded_script
from lapgs_plugin.checkouts.source import CheckoutSource
from lapgs_plugin.cli.app import app
from lapgs_plugin.cli.app import run as main
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hooks import StageContext, StageHook
from tests.contract.stub_runs import (
    NAMES,
    SAVING,
    SCHEDULE,
    SHORT,
    STUBS,
    Result,
    arguments,
    captured,
    drive,
    files,
    forgetting_stubs,
    loaded,
    run_hierarchy,
)

Bare = Callable[[str], tuple[Result, Tensor]]


def run_off(name: str, scene: Path, folder: Path, *more: Any) -> Result:
    results: list[Result] = []
    stub = STUBS[name]
    words = ["run", "--off", "--device", "cpu", str(stub.script), *arguments(stub, scene, folder, more)]
    with forgetting_stubs(), captured(folder, results):
        typer.main.get_command(app)(words, standalone_mode=False)
    return results[0]


@pytest.mark.parametrize("name", NAMES)
def test_off_equals_the_bare_run_to_the_bit(name: str, bare_run: Bare, scene: Path, tmp_path: Path) -> None:
    bare, number = bare_run(name)
    before = sys.stdout, sys.argv
    off = run_off(name, scene, tmp_path / "off", *SAVING)
    assert torch.rand(1) == number, "random state as after the bare run"
    assert (sys.stdout, sys.argv) == before
    assert [line.replace(str(off.folder), "OUT") for line in off.lines] == [
        line.replace(str(bare.folder), "OUT") for line in bare.lines
    ]
    assert off.losses == bare.losses
    assert files(tmp_path / "off") == files(bare.folder)
    assert f"point_cloud/iteration_{SCHEDULE[2]}/point_cloud.ply" in files(tmp_path / "off")


@pytest.mark.parametrize("name", ["taming", "graphdeco"])
def test_one_level_is_the_backbone_alone(name: str, bare_run: Bare, scene: Path, tmp_path: Path) -> None:
    """FastGS's hard-coded iterations are rescaled, so its one level is not its bare run."""
    bare, _ = bare_run(name)
    _, result = run_hierarchy(STUBS[name], scene, tmp_path / "run", *SAVING, levels=1)
    assert result.losses == bare.losses
    for iteration in (40, 90):
        ply = Path("point_cloud", f"iteration_{iteration}", "point_cloud.ply")
        assert (tmp_path / "run" / "level_0" / ply).read_bytes() == (bare.folder / ply).read_bytes()


def symbols(adapter: Any) -> dict[tuple[str, str], Any]:
    """Return all symbols of the checkout's modules and their classes."""
    modules = {"__main__": adapter.train}
    modules |= {
        name: module
        for name, module in sys.modules.items()
        if str(getattr(module, "__file__", None) or "").startswith(str(adapter.script.path.parent))
    }
    symbols_by_module = {}
    for name, module in modules.items():
        for key, value in vars(module).items():
            symbols_by_module[name, key] = value
            if isinstance(value, type) and value.__module__ in modules:
                symbols_by_module |= {(f"{name}.{key}", entry): part for entry, part in vars(value).items()}
    return symbols_by_module


class Failing(StageHook):
    """Raise an error in the second stage."""

    def on_densify(self, context: StageContext) -> None:
        if context.stage.level == 0:
            raise RuntimeError("from inside")


@pytest.mark.parametrize(("name", "fails"), [*((name, False) for name in NAMES), ("graphdeco", True)])
def test_symbols_are_restored_by_identity(name: str, fails: bool, scene: Path, tmp_path: Path) -> None:
    with captured(tmp_path, []), loaded(STUBS[name], scene, tmp_path / "run", *SHORT) as adapter:
        before = symbols(adapter)
        assert ("gaussian_renderer", "GaussianRasterizer") in before
        assert ("__main__.GaussianModel", "update_learning_rate") in before
        if fails:
            with pytest.raises(RuntimeError, match="from inside"):
                drive(adapter, hooks=(Failing(),))
        else:
            drive(adapter)
        after = symbols(adapter)
    assert [key for key, value in before.items() if after.get(key) is not value] == []


def test_process_state_is_that_of_before(scene: Path, tmp_path: Path) -> None:
    argv, path, stdout, main, modules = sys.argv, sys.path[:], sys.stdout, sys.modules["__main__"], set(sys.modules)
    with captured(tmp_path, []), loaded(STUBS["fastgs"], scene, tmp_path / "run") as adapter:
        assert sys.argv[0].endswith("train.py")
        assert sys.path[0] == str(adapter.script.path.parent)
        assert sys.modules["__main__"] is adapter.train
        assert sys.modules["scene"].__file__ == str(adapter.script.path.parent / "scene" / "__init__.py")
    assert sys.argv is argv
    assert sys.path == path
    assert sys.stdout is stdout
    assert sys.modules["__main__"] is main
    assert not {"scene", "arguments", "gaussian_renderer", "utils"} & (set(sys.modules) - modules)


@pytest.mark.parametrize("launcher", ["/opt/bin/lapgs", "/opt/lib/lapgs_plugin/__main__.py", "/opt/bin/pytest"])
def test_a_script_finds_the_modules_that_python_finds(
    launcher: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not those beside the launcher; a program that calls us from Python keeps its own."""
    script = tmp_path / "train.py"
    script.write_text('if __name__ == "__main__":\n    pass\n')
    search_path = ["/opt/bin", "/usr/lib/python"]
    monkeypatch.setattr(sys, "path", [*search_path])
    monkeypatch.setattr(sys, "argv", [launcher, "run", str(script)])
    with loaded_script(script, []):
        assert sys.path == [str(tmp_path), *(search_path if "pytest" in launcher else search_path[1:])]
    assert sys.path == search_path


def test_a_script_that_is_a_link_finds_the_modules_beside_its_target(tmp_path: Path) -> None:
    link = tmp_path / "train.py"
    link.symlink_to(os.path.relpath(STUBS["graphdeco"].script, tmp_path))
    assert CheckoutSource.read(link).root.samefile(STUBS["graphdeco"].script.parent)
    (tmp_path / "real").mkdir()
    script, link = tmp_path / "real" / "train.py", tmp_path / "mine.py"
    (script.parent / "beside_it.py").write_text("answer = 42\n")
    script.write_text('import beside_it\nif __name__ == "__main__":\n    print(beside_it.answer)\n')
    link.symlink_to("real/train.py")
    by_python = subprocess.run([sys.executable, link], capture_output=True, text=True, check=True).stdout
    output = io.StringIO()
    with redirect_stdout(output), loaded_script(link, []) as definitions:
        definitions.run_main()
    assert output.getvalue() == by_python == "42\n"


def test_a_script_ends_as_it_would_by_itself(tmp_path: Path) -> None:
    """Exit codes and exceptions are passed on."""
    for statement, raised in (("sys.exit(3)", SystemExit), ("1 / 0", ZeroDivisionError)):
        script = tmp_path / "train.py"
        script.write_text(f'import sys\nif __name__ == "__main__":\n    {statement}\n')
        with loaded_script(script, []) as definitions, pytest.raises(raised) as caught:
            definitions.run_main()
        assert caught.traceback[-1].path == script
        assert caught.traceback[-1].lineno == 2


def test_future_statements_of_a_script_hold_in_its_main_block(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = tmp_path / "train.py"
    script.write_text(
        "from __future__ import annotations\n"
        'if __name__ == "__main__":\n    def train(scene: OnlyForTypeCheckers): print(scene)\n    train("fox")\n'
    )
    with loaded_script(script, []) as definitions:
        definitions.run_main()
    assert capsys.readouterr().out == "fox\n"


def test_the_checkouts_modules_are_removed_and_installed_packages_stay(tmp_path: Path) -> None:
    """Its script may lie in a folder of it, and an environment, too: packages there cannot be imported twice."""
    installed = tmp_path / "ms" / ".venv" / "lib" / "python3" / "site-packages"
    for folder, name in ((tmp_path, "of_the_checkout"), (installed, "of_the_environment")):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.py").touch()
    script = tmp_path / "ms" / "train.py"
    script.write_text(
        "import sys\nfrom pathlib import Path\nsys.path.append(str(Path(__file__).parents[1]))\n"
        f"sys.path.append({str(installed)!r})\n"
        'import of_the_checkout, of_the_environment\nif __name__ == "__main__":\n    pass\n'
    )
    try:
        with loaded_script(script, []):
            assert {"of_the_checkout", "of_the_environment"} <= sys.modules.keys()
        assert "of_the_checkout" not in sys.modules
        assert "of_the_environment" in sys.modules
    finally:
        for name in {"of_the_checkout", "of_the_environment"} & sys.modules.keys():
            del sys.modules[name]


def test_what_is_no_module_does_not_matter_at_the_end(tmp_path: Path) -> None:
    """Some packages put objects with any attribute into `sys.modules`; these must not break the end of a run."""
    script = tmp_path / "train.py"
    script.write_text(
        "import sys\nimport beside\n"
        "class Anything:\n    def __getattr__(self, name):\n        return 7\n"
        'sys.modules["lapgs_anything"] = Anything()\n'
        'if __name__ == "__main__":\n    pass\n'
    )
    (tmp_path / "beside.py").write_text("")
    try:
        with loaded_script(script, []) as definitions:
            definitions.run_main()
        assert "beside" not in sys.modules
    finally:
        del sys.modules["lapgs_anything"]


def test_on_a_gpu_a_script_of_no_known_checkout_runs_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    script = tmp_path / "train.py"
    script.write_text('import sys\nif __name__ == "__main__":\n    print(sys.argv[1:])\n')
    command = typer.main.get_command(app)
    command(["run", "--off", str(script), "-s", "scene"], standalone_mode=False)
    assert capsys.readouterr().out == "['-s', 'scene']\n"
    with pytest.raises(UserInputError, match="is not the training script of a 3DGS checkout"):
        command(["run", str(script), "-s", "scene"], standalone_mode=False)


def test_an_exception_looks_as_if_python_ran_the_script(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = tmp_path / "train.py"
    script.write_text("def training():\n    return 1 / 0\n\n\nif __name__ == '__main__':\n    training()\n")
    bare = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    monkeypatch.setattr(sys, "argv", ["lapgs", "run", "--off", "--device", "cpu", str(script)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == bare.returncode == 1
    assert capsys.readouterr().err == bare.stderr


def test_the_checkouts_own_rasterizer_needs_a_gpu(scene: Path, tmp_path: Path) -> None:
    stub = STUBS["graphdeco"]
    words = ["run", "--device", "cpu", "--rasterizer", "checkout", str(stub.script)]
    with pytest.raises(UserInputError, match="--rasterizer checkout needs a CUDA device"):
        typer.main.get_command(app)([*words, *arguments(stub, scene, tmp_path / "run")], standalone_mode=False)
