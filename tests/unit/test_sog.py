"""Read SOG folders with a reader of this test, Gaussian by Gaussian, by the format's description."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from lapgs_plugin.errors import FieldError
from lapgs_plugin.fields import sog
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.quantization import palette
from lapgs_plugin.fields.sog import save_sog, save_streamed_sog
from lapgs_plugin.reference_raster import CpuRasterizer
from tests.refusals import refuses
from tests.training_scene import blob_field, ring_camera
from tests.unit.test_spz import fields


def pixels(path: Path) -> NDArray[np.uint8]:
    """Return the pixels of an image in rows, (h * w, 4)."""
    with Image.open(path) as image:
        assert image.format == "WEBP"
        return np.asarray(image.convert("RGBA")).reshape(-1, 4)


def read_sog(folder: Path) -> GaussianField:
    """Return the field of a folder, in the axes of PLY files."""
    meta = json.loads((folder / "meta.json").read_text())
    assert meta["version"] == 2
    count = meta["count"]

    def image(key: str, index: int = 0) -> NDArray[np.uint8]:
        return pixels(folder / meta[key]["files"][index])[:count]

    low, high = (np.array(meta["means"][name]) for name in ("mins", "maxs"))
    fixed = image("means")[:, :3] + 256 * image("means", 1)[:, :3].astype(int)
    folded = low + (high - low) * fixed / 65535
    means = np.sign(folded) * np.expm1(np.abs(folded))
    color = image("sh0")
    sh = np.array(meta["sh0"]["codebook"])[color[:, :3]][:, None]
    if "shN" in meta:
        k = {1: 3, 2: 8, 3: 15}[meta["shN"]["bands"]]
        with Image.open(folder / meta["shN"]["files"][0]) as palette_image:
            assert palette_image.width == 64 * k
        palette = pixels(folder / meta["shN"]["files"][0]).reshape(-1, k, 4)[: meta["shN"]["count"], :, :3]
        labels = image("shN", 1)[:, 0] + 256 * image("shN", 1)[:, 1].astype(int)
        sh = np.concatenate([sh, np.array(meta["shN"]["codebook"])[palette[labels]]], axis=1)
    return GaussianField(
        means=torch.from_numpy(means).float(),
        quaternions=torch.tensor([read_rotation(*map(int, row)) for row in image("quats")]),
        log_scales=torch.from_numpy(np.array(meta["scales"]["codebook"])[image("scales")[:, :3]]).float(),
        opacity_logits=torch.logit(torch.from_numpy(color[:, 3] / 255.0), eps=1e-6).float(),
        sh=torch.from_numpy(sh).float(),
    )


def read_rotation(a: int, b: int, c: int, tag: int) -> list[float]:
    """Decode a quaternion wxyz from its three smaller components and 252 + the index of the largest."""
    small = [(value / 255 * 2 - 1) / math.sqrt(2) for value in (a, b, c)]
    small.insert(tag - 252, math.sqrt(max(0.0, 1 - sum(value * value for value in small))))
    return small


@pytest.mark.parametrize("degree", range(4))
def test_every_quantity_comes_back_within_its_rounding(degree: int, tmp_path: Path) -> None:
    field = fields(1, degree, 3000, 5.0)
    save_sog(field, tmp_path)
    back = read_sog(tmp_path)
    assert len(back) == 3000
    span = 2 * float(field.means.abs().max().log1p())
    step = span / 65535 * (1 + field.means.abs())
    assert ((back.means - field.means).abs() <= 0.5001 * step + 1e-5).all()
    ours, theirs = (Rotation.from_quat(f.quaternions.double().numpy()[:, [1, 2, 3, 0]]) for f in (field, back))
    assert (ours.inv() * theirs).magnitude().max() < 0.017  # radians; 0.0128 seen: three roundings of 1/180
    torch.testing.assert_close(
        torch.sigmoid(back.opacity_logits), torch.sigmoid(field.opacity_logits), atol=0.5001 / 255, rtol=0
    )
    for read, own in ((back.log_scales, field.log_scales), (back.sh[:, 0], field.sh[:, 0])):
        assert float((read - own).square().mean().sqrt()) < 0.01 * float(own.std())  # 0.0075 seen
    if degree:
        error = (back.sh[:, 1:] - field.sh[:, 1:]).square().mean().sqrt()
        assert float(error) < 0.7 * float(field.sh[:, 1:].std())  # 0.58 seen: noise, which no palette holds


def test_coefficients_that_gaussians_share_are_kept(tmp_path: Path) -> None:
    field = fields(2, 3, 2000, 1.0)
    shared = field.sh[:40, 1:].repeat(50, 1, 1)
    save_sog(replace(field, sh=torch.cat([field.sh[:, :1], shared], dim=1)), tmp_path)
    error = (read_sog(tmp_path).sh[:, 1:] - shared).abs()
    assert float(error.max()) < 0.03  # 0.0215 seen: the codebook's largest step
    assert float(error.mean()) < 0.005


@pytest.mark.parametrize("most", [16, 256, 1024])
def test_a_palette_has_no_more_sets_than_labels_can_name(most: int) -> None:
    """Coefficients of all magnitudes, of which many groups have few members."""
    generator = torch.Generator().manual_seed(1)
    above, below = torch.randn(2, 50_000, 1, 1, generator=generator).abs()
    sets, labels = palette(torch.randn(50_000, 3, 3, generator=generator) * above / below.clamp(min=1e-9), most)
    assert most // 2 < len(sets) <= most
    assert 0 <= labels.min() <= labels.max() < len(sets)


def test_one_gaussian_and_equal_gaussians(tmp_path: Path) -> None:
    one = fields(4, 3, 1, 1.0)
    for name, field in (("one", one), ("equal", one.kept(torch.zeros(500, dtype=torch.long)))):
        save_sog(field, tmp_path / name)
        back = read_sog(tmp_path / name)
        torch.testing.assert_close(back.means, field.means, atol=1e-6, rtol=1e-6)
        torch.testing.assert_close(back.sh, field.sh, atol=1e-6, rtol=1e-6)
        torch.testing.assert_close(back.log_scales, field.log_scales, atol=1e-6, rtol=1e-6)


def test_the_picture_is_nearly_the_same(tmp_path: Path) -> None:
    field, camera = blob_field(), ring_camera(0.3, 160, 120)
    save_sog(field, tmp_path)
    before, after = (CpuRasterizer()(f, camera, background=torch.zeros(3)).image for f in (field, read_sog(tmp_path)))
    assert -10 * math.log10(float((before - after).square().mean())) > 50.0  # 60.3 dB seen


def leaves(node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for child in node.get("children", ()):
        yield from leaves(child)
        for which in ("min", "max"):
            outer, inner = np.array(node["bound"][which]), np.array(child["bound"][which])
            assert (outer <= inner).all() if which == "min" else (outer >= inner).all()
    if "lods" in node:
        yield node


def read_levels(folder: Path) -> tuple[dict[str, Any], list[list[GaussianField]]]:
    """Return lod-meta.json, and each level's leaves as fields; checks that they fill the files."""
    meta = json.loads((folder / "lod-meta.json").read_text())
    files = [read_sog((folder / name).parent) for name in meta["filenames"]]
    covered = [np.zeros(len(one), int) for one in files]
    levels: list[list[GaussianField]] = [[] for _ in range(meta["lodLevels"])]
    for leaf in leaves(meta["tree"]):
        for level, part in leaf["lods"].items():
            rows = torch.arange(part["offset"], part["offset"] + part["count"])
            covered[part["file"]][rows.numpy()] += 1
            levels[int(level)].append(files[part["file"]].kept(rows))
            inside = levels[int(level)][-1].means.numpy()
            assert (inside >= np.array(leaf["bound"]["min"]) - 1e-3).all()
            assert (inside <= np.array(leaf["bound"]["max"]) + 1e-3).all()
    assert all((one == 1).all() for one in covered)
    return meta, levels


