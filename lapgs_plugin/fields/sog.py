"""Write fields as SOG, PlayCanvas' format of WebP images: one field, or levels of detail that are streamed.

Version 2 of the format (https://github.com/playcanvas/splat-transform): each pixel of an image is a Gaussian.
Positions have 16 bits, after a logarithm; rotations and opacities 8. Scales and colours are indices into codebooks of
256 numbers. Coefficients above degree 0 are indices into a palette of at most 65,536 sets. Axes are those of PLY files.

Levels of detail are a tree of boxes in lod-meta.json. Each leaf names, by level, a range of a file of that level, so
that a viewer loads the level that suits the leaf's distance.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import Tensor

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.quantization import (
    Bytes,
    codebook,
    fixed_point,
    low_and_high,
    morton_order,
    packed_rotations,
    palette,
)
from lapgs_plugin.files import atomic_write
from lapgs_plugin.progress import item_progress

META, LOD_META = "meta.json", "lod-meta.json"
COLUMNS = 64
"""Sets in one row of a palette's image."""

LEAF = 65_536
"""Most Gaussians in a leaf of the tree, all levels together."""

FILE = 524_288
"""Gaussians of a file after which the next leaf starts another one."""

NOT_ZERO = (0.0, 0.0, 0.0, 1e-100)
"""Added to a quaternion xyzw, so that one of zeros has a direction."""


def save_sog(gaussians: GaussianField, folder: Path, *, antialiased: bool = False) -> None:
    """Write a field in its own order into a folder: meta.json, and the images that it names.

    Args:
        gaussians: one or more, of any SH degree up to 3.
        folder: is made.
        antialiased: tell viewers to dim Gaussians that are smaller than a pixel.

    Raises:
        FieldError: a number is NaN or inf.
        OSError: the folder cannot be written, or the disk is full.
    """
    gaussians = gaussians.detach().to("cpu", torch.float32)
    gaussians.require_finite()
    low, high, fixed = fixed_point(gaussians.means)
    scale_codes, scales = codebook(gaussians.log_scales.numpy())
    color_codes, colors = codebook(gaussians.sh[:, 0].numpy())
    opacities = np.rint(255.0 * torch.sigmoid(gaussians.opacity_logits).numpy()).astype(np.uint8)
    images = {
        "means_l.webp": _texture(low_and_high(fixed)[:, :3]),
        "means_u.webp": _texture(low_and_high(fixed)[:, 3:]),
        "quats.webp": _texture(packed_rotations(gaussians.quaternions)),
        "scales.webp": _texture(scales),
        "sh0.webp": _texture(np.concatenate([colors, opacities[:, None]], axis=1)),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "lapgs_plugin"},
        "count": len(gaussians),
        "antialias": antialiased,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_codes, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_codes, "files": ["sh0.webp"]},
    }
    if gaussians.sh_degree > 0:
        rest, labels = palette(gaussians.sh[:, 1:])
        rest_codes, sets = codebook(rest)
        files = ["shN_centroids.webp", "shN_labels.webp"]
        images |= {
            files[0]: _palette_texture(sets),
            files[1]: _texture(np.pad(low_and_high(labels[:, None]), ((0, 0), (0, 1)))),
        }
        meta["shN"] = {"count": len(sets), "bands": gaussians.sh_degree, "codebook": rest_codes, "files": files}
    folder.mkdir(parents=True, exist_ok=True)
    for name, pixels in images.items():
        _save_webp(pixels, folder / name)
    _save_json(meta, folder / META)


def save_streamed_sog(levels: Mapping[int, GaussianField], folder: Path, *, antialiased: Collection[int] = ()) -> None:
    """Write levels of detail into a folder: lod-meta.json, and folders of SOG that it names.

    Args:
        levels: of one scene; their order is that of detail, the finest first, whatever their numbers.
        folder: is made. Files of an earlier export are replaced, or no longer named.
        antialiased: the levels that viewers are told to dim, see `save_sog`.

    Raises:
        As `save_sog`.
    """
    numbers = sorted(levels)
    fields = [levels[number].detach().to("cpu", torch.float32) for number in numbers]
    for one in fields:
        one.require_finite()
    layout = _Layout(fields)
    tree = layout.node(np.arange(len(layout.means)))
    meta = {
        "version": 1,
        "asset": {"generator": "lapgs_plugin"},
        "count": len(layout.means),
        "counts": [len(one) for one in fields],
        "lodLevels": len(fields),
        "filenames": [f"{name}/{META}" for name in layout.files],
        "tree": tree,
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / LOD_META).unlink(missing_ok=True)  # until all that it names is there
    with item_progress("files") as progress:
        for name, (level, leaves) in progress.track(layout.files.items(), description="Compressing levels"):
            part = fields[level].kept(torch.from_numpy(np.concatenate(leaves)))
            save_sog(part, folder / name, antialiased=numbers[level] in antialiased)
    _save_json(meta, folder / LOD_META)


