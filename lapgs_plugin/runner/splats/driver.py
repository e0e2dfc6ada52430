"""Run a script whose class trains splats as a hierarchy: its own `train`, archived level by level.

A call of `train()` becomes one call for all nested levels, whose views change their size between two batches; or one
call for each level with residuals, before which the trainer is made anew with the stage's settings. These symbols are
replaced, and restored by identity at the end:

    `train` of the class                                as above
    `rasterization`, as the script imports it           our kernels, signed colours, coarser levels in the image
    `torch.utils.data.DataLoader`, also where the
    script imports it, of its datasets                  batches of the level's images, which are in memory
    `__init__` of the class, `Parser`                   read a scene once
    `eval` and the like of the class                    do not count as training
    `cli`, as the script imports it                     stays in this process, on one GPU

Its densification, optimizers, viewer, poses, exposure and what it saves are its own.
"""

from __future__ import annotations

import copy
import logging
import os
import shlex
import tempfile
from collections.abc import Callable, Mapping
from functools import wraps
from pathlib import Path
from typing import Any

import torch
from torch.utils import data

from lapgs_plugin.checkouts.attachment import Attachment, Replacement
from lapgs_plugin.checkouts.script import Script
from lapgs_plugin.checkouts.splat_script import RASTERIZATION, SplatScript
from lapgs_plugin.errors import DeviceMemoryError, UserInputError, first_line
from lapgs_plugin.fields.gaussian_field import GaussianField, splats_from_field
from lapgs_plugin.hierarchy.inheritance import inherit
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.runner.splats.joint import COLORS
from lapgs_plugin.runner.splats.run import SplatRequest, SplatRun, prepare
from lapgs_plugin.runner.splats.schedule import set_threshold, stage_config
from lapgs_plugin.runner.splats.signed import FinishedField, Rasterizer
from lapgs_plugin.runner.splats.stage import SplatStage
from lapgs_plugin.runner.splats.views import LevelBatches

logger = logging.getLogger(__name__)

MEASUREMENTS = ("eval", "render_traj", "run_compression")
"""Methods of a trainer that take time beside training."""
VIEWERLESS = "disable_viewer"
"""Setting of a script that keeps a trainer from starting a viewer."""


def run_bare(script: Script, described: SplatScript, device: str, ours: bool = False) -> None:
    """Run a script's main block as it is; on a CPU with gsplat's stand-in.

    Args:
        script: its definitions have been executed.
        described: what its syntax tree says.
        device: as of `SplatRequest`.
        ours: let our kernels render on a GPU.
    """
    replacements: list[Replacement] = []
    if device == "cpu" or ours:
        rasterize = _rasterizer(device, vars(script.module)[RASTERIZATION], ours=ours).render
        replacements.append(
            Replacement(script.module, RASTERIZATION, lambda _: rasterize, f"{described.trainer}.train()")
        )
        replacements += _single_process(script)
    with Attachment(replacements):
        script.run_main()


