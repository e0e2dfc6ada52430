"""What the commands that open a viewer have in common: its options, and the line that says how to reach it."""

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

ViewOption = Annotated[bool, typer.Option("--view", help="Watch training in a web browser, for 1.5 % of its time.")]
ViewPortOption = Annotated[
    int | None,
    typer.Option(min=1, max=65535, help=f"Port of --view; the next free one where it is taken. Default: {PORT}."),
]


def require_viser(what: str) -> None:
    """Check that pages can be served.

    Args:
        what: needs them.

    Raises:
        MissingExtraError: they cannot.
    """
    if importlib.util.find_spec("viser") is None:
        raise MissingExtraError(
            f"{what} needs viser, which is not installed; pip install 'lapgs_plugin[viewer]' brings it"
        )


def open_page(host: str, port: int, label: str, until: str, preview: Image | None = None) -> Page:
    """Serve the page, and say where.

    Args:
        until: what ends it.
        preview: what it shows before anything can be rendered.
    """
    from lapgs_plugin.viewer.page import Page

    page = Page(host, port, label, preview)
    print(f"open {page.address} in a browser; {until}", flush=True)
    return page


@contextmanager
def watching(view: bool, port: int | None, label: str, device: str = "auto") -> Iterator[Watcher]:
    """Who watches a run that is about to be trained: with `--view` whoever loads a page, else nobody.

    Args:
        view, port: as the options say.
        label: of the page.
        device: where pictures are rendered.

    Raises:
        UserInputError: a port without a viewer, or none that is free.
        MissingExtraError: pages cannot be served.
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
    """Let the viewer begin with a picture of a run that has just been trained. Whatever fails is a line of the log.

    Args:
        run: its folder.
        device: where to render.
    """
    from lapgs_plugin.jit.threads import one_pool
    from lapgs_plugin.viewer.preview import save_run_preview

    with one_pool():
        save_run_preview(run, device)
