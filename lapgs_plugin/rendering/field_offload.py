"""Where fields are while they are not rendered: in memory until they are needed, then on the device, to stay or not."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from lapgs_plugin.fields.gaussian_field import GaussianField


@dataclass
class FieldOffload:
    """Brings fields to the device that renders them.

    Attributes:
        device: where they are needed.
        keep: let a field stay there once it has come. Otherwise it waits in page-locked memory and is sent for each
            frame anew, in the stream that renders it, beside what other streams do.
    """

    device: torch.device
    keep: bool = True
    _here: dict[int, GaussianField] = field(default_factory=dict, repr=False)

    def bring(self, level: int, wanted: GaussianField) -> GaussianField:
        """The field of a level on `device`, for use in the current stream.

        Args:
            level: what it is remembered by.
            wanted: the field, anywhere.
        """
        if wanted.means.device.type == self.device.type == "cpu":
            return wanted
        if level not in self._here:
            self._here[level] = wanted.to(self.device) if self.keep else _page_locked(wanted)
            torch.cuda.synchronize(self.device)  # once: from now on every stream may use it
        found = self._here[level]
        return found if self.keep else _sent(found, self.device)


def _page_locked(wanted: GaussianField) -> GaussianField:
    return wanted.with_parameters({name: value.cpu().pin_memory() for name, value in wanted.parameters.items()})


def _sent(waiting: GaussianField, device: torch.device) -> GaussianField:
    return waiting.with_parameters(
        {name: value.to(device, non_blocking=True) for name, value in waiting.parameters.items()}
    )
