"""Check the packages that a checkout needs: its rasterizer, whose module name several share, and what is missing."""

from __future__ import annotations

from pathlib import Path

from lapgs_plugin.adapters.registry import known_extensions
from lapgs_plugin.checkouts.absent_modules import STOOD_IN
from lapgs_plugin.checkouts.packages import MissingPackage, changes_path, how_to_install, missing_packages, package_of
from lapgs_plugin.checkouts.profile import Profile
from lapgs_plugin.checkouts.rasterizer_uses import unlike
from lapgs_plugin.checkouts.source import CheckoutSource
from lapgs_plugin.environment import driver_version, gpus_are_hidden
from lapgs_plugin.errors import MissingExtraError, UserInputError, first_line


def require_matching_rasterizer(profile: Profile, title: str) -> None:
    """Compare the settings that a checkout's renderers pass with those that their rasterizers take.

    Args:
        profile: the checkout's.
        title: title of the backbone.

    Raises:
        UserInputError: an installed rasterizer belongs to another code base.
    """
    for rasterizer in profile.rasterizers:
        use = rasterizer.use
        if why := unlike(use, vars(rasterizer.module)):
            raise UserInputError(
                f"the installed {use.module} is not the one of {title}: it {why}, expected what "
                f"{use.where.rpartition(':')[0]} passes; install the checkout's own, as its README says, in an "
                "environment of its own, or leave out --rasterizer checkout"
            )


def require_packages(source: CheckoutSource, device: str) -> None:
    """Refuse a checkout whose packages are missing, before anything of it is executed.

    Args:
        source: the checkout.
        device: as of --device.

    Raises:
        MissingExtraError: some are; the line names all of them.
    """
    if changes_path(source):
        return
    if missing := _missing(source, on_cpu=True):
        without_gpu = device == "auto" and (gpus_are_hidden() or not driver_version())
        error = ModuleNotFoundError(f"No module named '{missing[0].name}'", name=missing[0].name)
        raise explain_import_error(error, source.script, on_cpu=device == "cpu" or without_gpu) or error


def explain_import_error(error: ImportError, script: Path, *, on_cpu: bool) -> MissingExtraError | None:
    """Return an error of one line for a package that a checkout imports and that cannot be imported.

    Args:
        error: raised while a script was executed.
        script: the script.
        on_cpu: whether it runs on CPU stand-ins.

    Returns:
        The error, which names all other packages that are missing, too; None if the checkout does not import the
        package itself.
    """
    package = package_of(error.name or "")
    purpose = next((why for name, why in known_extensions().items() if package_of(name) == package), None)
    try:
        source = CheckoutSource.read(script)
    except (UserInputError, OSError):
        where, extension, own, others = None, False, None, []
    else:
        where = next((one.where for one in source.externals if package_of(one.name) == package), None)
        extension = package in map(package_of, source.rasterizer_modules)
        own = source.own_package(package)
        others = [one for one in _missing(source, on_cpu=on_cpu) if one.name != package]
    if not package or (purpose is None and where is None):
        return None
    missing = MissingPackage(package, where or str(script), own, extension or purpose is not None)
    named = f", the {purpose}" if purpose else ""
    problem = f"{missing.where} needs {package}{named}, which cannot be imported ({first_line(error)})"
    also = f"; not installed either: {how_to_install(others)}" if others else ""
    if on_cpu and (missing.extension or (own is not None and own.needs_cuda)):
        return MissingExtraError(f"{problem}: no CPU stand-in has what the checkout takes from it; it needs CUDA{also}")
    if not missing.extension:
        return MissingExtraError(f"{problem}: {missing.install}{also}")
    return MissingExtraError(
        f"{problem}; {missing.install}, or run on CPU stand-ins with `lapgs run --device cpu`, if `lapgs doctor "
        f"CHECKOUT` finds one{also}"
    )


def _missing(source: CheckoutSource, *, on_cpu: bool) -> list[MissingPackage]:
    """Return packages that are not installed, without those that lapgs has."""
    missing = missing_packages(source, known_extensions())
    return [one for one in missing if not (one.extension or (on_cpu and one.name in STOOD_IN))]
