"""Images of views, kept where they cost least and handed out on the training device: level targets and predictions.

An image is encoded once, by `ImageStore.put`, and decoded on the device by every `get`. Until then only its stored
bytes move, which for 8-bit photographs is a quarter of what float32 would be:

    "gpu"     bytes on the device
    "memory"  bytes in memory; for a GPU page-locked, so that the GPU can copy them while it and the processor work on
    "disk"    a file an image; a thread of the store reads it into page-locked memory, and from there as above

`announce` starts that journey early and `get` waits for its end by an event in the GPU's own queue of work.
"""

from __future__ import annotations

import contextlib
import errno
import math
import mmap
import os
import shutil
import threading
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import SupportsInt

import torch
from torch import Tensor

from lapgs_plugin.errors import TrainingDivergedError, UserInputError
from lapgs_plugin.files import one_line_errors
from lapgs_plugin.hierarchy.settings import AUTO, PLACES

PRECISIONS = {"float32": torch.float32, "float16": torch.float16, "uint8": torch.uint8}

GPU_LIMIT = 1 << 30
"""Bytes of a stage's images that `place` keeps on a GPU at most, however large it is."""
GPU_SHARE = 0.1
"""The same as a share of the GPU's memory: the rest is for Gaussians and what they need to be trained."""

EIGHT_BIT_TOLERANCE = 1e-6
"""How far from k/255 a value may be for its image to count as 8-bit: a GPU multiplies by 1/255, an ulp beside k/255."""
AHEAD = 8
"""Announced images that wait on the device; another one takes the place of the oldest, which may never be fetched."""
LOADERS = 2
"""Threads that read files: one can read while the copy of the other's image is under way."""


def place(total_bytes: int, device: torch.device | str) -> str:
    """Where images of that many stored bytes, with all that are needed beside them, cost least: "gpu" while they are a
    small part of it, or "memory"."""
    if torch.device(device).type != "cuda":
        return "memory"
    available = torch.cuda.get_device_properties(torch.device(device)).total_memory
    return "gpu" if total_bytes <= min(GPU_LIMIT, GPU_SHARE * available) else "memory"


def chosen_precision(precision: str, device: torch.device | str) -> str:
    """Return a precision that images are stored in: as given, or what "auto" means on the device that looks at them."""
    if precision != AUTO:
        return precision
    return "float16" if torch.device(device).type == "cuda" else "float32"


@dataclass(frozen=True)
class _Image:
    """An encoded image: value = stored / divisor + low, or `stored` itself where `divisor` is None.

    Attributes:
        shape: (channels, h, w).
        divisor: 0-dimensional, on the training device. A tensor, because GPUs replace a division by a number with a
            multiplication by its reciprocal, which is not what a photograph was decoded with.
        low: value of a stored 0.
        stored: the bytes on the device or in memory; None on disk.
        path: the file; None elsewhere.
        page_locked: what keeps `stored` page-locked.
    """

    shape: torch.Size
    divisor: Tensor | None
    low: float
    stored: Tensor | None = None
    path: Path | None = None
    page_locked: _PageLocked | None = None


@dataclass(frozen=True)
class _Arrival:
    """Stored bytes that were brought to the device.

    Attributes:
        stored: complete once `event` has happened.
        event: in the store's stream; None where there is nothing to wait for.
    """

    stored: Tensor
    event: torch.cuda.Event | None


