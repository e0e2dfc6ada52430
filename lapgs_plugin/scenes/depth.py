"""Find and read depth of photos: maps beside them, or the points of a COLMAP model that they see."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from lapgs_plugin.errors import SceneError, counted, first_line, printable
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.files import is_folder
from lapgs_plugin.scenes.blender import depth_files, has_transforms
from lapgs_plugin.scenes.colmap import find_model, with_bare_names
from lapgs_plugin.scenes.colmap_model import Model, read_model
from lapgs_plugin.scenes.exports.points import MILLIMETRES
from lapgs_plugin.scenes.exports.registry import find_export
from lapgs_plugin.scenes.image_files import check_size
from lapgs_plugin.scenes.images import read_depth, same_shape
from lapgs_plugin.scenes.masks import AUTO, NONE, common_folder, resolve_folder, stem_of
from lapgs_plugin.scenes.parallel import in_threads
from lapgs_plugin.scenes.scene import Scene, View
from lapgs_plugin.untrusted import require_regular, shortened

logger = logging.getLogger(__name__)

POINTS, TRANSFORMS = "points", "transforms"
"""Values of --depth, beside auto, none and a folder."""
DEPTH_PATHS = "depth_file_path of transforms.json"
"""Where maps of `TRANSFORMS` are named, for messages."""
FOLDERS = ("depth", "highres_depth", "lowres_depth")
"""Folders of depth maps beside that of the photos; in exports the first is Record3D's and Polycam's, others ARKit's."""
SUFFIXES = (".npy", ".exr", ".tiff", ".tif", ".png")
"""Of depth maps; of several for a photo the first is read, because pictures of depth lie beside the numbers."""
NPY_START = b"\x93NUMPY"
"""First bytes of an .npy file."""
ENDS = ("", "_depth")
"""What the name of a depth map may have after that of its photo."""

MOST_PIXELS = 1 << 18
"""Most pixels of a depth map in training: depth has little detail."""
FIT_STEPS = 10
"""Steps of reweighting, from least squares to least absolute deviations."""
LEAST_FIT = 32
"""Fewest values for a fit."""
EVEN = 1e-3
"""Standard deviation of a map, over its mean, below which it determines no shift."""
LEAST_PIXELS = 32
"""Fewest valid pixels of a map that is used."""
SAME = 0.05
"""Median deviation of points' inverse depths, over their median, below which a map need not tell them apart."""
UNLIKE = (0.0, 0.0)
"""Scale and shift of a map that disagrees with the points."""
MOST_LEFT = 0.8
"""Largest share of that deviation which a map that agrees with its points leaves over."""
INVERSE = -0.2
"""Mean rank correlation of a map's values with the points' depths below which the values are inverse depths."""
INSIDE_SHARE = 0.5
"""Least share of a pixel inside valid pixels for its value to count."""

MOST_ERROR = 2.0
"""Largest mean reprojection error, in pixels, of points that are depths."""
CELLS = 64
"""Cells along the longer side of an image in which the nearest of the points without tracks are taken to be visible."""
MADE_UP = 0.5
"""Grey of random points, which a scene without points gets."""
BEHIND = 1.1
"""Depth over that of the nearest point of the cell up to which a point is taken to be visible."""

MAP_THREADS = 8
"""Threads that read maps."""
MAPS_ADVICE = "correct them, or train without (--depth none)"

Say = Callable[[str], None]


class DepthTargets(ABC):
    """Hold inverse depths of the training views that have some, in world units."""

    @property
    @abstractmethod
    def names(self) -> Sequence[str]:
        """The views."""

    @abstractmethod
    def inverse(self, name: str, size: tuple[int, int]) -> Tensor:
        """Return the inverse depths (h, w) of a view at a size (width, height), NaN where there is none."""


