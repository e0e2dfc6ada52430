"""Expand an experiment to its runs: scenes x backbones x variants x seeds, in the order of their start."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import product
from typing import Any, ClassVar, TypeVar

from lapgs_bench.experiments.schema import OF_BARE_RUNS, SCRIPT, Backbone, Experiment, SampleScene, Scenes, Variant
from lapgs_bench.experiments.settings import Selection
from lapgs_bench.experiments.standard import DATASETS, PRESETS
from lapgs_plugin.errors import UserInputError, nearest
from lapgs_plugin.hierarchy.plan import DEFAULT_HIERARCHY
from lapgs_plugin.untrusted import STRICT

T = TypeVar("T")


@dataclass(frozen=True)
class SceneSpec:
    """Describe one scene of an experiment.

    Attributes:
        dataset: "" without one.
        folder: as in the experiment, relative to its file; None when only --path or a variable gives it.
        sample, resolution, images: see `schema.Scenes`.
    """

    name: str
    dataset: str
    folder: str | None
    sample: SampleScene | None
    resolution: str
    images: str


@dataclass(frozen=True)
class RunSpec:
    """Describe one training run: everything that decides its result except the machine and the folders.

    Attributes:
        rasterizer, checkout: one of the two, see `schema.Backbone`.
        script: of the checkout.
        method: "hierarchy" or "bare".
        options: of `lapgs train` or `lapgs run`.
        arguments: of the checkout's script.
        sample: `schema.SampleScene.label` of a scene that was made, "" for others.
    """

    __pydantic_config__: ClassVar[Any] = STRICT

    scene: str
    dataset: str
    images: str
    resolution: str
    backbone: str
    rasterizer: str | None
    checkout: str | None
    method: str
    iterations: int
    seed: int
    options: Mapping[str, Any]
    arguments: Sequence[str]
    sample: str = ""
    script: str = SCRIPT

    @cached_property
    def run_id(self) -> str:
        """Name of the run, by its settings. Variants with equal settings share their runs."""
        settings = asdict(self)
        if self.script == SCRIPT:
            del settings["script"]  # runs keep the names that they had before experiments could choose a script
        digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]
        last_first = list(self.options.items())[::-1]  # the variant's own options are last, and say most
        setting = "".join(f"-{name}{value}" for name, value in last_first)[:40]
        words = f"{self.scene}-{self.backbone}-{self.method}{setting}-s{self.seed}"
        return re.sub(r"[^A-Za-z0-9.-]+", "_", words) + f"-{digest}"


@dataclass(frozen=True)
class PlannedRun:
    """Pair a run with a variant that asks for it."""

    spec: RunSpec
    variant: str


def scenes_of(experiment: Experiment, selection: Selection) -> list[SceneSpec]:
    """Return the selected scenes in the file's order.

    Raises:
        UserInputError: a selected scene is not in the file.
    """
    scenes = {scene.name: scene for entry in experiment.scenes for scene in _scenes(entry)}
    return list(_selected(scenes, selection.scenes, "--scene").values())


def plan_runs(experiment: Experiment, selection: Selection) -> list[PlannedRun]:
    """Plan all runs: for every seed and scene all variants in turn, each time starting with another one.

    The rotation spreads a slow-down of the machine over all variants.

    Raises:
        UserInputError: a selected name is not in the file.
    """
    backbones = _selected(experiment.backbones, selection.backbones, "--backbone")
    variants = _selected({one.name: one for one in experiment.variants}, selection.variants, "--variant")
    pairs = [
        (name, backbone, variant)
        for variant in variants.values()
        for name, backbone in backbones.items()
        if not variant.backbones or name in variant.backbones
    ]
    if not pairs:
        raise UserInputError("no run is left: the selected variants are not for the selected backbones")
    planned: list[PlannedRun] = []
    for seed, scene in product(selection.seeds_or(experiment.seeds), scenes_of(experiment, selection)):
        for name, backbone, variant in pairs:
            spec = _spec(experiment, selection, scene, name, backbone, variant, seed)
            planned.append(PlannedRun(spec, variant.name))
        pairs = [*pairs[1:], pairs[0]]
    return planned


def _spec(
    experiment: Experiment,
    selection: Selection,
    scene: SceneSpec,
    name: str,
    backbone: Backbone,
    variant: Variant,
    seed: int,
) -> RunSpec:
    chosen = variant.preset.get(name, backbone.preset)
    preset = None if chosen is None else PRESETS[chosen]
    iterations = _iterations(experiment, selection, variant)
    published = [] if preset is None else preset.arguments(scene.name, iterations)
    options = {**backbone.options, **({} if preset is None else preset.options), **variant.options}
    if variant.method != "bare":
        # Stored even when the file does not set it: a changed default must make a new run.
        options = {"hierarchy": DEFAULT_HIERARCHY.value, **options}
    elif backbone.checkout is not None:
        # A script that runs by itself has no hierarchy.
        options = {name: value for name, value in options.items() if name in OF_BARE_RUNS}
    return RunSpec(
        scene=scene.name,
        dataset=scene.dataset,
        images=scene.images,
        resolution=variant.resolution or scene.resolution,
        backbone=name,
        rasterizer=backbone.rasterizer,
        checkout=backbone.checkout,
        method=variant.method,
        iterations=iterations,
        seed=seed,
        options=options,
        arguments=[] if backbone.checkout is None else [*published, *backbone.arguments, *variant.arguments],
        sample="" if scene.sample is None else scene.sample.label,
        script=backbone.script,
    )


def _iterations(experiment: Experiment, selection: Selection, variant: Variant) -> int:
    own = variant.iterations or experiment.iterations
    return own if selection.iterations is None else max(1, round(own * selection.iterations / experiment.iterations))


def _scenes(entry: Scenes) -> Iterator[SceneSpec]:
    if entry.dataset is None:
        assert entry.name is not None, "checked by the schema"
        yield SceneSpec(entry.name, "", entry.path, entry.sample, entry.resolution, entry.images)
        return
    known = DATASETS[entry.dataset].scenes
    for name in entry.names:
        images = known[name] if entry.images == "downscaled" else entry.images
        yield SceneSpec(name, entry.dataset, None, None, entry.resolution, images)


def _selected(items: Mapping[str, T], wanted: Collection[str] | None, option: str) -> dict[str, T]:
    for name in wanted or ():
        if name not in items:
            raise UserInputError(f"{option} {name}: not in the experiment; {nearest(name, items.keys())}")
    return {name: item for name, item in items.items() if wanted is None or name in wanted}
