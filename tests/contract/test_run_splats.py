"""Test `lapgs run` on a script whose class trains splats, as gsplat's simple_trainer: a stub of it, on the CPU."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
import typer
from torch import Tensor

from lapgs_plugin.checkouts.splat_script import SplatScript
from lapgs_plugin.cli.app import app
from lapgs_plugin.errors import LapgsError, MissingExtraError, RunFolderError, UserInputError
from lapgs_plugin.evaluation.metrics import psnr
from lapgs_plugin.fields.gaussian_field import field_from_splats
from lapgs_plugin.rasterizers.choice import is_antialiased
from lapgs_plugin.rasterizers.gsplat.rasterization import refusal
from lapgs_plugin.reference_raster import gsplat as stand_in
from lapgs_plugin.rendering.run import run_cameras, run_renderer, run_scene
from lapgs_plugin.runner.splats import on_cpu
from lapgs_plugin.runner.splats.on_cpu import rasterization_on_cpu
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.training_figures import finest_gains, last_view_psnrs
from lapgs_plugin.scenes.scene import load_scene
from tests.training_runs import rendered_gains

SCRIPT = Path(__file__).parent / "checkouts" / "simple_trainer" / "simple_trainer.py"
SHORT = ("--max_steps", 30, "--eval_steps", 30, "--save_steps", 30, "--strategy.refine_stop_iter", 20)
QUIET = ("--disable_viewer",)
KINDS = ("nested", "laplacian")

# Bare, the script's loader starts more processes than there are processors, and pins memory without a GPU.
BARE = pytest.mark.filterwarnings("ignore::UserWarning:torch.utils.data")


def train(scene: Path, folder: Path, *words: Any, lapgs: tuple[Any, ...] = (), kind: str = "default") -> Path:
    """Run `lapgs run --device cpu LAPGS simple_trainer.py KIND ... WORDS` in this process; return the folder."""
    own = ("--data_dir", scene, "--result_dir", folder, *SHORT, *QUIET, *words)
    arguments = [str(word) for word in ("run", "--device", "cpu", *lapgs, SCRIPT, kind, *own)]
    typer.main.get_command(app)(arguments, standalone_mode=False)
    return folder


def hierarchy(kind: str, *more: Any) -> tuple[Any, ...]:
    return ("--hierarchy", kind, *more)


def checkpoint(folder: Path, step: int) -> dict[str, Tensor]:
    """The splats that the script saved before the last optimizer step."""
    saved: dict[str, Tensor] = torch.load(folder / "ckpts" / f"ckpt_{step}_rank0.pt", weights_only=True)["splats"]
    return saved


def measured(folder: Path, step: int) -> float:
    """The PSNR that the script itself measured."""
    return float(json.loads((folder / "stats" / f"val_step{step:04d}.json").read_text())["psnr"])


def rendered(folder: Path) -> float:
    """The mean PSNR of the run folder's held-out views, rendered from its levels."""
    archive = RunArchive.open(folder)
    render, scene = run_renderer(archive, "cpu"), run_scene(archive)
    assert scene.test
    values = [psnr(render.render(view.camera).image.clamp(0, 1), view.image) for view in scene.test]
    return sum(values) / len(values)


class Render(NamedTuple):
    size: tuple[int, int]
    K: Tensor
    signed: bool
    trains: bool


@pytest.fixture
def renders(monkeypatch: pytest.MonkeyPatch) -> list[Render]:
    """All calls of the stand-in of gsplat's rasterization."""
    calls: list[Render] = []
    original = stand_in.rasterization

    def spy(*args: Any, **inputs: Any) -> Any:
        size, signed = (inputs["width"], inputs["height"]), inputs["sh_degree"] is None
        calls.append(Render(size, inputs["Ks"][0], signed, torch.is_grad_enabled()))
        return original(*args, **inputs)

    monkeypatch.setattr(stand_in, "rasterization", spy)
    return calls


