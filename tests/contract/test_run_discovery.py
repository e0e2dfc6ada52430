"""What `lapgs run` and `lapgs doctor` find in a checkout's sources, and the lines for checkouts that do not fit."""

from __future__ import annotations

import re
import shutil
import sys
from argparse import Namespace
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import typer

from lapgs_plugin.adapters.registry import adapter_class
from lapgs_plugin.checkouts.profile import held_by
from lapgs_plugin.checkouts.source import CheckoutSource
from lapgs_plugin.checkouts.training_call import StageWindow, TrainingCall
from lapgs_plugin.cli.app import app
from lapgs_plugin.cli.doctor_checkout import describe
from lapgs_plugin.errors import MissingExtraError, UserInputError
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.runner.installed_packages import explain_import_error, require_packages
from tests.contract.stub_runs import CHECKOUTS, STUBS, loaded, stand_in_is_refused

MODULE = "diff_gaussian_rasterization"
OTHER = "diff_gaussian_rasterization_abs"


def missing(package: str) -> ModuleNotFoundError:
    return ModuleNotFoundError(f"No module named '{package}'", name=package)


@pytest.fixture
def fork(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a fork whose scripts are in a folder, and whose renderer imports another rasterizer when it is called."""
    monkeypatch.delenv("COLUMNS", raising=False)  # set where tests run in parallel, and it would wrap what is printed
    root = Path(shutil.copytree(CHECKOUTS / "graphdeco", tmp_path / "fork", ignore=shutil.ignore_patterns("__pyc*")))
    (root / "scripts").mkdir()
    script = (root / "train.py").read_text(encoding="utf-8")
    (root / "scripts" / "train.py").write_text("import sys\nsys.path.append('..')\nimport open3d\n" + script)
    (root / "train.py").unlink()
    renderer = root / "gaussian_renderer" / "__init__.py"
    text = renderer.read_text(encoding="utf-8")
    line = f"from {MODULE} import GaussianRasterizationSettings, GaussianRasterizer\n"
    assert line in text
    head, tail = text.replace(line, "").split("    screenspace_points = ", 1)
    inside = f"    import {MODULE}\n    from {OTHER} import GaussianRasterizationSettings, GaussianRasterizer as R\n"
    tail = tail.replace("GaussianRasterizer(raster_settings", "R(raster_settings")
    renderer.write_text(f"# {line}{head}{inside}    screenspace_points = {tail}", encoding="utf-8")
    return root


def test_a_fork_is_found_from_a_script_below_its_root(fork: Path) -> None:
    source = CheckoutSource.read(fork / "scripts" / "train.py")
    assert source.root == fork
    assert source.model[0] == "GaussianModel"
    assert source.model[1].startswith("scene/gaussian_model.py:")
    (use,) = source.rasterizers
    assert (use.module, use.inside, use.functions, len(use.outputs)) == (OTHER, True, ("render",), 3)
    assert use.names == ("GaussianRasterizationSettings", "GaussianRasterizer")
    assert {"antialiasing", "viewmatrix"} < use.settings
    assert adapter_class(fork).info.name == "generic", "its rasterizer is another one"
    stand_in_is_refused(
        fork, f"lapgs has no rasterizer in place of {OTHER}, imported in gaussian_renderer/__init__.py:"
    )


def test_two_rasterizers_of_one_name_are_each_replaced_once(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in Perceptual-GS: wrapped twice, a residual would be composed twice."""
    other = ModuleType(OTHER)
    vars(other)["GaussianRasterizer"] = type("GaussianRasterizer", (), {})
    monkeypatch.setitem(sys.modules, OTHER, other)
    checkouts = Path(shutil.copytree(CHECKOUTS, tmp_path / "c", ignore=shutil.ignore_patterns("__pycache__")))
    with (checkouts / "graphdeco" / "gaussian_renderer" / "__init__.py").open("a") as file:
        file.write(f"\n\ndef scores():\n    from {OTHER} import GaussianRasterizer\n    return GaussianRasterizer()\n")
    with loaded(STUBS["graphdeco"], scene, tmp_path, script=checkouts / "graphdeco" / "train.py") as adapter:
        name, holders = "GaussianRasterizer", adapter.profile.rasterizer_holders
        modules = {
            rasterizer.use.module: [module.__name__ for module, _ in holders(rasterizer, name)]
            for rasterizer in adapter.profile.rasterizers
        }
    assert modules == {MODULE: ["gaussian_renderer"], OTHER: [OTHER]}


def test_a_scene_that_reads_its_cameras_is_no_camera(scene: Path, tmp_path: Path) -> None:
    """As PGSR's, which compares their poses to find the nearest ones of each."""
    checkouts = Path(shutil.copytree(CHECKOUTS, tmp_path / "c", ignore=shutil.ignore_patterns("__pycache__")))
    path, line = checkouts / "graphdeco" / "scene" / "__init__.py", "        self.gaussians = gaussians\n"
    text, reads = path.read_text(encoding="utf-8"), "gaussians.image_name, gaussians.world_view_transform"
    assert text.count(line) == 1
    path.write_text(
        text.replace(line, f"{line}        if not args:\n            self.pose = {reads}\n"), encoding="utf-8"
    )
    with loaded(STUBS["graphdeco"], scene, tmp_path, script=checkouts / "graphdeco" / "train.py") as adapter:
        assert adapter.profile.scene.__name__ == "Scene"
        assert [each.__name__ for each in adapter.profile.cameras] == ["Camera"]


def test_the_model_is_the_class_that_the_script_calls(tmp_path: Path) -> None:
    """As of TrimGS, whose script makes a class derived from 3DGS's, which it imports, too."""
    root = Path(shutil.copytree(CHECKOUTS / "graphdeco", tmp_path / "fork", ignore=shutil.ignore_patterns("__pyc*")))
    with (root / "scene" / "gaussian_model.py").open("a", encoding="utf-8") as model:
        model.write("\n\nclass Flat(GaussianModel):\n    pass\n")
    script = root / "train.py"
    text = script.read_text(encoding="utf-8")
    assert CheckoutSource.read(script).model[0] == "GaussianModel"
    script.write_text(text.replace(" = GaussianModel(", " = Flat(") + "\n", encoding="utf-8")
    assert CheckoutSource.read(script).model[0] == "Flat"


def test_a_rasterizer_that_is_not_installed_is_the_checkouts_own(fork: Path) -> None:
    error = ModuleNotFoundError(f"No module named '{OTHER}'", name=OTHER)
    script = fork / "scripts" / "train.py"
    on_gpu, on_cpu = (explain_import_error(error, script, on_cpu=on_cpu) for on_cpu in (False, True))
    for line in map(str, (on_gpu, on_cpu)):
        assert line.startswith("gaussian_renderer/__init__.py:")
        assert f"needs {OTHER}, which cannot be imported" in line
        assert "\n" not in line
    assert "--device cpu" in str(on_gpu)
    assert "--device cpu" not in str(on_cpu), "it was given"


def test_a_name_that_a_stand_in_lacks(fork: Path) -> None:
    """As `compute_relocation` of 3dgs-mcmc once was."""
    error = ImportError(f"cannot import name 'compute_relocation' from '{MODULE}'", name=MODULE)
    line = str(explain_import_error(error, CHECKOUTS / "graphdeco" / "train.py", on_cpu=True))
    assert "compute_relocation" in line
    assert "it needs CUDA" in line


def test_a_package_that_is_not_installed_is_to_be_installed(fork: Path) -> None:
    """As open3d of Mip-Splatting."""
    error = missing("open3d")
    line = str(explain_import_error(error, fork / "scripts" / "train.py", on_cpu=True))
    assert line == (
        "scripts/train.py:3 needs open3d, which cannot be imported (No module named 'open3d'): pip install open3d"
    )


def test_packages_that_are_missing_are_named_at_once(fork: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As GES needs four; those that a branch imports, or a module that is imported in a function, may not be needed."""
    script = fork / "scripts" / "train.py"
    text = script.read_text(encoding="utf-8").replace("import sys\nsys.path.append('..')\n", "import einops_\n")
    text = text.replace("import open3d\n", "import sklearn_, wandb_\nif len('a') > 1:\n    import never_\n")
    script.write_text(f"{text}\n\ndef late():\n    import later\n", encoding="utf-8")
    (fork / "scripts" / "later.py").write_text("import lazy_\n", encoding="utf-8")
    names = ("einops_", "sklearn_", "wandb_")
    assert tuple(each.name for each in describe(script)["Packages"]) == names
    with pytest.raises(MissingExtraError) as caught:
        lapgs("run", "--device", "cpu", script)
    assert str(caught.value) == (
        "scripts/train.py:1 needs einops_, which cannot be imported (No module named 'einops_'): pip install einops_; "
        "not installed either: sklearn_, wandb_: pip install sklearn_ wandb_"
    )
    assert "simple_knn" not in str(explain_import_error(missing("einops_"), script, on_cpu=False)), "lapgs has it"


def test_what_changes_the_path_of_imports_is_left_to_the_import(fork: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    require_packages(CheckoutSource.read(fork / "scripts" / "train.py"), "cpu")  # open3d may be in '..'


@pytest.mark.parametrize("code", ["CUDAExtension", "Extension"])
def test_a_package_that_the_checkout_brings_is_installed_from_there(fork: Path, code: str) -> None:
    """As GaussianPro's propagation: nobody else has a package of that name, or a stranger has."""
    folder = fork / "submodules" / "Propagation"
    folder.mkdir(parents=True)
    (folder / "setup.py").write_text(f"setup(ext_modules=[{code}('open3d._C', ['a.cu'])])")
    error, script = missing("open3d"), fork / "scripts" / "train.py"
    on_gpu, on_cpu = (str(explain_import_error(error, script, on_cpu=on_cpu)) for on_cpu in (False, True))
    (packages,) = (each for each in describe(script)["Packages"] if each.name == "open3d")
    stand_in = describe(script)["lapgs run"][-1].detail
    if code == "CUDAExtension":
        assert on_gpu.endswith(f": {packages.advice}")
        assert packages.advice == f"pip install --no-build-isolation {folder}"
        assert on_cpu.endswith("no CPU stand-in has what the checkout takes from it; it needs CUDA")
        assert stand_in.startswith("no CPU stand-in for open3d, which scripts/train.py:3 imports from ")
    else:
        assert on_gpu.startswith(on_cpu)
        assert on_cpu.endswith(f": {packages.advice}")
        assert packages.advice == f"pip install {folder}"
        assert "open3d" not in stand_in


WINDOW = StageWindow(Stage(0, (8, 6), 20, signed=True), 10, 30, 2, 4.0, 2.0)


def test_arguments_of_training_are_known_by_their_roles(scene: Path, tmp_path: Path) -> None:
    """2DGS has no `debug_from`, Speedy-Splat `visualize_iterations`, EfficientGS `no_gui`."""
    passed: list[Any] = []

    def training(
        cfg: Any, options: Any, visualize_iterations: list[int], no_gui: bool = True, args: Any = None
    ) -> None:
        passed.append((cfg, options, visualize_iterations, no_gui, args))

    cfg = SimpleNamespace(source_path="scene", model_path="out", white_background=True)
    options = SimpleNamespace(iterations=30, feature_lr=0.1, densify_grad_threshold=0.2)
    parsed = Namespace(depth_pseudo_weight=0.5, test_iterations=[7, 25])
    with loaded(STUBS["graphdeco"], scene, tmp_path) as adapter:
        call = TrainingCall.bind(training, (cfg, options, [5, 15]), {"args": parsed})
        adapter.stage_call(call, WINDOW, "run/level_0").run()
    ((own, changed, visualized, gui, args),) = passed
    assert (args.depth_pseudo_weight, args.test_iterations) == (0.0, [15]), "of a residual"
    assert (parsed.depth_pseudo_weight, parsed.test_iterations) == (0.5, [7, 25])
    assert (own.model_path, own.white_background, cfg.model_path) == ("run/level_0", False, "out")
    assert (changed.iterations, changed.feature_lr, changed.densify_grad_threshold) == (20, 0.4, 0.4)
    assert (visualized, gui) == ([5], True)
    with pytest.raises(UserInputError, match=r"training\(cfg, options, .* has no argument with source_path") as caught:
        TrainingCall.bind(training, (1, options, []), {})
    assert "\n" not in str(caught.value)


def test_roles_among_all_options_of_a_script(scene: Path, tmp_path: Path) -> None:
    """As LightGaussian's distillation, which gets them besides, or a script that passes nothing else on."""
    options = Namespace(source_path="scene", model_path="out", iterations=30, feature_lr=0.1, convert_SHs_python=True)
    groups = SimpleNamespace(source_path="scene", model_path="out"), SimpleNamespace(iterations=30)
    call = TrainingCall.bind(lambda args, dataset, opt: None, (options, *groups), {})
    assert call.roles == {"dataset": "dataset", "opt": "opt", "pipe": "args"}
    with loaded(STUBS["graphdeco"], scene, tmp_path) as adapter:
        call = adapter.stage_call(TrainingCall.bind(lambda args: None, (options,), {}), WINDOW, "run/level_0")
    own = call.values["args"]
    assert (own.model_path, own.iterations, own.feature_lr, own.convert_SHs_python) == ("run/level_0", 20, 0.4, False)
    assert (options.model_path, options.iterations) == ("out", 30), "the script's own are not changed"


def test_options_in_a_global_variable_name_the_output_folder_of_the_call() -> None:
    """As DropGaussian's, whose dry run would otherwise write into the run's folder."""
    names: dict[str, Any] = {"args": Namespace(model_path="out", quiet=True), "other": Namespace(quiet=True)}
    exec(
        "written = []\ndef training(dataset, opt, own):\n"
        "    written.extend([args.model_path, own.model_path])\n    if opt.stop: raise KeyboardInterrupt",
        names,
    )
    dataset = SimpleNamespace(source_path="scene", model_path="out/level_1")
    for own in (names["args"], Namespace(model_path="out")):
        opt = SimpleNamespace(iterations=30, stop=own is not names["args"])
        call = TrainingCall.bind(names["training"], (dataset, opt, own), {})
        with pytest.raises(KeyboardInterrupt) if opt.stop else nullcontext():
            call.run()
        assert (names["args"].model_path, own.model_path) == ("out", "out"), "put back"
    assert names["written"] == ["out/level_1"] * 4
    assert vars(names["other"]) == {"quiet": True}


def test_iterations_among_parsed_options_are_the_calls() -> None:
    """FSGS and CoR-GS give `training` all of the script's options, and the lists with them."""
    args = Namespace(test_iterations=[7, 25], save_iterations=[12, 30], iterations=30, start_checkpoint="old.pth")
    dataset, opt = SimpleNamespace(source_path="scene"), SimpleNamespace(iterations=30)
    call = TrainingCall.bind(lambda dataset, opt, args: None, (dataset, opt, args), {})
    assert (call.checkpoint, call.test_iterations) == ("old.pth", [7, 25])
    own = call.listing(WINDOW.local).values["args"]
    assert (own.test_iterations, own.save_iterations, own.iterations) == ([15], [2, 20], 30)
    assert args.test_iterations == [7, 25], "the script's own are not changed"
    parsed = call.changed(args=Namespace(iterations=30))
    assert (parsed.checkpoint, parsed.test_iterations) == (None, ())


def test_a_lazy_module_may_grow_while_it_is_looked_at() -> None:
    module = ModuleType("lazy")

    class Lazy:
        @property  # type: ignore[misc]
        def __class__(self) -> type:
            setattr(module, f"loaded_{len(vars(module))}", None)
            return int

    vars(module).update(first=Lazy(), second=Lazy())
    assert {name for name, value in held_by(module) if isinstance(value, int)} >= {"first", "second"}
    assert sum(name.startswith("loaded_") for name in vars(module)) >= 2


def test_arguments_that_a_script_gathers_are_passed_on_by_name() -> None:
    passed: list[dict[str, Any]] = []

    def training(cfg: Any, opt: Any, **more: Any) -> None:
        passed.append(more)

    def gathering(cfg: Any, opt: Any, *more: Any) -> None:
        passed.append({"more": more})

    cfg, opt = SimpleNamespace(source_path="scene"), SimpleNamespace(iterations=30)
    TrainingCall.bind(training, (cfg,), {"opt": opt, "quiet": True}).changed(quiet=False).run()
    TrainingCall.bind(gathering, (cfg, opt), {}).run()
    assert passed == [{"quiet": False}, {"more": ()}]
    with pytest.raises(UserInputError, match=r"gathering\(\) of the script got 1 argument\(s\) in \*more"):
        TrainingCall.bind(gathering, (cfg, opt, 3), {})


def lapgs(*words: Any) -> None:
    typer.main.get_command(app)(list(map(str, words)), standalone_mode=False)


def test_a_script_of_no_checkout(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = tmp_path / "train.py"
    script.write_text('import json\nif __name__ == "__main__":\n    print("here")\n')
    with pytest.raises(UserInputError, match="is not the training script of a 3DGS checkout") as caught:
        lapgs("run", "--device", "cpu", script)
    assert "\n" not in str(caught.value)
    lapgs("run", "--off", "--device", "cpu", script)
    assert capsys.readouterr().out == "here\n", "--off recognises nothing"
    with pytest.raises(UserInputError, match="is not the training script of a 3DGS checkout"):
        lapgs("doctor", tmp_path)
    script.unlink()
    submodule = r"is empty \(in a clone `git submodule update --init --recursive` fills its submodules\)"
    (tmp_path / "raster").mkdir()
    folders = {tmp_path: r"has no train\*.py", tmp_path / "raster": submodule, tmp_path / "nowhere": "does not exist"}
    for folder, lacks in folders.items():
        with pytest.raises(UserInputError, match=rf"{folder} {lacks}, expected the root of a 3DGS checkout"):
            lapgs("doctor", folder)


def test_doctor_describes_a_checkout(fork: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with (fork / "gaussian_renderer" / "__init__.py").open("a", encoding="utf-8") as renderer:
        renderer.write(
            "\n\nfrom fast_backend import rasterize\n\ndef faster(pc):\n    return rasterize(means=pc.get_xyz)\n"
        )
    lapgs("doctor", fork)
    text = capsys.readouterr().out
    for part in (str(fork), "--backbone generic", "scripts/train.py:", "training(dataset, opt, pipe", OTHER, "open3d"):
        assert part in text
    assert "its rasterizer takes colors_precomp and shs, but fast_backend does not;" in text
    lapgs("doctor", CHECKOUTS / "taming")
    text = capsys.readouterr().out
    assert "Taming-3DGS (--backbone taming)" in text
    assert "stand-in taming" in text
    assert "iteration == args.ho_iteration (modify_functions)" in text, "what the loop does by iteration"


def test_a_package_without_an_init_file_is_the_checkouts_own(fork: Path) -> None:
    """As `utils` of DNGaussian, which another package of the environment may be called, too."""
    (fork / "tools").mkdir()
    (fork / "tools" / "poses.py").write_text("")
    with (fork / "scripts" / "train.py").open("a", encoding="utf-8") as script:
        script.write("\nfrom tools import poses\n")
    named = [each.name for each in CheckoutSource.read(fork / "scripts" / "train.py").externals]
    assert "open3d" in named
    assert "tools" not in named


def test_doctor_says_that_flat_gaussians_have_no_residuals(fork: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As 2DGS has."""
    lapgs("doctor", fork)
    assert "scale axes" not in capsys.readouterr().out
    model = fork / "scene" / "gaussian_model.py"
    lines = model.read_text(encoding="utf-8").splitlines()
    lines += [
        "",
        "    def create_from_pcd(self, pcd, *others):",
        "        scales = self.distances(pcd)[..., None].repeat(1, 2)",
    ]
    model.write_text("\n".join(lines) + "\n", encoding="utf-8")
    lapgs("doctor", fork)
    assert f"residuals need three scale axes; scene/gaussian_model.py:{len(lines)} makes 2" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("reads", "said"),
    [
        ("len(pc.exposure_mapping)", "exposure_mapping"),
        ("helper(pc)", "pretrained_exposures"),
        ("helper(pc) if pipe.antialiasing else None", None),
        ("pc.max_radii2D", None),
    ],
)
def test_doctor_says_what_a_model_is_rendered_with_beside_parameters(
    reads: str, said: str | None, fork: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As DNGaussian's network and the SH degrees of Reduced-3DGS; what options may turn off is not known to matter."""
    renderer, start = fork / "gaussian_renderer" / "__init__.py", "    screenspace_points = "
    text = renderer.read_text(encoding="utf-8")
    assert text.count(start) == 1
    helper = "\n\ndef helper(pc):\n    return pc.pretrained_exposures\n"
    renderer.write_text(text.replace(start, f"    {reads}\n{start}") + helper, encoding="utf-8")
    lapgs("doctor", fork)
    shown = capsys.readouterr().out
    assert "one call of the checkout's own training" in shown
    assert (f"are rendered with {said}, which create_from_pcd() makes and fields do not have" in shown) == bool(said)
    assert ("its rasterizer takes colors_precomp and shs" in shown) != bool(said)


def test_options_in_one_tree_have_no_levels(fork: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As of Self-Organizing Gaussians: `lapgs run` refused it in the middle of its main block."""
    script = fork / "scripts" / "train.py"
    text, start = script.read_text(encoding="utf-8"), "    first_iter = 0\n"
    assert text.count(start) == 1
    why = r"training\(dataset, opt, .*\) of the script has no argument with source_path, expected one as dataset has"
    for reads, count in (("dataset.source_path, dataset.parts.source_path", 0), ("dataset.parts.source_path", 2)):
        own = text.replace("dataset.source_path", "None").replace(start, f"{start}    print({reads})\n")
        script.write_text(own, encoding="utf-8")
        lapgs("doctor", fork)
        assert len(re.findall(why, capsys.readouterr().out)) == count
    with pytest.raises(UserInputError, match=f"cannot be trained in levels: {why}.* --off"):
        lapgs("run", "--device", "cpu", script)


def test_a_model_that_lacks_what_fields_have(fork: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As of forks whose colours come from a network."""
    model = fork / "scene" / "gaussian_model.py"
    base, parameters = "class GaussianModel(GaussianBase):\n", ("_xyz", "_rotation", "_scaling", "_opacity")
    text = model.read_text(encoding="utf-8")
    assert base in text
    roles = (
        f"class GaussianModel:\n    def get_xyz(self):\n        return {', '.join(f'self.{n}' for n in parameters)}\n"
    )
    model.write_text(text.replace(base, roles), encoding="utf-8")
    lapgs("doctor", fork)
    shown = capsys.readouterr().out
    why = r"\(scene/gaussian_model.py:\d+\) have no _features_dc, _features_rest, from"
    assert len(re.findall(why, shown)) == 2
    with pytest.raises(UserInputError, match=f"cannot be trained in levels: its Gaussians {why}.* --off"):
        lapgs("run", "--device", "cpu", fork / "scripts" / "train.py")  # before packages, which would not help


def test_doctor_says_that_images_of_several_sizes_have_no_levels(
    fork: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As Mini-Splatting2 has, whose scene `lapgs run` refuses."""
    script = fork / "scripts" / "train.py"
    text = script.read_text(encoding="utf-8")
    call = "Scene(dataset, gaussians)"
    assert text.count(call) == 1
    line = text[: text.index(call)].count("\n") + 1
    for scales, said in (("[1.0]", None), ("[1, 2]", "the scales 1, 2 ")):
        script.write_text(text.replace(call, f"Scene(dataset, gaussians, resolution_scales={scales})"))
        lapgs("doctor", fork)
        shown = capsys.readouterr().out
        assert shown.count(f"{said}(scripts/train.py:{line})") == (0 if said is None else 2)
        assert ("one call of the checkout's own training" in shown) == (said is None)


def test_doctor_says_which_training_scripts_there_are(fork: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As Mini-Splatting has `gs/train.py` and `ms/train.py`, DashGaussian `train.py` and `train_dash.py`."""
    shutil.copytree(fork / "scripts", fork / "more")
    with pytest.raises(UserInputError, match=r"several training scripts: more/train.py, scripts/train.py;") as e:
        lapgs("doctor", fork)
    assert f"`lapgs doctor {fork / 'more/train.py'}`" in str(e.value)
    assert "\n" not in str(e.value)
    own = Path(shutil.copytree(CHECKOUTS / "mini", fork.parent / "mini"))
    shutil.copytree(own / "ms", own / "gs")
    with pytest.raises(UserInputError, match=r"gs/train.py, ms/train.py; .* doctor .*/mini/ms/train.py`"):
        lapgs("doctor", own)
    lapgs("doctor", fork / "scripts" / "train.py")
    assert "Other scripts" not in capsys.readouterr().out
    shutil.copy(fork / "more" / "train.py", fork)
    lapgs("doctor", fork)
    text = capsys.readouterr().out
    assert " train.py:" in text
    assert "more/train.py, scripts/train.py; describe one with `lapgs doctor" in text
