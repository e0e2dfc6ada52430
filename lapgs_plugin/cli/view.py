"""`lapgs view`: a run in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.cli.rendering import DeviceOption, RasterizerOption, show_log
from lapgs_plugin.errors import MissingExtraError, RunFolderError, SceneError

if TYPE_CHECKING:
    from lapgs_plugin.archive import RunArchive
    from lapgs_plugin.viewer.navigation import Start
    from lapgs_plugin.viewer.session import Exhibit


def view(
    run: Annotated[Path, typer.Argument(help="Run folder of `lapgs train`, `lapgs run` or `lapgs import-run`.")],
    baseline: Annotated[
        Path | None, typer.Option(help="Another run of the scene, to the right of a divider that can be dragged.")
    ] = None,
    host: Annotated[
        str, typer.Option(help="Address to listen on. Default: this machine alone; 0.0.0.0 lets others in.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port; the next free one where it is taken.")] = 8080,
    scene: Annotated[
        Path | None, typer.Option(help="Where the scene is now, if it moved since the run was trained.")
    ] = None,
    device: DeviceOption = "auto",
    rasterizer: RasterizerOption = "auto",
) -> None:
    """Look at RUN in a web browser, one frequency band at a time.

    Drag to orbit, W A S D Q E to fly, scroll to come closer, or go to the cameras of the scene. The panel has each
    band's gain from 0 to 3, the level of detail, residuals around mid-grey, and what each band takes to render. On a
    CPU pictures are small while something moves and grow when it stops. Any number of browsers may look; Ctrl-C ends
    it. Needs the extra: pip install 'lapgs_plugin\\[viewer]'.

    Examples:

        lapgs view runs/garden

        lapgs view runs/garden --baseline runs/plain

        ssh -L 8080:localhost:8080 gpu-machine lapgs view runs/garden
    """
    _require_viser()
    from lapgs_plugin.archive import RunArchive
    from lapgs_plugin.reference_raster.threads import one_pool
    from lapgs_plugin.viewer.server import Viewer, free_port

    archive = RunArchive.open(run)
    other = None if baseline is None else RunArchive.open(baseline)
    show_log()
    with one_pool():
        exhibit, start = _exhibit(archive, other, scene, device, rasterizer)
        found = free_port(host, port)
        if found != port:
            print(f"port {port} is taken, using {found}")
        viewer = Viewer(exhibit, start, host, found)
        shown = "localhost" if host in ("0.0.0.0", "127.0.0.1") else host
        print(f"open http://{shown}:{viewer.port} in a browser; Ctrl-C ends the viewer", flush=True)
        try:
            viewer.serve()
        except KeyboardInterrupt:
            print("ended")
        finally:
            viewer.close()


def _require_viser() -> None:
    from importlib.util import find_spec

    if find_spec("viser") is None:
        raise MissingExtraError(
            "lapgs view needs viser, which is not installed; pip install 'lapgs_plugin[viewer]' brings it"
        )


def _exhibit(
    archive: RunArchive, other: RunArchive | None, scene: Path | None, device: str, rasterizer: str
) -> tuple[Exhibit, Start]:
    """What is shown, and where a client begins."""
    from lapgs_plugin.rendering.rig import Rig
    from lapgs_plugin.rendering.run import run_cameras
    from lapgs_plugin.viewer.navigation import start_at, start_outside
    from lapgs_plugin.viewer.pictures import ShownRun
    from lapgs_plugin.viewer.session import Exhibit

    manifest = archive.manifest
    if not manifest.complete and manifest.records:
        levels = ", ".join(str(level) for level in archive.available_levels)
        print(
            f"{archive.path()} is not complete: showing level {levels} of {manifest.levels}; start again for the rest"
        )
    try:
        train, test = run_cameras(archive, scene)
    except (RunFolderError, SceneError) as error:
        if scene is not None:
            raise
        print(f"without the scene's cameras: {error}")
        train, test = {}, {}
    cameras = {**test, **train}
    rig = Rig.of(list(train.values())) if train else None
    shown = ShownRun.load(archive, rig, device, rasterizer)
    compared = None if other is None else ShownRun.load(other, rig, device, rasterizer)
    if rig is None:
        return Exhibit(shown, compared, {}, None), start_outside(shown.renderer.fields[manifest.levels - 1])
    return Exhibit(shown, compared, cameras, rig), start_at(next(iter(cameras.values())), rig)
