"""`lapgs run` computes what a checkout's loop spends its time on in our kernels, and ends with the same image."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from lapgs_plugin.checkouts.logged_numbers import READ
from lapgs_plugin.family.call import ShParts
from lapgs_plugin.ops import photometric_loss
from lapgs_plugin.ops.adam import multi_tensor
from lapgs_plugin.ops.adam.multi_tensor import MultiTensorAdam
from lapgs_plugin.ops.masked_updates import update_rows
from lapgs_plugin.runner import checkout_loss, late_numbers, visible_rows
from lapgs_plugin.runner.rasterizer_wrapper import RasterizerWrapper
from lapgs_plugin.runner.stage_model import StageModel
from lapgs_plugin.runner.stage_rendering import StageRendering
from tests.contract.stub_runs import (
    FORKS,
    HALF,
    KINDS,
    SHORT,
    STUBS,
    STUBS_AND_KINDS,
    composed_psnr,
    edited_graphdeco,
    run_hierarchy,
)


@pytest.mark.parametrize(("name", "kind"), STUBS_AND_KINDS)
def test_adam(name: str, kind: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its class on a CPU, where it steps in PyTorch's operations: density control edits its state as PyTorch's."""
    plain, _ = run_hierarchy(STUBS[name], scene, tmp_path / "plain", *HALF, hierarchy=kind)
    used: set[type] = set()
    prepare, step = StageModel.prepare_optimizers, MultiTensorAdam.step

    def prepare_and_fuse(model: StageModel, gaussians: Any, inherit: bool) -> None:
        prepare(model, gaussians, inherit)
        for optimizer in model._adapter.optimizers(gaussians):
            multi_tensor.fuse_steps(optimizer)

    def counted(optimizer: MultiTensorAdam, *args: Any) -> Any:
        used.add(type(optimizer))
        return step(optimizer, *args)

    counted.hooked = True  # type: ignore[attr-defined]
    monkeypatch.setattr(multi_tensor, "triton_works", lambda *tensors: not tensors)
    monkeypatch.setattr(StageModel, "prepare_optimizers", prepare_and_fuse)
    monkeypatch.setattr(MultiTensorAdam, "step", counted)
    ours, _ = run_hierarchy(STUBS[name], scene, tmp_path / "ours", *HALF, hierarchy=kind)
    assert used == {MultiTensorAdam}
    assert composed_psnr(ours) == pytest.approx(composed_psnr(plain), abs=0.2)  # dB; worst seen 0


@pytest.mark.parametrize("name", ["dash", "graphdeco"])
@pytest.mark.parametrize("kind", KINDS)
def test_loss(name: str, kind: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """L1 and SSIM are computed together, once for each iteration, as on a GPU."""
    called: list[torch.Size] = []
    ours = photometric_loss.loss_and_l1

    def counted(image: torch.Tensor, target: torch.Tensor, weight: float) -> tuple[torch.Tensor, torch.Tensor]:
        if image.shape != (3, 29, 43):  # that functions are compared on before
            called.append(image.shape)
        return ours(image, target, weight)

    monkeypatch.setattr(photometric_loss, "loss_and_l1", counted)
    monkeypatch.setattr(checkout_loss, "_has_one_kernel", lambda image: True)
    losses = []
    for on in (True, False):
        called.clear()
        _, result = run_hierarchy(
            {**STUBS, **FORKS}[name], scene, tmp_path / str(on), *SHORT, hierarchy=kind, fused_ssim=on, joint=0.0
        )
        assert len(called) == (30 if on else 0)
        losses.append(result.losses[0])
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)  # before densification amplifies rounding; worst seen 2e-6