@dataclass(frozen=True)
class DepthMaps(DepthTargets):
    """Hold depth maps.

    Attributes:
        maps: (h, w) float32 inverse depth by view, NaN where it is invalid.
    """

    maps: Mapping[str, Tensor]

    @property
    def names(self) -> Sequence[str]:
        return [*self.maps]

    def inverse(self, name: str, size: tuple[int, int]) -> Tensor:
        """See `DepthTargets`: the mean of the valid pixels of larger maps, the nearest pixel of smaller ones."""
        return _resized(self.maps[name], size)


@dataclass(frozen=True)
class PointDepths(DepthTargets):
    """Hold the points that views see.

    Attributes:
        points: (k, 3) by view: place in the image in shares of its width and height, and inverse depth.
    """

    points: Mapping[str, Tensor]

    @property
    def names(self) -> Sequence[str]:
        return [*self.points]

    def inverse(self, name: str, size: tuple[int, int]) -> Tensor:
        """See `DepthTargets`: the mean of the points in each pixel."""
        width, height = size
        place, inverse = self.points[name][:, :2], self.points[name][:, 2]
        rows, columns = _pixels(place, size)
        pixel = rows * width + columns
        count = torch.zeros(width * height).index_add_(0, pixel, torch.ones_like(inverse))
        total = torch.zeros(width * height).index_add_(0, pixel, inverse)
        return (total / count).view(height, width)  # 0 / 0 is NaN


def depth_size(size: tuple[int, int]) -> tuple[int, int]:
    """Return the size (width, height) at which an image's depth is compared: its own, of large ones a smaller one.

    >>> depth_size((400, 300)), depth_size((4000, 3000))
    ((400, 300), (591, 443))
    """
    factor = min(1.0, (MOST_PIXELS / (size[0] * size[1])) ** 0.5)
    width, height = (max(1, round(side * factor)) for side in size)
    return width, height


def resolve_depth(scene: Path, setting: str) -> str:
    """Resolve a value of --depth for a scene: "none", "points", "transforms", or a folder, relative to it or absolute.

    Raises:
        UserInputError: there is no such folder.
    """
    if setting == AUTO:
        own = _own_depth(scene)
        if own == NONE:
            logger.warning(
                "--depth auto: no depth maps in %s, so depth is not supervised; expected a folder depth/, or "
                "depth_file_path in transforms.json; --depth points takes the points of COLMAP",
                scene,
            )
        return own
    if setting in (NONE, POINTS, TRANSFORMS):
        return setting
    return resolve_folder(scene, setting, "--depth", "a folder of depth maps, points or none")


def _own_depth(scene: Path) -> str:
    """Return the depth that a scene brings, as a value of --depth."""
    places = [scene]
    if find_model(scene) is None:
        if has_transforms(scene):
            if depth_files(scene):
                return TRANSFORMS
        elif (export := find_export(scene)) is not None and export.source.is_relative_to(scene):
            places.append(export.source.parent)
    folders = (place / folder for place in places for folder in FOLDERS)
    return next((folder.relative_to(scene).as_posix() for folder in folders if is_folder(folder)), NONE)


def load_depth(scene: Scene, setting: str, images: str, say: Say) -> DepthTargets | None:
    """Read the depth of a scene's training views; None for "none".

    Args:
        scene: its masks apply to maps, too.
        setting: result of `resolve_depth`.
        images: folder of the images, as `load_scene` takes it.
        say: receives how many views have depth, and a line for each kind of maps that are not used.

    Raises:
        SceneError: no view has any that can be used.
    """
    if setting == NONE:
        return None
    if setting == POINTS:
        return _load_points(scene, images, say)
    names = [view.name for view in scene.train]
    if setting == TRANSFORMS:
        named = depth_files(scene.path, images)
        files, where = {name: named[name] for name in names if name in named}, DEPTH_PATHS
    else:
        files, where = find_maps(scene.path / setting, names), str(scene.path / setting)
    if not files:
        raise SceneError(
            f"{where}: no depth map of any of the {len(names)} training photos, expected the names of photos with "
            f"{', '.join(SUFFIXES)}, such as {printable(stem_of(names[0]))}.png; {MAPS_ADVICE}"
        )
    return _load_maps(scene, files, where, images, say)


