"""Where code can step into a stage: the hooks, what they are told, and the order in which they run.

Order, the same for every method: composition, supervision, then users' hooks - those registered by entry point in the
order of their names, then those given as arguments in the order they were given. One iteration calls

    before_render  ->  (render)  ->  compose  ->  loss  ->  (backward)  ->  after_backward  ->  (step)  ->  on_densify

Where several views make a step, `before_render`, `compose` and `loss` are called for each of them, with its own image
and iteration, and the losses are added up. `after_backward` and `on_densify` are called once a step, with the context
of its last view, when the gradients of all its views are there. A step that runs out of memory begins again.

`compose` is a chain: each hook gets what the one before it returned, the first one the rendered image. `loss` is a sum:
each hook sees the composed image and may add a term.
"""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points

from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hierarchy.supervision import Supervision
from lapgs_plugin.ops.composition import add_prediction
from lapgs_plugin.ops.photometric_loss import photometric_loss
from lapgs_plugin.ops.photometric_loss.in_torch import DEFAULT_SSIM_WEIGHT

ENTRY_POINT_GROUP = "lapgs_plugin.hooks"
"""Entry point group whose members are StageHook classes, created without arguments for every run."""


@dataclass(frozen=True)
class StageContext:
    """What a hook may know of the iteration it runs in.

    Attributes:
        stage: level, size, length and colour map of the stage.
        iteration: counts from 1 within the stage.
        view: name of the training view.
        target: (3, h, w) ground truth I^l of the view at the stage's level.
        accumulated: (3, h, w) Up(I_hat^(l+1)) of the view, unclamped; None for the base.
        coarse_target: (3, h, w) Up(I^(l+1)), the ground truth's counterpart; None unless the supervision needs it.
    """

    stage: Stage
    iteration: int
    view: str
    target: Tensor  # (3, h, w)
    accumulated: Tensor | None = None  # (3, h, w)
    coarse_target: Tensor | None = None  # (3, h, w)


class StageHook:
    """Base of every hook. Each method does nothing; override those of interest, with the same arguments."""

    def on_stage_start(self, stage: Stage) -> None:
        """A stage begins or is resumed."""

    def before_render(self, context: StageContext) -> None:
        """An iteration begins."""

    def compose(self, context: StageContext, image: Tensor) -> Tensor:
        """Make the prediction of the iteration.

        Args:
            context: of the iteration.
            image: (3, h, w) what the hook before returned; for the first hook the rendered image, a residual where
                `context.stage.signed`.

        Returns:
            (3, h, w) the image for the next hook or, from the last one, for the loss; differentiable, not clamped.
        """
        return image

    def loss(self, context: StageContext, image: Tensor) -> Tensor | None:
        """Add a term to the loss.

        Args:
            context: of the iteration.
            image: (3, h, w) the composed prediction.

        Returns:
            A scalar, or None to add nothing.
        """
        return None

    def after_backward(self, context: StageContext) -> None:
        """Gradients are there, of all views of the step, and the optimizer has not stepped yet."""

    def on_densify(self, context: StageContext) -> None:
        """Density control has just added, removed or reset Gaussians."""

    def on_stage_end(self, stage: Stage) -> None:
        """A stage's iterations are done; its field is about to be archived."""


class Composition(StageHook):
    """I_hat^l = Up(I_hat^(l+1)) + R_hat^l: adds what the finished levels predict to a rendered residual."""

    def compose(self, context: StageContext, image: Tensor) -> Tensor:
        return add_prediction(image, context.accumulated)


class SupervisionLoss(StageHook):
    """Compare what a supervision says with the photometric loss.

    Args:
        supervision: which one.
        ssim_weight: lambda of the photometric loss, in [0, 1].
    """

    def __init__(self, supervision: Supervision, ssim_weight: float = DEFAULT_SSIM_WEIGHT) -> None:
        self._supervision = supervision
        self._ssim_weight = ssim_weight

    def loss(self, context: StageContext, image: Tensor) -> Tensor:
        prediction, target = image, context.target
        if context.accumulated is not None:  # the base is always compared with its target
            prediction, target = self._supervision.pair(image, target, context.accumulated, context.coarse_target)
        return photometric_loss(prediction, target, self._ssim_weight)


class HookDispatcher:
    """Calls the hooks of a run, in the order this module's docstring pins.

    Args:
        hooks: in the order they run.

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
    ) -> HookDispatcher:
        """The stock hooks, the hooks installed as entry points, and `user_hooks`.

        Raises:
            UserInputError: a user's hook is not usable; the line names it.
        """
        stock = (Composition(), SupervisionLoss(supervision, ssim_weight))
        return cls((*stock, *entry_point_hooks(), *user_hooks))

    @property
    def takes_batches(self) -> bool:
        """Whether `compose` and `loss` may get images of several views, (b, 3, h, w), where the context has such, too.

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
        """The iteration's prediction, (3, h, w), from the rendered image."""
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
        """The sum of all hooks' terms, a scalar."""
        total = self.extra_loss(context, image)
        assert total is not None, "no hook supervises"
        return total

    def extra_loss(self, context: StageContext, image: Tensor) -> Tensor | None:
        """The sum of all hooks' terms, a scalar; None if none has one."""
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


def entry_point_hooks() -> tuple[StageHook, ...]:
    """The hooks that installed packages register in the group `ENTRY_POINT_GROUP`, by name.

    Raises:
        UserInputError: one cannot be imported or created, or is not a usable hook; the line names it.
    """
    hooks = []
    for entry in sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda entry: (entry.name, entry.value)):
        source = f"entry point {entry.name} ({entry.value})"
        try:
            hook = entry.load()()
        except Exception as error:  # whatever a plugin's import does wrong, the user must learn which plugin it was
            raise UserInputError(
                f"hook {source} cannot be created: {type(error).__name__}: {error}; "
                "expected a StageHook class without arguments, fix or uninstall the package that brings it"
            ) from error
        verify_hook(hook, source)
        hooks.append(hook)
    return tuple(hooks)


HOOK_NAMES = tuple(name for name in vars(StageHook) if not name.startswith("_"))
"""The methods of a hook, in the order of a stage."""


def verify_hook(hook: object, source: str) -> None:
    """Check that `hook` overrides StageHook's methods with StageHook's arguments and misspells none.

    Args:
        hook: any object.
        source: where it comes from, for the message.

    Raises:
        UserInputError: names the source, the method and the argument.
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
