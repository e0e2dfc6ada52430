"""Options and helpers of the commands that open a viewer."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.errors import MissingExtraError, UserInputError
from lapgs_plugin.runs.watcher import Watcher

if TYPE_CHECKING:
    from PIL.Image import Image

    from lapgs_plugin.viewer.page import Page

HOST, PORT = "127.0.0.1", 8080

ViewOption = Annotated[bool, typer.Option("--view", help="Show training in a web browser.")]
ViewPortOption = Annotated[
    int | None,
    typer.Option(min=1, max=65535, help=f"Port of --view; if it is taken, the next free one. Default: {PORT}."),
]


def require_viser(what: str) -> None:
    """Check that viser is installed.

    Args:
        what: command or option that needs it, for the message.

    Raises:
        MissingExtraError: it is not.
    """
    if importlib.util.find_spec("viser") is None:
        raise MissingExtraError(
            f"{what} needs viser, which is not installed; pip install 'lapgs_plugin[viewer]' installs it"
        )


def open_page(host: str, port: int, label: str, until: str, preview: Image | None = None) -> Page:
    """Serve the viewer's page and print its address.

    Args:
        host, port: address to listen on; a taken port is replaced by the next free one.
        label: title of the page.
        until: when the page is closed, for the printed line.
        preview: image to show until the first one is rendered.
    """
    from lapgs_plugin.viewer.page import Page

    page = Page(host, port, label, preview)
    print(f"open {page.address} in a browser; {until}", flush=True)
    return page


@contextmanager
def watching(view: bool, port: int | None, label: str, device: str = "auto") -> Iterator[Watcher]:
    """Return a watcher for a training run: the viewer with `--view`, else one that does nothing.

    Args:
        view, port: values of --view and --view-port.
        label: title of the page.
        device: where images are rendered.

    Raises:
        UserInputError: a port without --view, or no port is free.
        MissingExtraError: viser is not installed.
    """
    if not view:
        if port is not None:
            raise UserInputError(f"--view-port {port} needs --view; leave it out")
        yield Watcher()
        return
    require_viser("--view")
    with open_page(HOST, PORT if port is None else port, label, "it shows the run while it is trained") as page:
        from lapgs_plugin.viewer.live import LiveView

        yield LiveView(page, device)


def keep_preview(run: Path, device: str = "auto") -> None:
    """Render a preview of a trained run, which `lapgs view` shows first. A failure is only logged.

    Args:
        run: the run folder.
        device: where to render.
    """
    from lapgs_plugin.jit.threads import one_pool
    from lapgs_plugin.viewer.preview import save_run_preview

    with one_pool():
        save_run_preview(run, device)
