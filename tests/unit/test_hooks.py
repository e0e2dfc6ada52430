"""Test hooks: their order as one literal list, chaining, and errors when they are attached."""

from __future__ import annotations

import re
from dataclasses import FrozenInstanceError, fields
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin import hooks as hooks_module
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hierarchy.supervision import SUPERVISIONS
from lapgs_plugin.hooks import (
    Composition,
    FieldInTraining,
    HookDispatcher,
    StageContext,
    StageHook,
    SupervisionLoss,
    entry_point_hooks,
    hooks_line,
    verify_hook,
)
from lapgs_plugin.ops.photometric_loss.in_torch import photometric_loss_torch
from lapgs_plugin.reference_raster import OracleRasterizer
from lapgs_plugin.runner.hook_calls import HookCaller
from lapgs_plugin.runner.running_stage import Stages
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.training.settings import TrainSettings
from tests.plugin_package import install_package
from tests.refusals import refuses

BASE = Stage(level=1, image_size=(16, 12), iterations=5, signed=False)
RESIDUAL = Stage(level=0, image_size=(32, 24), iterations=9, signed=True)
CALLS: list[str] = []


@pytest.fixture(autouse=True)
def _no_calls_yet() -> None:
    CALLS.clear()


def context(stage: Stage = RESIDUAL) -> StageContext:
    shape = (3, stage.image_size[1], stage.image_size[0])
    target, accumulated, coarse = torch.rand(shape), torch.rand(shape), torch.rand(shape)
    if stage.signed:
        return StageContext(stage, 3, "a.jpg", target, accumulated, coarse)
    return StageContext(stage, 3, "a.jpg", target)


class Recorder(StageHook):
    """Note every call, and the image of calls that return something."""

    name = "recorder"

    def on_stage_start(self, stage: Stage) -> None:
        CALLS.append(f"{self.name} on_stage_start {stage.level}")

    def before_render(self, context: StageContext) -> None:
        CALLS.append(f"{self.name} before_render {context.iteration}")

    def compose(self, context: StageContext, image: Tensor) -> Tensor:
        CALLS.append(f"{self.name} compose {image.flatten()[0].item():g}")
        return image * 2

    def loss(self, context: StageContext, image: Tensor) -> Tensor | None:
        CALLS.append(f"{self.name} loss {image.flatten()[0].item():g}")
        return None

    def after_backward(self, context: StageContext) -> None:
        CALLS.append(f"{self.name} after_backward")

    def on_densify(self, context: StageContext) -> None:
        CALLS.append(f"{self.name} on_densify")

    def on_stage_end(self, stage: Stage) -> None:
        CALLS.append(f"{self.name} on_stage_end {stage.level}")


class ByEntryPointA(Recorder):
    name = "entry a"


class ByEntryPointB(Recorder):
    name = "entry b"


class ByArgument(Recorder):
    name = "argument"


class LastArgument(Recorder):
    name = "last"


class NoisyComposition(Composition):
    def compose(self, context: StageContext, image: Tensor) -> Tensor:
        CALLS.append(f"composition compose {image.flatten()[0].item():g}")
        return super().compose(context, image)


class NoisySupervision(SupervisionLoss):
    def loss(self, context: StageContext, image: Tensor) -> Tensor:
        CALLS.append(f"supervision loss {image.flatten()[0].item():g}")
        return image.mean()


def register(monkeypatch: pytest.MonkeyPatch, **entries: str) -> None:
    """Register hooks as installed packages would, in this order."""
    group = [EntryPoint(name=name, value=value, group="lapgs_plugin.hooks") for name, value in entries.items()]

    def find(*, group: str, _entries: list[EntryPoint] = group) -> list[EntryPoint]:
        return [entry for entry in _entries if entry.group == group]

    monkeypatch.setattr("importlib.metadata.entry_points", find)


