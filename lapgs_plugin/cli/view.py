"""Show a run in the browser: `lapgs view`."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.cli.bridge import takes_settings
from lapgs_plugin.cli.output import say, show_log
from lapgs_plugin.cli.viewing import HOST, PORT, open_page
from lapgs_plugin.errors import require_extra
from lapgs_plugin.files import require_manifest
from lapgs_plugin.rendering.options import RenderOptions

if TYPE_CHECKING:
    from lapgs_plugin.viewer.page import Page


@takes_settings
def view(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Run folder of `lapgs train`, `lapgs run` or `lapgs import-run`.")
    ],
    *,
    baseline: Annotated[
        Path | None, typer.Option(help="Another run of the same scene, shown beside RUN behind a movable divider.")
    ] = None,
    crop: Annotated[
        str | None,
        typer.Option(
            metavar="BOX|SPHERE",
            help="Show the edges of a box, x0,y0,z0,x1,y1,z1, or a sphere, x,y,z,r, for `lapgs export --crop`.",
        ),
    ] = None,
    host: Annotated[
        str, typer.Option(help="Address to listen on. The default accepts this machine only; 0.0.0.0 accepts all.")
    ] = HOST,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port; if it is taken, the next free one.")] = PORT,
    options: RenderOptions,
) -> None:
    """Show RUN in a web browser, with a switch and a gain for each frequency band.

    Drag to orbit, scroll to zoom, fly with W A S D Q E, or jump to a camera of the scene. The panel sets the gain of
    each band and the level of detail, and shows residuals around mid-grey and render times. Where rendering is slow,
    pictures are small while the camera moves and full-size when it stops. Levels that finish later appear by
    themselves. Several browsers can connect. Ctrl-C stops the viewer. Needs the extra: pip install
    'lapgs_plugin\\[viewer]'.

    Examples:

        lapgs view runs/garden

        lapgs view runs/garden --baseline runs/plain

        lapgs view runs/garden --crop 0,0,0,5

        ssh -L 8080:localhost:8080 gpu-machine lapgs view runs/garden
    """
    require_extra("viser", "viewer", "lapgs view")
    for folder in filter(None, (run, baseline)):
        require_manifest(folder)
    from lapgs_plugin.fields.crop import Crop
    from lapgs_plugin.viewer.preview import read_preview

    edges = [] if crop is None else Crop.parse(crop).edges()

    # The browser loads the page while this process imports torch and the rasterizer.
    with open_page(host, port, run.absolute().name, "Ctrl-C ends the viewer", read_preview(run)) as page:
        from lapgs_plugin.jit.threads import one_pool

        show_log()
        page.show_edges(edges)
        with one_pool():
            _serve(page, run, baseline, options)


def _serve(page: Page, run: Path, baseline: Path | None, options: RenderOptions) -> None:
    """Show the runs and their new levels until Ctrl-C."""
    from lapgs_plugin.viewer.following import FollowedRun, RunFollower
    from lapgs_plugin.viewer.viewer import Viewer

    shown = FollowedRun(run, options)
    other = None if baseline is None else FollowedRun(baseline, options)
    viewer, stop = Viewer(page), threading.Event()
    following = RunFollower(viewer, page, shown, other, report=say)
    following.begin()
    following.warm_up()
    watching = threading.Thread(target=following.watch, args=(stop,), daemon=True)
    watching.start()
    try:
        viewer.serve(at_rest=following.save_preview)
    finally:
        stop.set()
        watching.join()
