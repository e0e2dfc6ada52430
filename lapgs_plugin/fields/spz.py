"""Write a field as an SPZ file, version 3, a compressed format of web viewers.

The format is Niantic's (https://github.com/nianticlabs/spz): gzip around a header of 16 bytes and six arrays, each of
one quantity of all Gaussians, rounded to 8, 10 or 24 bits. Axes are x right, y up, z back. All readers support version
3; version 4 replaced gzip in 2026, version 2 has 8 bits for rotations.
"""

from __future__ import annotations

import math
import struct
import time
import zlib
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from lapgs_plugin.errors import FieldError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.spherical_harmonics import sh_basis
from lapgs_plugin.files import atomic_write

MAGIC, VERSION = 0x5053474E, 3  # "NGSP"
COLOR_SCALE = 0.15
POSITION_BITS, MOST_FRACTIONAL_BITS = 24, 20
SCALE_OFFSET, SCALE_STEPS = 10.0, 16.0
ROTATION_BITS = 9  # of the magnitude of a component; one more is its sign
TO_SPZ_AXES = torch.tensor([1.0, -1.0, -1.0])
GZIP_WITH_COMMENT = 0x10

Bytes = NDArray[np.uint8]


def save_spz(field: GaussianField, path: Path, comment: str) -> None:
    """Write a field, completely or not at all.

    Positions are rounded to 2^-20 of a world unit or to the resolution that 24 bits allow, standard deviations to 6 %,
    opacities and colours to 8 bits, rotations to 10. Coefficients above degree 0 are clamped to [-1, 1) and rounded to
    8 bits. Niantic's own writer keeps 5 of these, from degree 2 on 4, which would lose the small coefficients of short
    trainings.

    Args:
        field: of any SH degree up to 3.
        path: of the file.
        comment: Latin-1 text for the gzip header, which viewers ignore.

    Raises:
        FieldError: it holds NaN or inf, or a position that 24 bits cannot hold.
        OSError: the folder cannot be written, or the disk is full.
    """
    field = field.detach().to("cpu", torch.float32)
    field.require_finite()
    fractional_bits = _fractional_bits(field)
    header = struct.pack("<IIIBBBB", MAGIC, VERSION, len(field), field.sh_degree, fractional_bits, 0, 0)
    arrays = (
        _positions(field, fractional_bits),
        _to_bytes(255.0 * torch.sigmoid(field.opacity_logits)),
        _to_bytes(255.0 * (COLOR_SCALE * field.sh[:, 0] + 0.5)),
        _to_bytes(SCALE_STEPS * (field.log_scales + SCALE_OFFSET)),
        _rotations(field),
        _higher_coefficients(field),
    )
    with atomic_write(path) as stream:
        stream.write(_gzip(b"".join([header, *(array.tobytes() for array in arrays)]), comment))


def _fractional_bits(field: GaussianField) -> int:
    """Return the number of fractional bits of positions, as many as the farthest Gaussian allows."""
    farthest = float(field.means.abs().max()) if len(field) else 0.0
    most = 2 ** (POSITION_BITS - 1) - 1
    bits = (
        MOST_FRACTIONAL_BITS if farthest == 0.0 else min(MOST_FRACTIONAL_BITS, math.floor(math.log2(most / farthest)))
    )
    if bits < 0:
        raise FieldError(
            f"a Gaussian is {farthest:g} units from the origin, expected at most {most}: SPZ cannot hold it; export PLY"
        )
    return bits


def _positions(field: GaussianField, fractional_bits: int) -> Bytes:
    """Return positions as 24-bit little-endian integers, (n, 3, 3) bytes."""
    fixed = torch.round(field.means.double() * TO_SPZ_AXES * 2.0**fractional_bits).to(torch.int32).numpy()
    return np.ascontiguousarray(fixed.astype("<i4")[..., None].view(np.uint8)[..., :3])


def _rotations(field: GaussianField) -> Bytes:
    """Return rotations as (n, 4) bytes: two bits for the index of the largest component, then the other three."""
    w, x, y, z = torch.nn.functional.normalize(field.quaternions.double(), dim=1).unbind(dim=1)
    quaternions = torch.stack([x, -y, -z, w], dim=1).numpy()  # (n, 4) xyzw in SPZ axes
    largest = np.abs(quaternions).argmax(axis=1)
    sign = np.where(np.take_along_axis(quaternions, largest[:, None], axis=1) < 0, -1.0, 1.0)
    quaternions = quaternions * sign  # the largest is positive and is not stored
    sizes = np.floor((2**ROTATION_BITS - 1) * math.sqrt(2.0) * np.abs(quaternions) + 0.5).astype(np.uint32)
    signed = ((quaternions < 0).astype(np.uint32) << ROTATION_BITS) | sizes
    packed = largest.astype(np.uint32)
    for component in range(4):
        with_it = (packed << (ROTATION_BITS + 1)) | signed[:, component]
        packed = np.where(component == largest, packed, with_it)
    return np.ascontiguousarray(packed.astype("<u4")[:, None]).view(np.uint8)


def _higher_coefficients(field: GaussianField) -> Bytes:
    """Return coefficients above degree 0, (n, k - 1, 3) bytes."""
    turned = field.sh[:, 1:] * _signs_of_basis(field.sh_degree)[1:, None]
    return _to_bytes(128.0 * turned + 128.0)


def _signs_of_basis(degree: int) -> torch.Tensor:
    """Return the sign (k,) that each basis function changes by when y and z are negated."""
    anywhere = torch.nn.functional.normalize(torch.tensor([[0.3, 0.5, 0.7]], dtype=torch.float64), dim=1)
    ratio = sh_basis(anywhere * TO_SPZ_AXES, degree) / sh_basis(anywhere, degree)
    return torch.sign(ratio[0]).float()


def _to_bytes(values: torch.Tensor) -> Bytes:
    return np.asarray(torch.round(values).clamp(0.0, 255.0).to(torch.uint8).numpy(), dtype=np.uint8)


def _gzip(content: bytes, comment: str) -> bytes:
    """Compress as gzip with a comment (RFC 1952), which Python's gzip module cannot write."""
    deflate = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    head = struct.pack("<BBBBIBB", 0x1F, 0x8B, 8, GZIP_WITH_COMMENT, int(time.time()), 2, 255)
    note = comment.encode("latin-1", errors="replace").replace(b"\0", b"") + b"\0"
    body = deflate.compress(content) + deflate.flush()
    return head + note + body + struct.pack("<II", zlib.crc32(content), len(content) & 0xFFFFFFFF)
