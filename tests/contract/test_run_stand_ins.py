"""Test the choice of the stand-in for a checkout's rasterizer with `--device cpu`."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from lapgs_plugin.adapters.registry import adapter_class
from lapgs_plugin.checkouts.source import CheckoutSource
from lapgs_plugin.checkouts.stand_in import fitting_stand_in
from lapgs_plugin.cli.doctor_checkout import describe
from lapgs_plugin.errors import MissingExtraError
from lapgs_plugin.family import FORKS, VARIANTS
from tests.contract.stub_runs import STUBS, stand_in_is_refused


@pytest.mark.parametrize(
    ("name", "arguments", "variant"),
    [
        ("fastgs", (), "fastgs"),
        ("taming", ("--optimizer_type", "sparse_adam"), "taming"),
        ("graphdeco", (), "graphdeco-aa"),
        ("graphdeco", ("--optimizer_type", "default"), "graphdeco-aa"),
        ("graphdeco", ("--optimizer_type", "sparse_adam"), "graphdeco-accel"),
        ("graphdeco", ("--optimizer_type=sparse_adam", "--antialiasing"), "graphdeco-accel"),
    ],
)
def test_the_stand_in_is_that_of_checkout_and_options(name: str, arguments: tuple[str, ...], variant: str) -> None:
    checkout = STUBS[name].script.parent
    assert adapter_class(checkout).stand_in_for(checkout, arguments) == variant


BLUR = "        debug=pipe.debug,\n"
"""Line of the stub's settings after which others are passed."""


def changed(folder: Path, *changes: tuple[str, str]) -> Path:
    """Return a fork of graphdeco's stub, from before antialiasing, whose renderer has other text."""
    checkout = Path(shutil.copytree(STUBS["graphdeco"].script.parent, folder / "fork"))
    renderer = checkout / "gaussian_renderer" / "__init__.py"
    text = renderer.read_text(encoding="utf-8")
    older = ("        antialiasing=pipe.antialiasing,\n", ""), ("radii, depth_image = ", "radii = ")
    for old, new in (*older, *changes):
        assert old in text
        text = text.replace(old, new)
    renderer.write_text(text, encoding="utf-8")
    return checkout


def test_a_checkout_from_before_antialiasing(tmp_path: Path) -> None:
    """The renderer lacks the setting, so its rasterizer does, too."""
    checkout = changed(tmp_path)
    assert adapter_class(checkout).stand_in_for(checkout, ()) == "graphdeco"


@pytest.mark.parametrize(
    ("settings", "name"),
    [("", "graphdeco"), ("        kernel_size=0.1,\n        subpixel_offset=None,\n", "mip_splatting")],
)
def test_a_fork_that_kept_a_file_is_recognised_by_what_it_renders_with(
    settings: str, name: str, tmp_path: Path
) -> None:
    """As a fork of Mip-Splatting that has its tools, and a rasterizer of its own."""
    checkout = changed(tmp_path, (BLUR, BLUR + settings))
    (checkout / "create_fused_ply.py").write_text("")
    assert adapter_class(checkout).info.name == name


def test_a_fork_that_kept_a_file_without_importing_it_is_not_its_source(tmp_path: Path) -> None:
    """As a fork of Taming-3DGS that scores Gaussians in another way: nothing of that file is there to be replaced."""
    checkout = changed(tmp_path)
    (checkout / "utils" / "taming_utils.py").write_text("")
    assert adapter_class(checkout).info.name == "graphdeco"
    with (checkout / "train.py").open("a", encoding="utf-8") as script:
        script.write("\nimport utils.taming_utils\n")
    assert adapter_class(checkout).info.name == "taming"


def test_a_fork_that_kept_filters_is_recognised_without_the_files_of_its_source(tmp_path: Path) -> None:
    """As a fork of Mip-Splatting that extracts meshes: its fields need the filters of its model applied."""
    checkout = changed(tmp_path, (BLUR, f"{BLUR}        kernel_size=0.1,\n"))
    assert adapter_class(checkout).info.name == "generic"
    filters = "pc.filter_3D, pc.get_scaling_with_3D_filter, pc.get_opacity_with_3D_filter"
    (checkout / "filters.py").write_text(f"def filtered(pc):\n    return {filters}\n")
    with (checkout / "gaussian_renderer" / "__init__.py").open("a", encoding="utf-8") as renderer:
        renderer.write("\nimport filters\n")
    assert adapter_class(checkout).info.name == "mip_splatting"


def test_a_rasterizer_that_returns_more_than_any_stand_in(tmp_path: Path) -> None:
    """Otherwise it is called as graphdeco's."""
    checkout = changed(tmp_path, ("rendered_image, radii = ", "rendered_image, radii, normals, alpha = "))
    stand_in_is_refused(checkout, r"the nearest, graphdeco, returns 2 outputs, not 4; it needs")


