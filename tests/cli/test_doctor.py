"""`lapgs doctor` on this machine, and on one where everything is broken."""

from __future__ import annotations

import json

import pytest
import typer
from typer.testing import CliRunner

from lapgs_plugin import environment
from lapgs_plugin.cli.doctor import doctor
from lapgs_plugin.environment import Probe
from tests.contract.stub_runs import CHECKOUTS

app = typer.Typer()
app.command()(doctor)


def test_json_names_every_section_and_this_machine_can_train() -> None:
    result = CliRunner().invoke(app, ["--json"])
    assert result.exit_code == 0
    sections = json.loads(result.stdout)
    assert {"System", "PyTorch", "Compilers", "CPU rasterizer", "Packages", "Backbones"} <= sections.keys()
    assert sections["lapgs train"][0]["status"] == "ok"
    assert "CPU rasterizer" in sections["lapgs train"][0]["detail"]
    for found in sections.values():
        for finding in found:
            assert finding["status"] in ("ok", "absent", "problem")
            assert "\n" not in finding["detail"]


def test_a_broken_machine_gets_advice_and_exit_code_0(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment, "run_probe", lambda *arguments: Probe({}, "ImportError: [libfoo] is gone"))
    result = CliRunner(env={"COLUMNS": "200"}).invoke(app, [])
    assert result.exit_code == 0
    assert "!!" in result.stdout
    assert "[libfoo] is gone" in result.stdout  # not taken for markup
    assert "python -m pip install --force-reinstall torch" in result.stdout
    assert "nothing until this is mended" in result.stdout


def test_the_current_folder_is_a_checkout(monkeypatch: pytest.MonkeyPatch) -> None:
    for folder, message in (
        ("fastgs", "a checkout of FastGS; `lapgs run train.py ...` trains it on the"),
        ("", "not a"),
    ):
        monkeypatch.chdir(CHECKOUTS / folder)
        found = json.loads(CliRunner().invoke(app, ["--json"]).stdout)["Backbones"][-1]
        assert found["name"] == "Current folder"
        assert found["detail"].startswith(message)
