"""Train with the built-in trainer: `lapgs train`."""

from __future__ import annotations

import os
import shlex
import sys
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.cli.bridge import chosen_options, takes_settings
from lapgs_plugin.cli.config_file import ConfigOption, extended_config, write_config
from lapgs_plugin.cli.output import log_to_stderr, make_console, say
from lapgs_plugin.cli.rehearsal import Rehearsal
from lapgs_plugin.cli.viewing import ViewOptions, watching
from lapgs_plugin.errors import UserInputError, printable
from lapgs_plugin.files import write_text
from lapgs_plugin.hierarchy.settings import AUTO
from lapgs_plugin.options import option
from lapgs_plugin.runs.layout import RUN_CONFIG, TENSORBOARD
from lapgs_plugin.runs.watcher import Watcher
from lapgs_plugin.scenes.options import SceneOptions
from lapgs_plugin.tiles.options import TileOptions, require_options_of_base
from lapgs_plugin.training.ranks import launcher
from lapgs_plugin.training.settings import TrainingControl, TrainSettings

if TYPE_CHECKING:
    from lapgs_plugin.tiles.workers import Workers
    from lapgs_plugin.training.monitor import Monitor
    from lapgs_plugin.training.preparation import TrainRequest
    from lapgs_plugin.training.prepared_run import PreparedRun

CHOSEN_ONCE = ("rasterizer", "strategy")
"""Options whose value "auto" stands for the choice that the run was started with when it is continued."""


@dataclass(frozen=True)
class StartOptions:
    """Choose whether a run is new, continued or replaced, and whether it is shown meanwhile."""

    resume: bool = option(
        False,
        "Continue the run in --out with its settings. A finished run is extended if --iterations is more than it has.",
    )
    overwrite: bool = option(False, "Replace the run in --out.")
    gpus: int | None = option(
        None,
        "Train on this many GPUs of the machine, which share the views of each step, or with --tiles the tiles; see "
        "`lapgs help scale`. torchrun -m lapgs_plugin train does the same, also on several machines.",
        least=1,
        most=1024,
    )
    processes: int | None = option(
        None, "Train on this many processes on CPUs instead, to try --gpus without GPUs.", least=1, most=1024
    )
    shard: bool = option(
        False,
        "With --gpus or --processes: divide the Gaussians over the ranks, for fields larger than one GPU; see `lapgs "
        "help scale`.",
    )
    tiling: TileOptions = field(default_factory=TileOptions)
    viewing: ViewOptions = field(default_factory=ViewOptions)

    def __post_init__(self) -> None:
        if self.gpus is not None and self.processes is not None:
            raise UserInputError(f"--gpus {self.gpus} with --processes {self.processes}: give one of them")
        if self.shard and self.tiling.asked is None:
            self._check_shard()

    def require_for_tiles(self, out: Path) -> None:
        """Refuse options that runs of tiles do not have, of a new run and of a continued one."""
        asked: dict[str, int | bool | None] = {"--shard": self.shard, "--view": self.viewing.view}
        if self.tiling.tile is not None or self.tiling.only_base:
            asked |= {"--gpus": self.gpus, "--processes": self.processes}
        for name, value in asked.items():
            if value:
                tiles = self.tiling.asked or f"{out}, which is made of tiles"
                raise UserInputError(f"{name} with {tiles}: not for tiles; leave {name} out")

    def _check_shard(self) -> None:
        """Refuse to divide Gaussians over one rank, or to show them while they are divided."""
        if not launcher.is_rank() and (self.gpus or self.processes or 1) == 1:
            raise UserInputError(
                "--shard: divides the Gaussians over several ranks; add --gpus 2 or more, --processes, or start it by "
                "torchrun"
            )
        if self.viewing.view:
            raise UserInputError("--view with --shard: no rank has all of the Gaussians to show; leave one out")

    def workers(self, rasterizer: str) -> Workers | None:
        """Return what trains tiles at the same time; None trains them one after the other.

        Args:
            rasterizer: that is asked for.

        Raises:
            UserInputError: the machine has not as many GPUs, or torchrun started this process.
        """
        from lapgs_plugin.tiles.workers import Workers

        if launcher.is_rank():
            raise UserInputError("torchrun with --tiles: tiles are no ranks; start it by lapgs train with --gpus")
        if self.processes is not None:
            os.environ["CUDA_VISIBLE_DEVICES"] = ""
            return Workers.on_cpus(self.processes)
        if self.gpus is None:
            return None
        launcher.require_gpus(self.gpus, rasterizer)
        return Workers.on_gpus(self.gpus)

    def launches(self, scene: Path, settings: TrainSettings, rasterizer: str) -> bool:
        """Run this command on several ranks if that is asked for; return whether it has.

        Args:
            scene: the scene folder.
            settings, rasterizer: that are asked for.

        Raises:
            UserInputError: the machine has not as many GPUs, the scene or the settings are for fewer ranks, or torchrun
                started another number of them.
        """
        asked, option = self.gpus or self.processes, "--processes" if self.gpus is None else "--gpus"
        if self.gpus is not None:
            launcher.require_gpus(self.gpus, rasterizer)
        if launcher.is_rank():
            launcher.join_started(option, asked)
            return False
        if asked is None or asked == 1:
            return False
        from lapgs_plugin.training.preparation import require_startable
        from lapgs_plugin.training.ranks.group import AskedRanks

        require_startable(AskedRanks(option, asked), scene, settings, self.shard)
        launcher.launch(asked, self.gpus is not None, sys.argv[1:])
        return True