@pytest.mark.parametrize(("name", "kind"), STUBS_AND_KINDS)
def test_running_ahead(name: str, kind: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop logs the same numbers, and trains the same field to the bit."""
    late: list[torch.Tensor] = []

    def read(tensor: torch.Tensor) -> Any:
        late.append(tensor)
        return late_numbers.read(tensor)

    monkeypatch.setitem(late_numbers.NAMES, READ, read)
    results = []
    for on in (True, False):
        late.clear()
        archive, result = run_hierarchy(STUBS[name], scene, tmp_path / str(on), *HALF, hierarchy=kind, run_ahead=on)
        assert len(late) == (HALF[1] if on else 0)
        fields = [archive.field(level) for level in (1, 0)]
        results.append((result.losses, [torch.cat([field.means, field.sh.flatten(1)], 1) for field in fields]))
    assert results[0][0] == results[1][0]
    assert all(map(torch.equal, results[0][1], results[1][1]))


REPORT = '    """Quality of test views and some training views."""\n'
WRITES = """
    tb_writer.add_scalar("l1", Ll1.item(), iteration)
    tb_writer.add_scalar("loss", loss.item(), iteration)
    tb_writer.add_scalar("iter_time", elapsed, iteration)
"""


def test_what_tensorboard_gets(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A report's numbers are read late, and the files have the same values in the same order."""
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

    late: list[torch.Tensor] = []

    def read(tensor: torch.Tensor) -> Any:
        late.append(tensor)
        return late_numbers.read(tensor)

    monkeypatch.setitem(late_numbers.NAMES, READ, read)
    script, contents = edited_graphdeco(tmp_path / "fork", "train.py", REPORT, REPORT + WRITES), []
    stub = replace(STUBS["graphdeco"], name=str(script.parent))
    for on in (True, False):
        late.clear()
        folder = tmp_path / str(on)
        run_hierarchy(stub, scene, folder, *SHORT, hierarchy="laplacian", run_ahead=on)
        assert len(late) == (3 * SHORT[1] if on else 0)  # with that of the progress bar
        files = sorted(folder.rglob("events.*"))
        assert len(files) == 2
        events = [event for file in files for event in list(EventFileLoader(str(file)).Load())[1:]]
        values = [(event.step, event.summary.value[0]) for event in events]
        contents.append([(step, value.tag, value.tag != "iter_time" and value) for step, value in values])
    assert len(contents[0]) == 3 * SHORT[1]
    assert contents[0] == contents[1]


@pytest.mark.parametrize("name", [*STUBS, *FORKS])
def test_visible_gaussians(name: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their statistics are updated by masks, and the loop gets no indices: the same field to the bit."""
    updated: list[bool] = []

    def update(mask: Any, *updates: Any) -> bool:
        updated.append(isinstance(mask, torch.Tensor) and mask.dtype is torch.bool)
        return updated[-1] and update_rows(mask, *updates)

    monkeypatch.setattr(visible_rows, "update_rows", update)
    stub, fields = {**STUBS, **FORKS}[name], []
    for on in (True, False):
        archive, _ = run_hierarchy(stub, scene, tmp_path / str(on), *SHORT, hierarchy="laplacian", run_ahead=on)
        fields.append([archive.field(level) for level in (1, 0)])
    assert updated
    assert all(updated)
    for ours, plain in zip(*fields, strict=True):
        assert torch.equal(ours.means, plain.means)
        assert torch.equal(ours.sh, plain.sh)


@pytest.mark.parametrize("name", ["dash", "mini"])
@pytest.mark.parametrize("kind", KINDS)
def test_sh_in_parts(name: str, kind: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are joined by nobody where our rasterizer renders, and the field is the same to the bit."""
    parts: list[bool] = []
    sh_of = RasterizerWrapper._sh

    def counted(wrapper: RasterizerWrapper, model: Any) -> Any:
        sh = sh_of(wrapper, model)
        parts.append(isinstance(sh, ShParts))
        return sh

    monkeypatch.setattr(RasterizerWrapper, "_sh", counted)
    fields = []
    for apart in (True, False):
        if not apart:
            monkeypatch.setattr(StageRendering, "takes_parts", False)
        archive, _ = run_hierarchy(FORKS[name], scene, tmp_path / str(apart), *SHORT, hierarchy=kind)
        fields.append([archive.field(level) for level in (1, 0)])
        assert any(parts) == apart
        parts.clear()
    for ours, plain in zip(*fields, strict=True):
        assert torch.equal(ours.means, plain.means)
        assert torch.equal(ours.sh, plain.sh)
