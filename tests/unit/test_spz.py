"""Read SPZ files with a reader of this test, Gaussian by Gaussian, by the format's description."""

from __future__ import annotations

import gzip
import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import zstandard
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lapgs_plugin.errors import FieldError, MissingExtraError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.spherical_harmonics import sh_basis, sh_to_color
from lapgs_plugin.fields.spz import save_spz
from lapgs_plugin.reference_raster import CpuRasterizer
from tests.refusals import refuses
from tests.training_scene import blob_field, ring_camera

HALF_TURN = Rotation.from_euler("x", 180, degrees=True)  # between y down, z ahead and y up, z back


def read_spz(path: Path, antialiased: bool = False) -> tuple[GaussianField, int]:
    """Return the field in the file's axes (y up, z back), and its fractional bits; check what it says of its training.

    Bit 0 of the flags is "antialiased" in Niantic's description.
    """
    data, sizes = stored(path.read_bytes())
    magic, version, count, degree, fractional_bits, flags, reserved = struct.unpack_from("<4sIIBBBB", data)
    assert (magic, flags) == (b"NGSP", int(antialiased))
    assert (version, reserved) == ((3, 0) if sizes is None else (4, len(sizes)))
    rest = (degree + 1) ** 2 - 1
    if sizes is not None:
        assert sizes == [count * size for size in (9, 1, 3, 3, 4, 3 * rest) if count * size]
    offset = 16

    def take(size: int) -> list[bytes]:
        nonlocal offset
        begin, offset = offset, offset + size * count
        return [data[begin + i * size : begin + (i + 1) * size] for i in range(count)]

    means = [
        [int.from_bytes(row[3 * i : 3 * i + 3], "little", signed=True) / 2**fractional_bits for i in range(3)]
        for row in take(9)
    ]
    opacities = [min(max(row[0] / 255, 1e-6), 1 - 1e-6) for row in take(1)]
    first = [[(byte / 255 - 0.5) / 0.15 for byte in row] for row in take(3)]
    scales = [[byte / 16 - 10 for byte in row] for row in take(3)]
    quaternions = [read_rotation(int.from_bytes(row, "little")) for row in take(4)]
    higher = [[(byte - 128) / 128 for byte in row] for row in take(3 * rest)]
    assert offset == len(data)
    sh = torch.cat([torch.tensor(first).view(count, 1, 3), torch.tensor(higher).view(count, rest, 3)], dim=1)
    field = GaussianField(
        means=torch.tensor(means).view(count, 3),
        quaternions=torch.tensor(quaternions).view(count, 4),
        log_scales=torch.tensor(scales).view(count, 3),
        opacity_logits=torch.logit(torch.tensor(opacities)),
        sh=sh,
    )
    return field, fractional_bits


def stored(content: bytes) -> tuple[bytes, list[int] | None]:
    """Return a file's first 16 bytes and its arrays without compression, and the sizes of version 4's arrays."""
    if content[:4] != b"NGSP":
        return gzip.decompress(content), None
    number, table = struct.unpack_from("<BI12x", content, 15)
    assert content[20:32] == bytes(12)
    offset, arrays = table + 16 * number, []
    for index in range(number):
        size, length = struct.unpack_from("<QQ", content, table + 16 * index)
        frame = content[offset : offset + size]
        arrays.append(zstandard.ZstdDecompressor().decompress(frame, max_output_size=length))
        assert len(arrays[-1]) == length
        offset += size
    assert offset == len(content)
    return content[:16] + b"".join(arrays), list(map(len, arrays))


def read_rotation(packed: int) -> list[float]:
    """Decode a quaternion wxyz from its three smallest components of ten bits, the last one lowest."""
    largest = packed >> 30
    xyzw = [0.0] * 4
    for component in reversed([i for i in range(4) if i != largest]):
        size = (packed & 511) / 511 * math.sqrt(0.5)
        xyzw[component] = -size if packed & 512 else size
        packed >>= 10
    xyzw[largest] = math.sqrt(max(0.0, 1 - sum(value * value for value in xyzw)))
    return [xyzw[3], *xyzw[:3]]


def in_our_axes(field: GaussianField) -> GaussianField:
    """Turn a field by 180 degrees about x, except SH, which the tests compare by colour."""
    w, x, y, z = field.quaternions.double().numpy().T
    turned = HALF_TURN * Rotation.from_quat(np.stack([x, y, z, w], axis=1)) * HALF_TURN.inv()
    x, y, z, w = turned.as_quat().T
    return replace(
        field,
        means=field.means * torch.tensor([1.0, -1.0, -1.0]),
        quaternions=torch.from_numpy(np.stack([w, x, y, z], axis=1)).float(),
    )


