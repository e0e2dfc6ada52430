"""Depth under `lapgs run`: by the checkouts' rasterizers, in both hierarchies, beside each script's own loss."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from lapgs_plugin.errors import SceneError, UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import render_inverse_depths
from lapgs_plugin.reference_raster import CpuRasterizer, OracleRasterizer
from lapgs_plugin.runner import depth as depth_of_run
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.scenes import load_scene
from tests.contract.stub_runs import FORKS, STUBS, WHITE, captured, drive, edited_graphdeco, loaded, run_hierarchy
from tests.refusals import refuses
from tests.unit.test_depth import true_depth, write_maps

ALL = {**STUBS, **FORKS}
SHORT = ("--iterations", 18)


@pytest.fixture
def deep(scene: Path, tmp_path: Path) -> Path:
    """The scene with the true depth of its photos in millimetres."""
    shutil.copytree(scene, tmp_path / "deep")
    write_maps(tmp_path / "deep" / "depth", load_scene(scene, progress=False))
    return tmp_path / "deep"


def by_the_oracle(inputs: Mapping[str, Any], settings: Any, mult: float | None) -> tuple[Tensor, Tensor]:
    """Blended inverse depths and opacity of a rasterizer's inputs, by the oracle in double precision."""
    values = {name: inputs[name].detach().double() for name in ("means3D", "scales", "rotations", "opacities")}
    field = GaussianField(
        means=values["means3D"],
        quaternions=values["rotations"],
        log_scales=values["scales"].log(),
        opacity_logits=values["opacities"][:, 0].logit(),
        sh=values["means3D"].new_zeros(len(values["means3D"]), 1, 3),
    )
    width, height = settings.image_width, settings.image_height
    focal = width / (2 * settings.tanfovx), height / (2 * settings.tanfovy)
    camera = Camera(width, height, *focal, width / 2, height / 2, settings.viewmatrix.T.double())
    return render_inverse_depths(OracleRasterizer(mult=mult), field, camera)


