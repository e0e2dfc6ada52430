"""Declare the folders besides runs on which `lapgs report` reports; entry points bring them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import ClassVar

from lapgs_plugin.registry import Registry
from lapgs_plugin.rendering.options import RenderOptions


class FolderReport(ABC):
    """Report on one kind of folder.

    Attributes:
        marker: name of a file that every such folder holds, and no run does.
    """

    marker: ClassVar[str]

    @abstractmethod
    def write(self, folder: Path, options: RenderOptions) -> Path:
        """Write the page of a folder, and return its path.

        Raises:
            LapgsError: the folder is damaged, or the page cannot be written.
        """


FOLDER_REPORTS: Registry[type[FolderReport]] = Registry(
    "lapgs report", "lapgs_plugin.reports", FolderReport, {}, classes=True
)
"""Kinds of folders by name, such as "experiment"."""
