"""Load scenes: posed views with their images, and the sparse points that training starts from."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePath
from shlex import quote
from typing import Generic, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_plugin.errors import SceneError, UserInputError, counted
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.units import unit_of_depth
from lapgs_plugin.files import MANIFEST, is_file, is_folder
from lapgs_plugin.hierarchy.inheritance import NEIGHBOURS, places_of
from lapgs_plugin.limits import VIEW_PIXELS
from lapgs_plugin.scenes.blender import SINGLE_FILE, TRAIN_FILE, count_frames, has_transforms, read_transforms
from lapgs_plugin.scenes.colmap import MODEL_PLACES, find_model, read_colmap
from lapgs_plugin.scenes.colmap_model import count_images
from lapgs_plugin.scenes.exports.registry import find_export, read_export
from lapgs_plugin.scenes.images import PhotoFile, image_size, not_there, read_as_3dgs, same_shape, where_else
from lapgs_plugin.scenes.masks import (
    ALPHA,
    AUTO,
    MASKS,
    NONE,
    alpha_mask,
    find_masks,
    find_sky,
    has_photo_suffix,
    outside_sky,
    read_mask,
    read_sky,
    refuse_photos,
    resolve_masks,
    resolve_sky,
)
from lapgs_plugin.scenes.parallel import ProgressCallback, ahead, in_threads, readers_of
from lapgs_plugin.scenes.resolution import Resolution, parse_resolution
from lapgs_plugin.scenes.source import LARGEST, Frame, SceneSource

LEAST_PLACES = NEIGHBOURS + 1
SAMPLED_POINTS = 10_000
"""Most points of which depths are measured."""
SAMPLED_VIEWS = 100
"""Most views in which depths are measured."""
EXTENT_MARGIN = 1.1
ROUNDED = 0.25
"""Largest rounding error of positions in pixels. Models in coordinates of a map have larger, visible ones."""

logger = logging.getLogger(__name__)

_Held = TypeVar("_Held")


class _Pixels(Generic[_Held]):
    """Hold a field of a `View`: a tensor, or a function that reads it at each access; None by default if `optional`."""

    def __init__(self, optional: bool = False) -> None:
        self._optional = optional

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = f"_{name}"

    def __get__(self, view: View | None, owner: type) -> _Held:
        if view is not None:
            held = vars(view)[self._name]
            pixels: _Held = held() if callable(held) else held
            return pixels
        if self._optional:
            return cast("_Held", None)  # the field's default, which dataclasses ask for
        raise AttributeError

    def __set__(self, view: View, held: _Held | Callable[[], _Held]) -> None:
        vars(view)[self._name] = held


@dataclass(frozen=True)
class View:
    """An image and its camera.

    `image`, `mask` and `sky` may be given as functions without arguments, which are called at each access: such a view
    takes no memory. `at` keeps the functions; `dataclasses.replace` would keep their results.

    Attributes:
        name: unique name of the image, such as "0001.jpg" or "train/r_0.png", relative to the image folder of a COLMAP
            scene or to the scene folder of other layouts.
        camera: size, intrinsics and pose, float32; its size is the image's.
        image: (3, h, w) float32 RGB on the CPU, in [0, 1] unless the file holds wider values (EXR).
        mask: (1, h, w) bool, False where the image is ignored, as in its sky; None uses all of it.
        sky: (1, h, w) bool, True where the scene has to be transparent; None without a mask of the sky.
    """

    name: str
    camera: Camera
    image: _Pixels[Tensor] = _Pixels[Tensor]()  # noqa: RUF009  # (3, h, w)
    mask: _Pixels[Tensor | None] = _Pixels[Tensor | None](optional=True)  # noqa: RUF009  # (1, h, w)
    sky: _Pixels[Tensor | None] = _Pixels[Tensor | None](optional=True)  # noqa: RUF009  # (1, h, w)

    @property
    def masked(self) -> bool:
        """Whether there is a mask, which is not read."""
        return vars(self)["_mask"] is not None

    @property
    def on_disk(self) -> bool:
        """Whether the image is read at each access."""
        return callable(vars(self)["_image"])

    @property
    def photo_file(self) -> PhotoFile | None:
        """The file that the image is read from at each access; None if it is in memory or not one file's."""
        held = vars(self)["_image"]
        return held if isinstance(held, PhotoFile) else None

    def at(self, camera: Camera) -> View:
        """Return the view with another camera of the same size."""
        return View(self.name, camera, *(vars(self)[f"_{pixels}"] for pixels in ("image", "mask", "sky")))

    def within(self, mask: Callable[[], Tensor]) -> View:
        """Return the view whose image is ignored outside of another mask (1, h, w), too, which is made at each use."""

        def both() -> Tensor:
            own, other = self.mask, mask()
            return other if own is None else own & other

        return View(self.name, self.camera, vars(self)["_image"], both, vars(self)["_sky"])


