"""Store images of views on the GPU, in memory or on the disk, and return them on the training device.

`ImageStore.put` encodes an image once, and every `get` decodes it on the device. Until then only its stored bytes are
copied, a quarter of float32 for 8-bit photographs:

    "gpu"     bytes on the device
    "memory"  bytes in memory; for a GPU page-locked, so that the GPU copies them while it and the processor work
    "disk"    one file for each image; a thread of the store reads it into page-locked memory, and then as above.
              `put_reader` takes a function in place of the image, such as one that decodes a photo's own file

`prefetch` starts the copy early, and `get` waits for it by an event in the GPU's own queue of work.
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
from typing import SupportsInt

import torch
from torch import Tensor

from lapgs_plugin.errors import TrainingDivergedError, UserInputError
from lapgs_plugin.files import one_line_errors
from lapgs_plugin.hierarchy.settings import AUTO, PLACES, PRECISIONS
from lapgs_plugin.limits import usable_processors, use_one_torch_thread
from lapgs_plugin.ops.mixed_sizes import stack_padded

DTYPES: dict[str, torch.dtype] = {name: getattr(torch, name) for name in PRECISIONS}

GPU_LIMIT = 1 << 30
"""Most bytes of a stage's images that `choose_place` keeps on a GPU of any size."""
GPU_SHARE = 0.1
"""Largest share of the GPU's memory for these images; the rest is for Gaussians and their training."""

EIGHT_BIT_TOLERANCE = 1e-6
"""Largest distance from k/255 of a value of an 8-bit image: a GPU multiplies by 1/255, which may be an ulp off."""
AHEAD = 24
"""Most prefetched images that wait on the device; one more replaces the oldest, which may never be used."""
AHEAD_BYTES = 2 << 30
"""Most bytes of them, of which one may have more."""
LOADERS = 4
"""Fewest threads that read files. Some read while the image of another is being copied."""
MOST_LOADERS = 16
"""Most threads that read files or decode photos, one for each processor; fewer than `AHEAD`, so that some are ready."""


def choose_place(total_bytes: int, device: torch.device | str) -> str:
    """Choose where to keep so many bytes of images: "gpu" if they are a small part of its memory, else "memory"."""
    if torch.device(device).type != "cuda":
        return "memory"
    available = torch.cuda.get_device_properties(torch.device(device)).total_memory
    return "gpu" if total_bytes <= min(GPU_LIMIT, GPU_SHARE * available) else "memory"


def chosen_precision(precision: str, device: torch.device | str) -> str:
    """Return the precision to store images in: as given, or the one that "auto" means on the training device."""
    if precision != AUTO:
        return precision
    return "float16" if torch.device(device).type == "cuda" else "float32"


def eight_bit_levels(image: Tensor) -> Tensor | None:
    """Return the uint8 levels k of a finite float32 image whose values are all k/255; None for any other image."""
    levels = (image * 255).round_()
    low, high, distance = torch.stack([*levels.aminmax(), (levels / 255).sub_(image).abs_().amax()]).tolist()
    return levels.to(torch.uint8) if low >= 0 and high <= 255 and distance <= EIGHT_BIT_TOLERANCE else None


@dataclass(frozen=True)
class _Image:
    """Hold an encoded image: value = stored / divisor + low, or `stored` itself where `divisor` is None.

    Attributes:
        shape: (channels, h, w).
        divisor: 0-dimensional, on the training device. A tensor, because GPUs replace the division by a number with a
            multiplication by its reciprocal, which gives other values than decoding the photograph did.
        low: value of a stored 0.
        stored: the bytes on the device or in memory; None on disk.
        path: the file; None elsewhere.
        read: returns the stored bytes, for an image that is neither in memory nor in a file of the store.
        page_locked: keeps `stored` page-locked.
    """

    shape: torch.Size
    divisor: Tensor | None
    low: float
    stored: Tensor | None = None
    path: Path | None = None
    read: Callable[[], Tensor] | None = None
    page_locked: PageLocked | None = None


@dataclass(frozen=True)
class _Arrival:
    """Hold stored bytes that were copied to the device, complete once `event` has happened; None needs no waiting."""

    stored: Tensor
    event: torch.cuda.Event | None