def fields(seed: int, degree: int, count: int, size: float) -> GaussianField:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator)

    return GaussianField(
        means=size * normal(count, 3),
        quaternions=normal(count, 4),
        log_scales=-3 + normal(count, 3),
        opacity_logits=2 * normal(count),
        sh=0.3 * normal(count, (degree + 1) ** 2, 3),
    )


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 2**31),
    degree=st.integers(0, 3),
    count=st.integers(0, 40),
    size=st.floats(1e-3, 1e5),
    version=st.sampled_from((3, 4)),
)
@example(seed=26913, degree=1, count=3, size=1.0, version=3)  # a coefficient of 1.003
def test_every_number_comes_back_within_its_rounding(
    tmp_path_factory: pytest.TempPathFactory, seed: int, degree: int, count: int, size: float, version: int
) -> None:
    field = fields(seed, degree, count, size)
    path = tmp_path_factory.mktemp("spz") / "field.spz"
    save_spz(field, path, "note", version)
    read, fractional_bits = read_spz(path)
    back = in_our_axes(read) if count else read
    assert len(back) == count
    if count == 0:
        return
    torch.testing.assert_close(back.means, field.means, atol=0.5001 * 2.0**-fractional_bits + 1e-7 * size, rtol=1e-6)
    torch.testing.assert_close(back.log_scales, field.log_scales.clamp(-10, 5.9375), atol=0.03126, rtol=0)
    opacities = torch.sigmoid(back.opacity_logits), torch.sigmoid(field.opacity_logits)
    torch.testing.assert_close(*opacities, atol=0.5001 / 255, rtol=0)
    torch.testing.assert_close(back.sh[:, 0], field.sh[:, 0].clamp(-3.333, 3.333), atol=0.0132, rtol=0)
    ours, theirs = (Rotation.from_quat(f.quaternions.double().numpy()[:, [1, 2, 3, 0]]) for f in (field, back))
    assert (ours.inv() * theirs).magnitude().max() < 0.006  # radians; 0.0042 seen: three roundings of 1/723
    directions = torch.nn.functional.normalize(field.means, dim=1)
    held = torch.cat([field.sh[:, :1].clamp(-3.333, 3.333), field.sh[:, 1:].clamp(-1, 1)], dim=1)
    seen = sh_to_color(held, directions, degree, signed=True)
    turned = directions * torch.tensor([1.0, -1.0, -1.0])
    written = sh_to_color(read.sh, turned, degree, signed=True)
    basis = sh_basis(directions, degree).abs()  # (n, k)
    # Half a step of each coefficient; the largest that the file holds, along axes of its own, is 127/128 or -1.
    steps = 1 / 255.9 + (held[:, 1:].abs() > 127 / 128).any(dim=2) / 128
    most = 0.0132 * basis[:, 0] + (basis[:, 1:] * steps).sum(dim=1)
    assert ((seen - written).abs() <= most[:, None] + 1e-5).all()


def test_the_picture_is_nearly_the_same(tmp_path: Path) -> None:
    field, camera = blob_field(), ring_camera(0.3, 160, 120)
    save_spz(field, tmp_path / "field.spz", "")
    back = in_our_axes(read_spz(tmp_path / "field.spz")[0])
    before, after = (CpuRasterizer()(shown, camera, background=torch.zeros(3)).image for shown in (field, back))
    assert -10 * math.log10(float((before - after).square().mean())) > 40.0  # 44.4 dB seen


def test_version_4_without_its_library_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lapgs_plugin.errors.find_spec", lambda _: None)
    facts = r"SPZ version 4 needs zstandard: pip install 'lapgs_plugin\[spz\]'"
    refuses(MissingExtraError, facts, save_spz, blob_field(count=2), tmp_path / "field.spz", "", 4)
    assert list(tmp_path.iterdir()) == []


def test_the_comment_stands_in_the_gzip_header(tmp_path: Path) -> None:
    save_spz(blob_field(count=2), tmp_path / "field.spz", "residual of level 0\0; not a scene, 5 \u03c3")
    data = (tmp_path / "field.spz").read_bytes()
    assert data[:4] == b"\x1f\x8b\x08\x10"  # RFC 1952: identification, deflate, only a comment
    assert data[10 : data.index(b"\0", 10)] == b"residual of level 0; not a scene, 5 ?"
    read_spz(tmp_path / "field.spz")


def test_what_cannot_be_held_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    field = blob_field(count=3)
    far = replace(field, means=torch.tensor([[1e7, 0, 0]] * 3))
    with pytest.raises(FieldError, match="1e\\+07 units from the origin, expected at most 8388607"):
        save_spz(far, tmp_path / "far.spz", "")
    with pytest.raises(FieldError, match="NaN or inf"):
        save_spz(replace(field, opacity_logits=torch.tensor([0.0, math.nan, 0.0])), tmp_path / "nan.spz", "")
    assert list(tmp_path.iterdir()) == []
