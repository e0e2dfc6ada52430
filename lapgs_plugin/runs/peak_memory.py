"""How much of a GPU's memory a stage took at its worst, and how much of that were images."""

from __future__ import annotations

import torch


class PeakMemory:
    """The highest use of a GPU's memory since this was made.

    Images come and go in a stage, so that what the peak held of them has to be noted before they do.

    Args:
        device: its statistics are reset, here and by `note`; on a CPU nothing is measured.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._bytes: dict[str, int] = {}
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)

    def note(self, images: int) -> dict[str, int]:
        """Look at the peak since this was last called.

        Args:
            images: bytes of images on the GPU all this while.

        Returns:
            Bytes of the highest peak so far, "peak", and what of it were "images"; nothing on a CPU.
        """
        if self._device.type == "cuda":
            peak = torch.cuda.max_memory_allocated(self._device)
            if peak >= self._bytes.get("peak", 0):
                self._bytes = {"peak": peak, "images": images}
            torch.cuda.reset_peak_memory_stats(self._device)
        return dict(self._bytes)