def with_pixels(views: Sequence[View]) -> Iterator[View]:
    """Yield views that hold their images. Threads read ahead those that are on the disk.

    Raises:
        SceneError: an image or a mask cannot be read any more.
    """
    if not any(view.on_disk for view in views):
        return iter(views)
    readers = readers_of(view.camera.size for view in views)
    return ahead(lambda view: View(view.name, view.camera, view.image, view.mask), views, most=readers)


@dataclass(frozen=True)
class Scene:
    """The views and points of a scene folder.

    Attributes:
        path: the scene folder.
        kind: "colmap", "transforms" or the program that exported it, such as "metashape".
        train: training views in name order, at least two.
        test: held-out views in name order; none by default.
        points: (n, 3) float32 positions of the sparse points, in world units, n at least 1.
        colors: (n, 3) float32 RGB of the points, in [0, 1].
        extent: size of the scene in world units as in 3DGS: 1.1 times the largest distance of a training camera from
            the mean of their centres.
        background: RGB in [0, 1] that transparent pixels were blended over.
        unit: the length, in world units, that is 1 for rasterizers, whose near plane is at 0.2: a power of two, by the
            median depth of the points; 1 for COLMAP's usual scenes.
    """

    path: Path
    kind: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    points: Tensor  # (n, 3)
    colors: Tensor  # (n, 3)
    extent: float
    background: tuple[float, float, float]
    unit: float = 1.0

    @property
    def smallest_size(self) -> tuple[int, int]:
        """Smallest width and smallest height of all views in pixels, which limit the number of levels."""
        return smallest_of(view.camera for view in (*self.train, *self.test))


