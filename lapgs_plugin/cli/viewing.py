"""Open the viewer for commands."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lapgs_plugin.errors import UserInputError, printable, require_extra
from lapgs_plugin.options import check_values, option
from lapgs_plugin.runs.watcher import Watcher

if TYPE_CHECKING:
    from PIL.Image import Image

    from lapgs_plugin.viewer.page import Page

HOST, PORT = "127.0.0.1", 8080


@dataclass(frozen=True)
class ViewOptions:
    """Choose whether a run is shown while it is trained.

    Raises:
        UserInputError: a port without --view.
    """

    view: bool = option(False, "Show training in a web browser.")
    view_port: int | None = option(
        None, f"Port of --view; if it is taken, the next free one. Default: {PORT}.", least=1, most=65535
    )

    def __post_init__(self) -> None:
        check_values(self)
        if not self.view and self.view_port is not None:
            raise UserInputError(f"--view-port {self.view_port} needs --view; leave it out")


def open_page(host: str, port: int, label: str, until: str, preview: Image | None = None) -> Page:
    """Serve the viewer's page and print its address.

    Args:
        host, port: address to listen on; a taken port is replaced by the next free one.
        label: title of the page.
        until: clause about the end of the page, for the printed line.
        preview: image to show until the first one is rendered.
    """
    from lapgs_plugin.viewer.page import Page

    page = Page(host, port, printable(label), preview)
    print(f"open {page.address} in a browser; {until}", flush=True)
    return page


@contextmanager
def watching(options: ViewOptions, label: str, device: str = "auto") -> Iterator[Watcher]:
    """Yield a watcher for a training run: the viewer with `--view`, else one that does nothing.

    Args:
        options: whether to show the run, and where.
        label: title of the page.
        device: where images are rendered.

    Raises:
        UserInputError: no port is free.
        MissingExtraError: viser is not installed.
    """
    if not options.view:
        yield Watcher()
        return
    require_extra("viser", "viewer", "--view")
    with open_page(HOST, options.view_port or PORT, label, "it shows the run while it is trained") as page:
        from lapgs_plugin.viewer.live import LiveView

        yield LiveView(page, device)
