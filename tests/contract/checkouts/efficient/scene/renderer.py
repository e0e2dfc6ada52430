"""One image of the Gaussians, with the largest shares and the losses weighted by shares."""

import math

import torch
from diff_gaussian_rasterization import (
    GaussianRasterizationSettings,
    GaussianRasterizer,
)

from scene.gaussian_model import GaussianModel


def render(
    viewpoint_camera,
    pc: GaussianModel,
    pipe,
    bg_color: torch.Tensor,
    scaling_modifier=1.0,
    top_k=-1,
    pix_loss=None,
    gt_image=None,
    use_hwc=False,
):
    screenspace_points = torch.zeros_like(pc.get_xyz, requires_grad=True, device="cuda") + 0
    if screenspace_points.requires_grad:
        screenspace_points.retain_grad()
    raster_settings = GaussianRasterizationSettings(
        image_height=int(viewpoint_camera.image_height),
        image_width=int(viewpoint_camera.image_width),
        tanfovx=math.tan(viewpoint_camera.FoVx * 0.5),
        tanfovy=math.tan(viewpoint_camera.FoVy * 0.5),
        bg=bg_color,
        scale_modifier=scaling_modifier,
        viewmatrix=viewpoint_camera.world_view_transform.clone(),
        projmatrix=viewpoint_camera.full_proj_transform.clone(),
        sh_degree=pc.active_sh_degree,
        campos=viewpoint_camera.camera_center.clone(),
        prefiltered=False,
        debug=pipe.debug,
        use_train_speedup=False,
        ignored_rate=0,
        lambda_dssim=-1,
        use_hwc=use_hwc,
    )
    rasterizer = GaussianRasterizer(raster_settings=raster_settings)
    rendered_image, radii, max_weight_pids, _, _, loss_weight, _, _ = rasterizer(
        means3D=pc.get_xyz,
        means2D=screenspace_points,
        gt_image=gt_image,
        shs=pc.get_features,
        colors_precomp=None,
        opacities=pc.get_opacity,
        scales=pc.get_scaling,
        rotations=pc.get_rotation,
        cov3D_precomp=None,
        top_k=top_k,
        pix_loss=pix_loss,
        sparse_shs_degree=pc.sparse_shs_degree,
        gs_radius=pipe.gs_radius,
    )
    return {
        "render": rendered_image,
        "max_weight_pids": max_weight_pids,
        "loss_weight": loss_weight,
        "viewspace_points": screenspace_points,
        "visibility_filter": radii > 0,
        "radii": radii,
    }
