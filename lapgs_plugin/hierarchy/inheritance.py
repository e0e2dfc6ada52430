"""Initialize a field from a point cloud, or from the next coarser level's field."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.spherical_harmonics import SH_C0
from lapgs_plugin.hierarchy.settings import INHERIT_MODES, parse_inheritance

INITIAL_OPACITY = 0.1
"""Opacity of Gaussians that are made of points."""
NEIGHBOURS = 3
"""Nearest points whose distances give a new Gaussian's size."""
SAME_PLACE = 1e-4
"""Points closer than this, in median distances of all points from their middle, are at one place."""
SINGLE_SIZE = math.sqrt(1e-7)
"""Standard deviation of a Gaussian in world units if all points are at one place: 3DGS's least."""


class Inherited(NamedTuple):
    """Hold the field to train, and the rows (m,) int64 of the old field that it came from, ascending."""

    field: GaussianField
    kept: Tensor  # (m,)


def field_from_points(points: Tensor, colors: Tensor, sh_degree: int) -> GaussianField:
    """Initialize a base field as 3DGS does: isotropic Gaussians as large as their spacing, with opacity 0.1.

    Args:
        points: (n, 3) positions in world units, n at least 1.
        colors: (n, 3) RGB in [0, 1], floats, the same from every direction.
        sh_degree: 0 to 3; coefficients above degree 0 are zero.

    Returns:
        A field of n Gaussians, float32, not signed.

    Raises:
        UserInputError: no points, one is not finite, colours that are not one in [0, 1] for each point, or another
            degree.
    """
    require_degree(sh_degree)
    if points.ndim != 2 or points.shape[1] != 3 or colors.shape != points.shape:
        raise UserInputError(
            f"points {tuple(points.shape)} and colours {tuple(colors.shape)}: expected two tensors (n, 3)"
        )
    if len(colors) and not (colors.is_floating_point() and float(colors.amin()) >= 0 and float(colors.amax()) <= 1):
        low, high = colors.aminmax()
        raise UserInputError(
            f"colours of {colors.dtype} from {low:g} to {high:g}: expected floats in [0, 1]; divide levels by 255.0"
        )
    sh = torch.zeros(len(points), (sh_degree + 1) ** 2, 3, device=points.device)
    sh[:, 0] = (colors.to(sh) - 0.5) / SH_C0
    return _initial_field(points, sh, signed=False)


def inherit(
    field: GaussianField,
    mode: str = "geometry",
    ratio: float = 1.0,
    generator: torch.Generator | None = None,
    sh_degree: int | None = None,
) -> Inherited:
    """Initialize a residual field from the next coarser level's field (paper, "Initialization and inheritance" and the
    supplement's ablation).

    "geometry", ours, keeps positions, shapes and opacities and sets colours to zero: the residual first renders exactly
    zero, with Gaussians that already follow the scene's surfaces.

    "xyz", the paper's default, keeps positions alone. Scales come from the nearest neighbours among the kept Gaussians;
    opacity is 0.1, rotation the identity and colour zero.

    "full" keeps every parameter, as the paper ("retains all parameters") and its authors' release do; `kept` tells
    which rows of the optimizer's state belong to it. A residual's colour is the raw SH value, so a residual that
    inherits fully from a base starts as the base's image minus 0.5 where that is opaque, which it has to unlearn.

    Args:
        field: of the coarser level; not modified.
        mode: "geometry", "xyz" or "full".
        ratio: rho in (0, 1], the share of Gaussians to keep, sampled without replacement; at least one is kept.
        generator: CPU generator for the sampling; None takes PyTorch's global one. Not used when all are kept.
        sh_degree: of the new field; None keeps the old one's. "full" can only keep it.

    Raises:
        UserInputError: an unknown mode, a ratio outside (0, 1], a field without Gaussians, a degree that is not 0 to
            3, or "full" with another `sh_degree`.
    """
    if mode not in INHERIT_MODES:
        raise UserInputError(f"--inherit {mode!r}: expected {', '.join(INHERIT_MODES)}; the ratio is another argument")
    parse_inheritance(f"{mode}:{ratio}")  # raises for a ratio outside (0, 1]
    if len(field) == 0:
        raise UserInputError("the coarser level has no Gaussians left to inherit; train it longer or prune it less")
    kept = _sample_rows(len(field), ratio, generator).to(field.means.device)
    degree = field.sh_degree if sh_degree is None else sh_degree
    require_degree(degree)
    rows = {name: tensor.detach()[kept] for name, tensor in field.parameters.items()}
    if mode == "full":
        if degree != field.sh_degree:
            raise UserInputError(
                f"full inheritance of a field of SH degree {field.sh_degree} cannot give degree {degree}; "
                "keep the degree, or inherit geometry or xyz"
            )
        return Inherited(GaussianField(**rows, signed=True), kept)
    sh = torch.zeros(len(kept), (degree + 1) ** 2, 3, dtype=field.means.dtype, device=field.means.device)
    if mode == "geometry":
        return Inherited(GaussianField(**{**rows, "sh": sh}, signed=True), kept)
    return Inherited(_initial_field(rows["means"], sh, signed=True), kept)


