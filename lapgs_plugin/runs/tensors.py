"""Write and read checkpoints: dictionaries of tensors, numbers, strings and containers of them."""

from __future__ import annotations

import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import torch

from lapgs_plugin.errors import RunFolderError, UserInputError, first_line
from lapgs_plugin.files import atomic_write, one_line_errors
from lapgs_plugin.untrusted import require_regular

PLAIN = (int, float, complex, bool, str, bytes, type(None), torch.dtype, torch.device)
"""Types besides tensors and containers that a checkpoint may hold."""


def write_tensors(path: Path, state: dict[str, Any]) -> None:
    """Replace a file by a dictionary that `read_tensors` reads.

    Raises:
        RunFolderError: the disk is full or the folder is not writable; the file stays as it was.
        UserInputError: `state` holds an object that `read_tensors` refuses; the file stays as it was.
    """
    _require_readable(state, path)
    with one_line_errors(path, training=True), atomic_write(path) as stream:
        try:
            torch.save(state, stream)
        except RuntimeError as error:  # torch hides the OSError of a full disk in one
            if isinstance(error.__context__, OSError):
                raise error.__context__ from error
            raise


def read_tensors(path: Path, advice: str) -> dict[str, Any]:
    """Read a file of `write_tensors`, with tensors on the CPU; messages end with advice.

    Raises:
        RunFolderError: it cannot be read, or its tensors would take more memory than the file has bytes.
    """
    try:
        require_regular(path)
        _require_stored(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # RuntimeError, UnpicklingError, EOFError, OSError, ...: it depends on the damage
        code = "Weights only load failed" in str(error)  # PyTorch's advice is to load it all the same, code included
        reason = "it is damaged or holds other objects than tensors, numbers and text" if code else first_line(error)
        raise RunFolderError(f"{path} cannot be read ({reason}); {advice}") from error
    if not isinstance(state, dict):
        raise RunFolderError(f"{path} holds a {type(state).__name__}, expected a dictionary; {advice}")
    _require_held(state, path, advice)
    return state


def _require_readable(state: dict[str, Any], path: Path) -> None:
    """Check that every object in a dictionary is of a type that `torch.load` makes without executing code.

    Raises:
        UserInputError: one is not; the line says where it is.
    """
    waiting: list[tuple[str, Any]] = [("state", state)]
    seen: set[int] = set()
    while waiting:
        name, value = waiting.pop()
        if type(value) in PLAIN or isinstance(value, torch.Tensor) or id(value) in seen:
            continue
        seen.add(id(value))
        if type(value) in (dict, OrderedDict):
            waiting.extend((f"{name}[{key!r}]", part) for item in value.items() for key in item[:1] for part in item)
        elif type(value) in (list, tuple, set, torch.Size):
            waiting.extend((f"{name}[{index}]", part) for index, part in enumerate(value))
        else:
            raise UserInputError(
                f"{path}: {name} is a {type(value).__name__}, expected tensors, numbers, text, None, and dictionaries "
                "and lists of them; convert it first"
            )


def _require_stored(path: Path) -> None:
    """Check that the contents of a zip file are stored without compression, as `torch.save` writes them.

    Raises:
        ValueError: they are compressed or overlap, and would unpack to more bytes than the file has.
        zipfile.BadZipFile, OSError: it is no zip file, or cannot be read.
    """
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
    size, held = path.stat().st_size, sum(entry.file_size for entry in entries)
    if held > size or any(entry.file_size != entry.compress_size for entry in entries):
        raise ValueError(f"it unpacks to {held:,} bytes, expected no more than its own {size:,}")


def _require_held(state: dict[str, Any], path: Path, advice: str) -> None:
    """Check that tensors are dense ones on the CPU and together no larger than their file.

    An expanded view can have more elements than fit into memory; copying it would allocate them.

    Raises:
        RunFolderError: they are not.
    """
    waiting: list[Any] = [state]
    seen: set[int] = set()
    held, size = 0, path.stat().st_size
    while waiting:
        value = waiting.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        if isinstance(value, torch.Tensor):
            if value.layout != torch.strided or value.device.type != "cpu" or value.is_quantized:
                raise RunFolderError(f"{path} holds a {value.layout} tensor, expected dense ones; {advice}")
            held += value.nelement() * value.element_size()
        elif isinstance(value, dict):
            waiting.extend(value.values())
        elif isinstance(value, (list, tuple)):
            waiting.extend(value)
    if held > size:
        raise RunFolderError(f"{path} names tensors of {held:,} bytes, expected at most its own {size:,}; {advice}")