def load_scene(
    path: Path | str,
    *,
    resolution: str = "full",
    images: str = "images",
    eval: bool = False,
    masks: str = AUTO,
    sky: str = NONE,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    distorted: bool = False,
    progress: bool | ProgressCallback = True,
    check: Callable[[tuple[int, int], int], None] | None = None,
    hold: bool = True,
    read: bool = True,
) -> Scene:
    """Load a COLMAP scene (`images/`, `sparse/0/`), a transforms scene or another program's export with all its images.

    Cameras and points are checked before any image is read. Views may differ in size.

    Args:
        path: the scene folder.
        resolution: "full", "1k", "2k", "4k", a width or a fraction; see `parse_resolution`. It is relative to the size
            of the image files. "3dgs:" and the -r of a 3DGS codebase load the views as that codebase does: with its
            sizes and pixels, and with the principal point in the middle of the image.
        images: name of the image folder, such as "images_4" for smaller copies.
        eval: hold out every eighth view in name order, or those that a transforms layout names.
        masks: as `masks.resolve_masks` takes it.
        sky: as `masks.resolve_sky` takes it.
        background: RGB behind transparent pixels.
        distorted: give cameras the lenses that bend their rays, instead of refusing distorted ones. Pixels to which a
            lens shows nothing are masked.
        progress: True shows a bar on stderr, False nothing. A function is called with the number of images read and
            their total.
        check: called before any image is read, with `Scene.smallest_size` and the number of training views. An error
            that it raises ends the loading.
        hold: keep the images in memory. False reads each once, to find damaged ones, and again at each use.
        read: False reads images only at each use, see `held_views`.

    Raises:
        SceneError: the folder, its model, an image or a mask cannot be used.
        UserInputError: the resolution cannot be parsed, there is no such folder of masks or of those of the sky, or no
            image has the transparent pixels that `masks` asks for.
    """
    rule = parse_resolution(resolution)
    path = Path(path)
    masks, sky = resolve_masks(path, masks), resolve_sky(path, sky)
    source = _checked_source(path, images, eval, distorted)
    require_places(torch.from_numpy(source.points), f"{path}:")
    for warning in source.warnings:
        logger.warning(warning)
    frames = [*source.train, *source.test]
    names = [frame.name for frame in frames]
    mask_files = {} if masks in (NONE, ALPHA) else find_masks(path / masks, names)
    sky_files = {} if sky == NONE else find_sky(path / sky, names)
    cameras = [_sized_camera(frame, rule) for frame in frames]
    photos = {frame.name: frame.path for frame in frames}
    refuse_photos(mask_files, photos)
    refuse_photos(sky_files, photos, "--sky")
    if check is not None:
        check(smallest_of(cameras), len(source.train))
    short = [camera.width for frame, camera in zip(frames, cameras, strict=True) if rule.falls_short(camera.width)]
    if short:
        logger.warning(
            f"--resolution {resolution}: {len(short)} of {len(frames)} images are only {max(short)} pixels wide or "
            "less and keep their size, images only shrink"
        )
    depth = _median_depth(source.points, source.train)
    _warn_if_rounded(path, source.train, max(camera.fx for camera in cameras), depth)
    behind = background if source.kind == "transforms" else None  # 3DGS ignores alpha of COLMAP scenes

    def load(posed: tuple[Frame, Camera]) -> View:
        frame, camera = posed
        size = camera.size

        image: Callable[[], Tensor] = PhotoFile(frame.path, size, background)
        if rule.backbone is not None:
            image = partial(read_as_3dgs, frame.path, size, behind)

        def in_sky() -> Tensor | None:
            file = sky_files.get(frame.name)
            return None if file is None else read_sky(file, image_size(frame.path), size)

        def mask() -> Tensor | None:
            if mask_files:
                own: Tensor | None = read_mask(mask_files[frame.name], image_size(frame.path), size)
            else:
                own = alpha_mask(frame.path, size) if masks == ALPHA else None
            own = _within_lens(own, camera, frame.path)
            return own if (above := in_sky()) is None else outside_sky(own, above, sky_files[frame.name])

        if not read:
            masked = bool(mask_files) or masks == ALPHA or frame.name in sky_files or lit_pixels(camera) is not None
            return View(
                frame.name, camera, image, mask if masked else None, in_sky if frame.name in sky_files else None
            )
        if hold:
            return View(frame.name, camera, image(), mask(), in_sky())
        _decode(image)
        inside, above = mask(), in_sky()
        later = None if inside is None else mask, None if above is None else in_sky
        return View(frame.name, camera, image, *later)

    items = list(zip(frames, cameras, strict=True))
    shown, readers = progress if read else False, readers_of(camera.size for camera in cameras)
    views = in_threads("Reading images", "images", load, items, most=readers, progress=shown)
    if masks == ALPHA and not any(view.masked for view in views):
        raise UserInputError(
            f"--masks alpha: no image of {path} has transparent pixels; leave the option out, which uses "
            f"{path / MASKS} if it is there"
        )
    return Scene(
        path=path,
        kind=source.kind,
        train=tuple(views[: len(source.train)]),
        test=tuple(views[len(source.train) :]),
        points=torch.from_numpy(source.points).float(),
        colors=torch.from_numpy(source.colors).float().clamp(0.0, 1.0),
        extent=_extent(path, source.train),
        background=background,
        unit=unit_of_depth(depth) if depth else 1.0,
    )


def _decode(image: Callable[[], Tensor]) -> None:
    """Read an image that is not kept, to find out whether it can be read.

    Raises:
        SceneError: it cannot.
    """
    if isinstance(image, PhotoFile) and image.has_levels:
        image.levels()  # decodes the same bytes, in less time
    else:
        image()


def lit_pixels(camera: Camera) -> Tensor | None:
    """Return the pixels (1, h, w) to which a camera's lens shows something; None if it does to all."""
    if camera.lens is None:
        return None
    lit = camera.lit_pixels()
    return None if bool(lit.all()) else lit[None]


