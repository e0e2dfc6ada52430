"""Replay sorting and blending as CUDA graphs: the processor starts two graphs instead of some thirty launches.

A graph reads and writes the same memory each time. So projection writes to memory of a `Frame`, and its graphs sort and
blend in memory of their own. A frame renders one view at a time. The next one may come when the records of the view
before are gone: after its backward pass, or when its result was dropped. Other views are launched one by one meanwhile.

A frame also does what a view needs once: it sends the number of pairs to the processor, and zeroes the memory that the
backward pass adds gradients to.

A frame has room for more Gaussians and pairs than there are, so that densification seldom needs other graphs.
"""

from __future__ import annotations

import threading
import weakref
from collections import Counter
from collections.abc import Callable
from typing import Generic, TypeVar

import torch
from torch import Tensor

from lapgs_plugin.gpu_raster.arriving_number import ArrivingNumber, new_slot
from lapgs_plugin.gpu_raster.records import GRADIENT, MOST_OTHERS, RECORD, grid_of, state_of
from lapgs_plugin.gpu_raster.rules import Rules
from lapgs_plugin.gpu_raster.tiles import MOST_PAIRS, Blending, Tiles, blend_and_sum

T = TypeVar("T")
Destination = tuple[Tensor, Tensor, Tensor, Tensor]
"""Radii, centres, depths and records that projection writes, as in `records.Projected`."""

ENABLED = True
"""Whether views are replayed at all."""
REPEATED = 3
"""Views of the same kind from which on they are replayed."""
LEAST_GAUSSIANS = 2**14
"""Fewer are sorted by other launches."""
MOST_FRAMES = 2
"""Frames that are kept at a time."""
IDLE = 200
"""Views of other kinds after which a frame is dropped when another one is made."""
HEADROOM = 1.25
"""Room for pairs when a graph is recorded, by what is wanted."""
MOST_ROOM = 2.0
"""Room for Gaussians or pairs, by what is wanted, from which on less is reserved."""

_Kind = tuple[torch.device, int, tuple[int, int], Rules, float, bool]
_lock = threading.Lock()
_broken: list[object] = []  # recordings that failed, which PyTorch may still refer to


class _Frames:
    """Keep frames by the kind of views that they render."""

    def __init__(self) -> None:
        self._by_kind: dict[_Kind, Frame] = {}
        self._unframed: Counter[tuple[_Kind, int]] = Counter()  # views by kind and room
        self._last: dict[_Kind, int] = {}  # of how many views the last one of each frame was
        self._views = 0

    def get(self, kind: _Kind, n: int, like: Tensor) -> Frame | None:
        """Return a frame with room for n Gaussians, perhaps a new one; None for the first views of a kind."""
        self._views += 1
        frame = self._by_kind.get(kind)
        if frame is None or not n <= frame.room <= MOST_ROOM * n:
            frame, room = None, _room_for(n)  # one that is referred to here would keep its memory
            self._unframed[kind, room] += 1
            if self._unframed[kind, room] < REPEATED or not self._make_place(kind):
                return None
            self._unframed.clear()
            frame = self._by_kind[kind] = Frame(like, room, *kind[2:])
        self._last[kind] = self._views
        return frame

    def _make_place(self, kind: _Kind) -> bool:
        """Drop the frame of a kind and all that are idle; return False if there are too many others."""
        if torch.cuda.get_allocator_backend() != "native":  # others may move a graph's memory
            return False
        dropped = [other for other, last in self._last.items() if other == kind or self._views - last >= IDLE]
        for other in dropped:
            del self._by_kind[other], self._last[other]
        if dropped:
            torch.cuda.empty_cache()  # PyTorch uses memory of graphs for nothing else
        return len(self._by_kind) < MOST_FRAMES


_frames = _Frames()


def take_frame(
    like: Tensor, n: int, size: tuple[int, int], rules: Rules, mult: float, summed: bool, stream: int
) -> tuple[Frame, Destination] | None:
    """Return a frame for n Gaussians that nothing else uses, and where to project them.

    Args:
        like: a tensor of the Gaussians.
        size: (width, height).
        rules, mult: as `blend_kernels.blend_family` takes them.
        summed: whether sums over pixels are wanted.
        stream: the current one's number.

    Returns:
        None if the view has to be launched without a frame.
    """
    device = like.device
    if not ENABLED or n < LEAST_GAUSSIANS or device.type != "cuda" or torch.version.hip is not None or _broken:
        return None
    if device.index != torch.cuda.current_device() or torch.cuda.is_current_stream_capturing():
        return None
    if torch.is_inference_mode_enabled():  # memory that was reserved then could not be saved for a backward pass
        return None
    kind = device, stream, size, rules, mult, summed
    with _lock:
        frame = _frames.get(kind, n, like)
        into = None if frame is None else frame.take(n)
    return None if frame is None or into is None else (frame, into)


