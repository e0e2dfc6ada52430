"""Forks of 3DGS train what `lapgs run` says: each level's images, composed residuals, the Gaussians in the archive."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.adapters import mini_splatting
from lapgs_plugin.adapters.registry import recognise
from lapgs_plugin.checkouts.training_call import StageWindow, TrainingCall
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.rendering.run import run_renderer, run_scene
from lapgs_plugin.runs.archive import RunArchive
from tests.contract.stub_runs import CHECKOUTS, FORKS, KINDS, THIRDS, captured, drive, loaded

NAMES = tuple(FORKS)
RUNS = [
    pytest.param(
        name, kind, marks=[pytest.mark.slow] if kind == "nested" and name != "dash" else [], id=f"{name}-{kind}"
    )
    for name in NAMES
    for kind in KINDS
]
"""Nested levels take the same way for all checkouts."""


@dataclass
class Seen:
    """Hold what the training loop of a fork did.

    Attributes:
        losses: iteration, render and target of each call of the loss.
        counts: iteration and number of Gaussians at the start of each iteration, in order.
        pruned: iterations in which Gaussians were pruned by scores.
        timed: iterations in which the time between two CUDA events was asked for.
        made_anew: iterations in which the Gaussians were replaced by points.
        budgets: budget and number of Gaussians at its start, whenever DashGaussian's scheduler is asked.
    """

    losses: list[tuple[int, Tensor, Tensor]] = field(default_factory=list)
    counts: list[tuple[int, int]] = field(default_factory=list)
    pruned: list[int] = field(default_factory=list)
    timed: list[int] = field(default_factory=list)
    made_anew: list[int] = field(default_factory=list)
    budgets: list[tuple[int, int]] = field(default_factory=list)

    @property
    def now(self) -> int:
        return len(self.counts)


def watch(adapter: Any, seen: Seen) -> None:
    """Look at the calls of a fork below everything that `lapgs run` replaces."""
    train, model = adapter.train, adapter.profile.model
    loss, update = train.l1_loss, model.update_learning_rate

    def l1_loss(image: Tensor, target: Tensor) -> Tensor:
        seen.losses.append((seen.now, image.detach().clone(), target.detach().clone()))
        return loss(image, target)

    def update_learning_rate(self: Any, iteration: int) -> Any:
        seen.counts.append((iteration, len(self._xyz)))
        return update(self, iteration)

    def noting(owner: Any, name: str, notes: list[int]) -> None:
        original: Callable[..., Any] = getattr(owner, name)

        @wraps(original)
        def method(*args: Any, **kwargs: Any) -> Any:
            notes.append(seen.now)
            return original(*args, **kwargs)

        setattr(owner, name, method)

    train.l1_loss, model.update_learning_rate = l1_loss, update_learning_rate
    if (schedules := sys.modules.get("utils.schedule_utils")) is not None:
        rate = schedules.TrainingScheduler.get_densify_rate

        def get_densify_rate(self: Any, *args: Any) -> float:
            seen.budgets.append((self.max_n_gaussian, self.init_n_gaussian))
            return float(rate(self, *args))

        schedules.TrainingScheduler.get_densify_rate = get_densify_rate
    if hasattr(model, "prune_gaussians"):
        noting(model, "prune_gaussians", seen.pruned)
        vars(torch.cuda)["Event"] = late_event(seen)  # until the script is unloaded
    if hasattr(model, "reinitial_pts"):
        noting(model, "reinitial_pts", seen.made_anew)


def late_event(seen: Seen) -> type:
    """Return a CUDA event as on a GPU that is busy with another process: complete only when it was waited for."""

    class Event(torch.cuda.Event):
        complete = False

        def synchronize(self) -> None:
            self.complete = True

        def elapsed_time(self, end_event: Event) -> float:
            if not end_event.complete:
                raise RuntimeError("Both events must be completed before calculating elapsed time.")
            seen.timed.append(seen.now)
            return 0.0

    return Event


@pytest.fixture(scope="module")
def run_of(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str], tuple[RunArchive, Seen]]:
    """Return a function that trains a fork once, with two levels of 30 and 60 iterations."""
    done: dict[tuple[str, str], tuple[RunArchive, Seen]] = {}

    def run(name: str, kind: str) -> tuple[RunArchive, Seen]:
        if (name, kind) not in done:
            folder, seen = tmp_path_factory.mktemp(f"{name}-{kind}") / "run", Seen()
            with captured(folder, []), loaded(FORKS[name], scene, folder) as adapter:
                watch(adapter, seen)
                drive(adapter, hierarchy=kind, joint=0.0, **THIRDS)
            seen.losses = [entry for entry in seen.losses if entry[0] > seen.now - 90]
            done[name, kind] = RunArchive.open(folder), seen
        return done[name, kind]

    return run


@pytest.mark.parametrize("name", NAMES)
def test_a_fork_is_recognised(name: str) -> None:
    adapter = recognise(CHECKOUTS / name)
    assert adapter is not None
    assert adapter.info.name.startswith(name)


@pytest.mark.parametrize(("name", "kind"), RUNS)
def test_the_images_of_each_level_reach_the_loss(
    name: str, kind: str, run_of: Callable[[str, str], tuple[RunArchive, Seen]]
) -> None:
    archive, seen = run_of(name, kind)
    assert [record.image_size for record in archive.manifest.records] == [(32, 24), (64, 48)]
    ends = archive.manifest.records[0].iterations  # a nested level ends before Speedy-Splat prunes in iteration 30
    assert (ends, len(seen.losses)) == (29 if (name, kind) == ("speedy", "nested") else 30, 90)
    base, finest = seen.losses[:ends], seen.losses[ends:]
    assert all(image.shape == target.shape for _, image, target in seen.losses)
    photos = [view.image for view in run_scene(archive).train]
    # In one call DashGaussian's own schedule holds, which halves all images until iteration 40.
    whole = finest[11:] if (name, kind) == ("dash", "nested") else finest
    assert {target.shape[1:] for _, _, target in whole} == {(48, 64)}
    for _, _, target in whole[:3]:
        assert min(float((target - photo).abs().max()) for photo in photos) < 1e-6
    # DashGaussian shrinks the images of the base further, at first.
    assert max(target.shape[2] for _, _, target in base) == (16 if (name, kind) == ("dash", "nested") else 32)
    small = [Pyramid("camera").down(photo) for photo in photos]
    for _, _, target in [entry for entry in base if entry[2].shape[2] == 32][:3]:
        assert min(float((target - photo).abs().max()) for photo in small) < 1 / 255  # 8 bits


@pytest.mark.parametrize("name", NAMES)
def test_a_residual_is_composed_before_the_loss(
    name: str, run_of: Callable[[str, str], tuple[RunArchive, Seen]]
) -> None:
    """In its first iteration a residual has no colour: the image is the base's prediction, rendered here by itself."""
    archive, seen = run_of(name, "laplacian")
    assert [record.signed for record in archive.manifest.records] == [False, True]
    _, image, target = seen.losses[30]
    renderer = run_renderer(archive, device="cpu", rasterizer="cpu")
    views = run_scene(archive).train
    view = min(views, key=lambda each: float((each.image - target).abs().max()))
    prediction = Pyramid("camera").up(renderer.render(view.camera).composed[1], (48, 64))
    assert float((image - prediction).abs().max()) < 0.02  # 8 bits of cached predictions
    assert float((image - image.mean()).abs().max()) > 0.1


