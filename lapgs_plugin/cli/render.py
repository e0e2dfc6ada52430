"""Render the images of a run: `lapgs render`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.cli.bridge import takes_settings
from lapgs_plugin.cli.output import make_console, make_table, say, show_log
from lapgs_plugin.errors import UserInputError, counted
from lapgs_plugin.options import check_values, option, refuse
from lapgs_plugin.rendering.options import RenderOptions
from lapgs_plugin.runs.layout import require_place

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
    from lapgs_plugin.runs.archive import RunArchive
    from lapgs_plugin.scenes import Scene, View

PNG, EXR = "png", "exr"
OTHER_VIDEOS = (".avi", ".gif", ".m4v", ".mkv", ".mov", ".webm")
DEFAULT_FRAMES, DEFAULT_FPS = 240, 30


@dataclass(frozen=True)
class RenderSettings:
    """Choose which images of a run are rendered, and where they are written.

    Raises:
        UserInputError: a value is unknown or out of range, or an option has no effect with the others.
    """

    views: str | None = option(
        None,
        "test (held-out views), train or all. Default: test if views were held out, else train.",
        choices=("test", "train", "all"),
    )
    image_format: str = option(
        PNG,
        "png (8 bits, clamped) or exr (float, unclamped, signed residuals).",
        names=("--format",),
        choices=(PNG, EXR),
    )
    level: int | None = option(
        None, "Finest level to render; 0 is full resolution. Default: the finest finished level."
    )
    out: Path | None = option(
        None,
        "Folder to write to, default RUN/renders. With --trajectory an .mp4 file or a folder of images, default "
        "RUN/renders/<trajectory>.mp4.",
        names=("--out", "-o"),
    )
    compare: bool = option(False, "Also write photo, composition and difference side by side.")
    trajectory: str | None = option(
        None,
        "Render along a camera path instead of the views: orbit (around the scene's centre), spline (through the "
        "training cameras) or a JSON file of cameras in the layout of transforms.json.",
    )
    frames: int | None = option(
        None,
        f"Frames of the path. Default: {DEFAULT_FRAMES}, or the cameras of the JSON file; given with a file, its "
        "cameras are interpolated.",
        least=2,
    )
    frame_rate: float | None = option(
        None, f"Frames per second of the video. Default: {DEFAULT_FPS}.", least=1.0, most=1000.0
    )
    size: str | None = option(
        None, "Image size with --trajectory or --fps, such as 1280x720. Default: that of the cameras."
    )
    panels: bool = option(
        False, "With --trajectory: show base, residuals (or differences) and composition side by side."
    )
    fps: bool = option(False, "Measure frames per second at each level instead of writing images.")

    def __post_init__(self) -> None:
        check_values(self)
        if self.trajectory is None:
            path_options = {"--frames": self.frames, "--frame-rate": self.frame_rate, "--panels": self.panels}
            refuse(path_options, "needs --trajectory")
            refuse({"--size": None if self.fps else self.size}, "needs --trajectory or --fps")
        else:
            refuse(
                {"--views": self.views, "--compare": self.compare}, "does not go with --trajectory, which has no photos"
            )
        if self.fps:
            chosen = None if self.image_format == PNG else self.image_format
            refuse(
                {"--trajectory": self.trajectory, "--out": self.out, "--compare": self.compare, "--format": chosen},
                "does not go with --fps",
            )


@takes_settings
def render(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Run folder of `lapgs train`, `lapgs run` or `lapgs import-run`.")
    ],
    settings: RenderSettings,
    options: RenderOptions,
) -> None:
    """Render the base, the residuals and the composition of RUN, for its views or along a camera path.

    Files are named <view>_base, <view>_residual_<level> and <view>_composed, in the folders test and train. Base and
    residuals have the size of their level. Nested levels have no residuals: <view>_difference_<level> is the difference
    of a level from the upsampled image of the level before. PNG files show residuals and differences around mid-grey:
    grey is zero, lighter is positive, darker is negative.

    Examples:

        lapgs render runs/garden

        lapgs render runs/garden --views all --format exr --out /tmp/garden

        lapgs render runs/garden --trajectory orbit --out garden.mp4

        lapgs render runs/garden --fps --size 3840x2160

        lapgs render runs/garden --trajectory spline --panels --out frames/
    """
    from lapgs_plugin.jit.threads import one_pool
    from lapgs_plugin.rendering.run import run_renderer
    from lapgs_plugin.runs.archive import RunArchive

    # Without the check, coarser levels can be rendered if a finer one is damaged.
    archive = RunArchive.open(run, check=False)
    show_log()
    wanted = settings.level if settings.level in archive.available_levels else None
    renderer = run_renderer(archive, options.device, options.rasterizer, finest=wanted or 0)
    level = renderer.finest if settings.level is None else settings.level
    renderer.require_level(level)
    make = _print_speeds if settings.fps else _write_views if settings.trajectory is None else _write_clip
    with one_pool():
        make(archive, renderer, level, options.scene, settings)


def _write_clip(
    archive: RunArchive, renderer: HierarchyRenderer, level: int, scene: Path | None, settings: RenderSettings
) -> None:
    """Render along a camera path, as a video or a folder of images."""
    from lapgs_plugin.rendering.clip import VIDEO, clip_size, is_video, render_clip, render_size
    from lapgs_plugin.rendering.run import path_cameras
    from lapgs_plugin.runs.layout import RENDERS

    path = settings.trajectory
    assert path is not None
    out = archive.results(RENDERS) / f"{Path(path).stem}.mp4" if settings.out is None else settings.out
    cameras = path_cameras(archive, path, settings.frames, DEFAULT_FRAMES, scene)
    if out.suffix.lower() in OTHER_VIDEOS:
        raise UserInputError(f"--out {out}: expected an {VIDEO} file or a folder for images")
    if is_video(out) and settings.image_format != PNG:
        raise UserInputError(f"--format {settings.image_format}: a video has 8 bits; give --out a folder")
    require_place(out.parent if is_video(out) else out)
    if not is_video(out):
        refuse({"--frame-rate": settings.frame_rate}, f"needs an {VIDEO} file as --out")
    render_clip(
        renderer,
        cameras,
        out,
        level=level,
        size=clip_size(cameras[0], None if settings.size is None else render_size(settings.size), out),
        fps=DEFAULT_FPS if settings.frame_rate is None else settings.frame_rate,
        panels=settings.panels,
        image_format=settings.image_format,
    )
    say(f"{out} holds the clip, {counted(len(cameras), 'frame')}")


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


def _print_speeds(
    archive: RunArchive, renderer: HierarchyRenderer, level: int, scene: Path | None, settings: RenderSettings
) -> None:
    """Print frames per second over the cameras of the views, at another size if one is given."""
    from lapgs_plugin.rendering.clip import render_size
    from lapgs_plugin.rendering.run import run_scene
    from lapgs_plugin.rendering.speed import measure_speed

    splits = _choose(run_scene(archive, scene), settings.views).values()
    cameras = [view.camera for split in splits for view in split]
    if settings.size is not None:
        cameras = [camera.resized(*render_size(settings.size)) for camera in cameras]
    table = make_table("", "size", "Gaussians", "ms", "FPS")
    for speed in measure_speed(renderer, cameras, level):
        size, times = f"{speed.size[0]}x{speed.size[1]}", (f"{speed.milliseconds:.2f}", f"{speed.fps:.1f}")
        table.add_row(speed.what, size, f"{speed.gaussians:,}", *times)
    say(f"Frames a second, medians over {counted(len(cameras), 'camera')}")
    make_console().print(table)


def _write_views(
    archive: RunArchive, renderer: HierarchyRenderer, level: int, scene: Path | None, settings: RenderSettings
) -> None:
    """Render the views, a folder for each split."""
    from lapgs_plugin.rendering.run import run_scene
    from lapgs_plugin.runs.layout import RENDERS

    folder = archive.results(RENDERS) if settings.out is None else settings.out
    require_place(folder)
    for split, chosen in _choose(run_scene(archive, scene), settings.views).items():
        _write_split(renderer, chosen, level, folder / split, settings)
    say(f"{folder} holds the images")


def _write_split(
    renderer: HierarchyRenderer, views: Sequence[View], level: int, folder: Path, settings: RenderSettings
) -> None:
    """Render and write the views of one split; each file appears whole or not at all."""
    from concurrent.futures import ThreadPoolExecutor

    from lapgs_plugin.progress import item_progress
    from lapgs_plugin.rendering.images import file_stems, view_images
    from lapgs_plugin.scenes.images import write_image

    stems, pyramid, suffix = file_stems(views), renderer.pyramid, settings.image_format
    # In threads, because compressing a PNG takes longer than rendering it.
    with item_progress("views") as progress, ThreadPoolExecutor() as pool:
        task = progress.add_task(f"Rendering {folder.name} views", total=len(views))
        for view in views:
            composition = renderer.render(view.camera, level)
            photo = pyramid.gaussian(view.image.to(renderer.device), level + 1)[level] if settings.compare else None
            images = view_images(composition, photo, raw=suffix == EXR, nested=renderer.nested)
            paths = [folder / f"{stems[view.name]}_{name}.{suffix}" for name in images]
            for _ in pool.map(write_image, paths, images.values()):
                pass
            progress.advance(task)