def _within_lens(mask: Tensor | None, camera: Camera, path: Path) -> Tensor | None:
    """Return what a mask (1, h, w) leaves of the pixels that a camera's lens shows; None is all of the photo.

    Raises:
        SceneError: nothing.
    """
    if (lit := lit_pixels(camera)) is None:
        return mask
    rest = lit if mask is None else mask & lit
    if not bool(rest.any()):
        whose = "its lens shows nothing to any pixel" if mask is None else "its mask hides all that its lens shows"
        raise SceneError(
            f"{path}: {whose}, expected a part of the photo to train on; correct the camera's distortion or the mask, "
            "or leave the photo out"
        )
    return rest


def held_views(views: Sequence[View], *, hold: bool = True, progress: bool | ProgressCallback = True) -> list[View]:
    """Read the images of views and return the views with them in memory.

    Args:
        views: to read.
        hold: without it, images are only read once, to find out whether they can be, and views returned as they are.
        progress: as `load_scene` takes it.

    Raises:
        SceneError: an image or a mask cannot be read.
    """

    def held(view: View) -> View:
        read = View(view.name, view.camera, view.image, view.mask, view.sky)
        return read if hold else view

    readers = readers_of(view.camera.size for view in views)
    return in_threads("Reading images", "images", held, views, most=readers, progress=progress)


def load_cameras(
    path: Path | str,
    *,
    resolution: str = "full",
    images: str = "images",
    eval: bool = False,
    distorted: bool = False,
) -> tuple[dict[str, Camera], dict[str, Camera]]:
    """Return the cameras of `Scene.train` and `Scene.test` by view name, without reading images.

    Args:
        path, resolution, images, eval, distorted: as `load_scene` takes them.

    Raises:
        SceneError, UserInputError: as `load_scene`.
    """
    rule = parse_resolution(resolution)
    source = _checked_source(Path(path), images, eval, distorted)
    train, test = ({f.name: _sized_camera(f, rule) for f in frames} for frames in (source.train, source.test))
    return train, test


def smallest_size(path: Path | str, *, resolution: str = "full", images: str = "images") -> tuple[int, int]:
    """Return `Scene.smallest_size` from the model and the headers of the images.

    Args:
        path, resolution, images: as `load_scene` takes them.

    Raises:
        SceneError, UserInputError: as `load_scene`.
    """
    train, _ = load_cameras(path, resolution=resolution, images=images)
    return smallest_of(train.values())


def smallest_of(cameras: Iterable[Camera]) -> tuple[int, int]:
    """Return the smallest width and the smallest height of cameras in pixels."""
    widths, heights = zip(*(camera.size for camera in cameras), strict=True)
    return min(widths), min(heights)


def _checked_source(path: Path, images: str, evaluate: bool, distorted: bool) -> SceneSource:
    """Return the frames and points of a scene folder, after checks; arguments as `load_scene` takes them."""
    try:
        str(path.absolute()).encode()
    except UnicodeEncodeError as error:
        raise SceneError(f"{path}: not UTF-8, as which images are opened by name; rename the folder") from error
    if not is_folder(path):
        raise SceneError(
            f"{path}: no such scene folder; give the folder that holds sparse/ or transforms.json, or make one from "
            "photos or a video with `lapgs prepare PHOTOS OUT`"
        )
    if (model := find_model(path)) is not None:
        source = read_colmap(path, model, images, evaluate, distorted)
        if (count := count_frames(path)) not in (None, total := len(source.train) + len(source.test)):
            line = (
                f"{path / SINGLE_FILE} lists {counted(count, 'photo')} and {model} {total}, which are used, as in 3DGS"
            )
            source = replace(source, warnings=(*source.warnings, line))
    elif has_transforms(path):
        source = read_transforms(path, images, evaluate, distorted=distorted)
    elif (export := find_export(path)) is not None:
        source = read_export(export, path, images, evaluate, distorted)
    elif is_file(path / MANIFEST):
        raise SceneError(f"{path} is a run, expected a scene; its {MANIFEST} names the scene that it was trained on")
    else:
        raise SceneError(
            f"{path}: neither a COLMAP model (sparse/0/cameras.bin) nor transforms.json, nor an export of another "
            f"program in it; {_advice_about(path)}"
        )
    check_source(path, source)
    if distorted and all(frame.camera.lens is None for frame in (*source.train, *source.test)):
        raise SceneError(
            f"{path}: no camera of it is distorted, so that --distorted would only make training slower; leave it out"
        )
    return source


