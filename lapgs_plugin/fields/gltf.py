"""Write a field as a binary glTF file with Khronos' extension KHR_gaussian_splatting.

The extension stores every quantity as an attribute of a point primitive, here without rounding except in COLOR_0, the
colours that programs without the extension show. Axes are glTF's: x right, y up, z back.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lapgs_plugin.errors import FieldError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.spherical_harmonics import SH_C0
from lapgs_plugin.fields.y_up import y_up
from lapgs_plugin.files import atomic_write

EXTENSION = "KHR_gaussian_splatting"
RENDERING = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
FLOAT, UNSIGNED_BYTE, ARRAY_BUFFER, POINTS = 5126, 5121, 34962, 0
MOST_BYTES = 2**32 - 1


def save_glb(field: GaussianField, path: Path, note: str) -> None:
    """Write a field, completely or not at all.

    Args:
        field: of any SH degree up to 3.
        path: of the file.
        note: name of the node.

    Raises:
        FieldError: it holds NaN or inf, no Gaussian, or more than 4 GB.
        OSError: the folder cannot be written, or the disk is full.
    """
    field = y_up(field.detach().to("cpu", torch.float32))
    field.require_finite()
    require_glb(field)
    arrays = _attributes(field)
    text = json.dumps(_document(arrays, note), separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    length = sum(array.nbytes for array in arrays.values())
    total = 12 + 8 + len(text) + 8 + length
    if total > MOST_BYTES:
        raise FieldError(f"a glTF file of {total:,} bytes, expected at most {MOST_BYTES:,}; export SPZ or PLY")
    with atomic_write(path) as stream:
        stream.write(struct.pack("<4sII", b"glTF", 2, total))
        stream.write(struct.pack("<I4s", len(text), b"JSON") + text)
        stream.write(struct.pack("<I4s", length, b"BIN\0"))
        for array in arrays.values():
            stream.write(array.tobytes())


def require_glb(field: GaussianField) -> None:
    """Check that a file can hold a field, for callers that write several.

    Raises:
        FieldError: it has no Gaussian.
    """
    if len(field) == 0:
        raise FieldError("the field has no Gaussians, expected one at least: glTF cannot hold none; export PLY")


def _attributes(field: GaussianField) -> dict[str, NDArray[Any]]:
    """Return the arrays (n, c) of all attributes by name; rows are whole multiples of four bytes."""
    w, x, y, z = torch.nn.functional.normalize(field.quaternions.double(), dim=1).float().unbind(dim=1)
    opacities = torch.sigmoid(field.opacity_logits)[:, None]
    tensors = {
        "POSITION": field.means,
        f"{EXTENSION}:ROTATION": torch.stack([x, y, z, w], dim=1),
        f"{EXTENSION}:SCALE": field.log_scales.exp().clamp_max(torch.finfo(torch.float32).max),
        f"{EXTENSION}:OPACITY": opacities,
    }
    for degree in range(field.sh_degree + 1):
        for order in range(2 * degree + 1):
            tensors[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"] = field.sh[:, degree * degree + order]
    color = torch.cat([_linear((SH_C0 * field.sh[:, 0] + 0.5).clamp(0.0, 1.0)), opacities], dim=1)
    return {
        **{name: np.ascontiguousarray(tensor.numpy(), "<f4") for name, tensor in tensors.items()},
        "COLOR_0": np.rint(255.0 * color.numpy()).astype(np.uint8),
    }


def _linear(color: torch.Tensor) -> torch.Tensor:
    """Decode sRGB, of which COLOR_0 has linear values."""
    return torch.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


def _document(arrays: Mapping[str, NDArray[Any]], note: str) -> dict[str, Any]:
    """Return the JSON part: one node with one primitive, whose attributes lie one after the other in the buffer."""
    views, accessors, offset = [], [], 0
    for index, (name, array) in enumerate(arrays.items()):
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": ARRAY_BUFFER})
        offset += array.nbytes
        accessor = {
            "bufferView": index,
            "componentType": FLOAT if array.dtype.kind == "f" else UNSIGNED_BYTE,
            "count": len(array),
            "type": TYPES[array.shape[1]],
        }
        if name == "POSITION":
            accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        if array.dtype.kind != "f":
            accessor["normalized"] = True
        accessors.append(accessor)
    primitive = {
        "attributes": {name: index for index, name in enumerate(arrays)},
        "mode": POINTS,
        "extensions": {EXTENSION: RENDERING},
    }
    return {
        "asset": {"version": "2.0", "generator": "lapgs_plugin"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": note}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
