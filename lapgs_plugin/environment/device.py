"""Choose the device of --device."""

from __future__ import annotations

from lapgs_plugin.errors import UserInputError

DEVICES = ("auto", "cuda", "cpu")


def chosen_device(device: str, advice: str = "`lapgs doctor` says why, or use --device cpu") -> str:
    """Return "cuda" or "cpu" for a value of --device; "auto" takes CUDA if there is a device.

    Raises:
        UserInputError: an unknown value, or CUDA without a device; `advice` ends that message.
    """
    if device not in DEVICES:
        raise UserInputError(f"--device {device}: expected {', '.join(DEVICES)}")
    if device == "cpu":
        return device
    import torch  # here, because it takes seconds

    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise UserInputError(f"--device cuda: PyTorch finds no CUDA device; {advice}")
    return "cuda" if available else "cpu"