def fit_scale_and_shift(values: Tensor, wanted: Tensor, valid: Tensor) -> Tensor:
    """Return the scale and shift (2,) that bring values (n,) to wanted ones (n,), by least absolute deviations.

    Args:
        valid: (n,) bool, which of them count.

    Returns:
        Zeros where too few are valid, or the scale would not be positive.
    """
    values, wanted = (torch.where(valid, each, 0.0).double() for each in (values, wanted))
    inside = valid.double()
    typical = (wanted * inside).sum() / inside.sum()
    weight, result = inside, values.new_zeros(2)
    for _ in range(FIT_STEPS):
        total = weight.sum()
        mean_value, mean_wanted = ((weight * each).sum() / total for each in (values, wanted))
        apart = values - mean_value
        variance = (weight * apart * apart).sum() / total
        slope = (weight * apart * (wanted - mean_wanted)).sum() / total / variance
        scale = torch.where(variance > (EVEN * mean_value) ** 2, slope, mean_wanted / mean_value)
        result = torch.stack([scale, mean_wanted - scale * mean_value])
        weight = inside / ((scale * values + result[1] - wanted).abs() + 1e-3 * typical)
    usable = (inside.sum() >= LEAST_FIT) & (result[0] > 0.0) & result.isfinite().all()
    return torch.where(usable, result, 0.0).float()


def find_maps(folder: Path, names: Sequence[str], ends: Sequence[str] = ENDS) -> dict[str, Path]:
    """Return the maps of those images that have one, by the images' names.

    That of a.jpg is a.png, or a_depth.png if `ends` has "_depth", or another file of `SUFFIXES`. Folders that hold all
    photos, such as images/, may be left out, and all folders if no two photos have the same name without them.
    """
    common = common_folder(names)
    bare = Counter(PurePosixPath(stem_of(name)).name.lower() for name in names)
    spelled = {}
    for name in names:
        stem = stem_of(name)
        last = PurePosixPath(stem).name
        spelled[name] = [stem, stem.removeprefix(common), *([last] if bare[last.lower()] == 1 else [])]
    parents = {PurePosixPath(stem).parent for stems in spelled.values() for stem in stems}
    present: dict[str, Path] = {}
    for parent in sorted(parents):
        inner = sorted((folder / parent).iterdir()) if is_folder(folder / parent) else []
        for file in sorted((file for file in inner if file.suffix.lower() in SUFFIXES), key=_preference):
            present.setdefault(file.relative_to(folder).with_suffix("").as_posix().lower(), file)
    keys = {name: [f"{stem}{end}".lower() for stem in stems for end in ends] for name, stems in spelled.items()}
    chosen = {name: next((present[key] for key in tried if key in present), None) for name, tried in keys.items()}
    return {name: file for name, file in chosen.items() if file is not None}


def _preference(file: Path) -> int:
    return SUFFIXES.index(file.suffix.lower())


def _load_maps(scene: Scene, files: Mapping[str, Path], where: str, images: str, say: Say) -> DepthMaps:
    """Read maps; the scene's points say whether they hold depths or inverse depths, and their scales and shifts."""
    values = read_maps(scene.train, files, _read_map, "depth", say)
    seen = _seen_points(scene, images)
    is_inverse = _holds_inverse_depth(values, seen)
    maps = {name: value if is_inverse else 1.0 / value for name, value in values.items()}
    told = {name: fit for name, each in maps.items() if name in seen and (fit := _fit_to_points(each, seen[name]))}
    fits = {name: fit for name, fit in told.items() if fit != UNLIKE}
    unlike = [name for name in told if name not in fits]
    if told and not fits:
        raise SceneError(
            f"{where}: none of {counted(len(told), 'depth map')} agrees with the points that its photo sees, "
            f"expected depths along the optical axis, or inverse depths, of the photos of their names; {MAPS_ADVICE}"
        )
    if fits:
        how = f"{counted(len(fits), 'scale')} and shifts fitted to the points that the photos see"
    elif where == DEPTH_PATHS:
        fits = {name: (_unit_factor(files[name]), 0.0) for name in maps}
        how = "in nerfstudio's units, because the photos see too few points"
    else:
        raise SceneError(
            f"{where}: the scale of these depth maps is not known, because no photo sees {LEAST_FIT} points that have "
            f"depth in its map; expected a COLMAP model or a PLY with points; {MAPS_ADVICE}"
        )
    kind = "inverse depth" if is_inverse else "depth"
    say(f"depth ({where}): {len(values)} of {len(scene.train)} training photos have a map, read as {kind}; {how}")
    if unlike:
        say(
            f"depth: {counted(len(unlike), 'map')} not used, because the points that the photos see disagree; "
            f"the first: that of {printable(unlike[0])}"
        )
    if few := len(maps) - len(told):
        say(f"depth: {counted(few, 'map')} not used, because no more than a few points tell their scale")
    return DepthMaps({name: (scale * maps[name] + shift).clamp_min(0.0) for name, (scale, shift) in fits.items()})


