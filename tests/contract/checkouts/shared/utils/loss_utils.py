"""Photometric losses."""

import torch

from lapgs_plugin.hierarchy import supervision


def l1_loss(network_output, gt):
    return torch.abs(network_output - gt).mean()


def ssim(img1, img2):
    return supervision.ssim(img1, img2)
