"""Read single numbers of a GPU later, so that the processor does not wait for it."""

from __future__ import annotations

import torch
from torch import Tensor

Slot = tuple[Tensor, torch.cuda.Event]
"""Page-locked memory for a number, and an event after its last copy there."""
# Each takes the processor longer to make than to use.
_free_slots: dict[tuple[torch.device, torch.dtype], list[Slot]] = {}


class ArrivingNumber:
    """Read a number that a device copies to page-locked memory, when the device has arrived there.

    Args:
        copy: the memory.
        copied: recorded after the copy; None if the number is there already.
        free: where both go when the number was read; None if they belong to somebody.
    """

    def __init__(self, copy: Tensor, copied: torch.cuda.Event | None, free: list[Slot] | None = None) -> None:
        self._value: int | None = None
        self._copy, self._copied, self._free = copy, copied, free

    @classmethod
    def of(cls, number: Tensor) -> ArrivingNumber:
        """Copy a number, if it is on a device."""
        if not number.is_cuda:
            return cls(number, None)
        free = _free_slots.setdefault((number.device, number.dtype), [])
        copy, copied = free.pop() if free else new_slot(number.dtype)
        copy.copy_(number, non_blocking=True)
        copied.record(torch.cuda.current_stream(number.device))
        return cls(copy, copied, free)

    def has_arrived(self) -> bool:
        """Return whether nothing has to be waited for."""
        return self._copied is None or bool(self._copied.query())  # type: ignore[no-untyped-call]  # torch's

    def read(self) -> int:
        """Return the number; the first time, wait for it."""
        if self._value is None:
            if self._copied is not None:
                self._copied.synchronize()
            self._value = int(self._copy)
            if self._free is not None and self._copied is not None:
                self._free.append((self._copy, self._copied))
        return self._value


def new_slot(dtype: torch.dtype) -> Slot:
    """Return page-locked memory for a number, and an event."""
    with torch.inference_mode(False):  # it is written to in other modes, too
        return torch.empty((), dtype=dtype, pin_memory=True), torch.cuda.Event()  # type: ignore[no-untyped-call]  # torch's