def read_maps(
    views: Sequence[View], files: Mapping[str, Path], read: Callable[[Path, View], Tensor], kind: str, say: Say
) -> dict[str, Tensor]:
    """Return the maps of those views that have one that can be used, by view.

    Args:
        views: of the scene.
        files: result of `find_maps`, of one of the views at least.
        read: reads a file for its view, or raises a SceneError.
        kind: of the maps, "depth" or "normals".
        say: receives a line if some cannot be used.

    Raises:
        SceneError: none can be used.
    """
    mapped = [view for view in views if view.name in files]

    def load(view: View) -> Tensor | SceneError:
        try:
            return read(files[view.name], view)
        except SceneError as error:
            return error

    results = in_threads(f"Reading maps of {kind}", "maps", load, mapped, most=MAP_THREADS, progress=False)
    maps = {view.name: result for view, result in zip(mapped, results, strict=True) if isinstance(result, Tensor)}
    problems = [result for result in results if isinstance(result, SceneError)]
    if not maps:
        advice = f"correct them, or train without (--{kind} none)"
        raise SceneError(
            f"none of {counted(len(files), 'map')} of {kind} can be used; the first: {problems[0]}; {advice}"
        )
    if problems:
        others = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        say(f"{kind}: {counted(len(problems), 'map')} not used, the first: {problems[0]}{others}")
    return maps


def _unit_factor(file: Path) -> float:
    """Return the factor on the inverse depths of a map of nerfstudio, whose integers are thousandths of world units."""
    return 1.0 if file.suffix.lower() in (".npy", ".exr") else 1.0 / MILLIMETRES


def _read_map(file: Path, view: View) -> Tensor:
    """Return the values (h, w) of a map, at most as large as it is used; NaN where invalid or outside of the mask.

    Raises:
        SceneError: it cannot be used.
    """
    values = torch.from_numpy(_read_numbers(file))
    height, width = values.shape
    size = view.camera.size
    if not same_shape((width, height), size):
        raise SceneError(
            f"{file}: the depth map is {width}x{height} pixels, its photo {size[0]}x{size[1]}; expected the same "
            "aspect ratio"
        )
    values = torch.where(torch.isfinite(values) & (values > 0.0), values, torch.nan)
    largest = depth_size(size)
    if width * height > largest[0] * largest[1]:
        # Inverse depths are averaged later on, too; where surfaces end the mean of depths is on neither.
        values = 1.0 / _resized(1.0 / values, largest)
    if view.mask is not None:
        inside = F.interpolate(view.mask[None].float(), tuple(values.shape), mode="area")[0, 0]
        values = torch.where(inside >= INSIDE_SHARE, values, torch.nan)
    if int((~values.isnan()).sum()) < LEAST_PIXELS:
        raise SceneError(f"{file}: fewer than {LEAST_PIXELS} of its pixels are valid, expected numbers above 0")
    return values


