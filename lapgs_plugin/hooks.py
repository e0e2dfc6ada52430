"""Let users' code take part in a stage: hooks, their context, and the order in which they run.

Every method is called in the same order of hooks: composition, supervision, hooks registered by entry point (by name),
hooks given as arguments. One iteration calls

    before_render  ->  (render)  ->  compose  ->  loss  ->  (backward)  ->  after_backward  ->  (step)  ->  on_densify

If a step accumulates several views, `before_render`, `compose` and `loss` are called for each of them with its own
image and iteration, and the losses are summed. `after_backward` and `on_densify` are called once a step, with the
context of its last view, after the gradients of all its views. A step that runs out of memory begins again.

`compose` is a chain: the first hook gets the rendered image, each other one the image of the hook before it. `loss` is
a sum: each hook gets the composed image and may add a term.
"""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from lapgs_plugin.errors import UserInputError, typed_line
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, render_depths, render_values
from lapgs_plugin.hierarchy.masks import fill_outside
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hierarchy.supervision import Reconstructed, Supervision
from lapgs_plugin.ops.composition import add_prediction
from lapgs_plugin.ops.photometric_loss import photometric_loss
from lapgs_plugin.ops.photometric_loss.in_torch import DEFAULT_SSIM_WEIGHT
from lapgs_plugin.registry import ALL, HOOKS, chosen_entries


@dataclass(frozen=True)
class FieldInTraining:
    """Render more of the field in training than its colours, such as depths for a term of the loss.

    Attributes:
        gaussians: the field as this iteration renders it; of a residual stage, the residual alone. Gradients reach its
            parameters.
        camera: of the view, at the stage's size.
        rasterizer: of the run.
    """

    gaussians: GaussianField
    camera: Camera
    rasterizer: Rasterizer

    def render(self, values: Tensor) -> Tensor:
        """Return values (n, 3) of the Gaussians blended as colours are, over zero: (3, h, w) with gradients."""
        return render_values(self.rasterizer, self.gaussians, self.camera, values)

    def depth(self) -> tuple[Tensor, Tensor]:
        """Return blended depths and opacity, (h, w) each, with gradients; their quotient is the mean depth of a pixel.

        Depths are distances along the camera's axis in world units.
        """
        return render_depths(self.rasterizer, self.gaussians, self.camera)


@dataclass(frozen=True)
class StageContext:
    """Describe the iteration that a hook runs in.

    Attributes:
        stage: level, size, length and colour map of the stage.
        iteration: number of the iteration in the stage, from 1.
        view: name of the training view.
        target: (3, h, w) ground truth I^l of the view at the stage's level.
        accumulated: (3, h, w) Up(I_hat^(l+1)) of the view, unclamped; None for the base.
        coarse_target: (3, h, w) Up(I^(l+1)) of the ground truth; None unless the supervision needs it.
        weight: (1, h, w) share of each pixel inside of the view's mask; None without masks.
        field: the field in training, while the view is rendered and its loss computed; None otherwise, and always
            under `lapgs run`, where the checkout's code renders.
    """

    stage: Stage
    iteration: int
    view: str
    target: Tensor  # (3, h, w)
    accumulated: Tensor | None = None  # (3, h, w)
    coarse_target: Tensor | None = None  # (3, h, w)
    weight: Tensor | None = None  # (1, h, w)
    field: FieldInTraining | None = None


class StageHook:
    """Do nothing in every method. Derive hooks from this class and override methods with the same arguments."""

    def on_stage_start(self, stage: Stage) -> None:
        """Run before a stage, new or resumed."""

    def before_render(self, context: StageContext) -> None:
        """Run at the start of an iteration."""

    def compose(self, context: StageContext, image: Tensor) -> Tensor:
        """Change the predicted image.

        Args:
            context: the iteration.
            image: (3, h, w) result of the hook before; for the first hook the rendered image, a residual if
                `context.stage.signed`.

        Returns:
            (3, h, w) image for the next hook and finally the loss; differentiable, not clamped.
        """
        return image

    def loss(self, context: StageContext, image: Tensor) -> Tensor | None:
        """Add a term to the loss.

        Args:
            context: the iteration.
            image: (3, h, w) composed prediction, at the exposure of the photo where that is compensated.

        Returns:
            A scalar, or None to add nothing.
        """
        return None

    def after_backward(self, context: StageContext) -> None:
        """Run after the backward passes of all views of a step, before the optimizer steps."""

    def on_densify(self, context: StageContext) -> None:
        """Run after density control has added, removed or reset Gaussians."""

    def on_stage_end(self, stage: Stage) -> None:
        """Run after a stage's last iteration, before its field is archived."""