@dataclass
class _Layout:
    """Sort the Gaussians of all levels into leaves and files.

    Attributes:
        fields: by level of detail, the finest first.
        files: by name, the level of a file and the rows of its field, leaf by leaf.
        means: (n, 3) of all fields, one after the other.
        reach: (n, 3) standard deviations along the axes of the world.
        level: (n,) index of the field of each.
        first: (levels,) index of the first Gaussian of each field.
    """

    fields: list[GaussianField]
    files: dict[str, tuple[int, list[NDArray[np.int64]]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.means = torch.cat([one.means for one in self.fields]).numpy()
        self.reach = torch.cat([_reach(one) for one in self.fields]).numpy()
        counts = [len(one) for one in self.fields]
        self.level = np.repeat(np.arange(len(counts)), counts)
        self.first = np.cumsum([0, *counts[:-1]])

    def node(self, members: NDArray[np.int64]) -> dict[str, Any]:
        """Return the tree of some Gaussians, and put them into files."""
        extent = np.ptp(self.means[members], axis=0) if len(members) else np.zeros(3)
        if len(members) > LEAF and extent.max() > 0.0:
            axis, half = int(extent.argmax()), len(members) // 2
            order = np.argpartition(self.means[members, axis], half)
            children = [self.node(members[order[:half]]), self.node(members[order[half:]])]
            bounds = [child["bound"] for child in children]
            low = np.min([bound["min"] for bound in bounds], axis=0)
            high = np.max([bound["max"] for bound in bounds], axis=0)
            return {"bound": _bound(low, high), "children": children}
        lods = {}
        for level in np.unique(self.level[members]).tolist():
            rows = members[self.level[members] == level]
            rows = rows[morton_order(self.means[rows])]
            lods[str(level)] = self._put(level, rows - self.first[level])
        low = (self.means[members] - self.reach[members]).min(axis=0)
        return {"bound": _bound(low, (self.means[members] + self.reach[members]).max(axis=0)), "lods": lods}

    def _put(self, level: int, rows: NDArray[np.int64]) -> dict[str, int]:
        """Append rows of a level to its last file, or to another one if that is full, and return where they are."""
        own = [name for name, (of, _) in self.files.items() if of == level]
        filled = sum(map(len, self.files[own[-1]][1])) if own else FILE
        if filled >= FILE:
            name, filled = f"{level}_{len(own)}", 0
            self.files[name] = level, []
        else:
            name = own[-1]
        self.files[name][1].append(rows)
        return {"file": list(self.files).index(name), "offset": filled, "count": len(rows)}


def _bound(low: NDArray[Any], high: NDArray[Any]) -> dict[str, list[float]]:
    return {"min": [float(value) for value in low], "max": [float(value) for value in high]}


def _reach(one: GaussianField) -> Tensor:
    """Return the standard deviation of each Gaussian along the axes of the world, (n, 3) float64.

    The square of one that diverged in training exceeds float32, and JSON has no infinity.
    """
    xyzw = one.quaternions.double().numpy()[:, [1, 2, 3, 0]] + NOT_ZERO
    rotations = torch.from_numpy(Rotation.from_quat(xyzw).as_matrix())
    reach: Tensor = (rotations * one.log_scales.double().exp()[:, None]).norm(dim=2)
    return reach


def _texture(values: Bytes) -> Bytes:
    """Return values (n, 3) or (n, 4) of Gaussians as an image (height, width, 4), opaque where they are three."""
    width = math.ceil(math.sqrt(len(values)) / 4) * 4
    height = math.ceil(len(values) / width / 4) * 4
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[: len(values), 3] = 255
    pixels[: len(values), : values.shape[1]] = values
    return pixels.reshape(height, width, 4)


def _palette_texture(sets: Bytes) -> Bytes:
    """Return sets (count, k, 3) as an image of rows of 64 sets: (height, 64 k, 4)."""
    height, k = -(-len(sets) // COLUMNS), sets.shape[1]
    pixels = np.zeros((height * COLUMNS, k, 4), np.uint8)
    pixels[: len(sets), :, :3], pixels[..., 3] = sets, 255
    return pixels.reshape(height, COLUMNS * k, 4)


def _save_webp(pixels: Bytes, path: Path) -> None:
    """Write an image without losses, also where it is transparent."""
    encoded = BytesIO()
    Image.fromarray(pixels).save(encoded, "WEBP", lossless=True, exact=True)
    with atomic_write(path) as stream:
        stream.write(encoded.getvalue())


def _save_json(values: Mapping[str, Any], path: Path) -> None:
    with atomic_write(path) as stream:
        stream.write(json.dumps(values, separators=(",", ":")).encode())