@pytest.fixture(scope="module", params=KINDS)
def finished(request: pytest.FixtureRequest, scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("splats") / request.param
    return train(scene, folder, lapgs=hierarchy(request.param))


@BARE
def test_one_level_is_the_script_alone(scene: Path, tmp_path: Path) -> None:
    bare = checkpoint(train(scene, tmp_path / "bare", lapgs=("--off",)), 29)
    ours = checkpoint(train(scene, tmp_path / "run", lapgs=("--levels", 1)), 29)
    assert list(bare) == list(ours)
    assert all(torch.equal(bare[name], ours[name]) for name in bare)
    assert measured(tmp_path / "bare", 29) == measured(tmp_path / "run", 29)


def test_levels_are_archived(finished: Path) -> None:
    archive = RunArchive.open(finished)
    signed = finished.name == "laplacian"
    levels = [(each.level, each.image_size, each.iterations, each.signed) for each in archive.manifest.records]
    assert levels == [(1, (32, 24), 10, False), (0, (64, 48), 20, signed)]
    assert [archive.field(level).signed for level in (1, 0)] == [False, signed]
    assert {entry["level"] for entry in archive.history() if "psnr" in entry} == {0, 1}
    gains = finest_gains(last_view_psnrs(archive.history(), along=True))
    assert gains == pytest.approx(rendered_gains(archive, run_scene(archive).test), abs=1e-3)  # 1e-7 seen


def test_the_run_folder_shows_what_the_script_measured(finished: Path) -> None:
    """The script evaluates composed images, and the folder has its cameras: those of a normalised world."""
    own = measured(finished, 29 if finished.name == "nested" else 19)
    assert rendered(finished) == pytest.approx(own, abs=1e-4)  # 5e-7 was seen


def test_a_run_is_antialiased_as_its_script(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So it is rendered and exported that way. The stand-in cannot, and trains without."""
    original = stand_in.rasterization
    modes: list[str] = []

    def classic(*args: Any, rasterize_mode: str, **inputs: Any) -> Any:
        modes.append(rasterize_mode)
        return original(*args, **inputs)

    monkeypatch.setattr(stand_in, "rasterization", classic)
    folder = train(scene, tmp_path, "--antialiased", lapgs=hierarchy("nested"))
    assert {*modes} == {"antialiased"}
    assert is_antialiased(RunArchive.open(folder).manifest)


def test_the_script_writes_its_results_where_it_does_alone(finished: Path) -> None:
    last = checkpoint(finished, 29 if finished.name == "nested" else 19)
    field = RunArchive.open(finished).field(0)
    assert len(last["means"]) == len(field)
    # The checkpoint is of before the last step, whose rate is 5e-2 at most.
    saved = field_from_splats(last)
    assert (saved.opacity_logits - field.opacity_logits).abs().max() < 0.06
    assert (saved.means - field.means).abs().max() < 1e-3
    assert (finished / "level_1" / "stats").is_dir() == (finished.name == "laplacian")


@pytest.mark.parametrize("kind", KINDS)
def test_each_iteration_renders_its_level(kind: str, scene: Path, tmp_path: Path, renders: list[Render]) -> None:
    train(scene, tmp_path / "run", lapgs=hierarchy(kind, "--joint", 0) if kind == "laplacian" else hierarchy(kind))
    trained = [each for each in renders if each.trains]
    assert [each.size for each in trained] == [(32, 24)] * 10 + [(64, 48)] * 20
    assert [each.signed for each in trained] == [False] * 10 + [kind == "laplacian"] * 20
    assert torch.allclose(trained[0].K[:2] * 2, trained[-1].K[:2])


@pytest.mark.parametrize("kind", KINDS)
def test_our_kernels_can_do_what_the_script_asks_for(
    kind: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused: list[str] = []

    def rasterize(**inputs: Any) -> Any:
        refused.append(refusal(inputs))
        return rasterization_on_cpu(**inputs)

    monkeypatch.setattr(on_cpu, "rasterization_on_cpu", rasterize)
    train(scene, tmp_path / "run", lapgs=hierarchy(kind, "--rasterizer", "lapgs"))
    assert len(refused) > 30
    assert set(refused) == {""}


def test_three_levels_of_odd_sizes(big: Path, tmp_path: Path) -> None:
    lapgs = hierarchy("laplacian", "--levels", 3, "--split", "1/3,1/3,1/3")
    folder = train(big, tmp_path / "run", "--eval_steps", 20, 30, lapgs=lapgs)
    archive = RunArchive.open(folder)
    assert [each.image_size for each in archive.manifest.records] == [(24, 17), (48, 33), (96, 66)]
    # In the middle of the hierarchy the script sees the composed image of its level, upsampled.
    middle = next(each["psnr"] for each in archive.history() if each["level"] == 1 and "psnr" in each)
    assert measured(folder / "level_1", 9) == pytest.approx(middle, abs=1e-4)  # 4e-7 was seen
    assert measured(folder, 9) == pytest.approx(rendered(folder), abs=1e-4)  # 5e-7 was seen


def test_joint_training_moves_the_base(scene: Path, tmp_path: Path) -> None:
    frozen, joint = (
        RunArchive.open(train(scene, tmp_path / str(share), lapgs=hierarchy("laplacian", "--joint", share)))
        for share in (0, 0.5)
    )
    first = checkpoint(tmp_path / "0" / "level_1", 9)
    assert len(first["means"]) == len(frozen.field(1)) == len(joint.field(1))
    changed = (frozen.field(1).sh - joint.field(1).sh).abs().amax()
    assert 0 < changed < 10 * 2.5e-3 * 1.1  # ten steps at the script's rate, not at that of residuals


def test_rates_that_are_numbers_in_a_script(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs made from older examples have no settings of learning rates; their residuals are trained alike."""
    residuals = hierarchy("laplacian", "--residual-color-rate", 3)
    usual = RunArchive.open(train(scene, tmp_path / "usual", lapgs=residuals))
    settings = "    sh0_lr: float = 2.5e-3\n    shN_lr: float = 2.5e-3 / 20\n"
    script = edited(tmp_path / "checkout", settings, "")
    script.write_text(script.read_text().replace("config.sh0_lr", "2.5e-3").replace("config.shN_lr", "2.5e-3 / 20"))
    monkeypatch.setattr(f"{__name__}.SCRIPT", script)
    fixed = RunArchive.open(train(scene, tmp_path / "fixed", lapgs=residuals))
    for level in (1, 0):
        assert torch.equal(usual.field(level).sh, fixed.field(level).sh)


def test_a_loader_that_is_imported_by_name(
    finished: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = edited(tmp_path / "checkout", "torch.utils.data.DataLoader(", "DataLoader(")
    script.write_text(
        script.read_text().replace("import torch\n", "import torch\nfrom torch.utils.data import DataLoader\n", 1)
    )
    monkeypatch.setattr(f"{__name__}.SCRIPT", script)
    usual, own = (
        RunArchive.open(each) for each in (finished, train(scene, tmp_path / "run", lapgs=hierarchy(finished.name)))
    )
    for level in (1, 0):
        assert torch.equal(usual.field(level).means, own.field(level).means)


@pytest.mark.parametrize("kind", KINDS)
def test_mcmc_in_batches(kind: str, scene: Path, tmp_path: Path) -> None:
    folder = train(scene, tmp_path / "run", "--batch_size", 2, lapgs=hierarchy(kind), kind="mcmc")
    assert rendered(folder) == pytest.approx(
        measured(folder, 29 if kind == "nested" else 19), abs=1e-4
    )  # 5e-7 was seen
    assert RunArchive.open(folder).manifest.records[-1].num_gaussians > 300


def test_learned_poses_are_those_of_the_run(scene: Path, tmp_path: Path) -> None:
    still, moved = (
        run_cameras(RunArchive.open(train(scene, tmp_path / f"{len(options)}", *options, lapgs=hierarchy("laplacian"))))
        for options in ((), ("--pose_opt",))
    )
    shifts = [(still[0][name].position - moved[0][name].position).norm() for name in still[0]]
    # Adam's steps are of 1e-3 in each direction, ten of the base and twenty of the residual, which goes on from there.
    assert all(0 < shift < 30 * 2e-3 for shift in shifts), shifts
    assert all(torch.equal(still[1][name].position, moved[1][name].position) for name in still[1])


def test_poses_get_gradients_on_a_cpu() -> None:
    """The gradients of what a photo's corrections move, against differences of the images themselves."""
    generator = torch.Generator().manual_seed(0)
    n = 40
    inputs = {
        "means": torch.randn(n, 3, generator=generator) * 0.4 + torch.tensor([0.0, 0.0, 2.0]),
        "quats": torch.randn(n, 4, generator=generator),
        "scales": torch.rand(n, 3, generator=generator) * 0.1 + 0.05,
        "opacities": torch.rand(n, generator=generator) * 0.8 + 0.1,
        "colors": torch.randn(n, 9, 3, generator=generator) * 0.3,
        "Ks": torch.tensor([[[40.0, 0, 24], [0, 40.0, 16], [0, 0, 1]]]),
        "sh_degree": 2,
        "width": 48,
        "height": 32,
    }
    weights = torch.randn(1, 32, 48, 3, generator=generator)
    generators = torch.zeros(6, 4, 4)
    for i, (row, column) in enumerate(((2, 1), (0, 2), (1, 0))):
        generators[i, row, column], generators[i, column, row], generators[3 + i, i, 3] = 1.0, -1.0, 1.0

    def loss(numbers: Tensor) -> Tensor:
        pose = torch.linalg.matrix_exp((numbers[:, None, None] * generators).sum(0))[None]
        return (rasterization_on_cpu(**inputs, viewmats=pose)[0] * weights).sum()

    numbers = torch.zeros(6, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(numbers), numbers)
    steps = 2e-3 * torch.eye(6)
    with torch.no_grad():
        expected = torch.stack([(loss(step) - loss(-step)) / 4e-3 for step in steps])
    # Differences also see Gaussians that end or begin in pixels: 0.9994 was seen.
    assert torch.cosine_similarity(gradient, expected, dim=0) > 0.99


@pytest.mark.parametrize("option", ["--app_opt", "--depth_loss", "--random_bkgd"])
def test_what_residuals_cannot_have_nested_levels_can(option: str, scene: Path, tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match=f"{option}: .*--hierarchy nested"):
        train(scene, tmp_path / "laplacian", option, lapgs=hierarchy("laplacian"))
    folder = train(scene, tmp_path / "nested", option, lapgs=hierarchy("nested"))
    field = RunArchive.open(folder).field(0)
    assert bool(field.sh[:, 1:].any()) == (option != "--app_opt")


def test_held_out_views_are_the_scripts(scene: Path, tmp_path: Path) -> None:
    archive = RunArchive.open(train(scene, tmp_path / "run", "--test_every", 3, lapgs=hierarchy("nested")))
    views = run_scene(archive)
    names = [view.name for view in load_scene(scene, progress=False).train]
    assert [view.name for view in views.test] == names[::3]
    assert [view.name for view in views.train] == [name for i, name in enumerate(names) if i % 3]


def test_viewers_see_composed_images_of_any_size(
    scene: Path, tmp_path: Path, renders: list[Render], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{__name__}.QUIET", ())
    train(scene, tmp_path / "run", "--max_steps", 90, lapgs=hierarchy("laplacian", "--joint", 0))
    shown = [each for each in renders if each.size in ((51, 35), (26, 18)) and not each.trains]
    # Once by the base, which is no residual; then twice by the residual, with the base at half the size below.
    assert [(each.size, each.signed) for each in shown] == [
        ((51, 35), False),
        *[((26, 18), False), ((51, 35), True)] * 2,
    ]


class Stopped(Exception):
    """The user pressed Ctrl-C."""


def test_a_run_with_residuals_is_resumed(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = train(scene, tmp_path / "whole", lapgs=hierarchy("laplacian"))
    original = stand_in.rasterization

    def stop(*args: Any, **inputs: Any) -> Any:
        if inputs["sh_degree"] is None:
            raise Stopped
        return original(*args, **inputs)

    with monkeypatch.context() as patch:
        patch.setattr(stand_in, "rasterization", stop)
        with pytest.raises(Stopped):
            train(scene, tmp_path / "run", lapgs=hierarchy("laplacian"))
    with pytest.raises(RunFolderError, match="another joint"):
        train(scene, tmp_path / "run", lapgs=hierarchy("laplacian", "--resume", "--joint", 0.1))
    folder = train(scene, tmp_path / "run", lapgs=hierarchy("laplacian", "--resume"))
    for level in (1, 0):
        assert (folder / f"level_{level}" / "point_cloud.ply").read_bytes() == (
            whole / f"level_{level}" / "point_cloud.ply"
        ).read_bytes()


def test_run_folders_are_kept(finished: Path, scene: Path, tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match="already holds a run"):
        train(scene, finished, lapgs=hierarchy("nested"))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(RunFolderError, match="not empty and not a run"):
        train(scene, tmp_path / "mine", lapgs=hierarchy("nested"))
    folder = train(scene, tmp_path / "run", lapgs=hierarchy("nested"))
    before = RunArchive.open(folder).field(0)
    train(scene, folder, lapgs=hierarchy("nested", "--overwrite"))
    assert torch.equal(before.means, RunArchive.open(folder).field(0).means)


REFUSED: dict[str, tuple[tuple[Any, ...], tuple[Any, ...], str]] = {
    "resume nested": (("--hierarchy", "nested", "--resume"), (), "--resume: Runner.train"),
    "supervision": (("--supervision", "online_residual"), (), "--supervision online_residual has no effect"),
    "prune": (("--prune", 0.01), (), "--prune 0.01 has no effect"),
    "appearance": (("--appearance", "affine"), (), "--appearance affine has no effect"),
    "inherit": (("--inherit", "full"), (), "--inherit full"),
    "masks": (("--masks", "masks"), (), "--masks masks"),
    "depth": (("--depth", "points"), (), "--depth points"),
    "breakdown": (("--breakdown",), (), "--breakdown"),
    "record": (("--off", "--record"), (), "--record"),
    "patches": ((), ("--patch_size", 16), "--patch_size 16"),
    "lens": ((), ("--camera_model", "fisheye"), "--camera_model fisheye"),
    "batches": ((), ("--batch_size", 2), "--batch_size 2"),
    "levels": (("--levels", 9), (), "level 8 of 9 would be"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_has_no_effect_is_refused(case: str, scene: Path, tmp_path: Path) -> None:
    lapgs, words, line = REFUSED[case]
    with pytest.raises(LapgsError) as caught:
        train(scene, tmp_path / "run", *words, lapgs=lapgs)
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run" / "manifest.json").exists()


def edited(folder: Path, before: str, after: str) -> Path:
    """Return a copy of the stub whose script has another text."""
    text = SCRIPT.read_text()
    assert before in text
    folder.mkdir()
    for name in ("options.py", "datasets"):
        (folder / name).symlink_to(SCRIPT.parent / name)
    (folder / SCRIPT.name).write_text(text.replace(before, after))
    return folder / SCRIPT.name


EDITS: dict[str, tuple[str, str, type[Exception], str]] = {
    "a package": ("import tqdm\n", "import tqdm\nimport no_such_package\n", MissingExtraError, "needs no_such_package"),
    "other loops": (
        "range(max_steps)",
        "range(max_steps - 1)",
        LapgsError,
        "ended after 9 of 10 iterations",
    ),
    "positions": ('means=splats["means"],', 'splats["means"],', UserInputError, "1 arguments without names"),
    "attributes": ("self.valset =", "self.testset =", UserInputError, "has no valset"),
}


@pytest.mark.parametrize("case", EDITS)
def test_scripts_that_differ(case: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, after, kind, line = EDITS[case]
    monkeypatch.setattr(f"{__name__}.SCRIPT", edited(tmp_path / "checkout", before, after))
    with pytest.raises(kind, match=line) as caught:
        train(scene, tmp_path / "run", lapgs=hierarchy("laplacian"))
    assert "\n" not in str(caught.value)


def described(text: str, folder: Path) -> SplatScript | None:
    (folder / "script.py").write_text(text)
    return SplatScript.read(folder / "script.py")


def test_scripts_are_recognised_by_their_class(tmp_path: Path) -> None:
    found: Callable[[str], SplatScript | None] = lambda text: described(text, tmp_path)  # noqa: E731
    text = SCRIPT.read_text()
    assert (known := found(text)) is not None
    assert known.trainer == "Runner"
    assert found(text.replace("from gsplat.rendering import rasterization", "from ours import rasterization")) is None
    assert found(text.replace("rasterization", "rasterization_2dgs")) is None
    assert found(text.replace("def train(", "def fit(")) is None
