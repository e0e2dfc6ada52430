"""Photometric losses."""

import torch

from lapgs_plugin.ops.photometric_loss import in_torch


def l1_loss(network_output, gt):
    return torch.abs(network_output - gt).mean()


def ssim(img1, img2):
    return in_torch.ssim(img1, img2)
