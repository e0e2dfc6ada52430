"""Damage that knows a binary format: headers that lie about sizes, tensors of other shapes, cells of a database."""

from __future__ import annotations

import io
import json
import pickle
import re
import sqlite3
import struct
import tempfile
import zipfile
import zlib
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import torch

from tests.fuzz.mutations import (
    DOUBLES,
    LIES,
    any_value,
    as_json,
    damaged_bytes,
    damaged_file,
    damaged_text,
    damaged_tree,
    pack_double,
    with_lie,
)

SIDES = (0, 1, 3, 65_535, 100_000, 1_000_000, 2**30, 2**31 - 1, 2**31, 2**32 - 1)
LARGE = 1_600_000_000
"""Bytes that a small file can be unpacked to, more than any case may take."""


def damaged_png(data: bytes, random: Random) -> bytes:
    """A header with other sides, depth or colour type and a checksum that fits; now and then with all those pixels."""
    action = random.randrange(8)
    if action < 3:
        return damaged_file(data, random)
    if action == 3:
        return _large_png(*random.choice(((16_000, 12_000), (40_000, 20_000), (2_000_000, 100))))
    width, height, depth, colour = struct.unpack_from(">IIBB", data, 16)
    field = random.randrange(5)
    if field in (0, 1):
        width = random.choice(SIDES)
    if field in (0, 2):
        height = random.choice(SIDES)
    if field == 3:
        depth = random.choice((0, 1, 2, 4, 8, 16, 32, 255))
    if field == 4:
        colour = random.choice((0, 2, 3, 4, 6, 7, 255))
    header = struct.pack(">IIBB", width, height, depth, colour) + data[26:29]
    return data[:16] + header + struct.pack(">I", zlib.crc32(b"IHDR" + header)) + data[33:]


@cache
def _large_png(width: int, height: int) -> bytes:
    """A black image of one bit a pixel."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    packer = zlib.compressobj(1)
    row = bytes(1 + (width + 7) // 8)
    pixels = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def damaged_jpeg(data: bytes, random: Random) -> bytes:
    """The frame header's sides, precision or components."""
    frame = next((at for at in range(len(data) - 9) if data[at] == 0xFF and data[at + 1] in (0xC0, 0xC1, 0xC2)), None)
    if frame is None or random.random() < 0.5:
        return damaged_file(data, random)
    at = frame + 4 + random.choice((0, 1, 1, 3, 3, 5))
    return data[:at] + random.choice((b"\0\0", b"\xff\xff", b"\0\1", b"\x0c\1", b"\x7f\xff")) + data[at + 2 :]


def stored_jpeg(data: bytes, random: Random) -> bytes:
    """Bytes between segments or restart markers in the pixels, as drones write them, or an end that comes too early."""
    action, pixels = random.randrange(4), data.index(b"\xff\xda")
    if action == 0:
        return data[: random.randrange(pixels, len(data))]
    if action == 1:
        return (
            data[:pixels] + random.choice((b"\0" * 4, b"\xff" * 3, b"APP", b"\xff\xe1\0\x08junk\0\0")) + data[pixels:]
        )
    if action == 2:
        at = random.randrange(pixels + 14, len(data))
        return data[:at] + bytes([0xFF, 0xD0 + random.randrange(8)]) + data[at:]
    return data + random.choice((b"\0" * 1000, data, b"MPF\0" + data[:100]))


def _interrupted(data: bytes, random: Random) -> bytes:
    """The file as an interrupted copy leaves it: short, or with zeros at its end."""
    at = random.randrange(len(data))
    return data[:at] + random.choice((b"", bytes(len(data) - at)))


def damaged_webp(data: bytes, random: Random) -> bytes:
    """The sides in its header, up to 16 million with the extended one; a file cut short; or any bytes."""
    action, side = random.randrange(4), random.choice((0, 1, 16_383))
    if action == 0:
        return _interrupted(data, random)
    if action == 1:
        canvas = random.choice((0, 99_999, 2**24 - 1)).to_bytes(3, "little")
        chunk = b"VP8X" + struct.pack("<I4x", 10) + canvas + random.choice((canvas, b"\0\0\0")) + data[12:]
        return b"RIFF" + struct.pack("<I", len(chunk) + 4) + b"WEBP" + chunk
    if action == 2 and data[12:16] == b"VP8 ":
        return data[:26] + struct.pack("<HH", side, random.choice((side, 40))) + data[30:]
    if action == 2:
        return data[:21] + struct.pack("<I", side | (random.choice((side, 31)) << 14)) + data[25:]
    return damaged_file(data, random)


