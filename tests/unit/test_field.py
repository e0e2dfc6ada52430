"""Compare GaussianField's PLY files with hand-written bytes and plyfile's raw reading."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from plyfile import PlyData, PlyElement

from lapgs_plugin.errors import FieldError
from lapgs_plugin.fields.gaussian_field import GaussianField, count_gaussians

REST_COUNT = {0: 0, 1: 9, 2: 24, 3: 45}


def random_field(n: int = 7, degree: int = 3, signed: bool = False) -> GaussianField:
    return GaussianField(
        means=torch.randn(n, 3),
        quaternions=3 * torch.randn(n, 4),
        log_scales=torch.randn(n, 3),
        opacity_logits=torch.randn(n),
        sh=torch.randn(n, (degree + 1) ** 2, 3),
        signed=signed,
    )


def assert_same_bits(one: GaussianField, other: GaussianField) -> None:
    assert one.signed == other.signed
    for name, tensor in one.parameters.items():
        np.testing.assert_array_equal(
            tensor.numpy().view(np.int32), other.parameters[name].numpy().view(np.int32), err_msg=name
        )


def standard_names(degree: int) -> list[str]:
    """Return the columns of 3DGS's file, independent of the implementation."""
    rest = [f"f_rest_{i}" for i in range(REST_COUNT[degree])]
    return [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *rest,
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]


def standard_table(field: GaussianField) -> np.ndarray:
    """Return the numbers of that file, (n, columns), with f_rest channel by channel."""
    n = len(field)
    return np.concatenate(
        [
            field.means.numpy(),
            np.zeros((n, 3), np.float32),
            field.sh[:, 0].numpy(),
            field.sh[:, 1:].permute(0, 2, 1).flatten(1).numpy(),
            field.opacity_logits[:, None].numpy(),
            field.log_scales.numpy(),
            field.quaternions.numpy(),
        ],
        axis=1,
    )


def write_variant(
    path: Path,
    names: list[str],
    table: np.ndarray,
    *,
    kind: str = "f4",
    byte_order: str = "<",
    text: bool = False,
    comments: tuple[str, ...] = (),
) -> None:
    rows = np.empty(len(table), dtype=[(name, kind) for name in names])
    for column, name in enumerate(names):
        rows[name] = table[:, column]
    PlyData([PlyElement.describe(rows, "vertex")], text=text, byte_order=byte_order, comments=comments).write(str(path))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 6])
@pytest.mark.parametrize("signed", [False, True])
def test_a_saved_field_is_3dgs_own_file_and_comes_back(tmp_path: Path, degree: int, n: int, signed: bool) -> None:
    field = random_field(n, degree, signed)
    field.save_ply(tmp_path / "field.ply")
    header = ["ply", "format binary_little_endian 1.0", *["comment lapgs_signed 1"] * signed, f"element vertex {n}"]
    header += [f"property float {name}" for name in standard_names(degree)] + ["end_header", ""]
    table = standard_table(field)
    expected = "\n".join(header).encode() + struct.pack(f"<{table.size}f", *table.ravel())
    assert (tmp_path / "field.ply").read_bytes() == expected
    assert_same_bits(field, GaussianField.load_ply(tmp_path / "field.ply"))
    assert count_gaussians(tmp_path / "field.ply") == n


@settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_round_trip_keeps_the_bits_of_any_finite_float32(tmp_path: Path, data: st.DataObject) -> None:
    n, degree = data.draw(st.integers(1, 4)), data.draw(st.integers(0, 3))
    numbers = st.floats(width=32, allow_nan=False, allow_infinity=False)  # with -0.0 and subnormals
    shapes = {"means": (n, 3), "quaternions": (n, 4), "log_scales": (n, 3), "opacity_logits": (n,)}
    shapes["sh"] = (n, (degree + 1) ** 2, 3)
    drawn = {
        name: torch.from_numpy(data.draw(arrays(np.float32, shape, elements=numbers))) for name, shape in shapes.items()
    }
    field = GaussianField(**drawn, signed=data.draw(st.booleans()))
    field.save_ply(tmp_path / "any.ply")
    assert_same_bits(field, GaussianField.load_ply(tmp_path / "any.ply"))


