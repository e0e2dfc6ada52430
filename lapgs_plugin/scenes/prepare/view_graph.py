"""Judge the consistency of placed photos by the points that they share and by their verticals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from lapgs_plugin.scenes.prepare.undistort import QUARTER_TURN

LINKED = 15
"""Fewest shared points that link two photos, as in COLMAP's mapper."""
WEAK = 0.2
"""Strength of a weak link between groups, as a share of its photos' strongest link within their groups. Links of photos
taken step by step are equally strong; wrong links consist of the few features that agree by chance."""
WEAK_IF_TURNED = 0.4
"""Strength of a weak link between groups with different verticals, in the same unit."""
GROUP = 3
"""Fewest photos of a group. Fewer have too few links of their own to compare with."""
HELD = 30
"""Fewest shared points that join two groups. COLMAP's mapper requires as many to place a single photo."""
TURNED = 45.0
"""Least angle in degrees between contradicting verticals of two upright groups. The vertical of a few photos of one
direction is known to about 30 degrees, because a hand tilts a phone so much."""
UPRIGHT = 30.0
"""Largest roll in degrees of an upright photo."""
ROLLED = 60.0
"""Least roll in degrees of a photo that is clearly not upright."""
MOSTLY = 0.8
"""Least share of upright photos in a group with a vertical."""
FEW_ROLLED = 0.1
"""Largest share of rolled photos without a warning, because people turn a phone now and then."""
STEEP = 0.5
"""Sine of the angle to the vertical below which a view has no usable roll, as of drones and table tops."""
NARROW = 0.9
"""Length of the mean of the unit view directions above which all photos look into one direction. Rotation about a
direction that points down, as of a drone, is no roll."""
TRIED = 60
"""Most photos whose up is tried as the vertical."""
LEVEL = 0.03
"""Weight of the assumption that photos look horizontally. It decides only where all look into one direction."""


@dataclass(frozen=True)
class Seam:
    """Two groups of photos that are joined so weakly that their relative pose is wrong.

    Attributes:
        apart: the images of the smaller group.
        points: number of points that the groups share.
        angle: in degrees between their verticals if these differ, else None.
    """

    apart: tuple[int, ...]
    points: int
    angle: float | None


def placed_images(model: pycolmap.Reconstruction) -> list[int]:
    """Return the images that have a pose, sorted."""
    return sorted(key for key, image in model.images.items() if image.has_pose)


def remove_unlinked(model: pycolmap.Reconstruction) -> None:
    """Leave only the largest group of photos that are linked by shared points.

    COLMAP's global mapper places photos by their rotations even if no points confirm it, and its incremental mapper
    places some by a few wrong points.
    """
    images = placed_images(model)
    _, shared = _points_of(model, images)
    links = shared >= LINKED
    links.eliminate_zeros()
    _, groups = connected_components(links, directed=False)
    largest = np.bincount(groups, minlength=1).argmax()
    for key, group in zip(images, groups, strict=True):
        if group != largest:
            model.deregister_frame(model.images[key].frame_id)


def find_seam(
    model: pycolmap.Reconstruction, turns_of: Callable[[str], int], held_upright: bool = False
) -> Seam | None:
    """Return the clearest seam of a model whose photos are linked, or None.

    A tree of the strongest links holds all photos. One of its links is a seam if the photos on its sides are upright to
    different verticals, or if it is weak beside the links within them and they share fewer points than place a photo.

    Args:
        model: with tracks.
        turns_of: returns the quarter turns clockwise that make a photo upright by its name.
        held_upright: whether that is known. Else photos that may have been rolled need a weak link, too.
    """
    images = placed_images(model)
    if len(images) < 2 * GROUP:
        return None
    seen, shared = _points_of(model, images)  # (points, photos), (photos, photos)
    shared.setdiag(0)
    shared.eliminate_zeros()
    tree = minimum_spanning_tree(csr_array((1.0 / shared.data, shared.indices, shared.indptr), shared.shape)).tocoo()
    axes = _upright_axes(model, images, turns_of)
    _, rolls = _best_vertical(axes)
    one_vertical = np.count_nonzero(rolls <= UPRIGHT) > len(images) - GROUP or _is_narrow(axes)
    turned: list[tuple[int, bool, Seam]] = []  # with the photos upright to either vertical, and whether that is wrong
    loose: list[Seam] = []
    for one, other, distance in zip(tree.row, tree.col, tree.data, strict=True):
        rest = (tree.row != one) | (tree.col != other)
        kept = coo_array((tree.data[rest], (tree.row[rest], tree.col[rest])), tree.shape)
        apart = connected_components(kept, directed=False)[1] == 0  # (photos)
        if 2 * apart.sum() > len(images):
            apart = ~apart
        if apart.sum() < GROUP:
            continue
        strength = 1.0 / distance / _strongest_within(shared, one, other, apart)
        turn = None if one_vertical else _turn(axes[apart], axes[~apart])
        if turn is None and strength > WEAK:
            continue
        points = int(np.count_nonzero((seen @ apart > 0) & (seen @ ~apart > 0)))
        seam = Seam(tuple(np.array(images)[apart].tolist()), points, None if turn is None else turn.angle)
        if turn is not None:
            is_wrong = held_upright or strength < WEAK_IF_TURNED or not turn.perhaps_rolled
            turned.append((turn.upright, is_wrong, seam))
        elif points < HELD:
            loose.append(seam)
    # Where the verticals part best: other links mix the groups.
    _, is_wrong, clearest = max(turned, key=lambda entry: entry[0], default=(0, False, None))
    if is_wrong:
        return clearest
    return min(loose, key=lambda seam: seam.points, default=None)


