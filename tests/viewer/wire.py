"""A client of viser's web socket without a browser: it sends its camera and receives pictures.

To the server go single messages in MessagePack. From it come two sizes (little endian, 8 bytes each) and a list of
messages in MessagePack, compressed with Zstandard.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import msgspec.msgpack
import viser
import zstandard
from websockets.sync.client import ClientConnection, connect


@dataclass
class WireClient:
    """A connected client.

    Attributes:
        size: (width, height) of its window.
        pictures: received JPEG files in order, each with its time by time.perf_counter().
        words: received Markdown texts and labels.
    """

    connection: ClientConnection
    size: tuple[int, int]
    pictures: list[tuple[float, bytes]] = field(default_factory=list)
    words: list[str] = field(default_factory=list)

    def look_from(self, x: float, y: float, z: float) -> None:
        """Move the camera there, looking along +z with y down."""
        width, height = self.size
        message = {
            **{"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (x, y, z), "fov": 0.9, "near": 0.01, "far": 1000.0},
            **{
                "image_height": height,
                "image_width": width,
                "look_at": (x, y, z + 4),
                "up_direction": (0.0, -1.0, 0.0),
            },
        }
        self.connection.send(msgspec.msgpack.encode({**message, "type": "ViewerCameraMessage"}))

    def listen(self, seconds: float, pictures: int | None = None) -> int:
        """Receive for so many seconds, or until so many pictures have arrived; return the number of pictures."""
        deadline, before = time.perf_counter() + seconds, len(self.pictures)
        while (left := deadline - time.perf_counter()) > 0:
            try:
                raw = self.connection.recv(timeout=left)
            except TimeoutError:
                break
            for message in _messages(raw):
                self._take(message)
            if pictures is not None and len(self.pictures) - before >= pictures:
                break
        return len(self.pictures) - before

    def _take(self, message: dict[str, Any]) -> None:
        if message["type"] == "BackgroundImageMessage" and message["rgb_data"] is not None:
            self.pictures.append((time.perf_counter(), message["rgb_data"]))
        for value in (message.get("updates"), message.get("props")):
            if isinstance(value, dict):
                self.words += [text for key in ("_markdown", "label", "content") if (text := value.get(key))]


def _messages(raw: bytes | str) -> list[dict[str, Any]]:
    assert isinstance(raw, bytes)
    compressed = int.from_bytes(raw[8:16], "little")
    content = zstandard.ZstdDecompressor().decompress(raw[16 : 16 + compressed])
    messages: list[dict[str, Any]] = msgspec.msgpack.decode(content)["messages"]
    return messages


@contextmanager
def wire_client(address: str, size: tuple[int, int] = (320, 240)) -> Iterator[WireClient]:
    """Connect as the page does, until the block ends."""
    with connect(
        address.replace("http:", "ws:"),
        subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]  # a NewType of str
        max_size=None,
        compression=None,
    ) as connection:
        client = WireClient(connection, size)
        client.look_from(0.0, 0.0, -4.0)
        yield client