class ImageStore:
    """Images by name. One thread puts, announces and gets.

    Args:
        where: "gpu", "memory" or "disk".
        precision: what a value is stored as. "float32" is exact. "uint8" is exact for images of which all values are
            k/255, and 256 steps over the range of each other image (predictions are not confined to [0, 1]).
        device: of the tensors handed out, a CPU or CUDA one.
        folder: for "disk", where to keep the files; made here and removed by `close`.

    Raises:
        UserInputError: an unknown place or precision, or "gpu" without one.
    """

    def __init__(
        self, where: str, precision: str, *, device: torch.device | str = "cpu", folder: Path | None = None
    ) -> None:
        self.check(where, precision, device)
        assert where != "disk" or folder is not None, "a store on disk needs a folder"
        self._where = where
        self._dtype = PRECISIONS[precision]
        self._device = torch.device(device)
        self._folder = folder if where == "disk" else None
        self._images: dict[str, _Image] = {}
        self._coming: dict[str, Future[_Arrival]] = {}
        self._stream = (
            torch.cuda.Stream(self._device)  # type: ignore[no-untyped-call]  # torch leaves these without annotations
            if self._device.type == "cuda"
            else None
        )
        self._loaders = ThreadPoolExecutor(max_workers=LOADERS, thread_name_prefix="image-store")
        self._staging = threading.local()
        self._255 = torch.tensor(255.0, device=self._device)

    @staticmethod
    def check(where: str, precision: str, device: torch.device | str = "cpu") -> None:
        """Raise what the constructor would about its arguments."""
        places = PLACES if torch.device(device).type == "cuda" else PLACES[1:]
        if where not in places:
            raise UserInputError(f"images cannot be kept on {where}: expected {' or '.join(places)}")
        if precision not in PRECISIONS:
            raise UserInputError(f"images cannot be stored as {precision}: expected {', '.join(PRECISIONS)}")

    def put(self, name: str, image: Tensor) -> None:
        """Keep an image, in place of what was kept under the name before.

        Args:
            name: of the view.
            image: (3, h, w) or (1, h, w), any float type and device, not clamped. Copied.

        Raises:
            TrainingDivergedError: it holds NaN or inf, or values beyond float16 where that is the precision.
            RunFolderError: the disk is full or the folder not writable.
            UserInputError: there is not enough memory to page-lock.
        """
        encoded, low, divisor = self._encode(name, image.detach())
        if (coming := self._coming.pop(name, None)) is not None:
            wait([coming])
        self._images[name] = self._keep(name, encoded, low, divisor)

    def prefetch(self, name: str) -> None:
        """Start bringing an image to the device, in the background, where it lies until it is fetched.

        At most `AHEAD` images do; `get` has to bring an older one again.

        Raises:
            KeyError: it was never put.
        """
        image = self._images[name]
        if name in self._coming or self._at_hand(image):
            return
        if image.stored is None:
            self._coming[name] = self._loaders.submit(self._read, image)
        else:
            self._coming[name] = Future()
            self._coming[name].set_result(self._bring(image.stored))
        if len(self._coming) > AHEAD:
            self._coming.pop(next(iter(self._coming))).cancel()

    def get(self, name: str) -> Tensor:
        """An image on the device, float32, for the stream that is current; not to be modified.

        The processor waits for nothing but a file that is still being read.

        Args:
            name: of the view.

        Raises:
            KeyError: it was never put.
            RunFolderError: its file cannot be read any more.
        """
        return _decode(self._arrived(name), self._images[name])

    def get_batch(self, names: Sequence[str]) -> Tensor:
        """(b, c, h, w) several images of one size; see `get`. Those that are encoded alike are decoded together."""
        images = [self._images[name] for name in names]
        first = images[0]
        if any(image.low != first.low or image.divisor is not first.divisor for image in images):
            return torch.stack([self.get(name) for name in names])
        return _decode(torch.stack([self._arrived(name) for name in names]), first)

    @property
    def where(self) -> str:
        """One of `PLACES`."""
        return self._where

    @property
    def names(self) -> tuple[str, ...]:
        """In the order in which they were first put."""
        return tuple(self._images)

    def __len__(self) -> int:
        return len(self._images)

    def __contains__(self, name: object) -> bool:
        return name in self._images

    @property
    def bytes_on_device(self) -> int:
        """Bytes on the GPU: images kept there and those announced."""
        return self._bytes_kept("gpu") + (0 if self._stream is None else self._bytes_prefetched())

    @property
    def bytes_in_memory(self) -> int:
        """Bytes in the computer's memory: images kept there, and on a CPU those announced."""
        return self._bytes_kept("memory") + (self._bytes_prefetched() if self._stream is None else 0)

    @property
    def bytes_on_disk(self) -> int:
        return self._bytes_kept("disk")

    def close(self) -> None:
        """Forget everything and remove the files."""
        self._loaders.shutdown(wait=True, cancel_futures=True)
        if self._where == "gpu":
            torch.cuda.synchronize(self._device)  # any stream may still be reading what is given back now
        self._coming.clear()
        self._images.clear()
        if self._folder is not None and self._folder.is_dir():
            shutil.rmtree(self._folder)

    def __enter__(self) -> ImageStore:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _arrived(self, name: str) -> Tensor:
        """The stored bytes of an image on the device, for the stream that is current."""
        image = self._images[name]
        if self._at_hand(image):
            assert image.stored is not None
            return image.stored
        self.prefetch(name)
        arrival = self._coming.pop(name).result()
        if arrival.event is not None:
            stream = torch.cuda.current_stream(self._device)
            stream.wait_event(arrival.event)
            # The tensor belongs to another stream: its memory is not to be given away before this one is done with it.
            arrival.stored.record_stream(stream)
        return arrival.stored

    def _at_hand(self, image: _Image) -> bool:
        """Whether the stored bytes lie on the device already."""
        return image.stored is not None and (self._where == "gpu" or self._stream is None)

    def _bytes_kept(self, where: str) -> int:
        return sum(self._num_bytes(image) for image in self._images.values()) if where == self._where else 0

    def _bytes_prefetched(self) -> int:
        return sum(self._num_bytes(self._images[name]) for name in self._coming)

    def _num_bytes(self, image: _Image) -> int:
        return math.prod(image.shape) * self._dtype.itemsize

    def _encode(self, name: str, values: Tensor) -> tuple[Tensor, float, Tensor | None]:
        """An image as stored, with `low` and `divisor` of `_Image`. Computed where the image is."""
        if self._dtype != torch.uint8:
            encoded = values.to(self._dtype)
            self._finite_range(name, encoded)
            return encoded, 0.0, None
        values = values.to(torch.float32)
        low, high = self._finite_range(name, values)
        if low > -EIGHT_BIT_TOLERANCE and high < 1 + EIGHT_BIT_TOLERANCE:
            levels = (values * 255).round_()
            if float((levels / 255).sub_(values).abs_().amax()) <= EIGHT_BIT_TOLERANCE:
                return levels.to(torch.uint8), 0.0, self._255
        # A range too small to divide by is stored as its lower end.
        divisor = 255 / (high - low) if high - low > 1e-30 else 0.0
        encoded = (values - low).mul_(divisor).round_().to(torch.uint8)
        return encoded, low, torch.tensor(divisor or 1.0, device=self._device)

    def _finite_range(self, name: str, values: Tensor) -> tuple[float, float]:
        low, high = torch.stack(values.aminmax()).tolist()  # one wait for the GPU instead of two
        if not math.isfinite(low) or not math.isfinite(high):
            what = "NaN, inf or values beyond 65504" if self._dtype == torch.float16 else "NaN or inf"
            raise TrainingDivergedError(
                f"the image of view {name} holds {what}, expected finite values; the levels finished before are kept"
            )
        return low, high

    def _keep(self, name: str, encoded: Tensor, low: float, divisor: Tensor | None) -> _Image:
        """Copy an encoded image to where it will stay."""
        if self._folder is not None:
            return _Image(encoded.shape, divisor, low, path=self._write(name, encoded.cpu()))
        page_locked = None
        if self._where == "gpu":
            stored = torch.empty(encoded.shape, dtype=self._dtype, device=self._device).copy_(encoded)
            torch.cuda.current_stream(self._device).synchronize()  # from here on any stream may read it
        elif self._stream is not None:
            page_locked = _PageLocked(encoded.nbytes, self._device)
            stored = page_locked.view(encoded.shape, self._dtype).copy_(encoded)
        else:
            stored = torch.empty(encoded.shape, dtype=self._dtype).copy_(encoded)
        return _Image(encoded.shape, divisor, low, stored=stored, page_locked=page_locked)

    def _write(self, name: str, encoded: Tensor) -> Path:
        assert self._folder is not None
        known = self._images.get(name)
        # Numbered, because view names may hold slashes or what a file system refuses.
        path = known.path if known and known.path else self._folder / f"{len(self._images):06d}.bin"
        with one_line_errors(path, training=True):
            self._folder.mkdir(parents=True, exist_ok=True)
            try:
                path.write_bytes(_buffer(encoded.contiguous()))
            except OSError:
                path.unlink(missing_ok=True)  # half an image would only keep a full disk full
                raise
        return path

    def _bring(self, stored: Tensor) -> _Arrival:
        """Copy page-locked bytes to the GPU beside whatever it is doing."""
        with torch.cuda.stream(self._stream):
            arriving = stored.to(self._device, non_blocking=True)
            event = torch.cuda.Event(blocking=True)  # type: ignore[no-untyped-call]
            event.record()
        return _Arrival(arriving, event)

    def _read(self, image: _Image) -> _Arrival:
        """Bring a file to the device; runs in a loader thread."""
        assert image.path is not None
        if self._stream is None:
            stored = torch.empty(image.shape, dtype=self._dtype)
            _read_file(image.path, stored)
            return _Arrival(stored, None)
        staged = self._staged(image)
        _read_file(image.path, staged)
        arrival = self._bring(staged)
        assert arrival.event is not None
        arrival.event.synchronize()  # the thread's next image will be read into the same memory
        return arrival

    def _staged(self, image: _Image) -> Tensor:
        """Page-locked memory of this loader thread for an image on its way from the disk."""
        page_locked: _PageLocked | None = getattr(self._staging, "page_locked", None)
        if page_locked is None or page_locked.num_bytes < self._num_bytes(image):
            page_locked = self._staging.page_locked = _PageLocked(self._num_bytes(image), self._device)
        return page_locked.view(image.shape, self._dtype)