def _room_for(n: int) -> int:
    """Return n, or up to an eighth more."""
    step = 1 << max(n.bit_length() - 4, 0)
    return -(-n // step) * step


class Frame:
    """Sort and blend views by graphs.

    Args:
        like: a tensor of the Gaussians.
        room: number of Gaussians that there is room for.
        size, rules, mult, summed: as `take_frame` takes them.

    Attributes:
        by_records: zeros for one backward pass of the view, as `blend_kernels.blend_backward` takes them.
    """

    def __init__(self, like: Tensor, room: int, size: tuple[int, int], rules: Rules, mult: float, summed: bool) -> None:
        self.room = room
        self._size, self._rules, self._mult, self._summed = size, rules, mult, summed
        self._radii = like.new_zeros(1, room, 2, dtype=torch.int32)
        self._means2d = like.new_empty(1, 0, 2)  # which the family's footprints do without
        self._depths = like.new_zeros(1, room)
        self._records = like.new_empty(1, room, RECORD)
        self.by_records = like.new_empty(room * (GRADIENT + MOST_OTHERS))
        self._background = like.new_empty(3)
        self._copied_background: tuple[weakref.ref[Tensor], tuple[int, int]] | None = None  # and its state
        self._n = 0
        self._of_view = self._slices()
        self._user: weakref.ref[Tensor] | None = None
        self._stream = torch.cuda.current_stream(like.device)
        self._pairs_there, self._counted = new_slot(torch.int64)
        self._recorder = _Recorder(like.device)
        self._sorting: _Recording[Tiles] | None = None
        self._blending: _Recording[tuple[Tiles, Blending, Tensor | None]] | None = None
        self._pairs = 0

    def take(self, n: int) -> Destination | None:
        """Reserve the frame for n Gaussians; return None if something holds the records of the view before."""
        if self._user is not None and self._user() is not None:
            return None
        if n < self._n:
            self._radii.zero_()  # those that are not there any more are in no tile
        if n != self._n:
            self._n = n
            self._of_view = self._slices()
        records = self._records[:, :n]  # whoever reads this view's memory holds them, too
        self._user = weakref.ref(records)
        return *self._of_view, records

    def _slices(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return radii, centres and depths of the view's Gaussians."""
        return self._radii[:, : self._n], self._means2d, self._depths[:, : self._n]

    def sort(self) -> ArrivingNumber:
        """Sort Gaussians by depth; return the number of pairs, to be read before the next view is rendered."""
        if self._sorting is None:
            self._sorting = self._recorder.record(self._sort)
        self._sorting.replay()
        self._counted.record(self._stream)
        return ArrivingNumber(self._pairs_there, self._counted)

    def blend(self, background: Tensor, pairs: int) -> tuple[Tiles, Blending, Tensor | None]:
        """Sort pairs by tile and blend them, see `tiles.blend_and_sum`; there is room for as many pairs or more."""
        self._set_background(background)
        if self._blending is None or not pairs <= self._pairs <= MOST_ROOM * pairs:
            self._blending, self._pairs = None, min(int(HEADROOM * pairs), MOST_PAIRS)  # its memory is needed
            self._blending = self._recorder.record(self._sort_and_blend)
        return self._blending.replay()

    def _set_background(self, background: Tensor) -> None:
        """Copy a background, unless it is the one of the view before."""
        before = self._copied_background
        if before is None or before[0]() is not background or before[1] != state_of(background):
            self._background.copy_(background.reshape(3))
            tracked = not background.is_inference()
            self._copied_background = (weakref.ref(background), state_of(background)) if tracked else None

    def _sort(self) -> Tiles:
        from lapgs_plugin.gpu_raster.tile_kernels import sort_by_depth

        order, ends = sort_by_depth(self._radii, self._means2d, self._depths, grid_of(self._size), True)
        self._pairs_there.copy_(ends[-1], non_blocking=True)
        return order, ends

    def _sort_and_blend(self) -> tuple[Tiles, Blending, Tensor | None]:
        from lapgs_plugin.gpu_raster.tile_kernels import sort_by_tile

        assert self._sorting is not None
        order, ends = self._sorting.results
        grid = grid_of(self._size)
        tiles = sort_by_tile(self._radii, self._means2d, order, ends, None, 1, grid, self._pairs, True)
        self.by_records.zero_()
        return tiles, *blend_and_sum(
            self._records, self._background, tiles, self._size, self._rules, self._mult, self._summed
        )


class _Recording(Generic[T]):
    """Hold the launches of a function that always reads and writes the same memory.

    Beside a graph the function is not kept: it is a frame's, which would live until Python looks for cycles.

    Args:
        launches: their graph, or the function if they cannot be recorded.

    Attributes:
        results: of the function; their numbers are those of the last replay.
    """

    def __init__(self, launches: torch.cuda.CUDAGraph | Callable[[], T], results: T) -> None:
        self._launches, self.results = launches, results

    def replay(self) -> T:
        """Launch all again."""
        if isinstance(self._launches, torch.cuda.CUDAGraph):
            self._launches.replay()
        else:
            self.results = self._launches()
        return self.results


class _Recorder:
    """Record functions into graphs that share memory, on the current device."""

    def __init__(self, device: torch.device) -> None:
        self._pool = torch.cuda.graph_pool_handle()
        self._stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]  # torch's

    def record(self, function: Callable[[], T]) -> _Recording[T]:
        """Return the launches of a function. If they cannot be recorded, nothing is from now on."""
        function()  # so that all kernels are loaded; its results are freed before the graph reserves memory for others
        graph = torch.cuda.CUDAGraph()
        self._stream.wait_stream(torch.cuda.current_stream(self._stream.device))
        try:
            # `torch.cuda.graph` would collect garbage and empty PyTorch's cache, which takes longer than all else.
            with torch.cuda.stream(self._stream):
                graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
                try:
                    results = function()
                finally:
                    graph.capture_end()
        except RuntimeError as error:
            _broken.extend((graph, self._stream, error))
            return _Recording(function, function())
        return _Recording(graph, results)