@pytest.mark.parametrize(
    ("name", "hierarchy", "more"),
    [
        ("graphdeco", "nested", ()),
        ("graphdeco", "laplacian", WHITE),
        ("fastgs", "laplacian", ()),
        ("taming", "nested", WHITE),
        ("speedy", "nested", ()),
        ("mini", "nested", ()),
    ],
)
def test_depths_are_those_of_the_oracle_in_every_second_iteration(
    name: str,
    hierarchy: str,
    more: tuple[Any, ...],
    deep: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    render, errors = depth_of_run.blended_inverse_depths, list[float]()

    def compared(rasterizer: Callable[..., Any], inputs: Mapping[str, Any], settings: Any) -> tuple[Tensor, Tensor]:
        own = render(rasterizer, inputs, settings)
        if torch.is_grad_enabled():
            with torch.no_grad():
                exact = by_the_oracle(inputs, settings, getattr(settings, "mult", None))
                errors.append(max(float((a - b).abs().max()) for a, b in zip(own, exact, strict=True)))
        return own

    monkeypatch.setattr(depth_of_run, "blended_inverse_depths", compared)
    run_hierarchy(ALL[name], deep, tmp_path / "run", *SHORT, *more, hierarchy=hierarchy, depth="auto")
    assert len(errors) == (9 if hierarchy == "nested" else 3)  # of 18 iterations, or of the base's 6
    assert max(errors) < 1e-5  # worst seen 6.7e-7


def depth_error(archive: RunArchive, level: int, scene: Path) -> float:
    """Mean difference of a level's inverse depth from the true one in the training views, over its median."""
    errors = []
    for view in load_scene(scene, eval=True, progress=False).train:
        blended, opacity = render_inverse_depths(CpuRasterizer(), archive.field(level), view.camera)
        true = 1 / torch.from_numpy(true_depth(view.camera))
        errors.append(float((blended / opacity.clamp_min(0.01) - true).abs().mean() / true.median()))
    return float(np.mean(errors))


@pytest.mark.parametrize(("hierarchy", "level", "gain"), [("nested", 0, 0.8), ("laplacian", 1, 0.93)])
def test_depth_alone_moves_the_field_to_the_maps(
    hierarchy: str, level: int, gain: float, deep: Path, tmp_path: Path
) -> None:
    script = edited_graphdeco(tmp_path / "c", "train.py", "loss.backward()", "(0.0 * loss).backward()")
    errors = []
    for depth in ("none", "auto"):
        more = "--densify_from_iter", 1000
        with (
            captured(tmp_path, []),
            loaded(STUBS["graphdeco"], deep, tmp_path / depth, *more, script=script) as adapter,
        ):
            drive(adapter, hierarchy=hierarchy, depth=depth)
        errors.append(depth_error(RunArchive.open(tmp_path / depth), level, deep))
    assert errors[1] < gain * errors[0]  # worst seen 0.68 of it; 0.87 in the 30 iterations of the base


@pytest.mark.parametrize("hierarchy", ["nested", "laplacian"])
def test_points_masks_and_views_without_maps(hierarchy: str, deep: Path, tmp_path: Path) -> None:
    fields = {}
    for name in sorted((deep / "depth").iterdir())[1:4]:
        name.unlink()
    for depth in ("none", "points", "depth", str(deep / "depth")):
        out = tmp_path / Path(depth).name.replace("depth", "maps" if depth == "depth" else "maps_by_path")
        archive, _ = run_hierarchy(STUBS["graphdeco"], deep, out, *SHORT, hierarchy=hierarchy, depth=depth)
        assert archive.manifest.settings["depth"] == depth
        fields[depth] = archive.field(1 if hierarchy == "laplacian" else 0).means
    assert torch.equal(fields["depth"], fields[str(deep / "depth")])
    assert not torch.equal(fields["depth"], fields["none"])
    assert not torch.equal(fields["points"], fields["none"])
    assert not torch.equal(fields["points"], fields["depth"])
    # What a mask hides of a map changes nothing.
    (deep / "masks").mkdir()
    mask = np.full((48, 64), 255, np.uint8)
    mask[:, :30] = 0
    means = []
    for file in (deep / "images").iterdir():
        cv2.imwrite(str(deep / "masks" / file.name), mask)
    for hidden in (0, 5000):
        for file in (deep / "depth").iterdir():
            values = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            assert values is not None
            values[mask == 0] = hidden
            cv2.imwrite(str(file), values)
        out = tmp_path / f"hidden_{hidden}"
        archive, _ = run_hierarchy(STUBS["graphdeco"], deep, out, *SHORT, hierarchy=hierarchy, depth="auto")
        means.append(archive.field(0).means)
    assert torch.equal(*means)


def test_a_rasterizer_without_colours_is_refused_before_anything_is_written(deep: Path, tmp_path: Path) -> None:
    """One that renders the same whatever colours it gets, and one that takes none."""
    for text, facts in (
        (
            "inputs['colors_precomp'] = torch.full_like(inputs['colors_precomp'], 9.0)",
            "are not the Gaussians' depths",
        ),
        ("raise TypeError('no colours')", "no colours"),
    ):
        folder = tmp_path / str(len(text))
        script = edited_graphdeco(
            folder, "gaussian_renderer/__init__.py", "    rendered_image, radii, depth_",
            "    own = rasterizer._original.forward\n"
            "    def forward(**inputs):\n"
            "        if inputs.get('colors_precomp') is not None:\n"
            f"            {text}\n"
            "        return own(**inputs)\n"
            "    rasterizer._original.forward = forward\n"
            "    rendered_image, radii, depth_",
        )  # fmt: skip
        run = folder / "run"
        with captured(folder, []), loaded(STUBS["graphdeco"], deep, run, *SHORT, script=script) as adapter:
            line = refuses(UserInputError, facts, drive, adapter, depth="auto")
        assert line.startswith("--depth auto: the checkout's rasterizer renders no depths")
        assert not run.exists()


def test_a_script_with_depth_of_its_own_is_told(deep: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    params = {file.stem: {"scale": 1.0, "offset": 0.0} for file in (deep / "images").iterdir()}
    (deep / "sparse" / "0" / "depth_params.json").write_text(json.dumps(params))
    with caplog.at_level(logging.INFO):
        run_hierarchy(STUBS["graphdeco"], deep, tmp_path / "run", *SHORT, "--depths", "depth", depth="points")
    lines = [message for message in caplog.messages if "depth" in message]
    assert "--depth points and the script's --depths depth both supervise depth; leave one out" in lines
    assert any(line.startswith("depth (points): 10 of 10 training photos see points") for line in lines)


def test_what_does_not_go_together(deep: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    refuses(UserInputError, "--depth points with --protocol paper", RunSettings, protocol="paper", depth="points")
    refuses(UserInputError, "--depth maps: no such folder", run_hierarchy, STUBS["graphdeco"], deep, run, depth="maps")
    shutil.rmtree(deep / "depth")
    (deep / "depth").mkdir()
    refuses(SceneError, "no depth map of any of the 10", run_hierarchy, STUBS["graphdeco"], deep, run, depth="auto")
    assert not run.exists()
