"""Find and read masks of photos, white where a photo shows the scene, and of their sky, white where they show it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePath, PurePosixPath
from statistics import fmean

import torch
from PIL import Image
from torch import Tensor

from lapgs_plugin.errors import SceneError, UserInputError, printable
from lapgs_plugin.files import is_folder
from lapgs_plugin.scenes.blender import mask_folder
from lapgs_plugin.scenes.images import SUFFIXES, has_alpha, image_size, is_photo, read_image, same_shape
from lapgs_plugin.untrusted import require_regular

MASKS = "masks"
"""Folder of masks in a scene that `lapgs prepare` writes."""
AUTO, NONE, ALPHA = "auto", "none", "alpha"
BLACK = 0.5 / 255
"""Largest value of a mask that is black everywhere."""
HEIC = (".heic", ".heif", ".hif")
"""Photos of phones that neither COLMAP nor OpenImageIO reads."""


def has_photo_suffix(file: PurePath) -> bool:
    """Return whether a file is a photo by its name."""
    return file.suffix.lower() in (*SUFFIXES, *HEIC)


def resolve_masks(scene: Path, setting: str) -> str:
    """Resolve a value of --masks for a scene: "none", "alpha", or a folder, relative to the scene or absolute.

    Raises:
        UserInputError: there is no such folder, or the link in its place leads to none.
    """
    if setting == AUTO:
        if (scene / MASKS).is_symlink() and not is_folder(scene / MASKS):
            raise UserInputError(f"{scene / MASKS} is a link to no folder; put the masks there, or remove it")
        return MASKS if is_folder(scene / MASKS) else mask_folder(scene) or NONE
    if setting in (NONE, ALPHA):
        return setting
    return resolve_folder(scene, setting, "--masks", "a folder of masks, alpha or none")


def resolve_sky(scene: Path, setting: str) -> str:
    """Resolve a value of --sky for a scene: "none", or a folder, relative to the scene or absolute.

    Raises:
        UserInputError: there is no such folder.
    """
    if setting == NONE:
        return setting
    return resolve_folder(scene, setting, "--sky", "a folder of masks, white where sky is, or none")


def resolve_folder(scene: Path, setting: str, option: str, expected: str) -> str:
    """Resolve a folder beside the photos, relative to the scene or absolute.

    Args:
        scene: its folder.
        setting: value of an option.
        option, expected: its name and what it may be, for the message.

    Raises:
        UserInputError: there is no such folder.
    """
    if is_folder(scene / setting):
        return setting
    if not is_folder(Path(setting)):
        raise UserInputError(f"{option} {setting}: no such folder; expected {expected}")
    return str(Path(setting).absolute())


def find_masks(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Return the mask file of each image by its name.

    Raises:
        SceneError: an image has no mask, or several.
    """
    masks, shorter = _masks_of(folder, names)
    if missing := [shorter[name] for name in names if name not in masks]:
        stem = stem_of(missing[0])
        raise SceneError(
            f"{folder}: {len(missing)} of {len(names)} photos have no mask, the first is {printable(missing[0])}; "
            f"expected {printable(f'{missing[0]}.png, {stem}.png or {stem}_mask.png')}: add it (all white to use the "
            "whole photo), or use no masks (in training: --masks none)"
        )
    return masks