def test_the_order_of_every_call(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch, b=f"{__name__}:ByEntryPointB", a=f"{__name__}:ByEntryPointA")
    monkeypatch.setattr(hooks_module, "Composition", NoisyComposition)
    monkeypatch.setattr(hooks_module, "SupervisionLoss", NoisySupervision)
    dispatcher = HookDispatcher.create(SUPERVISIONS["reconstructed"], 0.2, [ByArgument(), LastArgument()])
    shape = (3, 24, 32)
    here = StageContext(RESIDUAL, 3, "a.jpg", torch.zeros(shape), torch.full(shape, 0.5))

    dispatcher.on_stage_start(RESIDUAL)
    dispatcher.before_render(here)
    image = dispatcher.compose(here, torch.full(shape, 0.25))
    dispatcher.loss(here, image)
    dispatcher.after_backward(here)
    dispatcher.on_densify(here)
    dispatcher.on_stage_end(RESIDUAL)

    assert CALLS == [
        "entry a on_stage_start 0",
        "entry b on_stage_start 0",
        "argument on_stage_start 0",
        "last on_stage_start 0",
        "entry a before_render 3",
        "entry b before_render 3",
        "argument before_render 3",
        "last before_render 3",
        "composition compose 0.25",
        "entry a compose 0.75",
        "entry b compose 1.5",
        "argument compose 3",
        "last compose 6",
        "supervision loss 12",
        "entry a loss 12",
        "entry b loss 12",
        "argument loss 12",
        "last loss 12",
        "entry a after_backward",
        "entry b after_backward",
        "argument after_backward",
        "last after_backward",
        "entry a on_densify",
        "entry b on_densify",
        "argument on_densify",
        "last on_densify",
        "entry a on_stage_end 0",
        "entry b on_stage_end 0",
        "argument on_stage_end 0",
        "last on_stage_end 0",
    ]


def test_the_base_class_changes_nothing() -> None:
    hook, here = StageHook(), context()
    image = torch.rand(3, 24, 32)
    assert hook.compose(here, image) is image
    assert hook.loss(here, image) is None
    for call in (hook.before_render, hook.after_backward, hook.on_densify):
        call(here)
    for call_stage in (hook.on_stage_start, hook.on_stage_end):
        call_stage(RESIDUAL)


def test_stock_hooks_compose_and_supervise_both_kinds_of_stage() -> None:
    for name in SUPERVISIONS:
        dispatcher = HookDispatcher.create(SUPERVISIONS[name], 0.3)
        base, residual = context(BASE), context(RESIDUAL)
        rendered = torch.rand(3, 12, 16)
        assert torch.equal(dispatcher.compose(base, rendered), rendered)
        expected = photometric_loss_torch(rendered, base.target, 0.3)
        torch.testing.assert_close(dispatcher.loss(base, rendered), expected)

        rendered = torch.randn(3, 24, 32) * 0.1
        image = dispatcher.compose(residual, rendered)
        assert residual.accumulated is not None
        torch.testing.assert_close(image, rendered + residual.accumulated, rtol=0, atol=0)
        target = {
            "reconstructed": (image, residual.target),
            "online_residual": (rendered, residual.target - residual.accumulated),
            "gt_laplacian": (rendered, residual.target - residual.coarse_target),
        }[name]
        # The residual is taken from the composed image: one rounding of values up to 1.
        torch.testing.assert_close(
            dispatcher.loss(residual, image), photometric_loss_torch(*target, 0.3), rtol=1e-4, atol=1e-6
        )


def test_terms_of_the_loss_add_up_with_their_gradients() -> None:
    class Weight(StageHook):
        def loss(self, context: StageContext, image: Tensor) -> Tensor:
            return 3.0 * image.sum()

    here, image = context(), torch.rand(3, 24, 32, requires_grad=True)
    plain = HookDispatcher([SupervisionLoss(SUPERVISIONS["reconstructed"])]).loss(here, image)
    both = HookDispatcher([SupervisionLoss(SUPERVISIONS["reconstructed"]), Weight()]).loss(here, image)
    torch.testing.assert_close(both, plain + 3.0 * image.sum())
    (gradient,) = torch.autograd.grad(both - plain, image)
    torch.testing.assert_close(gradient, torch.full_like(image, 3.0), atol=1e-5, rtol=0)  # 0 seen


def test_a_hook_sees_no_more_than_the_context() -> None:
    images = {"target", "accumulated", "coarse_target", "weight"}
    assert set(vars(context())) == {"stage", "iteration", "view", "field"} | images
    assert [field.name for field in fields(FieldInTraining)] == ["gaussians", "camera", "rasterizer"]
    with pytest.raises(FrozenInstanceError):
        context().iteration = 1  # type: ignore[misc]  # that it is refused is what is tested


