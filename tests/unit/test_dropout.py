"""Test that Gaussians are left out at random, and that the expected field stays what it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from lapgs_plugin.errors import TrainingStoppedError, UserInputError
from lapgs_plugin.training import stage
from lapgs_plugin.training.dropout import thinned
from lapgs_plugin.training.settings import Densification, TrainSettings
from lapgs_plugin.training.strategies import Mcmc
from tests.training_runs import Said, StopAt, resume, train
from tests.training_scene import blob_field, ring_scene

MCMC = Densification(strategy="mcmc", options=Mcmc(), every=10)


def test_the_expected_opacity_stays_and_what_is_left_out_has_no_gradient() -> None:
    torch.manual_seed(0)
    field, share, draws = blob_field(50), 0.2, 2000
    logits = torch.linspace(-6.0, 1.0, 50).requires_grad_()  # above 1.38 they could not make up for what is left out
    drawn = torch.stack(
        [
            torch.sigmoid(thinned(field.with_parameters({"opacity_logits": logits}), share).opacity_logits)
            for _ in range(draws)
        ]
    )
    true = torch.sigmoid(logits.detach())
    spread = true * (share / (1.0 - share) / draws) ** 0.5
    assert float(((drawn.detach().mean(0) - true) / spread).abs().max()) < 4.5  # worst seen 2.7
    drawn[0].sum().backward()
    assert logits.grad is not None
    gone = drawn[0] < 1e-6
    assert 0 < int(gone.sum()) < 25
    assert float(logits.grad[gone].abs().max()) == 0.0
    kept = logits.detach()[~gone].double()
    expected = torch.sigmoid(kept) * torch.sigmoid(-kept) / (1.0 - share)
    torch.testing.assert_close(logits.grad[~gone].double(), expected, rtol=1e-5, atol=0.0)  # worst seen 1.3e-6


def test_extreme_opacities_have_finite_gradients_and_no_share_changes_nothing() -> None:
    field = blob_field(4)
    assert thinned(field, 0.0) is field
    logits = torch.tensor([-200.0, -20.0, 20.0, 200.0], requires_grad=True)
    thinned(field.with_parameters({"opacity_logits": logits}), 0.5).opacity_logits.sum().backward()
    assert logits.grad is not None
    assert bool(torch.isfinite(logits.grad).all())


def test_few_photos_get_it_with_mcmc() -> None:
    assert [TrainSettings().dropout_for(count) for count in (39, 40)] == [0.2, 0.0]
    assert TrainSettings(iterations=3000).dropout_for(10) == 0.0, "3DGS's heuristics"
    assert TrainSettings(dropout=0.0).dropout_for(10) == 0.0
    assert TrainSettings(protocol="paper").dropout_for(10) == 0.0
    with pytest.raises(UserInputError, match=r"--dropout 1.0: expected a share from 0 to below 1"):
        TrainSettings(dropout=1.0)


def test_a_stopped_run_leaves_out_the_same_ones(tmp_path: Path) -> None:
    scene = ring_scene(train=4, test=1)
    settings, said = TrainSettings(iterations=24, sh_degree=0, densification=MCMC), Said()
    whole = train(tmp_path / "whole", scene, settings, monitor=said)
    assert "4 training views are few: --dropout 0.2 leaves Gaussians out at random" in said.lines
    other = train(tmp_path / "other", scene, replace(settings, dropout=0.0))
    with pytest.raises(TrainingStoppedError):
        train(tmp_path / "stopped", scene, settings, monitor=StopAt(0, 6))
    again = resume(tmp_path / "stopped", scene, settings)
    assert bool((again.field(0).means == whole.field(0).means).all())
    assert not bool((other.field(0).means == whole.field(0).means).all())


def test_an_extension_leaves_out_as_many_as_the_end_of_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, shares = ring_scene(train=4, test=1), list[float]()
    settings = TrainSettings(iterations=12, levels=1, sh_degree=0, densification=MCMC)
    train(tmp_path / "run", scene, settings)
    monkeypatch.setattr(stage, "thinned", lambda field, share, _: shares.append(share) or thinned(field, share))
    resume(tmp_path / "run", scene, replace(settings, iterations=16, extended=4))
    assert shares == [0.2] * 4
