"""Models that a script chooses when it runs, models with more than a field's parameters, and finished models."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from lapgs_plugin.checkouts.source import CheckoutSource
from lapgs_plugin.cli.doctor import current_folder
from lapgs_plugin.cli.doctor_checkout import describe
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.runs.archive import RunArchive
from tests.contract.stub_runs import CHECKOUTS, SHORT, STUBS, captured, drive, edited_graphdeco, loaded, run_residuals

MADE = "    gaussians = GaussianModel(dataset.sh_degree, opt.optimizer_type)\n"
MODELS = """

class Chosen(GaussianModel):
    def update_learning_rate(self, iteration):
        return super().update_learning_rate(iteration)


class Flat(GaussianModel):
    def create_from_pcd(self, pcd, *others):
        scales = self.distances(pcd)[..., None].repeat(1, 2)


MODELS = {"plain": GaussianModel, "chosen": Chosen, "flat": Flat}


def make_model(dataset, opt):
    return Chosen(dataset.sh_degree, opt.optimizer_type)
"""
CHOICES = {
    "a dictionary": '    name = "chosen" if dataset.sh_degree else "plain"\n    kind = MODELS[name]\n'
    "    gaussians = kind(dataset.sh_degree, opt.optimizer_type)\n",
    "a factory": "    gaussians = make_model(dataset, opt)\n",
    "branches": "    if dataset.sh_degree:\n        gaussians = Chosen(dataset.sh_degree, opt.optimizer_type)\n"
    f"    else:\n    {MADE}",
}


def choosing(folder: Path, statements: str) -> Path:
    """Return the script of a fork that makes its model by these statements."""
    script = edited_graphdeco(folder, "train.py", MADE, statements)
    text = script.read_text(encoding="utf-8")
    imports = "from scene import Scene\nfrom scene.gaussian_model import MODELS, Chosen, GaussianModel, make_model\n"
    script.write_text(text.replace("from scene import GaussianModel, Scene\n", imports), encoding="utf-8")
    with (script.parent / "scene" / "gaussian_model.py").open("a", encoding="utf-8") as file:
        file.write(MODELS)
    return script


@pytest.fixture(scope="module")
def plain(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> RunArchive:
    """Train the checkout that names its class."""
    return run_residuals(STUBS["graphdeco"], scene, tmp_path_factory.mktemp("plain") / "run", *SHORT)[0]


@pytest.mark.parametrize("choice", CHOICES)
def test_a_model_that_the_script_chooses_trains_to_the_same_field(
    choice: str, plain: RunArchive, scene: Path, tmp_path: Path
) -> None:
    """As of GaMeS, whose script has `gaussianModel[gs_type](dataset.sh_degree)`."""
    script = choosing(tmp_path / "c", CHOICES[choice])
    with (
        captured(tmp_path, []),
        loaded(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT, script=script) as adapter,
    ):
        drive(adapter, hierarchy="laplacian", dry_run=True)
        assert adapter.profile.model.__name__ == "Chosen"
    run = RunArchive.open(tmp_path / "run")
    for level in (1, 0):
        for name, value in plain.field(level).parameters.items():
            torch.testing.assert_close(run.field(level).parameters[name], value)  # worst seen: equal


def test_doctor_names_all_models_and_what_works_with_each(tmp_path: Path) -> None:
    script = choosing(tmp_path / "c", CHOICES["a dictionary"])
    findings = describe(script)
    (gaussians,) = (each.detail for each in findings["Checkout"] if each.name == "Gaussians")
    for part in ("GaussianModel", "Chosen", "Flat", "train.py:", "gaussians = kind(dataset.sh_degree"):
        assert part in gaussians
    laplacian = next(each for each in findings["lapgs run"] if each.name == "laplacian")
    assert laplacian.detail.startswith("GaussianModel: its rasterizer takes")
    assert "Flat: residuals need three scale axes; scene/gaussian_model.py:" in laplacian.detail


def test_a_model_that_cannot_be_made_outside_of_the_loop(scene: Path, tmp_path: Path) -> None:
    script = choosing(tmp_path / "c", "    kind = MODELS[scene.kind]\n    gaussians = kind(dataset.sh_degree)\n")
    with (
        captured(tmp_path, []),
        loaded(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT, script=script) as adapter,
        pytest.raises(UserInputError, match=r"train.py:\d+: gaussians cannot be made .*NameError.*scene") as caught,
    ):
        drive(adapter)
    assert "\n" not in str(caught.value)


SHAPES = "        self.exposure_mapping = {info"
SCALES = "        scales=pc.get_scaling,\n"


def shaped(folder: Path, scales: str) -> Path:
    """Return the script of a fork whose Gaussians have a shape, by which a renderer's scales are multiplied."""
    script = edited_graphdeco(folder, "gaussian_renderer/__init__.py", SCALES, scales)
    model = script.parent / "scene" / "gaussian_model.py"
    made = f"        self._shape = nn.Parameter(torch.ones(len(points), 1))\n{SHAPES}"
    text = model.read_text(encoding="utf-8").replace(SHAPES, made)
    shape = "\n    @property\n    def get_shape(self):\n        return self._shape\n"
    model.write_text(text + shape, encoding="utf-8")
    return script