def damaged_heic(data: bytes, random: Random) -> bytes:
    """The sides that a box announces, the length or name of a box, a file cut short, or any bytes."""
    action = random.randrange(5)
    if action == 0:
        return _interrupted(data, random)
    if action == 1:
        at = data.index(b"ispe") + random.choice((8, 12))
        return data[:at] + struct.pack(">I", random.choice(SIDES)) + data[at + 4 :]
    if action == 2:
        boxes = [
            match.start() for match in re.finditer(rb"ftyp|meta|hdlr|iloc|iinf|iprp|ipco|hvcC|ispe|ipma|mdat", data)
        ]
        at = random.choice(boxes)
        if random.random() < 0.3:
            return data[:at] + b"free" + data[at + 4 :]
        return data[: at - 4] + struct.pack(">I", random.choice(LIES) % 2**32) + data[at:]
    return damaged_file(data, random)


def damaged_clip(data: bytes, random: Random) -> bytes:
    """Times, sides or sizes of an MP4's boxes, the frames' bytes, a file cut short, or another kind of file."""
    action = random.randrange(6)
    if action == 0:
        return data[: random.randrange(len(data))]
    if action == 1:
        return random.choice(
            (b"", b"RIFF\0\0\0\0AVI ", b"#EXTM3U\nfile:///etc/hostname\n", b"ffconcat version 1.0\nfile 'x'\n")
        )
    if action < 4:
        boxes = [
            match.start() for match in re.finditer(rb"moov|mvhd|tkhd|mdhd|stsd|avc1|stts|stsz|stco|stsc|mdat", data)
        ]
        return with_lie(data, random.choice(boxes) + 4 * random.randrange(-1, 24), random)
    return damaged_file(data, random)


def damaged_gif(data: bytes, random: Random) -> bytes:
    """Sides of the screen or of the picture in it, and how many colours the palette has."""
    if random.random() < 0.5:
        return damaged_file(data, random)
    at = random.choice((6, 8, 10, 11, 12, max(12, data.find(b"\x2c") + random.choice((1, 3, 5, 7, 9)))))
    return data[:at] + random.choice((b"\0\0", b"\xff\xff", b"\0\1", b"\x87\0")) + data[at + 2 :]


def damaged_exr(data: bytes, random: Random) -> bytes:
    """The windows that pixels are stored and shown in."""
    if random.random() < 0.4:
        return damaged_file(data, random)
    name = random.choice((b"displayWindow\0box2i\0", b"dataWindow\0box2i\0"))
    at = data.index(name) + len(name) + 4 + 4 * random.randrange(4)
    return data[:at] + struct.pack("<I", random.choice((*SIDES, 99_999, 2**32 - 5))) + data[at + 4 :]


def damaged_tiff(data: bytes, random: Random) -> bytes:
    """An entry of the first directory: its tag, type, count or value."""
    if random.random() < 0.4:
        return damaged_file(data, random)
    order = "<" if data[:2] == b"II" else ">"
    directory = struct.unpack_from(order + "I", data, 4)[0]
    if directory + 2 > len(data):
        return damaged_file(data, random)
    entries = max(1, struct.unpack_from(order + "H", data, directory)[0])
    at = directory + 2 + 12 * random.randrange(entries)
    at, kind = random.choice(((at, "H"), (at + 2, "H"), (at + 4, "I"), (at + 8, "I"), (at + 8, "I"), (at + 8, "H")))
    lie = random.choice((*SIDES, 7, 8, 16, 32, 32_773)) % 256 ** struct.calcsize(kind)
    return data[:at] + struct.pack(order + kind, lie) + data[at + struct.calcsize(kind) :]


def damaged_ply(data: bytes, random: Random) -> bytes:
    """Words of the header, numbers behind it, or any bytes."""
    action = random.randrange(4)
    if action == 0:
        return damaged_file(data, random)
    if action == 1:
        at = random.randrange(data.find(b"end_header"), len(data) + 1)
        return with_lie(data, at, random)
    return damaged_text(data, random, until=b"end_header")


def damaged_ascii_ply(data: bytes, random: Random) -> bytes:
    return damaged_text(data, random) if random.random() < 0.4 else damaged_ply(data, random)


def damaged_colmap(data: bytes, random: Random) -> bytes:
    """A count, an id, a double or a name of a binary model."""
    action = random.randrange(5)
    if action == 0:
        return damaged_file(data, random)
    if action == 1:
        return random.choice(LIES).to_bytes(8, "little") + data[8:]
    if action == 2:
        at = random.randrange(0, max(1, len(data) - 8), 4)
        return data[:at] + pack_double(random.choice(DOUBLES)) + data[at + 8 :]
    if action == 3 and b".jpg\0" in data:
        name = random.choice((b"", b"/", b"../x", b"n" * 300, b"\xff\xfe", b"\x1b[31m", b"a\nb", b"/dev/zero"))
        at = data.index(b".jpg\0") - 1
        return data[:at] + name + data[at + 5 :]
    at = random.randrange(8, max(9, len(data)), 4)
    return with_lie(data, at, random)


# Tensors.


def damaged_tensors(data: bytes, random: Random) -> bytes:
    """A file of torch.save with another structure, other shapes and types, or more in it than it looks like."""
    action = random.randrange(10)
    if action < 2:
        return damaged_file(data, random)
    if action == 2:
        return random.choice((_bomb, _pickled_call))(data, random)
    tree = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    for _ in range(random.choice((1, 1, 2))):
        tree = damaged_tree(tree, random, _tensor_value)
    stream = io.BytesIO()
    torch.save(_storable(tree), stream)
    return stream.getvalue()


