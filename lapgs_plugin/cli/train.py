"""`lapgs train`: a hierarchy without a checkout, on gsplat or on the CPU rasterizer."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lapgs_plugin.cli.options import (
    DEFAULT_INHERITANCE,
    HIERARCHY,
    PRUNE_HELP,
    GridOption,
    InheritOption,
    SupervisionOption,
    check_residual_options,
    given_options,
)
from lapgs_plugin.cli.viewing import ViewOption, ViewPortOption, keep_preview, watching
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import DEFAULT_HIERARCHY, NESTED_COARSE_THRESHOLD

if TYPE_CHECKING:
    from rich.console import Console

    from lapgs_plugin.runs.archive import RunArchive, SceneReference
    from lapgs_plugin.runs.watching import Watcher
    from lapgs_plugin.scenes import Scene
    from lapgs_plugin.training.settings import TrainSettings

SCHEDULE = "Schedule"
GSPLAT = "gsplat"
RUN = "Run"
BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


def train(
    context: typer.Context,
    scene: Annotated[Path, typer.Argument(help="Folder of a COLMAP or Blender-style scene.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Run folder to write.")],
    iterations: Annotated[
        int, typer.Option(min=1, help="Views trained on, all stages together. The 3DGS schedule shrinks with it.")
    ] = 30_000,
    resolution: Annotated[
        str, typer.Option(help="1k, 2k or 4k as in the paper, full, a width such as 800, or a fraction such as 1/4.")
    ] = "full",
    images: Annotated[str, typer.Option(help="Image folder inside a COLMAP scene, such as images_4.")] = "images",
    hold_out: Annotated[bool, typer.Option("--eval", help="Hold out every eighth view for testing.")] = False,
    background: Annotated[
        str, typer.Option(help="Behind the scene and behind transparent pixels: black, white or R,G,B from 0 to 1.")
    ] = "black",
    seed: Annotated[int, typer.Option(min=0, help="The same seed and settings give the same bits on a CPU.")] = 0,
    levels: Annotated[
        int, typer.Option(rich_help_panel=HIERARCHY, help="Number of levels; 1 is a plain single field, the baseline.")
    ] = 2,
    split: Annotated[
        str | None,
        typer.Option(
            rich_help_panel=HIERARCHY,
            help="Share of the iterations of each stage, coarsest first. Two levels: 1/2,1/2 (paper: 1/3,2/3).",
        ),
    ] = None,
    hierarchy: Annotated[
        str,
        typer.Option(
            rich_help_panel=HIERARCHY,
            help="nested (each level trains the coarser one's field on at its own size; the last one makes the whole "
            "image, as fast as a single field's and about as good) or laplacian (the paper's: a base and residuals "
            "that are added up; saves more time where images are large and views are few).",
        ),
    ] = DEFAULT_HIERARCHY.value,
    supervision: SupervisionOption = "reconstructed",
    inherit: InheritOption = None,
    joint: Annotated[
        float,
        typer.Option(
            rich_help_panel=HIERARCHY,
            help="Of residuals: share of each residual stage, its last, in which the finished coarser fields are "
            "optimized too, such as 0.25; 0 leaves them as they are, as in the paper.",
        ),
    ] = 0.0,
    grid: GridOption = "camera",
    sh_degree: Annotated[int, typer.Option(rich_help_panel=SCHEDULE, help="Highest SH degree, 0 to 3.")] = 3,
    base_sh_degree: Annotated[
        int | None,
        typer.Option(
            rich_help_panel=SCHEDULE,
            help="Of residuals: highest SH degree of the base, at most --sh-degree, which is the default.",
        ),
    ] = None,
    sh_rate_factor: Annotated[
        float,
        typer.Option(
            rich_help_panel=SCHEDULE,
            help="Factor on the learning rate of SH above degree 0, which is a twentieth of degree 0's, in every "
            "field. 8 suits scenes with hundreds of views, 1 those with few.",
        ),
    ] = 1.0,
    sh_rate_decay: Annotated[
        bool,
        typer.Option(
            "--sh-rate-decay",
            rich_help_panel=SCHEDULE,
            help="Let that factor go exponentially to 1 within each stage.",
        ),
    ] = False,
    gather: Annotated[
        int,
        typer.Option(
            rich_help_panel=SCHEDULE,
            min=1,
            help="Views whose gradients are added up for each optimizer step in the last quarter of a stage, once "
            "densification has ended and if 40 such steps fit; 1 steps after every view, as 3DGS does.",
        ),
    ] = 8,
    views_per_step: Annotated[
        str,
        typer.Option(
            rich_help_panel=SCHEDULE,
            help="Training views of one optimizer step, rendered together on a GPU; step sizes grow with the root of "
            "their number. auto: by the size of the images on a GPU, 1 on a CPU. Iterations count views.",
        ),
    ] = "1",
    densify_from: Annotated[
        int | None, typer.Option(rich_help_panel=SCHEDULE, min=0, help="First densification. Default: 500 of 30000.")
    ] = None,
    densify_until: Annotated[
        int | None,
        typer.Option(
            rich_help_panel=SCHEDULE,
            min=0,
            help="Last one, of the whole run; stages scale it. Default: 15000 of 30000.",
        ),
    ] = None,
    base_densify_share: Annotated[
        float | None,
        typer.Option(
            rich_help_panel=SCHEDULE,
            help="Share of the coarsest level's iterations in which it densifies, from 0 to 1. Default: as all stages, "
            "half.",
        ),
    ] = None,
    densify_threshold: Annotated[
        float | None,
        typer.Option(
            rich_help_panel=SCHEDULE,
            help="Gradient above which a Gaussian is cloned or split. Default: 0.0002, and 0.0008 with --absgrad.",
        ),
    ] = None,
    coarse_threshold: Annotated[
        float | None,
        typer.Option(
            rich_help_panel=SCHEDULE,
            help="Factor on the gradient threshold of densification for each time that images are halved: above 1 "
            f"gives coarse levels fewer Gaussians. Default: {NESTED_COARSE_THRESHOLD:g}, and 1 for residuals.",
        ),
    ] = None,
    residual_threshold: Annotated[
        float,
        typer.Option(rich_help_panel=SCHEDULE, help="Of residuals: factor on the gradient threshold in their stages."),
    ] = 1.0,
    densify_every: Annotated[
        int, typer.Option(rich_help_panel=SCHEDULE, min=1, help="Iterations between two densifications.")
    ] = 100,
    prune: Annotated[float, typer.Option(rich_help_panel=SCHEDULE, help=PRUNE_HELP)] = 0.0,
    opacity_reset_every: Annotated[
        int | None,
        typer.Option(
            rich_help_panel=SCHEDULE,
            min=0,
            help="Iterations between two resets of all opacities; 0 never resets. Default: 3000 of 30000, in the "
            "coarsest level alone.",
        ),
    ] = None,
    strategy: Annotated[
        str,
        typer.Option(
            rich_help_panel=SCHEDULE,
            help="Density control: default (3DGS's heuristics), mcmc (gsplat), or multiview (only where several views "
            "are badly shown).",
        ),
    ] = "default",
    split_threshold: Annotated[
        float | None,
        typer.Option(
            rich_help_panel=SCHEDULE,
            help="Absolute gradient above which --strategy multiview splits a large Gaussian. Default: 0.0008.",
        ),
    ] = None,
    error_threshold: Annotated[
        float,
        typer.Option(
            rich_help_panel=SCHEDULE,
            help="Share of a view's largest error above which a pixel is badly shown, for --strategy multiview.",
        ),
    ] = 0.1,
    error_pixels: Annotated[
        float,
        typer.Option(
            rich_help_panel=SCHEDULE,
            help="Badly shown pixels of a view that a Gaussian must make up to be cloned or split, for --strategy "
            "multiview.",
        ),
    ] = 0.1,
    cap_max: Annotated[
        int, typer.Option(rich_help_panel=SCHEDULE, min=1, help="Most Gaussians of a level, for --strategy mcmc.")
    ] = 1_000_000,
    base_cap_max: Annotated[
        int | None,
        typer.Option(rich_help_panel=SCHEDULE, min=1, help="Most Gaussians of the coarsest level. Default: --cap-max."),
    ] = None,
    absgrad: Annotated[
        bool,
        typer.Option("--absgrad", rich_help_panel=SCHEDULE, help="Densify by absolute gradients (AbsGS)."),
    ] = False,
    antialiased: Annotated[
        bool,
        typer.Option("--antialiased", rich_help_panel=GSPLAT, help="Dim Gaussians that are smaller than a pixel."),
    ] = False,
    packed: Annotated[
        bool, typer.Option("--packed", rich_help_panel=GSPLAT, help="Less memory where a view sees little; slower.")
    ] = False,
    sparse_adam: Annotated[
        bool, typer.Option("--sparse-adam", rich_help_panel=GSPLAT, help="Step only the Gaussians that the view shows.")
    ] = False,
    rasterizer: Annotated[
        str,
        typer.Option(
            rich_help_panel=RUN,
            help="gsplat (CUDA), cpu, or oracle (slow, plain PyTorch, for checking). auto: gsplat where there is a "
            "CUDA device, else cpu.",
        ),
    ] = "auto",
    threads: Annotated[
        int | None,
        typer.Option(
            rich_help_panel=RUN, min=1, max=1024, help="Processor threads. Default: all this process may use."
        ),
    ] = None,
    cache: Annotated[
        str,
        typer.Option(
            rich_help_panel=RUN,
            help="Where finished levels' predictions are kept: gpu, memory or disk. auto: a GPU while those of "
            "training views are a small part of it, else memory.",
        ),
    ] = "auto",
    cache_precision: Annotated[
        str,
        typer.Option(
            rich_help_panel=RUN,
            help="How they are stored, at their own size and before Up: float32, float16 or uint8. auto: float16 on "
            "a GPU, else float32.",
        ),
    ] = "auto",
    test_every: Annotated[
        int | None,
        typer.Option(
            rich_help_panel=RUN, min=1, help="Measure held-out PSNR this often. Default: at the end of each stage."
        ),
    ] = None,
    breakdown: Annotated[
        bool,
        typer.Option(
            "--breakdown",
            rich_help_panel=RUN,
            help="Measure where the time of iterations goes: forward, loss, backward, densification, optimizer, other.",
        ),
    ] = False,
    checkpoint_every: Annotated[
        int | None,
        typer.Option(
            rich_help_panel=RUN,
            min=1,
            help="Iterations between checkpoints; by default one is written every minute. Ctrl-C writes one too.",
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue the run in --out where it stopped, with its settings.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the run in --out.")] = False,
    view: ViewOption = False,
    view_port: ViewPortOption = None,
) -> None:
    """Train SCENE level by level, from small images to its own, into the run folder --out.

    Examples:

        lapgs train data/garden -o runs/garden --resolution 1/4 --iterations 3000 --eval

        lapgs train data/garden -o runs/plain --levels 1       (the baseline: one field)

        lapgs train data/garden -o runs/bands --hierarchy laplacian       (the paper's method: a base and a residual)

        lapgs train data/garden -o runs/garden --resume        (after Ctrl-C or a crash)
    """
    from rich.console import Console
    from rich.markup import escape

    from lapgs_plugin.hierarchy.inheritance import parse_inheritance
    from lapgs_plugin.runs.archive import SceneReference
    from lapgs_plugin.training.backend import ANTIALIASING, AUTO, choose_rasterizer
    from lapgs_plugin.training.settings import ABSGRAD_THRESHOLD, Densification, LearningRates, TrainSettings

    if resume and overwrite:
        raise UserInputError("--resume and --overwrite contradict each other: give the one that is meant")
    check_residual_options(hierarchy, {"--inherit": inherit})
    mode, ratio = parse_inheritance(DEFAULT_INHERITANCE if inherit is None else inherit)
    watcher = context.with_resource(watching(view, view_port, out.absolute().name))
    settings = TrainSettings(
        iterations=iterations,
        levels=levels,
        hierarchy=hierarchy,
        split=None if split is None else tuple(part.strip() for part in split.split(",")),
        grid=grid,
        supervision=supervision,
        inherit=mode,
        inherit_ratio=ratio,
        joint=joint,
        gather=gather,
        views_per_step=_views_per_step(views_per_step),
        sh_degree=sh_degree,
        base_sh_degree=base_sh_degree,
        seed=seed,
        cache=cache,
        cache_precision=cache_precision,
        learning_rates=LearningRates(sh_rest_factor=sh_rate_factor, sh_rest_decay=sh_rate_decay),
        densification=Densification(
            densify_from,
            densify_until,
            densify_every,
            opacity_reset_every,
            strategy=strategy,
            absgrad=absgrad,
            cap_max=cap_max,
            base_cap_max=base_cap_max,
            coarse_threshold=coarse_threshold,
            residual_threshold=residual_threshold,
            base_share=base_densify_share,
            prune=prune,
            error_threshold=error_threshold,
            error_pixels=error_pixels,
            split_absgrad2d=ABSGRAD_THRESHOLD if split_threshold is None else split_threshold,
            grow_grad2d=(ABSGRAD_THRESHOLD if absgrad else Densification.grow_grad2d)
            if densify_threshold is None
            else densify_threshold,
        ),
        packed=packed,
        sparse_adam=sparse_adam,
        raster={ANTIALIASING: True} if antialiased else {},
    )
    reference = SceneReference(str(scene.absolute()), resolution, hold_out, _color(background), images=images, kind="")
    console = Console(stderr=True)
    if resume:
        given = given_options(context) - ({"rasterizer"} if rasterizer == AUTO else set())
        kept = {"cache": cache, "cache_precision": cache_precision}
        archive, loaded, settings = _resume(
            *(out, scene, _options(reference, settings, rasterizer), given),
            {name: value for name, value in kept.items() if name in given},
        )
    else:
        archive, loaded = _create(out, reference, settings, choose_rasterizer(rasterizer), overwrite)
    with archive:
        _run(
            archive,
            loaded,
            settings,
            console,
            threads=threads,
            test_every=test_every,
            breakdown=breakdown,
            checkpoint_every=checkpoint_every,
            resume=resume,
            watcher=watcher,
        )
    keep_preview(out.absolute())
    name, word = escape(str(out)), escape(shlex.quote(str(out)))
    console.print(
        f"[bold]{name}[/bold] holds the run; look at it with `lapgs eval {word}` and `lapgs render {word}`",
        soft_wrap=True,
    )


def _color(text: str) -> tuple[float, float, float]:
    """--background as RGB."""
    if text in BACKGROUNDS:
        return BACKGROUNDS[text]
    try:
        red, green, blue = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UserInputError(f"--background {text!r}: expected black, white or R,G,B such as 0.5,0.5,0.5") from error
    if not all(0.0 <= value <= 1.0 for value in (red, green, blue)):
        raise UserInputError(f"--background {text!r}: expected three values from 0 to 1")
    return red, green, blue


def _views_per_step(text: str) -> int | None:
    """--views-per-step as a number, None for auto."""
    if text == "auto":
        return None
    try:
        return int(text)
    except ValueError as error:
        raise UserInputError(f"--views-per-step {text}: expected auto, or a number of views from 1 on") from error


def _options(reference: SceneReference, settings: TrainSettings, rasterizer: str) -> dict[str, Any]:
    """What decides a run's result, by the name of its option."""
    densification = settings.densification
    return {
        "resolution": reference.resolution,
        "images": reference.images,
        "hold_out": reference.eval,
        "background": reference.background,
        "rasterizer": rasterizer,
        "inherit": (settings.inherit, settings.inherit_ratio),
        "densify_from": densification.start,
        "densify_until": densification.until,
        "densify_every": densification.every,
        "base_densify_share": densification.base_share,
        "densify_threshold": densification.grow_grad2d,
        "coarse_threshold": densification.coarse_threshold,
        "residual_threshold": densification.residual_threshold,
        "prune": densification.prune,
        "opacity_reset_every": densification.reset_every,
        "strategy": densification.strategy,
        "split_threshold": densification.split_absgrad2d,
        "error_threshold": densification.error_threshold,
        "error_pixels": densification.error_pixels,
        "cap_max": densification.cap_max,
        "base_cap_max": densification.base_cap_max,
        "absgrad": densification.absgrad,
        "antialiased": bool(settings.raster),
        "sh_rate_factor": settings.learning_rates.sh_rest_factor,
        "sh_rate_decay": settings.learning_rates.sh_rest_decay,
        **{
            name: getattr(settings, name)
            for name in (
                *("iterations", "levels", "hierarchy", "split", "supervision", "grid", "joint", "gather"),
                *("views_per_step", "sh_degree", "base_sh_degree", "seed", "packed", "sparse_adam"),
            )
        },
    }


def _resume(
    out: Path, scene: Path, wanted: dict[str, Any], given: set[str], anew: Mapping[str, Any]
) -> tuple[RunArchive, Scene, TrainSettings]:
    """Open a run to continue it, refusing a scene and options that are others than it was started with.

    A scene may have moved: then there is none any more where it was.

    Returns:
        The run, its scene, and its settings, of which `anew` gives those that may change.
    """
    from lapgs_plugin.rendering.run import require_same_scene
    from lapgs_plugin.runs.archive import RunArchive
    from lapgs_plugin.training.backend import training_rasterizer
    from lapgs_plugin.training.settings import TrainSettings
    from lapgs_plugin.training.trainer import check_cache

    archive = RunArchive.open(out, resume=True)
    try:
        manifest = archive.manifest
        before = Path(manifest.scene.path)
        if before.exists() and scene.exists() and not before.samefile(scene):
            raise UserInputError(
                f"{scene}: the run in {out} was started with the scene {before}; give that one to continue it, or "
                "start again with --overwrite"
            )
        settings = TrainSettings.from_manifest(manifest)
        started_with = _options(manifest.scene, settings, manifest.rasterizer)
        for name in sorted(given & wanted.keys()):
            if wanted[name] != started_with[name]:
                option = "--eval" if name == "hold_out" else "--" + name.replace("_", "-")
                raise UserInputError(
                    f"{option} asks for {wanted[name]}, but the run in {out} was started with {started_with[name]}; "
                    "leave the option out to continue it, or start again with --overwrite"
                )
        settings = replace(settings, **anew)
        check_cache(settings, training_rasterizer(manifest.rasterizer, settings).device)
        loaded = _load(replace(manifest.scene, path=str(scene.absolute())))
        require_same_scene(archive, scene, loaded.smallest_size)
    except BaseException:
        archive.close()
        raise
    return archive, loaded, settings


def _load(reference: SceneReference) -> Scene:
    from lapgs_plugin.scenes import load_scene

    return load_scene(
        reference.path,
        resolution=reference.resolution,
        images=reference.images,
        eval=reference.eval,
        background=reference.background,
    )


def _create(
    out: Path, reference: SceneReference, settings: TrainSettings, rasterizer: str, overwrite: bool
) -> tuple[RunArchive, Scene]:
    """Read the scene, check that it can be trained as asked, and only then make the run folder."""
    from lapgs_plugin.runs.archive import Manifest, RunArchive
    from lapgs_plugin.training.backend import training_rasterizer
    from lapgs_plugin.training.trainer import check_cache, make_plan

    RunArchive.require_room(out, overwrite)
    check_cache(settings, training_rasterizer(rasterizer, settings).device)
    loaded = _load(reference)
    make_plan(loaded, settings)
    manifest = Manifest(
        scene=replace(reference, kind=loaded.kind),
        rasterizer=rasterizer,
        **settings.for_manifest(),
    )
    return RunArchive.create(out, manifest, overwrite), loaded


def _run(
    archive: RunArchive,
    scene: Scene,
    settings: TrainSettings,
    console: Console,
    *,
    threads: int | None,
    test_every: int | None,
    breakdown: bool,
    checkpoint_every: int | None,
    resume: bool,
    watcher: Watcher,
) -> None:
    """Train with a progress display."""
    import torch

    from lapgs_plugin.jit.threads import one_pool
    from lapgs_plugin.training.backend import training_rasterizer
    from lapgs_plugin.training.monitor import ProgressMonitor
    from lapgs_plugin.training.trainer import Trainer

    if threads is not None:
        torch.set_num_threads(threads)
    manifest = archive.manifest
    placed = training_rasterizer(manifest.rasterizer, settings)
    with one_pool(), ProgressMonitor(console, manifest.levels) as monitor:
        trainer = Trainer(
            scene=scene,
            settings=settings,
            archive=archive,
            rasterizer=placed.rasterizer,
            device=placed.device,
            monitor=monitor,
            checkpoint_every=checkpoint_every,
            test_every=test_every,
            breakdown=breakdown,
            watcher=watcher,
        )
        trainer.run(resume)
