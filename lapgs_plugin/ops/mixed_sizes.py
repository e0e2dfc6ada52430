"""Hold images of several sizes in one tensor: each at its top left, which is as large as the largest.

What is beyond an image's own part has no meaning. Operations that are told the sizes do not read it, and the gradients
that they return are zero there.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

Sizes = Sequence[tuple[int, int]]
"""(width, height) of each image."""


def largest_size(sizes: Sizes) -> tuple[int, int]:
    """Return the width and the height of the tensor that holds images of some sizes."""
    return max(width for width, _ in sizes), max(height for _, height in sizes)


def if_mixed(sizes: Sizes) -> Sizes | None:
    """Return the sizes if they differ, else None: the images are whole."""
    return sizes if len(set(sizes)) > 1 else None


def own_part(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the part (..., h, w) of an image (..., H, W) that has a meaning, as a view."""
    return image[..., : size[1], : size[0]]


def own_parts(images: Tensor, sizes: Sizes) -> list[Tensor]:
    """Return the part of each image of (b, ..., H, W)."""
    return [own_part(image, size) for image, size in zip(images, sizes, strict=True)]


def stack_padded(images: Sequence[Tensor]) -> Tensor:
    """Return images (..., h, w) as one tensor (b, ..., H, W), zero beyond them; differentiable."""
    if all(image.shape == images[0].shape for image in images):
        return torch.stack(list(images))
    width, height = largest_size([(image.shape[-1], image.shape[-2]) for image in images])
    padded = images[0].new_zeros(len(images), *images[0].shape[:-2], height, width)
    for index, image in enumerate(images):
        own_part(padded[index], (image.shape[-1], image.shape[-2])).copy_(image)
    return padded


def similar_sizes(sizes: Sizes, most: float) -> dict[tuple[int, int], int]:
    """Group sizes so that images of a group have little padding where one tensor holds all of them.

    Args:
        sizes: in any order; the result does not depend on it.
        most: largest padding of an image, as a share of its own pixels.

    Returns:
        The number of the group of each size.
    """
    groups: list[list[tuple[int, int]]] = []
    for size in sorted(set(sizes), reverse=True):
        for group in groups:
            width, height = largest_size([*group, size])
            if all(width * height <= (1 + most) * own[0] * own[1] for own in (*group, size)):
                group.append(size)
                break
        else:
            groups.append([size])
    return {size: number for number, group in enumerate(groups) for size in group}


def sizes_on_device(sizes: Sizes, device: torch.device) -> Tensor:
    """Return (b, 2) int32 widths and heights on a device, without waiting for it."""
    return _together(tuple(sizes), device)


@lru_cache(maxsize=8)  # all operations of a launch have the same
@torch.inference_mode(False)  # the cache serves calls that need gradients
def _together(sizes: tuple[tuple[int, int], ...], device: torch.device) -> Tensor:
    return torch.stack([_alone(size, device) for size in sizes])


@lru_cache(maxsize=1024)
@torch.inference_mode(False)  # the cache serves calls that need gradients
def _alone(size: tuple[int, int], device: torch.device) -> Tensor:
    # Page-locked, because a copy from other memory would wait for the GPU.
    numbers = torch.tensor(size, dtype=torch.int32, device="cpu", pin_memory=device.type == "cuda")
    return numbers.to(device, non_blocking=True)
