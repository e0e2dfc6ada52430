"""Write a field as an SPZ file, a compressed format of web viewers.

The format is Niantic's (https://github.com/nianticlabs/spz): a header and six arrays, each of one quantity of all
Gaussians, rounded to 8, 10 or 24 bits. Axes are x right, y up, z back. Version 3 is gzip around all of it, and every
reader has it. Version 4, of 2026, has a header of 32 bytes, a table of sizes, and each array as a Zstandard frame.
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

from lapgs_plugin.errors import FieldError, require_extra
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.y_up import y_up
from lapgs_plugin.files import atomic_write

MAGIC = 0x5053474E  # "NGSP"
COLOR_SCALE = 0.15
POSITION_BITS, MOST_FRACTIONAL_BITS = 24, 20
SCALE_OFFSET, SCALE_STEPS = 10.0, 16.0
ROTATION_BITS = 9  # of the magnitude of a component; one more is its sign
GZIP_WITH_COMMENT = 0x10
ANTIALIASED = 0x1
"""Flag of fields that were trained with antialiasing."""
HEADER_4 = struct.Struct("<IIIBBBBI12x")
ZSTD_LEVEL = 12

Bytes = NDArray[np.uint8]


def save_spz(field: GaussianField, path: Path, comment: str, version: int = 3, *, antialiased: bool = False) -> None:
    """Write a field, completely or not at all.

    Positions are rounded to 2^-20 of a world unit or to the resolution that 24 bits allow, standard deviations to 6 %,
    opacities and colours to 8 bits, rotations to 10. Coefficients above degree 0 are clamped to [-1, 1) and rounded to
    8 bits. Niantic's own writer keeps 5 of these, from degree 2 on 4, which would lose the small coefficients of short
    trainings.

    Args:
        field: of any SH degree up to 3.
        path: of the file.
        comment: Latin-1 text for the gzip header, which viewers ignore. Version 4 has no place for it.
        version: 3 or 4.
        antialiased: tell viewers to dim Gaussians that are smaller than a pixel.

    Raises:
        MissingExtraError: version 4 needs the extra "spz".
        FieldError: it holds NaN or inf, or a position that 24 bits cannot hold.
        OSError: the folder cannot be written, or the disk is full.
    """
    if version == 4:
        require_extra("zstandard", "spz", "SPZ version 4", "take version 3")
    field = y_up(field.detach().to("cpu", torch.float32))
    field.require_finite()
    fractional_bits = _fractional_bits(field)
    arrays = (
        _positions(field, fractional_bits),
        _to_bytes(255.0 * torch.sigmoid(field.opacity_logits)),
        _to_bytes(255.0 * (COLOR_SCALE * field.sh[:, 0] + 0.5)),
        _to_bytes(SCALE_STEPS * (field.log_scales + SCALE_OFFSET)),
        _rotations(field),
        _higher_coefficients(field),
    )
    streams = [array.tobytes() for array in arrays]
    facts = len(field), field.sh_degree, fractional_bits, ANTIALIASED if antialiased else 0
    with atomic_write(path) as stream:
        if version == 3:
            header = struct.pack("<IIIBBBB", MAGIC, 3, *facts, 0)
            stream.write(_gzip(b"".join([header, *streams]), comment))
        else:
            stream.write(_with_table(facts, [content for content in streams if content]))


def require_spz(field: GaussianField) -> None:
    """Check that a file can hold a field, for callers that write several.

    Raises:
        FieldError: a position is too far from the origin.
    """
    _fractional_bits(field)


def _with_table(facts: tuple[int, int, int, int], streams: list[bytes]) -> bytes:
    """Return a file of version 4: `facts` are the number of Gaussians, the SH degree, fractional bits and flags."""
    import zstandard

    compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
    frames = [compressor.compress(content) for content in streams]
    header = HEADER_4.pack(MAGIC, 4, *facts, len(frames), HEADER_4.size)
    table = [struct.pack("<QQ", len(frame), len(content)) for frame, content in zip(frames, streams, strict=True)]
    return b"".join([header, *table, *frames])


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
    fixed = torch.round(field.means.double() * 2.0**fractional_bits).to(torch.int32).numpy()
    return np.ascontiguousarray(fixed.astype("<i4")[..., None].view(np.uint8)[..., :3])


def _rotations(field: GaussianField) -> Bytes:
    """Return rotations as (n, 4) bytes: two bits for the index of the largest component, then the other three."""
    w, x, y, z = torch.nn.functional.normalize(field.quaternions.double(), dim=1).unbind(dim=1)
    quaternions = torch.stack([x, y, z, w], dim=1).numpy()  # (n, 4)
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
    return _to_bytes(128.0 * field.sh[:, 1:] + 128.0)


def _to_bytes(values: torch.Tensor) -> Bytes:
    return np.asarray(torch.round(values).clamp(0.0, 255.0).to(torch.uint8).numpy(), dtype=np.uint8)


def _gzip(content: bytes, comment: str) -> bytes:
    """Compress as gzip with a comment (RFC 1952), which Python's gzip module cannot write."""
    deflate = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    head = struct.pack("<BBBBIBB", 0x1F, 0x8B, 8, GZIP_WITH_COMMENT, int(time.time()), 2, 255)
    note = comment.encode("latin-1", errors="replace").replace(b"\0", b"") + b"\0"
    body = deflate.compress(content) + deflate.flush()
    return head + note + body + struct.pack("<II", zlib.crc32(content), len(content) & 0xFFFFFFFF)
