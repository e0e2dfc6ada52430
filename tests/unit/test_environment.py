"""Test the findings of `lapgs doctor` for given probes, and the probes with broken modules."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from lapgs_plugin import environment
from lapgs_plugin.cli.doctor import current_folder
from lapgs_plugin.environment import findings, probes
from lapgs_plugin.environment.findings import Finding
from lapgs_plugin.environment.probes import Probe

GPU = "NVIDIA H100, 80 GiB, compute capability 9.0"


def torch_probe(cuda: str | None = None, gpus: tuple[str, ...] = (), complaint: str = "") -> Probe:
    return Probe({"version": "2.6.0", "cuda": cuda, "gpus": list(gpus), "complaint": complaint, "extensions": "none"})


def status(reported: list[Finding]) -> dict[str, str]:
    return {finding.name: finding.status for finding in reported}


def test_no_gpu_is_no_problem() -> None:
    assert status(findings.torch_findings(torch_probe(), driver="")) == {"PyTorch": "ok", "GPU": "absent"}


def test_a_usable_gpu_is_named_with_its_driver() -> None:
    reported = findings.torch_findings(torch_probe("12.4", (GPU, GPU)), driver="550.54")
    assert [finding.detail for finding in reported] == ["2.6.0, built for CUDA 12.4", *[f"{GPU}, driver 550.54"] * 2]


@pytest.mark.parametrize(
    ("probe", "advice"),
    [
        (torch_probe(), "install PyTorch for CUDA"),
        (torch_probe("12.4", complaint="The NVIDIA driver on your system is too old"), "update the NVIDIA driver"),
    ],
)
def test_a_gpu_that_pytorch_cannot_use_is_a_problem_with_advice(probe: Probe, advice: str) -> None:
    gpu = findings.torch_findings(probe, driver="470.1")[1]
    assert gpu.status == "problem"
    assert "470.1" in gpu.detail
    assert probe.facts["complaint"] in gpu.detail
    assert advice in gpu.advice


def test_broken_pytorch_is_reported_with_its_error() -> None:
    (finding,) = findings.torch_findings(Probe({}, "ImportError: libtorch.so"), driver="")
    assert (finding.status, finding.detail) == ("problem", "ImportError: libtorch.so")


def test_a_toolkit_of_another_cuda_major_version_is_a_problem(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    nvcc = tmp_path / "nvcc"
    nvcc.write_text("#!/bin/sh\necho 'Cuda compilation tools, release 13.0, V13.0.88'\n")
    nvcc.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    assert findings.compiler_findings("12.4")[0].status == "problem"
    assert findings.compiler_findings("13.1")[0] == Finding("CUDA toolkit", "ok", f"13.0 ({nvcc})")
    assert findings.compiler_findings(None)[0].status == "ok"
    nvcc.unlink()
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CUDA_HOME", raising=False)
    monkeypatch.delenv("CXX", raising=False)
    assert status(findings.compiler_findings("12.4")) == {"CUDA toolkit": "absent", "C++ compiler": "absent"}


def test_kernel_cache_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_DISABLE_JIT", raising=False)
    facts = {"numba": "0.60", "threads": 4, "cache": str(tmp_path)}
    assert "empty" in findings.numba_findings(Probe(facts))[1].detail
    (tmp_path / "loss.kernel-1.py311.nbi").touch()
    assert "1 compiled kernels" in findings.numba_findings(Probe(facts))[1].detail
    unwritable = findings.numba_findings(Probe({**facts, "cache": None}))[1]
    assert unwritable.status == "problem"
    assert "NUMBA_CACHE_DIR" in unwritable.advice
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    assert findings.numba_findings(Probe(facts))[0].status == "problem"


def test_packages_missing_old_and_broken() -> None:
    wanted = [
        Requirement("torch>=2.4"),
        Requirement("numpy>=999.1"),
        Requirement("no-such-package>=1"),
        Requirement("rich"),
    ]
    reported = findings.package_findings(wanted, {"rich": Probe({}, "ImportError: boom")})
    assert status(reported) == {"torch": "ok", "numpy": "problem", "no-such-package": "problem", "rich": "problem"}
    assert reported[2].advice == "python -m pip install 'no-such-package>=1'"
    assert "boom" in reported[3].detail


def test_extras_are_whole_or_absent() -> None:
    wanted = {
        "viewer": [Requirement("numpy")],
        "": [Requirement("rich")],
        "lpips": [Requirement("no-such-package"), Requirement("numpy")],
        "dev": [Requirement("pytest")],
    }
    lpips, viewer = findings.extra_findings(wanted)
    assert (lpips.name, lpips.status, lpips.detail) == ("[lpips]", "absent", "lacks no-such-package")
    assert lpips.advice == "python -m pip install 'lapgs_plugin[lpips]'"
    assert (viewer.name, viewer.status) == ("[viewer]", "ok")


def test_own_requirements_are_read_with_their_bounds() -> None:
    requirements = findings.own_requirements()
    assert "torch>=2.4" in [f"{requirement.name}{requirement.specifier}" for requirement in requirements[""]]
    assert "pytest" in [requirement.name for requirement in requirements["dev"]]
    assert "pytest" not in [requirement.name for requirement in requirements[""]]


def test_gsplat_needs_a_gpu_for_its_cuda_part() -> None:
    assert findings.gsplat_finding(torch_probe(), nvcc=True).status == "absent"
    with_gpu = torch_probe("12.4", (GPU,))
    assert findings.gsplat_finding(with_gpu, nvcc=True).status == "ok"


@pytest.fixture
def broken_modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "lapgs_crashing.py").write_text("import os\nos.abort()\n")
    (tmp_path / "lapgs_other_abi.py").write_text("raise ImportError('undefined symbol: _ZN3c10\\nmore')\n")
    (tmp_path / "lapgs_exiting.py").write_text("raise SystemExit(3)\n")
    (tmp_path / "lapgs_loud.py").write_text("print('hello from an import')\n")
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])


@pytest.mark.usefixtures("broken_modules")
@pytest.mark.parametrize(
    ("module", "error"),
    [
        ("lapgs_crashing", "crashed (Aborted)"),
        ("lapgs_other_abi", "ImportError: undefined symbol: _ZN3c10"),
        ("lapgs_exiting", "SystemExit: 3"),
        ("lapgs_loud", ""),
        ("lapgs_not_there", "ModuleNotFoundError: No module named 'lapgs_not_there'"),
    ],
)
def test_a_probe_survives_whatever_an_import_does(module: str, error: str) -> None:
    assert probes.run_probe("import", module) == Probe({}, error)


def test_an_extension_that_is_not_installed_is_absent_and_costs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(findings, "run_probe", None)
    finding = findings.extension_finding("lapgs_not_there._C", "rasterizer of a test")
    assert finding == Finding("lapgs_not_there._C", "absent", "not installed (rasterizer of a test)")


GRAPHDECO = ("train.py", "gaussian_renderer/__init__.py", "scene/gaussian_model.py")


@pytest.mark.parametrize(
    ("files", "name"),
    [
        (GRAPHDECO, "graphdeco 3DGS"),
        ((*GRAPHDECO, "utils/taming_utils.py"), "Taming-3DGS"),
        ((*GRAPHDECO, "utils/taming_utils.py", "utils/fast_utils.py"), "FastGS"),
        (("gsplat/rendering.py", "examples/simple_trainer.py"), "gsplat"),
        (("train.py",), None),
    ],
)
def test_checkouts_are_recognised(files: tuple[str, ...], name: str | None, tmp_path: Path) -> None:
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    finding = current_folder(tmp_path, has_gpu=False)
    assert finding.detail.startswith(f"a checkout of {name}" if name else "not a known 3DGS checkout")
    assert ("lapgs run" in finding.detail) == (name not in (None, "gsplat"))


def test_what_triton_needs_to_start_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiler = tmp_path / "gcc"
    compiler.touch(mode=0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(environment.sysconfig, "get_path", lambda name, scheme: str(tmp_path))
    monkeypatch.setattr(environment.importlib.util, "find_spec", lambda name: None)
    assert environment.triton_missing() == "Triton is not installed"
    monkeypatch.setattr(environment.importlib.util, "find_spec", lambda name: name)
    assert environment.triton_missing().endswith(f"there is no {tmp_path / 'Python.h'}")
    (tmp_path / "Python.h").touch()
    assert environment.triton_missing() == ""
    compiler.rename(tmp_path / "other")
    assert environment.triton_missing() == "there is no C compiler for Triton (gcc, clang or CC)"
    monkeypatch.setenv("CC", str(tmp_path / "other"))
    assert environment.triton_missing() == ""