@takes_settings
def train(
    context: typer.Context,
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene folder: COLMAP, Blender or nerfstudio.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Run folder to write.")],
    *,
    settings: TrainSettings,
    photos: SceneOptions,
    start: StartOptions,
    config: ConfigOption = None,
    control: TrainingControl,
) -> None:
    """Train a scene coarse to fine with the built-in trainer, on a GPU (gsplat) or a CPU.

    Each level trains at twice the image size of the level before.

    Examples:

        lapgs train data/garden -o runs/garden --eval

        lapgs train data/garden -o runs/small --resolution 1/4 --iterations 3000

        lapgs train data/garden -o runs/fast --time 2m

        lapgs train data/garden -o runs/plain --levels 1    # a single field

        lapgs train data/garden -o runs/nested --hierarchy nested    # one PLY

        lapgs train data/garden -o runs/garden --resume    # after Ctrl-C

        lapgs train data/garden -o runs/garden --resume --iterations 40000

        lapgs train --config runs/garden/run.toml -o runs/again --seed 1

        lapgs train data/town -o runs/town --hierarchy nested --tiles 2x3 --gpus 4
    """
    from lapgs_plugin.tiles.grid import has_grid
    from lapgs_plugin.training.preparation import TrainRequest, prepare
    from lapgs_plugin.training.ranks.group import joined

    in_tiles = start.tiling.asked is not None or (start.resume and has_grid(out))
    if in_tiles:
        start.require_for_tiles(out)
    if not isinstance(context.obj, Rehearsal) and not in_tiles and start.launches(scene, settings, control.rasterizer):
        return
    if leads := launcher.leads():
        log_to_stderr("%(message)s")
    chosen = {name for name in chosen_options(context) if name not in CHOSEN_ONCE or context.params[name] != AUTO}
    request = TrainRequest(
        scene=scene,
        out=out,
        settings=settings,
        photos=photos,
        control=control,
        resume=start.resume,
        overwrite=start.overwrite,
        chosen=frozenset(chosen),
    )
    if isinstance(context.obj, float):
        request = replace(request, began=context.obj)
    if not isinstance(context.obj, Rehearsal) and _trained_in_tiles(context, request, start):
        return
    viewing = start.viewing if leads else ViewOptions()
    watcher = context.with_resource(watching(viewing, out.absolute().name))
    if isinstance(context.obj, Rehearsal):
        context.obj.train(request)
        return
    request = replace(request, ranks=joined(), shard=start.shard)
    if request.ranks.size > 1:  # signals end imports at once: rank 0 could not say why another rank failed
        import_module("lapgs_plugin.training.trainer")
    with request.ranks.explained(), prepare(request, partial(say, stderr=True)) as run:
        path, extended = run.archive.path(RUN_CONFIG), None
        if leads:
            extended = _write_options(path, run, context)
        _train(run, watcher)
        if extended is not None:
            write_text(path, extended)
    request.ranks.close()
    if not leads:
        return
    show_finished(out, scene, preview=request.settings.time is None)  # a preview is beyond the time