def count_photos(path: Path) -> int | None:
    """Return how many photos a scene folder lists, without reading more of it; None where that takes longer."""
    if (model := find_model(path)) is not None:
        return count_images(model) or None
    return None if is_file(path / TRAIN_FILE) else count_frames(path)


def require_colmap_or_transforms(path: Path) -> None:
    """Raise a SceneError with advice if a scene folder holds another program's export, which no checkout reads."""
    if find_model(path) is None and not has_transforms(path) and (export := find_export(path)) is not None:
        raise SceneError(
            f"{export.source}: checkouts do not read this format, expected COLMAP's; write it with `lapgs prepare "
            f"{quote(str(path))} OUT`"
        )


def _advice_about(path: Path) -> str:
    """Return the advice for a folder that is no scene: the scene in it or around it, or the photos in it."""
    if find_model(path, MODEL_PLACES) is not None:
        return f"make a scene of its photos and its model with `lapgs prepare {quote(str(path))} OUT`"
    inside = [path / "dense" / "0", *sorted(path.glob("*"))]  # the first is that of COLMAP's automatic reconstructor
    with suppress(SceneError):
        if (export := next(filter(find_export, filter(is_folder, inside)), None)) is not None:
            return f"give {export}, which has one"
    folders = [*inside, *path.parents[:3]]
    if (scene := next((inner for inner in folders if find_model(inner) or has_transforms(inner)), None)) is not None:
        return f"give {scene}, which has one"
    if find_model(path, (".",)) is not None:
        folder = quote(str(path))
        return f"make a scene of its photos and its model with `lapgs prepare {folder} OUT --model {folder}`"
    known = (path / name for name in ("keyframes/images", "images", "input", "."))  # the first is Polycam's
    photos = next((quote(str(inner)) for inner in known if any(map(has_photo_suffix, inner.glob("*")))), "PHOTOS")
    return f"make a scene from photos with `lapgs prepare {photos} OUT`"


def check_source(path: Path, source: SceneSource) -> None:
    """Check frames and points before any image is read.

    Raises:
        SceneError: there are fewer than two training views, an image is missing, listed twice or outside of the scene,
            or the points cannot be used.
    """
    frames = [*source.train, *source.test]
    if len(source.train) < 2:
        held_out = f" besides {len(source.test)} held out" if source.test else ""
        hint = "train without --eval or add photos" if source.test else "add photos and reconstruct again"
        raise SceneError(
            f"{path}: {counted(len(source.train), 'training view')}{held_out}, expected at least 2; {hint}"
        )
    uses = Counter(key for frame in frames for key in (frame.name, frame.path))
    if (double := next((frame.name for frame in frames if uses[frame.name] + uses[frame.path] > 2), None)) is not None:
        raise SceneError(f"{path}: image {double} is listed twice, expected each once; remove one of its entries")
    if len(missing := [frame for frame in frames if not is_file(frame.path)]) > 1:
        some = len(missing) < len(frames)
        leave_out = f", or leave them out with `lapgs prepare {quote(str(path))} OUT`" if some else ""
        name = missing[0].name if source.kind == "colmap" else missing[0].path.name
        raise SceneError(
            f"{not_there(missing[0].path)} ({len(missing)} of {len(frames)} are missing); "
            f"{where_else(path, name)}{leave_out}"
        )
    for frame in frames:
        if PurePath(frame.name).is_absolute() or ".." in PurePath(frame.name).parts:
            # because renders are written under these names
            raise SceneError(
                f"{path}: image {frame.name} is named by a path outside the scene, expected one inside it; "
                "copy the photos there and reconstruct or export again"
            )
    if len(source.points) == 0 or not np.isfinite(source.points).all():
        raise SceneError(f"{path}: there are no sparse points, or they hold NaN or inf; reconstruct or export again")
    if (furthest := float(np.abs(source.points).max())) > LARGEST:
        raise SceneError(
            f"{path}: a sparse point lies at {furthest:g}, expected at most {LARGEST:g}; reconstruct or export them "
            "again"
        )
    if not np.isfinite(source.colors).all():
        raise SceneError(
            f"{path}: colours of the sparse points hold NaN or inf, expected 0 to 255 or 0.0 to 1.0; export them again"
        )