class SplatDriver:
    """Run a script's main block with its trainer's `train` replaced by the stages of a hierarchy.

    Args:
        request: what the user asks for.
    """

    def __init__(self, request: SplatRequest) -> None:
        self._request, self._module = request, request.script.module
        self._class: type = vars(self._module)[request.described.trainer]
        self._train_once: Callable[[Any], Any]
        self._init: Callable[..., None]
        self._made_with: tuple[tuple[Any, ...], dict[str, Any]] = (), {}
        self._parsers: dict[str, Any] = {}
        self._own = _rasterizer(request.device, vars(self._module)[RASTERIZATION])
        self._rasterizer = self._own  # of calls outside of a stage
        self._run: SplatRun
        self._stage: SplatStage | None = None
        self._advance: Callable[[], None] | None = None
        self._folder: Path | None = None
        with tempfile.TemporaryFile() as file:  # its clock is behind `time.time_ns`
            self._began = os.fstat(file.fileno()).st_mtime_ns

    def run(self) -> Path | None:
        """Run the main block and return the folder of its run; None if it trained nothing.

        Raises:
            LapgsError: the script, its options, the scene and the hierarchy do not go together.
        """
        # Handing a backward pass to a thread of autograd's and waiting for it takes up to a tenth of an iteration.
        with Attachment(self._replacements()), torch.autograd.set_multithreading_enabled(False):
            self._request.script.run_main()
        return self._folder

    def _replacements(self) -> list[Replacement]:
        of_class, of_script = vars(self._class), vars(self._module)
        trainer = f"{self._class.__name__}.train()"
        replacements = [
            Replacement(self._class, "__init__", self._making, "the script's main block"),
            Replacement(self._class, "train", self._training, "the script's main block", ("self",)),
            Replacement(self._module, RASTERIZATION, lambda _: self._rasterize, trainer),
            Replacement(data, "DataLoader", self._loading, trainer),
        ]
        imported = [name for name, value in of_script.items() if value is data.DataLoader]
        replacements += [Replacement(self._module, name, self._loading, trainer) for name in imported]
        replacements += [Replacement(self._class, n, self._measuring, trainer) for n in MEASUREMENTS if n in of_class]
        if isinstance(of_script.get("Parser"), type):
            replacements.append(
                Replacement(self._module, "Parser", self._parsing, f"{self._class.__name__}.__init__()")
            )
        return replacements + _single_process(self._request.script)

    def _making(self, original: Callable[..., None]) -> Callable[..., None]:
        self._init = original

        @wraps(original)
        def making(trainer: Any, *args: Any, **kwargs: Any) -> None:
            self._made_with = args, kwargs
            original(trainer, *args, **kwargs)

        return making

    def _parsing(self, kind: type) -> Callable[..., Any]:
        def parse(*args: Any, **kwargs: Any) -> Any:
            key = repr((args, kwargs))
            if key not in self._parsers:
                self._parsers[key] = kind(*args, **kwargs)
            return self._parsers[key]

        return parse

    def _measuring(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def measure(*args: Any, **kwargs: Any) -> Any:
            if self._stage is None:
                return original(*args, **kwargs)
            with self._stage.outside("evaluation"):
                return original(*args, **kwargs)

        return measure

    def _loading(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def load(dataset: Any, batch_size: int = 1, shuffle: bool = False, **others: Any) -> Any:
            if self._stage is None or dataset not in (self._run.trainer.trainset, self._run.trainer.valset):
                return original(dataset, batch_size=batch_size, shuffle=shuffle, **others)
            if dataset is self._run.trainer.valset:  # read once in a while: processes for it take longer to start
                return original(dataset, batch_size=batch_size, shuffle=shuffle)
            persistent = bool(others.get("persistent_workers"))
            acts = self._item, self._prefetch, self._iteration_begins
            return LevelBatches(len(dataset), *acts, batch_size, shuffle, persistent)

        return load

    def _item(self, index: int) -> dict[str, Any]:
        assert self._stage is not None, "a stage draws views"
        return self._stage.item(index)

    def _prefetch(self, index: int) -> None:
        if self._stage is not None:
            self._stage.prefetch(index)

    def _iteration_begins(self) -> None:
        assert self._stage is not None, "a stage iterates"
        if self._advance is not None and self._stage.iteration == self._stage.stage.iterations:
            self._advance()
        self._stage.iteration_begins()

    def _rasterize(self, *args: Any, **inputs: Any) -> Any:
        if self._stage is None:
            return self._rasterizer.rasterization(*args, **inputs) if args else self._rasterizer.render(**inputs)
        if args:
            raise UserInputError(
                f"{self._request.script.path} calls {RASTERIZATION}() with {len(args)} arguments without names, "
                "expected names; `lapgs run --off` runs the script as it is"
            )
        return self._stage.rasterize(**inputs)

    def _training(self, original: Callable[[Any], Any]) -> Callable[[Any], Any]:
        self._train_once = original

        @wraps(original)
        def train(trainer: Any) -> Any:
            with prepare(self._request, self._own, trainer, self._began) as run:
                self._run, self._folder, self._rasterizer = run, run.archive.path(), run.rasterizer
                run.request.watcher.run_started(run.archive)
                try:
                    with run.image_cache():
                        returned = self._train_stages() if run.settings.has_residuals else self._train_nested()
                except torch.cuda.OutOfMemoryError as error:
                    raise DeviceMemoryError(
                        f"out of GPU memory; finished levels ({run.finished_levels}) are kept; "
                        "--images-on memory takes images off the GPU, more --levels or a larger --data_factor help too "
                        f"[{first_line(error)}]"
                    ) from error
                finally:
                    self._stage = self._advance = None
            logger.info("run folder: %s; next: `lapgs eval %s`", run.folder, shlex.quote(str(run.folder)))
            return returned

        return train

    def _train_nested(self) -> Any:
        """Train all levels in one call of the script's `train`."""
        run, left = self._run, list(self._run.plan)
        own, of_run = run.config.strategy, copy.copy(run.config.strategy)
        self._scale_sh_rate()

        def begin() -> SplatStage:
            stage = left.pop(0)
            set_threshold(own, of_run, run.window(stage).threshold_factor)
            active = SplatStage(run, stage)
            active.begin()
            return active

        def advance() -> None:
            self._finish()
            self._stage = begin()

        self._stage, self._advance = begin(), advance
        returned = self._train_once(run.trainer)
        set_threshold(own, of_run, 1.0)
        self._finish()
        return returned

    def _train_stages(self) -> Any:
        """Train each level by a call of the script's `train` on a trainer that is made anew."""
        run, returned = self._run, None
        for stage in run.plan:
            if stage.level in run.archive.available_levels:
                continue
            self._remake(stage)
            finished = [
                FinishedField.of(level, run.archive.field(level), run.device) for level in run.archive.available_levels
            ]
            if finished:
                self._inherit(run.archive.field(stage.level + 1))
            self._stage = SplatStage(run, stage, finished)
            self._stage.begin()
            returned = self._train_once(run.trainer)
            self._finish()
        return returned

    def _finish(self) -> None:
        assert self._stage is not None, "a stage ended"
        self._stage.finish()
        self._stage.close()
        self._stage = None

    def _remake(self, stage: Stage) -> None:
        """Make the script's trainer anew for one stage; its viewer stays, and what it learned beside the splats."""
        run, trainer = self._run, self._run.trainer
        learned = {name: module.state_dict() for name, module in _beside_splats(trainer).items()}
        folder = run.config.result_dir if stage.level == 0 else str(run.archive.path(f"level_{stage.level}"))
        config = stage_config(run.config, run.window(stage), folder, run.settings)
        if hasattr(config, VIEWERLESS):
            setattr(config, VIEWERLESS, True)
        args, kwargs = self._made_with
        instead = {id(run.config): config}
        if hasattr(trainer, "writer"):
            trainer.writer.close()
        self._init(
            trainer,
            *(instead.get(id(value), value) for value in args),
            **{name: instead.get(id(value), value) for name, value in kwargs.items()},
        )
        if hasattr(config, VIEWERLESS):
            setattr(config, VIEWERLESS, getattr(run.config, VIEWERLESS))
        for name, module in _beside_splats(trainer).items():
            if name in learned and _shapes(learned[name]) == _shapes(module.state_dict()):
                module.load_state_dict(learned[name])
        if stage.signed:
            # Its optimizers, not its settings: programs made of older examples have rates as numbers in their code.
            for name in COLORS:
                _scale_rate(trainer.optimizers[name], run.window(stage).residual_color_rate)
        self._scale_sh_rate()

    def _inherit(self, coarser: GaussianField) -> None:
        """Let the trainer's new splats start from the next coarser level's field."""
        run = self._run
        generator = torch.Generator().manual_seed(run.settings.seed)
        field = inherit(coarser, run.settings.inherit_mode, run.settings.inherit_ratio, generator).field
        for name, value in splats_from_field(field).items():
            run.trainer.splats[name].data = value.to(run.device)

    def _scale_sh_rate(self) -> None:
        """Apply --sh-rate to the trainer's optimizer of SH above degree 0."""
        rate, optimizers = self._run.settings.sh_rate, self._run.trainer.optimizers
        if rate != 1.0 and "shN" not in optimizers:
            raise UserInputError(f"--sh-rate {rate:g}: the script has no optimizer of shN; leave it out")
        if rate != 1.0:
            _scale_rate(optimizers["shN"], rate)


def _scale_rate(optimizer: torch.optim.Optimizer, factor: float) -> None:
    for group in optimizer.param_groups:
        group["lr"] *= factor


def _beside_splats(trainer: Any) -> dict[str, torch.nn.Module]:
    """Return a trainer's modules without splats, such as corrections of poses and exposure, by attribute."""
    splats = set(map(id, trainer.splats.values()))
    modules = {name: value for name, value in vars(trainer).items() if isinstance(value, torch.nn.Module)}
    return {name: module for name, module in modules.items() if not splats & set(map(id, module.parameters()))}


def _shapes(state: Mapping[str, Any]) -> dict[str, Any]:
    return {name: getattr(value, "shape", None) for name, value in state.items()}


def _single_process(script: Script) -> list[Replacement]:
    """Return the replacement of the function that starts a process for each GPU, if a script has it."""
    if not callable(vars(script.module).get("cli")):
        return []
    return [Replacement(script.module, "cli", lambda _: _in_process, "the script's main block")]


def _in_process(main: Callable[..., Any], config: Any, verbose: bool = False) -> Any:
    """Call a script's main function as its `cli` does on a machine with one GPU."""
    if torch.cuda.device_count() > 1:
        logger.info("one of %d GPUs is used: levels are trained in one process", torch.cuda.device_count())
    return main(0, 0, 1, config)


def _rasterizer(device: str, rasterization: Any, *, ours: bool = False) -> Rasterizer:
    """Return the functions that a script renders with, ours in their place, or their stand-ins on a CPU."""
    if device == "cpu":
        from lapgs_plugin.reference_raster import gsplat as stand_in
        from lapgs_plugin.runner.splats.on_cpu import rasterization_on_cpu

        return Rasterizer(rasterization_on_cpu, stand_in.spherical_harmonics)
    from gsplat import spherical_harmonics

    own = Rasterizer(rasterization, spherical_harmonics)
    if not ours:
        return own
    from lapgs_plugin.runner.splats.choice import OurRasterizer

    logger.info("rasterizer: that of lapgs")
    return OurRasterizer.instead_of(own)