def _read_numbers(file: Path) -> NDArray[np.float32]:
    """Return the numbers (h, w) of a file.

    Raises:
        SceneError: it cannot be read, or is no picture of one channel.
    """
    if file.suffix.lower() != ".npy":
        return read_depth(file, 1.0)
    try:
        array = open_npy(file)
        if array.dtype.kind not in "fiu":
            raise ValueError(f"it holds {array.dtype}, expected numbers")
        shape = tuple(side for side in array.shape if side != 1)
        if len(shape) != 2:
            raise ValueError(f"its shape is {array.shape}, expected height and width")
        check_size(file, shape[1], shape[0])
        with np.errstate(over="ignore"):  # of float64, as inf
            return np.array(array, np.float32).reshape(shape)
    except (OSError, ValueError) as error:
        raise SceneError(f"{file}: the depth map cannot be read ({first_line(error)})") from error


def open_npy(file: Path) -> NDArray[Any]:
    """Return the array of an .npy file, whose numbers are read where they are used.

    Raises:
        OSError: it cannot be read.
        ValueError: it is damaged, or another file.
    """
    require_regular(file)
    with file.open("rb") as stream:
        start = stream.read(len(NPY_START))
    if start != NPY_START:
        raise ValueError(f"it begins with {shortened(start)}, expected NumPy's .npy format")
    try:
        with np.errstate(over="ignore"):  # of a damaged shape
            return np.lib.format.open_memmap(file, mode="r")
    except OSError:
        raise
    except Exception as error:  # damaged headers raise TypeError, OverflowError, TokenError, ... in NumPy
        raise ValueError(f"its header is damaged ({first_line(error)})") from error


def _resized(values: Tensor, size: tuple[int, int]) -> Tensor:
    """Return (h, w) values at another size: means of what is not NaN, NaN where that is less than half of a pixel."""
    width, height = size
    if values.shape == (height, width):
        return values
    valid = ~values.isnan()
    both = torch.stack([torch.where(valid, values, 0.0), valid.float()])
    total, share = F.interpolate(both[None], (height, width), mode="area")[0]
    return torch.where(share >= INSIDE_SHARE, total / share, torch.nan)


def _holds_inverse_depth(maps: Mapping[str, Tensor], seen: Mapping[str, Tensor]) -> bool:
    """Return whether maps grow where the points that their photos see are nearer."""
    ranks, weights = [], []
    for name in (name for name in maps if name in seen):
        place, inverse = seen[name][:, :2], seen[name][:, 2]
        shown = _at(maps[name], place)
        valid = ~shown.isnan()
        if (count := int(valid.sum())) >= LEAST_PIXELS:
            ranks.append(_rank_correlation(shown[valid], -inverse[valid]))
            weights.append(float(count))
    return bool(ranks) and float(np.average(ranks, weights=weights)) < INVERSE


def _fit_to_points(inverse: Tensor, points: Tensor) -> tuple[float, float] | None:
    """Return the scale and shift that bring inverse depths (h, w) to those of points (k, 3).

    Returns:
        None if the points are few; `UNLIKE` if the map tells near points from far ones hardly better than chance.
    """
    shown = _at(inverse, points[:, :2])
    valid = ~shown.isnan()
    if int(valid.sum()) < LEAST_FIT:
        return None
    scale, shift = fit_scale_and_shift(shown, points[:, 2], valid).tolist()
    wanted = points[valid, 2]
    middle = wanted.median()
    apart = (wanted - middle).abs().median()
    left = (scale * shown[valid] + shift - wanted).abs().median()
    agrees = apart <= SAME * middle or left <= MOST_LEFT * apart
    return (scale, shift) if scale > 0.0 and agrees else UNLIKE


def _rank_correlation(one: Tensor, other: Tensor) -> float:
    ranks = torch.stack([one.argsort().argsort(), other.argsort().argsort()]).double()
    return float(torch.corrcoef(ranks)[0, 1])


