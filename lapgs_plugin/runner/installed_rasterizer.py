"""Check that the installed rasterizer is the one that a checkout was written for: several share one module name."""

from __future__ import annotations

from lapgs_plugin.adapters.registry import known_extensions
from lapgs_plugin.checkouts.profile import Profile
from lapgs_plugin.errors import MissingExtraError, UserInputError


def require_matching_rasterizer(profile: Profile, title: str) -> None:
    """Compare the settings that a checkout's renderers pass with those that their rasterizers take.

    Args:
        profile: the checkout's.
        title: title of the backbone.

    Raises:
        UserInputError: an installed rasterizer belongs to another code base.
    """
    for rasterizer in profile.rasterizers:
        use, named = rasterizer.use, (vars(rasterizer.module)[name] for name in rasterizer.settings)
        for settings in named:
            fields, defaults = getattr(settings, "_fields", None), getattr(settings, "_field_defaults", {})
            if fields is None or not use.settings:
                continue
            unknown, wanting = use.settings - set(fields), set(fields) - set(defaults) - use.settings
            if unknown or wanting:
                found = [f"takes no {name}" for name in sorted(unknown)] + [f"wants {name}" for name in sorted(wanting)]
                raise UserInputError(
                    f"the installed {use.module} is not the one of {title}: it {' and '.join(found)}, expected what "
                    f"{use.where.rpartition(':')[0]} passes; install the checkout's own, as its README says, in an "
                    "environment of its own"
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
