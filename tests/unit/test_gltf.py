"""Read glTF files with a reader of this test, by the text of glTF 2.0 and of KHR_gaussian_splatting."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from lapgs_plugin.errors import FieldError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.gltf import save_glb
from lapgs_plugin.fields.spherical_harmonics import sh_to_color
from lapgs_plugin.reference_raster import CpuRasterizer
from tests.refusals import refuses
from tests.training_scene import blob_field, ring_camera
from tests.unit.test_spz import fields, in_our_axes

PREFIX = "KHR_gaussian_splatting:"


def parts(path: Path) -> tuple[dict[str, Any], bytes]:
    """Return the JSON and the binary chunk of a GLB file."""
    data = path.read_bytes()
    magic, version, length, json_length, json_kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, json_kind) == (b"glTF", 2, len(data), b"JSON")
    end = 20 + json_length
    binary_length, binary_kind = struct.unpack_from("<I4s", data, end)
    assert binary_kind == b"BIN\0"
    assert end % 4 == binary_length % 4 == 0
    assert end + 8 + binary_length == len(data)
    return json.loads(data[20:end]), data[end + 8 :]


def attributes(path: Path) -> dict[str, NDArray[Any]]:
    """Return the attributes (n, c) of the only primitive by name."""
    document, binary = parts(path)
    assert document["asset"]["version"] == "2.0"
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert document["buffers"] == [{"byteLength": len(binary)}]
    (primitive,) = document["meshes"][document["nodes"][0]["mesh"]]["primitives"]
    assert primitive["mode"] == 0
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert (extension["kernel"], extension["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    arrays = {}
    for name, index in primitive["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        columns = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        assert view["byteOffset"] % 4 == 0
        content = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        arrays[name] = np.frombuffer(content, kind).reshape(accessor["count"], columns)
        if name == "POSITION":
            np.testing.assert_array_equal(accessor["min"], arrays[name].min(0))
            np.testing.assert_array_equal(accessor["max"], arrays[name].max(0))
    return arrays


def read_glb(path: Path) -> GaussianField:
    """Return the field in glTF's axes (y up, z back)."""
    arrays = {name: torch.from_numpy(values.copy()) for name, values in attributes(path).items()}
    degree = max(degree for degree in range(4) if f"{PREFIX}SH_DEGREE_{degree}_COEF_0" in arrays)
    names = [f"{PREFIX}SH_DEGREE_{one}_COEF_{order}" for one in range(degree + 1) for order in range(2 * one + 1)]
    return GaussianField(
        means=arrays["POSITION"],
        quaternions=arrays[f"{PREFIX}ROTATION"][:, [3, 0, 1, 2]],
        log_scales=arrays[f"{PREFIX}SCALE"].log(),
        opacity_logits=torch.logit(arrays[f"{PREFIX}OPACITY"][:, 0]),
        sh=torch.stack([arrays[name] for name in names], dim=1),
    )


@pytest.mark.parametrize("degree", range(4))
def test_every_quantity_comes_back(degree: int, tmp_path: Path) -> None:
    field = fields(3, degree, 30, 2.0)
    save_glb(field, tmp_path / "field.glb", "note")
    read = read_glb(tmp_path / "field.glb")
    back = in_our_axes(read)
    assert torch.equal(back.means, field.means)
    torch.testing.assert_close(back.log_scales, field.log_scales, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(back.opacity_logits, field.opacity_logits, atol=1e-4, rtol=1e-4)
    unit = torch.nn.functional.normalize(field.quaternions, dim=1)
    torch.testing.assert_close((back.quaternions * unit).sum(1).abs(), torch.ones(30), atol=1e-6, rtol=0)
    np.testing.assert_allclose(read.quaternions.norm(dim=1).numpy(), 1.0, rtol=1e-6)
    directions = torch.nn.functional.normalize(field.means, dim=1)
    turned = directions * torch.tensor([1.0, -1.0, -1.0])
    seen, written = (
        sh_to_color(field.sh, directions, degree, signed=True),
        sh_to_color(read.sh, turned, degree, signed=True),
    )
    torch.testing.assert_close(written, seen, atol=1e-5, rtol=1e-5)


def test_programs_without_the_extension_see_points_in_linear_colours(tmp_path: Path) -> None:
    field = blob_field(count=4)
    gray = replace(field, sh=torch.tensor([-9.0, 0.0, 9.0, 0.5]).view(4, 1, 1).expand(4, 1, 3))
    save_glb(gray, tmp_path / "field.glb", "")
    colors = attributes(tmp_path / "field.glb")["COLOR_0"]
    assert colors[:, 0].tolist() == [0, 55, 255, 94]  # of sRGB 0, 0.5, 1, 0.641
    assert (colors[:, 3] / 255).tolist() == pytest.approx(torch.sigmoid(field.opacity_logits).tolist(), abs=0.002)
    assert parts(tmp_path / "field.glb")[0]["accessors"][-1]["normalized"] is True


def test_the_picture_is_the_same(tmp_path: Path) -> None:
    field, camera = blob_field(), ring_camera(0.3, 160, 120)
    save_glb(field, tmp_path / "field.glb", "")
    back = in_our_axes(read_glb(tmp_path / "field.glb"))
    before, after = (CpuRasterizer()(shown, camera, background=torch.zeros(3)).image for shown in (field, back))
    assert float((before - after).abs().max()) < 5e-6  # 3.6e-7 seen


def test_enormous_scales_are_the_largest_numbers(tmp_path: Path) -> None:
    field = replace(blob_field(count=2), log_scales=torch.tensor([[0.0, 100.0, 88.0], [-200.0, 0.0, 1.0]]))
    save_glb(field, tmp_path / "field.glb", "")
    scales = attributes(tmp_path / "field.glb")[f"{PREFIX}SCALE"]
    expected = np.exp(field.log_scales.double().numpy()).clip(max=np.finfo(np.float32).max)
    np.testing.assert_allclose(np.sort(scales), np.sort(expected), rtol=1e-5, atol=1e-40)


def test_what_cannot_be_held_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    none = blob_field(count=3).kept(torch.zeros(3, dtype=torch.bool))
    refuses(FieldError, "no Gaussians, expected one at least", save_glb, none, tmp_path / "none.glb", "")
    wrong = replace(blob_field(count=2), opacity_logits=torch.tensor([0.0, math.nan]))
    refuses(FieldError, "NaN or inf", save_glb, wrong, tmp_path / "nan.glb", "")
    assert list(tmp_path.iterdir()) == []
