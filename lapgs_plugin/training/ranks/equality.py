"""Check that all ranks train the same: the same version, scene and settings, and fields of the same bits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from zlib import crc32

import torch

import lapgs_plugin
from lapgs_plugin.errors import LapgsError, UserInputError
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.ranks.group import Ranks


class RanksDifferError(LapgsError):
    """Ranks have fields of different bits: a fault of the machine or of this program."""


def require_same(ranks: Ranks, values: Mapping[str, Any]) -> None:
    """Refuse ranks that were started for something else than rank 0.

    Args:
        ranks: the group.
        values: of this rank, by what they are in the message.

    Raises:
        UserInputError: a value of a rank is not that of rank 0.
    """
    first, *others = ranks.gathered(dict(values))
    for rank, theirs in enumerate(others, start=1):
        for name, value in first.items():
            if theirs[name] != value:
                raise UserInputError(
                    f"rank {rank} has other {name} than rank 0 ({_difference(theirs[name], value)}); start all ranks "
                    "with the same command, on machines with the same files and packages"
                )


def _difference(theirs: Any, ours: Any) -> str:
    """Return the first entry in which two values differ, or the values."""
    if isinstance(ours, Mapping) and isinstance(theirs, Mapping):
        name = next(name for name in {**ours, **theirs} if theirs.get(name) != ours.get(name))
        one, other = theirs.get(name), ours.get(name)
        inner = _difference(one, other)
        return inner if isinstance(one, Mapping) and isinstance(other, Mapping) else f"{name}: {inner}"
    if isinstance(ours, list) and isinstance(theirs, list):
        if len(ours) == len(theirs):
            return next(f"{one} and {other}" for one, other in zip(theirs, ours, strict=True) if one != other)
        return f"{len(theirs)} and {len(ours)}"
    return f"{theirs} and {ours}"


def source_checksum(root: Path = Path(lapgs_plugin.__file__).parent) -> str:
    """Return a checksum of a package's source files, this one's by default: two checkouts often have one version."""
    checksum = 0
    for file in sorted(root.rglob("*.py")):
        checksum = crc32(file.read_bytes(), crc32(file.relative_to(root).as_posix().encode(), checksum))
    return f"{checksum:08x}"


def digest(models: Sequence[TrainableField]) -> tuple[int, ...]:
    """Return numbers that differ, but for a rare chance, if a bit of a field's parameters does."""
    sums = []
    for param in (param for model in models for param in model.params.values()):
        bits = param.detach()[:, None].flatten(1).view(torch.int32)  # also of no Gaussians
        sums += [bits.sum(dtype=torch.int64), bits[::2].sum(dtype=torch.int64), bits[:, ::2].sum(dtype=torch.int64)]
    return tuple(torch.stack(sums).tolist())


def require_equal_fields(ranks: Ranks, models: Sequence[TrainableField], where: str) -> None:
    """Refuse to go on with fields that are not the same on all ranks.

    Args:
        ranks: the group.
        models: the fields under training, on each rank.
        where: level and iteration, for the message.

    Raises:
        RanksDifferError: they are not.
    """
    if ranks.size == 1:
        return
    first, *others = ranks.gathered((len(models[0]), digest(models)))
    for rank, theirs in enumerate(others, start=1):
        if theirs != first:
            raise RanksDifferError(
                f"{where}: the field of rank {rank} is not that of rank 0 ({theirs[0]:,} and {first[0]:,} Gaussians); "
                "the last checkpoint continues with --resume"
            )
