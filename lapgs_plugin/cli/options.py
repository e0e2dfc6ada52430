"""What `lapgs train` and `lapgs run` ask in the same words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import typer

from lapgs_plugin.hierarchy.plan import Hierarchy, parse_hierarchy, require_no_residuals

HIERARCHY = "Hierarchy"
"""Title of the options about levels."""

SupervisionOption = Annotated[
    str,
    typer.Option(
        rich_help_panel=HIERARCHY,
        help="Of residuals: reconstructed (composed image against the photo), online_residual or gt_laplacian.",
    ),
]
DEFAULT_INHERITANCE = "geometry"
InheritOption = Annotated[
    str | None,
    typer.Option(
        rich_help_panel=HIERARCHY,
        help="What a residual starts from: geometry (all but colour), xyz (positions, as in the paper) or full (all "
        "parameters and optimizer state); a ratio in (0, 1] of the Gaussians alone or after it: xyz:0.5. "
        f"Default: {DEFAULT_INHERITANCE}.",
    ),
]
GridOption = Annotated[
    str,
    typer.Option(
        rich_help_panel=HIERARCHY,
        help="Pixel grid of the pyramid: camera (where the cameras see) or even (every second pixel, as OpenCV).",
    ),
]
PRUNE_HELP = (
    "When a stage's densification ends, remove the least visible Gaussians: each counts with the pixels that it makes "
    "up in the view that shows most of it, and the least go that make up this share of the sum. 0.005 takes about a "
    "fifth of them."
)


def check_residual_options(hierarchy: str, given: Mapping[str, object]) -> None:
    """Refuse options that only residuals have, whatever they say, where none are trained.

    Args:
        hierarchy: of the command line.
        given: what stands there, by option; None where an option does not.

    Raises:
        UserInputError: one of them stands there although levels are nested, or there is no such hierarchy.
    """
    if parse_hierarchy(hierarchy) is Hierarchy.NESTED:
        require_no_residuals({option: (value, None) for option, value in given.items()})


def given_options(context: typer.Context) -> set[str]:
    """Parameters that stand on the command line, as opposed to those left at their defaults."""
    sources = {name: context.get_parameter_source(name) for name in context.params}
    return {name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"}