def _in_view(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return places (k, 2) in shares of the image's sides, below 1, and depths (k,) of points (n, 3) in it."""
    x, y, depths = camera.local(points).unbind(-1)
    across = (camera.fx * x / depths + camera.cx) / camera.width
    down = (camera.fy * y / depths + camera.cy) / camera.height
    inside = (depths > 0) & (across >= 0) & (across < 1) & (down >= 0) & (down < 1)
    return torch.stack([across, down], 1)[inside], depths[inside]


def _pixels(place: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return rows and columns (k,) of places (k, 2) in an image of this width and height."""
    width, height = size
    return (place[:, 1] * height).long().clamp_max(height - 1), (place[:, 0] * width).long().clamp_max(width - 1)


def _at(image: Tensor, place: Tensor) -> Tensor:
    """Return the values (k,) of an image (h, w) at places (k, 2)."""
    return image[_pixels(place, (image.shape[1], image.shape[0]))]


def _load_points(scene: Scene, images: str, say: Say) -> PointDepths:
    """Return the points that each training view sees.

    Raises:
        SceneError: no view sees any.
    """
    points = _seen_points(scene, images)
    if not points:
        raise SceneError(
            f"--depth points: no training photo of {scene.path} sees a point, expected those of a COLMAP model or a "
            "PLY; give a folder of depth maps, or leave it out"
        )
    mean = sum(map(len, points.values())) // len(points)
    say(f"depth (points): {len(points)} of {len(scene.train)} training photos see points, {mean} each in the mean")
    return PointDepths(points)


def _seen_points(scene: Scene, images: str) -> dict[str, Tensor]:
    """Return place and inverse depth (k, 3) of the points that each training view sees, if any.

    They are those of its tracks, without tracks those that are in front. Made-up points are seen by none.
    """
    tracked = _tracked_points(scene, images)
    if tracked is None and bool((scene.colors == MADE_UP).all()):
        return {}
    points = {}
    for view in scene.train:
        own = scene.points if tracked is None else tracked.get(view.name, scene.points[:0])
        place, depths = _in_view(view.camera, own)
        if tracked is None:
            front = _in_front(view.camera, place, depths)
            place, depths = place[front], depths[front]
        if view.mask is not None and len(place):
            inside = _at(view.mask[0], place)
            place, depths = place[inside], depths[inside]
        if len(place):
            points[view.name] = torch.cat([place, 1.0 / depths[:, None]], 1)
    return points


def _tracked_points(scene: Scene, images: str) -> dict[str, Tensor] | None:
    """Return the points (k, 3) of each image by the tracks of its COLMAP model; None without tracks."""
    folder = find_model(scene.path) if scene.kind == "colmap" else None
    if folder is None:
        return None
    model: Model = with_bare_names(read_model(folder, observations=True), scene.path / images)
    if not any(map(len, model.points.tracks)):
        return None
    lengths = np.array([len(track) for track in model.points.tracks])
    accurate = ~(np.array(model.points.errors) > MOST_ERROR)  # also where the error is not known
    keys = np.concatenate([track[:, 0] for track in model.points.tracks])
    numbers = np.repeat(np.arange(len(lengths)), lengths)
    keys, numbers = keys[accurate[numbers]], numbers[accurate[numbers]]
    order = np.argsort(keys, kind="stable")
    keys, numbers = keys[order], numbers[order]
    seen = {}
    for key, image in model.images.items():
        own = np.unique(numbers[np.searchsorted(keys, key) : np.searchsorted(keys, key, "right")])
        seen[image.name] = torch.from_numpy(model.points.xyz[own]).float()
    return seen


def _in_front(camera: Camera, place: Tensor, depths: Tensor) -> Tensor:
    """Return which points (k,) are nearly the nearest of their cell of the image."""
    across = max(1, round(CELLS * min(1.0, camera.width / camera.height)))
    down = max(1, round(CELLS * min(1.0, camera.height / camera.width)))
    rows, columns = _pixels(place, (across, down))
    cell = rows * across + columns
    nearest = torch.full((across * down,), torch.inf).scatter_reduce_(0, cell, depths, "amin")
    return depths <= BEHIND * nearest[cell]
