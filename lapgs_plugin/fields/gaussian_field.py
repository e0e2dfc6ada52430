"""Hold a set of Gaussians with the parameters that 3DGS optimizes; read and write it as PLY."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement
from torch import Tensor

from lapgs_plugin.errors import FieldError
from lapgs_plugin.fields.ply import read_ply, scalar_names
from lapgs_plugin.files import atomic_write

SIGNED_COMMENT = "lapgs_signed 1"
"""PLY comment that marks a residual field. Other viewers ignore it and show an ordinary field."""

ROWS = 1 << 14
"""Gaussians that are brought into the order of a PLY at once: 4 MB, which a processor's cache holds."""

SH_REST_COUNTS = (0, 9, 24, 45)
"""Number of f_rest_* properties of a PLY of SH degree 0 to 3: (degree + 1)^2 - 1 for each of three channels."""

SPLAT_NAMES = {"means": "means", "quats": "quaternions", "scales": "log_scales", "opacities": "opacity_logits"}
"""Attributes of a field, except SH, by the names of gsplat's trainers and strategies."""


@dataclass(frozen=True)
class GaussianField:
    """Hold n Gaussians as raw (unconstrained) parameters.

    Attributes:
        means: (n, 3) centres in world coordinates.
        quaternions: (n, 4) rotations, wxyz, not necessarily normalised.
        log_scales: (n, 3) natural logarithm of the standard deviations along the rotated axes, in world units.
        opacity_logits: (n,) logit of the opacity.
        sh: (n, k, 3) spherical-harmonic coefficients, k = (degree + 1)^2 with degree 0 to 3, RGB last.
        signed: True for a residual field, whose colour is the raw SH value; False for max(SH + 0.5, 0).

    Raises:
        FieldError: a tensor has another shape.
    """

    means: Tensor  # (n, 3)
    quaternions: Tensor  # (n, 4)
    log_scales: Tensor  # (n, 3)
    opacity_logits: Tensor  # (n,)
    sh: Tensor  # (n, k, 3)
    signed: bool = False

    def __post_init__(self) -> None:
        n = self.means.shape[0] if self.means.ndim else 0
        expected = {"means": (n, 3), "quaternions": (n, 4), "log_scales": (n, 3), "opacity_logits": (n,)}
        for name, shape in expected.items():
            if tuple(getattr(self, name).shape) != shape:
                raise FieldError(f"{name} has shape {tuple(getattr(self, name).shape)}, expected {shape}")
        if self.sh.ndim != 3 or self.sh.shape[0] != n or self.sh.shape[1] not in (1, 4, 9, 16) or self.sh.shape[2] != 3:
            raise FieldError(f"sh has shape {tuple(self.sh.shape)}, expected ({n}, 1|4|9|16, 3)")

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        """Highest degree of `sh`, 0 to 3."""
        return math.isqrt(self.sh.shape[1]) - 1

    @property
    def parameters(self) -> dict[str, Tensor]:
        """Tensors by attribute name, in declaration order."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "signed"}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> GaussianField:
        """Return the field with some or all tensors replaced."""
        return GaussianField(**{**self.parameters, **parameters}, signed=self.signed)

    def kept(self, rows: Tensor) -> GaussianField:
        """Return some of the Gaussians: those of a mask (n,) bool, or of indices in their order."""
        return self.with_parameters({name: tensor[rows] for name, tensor in self.parameters.items()})

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> GaussianField:
        """Return the field on another device or in another precision, with gradients to this one."""
        return self.with_parameters({k: v.to(device=device, dtype=dtype) for k, v in self.parameters.items()})

    def detach(self) -> GaussianField:
        """Return the field without gradients; it shares memory with this one."""
        return self.with_parameters({k: v.detach() for k, v in self.parameters.items()})

    def require_finite(self) -> None:
        """Check that every number is finite.

        Raises:
            FieldError: one is NaN or inf; names the PLY property, how many and the first Gaussian.
        """
        for attribute, tensor in self.parameters.items():
            if bool(torch.isfinite(tensor.detach().sum())):  # far cheaper than looking at each number
                continue
            bad = ~torch.isfinite(_as_columns(tensor))  # (n, columns)
            if bool(bad.any()):
                column = int(bad.any(dim=0).nonzero()[0])
                name = property_names(self.sh_degree)[attribute][column]
                count, first = int(bad[:, column].sum()), int(bad[:, column].nonzero()[0])
                raise FieldError(
                    f"{name} is NaN or inf for {count} of {len(self)} Gaussians, first at index {first}; "
                    "expected finite numbers"
                )

    def save_ply(self, path: Path | str, comments: Sequence[str] = ()) -> None:
        """Write the field as a standard 3DGS PLY, little endian and float32, completely or not at all.

        `load_ply` returns float32 parameters with the same bits. Characters of `comments` that are not ASCII become
        question marks, and line breaks spaces.

        Raises:
            OSError: the folder cannot be written, or the disk is full.
        """
        lines = [SIGNED_COMMENT] if self.signed else []
        lines += [" ".join(comment.encode("ascii", errors="replace").decode().splitlines()) for comment in comments]
        ply = PlyData([PlyElement.describe(self._as_vertices(), "vertex")], byte_order="<", comments=lines)
        with atomic_write(Path(path)) as stream:
            ply.write(stream)

    def _as_vertices(self) -> NDArray[Any]:
        """Return the field as PLY vertices, (n,), with normals of 0."""
        names, normals = property_names(self.sh_degree), ("nx", "ny", "nz")
        file_order = (
            *names["means"],
            *normals,
            *sorted(names["sh"], key=lambda name: (name.startswith("f_rest_"), int(name.rpartition("_")[2]))),
            *names["opacity_logits"],
            *names["log_scales"],
            *names["quaternions"],
        )
        vertices = np.empty(len(self), dtype=[(name, "<f4") for name in file_order])
        written = torch.from_numpy(vertices.view("<f4").reshape(len(self), len(file_order)))
        parameters = self.parameters
        held = (*(name for attribute in parameters for name in names[attribute]), *normals)
        order = torch.tensor([held.index(name) for name in file_order], device=self.means.device)
        # Whole rows where the field is: writing property by property would go through the array for each.
        for start in range(0, len(self), ROWS):
            part = slice(start, start + ROWS)
            columns = [_as_columns(tensor[part]).to(torch.float32) for tensor in parameters.values()]
            written[part] = torch.cat([*columns, torch.zeros_like(columns[0][:, :3])], 1).index_select(1, order).cpu()
        return vertices

    @classmethod
    def load_ply(cls, path: Path | str) -> GaussianField:
        """Read a 3DGS PLY of any trainer in float32 on the CPU.

        It may have SH degree 0 to 3, normals and further properties (both ignored), float or double values, in ASCII or
        binary of either byte order. `SIGNED_COMMENT` in its header marks a residual field.

        Raises:
            FieldError: the file is missing, truncated, not a PLY, lacks properties of a Gaussian field, or holds NaN or
                inf; says where or which.
        """
        path = Path(path)
        with _naming_file(path):
            ply, vertices = _read_vertices(path)
            degree = _sh_degree(vertices)
            columns = {
                attribute: _stack_columns(vertices, names) for attribute, names in property_names(degree).items()
            }
            field = cls(
                means=columns["means"],
                quaternions=columns["quaternions"],
                log_scales=columns["log_scales"],
                opacity_logits=columns["opacity_logits"][:, 0],
                sh=columns["sh"].reshape(vertices.count, (degree + 1) ** 2, 3),
                signed=SIGNED_COMMENT in ply.comments,
            )
            field.require_finite()
        return field


def require_finite(trained: Mapping[int, GaussianField], level: int) -> None:
    """Check the field of a level in training, and those of others, by level, that are trained jointly with it.

    Raises:
        FieldError: as of `GaussianField.require_finite`; names the level of another one.
    """
    for trained_level, field in trained.items():
        try:
            field.require_finite()
        except FieldError as error:
            if trained_level == level:
                raise
            raise FieldError(f"{error} of level {trained_level}, trained jointly") from error


def field_from_splats(splats: Mapping[str, Tensor], signed: bool = False) -> GaussianField:
    """Make a field that shares the tensors of a gsplat trainer, and their gradients.

    Args:
        splats: "means" (n, 3), "quats" (n, 4), "scales" (n, 3) logarithms, "opacities" (n,) or (n, 1) logits, and SH
            as "sh" (n, k, 3), or as "sh0" (n, 1, 3) and "shN" (n, k - 1, 3). Other entries are ignored.
        signed: whether it is a residual.

    Raises:
        FieldError: an entry is missing, or of another shape.
    """
    colors = ("sh",) if "sh" in splats else ("sh0", "shN")
    if missing := [name for name in (*SPLAT_NAMES, *colors) if name not in splats]:
        raise FieldError(
            f"splats without {', '.join(missing)} (they have {', '.join(splats)}); expected gsplat's names"
        )
    values = {ours: splats[theirs] for theirs, ours in SPLAT_NAMES.items()}
    if values["opacity_logits"].ndim == 2:
        values["opacity_logits"] = values["opacity_logits"][:, 0]
    if wrong := [name for name in colors if splats[name].ndim != 3]:
        raise FieldError(f"{wrong[0]} has shape {tuple(splats[wrong[0]].shape)}, expected (n, coefficients, 3)")
    sh = splats["sh"] if colors == ("sh",) else torch.cat([splats["sh0"], splats["shN"]], 1)
    return GaussianField(**values, sh=sh, signed=signed)


def splats_from_field(field: GaussianField) -> dict[str, Tensor]:
    """Return a field's tensors by gsplat's names: "means", "quats", "scales", "opacities", "sh0", "shN".

    Only SH are copied. `field.signed` is not part of the result.
    """
    values = {theirs: field.parameters[ours] for theirs, ours in SPLAT_NAMES.items()}
    return {**values, "sh0": field.sh[:, :1].contiguous(), "shN": field.sh[:, 1:].contiguous()}


def property_names(sh_degree: int) -> dict[str, tuple[str, ...]]:
    """Return the PLY properties of each attribute of a field, in the order of its flattened columns.

    A PLY numbers SH coefficients above degree 0 channel by channel (red, then green, then blue). A field holds them
    coefficient by coefficient, RGB last.
    """
    rest = (sh_degree + 1) ** 2 - 1
    return {
        "means": ("x", "y", "z"),
        "sh": (
            *(f"f_dc_{channel}" for channel in range(3)),
            *(f"f_rest_{channel * rest + i}" for i in range(rest) for channel in range(3)),
        ),
        "opacity_logits": ("opacity",),
        "log_scales": ("scale_0", "scale_1", "scale_2"),
        "quaternions": ("rot_0", "rot_1", "rot_2", "rot_3"),
    }


def count_gaussians(path: Path | str) -> int:
    """Return the number of Gaussians in a PLY file from its header and size, without reading binary values.

    Raises:
        FieldError: as `GaussianField.load_ply`, except that values are not checked.
    """
    path = Path(path)
    with _naming_file(path):
        _, vertices = _read_vertices(path)
        _sh_degree(vertices)
        return int(vertices.count)


@contextmanager
def _naming_file(path: Path) -> Iterator[None]:
    """Turn errors while reading `path` into a FieldError that names it."""
    try:
        yield
    except FieldError as error:
        raise FieldError(f"{path}: {error}") from error
    except ValueError as error:  # of `read_ply`
        raise FieldError(f"{path}: {error}; expected a whole PLY file written by a 3DGS trainer") from error
    except OSError as error:
        raise FieldError(f"{path} cannot be read: {error.strerror}; expected a PLY file") from error


def _read_vertices(path: Path) -> tuple[PlyData, PlyElement]:
    ply = read_ply(path)
    if "vertex" not in ply:
        elements = ", ".join(element.name for element in ply.elements) or "none"
        raise FieldError(f"no element 'vertex', got {elements}; expected the PLY of a Gaussian field")
    return ply, ply["vertex"]


def _sh_degree(vertices: PlyElement) -> int:
    """Return the SH degree, after checking that all properties of a field are there."""
    scalars = scalar_names(vertices)
    rest = sum(name.startswith("f_rest_") for name in scalars)
    degree = SH_REST_COUNTS.index(rest) if rest in SH_REST_COUNTS else 3
    names = property_names(degree)
    missing = [name for group in names.values() for name in group if name not in scalars]
    if rest not in SH_REST_COUNTS:
        raise FieldError(f"{rest} f_rest_* properties; expected 0, 9, 24 or 45, for SH degree 0, 1, 2 or 3")
    if missing:
        raise FieldError(
            f"the vertices lack {', '.join(missing)}; expected a Gaussian field as 3DGS trainers write it, "
            "not a point cloud, mesh or compressed PLY"
        )
    return degree


def _as_columns(tensor: Tensor) -> Tensor:
    """Return a parameter as PLY columns, (n, columns); reshape(n, -1) would refuse a field without Gaussians."""
    return tensor.detach().reshape(len(tensor), math.prod(tensor.shape[1:]))


def _stack_columns(vertices: PlyElement, names: tuple[str, ...]) -> Tensor:
    """Return properties as one tensor, (n, len(names)) float32."""
    if (rows := _as_rows(vertices)) is not None:
        # All columns in one pass; property by property would read the whole array for each.
        columns = [vertices.data.dtype.names.index(name) for name in names]
        return torch.from_numpy(np.take(rows, columns, axis=1))
    stacked: NDArray[Any] = np.empty((vertices.count, len(names)), dtype=np.float32)
    with np.errstate(over="ignore"):  # a double beyond float32 becomes inf, which require_finite reports
        for column, name in enumerate(names):
            stacked[:, column] = vertices[name]
    return torch.from_numpy(stacked)


def _as_rows(vertices: PlyElement) -> NDArray[np.float32] | None:
    """Return a view of the vertices as (n, properties) if all are native float32; None otherwise."""
    layout = vertices.data.dtype
    if any(layout[name] != np.dtype(np.float32) for name in layout.names):
        return None
    rows: NDArray[np.float32] = vertices.data.view(np.float32).reshape(vertices.count, len(layout.names))
    return rows