class Composition(StageHook):
    """Add the upsampled coarser prediction to a rendered residual: I_hat^l = Up(I_hat^(l+1)) + R_hat^l."""

    def compose(self, context: StageContext, image: Tensor) -> Tensor:
        return add_prediction(image, context.accumulated)


class SupervisionLoss(StageHook):
    """Compute the photometric loss of the two images that a supervision chooses.

    Args:
        supervision: the supervision.
        ssim_weight: lambda of the photometric loss, in [0, 1].
    """

    def __init__(self, supervision: Supervision, ssim_weight: float = DEFAULT_SSIM_WEIGHT) -> None:
        self._supervision = supervision
        self._ssim_weight = ssim_weight

    @property
    def compares_images(self) -> bool:
        """Whether the supervision compares the composed image with the target."""
        return type(self._supervision) is Reconstructed

    def loss(self, context: StageContext, image: Tensor) -> Tensor:
        prediction, target = image, context.target
        if context.accumulated is not None:  # the base is always compared with its target
            pair = self._supervision.pair(image, target, context.accumulated, context.coarse_target)
            if not isinstance(pair, (tuple, list)) or len(pair) != 2:
                name = type(self._supervision).__qualname__
                raise UserInputError(f"supervision {name}: pair returned {_describe(pair)}, expected two images")
            prediction, target = pair
        return photometric_loss(fill_outside(prediction, target, context.weight), target, self._ssim_weight)


class HookDispatcher:
    """Call the hooks of a run.

    Args:
        hooks: hooks in the order in which they run.

    Raises:
        UserInputError: an object is not a usable hook (see `verify_hook`).
    """

    def __init__(self, hooks: Sequence[StageHook]) -> None:
        for hook in hooks:
            verify_hook(hook, type(hook).__qualname__)
        self._hooks = tuple(hooks)

    @classmethod
    def create(
        cls,
        supervision: Supervision,
        ssim_weight: float = DEFAULT_SSIM_WEIGHT,
        user_hooks: Sequence[StageHook] = (),
        registered: str = ALL,
    ) -> HookDispatcher:
        """Return a dispatcher of composition, supervision, the hooks registered by entry point, and `user_hooks`.

        `registered` chooses those by entry point as `entry_point_hooks` takes it.

        Raises:
            UserInputError: a user's hook is not usable; the line names it.
        """
        stock = (Composition(), SupervisionLoss(supervision, ssim_weight))
        return cls((*stock, *entry_point_hooks(registered), *user_hooks))

    def is_plain(self, stage: Stage) -> bool:
        """Return whether the loss of a stage is the photometric loss of the composed image, without any user's hook."""
        supervised = [hook for hook in self._hooks if type(hook) is SupervisionLoss]
        others = [hook for hook in self._hooks if type(hook) not in (SupervisionLoss, Composition)]
        compares_images = all(hook.compares_images for hook in supervised) or not stage.signed
        return len(supervised) == 1 and not others and compares_images

    @property
    def takes_batches(self) -> bool:
        """Whether `compose` and `loss` take images of several views, (b, 3, h, w), with a context of such images.

        Users' hooks are written for one view.
        """
        return all(isinstance(hook, (Composition, SupervisionLoss)) for hook in self._hooks)

    def on_stage_start(self, stage: Stage) -> None:
        for hook in self._hooks:
            hook.on_stage_start(stage)

    def before_render(self, context: StageContext) -> None:
        for hook in self._hooks:
            hook.before_render(context)

    def compose(self, context: StageContext, rendered: Tensor) -> Tensor:
        """Return the iteration's prediction (3, h, w), given the rendered image."""
        image = rendered
        for hook in self._hooks:
            composed = hook.compose(context, image)
            if not isinstance(composed, Tensor) or composed.shape != image.shape:
                raise UserInputError(
                    f"hook {type(hook).__qualname__}: compose returned {_describe(composed)}, "
                    f"expected an image of shape {tuple(image.shape)}"
                )
            image = composed
        return image

    def loss(self, context: StageContext, image: Tensor) -> Tensor:
        """Return the sum of all hooks' terms, a scalar."""
        total = self.extra_loss(context, image)
        assert total is not None, "no hook supervises"
        return total

    def extra_loss(self, context: StageContext, image: Tensor) -> Tensor | None:
        """Return the sum of all hooks' terms, a scalar; None without any."""
        total: Tensor | None = None
        for hook in self._hooks:
            term = hook.loss(context, image)
            if term is None:
                continue
            if not isinstance(term, Tensor) or term.ndim != 0:
                raise UserInputError(
                    f"hook {type(hook).__qualname__}: loss returned {_describe(term)}, expected a scalar Tensor or None"
                )
            total = term if total is None else total + term
        return total

    def after_backward(self, context: StageContext) -> None:
        for hook in self._hooks:
            hook.after_backward(context)

    def on_densify(self, context: StageContext) -> None:
        for hook in self._hooks:
            hook.on_densify(context)

    def on_stage_end(self, stage: Stage) -> None:
        for hook in self._hooks:
            hook.on_stage_end(stage)


