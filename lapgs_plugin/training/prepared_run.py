"""Hold a run of the built-in trainer that is ready to train: its choices are decided and checked."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.fields.gaussian_field import GaussianField, field_from_splats
from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.fields.units import in_unit
from lapgs_plugin.hierarchy.plan import Stage, StagePlan, level_size
from lapgs_plugin.ops.mixed_sizes import similar_sizes
from lapgs_plugin.rasterizers.choice import PlacedRasterizer
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import CACHE
from lapgs_plugin.runs.manifest import LevelRecord
from lapgs_plugin.scenes.depth import DepthTargets
from lapgs_plugin.scenes.scene import Scene, View
from lapgs_plugin.stages.run import StagedRun
from lapgs_plugin.training.densification import DensityControl, control_of
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.planning import iterations_continued, make_plan
from lapgs_plugin.training.quality import set_aside, set_aside_to_stop
from lapgs_plugin.training.ranks.group import ALONE, Ranks
from lapgs_plugin.training.ranks.sharding import WholeFields, sharding_of
from lapgs_plugin.training.ranks.steps import WholeSteps, steps_of
from lapgs_plugin.training.schedule import MOST_PADDING, StageSchedule, views_per_step
from lapgs_plugin.training.settings import BEST, TrainingControl, TrainSettings
from lapgs_plugin.training.strategies import Strategy


def split_aside(scene: Scene, settings: TrainSettings) -> tuple[Scene, tuple[View, ...]]:
    """Return the scene without the training views that are set aside for --keep best, and these."""
    aside = set_aside(scene.train) if settings.keep == BEST else []
    names = {view.name for view in aside}
    return replace(scene, train=tuple(view for view in scene.train if view.name not in names)), tuple(aside)


def own_names(scene: Scene, aside: Sequence[View], steps: WholeSteps, ranks: Ranks) -> frozenset[str]:
    """Return the names of the views whose images a rank has.

    Args:
        scene: without the views set aside.
        aside: these.
        steps: of any stage.
        ranks: the group.
    """
    trained = [scene.train[index] for part in steps.own(range(len(scene.train))) for index in part]
    measured = (*scene.test, *aside)[ranks.rank :: ranks.size]
    return frozenset(view.name for view in (*trained, *measured))


@dataclass(frozen=True)
class PreparedRun(StagedRun):
    """Hold a run that is ready to train. `preparation.prepare` makes it from a request, `of` from a scene in memory.

    Attributes:
        settings: of the run; the archive's manifest has the same.
        scene: its training views are those that are trained on.
        aside: training views that were set aside to choose the best state; empty without --keep best.
        planned: the stages as the settings ask for them; `plan` has the lengths that were decided since.
        rasterizer: renders every field on the device, in world units.
        control: how the run is executed and observed.
        resumes: whether the run continues from its checkpoint, or after its last finished level.
        first_field: the first stage starts from it; None starts from the scene's points.
        began: when the seconds of --time began, by `time.monotonic`; None goes on with those that are left.
        depth: of the training views; None without.
        normals: (3, h, w) of training views by name, as `load_normals` returns them.
        ranks: the processes that train it.
        sharding: which Gaussians of a field this rank trains.
        part_of_views: whether its views are only some of those that the coarser levels were trained on.
    """

    settings: TrainSettings
    scene: Scene
    aside: tuple[View, ...]
    planned: StagePlan
    rasterizer: Rasterizer
    control: TrainingControl
    resumes: bool
    first_field: GaussianField | None
    began: float | None
    depth: DepthTargets | None
    normals: Mapping[str, Tensor]
    ranks: Ranks
    sharding: WholeFields
    part_of_views: bool = False

    @classmethod
    def of(
        cls,
        scene: Scene,
        settings: TrainSettings,
        archive: RunArchive,
        placed: PlacedRasterizer,
        control: TrainingControl | None = None,
        *,
        resumes: bool = False,
        first_field: GaussianField | None = None,
        began: float | None = None,
        depth: DepthTargets | None = None,
        normals: Mapping[str, Tensor] | None = None,
        ranks: Ranks = ALONE,
        shard: bool = False,
    ) -> PreparedRun:
        """Return the run of a scene in memory.

        Args:
            scene: with all its training views.
            settings: of the run.
            archive: open for writing.
            placed: as `backend.training_rasterizer` returns it. The manifest's scene has the unit of its lengths.
            control, resumes, first_field, began, depth, normals, ranks: see the attributes; by default the run is new,
                starts from the points without depth and normals, a time begins with the training, and this process
                trains alone.
            shard: divide the Gaussians over the ranks.

        Raises:
            UserInputError: as `make_plan`.
        """
        sharding = sharding_of(ranks, shard)
        plan = make_plan(scene.smallest_size, settings, len(scene.train))
        trained, aside = split_aside(scene, settings)
        run = cls(
            scene=trained,
            aside=aside,
            settings=settings,
            plan=plan,
            planned=plan,
            archive=archive,
            rasterizer=sharding.rasterizer(in_unit(placed.rasterizer, archive.manifest.scene.unit)),
            device=placed.device,
            control=control or TrainingControl(),
            resumes=resumes,
            first_field=first_field,
            began=began,
            depth=depth,
            normals=normals or {},
            ranks=ranks,
            sharding=sharding,
        )
        # Their lengths were decided while they were trained.
        for record in archive.manifest.records if settings.time is not None or settings.stops_early else ():
            run = run.lasting(record.level, record.iterations)
        return run

    @property
    def background(self) -> Tensor:
        """(3,) colour behind the base, on the device."""
        return torch.tensor(self.scene.background).to(self.device)

    @property
    def batches(self) -> bool:
        """Whether views are rendered together; a pose's gradient needs the Gaussians' gradients of its view alone."""
        return not self.settings.refine_poses and self.rasterizer.can_batch

    @property
    def cache_folder(self) -> Path:
        """See `StagedRun`; each rank has its own."""
        return self.archive.path(CACHE, f"rank_{self.ranks.rank}") if self.ranks.size > 1 else super().cache_folder

    @contextmanager
    def image_cache(self) -> Iterator[None]:
        """See `StagedRun`; rank 0 removes the images of all ranks of a killed run, which may have had more."""
        folder = self.archive.path(CACHE)
        if self.ranks.leads:
            shutil.rmtree(folder, ignore_errors=True)
        self.ranks.wait()
        try:
            with super().image_cache():
                yield
        finally:
            with suppress(OSError):  # other ranks may have images there
                folder.rmdir()

    @cached_property
    def withheld(self) -> tuple[View, ...]:
        """Training views that are not trained on before the lengths of levels are decided, for --stop auto."""
        return tuple(set_aside_to_stop(self.scene.train)) if self.settings.stops_early else ()

    def steps_of(self, stage: Stage, views: int) -> WholeSteps:
        """Return which of so many views the steps of a stage have, and which of them this process renders."""
        settings, sharded = self.settings, self.sharding.divides
        return steps_of(views, settings.seed, stage.level, settings.ranks, self.ranks, self.device, sharded=sharded)

    @cached_property
    def own(self) -> frozenset[str]:
        """Names of the views whose images this rank has."""
        return own_names(self.scene, self.aside, self.steps_of(self.plan[0], len(self.scene.train)), self.ranks)

    def owned(self, views: Sequence[View]) -> tuple[View, ...]:
        """Return those views whose images this rank has."""
        return tuple(view for view in views if view.name in self.own)

    def size_groups(self, level: int) -> dict[tuple[int, int], int]:
        """Return the groups of the training views' sizes at a level whose views can be rendered together."""
        sizes = [level_size(view.camera.size, level) for view in self.scene.train]
        return similar_sizes(sizes, MOST_PADDING if self.rasterizer.mixes_sizes else 0.0)

    def lasting(self, level: int, iterations: int) -> PreparedRun:
        """Return the run whose stage of a level has so many iterations, and finer ones in proportion.

        The result depends on the lengths of coarser levels and on this one alone, not on what was planned in between.
        """
        plan = self.planned
        for stage in self.plan:
            if stage.level > level:
                plan = plan.lasting(stage.level, stage.iterations)
        plan = plan.lasting(level, iterations)
        return replace(self, plan=plan, settings=self.settings.lasting(plan.iterations))

    def strategy_of(self, stage: Stage) -> Strategy:
        """Return the strategy of density control with the options of a stage."""
        sizes = [level_size(view.camera.size, stage.level) for view in self.scene.train]
        return self.settings.strategy_of(stage, sum(map(math.prod, sizes)))

    def gaussians_to_archive(self, stage: Stage) -> int:
        """Return how many Gaussians are archived when a stage has ended, at most; 0 without a limit."""
        joint = self.settings.joint_from(stage) is not None
        written = [each for each in self.plan if each.level == stage.level or (joint and each.level > stage.level)]
        return sum(self.strategy_of(each).most or 0 for each in written)

    def density_control(self, stage: Stage, schedule: StageSchedule) -> DensityControl:
        """Return the density control of a stage."""
        control = control_of(self.sharding.strategy(self.strategy_of(stage)), schedule, self.scene.extent)
        control.ranks = self.sharding.edits_with(self.ranks)
        return control

    def schedule_of(self, stage: Stage) -> StageSchedule:
        """Return the schedule of a stage."""
        views = len(self.scene.train)
        together = self.steps_of(stage, views).trained(views_per_step(self.settings, stage, views, self.batches))
        return StageSchedule.create(self.settings, stage, iterations_continued(self.plan, stage), together, views)

    def record_to_extend(self, stage: Stage) -> LevelRecord | None:
        """Return the record of a finished stage that is to train on; None for all others."""
        done = {record.level: record for record in self.archive.manifest.records}.get(stage.level)
        whole = stage.iterations + self.settings.extension_of(stage)
        return done if done is not None and done.iterations < whole else None

    def model(self, field: GaussianField) -> TrainableField:
        """Return those Gaussians of a field that this rank trains, ready on the device, with empty moments."""
        rates, extent, sparse = self.settings.rates, self.scene.extent, self.settings.sparse_adam
        return TrainableField.create(self.sharding.dealt(field).to(self.device), rates, extent, sparse=sparse)

    def restored_model(self, state: dict[str, Any]) -> TrainableField:
        """Return the model of a `TrainableField.state`, on the device."""
        field = field_from_splats(state["params"], state["signed"])
        model = self.model(field)
        model.adopt_moments(state["moments"], self.sharding.rows(len(field)))
        return model