def test_a_tree_has_every_gaussian_of_every_level_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sog, "LEAF", 300)
    monkeypatch.setattr(sog, "FILE", 700)
    fine, coarse = fields(5, 1, 2000, 2.0), fields(6, 1, 500, 2.0)
    save_streamed_sog({3: coarse, 1: fine}, tmp_path)
    meta, levels = read_levels(tmp_path)
    assert (meta["version"], meta["count"], meta["counts"], meta["lodLevels"]) == (1, 2500, [2000, 500], 2)
    assert len(levels[0]) >= 2500 / 300
    assert len({name[0] for name in meta["filenames"]}) == 2
    assert len(meta["filenames"]) > 2, "the finest level needs several files"
    for own, parts in ((fine, levels[0]), (coarse, levels[1])):
        read = torch.cat([part.means for part in parts]).numpy()
        order, expected = np.lexsort(read.round(1).T), np.lexsort(own.means.numpy().round(1).T)
        assert len(order) == len(expected)
        np.testing.assert_allclose(np.sort(read, axis=0), np.sort(own.means.numpy(), axis=0), atol=2e-3)


def test_leaves_are_small_boxes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sog, "LEAF", 300)
    save_streamed_sog({0: fields(5, 0, 2000, 2.0), 1: fields(6, 0, 500, 2.0)}, tmp_path)
    _, levels = read_levels(tmp_path)
    whole = torch.cat([part.means for part in levels[0]])
    volumes = [float(np.prod(np.ptp(part.means.numpy(), axis=0))) for part in levels[0]]
    assert sum(volumes) < 0.7 * float(np.prod(np.ptp(whole.numpy(), axis=0)))  # 0.58 seen


def test_bounds_of_a_gaussian_that_diverged_are_numbers_of_json(tmp_path: Path) -> None:
    field = blob_field(20)
    field.log_scales[3] = 50.0
    save_streamed_sog({0: field}, tmp_path)
    meta = json.loads((tmp_path / "lod-meta.json").read_text(), parse_constant=pytest.fail)
    for low, high, mean in zip(*meta["tree"]["bound"].values(), field.means[3].tolist(), strict=True):
        assert (low, high) == pytest.approx((mean - math.exp(50), mean + math.exp(50)), rel=1e-6)


def test_an_earlier_export_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_streamed_sog({0: fields(5, 0, 200, 2.0), 1: fields(6, 0, 50, 2.0)}, tmp_path)
    monkeypatch.setattr(sog, "save_sog", lambda *_, **__: pytest.fail("stopped"))
    with pytest.raises(pytest.fail.Exception):
        save_streamed_sog({0: fields(5, 0, 100, 2.0), 1: fields(6, 0, 50, 2.0)}, tmp_path)
    assert not (tmp_path / "lod-meta.json").exists(), "it would name files that are half written"


def test_what_is_not_finite_is_refused(tmp_path: Path) -> None:
    wrong = replace(blob_field(count=2), opacity_logits=torch.tensor([0.0, math.nan]))
    refuses(FieldError, "NaN or inf", save_sog, wrong, tmp_path / "a")
    refuses(FieldError, "NaN or inf", save_streamed_sog, {0: wrong, 1: wrong}, tmp_path / "b")
    assert list(tmp_path.iterdir()) == []