def _tensor_value(random: Random) -> Any:
    tensors = (
        *(torch.zeros(0), torch.zeros(()), torch.zeros(3), torch.zeros(2, 3), torch.zeros(8, 3, dtype=torch.int64)),
        *(torch.zeros(8, 3, dtype=torch.bool), torch.full((8, 3), torch.nan), torch.zeros(8, 3, dtype=torch.float16)),
        *(torch.zeros(1).expand(3 * 10**9), torch.zeros(1, 1, 1).expand(10**9, 1, 3), torch.zeros(8, 1, 3).to_sparse()),
        *(torch.zeros(5056, dtype=torch.uint8), torch.zeros(8, 3, dtype=torch.complex64)),
    )
    return random.choice(tensors) if random.random() < 0.5 else any_value(random)


def _storable(tree: Any) -> Any:
    """What `torch.save` can write: texts that stand for what JSON cannot say become plain ones."""
    if isinstance(tree, dict):
        return {str(key) if isinstance(key, str) else key: _storable(value) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_storable(value) for value in tree]
    if isinstance(tree, str):
        text = str(tree)[:1000].encode("utf-8", "replace").decode()
        return float(text) if text in ("NaN", "Infinity", "-Infinity") else text
    return tree


def _bomb(data: bytes, random: Random) -> bytes:
    return _packed_zeros()


@cache
def _packed_zeros() -> bytes:
    """A checkpoint of one tensor whose zeros are packed: `LARGE` bytes in a file of a few megabytes."""
    count, announced = 1_234_567, LARGE // 4
    stream = io.BytesIO()
    torch.save({"level": 0, "state": {"model": torch.zeros(count)}}, stream)
    target = io.BytesIO()
    with (
        zipfile.ZipFile(stream) as source,
        zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed,
    ):
        for entry in source.infolist():
            content = source.read(entry)
            if entry.filename.endswith("/data.pkl"):
                content = content.replace(struct.pack("<i", count), struct.pack("<i", announced))
            if len(content) < 4 * count:
                packed.writestr(entry.filename, content)
                continue
            with packed.open(entry.filename, "w", force_zip64=True) as out:
                for _ in range(LARGE // 16_000_000):
                    out.write(bytes(16_000_000))
    return target.getvalue()


class _Call:
    def __reduce__(self) -> Any:
        return (print, ("a checkpoint was executed",))


def _pickled_call(data: bytes, random: Random) -> bytes:
    return pickle.dumps({"level": 0, "state": _Call()}, protocol=2)


# Stores of results.


def damaged_store(data: bytes, random: Random) -> bytes:
    """A cell with another value or damaged JSON, a table or column that is gone, or any bytes."""
    if random.random() < 0.35:
        return damaged_file(data, random)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "store"
        path.write_bytes(data)
        connection = sqlite3.connect(path)
        try:
            _damage_cell(connection, random)
            connection.commit()
        finally:
            connection.close()
        return path.read_bytes()


def _damage_cell(connection: sqlite3.Connection, random: Random) -> None:
    if random.random() < 0.1:
        connection.execute(
            random.choice(("DROP TABLE runs", "DROP TABLE about", "ALTER TABLE runs DROP COLUMN record"))
        )
        return
    if random.random() < 0.1:
        connection.execute("UPDATE about SET value = ?", (random.choice(("2", "", "x", b"\xff\xfe")),))
        return
    column = random.choice(("job", "record", "record", "record", "state", "error", "position", "run_id"))
    (row, before), *_ = connection.execute(f"SELECT rowid, {column} FROM runs").fetchall()
    if column in ("job", "record") and random.random() < 0.8:
        after: Any = as_json(damaged_tree(json.loads(before), random)).encode("utf-8", "surrogatepass")
        after = after.decode("utf-8", "replace")
    else:
        after = random.choice((b"\xff\xfe", 5, 1.5, "", "x", "{", "[]", "null", "9" * 5000))
    connection.execute(f"UPDATE runs SET {column} = ? WHERE rowid = ?", (after, row))


def damaged_lines(data: bytes, random: Random) -> bytes:
    """JSON lines, one of them with other values, another type, or bytes that are no text."""
    lines = data.split(b"\n")[:-1]
    at = random.randrange(len(lines))
    action = random.randrange(4)
    if action == 0:
        return damaged_bytes(data, random)
    if action == 1:
        lines[at] = random.choice(
            (b"null", b"[]", b"5", b"{}", b'"x"', b"", b"\xff", b"{", b"[" * 200_000, b"9" * 5000)
        )
    else:
        damaged = damaged_tree(json.loads(lines[at]), random)
        lines[at] = as_json(damaged).encode("utf-8", "surrogatepass")
    return b"\n".join(lines) + b"\n"
