"""What `lapgs train` and `lapgs run` ask in the same words."""

from __future__ import annotations

from typing import Annotated

import typer

HIERARCHY = "Hierarchy"
"""Title of the options about levels."""

SupervisionOption = Annotated[
    str,
    typer.Option(
        rich_help_panel=HIERARCHY,
        help="reconstructed (composed image against the photo), online_residual or gt_laplacian.",
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
    "When a stage's densification ends, remove the Gaussians least seen, as many as make up this share of all blending "
    "together: 0.005 takes about a fifth of them."
)