def require_degree(sh_degree: int) -> None:
    """Raise a UserInputError about an SH degree that is not 0 to 3."""
    if not 0 <= sh_degree <= 3:
        raise UserInputError(f"sh_degree {sh_degree}: expected 0 to 3")


def _sample_rows(n: int, ratio: float, generator: torch.Generator | None) -> Tensor:
    """Return ascending indices of a random share of n, at least one, (m,)."""
    count = max(1, round(n * ratio))
    if count == n:
        return torch.arange(n)
    return torch.randperm(n, generator=generator)[:count].sort().values


def _initial_field(means: Tensor, sh: Tensor, signed: bool) -> GaussianField:
    """Initialize everything but position and colour as 3DGS does from a point cloud."""
    if len(means) == 0 or not bool(torch.isfinite(means).all()):
        raise UserInputError(
            f"{len(means)} points, not all finite; expected at least one point with finite coordinates"
        )
    n, means = len(means), means.to(sh.dtype, copy=True)
    log_scale = _spacing(means).log()  # (n,)
    quaternions = torch.zeros(n, 4, dtype=sh.dtype, device=sh.device)
    quaternions[:, 0] = 1.0
    return GaussianField(
        means=means,
        quaternions=quaternions,
        log_scales=log_scale[:, None].repeat(1, 3),
        opacity_logits=torch.full((n,), math.log(INITIAL_OPACITY / (1.0 - INITIAL_OPACITY))).to(sh),
        sh=sh,
        signed=signed,
    )


def _spacing(points: Tensor) -> Tensor:
    """Return the root mean square distance from each point (n, 3) to the three nearest places of other points, (n,).

    Copies of a point are no neighbours of it, or it would start too small to be seen.
    """
    first, index, cell = places_of(points)
    squares = mean_squared_distance(points[first])[index]
    return squares.sqrt().clamp_min(cell) if cell > 0.0 else torch.full_like(squares, SINGLE_SIZE)


def places_of(points: Tensor) -> tuple[Tensor, Tensor, float]:
    """Find points (n, 3) that are at one place, to rounding; n is at least 1.

    Returns:
        The row of a point at each of k places (k,), the place of each point (n,), and the size of a place in the
        units of the points, 0 if they are all at the same.
    """
    positions = points.detach().to("cpu", torch.float64).numpy()
    away = positions - np.median(positions, axis=0)
    distances = np.linalg.norm(away, axis=1)
    cell = SAME_PLACE * float(np.median(distances) or distances.mean())  # most points may be at one place
    cells = np.round(away / cell) if cell > 0.0 else away
    _, first, index = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    first_rows, places = (torch.from_numpy(rows.reshape(-1)).to(points.device) for rows in (first, index))
    return first_rows, places, cell


def mean_squared_distance(points: Tensor) -> Tensor:
    """Return the mean squared distance (n,) from each point (n, 3) to its three nearest neighbours.

    With fewer than four points the mean is over all other points, and 0 for a single point.
    """
    count = min(NEIGHBOURS, len(points) - 1)
    if count == 0:
        return torch.zeros_like(points[:, 0])
    from scipy.spatial import cKDTree  # a tenth of a second, which reading a run's manifest need not wait

    positions = points.detach().to("cpu", torch.float64).numpy()
    # The nearest of count + 1 is the point itself or one at the same position: its distance is 0 either way.
    distances, _ = cKDTree(positions).query(positions, k=count + 1, workers=-1)
    return torch.from_numpy(np.mean(distances[:, 1:] ** 2, axis=1)).to(points)