def test_wrong_returns_name_hook_and_method() -> None:
    class Forgetful(StageHook):
        def compose(self, context: StageContext, image: Tensor) -> Tensor:
            image.mul(2)
            return None  # type: ignore[return-value]  # the mistake under test

    class Cropping(StageHook):
        def compose(self, context: StageContext, image: Tensor) -> Tensor:
            return image[:, 1:]

    class PerPixel(StageHook):
        def loss(self, context: StageContext, image: Tensor) -> Tensor:
            return image

    class Number(StageHook):
        def loss(self, context: StageContext, image: Tensor) -> Any:
            return 0.5

    image = torch.rand(3, 24, 32)
    with pytest.raises(UserInputError, match=r"Forgetful: compose returned None, expected an image of shape"):
        HookDispatcher([Forgetful()]).compose(context(), image)
    with pytest.raises(UserInputError, match=r"Cropping: compose returned a Tensor of shape \(3, 23, 32\)"):
        HookDispatcher([Cropping()]).compose(context(), image)
    with pytest.raises(UserInputError, match=r"PerPixel: loss returned a Tensor of shape .* expected a scalar"):
        HookDispatcher([PerPixel()]).loss(context(), image)
    refuses(UserInputError, "Number: loss returned a float", HookDispatcher([Number()]).loss, context(), image)


def test_an_exception_of_a_users_hook_is_left_alone() -> None:
    class Failing(StageHook):
        def before_render(self, context: StageContext) -> None:
            raise ZeroDivisionError("theirs")

    with pytest.raises(ZeroDivisionError, match="theirs"):
        HookDispatcher([Failing()]).before_render(context())


def hook_with(**members: Any) -> StageHook:
    hook: StageHook = type("MyHook", (StageHook,), members)()
    return hook


@pytest.mark.parametrize(
    ("member", "function", "message"),
    [
        (
            "compose",
            lambda self, ctx, image: image,
            r"compose has the arguments \(ctx, image\), expected \(context, image\); look at ctx",
        ),
        ("compose", lambda self, image, context: image, r"expected \(context, image\)"),
        ("compose", lambda self, context: context, r"compose has the arguments \(context\), .*look at image"),
        ("loss", lambda self, context, image, weight: None, "look at weight"),
        ("loss", lambda self, context, *, image: None, r"loss has the arguments \(context, \*, image\)|look at"),
        ("loss", lambda self, *args: None, r"loss has the arguments \(\*args\)"),
        ("on_stage_start", lambda self: None, r"expected \(stage\); look at stage"),
        ("on_densify", None, r"on_densify is None, expected a method\(context\)"),
        ("loss", 0.2, r"loss is a float, expected a method\(context, image\)"),
    ],
)
def test_wrong_arguments_name_plugin_hook_and_argument(member: str, function: Any, message: str) -> None:
    with pytest.raises(UserInputError, match=rf"hook MyHook: {member} .*") as caught:
        HookDispatcher([hook_with(**{member: function})])
    assert caught.match(message)


@pytest.mark.parametrize(
    ("wrong", "hint"),
    [
        ("on_stage_started", "did you mean on_stage_start?"),
        ("before_rendering", "did you mean before_render?"),
        ("composes", "did you mean compose?"),
        ("after_backwards", "did you mean after_backward?"),
        ("on_densified", "did you mean on_densify?"),
        ("stage_end", "did you mean on_stage_end?"),
        (
            "on_epoch",
            "there are on_stage_start, before_render, compose, loss, after_backward, on_densify, on_stage_end.",
        ),
    ],
)
def test_misspelt_methods_are_found(wrong: str, hint: str) -> None:
    with pytest.raises(UserInputError, match=f"hook mine: {wrong} is not a method of StageHook; {re.escape(hint)}"):
        verify_hook(hook_with(**{wrong: lambda self: None}), "mine")


@pytest.mark.parametrize("name", ["_compose", "save_picture", "weight", "view"])
def test_a_hooks_own_methods_are_left_alone(name: str) -> None:
    verify_hook(hook_with(**{name: lambda self: None}), "mine")


def test_a_hooks_own_data_may_be_called_anything() -> None:
    verify_hook(hook_with(losses=[], on_device="cpu"), "mine")


def test_what_is_no_hook_is_refused() -> None:
    for thing in (object(), Recorder, None, lambda: None):
        with pytest.raises(UserInputError, match=r"expected an instance of lapgs_plugin\.hooks\.StageHook"):
            HookDispatcher([thing])  # type: ignore[list-item]  # the mistake under test


