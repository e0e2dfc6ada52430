"""Check the packages that a checkout needs: its rasterizer, whose module name several share, and what is missing."""

from __future__ import annotations

from pathlib import Path

from lapgs_plugin.adapters.registry import known_extensions
from lapgs_plugin.checkouts.profile import Profile
from lapgs_plugin.checkouts.source import CheckoutSource
from lapgs_plugin.errors import MissingExtraError, UserInputError, first_line

DISTRIBUTIONS = {
    "cv2": "opencv-python-headless",
    "PIL": "pillow",
    "skimage": "scikit-image",
    "sklearn": "scikit-learn",
    "yaml": "pyyaml",
}
"""Distributions whose names differ from those of their packages."""


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


def explain_import_error(error: ImportError, script: Path, *, on_cpu: bool) -> MissingExtraError | None:
    """Return an error of one line for a package that a checkout imports and that cannot be imported.

    Args:
        error: raised while a script was executed.
        script: the script.
        on_cpu: whether it runs on CPU stand-ins.

    Returns:
        The error; None if the checkout does not import the package itself.
    """
    package = _package(error.name or "")
    purpose = next((why for name, why in known_extensions().items() if _package(name) == package), None)
    try:
        source = CheckoutSource.read(script)
        imports, rasterizers, own = source.externals, source.rasterizer_modules, source.own_package(package)
    except (UserInputError, OSError):
        imports, rasterizers, own = (), (), None
    where = next((one.where for one in imports if _package(one.name) == package), None)
    if not package or (purpose is None and where is None):
        return None
    named = f", the {purpose}" if purpose else ""
    problem = f"{where or script} needs {package}{named}, which cannot be imported ({first_line(error)})"
    ours = purpose is not None or package in map(_package, rasterizers)
    if on_cpu and (ours or (own is not None and own.needs_cuda)):
        return MissingExtraError(f"{problem}: no CPU stand-in has what the checkout takes from it; it needs CUDA")
    if not ours:
        install = f"pip install {DISTRIBUTIONS.get(package, package)}" if own is None else own.install
        return MissingExtraError(f"{problem}: {install}")
    how = "install it as the checkout's README says" if own is None else own.install
    return MissingExtraError(
        f"{problem}; {how}, or run on CPU stand-ins with `lapgs run --device cpu`, if `lapgs doctor CHECKOUT` finds one"
    )


def _package(module: str) -> str:
    return module.partition(".")[0]