@pytest.mark.parametrize(
    ("outputs", "stand_in"),
    [
        ("rendered_image, radii, depth, alpha", "depth-and-alpha"),
        ("image, radii, rendered_depth, acc", "depth-and-alpha"),
        ("image, radii, alpha, depth", ""),
        ("image, depth, alpha, radii", ""),
        ("image, radii, inv_depth, alpha", ""),
        ("image, radii, depth", ""),
    ],
)
def test_outputs_are_told_apart_by_the_variables_that_they_are_unpacked_into(
    outputs: str, stand_in: str, tmp_path: Path
) -> None:
    """Several forks call graphdeco's module alike and get other outputs: as many say nothing of what they are."""
    checkout = changed(tmp_path, ("rendered_image, radii = ", f"{outputs} = "))
    if stand_in:
        assert fitting_stand_in(checkout, "graphdeco") == stand_in
    else:
        stand_in_is_refused(checkout, "the nearest, graphdeco, returns 2 outputs, not")


def test_a_setting_that_no_stand_in_takes(tmp_path: Path) -> None:
    checkout = changed(tmp_path, (BLUR, f"{BLUR}        glow=1.0,\n"))
    stand_in_is_refused(checkout, r"gaussian_renderer/__init__.py:\d+, .* takes no setting glow")


def test_a_rasterizer_that_is_part_of_the_checkout(tmp_path: Path) -> None:
    """As one that compiles itself when it is imported; stand-ins take the places of installed ones."""
    module = "submodules.raster.binding"
    checkout = changed(tmp_path, ("from diff_gaussian_rasterization import", f"from {module} import"))
    binding = checkout / "submodules" / "raster" / "binding.py"
    binding.parent.mkdir(parents=True)
    binding.write_text("from .setup import _C\n\nclass GaussianRasterizer:\n    pass\n")
    (use,) = CheckoutSource.read(checkout / "train.py").rasterizers
    assert (use.module, use.functions) == (module, ("render",))
    stand_in_is_refused(
        checkout, f"lapgs has no rasterizer in place of {module}, imported in gaussian_renderer/__init_"
    )
    (finding,) = describe(checkout)["Rasterizers"]
    assert (finding.name, finding.status) == (module, "ok")
    assert finding.detail.startswith("part of the checkout; ")


TRAIN = """\
from renderer import render

class GaussianModel:
    def get_xyz(self): ...
    def training_setup(self): ...

def training():
    render().backward()

if __name__ == "__main__":
    training()
"""
CALLS = {
    "speedy-splat": ("diff_gaussian_rasterization", "", "scores=None, "),
    "mip-splatting": ("diff_gaussian_rasterization", "kernel_size=0, subpixel_offset=0, ", ""),
    "absgs": ("diff_gaussian_rasterization_abs", "", ""),
    "confidence": ("diff_gaussian_rasterization", "confidence=0, ", ""),
    "depth-acc": ("diff_gaussian_rasterization_depth_acc", "", ""),
    "graphdeco": ("diff_gaussian_rasterization", "", ""),
    "graphdeco-aa": ("diff_gaussian_rasterization", "antialiasing=0, ", ""),
    None: ("diff_gaussian_rasterization", "glow=0, ", ""),
}


def renderer(module: str, settings: str = "", inputs: str = "") -> str:
    view = ", ".join(f"{name}=0" for name in VARIANTS["graphdeco"].settings)
    return (
        f"from {module} import GaussianRasterizationSettings, GaussianRasterizer\n"
        f"def render():\n    rasterizer = GaussianRasterizer(GaussianRasterizationSettings({settings}{view}))\n"
        f"    return rasterizer(means3D=0, means2D=0, opacities=0, {inputs}shs=0)\n"
    )


@pytest.mark.parametrize("variant", CALLS)
def test_the_stand_in_is_chosen_by_the_checkouts_calls(variant: str | None, tmp_path: Path) -> None:
    (tmp_path / "train.py").write_text(TRAIN)
    (tmp_path / "renderer.py").write_text(renderer(*CALLS[variant]))
    if variant is None:
        with pytest.raises(MissingExtraError, match="takes no setting glow"):
            fitting_stand_in(tmp_path)
    else:
        assert fitting_stand_in(tmp_path) == variant


def test_functions_that_are_imported_decide_and_optional_imports_do_not(tmp_path: Path) -> None:
    optional = "from diff_gaussian_rasterization import SparseGaussianAdam\n"
    imports = (
        "from diff_gaussian_rasterization import compute_relocation\n"
        f"try:\n    {optional}except ImportError:\n    pass\n"
        f"import contextlib\nwith contextlib.suppress(ImportError):\n    {optional}"
    )
    (tmp_path / "train.py").write_text(imports + TRAIN)
    (tmp_path / "renderer.py").write_text(renderer("diff_gaussian_rasterization"))
    assert fitting_stand_in(tmp_path, "graphdeco") == "3dgs-mcmc"
    assert {"3dgs-mcmc", "faster-gs"} <= set(FORKS)


@pytest.mark.parametrize(
    ("line", "unpacks"),
    [
        ("distances, neighbours = knn(points)", True),
        ("scales = torch.log(knn(points)[0])", True),
        ("scales = torch.log(knn(points))[0]", False),
        ("scales = knn(points)[..., None]", False),
        ("scales, rotations = torch.sqrt(knn(points)), 1", False),
    ],
)
def test_whether_a_function_has_to_return_several_results_is_read_from_its_calls(
    line: str, unpacks: bool, tmp_path: Path
) -> None:
    (tmp_path / "train.py").write_text(f"{TRAIN}\n\ndef create(points):\n    {line}\n")
    assert CheckoutSource.read(tmp_path / "train.py").unpacks("knn") == unpacks