class Misspelt(StageHook):
    def before_rendering(self, context: StageContext) -> None: ...


class NeedsArguments(StageHook):
    def __init__(self, weight: float) -> None:
        self._weight = weight


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (f"{__name__}:Misspelt", "did you mean before_render"),
        (f"{__name__}:NeedsArguments", "cannot be created: TypeError"),
        (f"{__name__}:Absent", "cannot be created: AttributeError"),
        ("no_such_module_of_anybody:Hook", "cannot be created: ModuleNotFoundError"),
        ("pathlib:Path", "expected an instance of"),
    ],
)
def test_entry_points_that_cannot_be_used_are_named(monkeypatch: pytest.MonkeyPatch, value: str, message: str) -> None:
    register(monkeypatch, fancy=value)
    with pytest.raises(UserInputError, match=f"hook entry point fancy .{value}.") as caught:
        entry_point_hooks()
    assert caught.match(message)


@pytest.mark.parametrize(
    ("chosen", "names"),
    [("all", ["a", "b"]), ("none", []), ("b", ["b"]), ("b, a", ["a", "b"])],
)
def test_installed_hooks_are_chosen(monkeypatch: pytest.MonkeyPatch, chosen: str, names: list[str]) -> None:
    """By `lapgs train`, by `lapgs run`, and in the options of an experiment's variants."""
    register(monkeypatch, b=f"{__name__}:ByEntryPointB", a=f"{__name__}:ByEntryPointA")
    for settings in (TrainSettings(hooks=chosen), RunSettings(hooks=chosen)):
        dispatcher = HookDispatcher.create(SUPERVISIONS["reconstructed"], registered=settings.hooks)
        assert dispatcher.is_plain(BASE) == (not names)
        dispatcher.on_stage_start(BASE)
        assert [call.split()[1] for call in CALLS] == names
        CALLS.clear()
        assert bool(HookCaller(Stages(), registered=settings.hooks)) == bool(names)
        assert (hooks_line(settings.hooks) is None) == (not names)


def test_hooks_that_nobody_registers_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch, fancy=f"{__name__}:ByEntryPointA")
    for kind in (TrainSettings, RunSettings):
        with pytest.raises(UserInputError, match=r"--hooks fancy,plain: .* 'plain'; expected all, none, fancy") as e:
            kind(hooks="fancy,plain")
        assert "\n" not in str(e.value)


def test_an_installed_package_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hooks are found by a distribution's metadata on the path."""
    source = "from lapgs_plugin.hooks import StageHook\nclass Fancy(StageHook):\n    pass\n"
    install_package(tmp_path, monkeypatch, "my_hooks", "[lapgs_plugin.hooks]\nfancy = my_hooks:Fancy\n", source)
    assert [type(hook).__name__ for hook in entry_point_hooks()] == ["Fancy"]


def test_a_hook_renders_depths_with_gradients() -> None:
    """The left Gaussian is 2 units away, the right one 3; neither reaches the other's half of the image."""
    means = torch.tensor([[-1.0, 0.0, -3.0], [1.5, 0.0, -2.0]], dtype=torch.float64, requires_grad=True)
    field = GaussianField(
        means=means,
        quaternions=torch.tensor([[1.0, 0, 0, 0]] * 2, dtype=torch.float64),
        log_scales=torch.full((2, 3), -2.0, dtype=torch.float64),
        opacity_logits=torch.ones(2, dtype=torch.float64),
        sh=torch.full((2, 4, 3), 9.0, dtype=torch.float64),
    )
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 5.0  # the camera is 5 units behind the origin
    shown = FieldInTraining(field, Camera(24, 16, 12.0, 12.0, 12.0, 8.0, pose), OracleRasterizer())
    depth, opacity = shown.depth()
    assert depth.shape == opacity.shape == (16, 24)
    for half, distance in ((slice(0, 12), 2.0), (slice(12, 24), 3.0)):
        assert opacity[:, half].max() > 0.4
        torch.testing.assert_close(depth[:, half], distance * opacity[:, half])
    (depth.sum() - 2.0 * opacity[:, :12].sum() - 3.0 * opacity[:, 12:].sum()).backward()
    assert means.grad is not None
    expected = torch.stack([opacity[:, :12].sum(), opacity[:, 12:].sum()])  # opacities' own changes cancel out
    torch.testing.assert_close(means.grad[:, 2], expected.detach())