def find_sky(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Return the masks of the sky of those images that have one, by their names.

    Raises:
        SceneError: no image has one, or an image has several.
    """
    masks, shorter = _masks_of(folder, names)
    if not masks:
        stem = stem_of(shorter[names[0]])
        raise SceneError(
            f"{folder}: no photo of {len(names)} has a mask of its sky, expected files such as "
            f"{printable(f'{stem}.png or {stem}_mask.png')}; give their folder, or train without --sky"
        )
    return masks


def _masks_of(folder: Path, names: Sequence[str]) -> tuple[dict[str, Path], dict[str, str]]:
    """Return the masks of those images that have one, by name, and the names without a folder that holds all.

    The mask of a.jpg is a.jpg.png as in COLMAP, a.png (or another image file), or a_mask.png, in the same subfolder. A
    folder that holds all photos, such as images/, may be left out. Other folders are not searched, because `folder` may
    be a whole disk by mistake.

    Raises:
        SceneError: an image has several.
    """
    common = common_folder(names)
    shorter = {name: name.removeprefix(common) for name in names}
    parents = {PurePosixPath(name).parent for name in (*names, *shorter.values())}
    searched = filter(is_folder, (folder / parent for parent in parents))
    files = [file for inner in searched for file in inner.iterdir() if is_photo(file)]
    present: dict[str, list[Path]] = {}
    for file in sorted(files):  # cameras write .JPG, other programs .jpg
        present.setdefault(file.relative_to(folder).as_posix().lower(), []).append(file)
    masks = {name: _mask_of(folder, present, name) or _mask_of(folder, present, shorter[name]) for name in names}
    return {name: path for name, path in masks.items() if path is not None}, shorter


def common_folder(names: Sequence[str]) -> str:
    """Return the top folder that all names begin with, with its slash; "" if there is none."""
    tops = {name[: name.find("/") + 1] for name in names}  # "" of a name without a folder
    return tops.pop() if len(tops) == 1 else ""


def refuse_photos(masks: Mapping[str, Path], photos: Mapping[str, Path], option: str = "--masks") -> None:
    """Check that no photo is its own mask, as if an option for masks names the folder of the photos.

    Raises:
        SceneError: one is, or a mask is no file.
    """
    for name, mask in masks.items():
        try:
            require_regular(mask)
        except OSError as error:
            raise SceneError(f"{mask} cannot be read: {error.strerror}; expected a mask, put it there") from error
        if mask.samefile(photos[name]):
            raise SceneError(
                f"{option} {mask.parent}: {printable(mask.name)} is the photo itself, expected its mask; give the "
                "folder of the masks"
            )


def _mask_of(folder: Path, present: dict[str, list[Path]], name: str) -> Path | None:
    stem = stem_of(name)
    whole = [name] if stem != name else [f"{name}{suffix}" for suffix in SUFFIXES]  # a checkout's name without suffix
    spellings = [f"{name}.png" for name in whole]
    spellings += [f"{stem}{end}{suffix}" for end in ("", "_mask") for suffix in SUFFIXES]
    files = [file for spelling in spellings for file in present.get(spelling.lower(), ())]
    if len(files) > 1:
        raise SceneError(
            f"{folder}: photo {printable(name)} has the masks {printable(files[0].name)} and "
            f"{printable(files[1].name)}, expected one; remove the other"
        )
    return files[0] if files else None


def stem_of(name: str) -> str:
    """Return the name of a photo without its suffix."""
    path = PurePosixPath(name)
    return path.with_suffix("").as_posix() if has_photo_suffix(path) else name


def read_mask(path: Path, photo: tuple[int, int], size: tuple[int, int]) -> Tensor:
    """Read the mask of a photo, at the size of its view.

    Values above half of the mask's largest are inside. So masks of 0 and 1 are read like those of 0 and 255.

    Args:
        path: the mask.
        photo: (width, height) of its photo, whose shape the mask must have.
        size: (width, height) of the result.

    Returns:
        (1, h, w) bool, True inside.

    Raises:
        SceneError: it cannot be read, has another shape, or is black everywhere.
    """
    return _inside(_read_grey(path, photo, size), path)


def read_sky(path: Path, photo: tuple[int, int], size: tuple[int, int]) -> Tensor:
    """Read the mask of a photo's sky as `read_mask` does, (1, h, w) bool, True in the sky; black has none.

    Raises:
        SceneError: it cannot be read, or has another shape.
    """
    values = _read_grey(path, photo, size)
    highest = float(values.max())
    return values > 0.5 * min(highest, 1.0) if highest > BLACK else torch.zeros_like(values, dtype=torch.bool)


def outside_sky(mask: Tensor | None, sky: Tensor, path: Path) -> Tensor:
    """Return what a mask (1, h, w) leaves outside of the sky; None is all of the photo.

    Raises:
        SceneError: nothing.
    """
    rest = ~sky if mask is None else mask & ~sky
    if not bool(rest.any()):
        raise SceneError(
            f"{path}: the photo shows nothing but sky, or what its mask hides, expected white in the sky alone; leave "
            "the photo out, or correct the mask"
        )
    return rest


def _read_grey(path: Path, photo: tuple[int, int], size: tuple[int, int]) -> Tensor:
    """Return the grey values (1, h, w) of a mask at a size, after comparing its shape with the photo's."""
    width, height = image_size(path)
    if not same_shape((width, height), photo):
        turned = " (EXIF turns photos for display; masks belong to stored pixels)" if width == photo[1] else ""
        raise SceneError(
            f"{path}: the mask is {width}x{height} pixels, its photo {photo[0]}x{photo[1]}{turned}; expected the same "
            "size, make it again from this photo"
        )
    return read_image(path, size=size).mean(0, keepdim=True)


def alpha_mask(photo: Path, size: tuple[int, int]) -> Tensor | None:
    """Return where a photo is opaque, (1, h, w) bool; None if it has no alpha channel or is opaque everywhere.

    Raises:
        SceneError: it cannot be read or is transparent everywhere.
    """
    if not has_alpha(photo):
        return None
    black, white = (read_image(photo, size=size, background=(grey,) * 3, clamp=False)[:1] for grey in (0.0, 1.0))
    opaque = 1.0 - (white - black)
    return None if bool((opaque > 0.5).all()) else _inside(opaque, photo)


def write_mask(path: Path, mask: Tensor) -> None:
    """Write a mask (1, h, w) of bool as a grey PNG, white inside. Missing folders are made.

    Raises:
        OSError: it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(mask[0].to(torch.uint8).mul(255).numpy()).save(path, "PNG", compress_level=1)


def _inside(values: Tensor, path: Path) -> Tensor:
    highest = float(values.max())
    if highest <= BLACK:
        raise SceneError(
            f"{path}: the mask is black everywhere, expected white where the photo shows the scene; leave the photo out"
        )
    return values > 0.5 * min(highest, 1.0)


def share_inside(masks: Iterable[Tensor | None]) -> float:
    """Return the share of pixels inside of masks, the mean over views; None is a view without a mask."""
    return fmean(1.0 if mask is None else float(mask.float().mean()) for mask in masks)
