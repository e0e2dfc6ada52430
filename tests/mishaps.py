"""Processes that die and disks that fill up while a run is written."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hooks import StageHook


class Killed(BaseException):
    """Stands for the end of the process."""


def disk_full() -> OSError:
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class FailingWrites:
    """Fails at a chosen fsync or rename and all that follow; once killed nothing is cleaned up, as after SIGKILL.

    Args:
        failure: gives what is raised instead of writing.

    Attributes:
        left: how many go well from now on.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, failure: Callable[[], BaseException]) -> None:
        self.left = sys.maxsize
        self._failure = failure
        real_fsync, real_replace, real_unlink = os.fsync, Path.replace, Path.unlink

        def fsync(descriptor: int) -> None:
            self._use_one()
            real_fsync(descriptor)

        def rename(path: Path, target: Path) -> Path:
            self._use_one()
            return real_replace(path, target)

        def unlink(path: Path, missing_ok: bool = False) -> None:
            if self.left >= 0 or failure is not Killed:
                real_unlink(path, missing_ok=missing_ok)

        monkeypatch.setattr(os, "fsync", fsync)
        monkeypatch.setattr(Path, "replace", rename)
        monkeypatch.setattr(Path, "unlink", unlink)

    def _use_one(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise self._failure()


class FailAfterStage(StageHook):
    """Lets writes fail when a stage has been trained.

    Args:
        writes: that fail.
        level: of the stage.
        left: how many go well after it.
    """

    def __init__(self, writes: FailingWrites, level: int, left: int) -> None:
        self._writes, self._level, self._left = writes, level, left

    def on_stage_end(self, stage: Stage) -> None:
        if stage.level == self._level:
            self._writes.left = self._left