class ImageStore:
    """Store images by name. Only one thread may use it.

    Args:
        where: "gpu", "memory" or "disk".
        precision: of stored values. "float32" is exact. "uint8" is exact for images whose values are all k/255; the
            range of any other image, which may exceed [0, 1], is divided into 256 steps.
        device: of returned tensors, a CPU or CUDA one.
        folder: for "disk", the folder of the files; made here and removed by `close`.

    Raises:
        UserInputError: an unknown place or precision, "gpu" without one, or "disk" without a folder.
    """

    def __init__(
        self, where: str, precision: str, *, device: torch.device | str = "cpu", folder: Path | None = None
    ) -> None:
        places = PLACES if torch.device(device).type == "cuda" else PLACES[1:]
        if where not in places:
            raise UserInputError(f"images cannot be kept on {where}: expected {' or '.join(places)}")
        if precision not in PRECISIONS:
            raise UserInputError(f"images cannot be stored as {precision}: expected {', '.join(PRECISIONS)}")
        if where == "disk" and folder is None:
            raise UserInputError("images on disk: expected the folder to write them to; pass folder=")
        self._where = where
        self._dtype = DTYPES[precision]
        self._device = torch.device(device)
        self._folder = folder.absolute() if folder is not None and where == "disk" else None
        self._images: dict[str, _Image] = {}
        self._coming: dict[str, Future[_Arrival]] = {}
        self._stream = (
            torch.cuda.Stream(self._device)  # type: ignore[no-untyped-call]  # torch leaves these without annotations
            if self._device.type == "cuda"
            else None
        )
        self._loaders = ThreadPoolExecutor(
            max_workers=max(LOADERS, min(MOST_LOADERS, usable_processors())),
            thread_name_prefix="image-store",
            initializer=use_one_torch_thread,
        )
        self._staging = threading.local()
        self._255 = torch.tensor(255.0, device=self._device)

    def put(self, name: str, image: Tensor) -> None:
        """Store a copy of an image of a view, (3, h, w) or (1, h, w) of any float type; it replaces an earlier one.

        Raises:
            TrainingDivergedError: it holds NaN or inf, or values beyond float16 if that is the precision.
            RunFolderError: the disk is full or the folder not writable.
            UserInputError: it is not of floats, or there is not enough memory to page-lock.
        """
        if not image.is_floating_point():
            raise UserInputError(
                f"the image of view {name} is of {image.dtype}: expected floats; divide levels from 0 to 255 by 255.0"
            )
        encoded, low, divisor = self._encode(name, image.detach())
        if (coming := self._coming.pop(name, None)) is not None:
            wait([coming])
        self._images[name] = self._keep(name, encoded, low, divisor)

    def put_reader(self, name: str, shape: tuple[int, int, int], read: Callable[[], Tensor]) -> None:
        """Store an image as a function that threads call at each use. It takes no memory between uses, and no disk.

        Args:
            name: of the view; an earlier image is replaced.
            shape: (c, h, w).
            read: returns the image in the store's precision, on the CPU: as it is, or for "uint8" the levels k of
                k / 255. The fastest layout for a GPU has channels last. `get` raises its errors.
        """
        assert self._where == "disk", "elsewhere images are kept"
        if (coming := self._coming.pop(name, None)) is not None:
            wait([coming])
        divisor = self._255 if self._dtype == torch.uint8 else None
        self._images[name] = _Image(torch.Size(shape), divisor, 0.0, read=read)

    def prefetch(self, name: str) -> None:
        """Start copying an image to the device in the background, where it waits for `get`.

        At most `AHEAD` images and `AHEAD_BYTES` wait; an older one is copied again by `get`.

        Raises:
            KeyError: there is no such image.
        """
        image = self._images[name]
        if name in self._coming or self._at_hand(image):
            return
        if image.stored is None:
            self._coming[name] = self._loaders.submit(self._read, image)
        else:
            self._coming[name] = Future()
            self._coming[name].set_result(self._bring(image.stored))
        while len(self._coming) > 1 and (len(self._coming) > AHEAD or self._bytes_coming > AHEAD_BYTES):
            self._coming.pop(next(iter(self._coming))).cancel()

    def get(self, *names: str) -> Tensor:
        """Return images on the device, float32, for the current stream: (c, h, w) of one view, (b, c, h, w) of several.

        Do not modify them. The processor waits only for a file that is still being read. Views of several sizes are
        padded at the right and below. They are decoded together if they are encoded alike.

        Raises:
            KeyError: there is no such image.
            RunFolderError: its file cannot be read any more.
            Exception: that of the function of `put_reader`.
        """
        first, *others = (self._images[name] for name in names)
        if any(image.low != first.low or image.divisor is not first.divisor for image in others):
            return stack_padded([self.get(name) for name in names])
        return _decode(self._all_arrived(names), first)

    def get_stored(self, *names: str) -> Tensor:
        """Like `get`, without conversion to float32: float16 stays, 8-bit images stay uint8 (k of k / 255)."""
        divisors = [self._images[name].divisor for name in names]
        as_stored = all(divisor is None or divisor is self._255 for divisor in divisors)
        return self._all_arrived(names) if as_stored else self.get(*names)

    @property
    def where(self) -> str:
        """One of `PLACES`."""
        return self._where

    def __len__(self) -> int:
        return len(self._images)

    def __contains__(self, name: object) -> bool:
        return name in self._images

    @property
    def bytes_on_device(self) -> int:
        """Bytes on the GPU: images stored there, or prefetched ones."""
        if self._stream is None:
            return 0
        return sum(map(self._num_bytes, self._images.values())) if self._where == "gpu" else self._bytes_coming

    @property
    def _bytes_coming(self) -> int:
        """Bytes of prefetched images."""
        return sum(self._num_bytes(self._images[name]) for name in self._coming)

    def close(self) -> None:
        """Drop all images and remove the files."""
        self._loaders.shutdown(wait=True, cancel_futures=True)
        if self._where == "gpu":
            torch.cuda.synchronize(self._device)  # any stream may still read the memory that is freed now
        self._coming.clear()
        self._images.clear()
        if self._folder is not None and self._folder.is_dir():
            shutil.rmtree(self._folder)

    def __enter__(self) -> ImageStore:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _all_arrived(self, names: Sequence[str]) -> Tensor:
        """Return the stored bytes of images on the device, with a leading dimension if there are several."""
        stored = [self._arrived(name) for name in names]
        return stored[0] if len(stored) == 1 else stack_padded(stored)

    def _arrived(self, name: str) -> Tensor:
        """Return the stored bytes of an image on the device, for the current stream."""
        image = self._images[name]
        if self._at_hand(image):
            assert image.stored is not None
            return image.stored
        self.prefetch(name)
        arrival = self._coming.pop(name).result()
        if arrival.event is not None:
            stream = torch.cuda.current_stream(self._device)
            stream.wait_event(arrival.event)
            # The tensor belongs to another stream: its memory must not be reused before this one has read it.
            arrival.stored.record_stream(stream)
        return arrival.stored

    def _at_hand(self, image: _Image) -> bool:
        """Return whether the stored bytes are on the device already."""
        return image.stored is not None and (self._where == "gpu" or self._stream is None)

    def _num_bytes(self, image: _Image) -> int:
        return math.prod(image.shape) * self._dtype.itemsize

    def _encode(self, name: str, values: Tensor) -> tuple[Tensor, float, Tensor | None]:
        """Return an image as stored, with `low` and `divisor` of `_Image`. Computed on the image's device."""
        if self._dtype != torch.uint8:
            encoded = values.to(self._dtype)
            self._finite_range(name, encoded)
            return encoded, 0.0, None
        values = values.to(torch.float32)
        low, high = self._finite_range(name, values)
        if (levels := eight_bit_levels(values)) is not None:
            return levels, 0.0, self._255
        # A range too small to divide by is stored as its lower end.
        divisor = 255 / (high - low) if high - low > 1e-30 else 0.0
        encoded = (values - low).mul_(divisor).round_().to(torch.uint8)
        return encoded, low, torch.tensor(divisor or 1.0, device=self._device)

    def _finite_range(self, name: str, values: Tensor) -> tuple[float, float]:
        low, high = torch.stack(values.aminmax()).tolist()  # one wait for the GPU instead of two
        if not math.isfinite(low) or not math.isfinite(high):
            bad = "NaN, inf or values beyond 65504" if self._dtype == torch.float16 else "NaN or inf"
            raise TrainingDivergedError(
                f"the image of view {name} holds {bad}, expected finite values; the levels finished before are kept"
            )
        return low, high

    def _keep(self, name: str, encoded: Tensor, low: float, divisor: Tensor | None) -> _Image:
        """Copy an encoded image to its place."""
        if self._folder is not None:
            return _Image(encoded.shape, divisor, low, path=self._write(name, encoded.cpu()))
        page_locked = None
        if self._where == "gpu":
            stored = torch.empty(encoded.shape, dtype=self._dtype, device=self._device).copy_(encoded)
            torch.cuda.current_stream(self._device).synchronize()  # from now on any stream may read it
        elif self._stream is not None:
            page_locked = PageLocked(encoded.nbytes, self._device)
            stored = page_locked.view(encoded.shape, self._dtype).copy_(encoded)
        else:
            stored = torch.empty(encoded.shape, dtype=self._dtype).copy_(encoded)
        return _Image(encoded.shape, divisor, low, stored=stored, page_locked=page_locked)

    def _write(self, name: str, encoded: Tensor) -> Path:
        assert self._folder is not None
        known = self._images.get(name)
        # Numbered, because names of views may contain slashes or other characters that a file system refuses.
        path = known.path if known and known.path else self._folder / f"{len(self._images):06d}.bin"
        with one_line_errors(path, training=True):
            self._folder.mkdir(parents=True, exist_ok=True)
            try:
                path.write_bytes(tensor_bytes(encoded.contiguous()))
            except OSError:
                path.unlink(missing_ok=True)  # half an image is useless and keeps a full disk full
                raise
        return path

    def _bring(self, stored: Tensor) -> _Arrival:
        """Copy page-locked bytes to the GPU while it works, which makes them contiguous."""
        with torch.cuda.stream(self._stream):
            arriving = stored.to(self._device, non_blocking=True).contiguous()
            event = torch.cuda.Event(blocking=True)  # type: ignore[no-untyped-call]
            event.record()
        return _Arrival(arriving, event)

    def _read(self, image: _Image) -> _Arrival:
        """Read an image and copy it to the device; runs in a loader thread."""
        if image.read is not None:
            values = image.read()
            assert (values.shape, values.dtype) == (image.shape, self._dtype)
            if self._stream is None:
                return _Arrival(values.contiguous(), None)
            channels, height, width = image.shape
            # Decoders put channels last. Moving them takes a processor as long as decoding; the GPU does it.
            staged = self._staged(image).view(height, width, channels).permute(2, 0, 1).copy_(values)
        else:
            assert image.path is not None
            staged = torch.empty(image.shape, dtype=self._dtype) if self._stream is None else self._staged(image)
            _read_file(image.path, staged)
            if self._stream is None:
                return _Arrival(staged, None)
        arrival = self._bring(staged)
        assert arrival.event is not None
        arrival.event.synchronize()  # the thread reads its next image into the same memory
        return arrival

    def _staged(self, image: _Image) -> Tensor:
        """Return page-locked memory of this loader thread for an image from the disk."""
        page_locked: PageLocked | None = getattr(self._staging, "page_locked", None)
        if page_locked is None or page_locked.num_bytes < self._num_bytes(image):
            page_locked = self._staging.page_locked = PageLocked(self._num_bytes(image), self._device)
        return page_locked.view(image.shape, self._dtype)


