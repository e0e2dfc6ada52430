"""What each Gaussian is worth, and how many there may be."""

import torch
from fused_ssim import fused_ssim as fast_ssim
from gaussian_renderer import render
from PIL import ImageFilter
from torchvision import transforms

from .loss_utils import l1_loss


def get_edges(image):
    picture = transforms.ToPILImage()(image).convert("L")
    return transforms.ToTensor()(picture.filter(ImageFilter.FIND_EDGES))


def get_loss_map(reconstructed_image, original_image, config, edges_loss_norm):
    error = (reconstructed_image - original_image).abs().mean(0).detach()
    normalized = (error - error.min()) / (error.max() - error.min())
    return config["mse_importance"] * normalized + config["edge_importance"] * edges_loss_norm


def normalize(config_value, value_tensor):
    """Values over the median of the positive ones, the others zero."""
    values = value_tensor.nan_to_num(0).to(torch.float32)
    valid = values > 0
    return torch.where(valid, config_value * values / values[valid].median(), 0.0)


def compute_photometric_loss(viewpoint_cam, image):
    gt_image = viewpoint_cam.original_image.cuda()
    dissimilarity = 1.0 - fast_ssim(image.unsqueeze(0), gt_image.unsqueeze(0))
    return 0.8 * l1_loss(image, gt_image) + 0.2 * dissimilarity


def compute_gaussian_score(scene, camlist, edge_losses, gaussians, pipe, bg, importance_values, opt, to_prune=False):
    """(n,) sums over views; each is rendered twice, to find its errors and to sum them by Gaussian."""
    config = importance_values
    own = {
        "grad_importance": (scene.gaussians.xyz_gradient_accum / scene.gaussians.denom).detach()[:, 0],
        "opac_importance": scene.gaussians.get_opacity.detach()[:, 0],
        "scale_importance": scene.gaussians.get_scaling.detach().prod(dim=1),
    }
    gaussian_importance = torch.zeros(len(scene.gaussians.get_xyz), device="cuda")
    for my_viewpoint_cam, edge_loss in zip(camlist, edge_losses, strict=True):
        render_image = render(my_viewpoint_cam, gaussians, pipe, bg)["render"]
        photometric_loss = compute_photometric_loss(my_viewpoint_cam, render_image)
        gt_image = my_viewpoint_cam.original_image.cuda()
        pixel_weights = get_loss_map(render_image, gt_image, config, edge_loss.cuda())
        render_pkg = render(my_viewpoint_cam, gaussians, pipe, bg, pixel_weights=pixel_weights)
        seen = {
            "dept_importance": render_pkg["gaussian_depths"].detach(),
            "radii_importance": render_pkg["gaussian_radii"].detach(),
            "dist_importance": render_pkg["accum_dist"],
            "loss_importance": render_pkg["accum_weights"],
            "count_importance": render_pkg["accum_count"],
            "blend_importance": render_pkg["accum_blend"],
        }
        total = sum(normalize(config[name], values) for name, values in {**own, **seen}.items())
        visible = render_pkg["visibility_filter"].detach()
        gaussian_importance[visible] += (config["view_importance"] * photometric_loss * total)[visible]
    return gaussian_importance


def get_count_array(start_count, multiplier, opt, mode):
    """How many Gaussians there may be after each densification: growth that slows down to none at the budget."""
    budget = int(start_count * float(multiplier)) if mode == "multiplier" else multiplier
    num_steps = (opt.densify_until_iter - opt.densify_from_iter) // opt.densification_interval
    growth = budget - start_count
    slope = 2 * growth / num_steps
    curvature = (growth - slope * num_steps) / (num_steps * num_steps)
    return [int(curvature * step**2 + slope * step + start_count) for step in range(num_steps)]