def _sized_camera(frame: Frame, rule: Resolution) -> Camera:
    """Return the camera at its training size, after comparing the shapes of model and file."""
    width, height = image_size(frame.path)
    check_shape(frame, (width, height))
    size = rule.size_for(width, height)
    subject = f"{frame.path}: at --resolution {rule.text} the image has {size[0]}x{size[1]} pixels"
    VIEW_PIXELS.check(size[0] * size[1], subject, "choose a smaller --resolution", SceneError)
    resized = frame.camera.resized(*size).to(dtype=torch.float32)
    return replace(resized, cx=resized.width / 2, cy=resized.height / 2) if rule.backbone is not None else resized


def check_shape(frame: Frame, size: tuple[int, int]) -> None:
    """Raise a SceneError if the shape of an image file, of this width and height, is not that of its camera."""
    if not same_shape(size, frame.camera.size):
        width, height = frame.camera.size
        raise SceneError(
            f"{frame.path}: the image is {size[0]}x{size[1]} pixels, its camera {width}x{height}; "
            "expected the same aspect ratio, use the images the scene was made from, neither cropped nor rotated since"
        )


def _extent(path: Path, train: Sequence[Frame]) -> float:
    """Return `Scene.extent`."""
    centers = torch.stack([frame.camera.position for frame in train])  # (v, 3)
    extent = EXTENT_MARGIN * float((centers - centers.mean(dim=0)).norm(dim=1).max())
    if extent <= 1e-9 * float(centers.abs().max()):  # only rounding apart
        raise SceneError(
            f"{path}: all {len(train)} training cameras are at the same point, expected photos from different places"
        )
    return extent


def _warn_if_rounded(path: Path, train: Sequence[Frame], focal: float, depth: float) -> None:
    """Warn if float32 rounds positions to more than a part of a pixel: the model is far from the origin.

    Args:
        path: of the scene.
        train: training frames.
        focal: the longest focal length of the views, in pixels.
        depth: as `_median_depth`.
    """
    depth = depth or _extent(path, train)  # made-up points may be elsewhere
    away = float(torch.stack([frame.camera.position.norm() for frame in train]).median())
    rounded = float(np.spacing(np.float32(away))) * focal / depth  # pixels
    if rounded > ROUNDED:
        logger.warning(
            f"{path}: the cameras are {away:.3g} from the origin, where float32 rounds positions to {rounded:.1g} "
            "pixels: fine detail is lost; move cameras and points to the origin, for example with COLMAP's "
            "model_transformer"
        )


def _median_depth(points: NDArray[np.float64], train: Sequence[Frame]) -> float:
    """Return the median depth of points (n, 3) in the views that see them; 0 if none does."""
    some = some_of(torch.from_numpy(points))
    depths = [_depths_in_view(frame.camera, some) for frame in train[:: len(train) // SAMPLED_VIEWS + 1]]
    return float(torch.cat(depths).median()) if any(map(len, depths)) else 0.0


def _depths_in_view(camera: Camera, points: Tensor) -> Tensor:
    """Return the depths of those points (n, 3) that a camera sees, were none hidden."""
    local = camera.local(points)
    return local[camera.shown(local)[1], 2]


def require_places(points: Tensor, whose: str) -> None:
    """Check that points (n, 3) are at enough different places to have sizes. A sample is checked first.

    Args:
        points: of a scene.
        whose: begins the message, such as "the scene has".

    Raises:
        SceneError: they are not.
    """
    places = len(places_of(some_of(points))[0])
    if places < LEAST_PLACES and (places := len(places_of(points)[0])) < LEAST_PLACES:
        raise SceneError(
            f"{whose} {counted(len(points), 'sparse point')} at {counted(places, 'place')}, expected points at "
            f"{LEAST_PLACES} or more; reconstruct or export them again"
        )


def some_of(points: Tensor) -> Tensor:
    """Return an evenly spread sample of points (n, 3), at most `SAMPLED_POINTS`."""
    return points[:: len(points) // SAMPLED_POINTS + 1]
