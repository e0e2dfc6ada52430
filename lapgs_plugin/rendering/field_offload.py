"""Keep fields in host memory and copy them to the device for rendering, once or for each frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from lapgs_plugin.fields.gaussian_field import GaussianField


@dataclass
class FieldOffload:
    """Copy fields to the device that renders them.

    Attributes:
        device: that renders.
        keep: keep a field there after the first copy. Otherwise it stays in page-locked memory and is copied for every
            frame, in the stream that renders it, while other streams work.
    """

    device: torch.device
    keep: bool = True
    _ready: dict[int, GaussianField] = field(default_factory=dict, repr=False)

    def bring(self, level: int, wanted: GaussianField) -> GaussianField:
        """Return a level's field on `device`, for use in the current stream.

        Args:
            level: key of the kept copy.
            wanted: the field, on any device.
        """
        if wanted.means.device.type == self.device.type == "cpu":
            return wanted
        if level not in self._ready:
            self._ready[level] = wanted.to(self.device) if self.keep else _page_locked(wanted)
            torch.cuda.synchronize(self.device)  # once: from now on every stream may use it
        ready = self._ready[level]
        return ready if self.keep else _copied(ready, self.device)


def _page_locked(wanted: GaussianField) -> GaussianField:
    return wanted.with_parameters({name: value.cpu().pin_memory() for name, value in wanted.parameters.items()})


def _copied(waiting: GaussianField, device: torch.device) -> GaussianField:
    """Start copying a field to the device, without waiting for it."""
    return waiting.with_parameters(
        {name: value.to(device, non_blocking=True) for name, value in waiting.parameters.items()}
    )
