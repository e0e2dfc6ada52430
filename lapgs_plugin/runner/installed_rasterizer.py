"""Check that the installed rasterizer is the one that a checkout was written for: several share one module name."""

from __future__ import annotations

import ast
import inspect
from types import ModuleType

from lapgs_plugin.adapters.registry import known_extensions
from lapgs_plugin.errors import MissingExtraError, UserInputError

SETTINGS = "GaussianRasterizationSettings"


def require_matching_rasterizer(renderer: ModuleType, rasterizer: str, title: str) -> None:
    """Compare the settings that a checkout's `render` passes with those that the rasterizer takes.

    Args:
        renderer: the checkout's `gaussian_renderer`; nothing is compared if it does not have the settings.
        rasterizer: name of the rasterizer's module.
        title: title of the backbone.

    Raises:
        UserInputError: the rasterizer belongs to another code base.
    """
    settings = vars(renderer).get(SETTINGS)
    passed = _passed_settings(renderer)
    if settings is None or not passed:
        return
    unknown = passed - set(settings._fields)
    wanting = set(settings._fields) - set(settings._field_defaults) - passed
    if unknown or wanting:
        found = [f"takes no {name}" for name in sorted(unknown)] + [f"wants {name}" for name in sorted(wanting)]
        raise UserInputError(
            f"the installed {rasterizer} is not the one of {title}: it {' and '.join(found)}, expected what "
            f"{renderer.__file__} passes; install the checkout's own, as its README says, in an environment of its own"
        )


def explain_import_error(error: ImportError, script: str) -> MissingExtraError | None:
    """Return an error of one line for an extension that cannot be imported; None for any other module."""
    for name, purpose in known_extensions().items():
        package = name.partition(".")[0]
        if (error.name or "").partition(".")[0] == package:
            return MissingExtraError(
                f"{script} needs {package}, the {purpose}, which cannot be imported ({str(error).splitlines()[0]}); "
                "install it as the checkout's README says, or run on CPU stand-ins with `lapgs run --device cpu`"
            )
    return None


def _passed_settings(renderer: ModuleType) -> set[str]:
    """Return the keywords of the calls that make settings."""
    calls = [node for node in ast.walk(ast.parse(inspect.getsource(renderer))) if isinstance(node, ast.Call)]
    makers = [call for call in calls if isinstance(call.func, ast.Name) and call.func.id == SETTINGS]
    return {keyword.arg for call in makers for keyword in call.keywords if keyword.arg is not None}