class PageLocked:
    """Allocate memory that a GPU can copy from by itself while the processor works.

    Its pages are registered with the driver. torch's allocator of page-locked memory rounds every size up to a power of
    two and never frees it.

    Raises:
        UserInputError: the driver refuses.
    """

    def __init__(self, num_bytes: int, device: torch.device) -> None:
        self.num_bytes = num_bytes
        page = mmap.PAGESIZE
        room = torch.empty(num_bytes + 2 * page, dtype=torch.uint8)
        # Whole pages: two registrations must not share one.
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
        release.atexit = False  # the process releases it at its end, when the driver may be gone

    def view(self, shape: torch.Size, dtype: torch.dtype) -> Tensor:
        """Return its beginning as a tensor, which does not keep it page-locked."""
        return self._bytes[: math.prod(shape) * dtype.itemsize].view(dtype).view(shape)


def _release(room: Tensor, address: int, device: torch.device, unregister: Callable[[int], SupportsInt]) -> None:
    """Release page-locked memory; `room` is an argument so that it outlives its registration."""
    with contextlib.suppress(RuntimeError):  # a GPU that failed copies nothing
        torch.cuda.synchronize(device)  # a copy may be in progress
    if int(unregister(address)) != 0:
        _forget_refusal(device)


def _forget_refusal(device: torch.device) -> None:
    """Clear the CUDA runtime's last error, a call of this thread that it refused.

    The error stays until it is read. PyTorch reads it after each launch, so an unrelated launch would raise. PyTorch
    cannot just read it, and a second copy of the runtime has an error of its own; so a small launch reads it here.
    """
    with contextlib.suppress(RuntimeError):
        torch.ones((), device=device)


def tensor_bytes(tensor: Tensor) -> memoryview:
    """Return the bytes of a contiguous CPU tensor, to read or write."""
    return tensor.view(-1).view(torch.uint8).numpy().data


def _read_file(path: Path, stored: Tensor) -> None:
    with one_line_errors(path, "read"), path.open("rb") as stream:
        if stream.readinto(tensor_bytes(stored)) != stored.nbytes:
            raise OSError(errno.EIO, os.strerror(errno.EIO))


def _decode(stored: Tensor, image: _Image) -> Tensor:
    """Return a float32 image from its stored bytes, in the current stream."""
    if image.divisor is None:
        return stored.float()
    values = torch.div(stored, image.divisor)  # float32
    if image.low:
        values += image.low
    return values