def entry_point_hooks(registered: str = ALL) -> tuple[StageHook, ...]:
    """Return the hooks that installed packages register in the group `registry.HOOKS`, sorted by name.

    Args:
        registered: "all", "none", or names separated by commas: the value of --hooks.

    Raises:
        UserInputError: a name is unknown; or one cannot be imported or created, or is not a usable hook; the line names
            it.
    """
    hooks = []
    for entry in chosen_entries("--hooks", HOOKS, registered):
        source = f"entry point {entry.name} ({entry.value})"
        try:
            hook = entry.load()()
        except Exception as error:  # any error of a plugin's code must name the plugin
            raise UserInputError(
                f"hook {source} cannot be created: {typed_line(error)}; "
                "expected a StageHook class without arguments, fix or uninstall the package that brings it, or leave "
                "it out with --hooks"
            ) from error
        verify_hook(hook, source)
        hooks.append(hook)
    return tuple(hooks)


def hooks_line(registered: str = ALL) -> str | None:
    """Return a line that lists the hooks of installed packages, chosen as in `entry_point_hooks`; None without any."""
    chosen = [f"{entry.name} ({entry.value})" for entry in chosen_entries("--hooks", HOOKS, registered)]
    return f"hooks of installed packages: {', '.join(chosen)}" if chosen else None


HOOK_NAMES = tuple(name for name in vars(StageHook) if not name.startswith("_"))
"""The methods of a hook, in the order of a stage."""


def verify_hook(hook: object, source: str) -> None:
    """Check that an object is a hook whose methods have StageHook's names and arguments.

    Args:
        hook: any object.
        source: name of the hook for the message.

    Raises:
        UserInputError: it is not; the line names the source, the method and the argument.
    """
    if not isinstance(hook, StageHook):
        raise UserInputError(
            f"hook {source} is {_describe(hook)}, expected an instance of lapgs_plugin.hooks.StageHook"
        )
    for name in dir(hook):
        if name in HOOK_NAMES:
            _verify_arguments(hook, name, source)
        elif callable(getattr(hook, name)):
            _verify_not_misspelt(name, source)


def _verify_not_misspelt(name: str, source: str) -> None:
    close = difflib.get_close_matches(name, HOOK_NAMES, n=1, cutoff=0.8)
    if (close and not name.startswith("_")) or name.startswith(("on_", "before_", "after_")):
        guess = f"did you mean {close[0]}?" if close else f"there are {', '.join(HOOK_NAMES)}."
        raise UserInputError(
            f"hook {source}: {name} is not a method of StageHook; {guess} "
            "Rename it, or begin its name with an underscore if it is no hook"
        )


def _verify_arguments(hook: StageHook, name: str, source: str) -> None:
    _, *expected = inspect.signature(getattr(StageHook, name)).parameters
    method = getattr(hook, name)
    if not callable(method):
        raise UserInputError(f"hook {source}: {name} is {_describe(method)}, expected a method({', '.join(expected)})")
    parameters = inspect.signature(method).parameters
    positional = all(p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) for p in parameters.values())
    if list(parameters) != expected or not positional:
        wrong = [a for a in parameters if a not in expected] + [a for a in expected if a not in parameters]
        raise UserInputError(
            f"hook {source}: {name} has the arguments ({', '.join(map(str, parameters.values()))}), expected "
            f"({', '.join(expected)}); look at {(wrong or expected)[0]}"
        )


def _describe(value: object) -> str:
    if isinstance(value, Tensor):
        return f"a Tensor of shape {tuple(value.shape)}"
    return "None" if value is None else f"a {type(value).__name__}"