class _PageLocked:
    """Memory that a GPU can copy from by itself while the processor goes on.

    Registered with the driver, page by page, instead of taken from torch's allocator of page-locked memory: that one
    rounds every size up to a power of two (21 MB of image become 34) and never gives anything back.

    Raises:
        UserInputError: the driver refuses.
    """

    def __init__(self, num_bytes: int, device: torch.device) -> None:
        self.num_bytes = num_bytes
        page = mmap.PAGESIZE
        room = torch.empty(num_bytes + 2 * page, dtype=torch.uint8)
        # Whole pages of our own: two registrations must not share one.
        start, length = -room.data_ptr() % page, -(-num_bytes // page) * page
        self._bytes = room[start : start + num_bytes]
        runtime = torch.cuda.cudart()  # type: ignore[no-untyped-call]
        address, portable = self._bytes.data_ptr(), 1
        result = runtime.cudaHostRegister(address, length, portable)
        if int(result) != 0:
            _forget_refusal(device)
            raise UserInputError(
                f"{num_bytes:,} more bytes of memory cannot be page-locked for images "
                f"({runtime.cudaGetErrorString(result)}); expected room for all of them; "
                "keep them on the disk or at a lower precision"
            )
        release = weakref.finalize(self, _release, room, address, device, runtime.cudaHostUnregister)
        release.atexit = False  # the end of the process releases it, and the driver may be gone by then

    def view(self, shape: torch.Size, dtype: torch.dtype) -> Tensor:
        """Its beginning as a tensor, which does not keep it page-locked."""
        return self._bytes[: math.prod(shape) * dtype.itemsize].view(dtype).view(shape)


def _release(room: Tensor, address: int, device: torch.device, unregister: Callable[[int], SupportsInt]) -> None:
    """Let go of page-locked memory; `room` is an argument so that it outlives its registration."""
    with contextlib.suppress(RuntimeError):  # a GPU that failed copies nothing any more
        torch.cuda.synchronize(device)  # a copy may be under way
    if int(unregister(address)) != 0:
        _forget_refusal(device)


def _forget_refusal(device: torch.device) -> None:
    """Let the CUDA runtime forget that it refused a call of this thread.

    It remembers until it is asked, and PyTorch asks after each of its launches: one that has nothing to do with it
    would raise. PyTorch has no binding to ask by, and a second copy of the runtime would not know, so a launch of
    nothing asks.
    """
    with contextlib.suppress(RuntimeError):
        torch.ones((), device=device)


def _buffer(tensor: Tensor) -> memoryview:
    """The bytes of a contiguous CPU tensor, to read from or write into."""
    return tensor.view(-1).view(torch.uint8).numpy().data


def _read_file(path: Path, stored: Tensor) -> None:
    with one_line_errors(path, "read"), path.open("rb") as stream:
        if stream.readinto(_buffer(stored)) != stored.nbytes:
            raise OSError(errno.EIO, os.strerror(errno.EIO))


def _decode(stored: Tensor, image: _Image) -> Tensor:
    """A float32 image from its stored bytes, in the current stream."""
    if image.divisor is None:
        return stored.float()
    values = torch.div(stored, image.divisor)  # float32
    if image.low:
        values += image.low
    return values