@pytest.mark.parametrize(("name", "kind"), RUNS)
def test_the_archived_gaussians_are_those_of_the_last_iteration(
    name: str, kind: str, run_of: Callable[[str, str], tuple[RunArchive, Seen]]
) -> None:
    archive, seen = run_of(name, kind)
    counts = seen.counts[-90:]
    ends = archive.manifest.records[0].iterations
    last = {1: counts[ends - 1][1], 0: counts[89][1]}
    if kind == "nested":
        last[1] = counts[ends][1]  # one call: what the base's last iteration changed is the next one's start
    for record in archive.manifest.records:
        assert record.num_gaussians == len(archive.field(record.level)) == last[record.level]


def test_dashgaussians_budget_of_a_residual_is_what_it_inherits(
    run_of: Callable[[str, str], tuple[RunArchive, Seen]],
) -> None:
    """A base may grow to six times the scene's points, a residual at first to as many Gaussians as it has."""
    archive, seen = run_of("dash", "laplacian")
    first = next(i for i, (_, start) in enumerate(seen.budgets) if start == len(archive.field(1)))
    assert seen.budgets[0] == (1800, 300)
    assert seen.budgets[first] == (len(archive.field(1)),) * 2
    assert {image.shape[2] for _, image, _ in seen.losses[:30]} > {32}, "renders of the base grow"


@pytest.mark.slow
def test_dashgaussians_own_schedule_holds_in_one_call(run_of: Callable[[str, str], tuple[RunArchive, Seen]]) -> None:
    _, seen = run_of("dash", "nested")
    assert {start for _, start in seen.budgets} == {300}


def test_speedy_splat_prunes_at_shares_of_a_stage_and_not_at_its_end(
    run_of: Callable[[str, str], tuple[RunArchive, Seen]],
) -> None:
    """For 90 iterations it would prune at 30, 45, 60 and 75."""
    _, seen = run_of("speedy", "laplacian")
    assert seen.pruned == [10, 15, 20, 25, *(30 + i for i in (20, 30, 40, 50))]


def test_speedy_splats_pruning_may_be_timed_before_its_kernels_are_done(
    run_of: Callable[[str, str], tuple[RunArchive, Seen]],
) -> None:
    """Its `prune` asks for the time between two events, and waits for neither."""
    _, seen = run_of("speedy", "laplacian")
    assert seen.timed == seen.pruned


