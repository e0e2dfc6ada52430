"""Image quality."""

import torch


def mse(img1, img2):
    return ((img1 - img2) ** 2).flatten(1).mean(1, keepdim=True)


def psnr(img1, img2):
    return -10 * torch.log10(mse(img1, img2))