@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize("form", ["<", ">", "ascii"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_reads_every_encoding(tmp_path: Path, kind: str, form: str, degree: int) -> None:
    field = random_field(4, degree)
    text = form == "ascii"
    names, table, order = standard_names(degree), standard_table(field), "=" if text else form
    write_variant(tmp_path / "f.ply", names, table, kind=kind, byte_order=order, text=text)
    loaded = GaussianField.load_ply(tmp_path / "f.ply")
    assert loaded.sh_degree == degree
    for name, tensor in field.parameters.items():
        # ascii prints what numpy needs to read the same float back; the others are exact
        torch.testing.assert_close(loaded.parameters[name], tensor, rtol=1e-6 if text else 0, atol=0, msg=name)


def test_reads_extra_properties_in_any_order_without_normals(tmp_path: Path) -> None:
    field = random_field(4, 2)
    names, table = standard_names(2), standard_table(field)
    extra = [*names, "red", "segment", "filter_3D"]
    table = np.concatenate([table, np.random.default_rng(0).random((4, 3))], axis=1)
    order = [i for i in np.random.default_rng(1).permutation(len(extra)) if extra[i] not in ("nx", "ny", "nz")]
    write_variant(tmp_path / "f.ply", [extra[i] for i in order], table[:, order])
    assert_same_bits(field, GaussianField.load_ply(tmp_path / "f.ply"))


def test_reads_a_vertex_element_beside_others(tmp_path: Path) -> None:
    field = random_field(3, 1)
    names, table = standard_names(1), standard_table(field)
    rows = np.empty(3, dtype=[(name, "f4") for name in names])
    for column, name in enumerate(names):
        rows[name] = table[:, column]
    faces = np.array([([0, 1, 2],)], dtype=[("vertex_indices", "i4", (3,))])
    elements = [PlyElement.describe(faces, "face"), PlyElement.describe(rows, "vertex")]
    PlyData(elements).write(str(tmp_path / "f.ply"))
    assert_same_bits(field, GaussianField.load_ply(tmp_path / "f.ply"))


def test_only_our_comment_makes_a_field_signed(tmp_path: Path) -> None:
    names, table = standard_names(0), standard_table(random_field(2, 0))
    for comments, signed in [(("by a trainer",), False), (("lapgs_signed 0",), False), (("a", "lapgs_signed 1"), True)]:
        write_variant(tmp_path / "f.ply", names, table, comments=comments)
        assert GaussianField.load_ply(tmp_path / "f.ply").signed is signed


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.integers(0, 10_000), form=st.sampled_from(["<", ">", "ascii"]))
def test_a_file_cut_short_anywhere_is_an_error(tmp_path: Path, cut: int, form: str) -> None:
    whole = tmp_path / f"{form == 'ascii'}{form == '<'}.ply"
    if not whole.exists():
        text = form == "ascii"
        table = standard_table(random_field(9, 1))
        write_variant(whole, standard_names(1), table, byte_order="=" if text else form, text=text)
    contents = whole.read_bytes()
    # Of an ascii file the last line break may be missing, and digits of its last number cannot be missed.
    end = contents.rstrip().rfind(b" ") if form == "ascii" else len(contents) - 1
    (tmp_path / "cut.ply").write_bytes(contents[: cut % (end + 1)])
    for read in (GaussianField.load_ply, count_gaussians):
        with pytest.raises(FieldError, match=r"cut\.ply"):
            read(tmp_path / "cut.ply")


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(position=st.integers(0, 3000), value=st.integers(0, 255))
def test_a_damaged_header_is_an_error_or_another_field_never_a_crash(tmp_path: Path, position: int, value: int) -> None:
    if not (tmp_path / "whole.ply").exists():
        random_field(3, 1).save_ply(tmp_path / "whole.ply")
    contents = bytearray((tmp_path / "whole.ply").read_bytes())
    contents[position % contents.index(b"end_header")] = value
    (tmp_path / "damaged.ply").write_bytes(contents)
    with contextlib.suppress(FieldError):
        GaussianField.load_ply(tmp_path / "damaged.ply").require_finite()


@pytest.mark.parametrize(
    ("drop", "message"),
    [
        (["opacity"], "lack opacity;"),
        (["scale_2"], "lack scale_2;"),
        (["rot_0", "rot_3"], "lack rot_0, rot_3;"),
        (["f_dc_1"], "lack f_dc_1;"),
        (["f_rest_44"], "44 f_rest_"),
        ([f"f_rest_{i}" for i in range(36)], "lack f_rest_0, "),
    ],
)
def test_missing_properties_are_named(tmp_path: Path, drop: list[str], message: str) -> None:
    names, table = standard_names(3), standard_table(random_field(3, 3))
    keep = [i for i, name in enumerate(names) if name not in drop]
    write_variant(tmp_path / "f.ply", [names[i] for i in keep], table[:, keep])
    with pytest.raises(FieldError, match=message):
        GaussianField.load_ply(tmp_path / "f.ply")


def test_files_that_hold_no_field(tmp_path: Path) -> None:
    write_variant(tmp_path / "points.ply", ["x", "y", "z", "red", "green", "blue"], np.zeros((2, 6)))
    (tmp_path / "folder.ply").mkdir()
    for name, words in (("points.ply", "not a point cloud"), ("folder.ply", ""), ("missing.ply", "")):
        with pytest.raises(FieldError, match=f"{name}.*{words}"):
            GaussianField.load_ply(tmp_path / name)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])  # the last one is beyond float32