def test_speedy_splats_scores_are_the_checkouts_and_leave_other_gradients_alone(scene: Path, tmp_path: Path) -> None:
    scores: dict[str, Tensor] = {}
    reached: list[bool] = []
    with captured(tmp_path, []), loaded(FORKS["speedy"], scene, tmp_path / "run") as adapter:
        original, alone = adapter.train.score_func, adapter.replacements(lambda: True)[0].make(None)

        def compare(train_scene: Any, gaussians: Any, pipe: Any, background: Any, ratio: float) -> None:
            view = train_scene.getTrainCameras()[0]
            for name, score in (("alone", alone), ("checkout", original)):
                scores[name] = torch.zeros_like(gaussians.get_opacity)
                gaussians._xyz.grad = None
                with torch.enable_grad():
                    score(view, gaussians, pipe, background, scores[name])
                reached.append(gaussians._xyz.grad is not None)
            raise KeyboardInterrupt

        adapter.train.prune = compare
        with pytest.raises(KeyboardInterrupt):
            adapter.script.run_main()
    torch.testing.assert_close(scores["alone"], scores["checkout"])
    assert scores["alone"].max() > 0
    assert reached == [False, True]


def test_mini_splatting_makes_a_base_anew_and_no_residual(
    run_of: Callable[[str, str], tuple[RunArchive, Seen]],
) -> None:
    """It simplifies at 60 and 75 of 90 iterations: at 20 and 25 of the base's 30."""
    archive, seen = run_of("mini", "laplacian")
    assert seen.made_anew == [20]
    assert archive.field(0).sh.shape[1] == 16
    assert len({count for _, count in seen.counts[-60:]}) > 1, "a residual densifies"


@pytest.mark.slow
def test_mini_splatting_simplifies_once_in_one_call(run_of: Callable[[str, str], tuple[RunArchive, Seen]]) -> None:
    _, seen = run_of("mini", "nested")
    assert seen.made_anew == [60]


@pytest.mark.parametrize("late", [True, False], ids=["ms/train.py", "gs/train.py"])
def test_mini_splatting_unlocks_sh_of_a_residual_once_an_interval(
    late: bool, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of its scripts, plain 3DGS, does so itself from the start; the others after their simplification."""
    monkeypatch.setattr(mini_splatting, "SH_EVERY", 7)
    script = Path(shutil.copytree(CHECKOUTS, tmp_path / "copy")) / "mini" / "ms" / "train.py"
    text, condition = script.read_text(encoding="utf-8"), "if iteration % 1000 == 0 and iteration > simp_iteration1:"
    assert condition in text
    own = condition.replace("1000", "7") if late else "if iteration % 7 == 0:"
    script.write_text(text.replace(condition, own), encoding="utf-8")
    unlocked: list[int] = []
    with captured(tmp_path, []), loaded(FORKS["mini"], scene, tmp_path / "run", script=script) as adapter:
        seen, model = Seen(), adapter.profile.model
        watch(adapter, seen)
        one_more = model.oneupSHdegree

        def oneupSHdegree(self: Any) -> None:
            unlocked.append(seen.now)
            one_more(self)

        model.oneupSHdegree = oneupSHdegree
        drive(adapter, hierarchy="laplacian")
    of_residual = [now for now in unlocked if now > 30]
    assert len(of_residual) == 60 // 7


def test_efficientgs_unlocks_sh_of_a_residual_at_its_start(scene: Path, tmp_path: Path) -> None:
    total = 30_000
    base = StageWindow(Stage(1, (32, 24), 10_000, False), 0, total, 2, 4.0, 1.0)
    finest = StageWindow(Stage(0, (64, 48), 20_000, True), 10_000, total, 2, 4.0, 1.0)
    more = ("--iterations", total, "--densify_until_iter", 15_000, "--oneupSHdegree_from_iter", 15_500)
    calls: list[TrainingCall] = []
    with captured(tmp_path, []), loaded(FORKS["efficient"], scene, tmp_path, *more) as adapter:
        training = adapter.profile.training
        vars(adapter.train)["training"] = lambda *args: calls.append(TrainingCall.bind(training, args, {}))
        adapter.script.run_main()
        stages = [adapter.stage_call(calls[0], window, "run").opt for window in (base, finest)]
    assert [opt.oneupSHdegree_from_iter for opt in stages] == [5_167, 0]
    assert [opt.densify_until_iter for opt in stages] == [5_000, 10_000]
    assert [opt.use_sparse_shs for opt in stages] == [True, False]


def test_efficientgs_archives_what_its_rasterizer_renders(
    run_of: Callable[[str, str], tuple[RunArchive, Seen]],
) -> None:
    """Coefficients above a Gaussian's own degree are zero; those of most Gaussians are above degree 0."""
    sh = run_of("efficient", "laplacian")[0].field(1).sh
    used = sh[:, 1:].abs().amax((1, 2)) > 0
    assert 0 < int(used.sum()) < 0.5 * len(sh)  # each of three times a tenth gets one degree more