@pytest.mark.parametrize(
    ("scales", "said"),
    [
        ("scales=pc.get_scaling * pc.get_shape,\n", "ok"),
        ("scales=pc.get_scaling if pipe.antialiasing else pc.get_scaling * pc.get_shape,\n", "absent"),
        ("scales=pc.get_scaling * (pc.get_shape if override_color is None else 1),\n", "absent"),
        ("scales=pc.get_scaling * (pc.get_shape if len(pc._xyz) else 1),\n", "perhaps"),
        ("scales=pc.get_scaling * getattr(pc, '_sh' + 'ape'),\n", "nothing"),
    ],
    ids=["always", "an option", "an argument", "undecided", "hidden"],
)
def test_values_of_each_gaussian_that_fields_lack(scales: str, said: str, scene: Path, tmp_path: Path) -> None:
    """As GES' shapes, which it renders with where covariances are not computed in Python: so by default."""
    script = shaped(tmp_path / "c", f"        {scales}")
    laplacian = next(each for each in describe(script)["lapgs run"] if each.name == "laplacian")
    known = "are rendered with _shape, which create_from_pcd() makes and fields do not have"
    assert (known in laplacian.detail) == (said != "nothing")
    assert ("perhaps" in laplacian.detail) == (said == "perhaps")
    assert laplacian.status == ("ok" if said in ("perhaps", "nothing") else "absent")
    with (
        captured(tmp_path, []),
        loaded(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT, script=script) as adapter,
        pytest.raises(UserInputError, match=r"no residuals: .* rendered with _shape, .* --hierarchy nested") as caught,
    ):
        drive(adapter, dry_run=True, hierarchy="laplacian")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_parameters_that_are_computed_of_others_have_no_residuals(scene: Path, tmp_path: Path) -> None:
    """As positions on a mesh, which GaMeS computes of its vertices."""
    made = f"        self._xyz = nn.Parameter(points) * 1\n{SHAPES}"
    script = edited_graphdeco(tmp_path / "c", "scene/gaussian_model.py", SHAPES, made)
    with (
        captured(tmp_path, []),
        loaded(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT, script=script) as adapter,
        pytest.raises(UserInputError, match=r"the model computes _xyz of other values, .* --hierarchy nested"),
    ):
        drive(adapter, dry_run=True, hierarchy="laplacian")


SET_UP = "    gaussians.training_setup(opt)\n"
FEATURES = '        if training_args.lambda_dssim:\n            groups = [{"params": [self._features], "lr": 0.1}]\n'
FEATURES += '        else:\n            groups = [{"params": [self._xyz], "lr": 0.1}]\n'
FINISHED: dict[str, tuple[str, str, str, str]] = {
    "another model is set up": ("train.py", SET_UP, "    gaussians.train_features(opt)\n", "calls no training_setup"),
    "a finished run is read": (
        "train.py",
        "    scene = Scene(dataset, gaussians)\n",
        "    scene = Scene(dataset, gaussians, load_iteration=-1)\n",
        r"Scene\(dataset, gaussians, load_iteration=-1\) makes none of points",
    ),
    "features alone are stepped": (
        "scene/gaussian_model.py",
        "        self._forget_statistics()\n",
        FEATURES,
        r"its optimizer \(scene/gaussian_model.py:\d+\) steps _features alone",
    ),
}


def of_finished_models(folder: Path, case: str) -> Path:
    """Return the script of a fork that trains something else on a finished model."""
    file, old, new, _ = FINISHED[case]
    script = edited_graphdeco(folder, file, old, new)
    if "load_iteration" in new:
        scene = script.parent / "scene" / "__init__.py"
        text = scene.read_text(encoding="utf-8").replace("shuffle=True,", "shuffle=True, load_iteration=None,")
        scene.write_text(text, encoding="utf-8")
    if file != "train.py":  # its parameters are in groups that another module makes
        options = script.parent / "arguments" / "__init__.py"
        text = options.read_text(encoding="utf-8").replace(" = 0.01\n", " = 0.01\n        self.lambda_dssim = 0.2\n", 1)
        options.write_text(text, encoding="utf-8")
    return script