@pytest.mark.parametrize("name", ["y", "f_dc_2", "f_rest_16", "opacity", "scale_1", "rot_3"])
def test_numbers_that_are_not_finite_are_located(tmp_path: Path, name: str, bad: float) -> None:
    names, table = standard_names(3), standard_table(random_field(6, 3)).astype(np.float64)
    table[[2, 5], names.index(name)] = bad
    write_variant(tmp_path / "f.ply", names, table, kind="f8" if bad == 1e300 else "f4")
    with pytest.raises(FieldError, match=f"{name} is NaN or inf for 2 of 6 Gaussians, first at index 2"):
        GaussianField.load_ply(tmp_path / "f.ply")


def test_saving_does_not_touch_gradients_or_precision(tmp_path: Path) -> None:
    field = random_field(3, 1).to(dtype=torch.float64)
    field = field.with_parameters({name: tensor.requires_grad_() for name, tensor in field.parameters.items()})
    field.save_ply(tmp_path / "f.ply")
    assert_same_bits(field.detach().to(dtype=torch.float32), GaussianField.load_ply(tmp_path / "f.ply"))
    assert field.means.requires_grad


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as caught:
        random_field().save_ply(tmp_path / "missing/field.ply")
    assert caught.value.filename == str(tmp_path / "missing")


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    field = random_field(3, 0)
    field.save_ply(tmp_path / "f.ply")

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        random_field(3, 0).save_ply(tmp_path / "f.ply")
    assert [path.name for path in tmp_path.iterdir()] == ["f.ply"]
    assert_same_bits(field, GaussianField.load_ply(tmp_path / "f.ply"))


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("means", (5, 2)),
        ("means", ()),
        ("quaternions", (4, 4)),
        ("opacity_logits", (5, 1)),
        ("sh", (5, 5, 3)),
        ("sh", (5, 3)),
    ],
)
def test_wrong_shapes_are_refused(name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(FieldError, match=re.escape(f"{name} has shape {shape}, expected (")):
        random_field(5, 1).with_parameters({name: torch.zeros(shape)})


def test_a_comment_of_several_lines_is_one(tmp_path: Path) -> None:
    field = GaussianField(*(torch.zeros(2, *shape) for shape in ((3,), (4,), (3,), (), (1, 3))))
    field.save_ply(tmp_path / "f.ply", ["of the run a\nlapgs_signed 1", "caf\u00e9"])
    assert PlyData.read(str(tmp_path / "f.ply")).comments == ["of the run a lapgs_signed 1", "caf?"]
    assert not GaussianField.load_ply(tmp_path / "f.ply").signed
