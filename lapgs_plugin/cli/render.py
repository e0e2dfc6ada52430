"""Render the images of a run: `lapgs render`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.cli.bridge import takes_settings
from lapgs_plugin.cli.output import make_console
from lapgs_plugin.cli.rendering import RenderOptions, refuse, show_log
from lapgs_plugin.errors import UserInputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lapgs_plugin.fields.camera import Camera
    from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
    from lapgs_plugin.scenes import Scene, View

SPLITS = ("test", "train", "all")
FORMATS = ("png", "exr")
OTHER_VIDEOS = (".avi", ".gif", ".m4v", ".mkv", ".mov", ".webm")
DEFAULT_FRAMES, DEFAULT_FPS = 240, 30


@takes_settings
def render(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Run folder of `lapgs train`, `lapgs run` or `lapgs import-run`.")
    ],
    options: RenderOptions,
    views: Annotated[
        str | None,
        typer.Option(help="test (held-out views), train or all. Default: test if views were held out, else train."),
    ] = None,
    image_format: Annotated[
        str, typer.Option("--format", help="png (8 bits, clamped) or exr (float, unclamped, signed residuals).")
    ] = "png",
    level: Annotated[
        int | None,
        typer.Option(help="Finest level to render; 0 is full resolution. Default: the finest finished level."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder to write to, default RUN/renders. With --trajectory an .mp4 file or a folder of images, "
            "default RUN/renders/<trajectory>.mp4.",
        ),
    ] = None,
    compare: Annotated[
        bool, typer.Option("--compare", help="Also write photo, composition and difference side by side.")
    ] = False,
    trajectory: Annotated[
        str | None,
        typer.Option(
            help="Render along a camera path instead of the views: orbit (around the scene's centre), spline (through "
            "the training cameras) or a JSON file of cameras in the layout of transforms.json."
        ),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(
            min=2,
            help=f"Frames of the path. Default: {DEFAULT_FRAMES}, or the cameras of the JSON file; given with a file, "
            "its cameras are interpolated.",
        ),
    ] = None,
    frame_rate: Annotated[
        float | None, typer.Option(min=1.0, max=1000.0, help=f"Frames per second of the video. Default: {DEFAULT_FPS}.")
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(help="Image size with --trajectory or --fps, such as 1280x720. Default: that of the cameras."),
    ] = None,
    panels: Annotated[
        bool,
        typer.Option(
            "--panels",
            help="With --trajectory: show base, residuals (or differences) and composition side by side.",
        ),
    ] = False,
    fps: Annotated[
        bool,
        typer.Option("--fps", help="Measure frames per second at each level instead of writing images."),
    ] = False,
) -> None:
    """Render the base, the residuals and the composition of RUN, for its views or along a camera path.

    Files are named <view>_base, <view>_residual_<level> and <view>_composed, in the folders test and train. Base and
    residuals have the size of their level. Nested levels have no residuals: <view>_difference_<level> is what a level
    changes in the upsampled image of the level before. PNG files show residuals and differences around mid-grey: grey
    is zero, lighter is positive, darker is negative.

    Examples:

        lapgs render runs/garden

        lapgs render runs/garden --views all --format exr --out /tmp/garden

        lapgs render runs/garden --trajectory orbit --out garden.mp4

        lapgs render runs/garden --fps --size 3840x2160

        lapgs render runs/garden --trajectory spline --panels --out frames/
    """
    if trajectory is None:
        refuse({"--frames": frames, "--frame-rate": frame_rate, "--panels": panels or None}, "needs --trajectory")
        refuse({"--size": None if fps else size}, "needs --trajectory or --fps")
    else:
        refuse({"--views": views, "--compare": compare or None}, "does not go with --trajectory, which has no photos")
    from lapgs_plugin.jit.threads import one_pool
    from lapgs_plugin.rendering.run import path_cameras, run_renderer, run_scene
    from lapgs_plugin.runs.archive import RENDERS, RunArchive

    _require_one_of("--views", views, (None, *SPLITS))
    _require_one_of("--format", image_format, FORMATS)
    # Without the check, coarser levels can be rendered if a finer one is damaged.
    archive = RunArchive.open(run, check=False)
    show_log()
    wanted = level if level in archive.available_levels else None
    renderer = run_renderer(archive, options.device, options.rasterizer, finest=wanted or 0)
    level = renderer.finest if level is None else level
    renderer.require_level(level)
    if fps:
        refuse({"--trajectory": trajectory, "--out": out, "--compare": compare or None}, "does not go with --fps")
        with one_pool():
            splits = _choose(run_scene(archive, options.scene), views).values()
            _print_speeds(renderer, [view.camera for split in splits for view in split], level, size)
        return
    if trajectory is not None:
        clip = archive.path(RENDERS, f"{Path(trajectory).stem}.mp4") if out is None else out
        with one_pool():
            cameras = path_cameras(archive, trajectory, frames, DEFAULT_FRAMES, options.scene)
            _write_clip(
                renderer, cameras, clip, level, size, frame_rate=frame_rate, panels=panels, image_format=image_format
            )
        print(f"{clip} holds the clip, {len(cameras)} frames")
        return
    folder = archive.path(RENDERS) if out is None else out
    with one_pool():
        loaded = run_scene(archive, options.scene)
        for split, chosen in _choose(loaded, views).items():
            _write_views(renderer, chosen, level, folder=folder / split, image_format=image_format, compare=compare)
    print(f"{folder} holds the images")


def _write_clip(
    renderer: HierarchyRenderer,
    cameras: Sequence[Camera],
    out: Path,
    level: int,
    size: str | None,
    *,
    frame_rate: float | None,
    panels: bool,
    image_format: str,
) -> None:
    from lapgs_plugin.rendering.clip import VIDEO, clip_size, is_video, parse_size, render_clip

    if out.suffix.lower() in OTHER_VIDEOS:
        raise UserInputError(f"--out {out}: expected an {VIDEO} file or a folder for images")
    if is_video(out) and image_format != "png":
        raise UserInputError(f"--format {image_format}: a video has 8 bits; give --out a folder")
    if not is_video(out):
        refuse({"--frame-rate": frame_rate}, f"needs an {VIDEO} file as --out")
    wanted = None if size is None else parse_size(size)
    render_clip(
        renderer,
        cameras,
        out,
        level=level,
        size=clip_size(cameras[0], wanted, out),
        fps=DEFAULT_FPS if frame_rate is None else frame_rate,
        panels=panels,
        image_format=image_format,
    )


def _require_one_of(option: str, value: str | None, accepted: Sequence[str | None]) -> None:
    if value not in accepted:
        raise UserInputError(f"{option} {value}: expected {', '.join(filter(None, accepted))}")


def _choose(scene: Scene, views: str | None) -> dict[str, tuple[View, ...]]:
    """Return the views to render by the name of their folder."""
    if views == "test" and not scene.test:
        raise UserInputError(
            "--views test: nothing was held out of this run; render --views train, or train with --eval"
        )
    wanted = views or ("test" if scene.test else "train")
    return {
        split: chosen
        for split, chosen in (("test", scene.test), ("train", scene.train))
        if wanted in (split, "all") and chosen
    }


def _print_speeds(renderer: HierarchyRenderer, cameras: Sequence[Camera], level: int, size: str | None) -> None:
    """Print frames per second over these cameras, at another size if one is given."""
    from rich.table import Table

    from lapgs_plugin.rendering.clip import parse_size
    from lapgs_plugin.rendering.speed import measure_speed

    if size is not None:
        cameras = [camera.resized(*parse_size(size)) for camera in cameras]
    table = Table("", "size", "Gaussians", "ms", "FPS", title=f"median over {len(cameras)} cameras")
    for speed in measure_speed(renderer, cameras, level):
        table.add_row(
            speed.what,
            f"{speed.size[0]}x{speed.size[1]}",
            f"{speed.gaussians:,}",
            f"{speed.milliseconds:.2f}",
            f"{speed.fps:.1f}",
        )
    make_console().print(table)


def _write_views(
    renderer: HierarchyRenderer, views: Sequence[View], level: int, *, folder: Path, image_format: str, compare: bool
) -> None:
    """Render and write the views of one split; each file appears whole or not at all."""
    from concurrent.futures import ThreadPoolExecutor

    from lapgs_plugin.progress import item_progress
    from lapgs_plugin.rendering.images import file_stems, view_images
    from lapgs_plugin.scenes import write_image

    stems = file_stems(views)
    # In threads, because compressing a PNG takes longer than rendering it.
    with item_progress("views") as progress, ThreadPoolExecutor() as pool:
        task = progress.add_task(f"Rendering {folder.name} views", total=len(views))
        for view in views:
            composition = renderer.render(view.camera, level)
            photo = renderer.pyramid.gaussian(view.image.to(renderer.device), level + 1)[level] if compare else None
            images = view_images(composition, photo, raw=image_format == "exr", nested=renderer.nested)
            paths = [folder / f"{stems[view.name]}_{suffix}.{image_format}" for suffix in images]
            for _ in pool.map(write_image, paths, images.values()):
                pass
            progress.advance(task)
