"""How consistently a few views reconstruct: the scores that densification and pruning go by."""

import random

import torch
from fused_ssim import fused_ssim as fast_ssim
from gaussian_renderer import render_fastgs

from .loss_utils import l1_loss


def sampling_cameras(my_viewpoint_stack):
    """Ten views, taken off the stack; it fails with fewer."""
    return [my_viewpoint_stack.pop(random.randint(0, len(my_viewpoint_stack) - 1)) for _ in range(10)]


def get_loss(reconstructed_image, original_image):
    error = (reconstructed_image - original_image).abs().mean(0).detach()
    return (error - error.min()) / (error.max() - error.min())


def compute_photometric_loss(viewpoint_cam, image):
    gt_image = viewpoint_cam.original_image.cuda()
    dissimilarity = 1.0 - fast_ssim(image.unsqueeze(0), gt_image.unsqueeze(0))
    return 0.8 * l1_loss(image, gt_image) + 0.2 * dissimilarity


def compute_gaussian_score_fastgs(camlist, gaussians, pipe, bg, args, DENSIFY=False):
    """How many badly rendered pixels each Gaussian touches on average, if DENSIFY, and its share of the loss in [0, 1].

    Each view is rendered twice: to find the pixels, and to count them.
    """
    full_metric_counts = full_metric_score = 0
    for my_viewpoint_cam in camlist:
        render_image = render_fastgs(my_viewpoint_cam, gaussians, pipe, bg, args.mult)["render"]
        photometric_loss = compute_photometric_loss(my_viewpoint_cam, render_image)
        gt_image = my_viewpoint_cam.original_image.cuda()
        metric_map = (get_loss(render_image, gt_image) > args.loss_thresh).int()
        render_pkg = render_fastgs(
            my_viewpoint_cam, gaussians, pipe, bg, args.mult, get_flag=True, metric_map=metric_map
        )
        full_metric_counts = full_metric_counts + render_pkg["accum_metric_counts"]
        full_metric_score = full_metric_score + photometric_loss * render_pkg["accum_metric_counts"]
    low, high = full_metric_score.min(), full_metric_score.max()
    pruning_score = (full_metric_score - low) / (high - low)
    importance_score = torch.div(full_metric_counts, len(camlist), rounding_mode="floor") if DENSIFY else None
    return importance_score, pruning_score