@pytest.mark.parametrize("case", FINISHED)
def test_a_script_that_trains_on_a_finished_model(case: str, tmp_path: Path) -> None:
    """As SegAnyGAussians' and LangSplat's features, and the trees of hierarchical 3DGS."""
    script = of_finished_models(tmp_path / "c", case)
    findings = {each.name: each for each in describe(script)["lapgs run"]}
    assert findings["nested"].status == findings["laplacian"].status == "absent"
    assert re.search(FINISHED[case][3], findings["nested"].detail)
    assert "without levels" in current_folder(script.parent, has_gpu=False).detail


def test_scripts_of_finished_models_are_no_examples(tmp_path: Path) -> None:
    """As `train_contrastive_feature.py` beside `train_scene.py`."""
    root = of_finished_models(tmp_path / "c", "another model is set up").parent
    (root / "train.py").rename(root / "train_features.py")
    shutil.copy(CHECKOUTS / "graphdeco" / "train.py", root / "train_scene.py")
    findings = {each.name: each for each in describe(root)["Checkout"]}
    assert findings["Training"].detail.startswith("train_scene.py:")
    assert "calls no training_setup" in findings["train_features.py"].detail
    assert "`lapgs run train_scene.py ...`" in current_folder(root, has_gpu=False).detail


@pytest.mark.parametrize("method", ["load_ply", "create_from_hier"])
def test_a_scene_that_reads_a_finished_model_is_one_line(method: str, scene: Path, tmp_path: Path) -> None:
    """Where the sources do not say it."""
    line = "        self.gaussians.create_from_pcd("
    script = edited_graphdeco(
        tmp_path / "c", "scene/__init__.py", line, f"        self.gaussians.{method}('x')\n        return\n{line}"
    )
    with (
        captured(tmp_path, []),
        loaded(STUBS["graphdeco"], scene, tmp_path / "run", *SHORT, script=script) as adapter,
        pytest.raises(UserInputError, match=rf"makes its model by {method}\(\), expected create_from_pcd\(\)") as e,
    ):
        drive(adapter)
    assert "\n" not in str(e.value)


OTHER_TRAINERS: dict[str, tuple[str, Any]] = {
    "nerfstudio.py": ("from nerfstudio.scripts.train import entrypoint\n", "`lapgs train DATA`"),
    "simple_trainer.py": ("from gsplat.rendering import rasterization\n", "`lapgs train SCENE` trains with gsplat"),
    "train.py": ("from gaussian_splatting.trainer import Trainer\n", "`lapgs help python`"),
}


@pytest.mark.parametrize("name", OTHER_TRAINERS)
def test_other_trainers_are_recognised(name: str, tmp_path: Path) -> None:
    text, advice = OTHER_TRAINERS[name]
    (tmp_path / name).write_text(f'{text}if __name__ == "__main__":\n    main()\n', encoding="utf-8")
    with pytest.raises(UserInputError, match="is not the training script of a 3DGS checkout") as caught:
        CheckoutSource.read(tmp_path / name)
    assert advice in str(caught.value)


@pytest.mark.parametrize(("package", "path"), [("nerfstudio", "ns-train"), ("nerfstudio", "."), ("gsplat", ".")])
def test_other_trainers_commands_and_folders(package: str, path: str, tmp_path: Path) -> None:
    (tmp_path / package).mkdir()
    (tmp_path / package / "__init__.py").touch()
    with pytest.raises(UserInputError, match=f"{package}.*`lapgs train [A-Z]+` trains"):
        describe(tmp_path / path)


@pytest.mark.parametrize("case", ["another trainer", "finished", "missing", "no file"])
def test_what_sources_refuse_is_refused_without_pytorch(case: str, tmp_path: Path) -> None:
    script = tmp_path / "train.py"
    if case == "finished":
        script = of_finished_models(tmp_path / "c", "another model is set up")
    elif case == "missing":
        script = edited_graphdeco(tmp_path / "c", "train.py", "import sys\n", "import sys\nimport not_installed\n")
    elif case == "another trainer":
        script.write_text("import gsplat\n", encoding="utf-8")
    code = "import atexit, runpy, sys\natexit.register(lambda: print('torch' in sys.modules))\n"
    code += "runpy.run_module('lapgs_plugin', run_name='__main__')"
    command = [sys.executable, "-c", code, "run", "--device", "cpu", str(script)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert done.stdout == "False\n"
    assert done.stderr.count("\n") == 1
