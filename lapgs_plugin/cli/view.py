"""`lapgs view`: a run in the browser."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.cli.rendering import DeviceOption, RasterizerOption, show_log
from lapgs_plugin.cli.viewing import HOST, PORT, open_page, require_viser
from lapgs_plugin.files import require_manifest

if TYPE_CHECKING:
    from lapgs_plugin.viewer.page import Page


def view(
    run: Annotated[Path, typer.Argument(help="Run folder of `lapgs train`, `lapgs run` or `lapgs import-run`.")],
    baseline: Annotated[
        Path | None, typer.Option(help="Another run of the scene, to the right of a divider that can be dragged.")
    ] = None,
    host: Annotated[
        str, typer.Option(help="Address to listen on. Default: this machine alone; 0.0.0.0 lets others in.")
    ] = HOST,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port; the next free one where it is taken.")] = PORT,
    scene: Annotated[
        Path | None, typer.Option(help="Where the scene is now, if it moved since the run was trained.")
    ] = None,
    device: DeviceOption = "auto",
    rasterizer: RasterizerOption = "auto",
) -> None:
    """Look at RUN in a web browser, one frequency band at a time.

    Drag to orbit, W A S D Q E to fly, scroll to come closer, or go to the cameras of the scene. The panel has each
    band's gain from 0 to 3, the level of detail, residuals around mid-grey, and what each band takes to render. On a
    CPU pictures are small while something moves and grow when it stops. Levels that are finished later appear by
    themselves. Any number of browsers may look; Ctrl-C ends it. Needs the extra: pip install 'lapgs_plugin\\[viewer]'.

    Examples:

        lapgs view runs/garden

        lapgs view runs/garden --baseline runs/plain

        ssh -L 8080:localhost:8080 gpu-machine lapgs view runs/garden
    """
    require_viser("lapgs view")
    for folder in filter(None, (run, baseline)):
        require_manifest(folder.absolute())
    from lapgs_plugin.viewer.preview import read_preview

    # A browser loads the page while this process imports what draws.
    with open_page(host, port, run.absolute().name, "Ctrl-C ends the viewer", read_preview(run.absolute())) as page:
        from lapgs_plugin.jit.threads import one_pool

        show_log()
        with one_pool():
            _serve(page, run, baseline, scene, device, rasterizer)


def _serve(page: Page, run: Path, baseline: Path | None, scene: Path | None, device: str, rasterizer: str) -> None:
    """Show the runs, as they are and as they grow, until Ctrl-C."""
    from lapgs_plugin.viewer.following import FollowedRun, RunFollower
    from lapgs_plugin.viewer.viewer import Viewer

    shown, other = (None if folder is None else FollowedRun(folder, device, rasterizer) for folder in (run, baseline))
    assert shown is not None, "it is a required argument"
    viewer, stop = Viewer(page), threading.Event()
    following = RunFollower(viewer, page, shown, other, scene, report=lambda line: print(line, flush=True))
    following.begin()
    following.warm_up()
    watching = threading.Thread(target=following.watch, args=(stop,), daemon=True)
    watching.start()
    try:
        viewer.serve(at_rest=following.save_preview)
    finally:
        stop.set()
        watching.join()
