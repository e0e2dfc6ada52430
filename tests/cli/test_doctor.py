"""Run `lapgs doctor` on this machine, and on one where everything is broken."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from lapgs_plugin import environment
from lapgs_plugin.cli.doctor import current_folder, doctor, examine
from lapgs_plugin.environment import findings, probes
from lapgs_plugin.environment.probes import Probe
from lapgs_plugin.registry import HOOKS
from tests.contract.stub_runs import CHECKOUTS
from tests.plugin_package import REGISTRIES, install_package

probed = lru_cache(probes.run_probe)
"""Run each probe once for all tests: it is a process that imports PyTorch."""
app = typer.Typer()
app.command()(doctor)


@pytest.fixture(autouse=True)
def _probed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And in an empty folder, because the files of the current one are read."""
    monkeypatch.setattr(probes, "run_probe", probed)
    monkeypatch.chdir(tmp_path)


def test_json_names_every_section_and_this_machine_can_train(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(CHECKOUTS / "fastgs")
    result = CliRunner().invoke(app, ["--json"])
    assert result.exit_code == 0
    sections = json.loads(result.stdout)
    assert {"System", "PyTorch", "Compilers", "CPU rasterizer", "Packages", "Backbones"} <= sections.keys()
    assert sections["lapgs train"][0]["status"] == "ok"
    assert "CPU rasterizer" in sections["lapgs train"][0]["detail"]
    assert sections["Backbones"][-1]["name"] == "Current folder"
    assert "FastGS" in sections["Backbones"][-1]["detail"]
    for section in sections.values():
        for finding in section:
            assert finding["status"] in ("ok", "absent", "problem")
            assert "\n" not in finding["detail"]


def test_entry_points_of_packages_are_listed_and_misspelt_groups_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entries = "[lapgs_plugin.hooks]\nsmooth = tiny:Smooth\n[lapgs_plugin.rasterizers]\ndiscs = tiny:Discs\n"
    entries += "[lapgs.commands]\nhello = tiny:app\n"
    install_package(tmp_path, monkeypatch, "tiny", f"{entries}[lapgs_plugin.strategy]\nopaque = tiny:OPAQUE\n", "")
    by_name = {finding.name: finding for finding in findings.entry_point_findings()}
    assert by_name["smooth"].detail == "a hook, part of every run: tiny:Smooth of tiny 1.0"
    assert by_name["discs"].detail == "--rasterizer discs: tiny:Discs of tiny 1.0"
    assert by_name["opaque"].status == "problem"
    assert "lapgs_plugin.strategy, which nothing reads" in by_name["opaque"].detail
    assert by_name["hello"].detail == "lapgs hello: tiny:app of tiny 1.0"
    assert "bench" not in by_name, "it is of this package"
    assert {*(registry.group for registry in REGISTRIES), HOOKS} == set(findings.ENTRY_POINT_GROUPS)


def test_a_broken_machine_gets_advice_and_exit_code_0(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "run_probe", lambda *arguments: Probe({}, "ImportError: [libfoo] is gone"))
    result = CliRunner(env={"COLUMNS": "200"}).invoke(app, [])
    assert result.exit_code == 0
    assert "!!" in result.stdout
    assert "[libfoo] is gone" in result.stdout  # not taken for markup
    assert "python -m pip install --force-reinstall torch" in result.stdout
    assert "nothing until this is fixed" in result.stdout


TORCH = {"version": "2.11.0", "cuda": "13.0", "gpus": [], "complaint": "", "extensions": "/none"}
GPU = "NVIDIA H200, 140 GiB"


@pytest.mark.parametrize(
    ("facts", "driver", "triton", "built", "hidden", "status", "detail"),
    [
        ({"gpus": [GPU]}, "580.1", "", None, None, "ok", f"our kernels on the GPU, {GPU}"),
        ({"gpus": [GPU]}, "580.1", "", False, None, "ok", f"our kernels on the GPU, {GPU}"),
        ({"gpus": [GPU]}, "580.1", "no Triton", True, None, "ok", f"gsplat on the GPU, {GPU}"),
        ({"gpus": [GPU]}, "580.1", "no Triton", None, None, "problem", "nothing until this is fixed: Triton"),
        ({"gpus": [GPU]}, "580.1", "no Triton", False, None, "problem", "nothing until this is fixed: Triton"),
        ({"complaint": "too old"}, "470.1", "", True, None, "problem", "nothing until this is fixed: GPU"),
        ({"cuda": None}, "580.1", "", True, None, "problem", "nothing until this is fixed: GPU"),
        ({"complaint": "no device"}, "580.1", "", True, "", "ok", "the CPU rasterizer"),
        ({}, "", "", True, None, "ok", "the CPU rasterizer"),
    ],
)
def test_what_training_will_use(
    monkeypatch: pytest.MonkeyPatch,
    facts: dict[str, Any],
    driver: str,
    triton: str,
    built: bool | None,
    hidden: str | None,
    status: str,
    detail: str,
) -> None:
    """As `choose_rasterizer` has it: a GPU that cannot be used stands in the way, unless it is hidden."""
    probe = Probe({**TORCH, **facts})
    monkeypatch.setattr(
        probes, "run_probe", lambda *arguments: probe if arguments == ("torch",) else probed(*arguments)
    )
    monkeypatch.setattr(environment, "driver_version", lambda: driver)
    monkeypatch.setattr(findings, "gsplat_built", lambda: built)
    monkeypatch.setattr(findings, "triton_missing", lambda: triton)
    monkeypatch.setattr(findings.shutil, "which", lambda name, path=None: None)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if hidden is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", hidden)
    (conclusion,) = examine()["lapgs train"]
    assert conclusion.status == status
    assert conclusion.detail.startswith(detail)
    assert ("--rasterizer cpu" in conclusion.advice) == (status == "problem")


def test_the_current_folder_is_a_checkout() -> None:
    for folder, script in (("fastgs", "train.py"), ("mini", "ms/train.py")):
        assert f"`lapgs run {script} ...` trains it" in current_folder(CHECKOUTS / folder, has_gpu=False).detail


@pytest.mark.parametrize("own_folder", [True, False])
def test_what_gsplat_compiled_at_its_first_use_is_built(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own_folder: bool
) -> None:
    from torch.utils.cpp_extension import _get_build_directory

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "own"))
    if not own_folder:
        monkeypatch.delenv("TORCH_EXTENSIONS_DIR")
    monkeypatch.setattr(findings, "gsplat_built", lambda: False)
    torch = Probe({**probes.PROBES["torch"](), "gpus": [GPU]})
    assert findings.gsplat_finding(torch, nvcc=True).detail.startswith("not built yet")
    library = Path(_get_build_directory("gsplat_cuda", verbose=False), "gsplat_cuda.so")  # where gsplat builds it
    library.touch()
    assert findings.gsplat_finding(torch, nvcc=True).detail == f"built at its first use ({library})"
    assert findings.gsplat_finding(torch, nvcc=False).status == "absent"  # gsplat does not load it then