def _write_options(path: Path, run: PreparedRun, context: typer.Context) -> str | None:
    """Write the options of a new run into its folder; return those of one that is extended, to be written after it."""
    if run.resumes:
        return extended_config(path, run.settings) if run.settings.extended else None
    photos = run.archive.manifest.scene
    length = run.planned.iterations if run.settings.time is None else None
    write_config(
        path,
        context,
        masks=photos.masks,
        sky=photos.sky,
        iterations=length,
        depth=run.settings.depth,
        normals=run.settings.normals,
    )
    return None


def _trained_in_tiles(context: typer.Context, request: TrainRequest, start: StartOptions) -> bool:
    """Train a run in tiles, or one tile, if that is asked for or was begun; return whether it was.

    Raises:
        UserInputError: a tile is asked for with options that its base has decided, or continued without its base.
    """
    from lapgs_plugin.runs.layout import require_room
    from lapgs_plugin.tiles.grid import has_grid, read_grid
    from lapgs_plugin.tiles.run import train_tile, train_tiles
    from lapgs_plugin.tiles.tile import Tile

    tiling = start.tiling
    out, scene, tell = Path(request.out), Path(request.scene), partial(say, stderr=True)

    def started(run: PreparedRun, finest: int) -> None:
        if run.archive.path() == out and tiling.tile is None:
            _write_options(out / RUN_CONFIG, run, context)
        _train(run, Watcher(), finest)

    if tiling.base is not None:
        require_options_of_base(request.chosen, tiling.base)
        if not request.resume:
            require_room(out, request.overwrite)
        tile = Tile(tiling.base, scene, tiling.place)
        train_tile(tile, out, request.control, started, tell, overwrite=request.overwrite)
        return True
    continues = request.resume and has_grid(out)
    if continues and (only := read_grid(out).only) is not None:
        raise UserInputError(
            f"{out} is a tile of another run; continue it with --tile {only[0]},{only[1]} --base and that run"
        )
    if tiling.tiles is None and not continues:
        return False
    shape = None if tiling.tiles is None else tiling.shape
    queue, workers = say if tiling.only_base else None, start.workers(request.control.rasterizer)
    if workers is not None:
        tell("the coarser levels are trained by one process; then the tiles at the same time")
    if train_tiles(request, shape, started, tell, queue=queue, workers=workers):
        show_finished(out, scene)
    return True


def _train(run: PreparedRun, watcher: Watcher, finest: int = 0) -> None:
    """Train down to a level with a progress display."""
    from lapgs_plugin.training.monitor import ProgressMonitor
    from lapgs_plugin.training.tensorboard import TensorboardMonitor
    from lapgs_plugin.training.trainer import Trainer

    if not run.ranks.leads:
        Trainer(run).run()
        return
    with ExitStack() as opened:
        monitor: Monitor = opened.enter_context(ProgressMonitor(make_console(stderr=True), run.plan.levels))
        if run.control.log is not None:
            monitor = opened.enter_context(TensorboardMonitor(run.archive.path(TENSORBOARD), run.plan, monitor))
        Trainer(run, monitor=monitor, watcher=watcher, finest=finest).run()


def show_finished(out: Path, scene: Path, preview: bool = True) -> None:
    """Say what can be done with a finished run.

    Args:
        out: the run.
        scene: its scene, now.
        preview: save the picture that the viewer shows first.
    """
    from rich.markup import escape

    from lapgs_plugin.viewer.preview import save_run_preview

    if preview:
        save_run_preview(out, moved_to=scene)
    name, word = (escape(printable(text)) for text in (str(out), shlex.quote(str(out))))
    make_console(stderr=True).print(
        f"[bold]{name}[/bold] holds the run; next: `lapgs eval {word}`, `lapgs render {word}` or `lapgs view {word}`",
        soft_wrap=True,
    )
