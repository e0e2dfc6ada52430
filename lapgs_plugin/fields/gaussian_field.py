"""A set of Gaussians with the parameterisation every 3DGS backbone optimizes; its PLY file in and out."""

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
"""PLY comment that marks a residual field. Viewers that do not know it show the field as an ordinary one."""

SH_REST_COUNTS = (0, 9, 24, 45)
"""How many f_rest_* properties a PLY of SH degree 0 to 3 has: three channels of (degree + 1)^2 - 1."""


@dataclass(frozen=True)
class GaussianField:
    """n Gaussians, as raw (unconstrained) parameters.

    Attributes:
        means: (n, 3) centres in world coordinates.
        quaternions: (n, 4) rotations, wxyz, not necessarily normalised.
        log_scales: (n, 3) natural logarithm of the standard deviations along the rotated axes, in world units.
        opacity_logits: (n,) logit of the opacity.
        sh: (n, k, 3) spherical-harmonic coefficients, k = (degree + 1)^2 with degree 0 to 3, RGB last.
        signed: True for a residual field, whose colour is the raw SH value; False for max(SH + 0.5, 0).
    """

    means: Tensor  # (n, 3)
    quaternions: Tensor  # (n, 4)
    log_scales: Tensor  # (n, 3)
    opacity_logits: Tensor  # (n,)
    sh: Tensor  # (n, k, 3)
    signed: bool = False

    def __post_init__(self) -> None:
        n = self.means.shape[0]
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
        return math.isqrt(self.sh.shape[1]) - 1

    @property
    def parameters(self) -> dict[str, Tensor]:
        """The tensors by attribute name, in declaration order."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "signed"}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> GaussianField:
        """The field with some or all tensors replaced."""
        return GaussianField(**{**self.parameters, **parameters}, signed=self.signed)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> GaussianField:
        return self.with_parameters({k: v.to(device=device, dtype=dtype) for k, v in self.parameters.items()})

    def detach(self) -> GaussianField:
        return self.with_parameters({k: v.detach() for k, v in self.parameters.items()})

    def require_finite(self) -> None:
        """Check every number of the field.

        Raises:
            FieldError: one is NaN or inf; names the property as a PLY calls it, how many and the first Gaussian.
        """
        for attribute, tensor in self.parameters.items():
            if bool(
                torch.isfinite(tensor.detach().sum())
            ):  # a tenth of the time of looking at each, and nearly always so
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
        """Write the field as a standard 3DGS PLY, little endian, float32, that other viewers read.

        float32 parameters come back from `load_ply` with the same bits. The file appears whole or not at all.

        Args:
            path: of the file.
            comments: for the header, one line each; non-ASCII characters are written as question marks.

        Raises:
            OSError: the folder cannot be written, or the disk is full.
        """
        names = property_names(self.sh_degree)
        file_order = (
            *names["means"],
            *("nx", "ny", "nz"),
            *sorted(names["sh"], key=lambda name: (name.startswith("f_rest_"), int(name.rpartition("_")[2]))),
            *names["opacity_logits"],
            *names["log_scales"],
            *names["quaternions"],
        )
        rows = np.zeros(len(self), dtype=[(name, "<f4") for name in file_order])
        for attribute, tensor in self.parameters.items():
            columns = _as_columns(tensor).to("cpu", torch.float32).numpy()
            for column, name in zip(columns.T, names[attribute], strict=True):
                rows[name] = column
        lines = [SIGNED_COMMENT] if self.signed else []
        lines += [comment.encode("ascii", errors="replace").decode() for comment in comments]
        ply = PlyData([PlyElement.describe(rows, "vertex")], byte_order="<", comments=lines)
        with atomic_write(Path(path)) as stream:
            ply.write(stream)

    @classmethod
    def load_ply(cls, path: Path | str) -> GaussianField:
        """Read a 3DGS PLY as any trainer wrote it, in float32 on the CPU.

        SH degree 0 to 3, with or without normals, with further properties (ignored), in float or double, ascii or
        binary of either byte order. A file is a residual field when its header says so (`SIGNED_COMMENT`).

        Raises:
            FieldError: the file is missing, cut short (says after which Gaussian), not a PLY, lacks properties of a
                Gaussian field (says which), or holds NaN or inf (says where).
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


def property_names(sh_degree: int) -> dict[str, tuple[str, ...]]:
    """PLY properties of each attribute of a field, in the order of the attribute's flattened columns.

    A PLY numbers SH coefficients above degree 0 channel by channel (all of red, then green, then blue), the field
    holds them coefficient by coefficient with RGB last.
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
    """How many Gaussians a PLY file holds, from its header and its size, without reading them when it is binary.

    Raises:
        FieldError: as `GaussianField.load_ply`, except that values are not looked at.
    """
    path = Path(path)
    with _naming_file(path):
        _, vertices = _read_vertices(path)
        _sh_degree(vertices)
        return int(vertices.count)


@contextmanager
def _naming_file(path: Path) -> Iterator[None]:
    """Turn what goes wrong while reading `path` into one line that names it."""
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
    """SH degree of the properties, after checking that a whole set is there."""
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
    """A parameter as the PLY's columns, (n, columns); reshape(n, -1) would refuse a field without Gaussians."""
    return tensor.detach().reshape(len(tensor), math.prod(tensor.shape[1:]))


def _stack_columns(vertices: PlyElement, names: tuple[str, ...]) -> Tensor:
    """Properties as one tensor, (n, len(names)) float32."""
    if (rows := _as_rows(vertices)) is not None:
        # Row by row; property by property would go through the whole file for each.
        columns = [vertices.data.dtype.names.index(name) for name in names]
        return torch.from_numpy(np.take(rows, columns, axis=1))
    stacked: NDArray[Any] = np.empty((vertices.count, len(names)), dtype=np.float32)
    with np.errstate(over="ignore"):  # a double beyond float32 becomes inf, which require_finite reports
        for column, name in enumerate(names):
            stacked[:, column] = vertices[name]
    return torch.from_numpy(stacked)


def _as_rows(vertices: PlyElement) -> NDArray[np.float32] | None:
    """The vertices as (n, properties), where all are floats as they lie in this machine's memory; None otherwise."""
    layout = vertices.data.dtype
    if any(layout[name] != np.dtype(np.float32) for name in layout.names):
        return None
    rows: NDArray[np.float32] = vertices.data.view(np.float32).reshape(vertices.count, len(layout.names))
    return rows