def rolled_images(model: pycolmap.Reconstruction, turns_of: Callable[[str], int]) -> list[int]:
    """Return the images that are clearly not upright in a model whose other photos are, if they are more than a few."""
    images = placed_images(model)
    axes = _upright_axes(model, images, turns_of)
    _, rolls = _best_vertical(axes)
    rolled = rolls > ROLLED
    if rolled.sum() < max(GROUP, FEW_ROLLED * len(images)) or _is_narrow(axes):
        return []
    return [key for key, is_rolled in zip(images, rolled, strict=True) if is_rolled]


def _best_vertical(axes: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the direction (3) to which most photos are upright, and how far each is rolled (n), NaN if it is steep.

    A photo without roll has its right at a right angle to the vertical, however much it looks up or down.
    """
    if not len(axes):
        return np.zeros(3), np.zeros(0)
    tried = -axes[:: -(-len(axes) // TRIED), 1]
    up = tried[np.argmax([np.count_nonzero(_rolls(axes, up) <= UPRIGHT) for up in tried])]
    for _ in range(2):
        upright = axes[_rolls(axes, up) <= UPRIGHT]
        right, forward = upright[:, 0], upright[:, 2]
        _, directions = np.linalg.eigh(right.T @ right + LEVEL * forward.T @ forward)
        up = directions[:, 0] * (-1.0 if (upright[:, 1] @ directions[:, 0]).sum() > 0 else 1.0)
    return up, _rolls(axes, up)


def _rolls(axes: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far each photo is rolled (n) in degrees, NaN where it looks up or down steeply."""
    across, along = axes[:, 0] @ up, -axes[:, 1] @ up
    rolls = np.degrees(np.abs(np.arctan2(across, along)))
    return np.where(np.hypot(across, along) < STEEP, np.nan, rolls)


def _is_narrow(axes: NDArray[np.float64]) -> bool:
    """Return whether all photos look into one direction."""
    return bool(np.linalg.norm(axes[:, 2].mean(axis=0)) > NARROW)


def _strongest_within(shared: csr_array, one: int, other: int, apart: NDArray[np.bool_]) -> float:
    """Return the points of the strongest link of either photo within its group."""
    return float(max(shared[[end]].toarray()[0][apart == apart[end]].max() for end in (one, other)))


class _Turn(NamedTuple):
    """The rotation of two groups against each other.

    Attributes:
        angle: between their verticals in degrees.
        upright: number of photos that are upright to the vertical of their group.
        perhaps_rolled: whether one group may only have been rolled.
    """

    angle: float
    upright: int
    perhaps_rolled: bool


def _turn(one: NDArray[np.float64], other: NDArray[np.float64]) -> _Turn | None:
    """Return how two groups, of axes (n, 3, 3), are turned; None if one has no vertical, or both have the same."""
    (up, rolls), (other_up, other_rolls) = _best_vertical(one), _best_vertical(other)
    angle = float(np.degrees(np.arccos(np.clip(up @ other_up, -1.0, 1.0))))
    if angle <= TURNED or not (_are_upright(rolls) and _are_upright(other_rolls)):
        return None
    upright = int(np.count_nonzero(np.concatenate([rolls, other_rolls]) <= UPRIGHT))
    return _Turn(angle, upright, _are_rolled(one, other_up) or _are_rolled(other, up))


def _are_upright(rolls: NDArray[np.float64]) -> bool:
    """Return whether most photos of a group are upright."""
    return bool(np.count_nonzero(rolls <= UPRIGHT) >= max(GROUP, MOSTLY * len(rolls)))


def _are_rolled(axes: NDArray[np.float64], up: NDArray[np.float64]) -> bool:
    """Return whether photos that look level are all rolled by the same angle, as if a phone was held sideways."""
    turns = -axes[:, 1] @ up + 1j * (axes[:, 0] @ up)  # (n)
    level = turns[np.abs(turns) >= STEEP]
    apart = np.abs(np.degrees(np.angle(level * np.conj(level.sum()))))
    return bool(np.count_nonzero(apart <= UPRIGHT) >= MOSTLY * len(axes))


def _points_of(model: pycolmap.Reconstruction, images: Sequence[int]) -> tuple[csr_array, csr_array]:
    """Return which points each image sees (points, images), and how many each two share (images, images)."""
    pairs = [
        (row, np.searchsorted(images, element.image_id))
        for row, point in enumerate(model.points3D.values())
        for element in point.track.elements
    ]
    rows, columns = np.array(pairs, dtype=np.int64).reshape(-1, 2).T  # (n), (n)
    seen = coo_array((np.ones(len(rows), np.int64), (rows, columns)), (model.num_points3D(), len(images))).tocsr()
    seen.data[:] = 1  # tracks may have several features of a photo
    return seen, (seen.T @ seen).tocsr()


def _upright_axes(
    model: pycolmap.Reconstruction, images: Sequence[int], turns_of: Callable[[str], int]
) -> NDArray[np.float64]:
    """Return right, down and forward of each photo in the world, (n, 3, 3), turned upright by EXIF."""
    axes = [
        np.linalg.matrix_power(QUARTER_TURN, turns_of(image.name)) @ image.cam_from_world().rotation.matrix()
        for image in (model.images[key] for key in images)
    ]
    return np.array(axes, dtype=np.float64).reshape(-1, 3, 3)
