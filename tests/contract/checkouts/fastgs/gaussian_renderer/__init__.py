"""One image of the Gaussians, with what densification and the scores need."""

import math

import torch
from diff_gaussian_rasterization_fastgs import GaussianRasterizationSettings, GaussianRasterizer
from scene.gaussian_model import GaussianModel
from utils.sh_utils import eval_sh


def render_fastgs(
    viewpoint_camera,
    pc: GaussianModel,
    pipe,
    bg_color: torch.Tensor,
    mult,
    scaling_modifier=1.0,
    override_color=None,
    get_flag=None,
    metric_map=None,
):
    # Four columns: the gradients by the screen position, and the sums of their absolute values.
    screenspace_points = (
        torch.zeros((len(pc.get_xyz), 4), dtype=pc.get_xyz.dtype, requires_grad=True, device="cuda") + 0
    )
    if screenspace_points.requires_grad:  # not under no_grad
        screenspace_points.retain_grad()
    height, width = int(viewpoint_camera.image_height), int(viewpoint_camera.image_width)
    if metric_map is None:
        metric_map = torch.zeros(height * width, dtype=torch.int, device="cuda")
    raster_settings = GaussianRasterizationSettings(
        image_height=height,
        image_width=width,
        tanfovx=math.tan(viewpoint_camera.FoVx * 0.5),
        tanfovy=math.tan(viewpoint_camera.FoVy * 0.5),
        bg=bg_color,
        scale_modifier=scaling_modifier,
        viewmatrix=viewpoint_camera.world_view_transform,
        projmatrix=viewpoint_camera.full_proj_transform,
        sh_degree=pc.active_sh_degree,
        campos=viewpoint_camera.camera_center,
        mult=mult,
        prefiltered=False,
        debug=pipe.debug,
        get_flag=get_flag,
        metric_map=metric_map,
    )
    rasterizer = GaussianRasterizer(raster_settings=raster_settings)
    dc = shs = colors_precomp = None
    if override_color is not None:
        colors_precomp = override_color
    elif pipe.convert_SHs_python:
        directions = torch.nn.functional.normalize(pc.get_xyz - viewpoint_camera.camera_center)
        values = eval_sh(pc.active_sh_degree, pc.get_features.transpose(1, 2), directions)
        colors_precomp = torch.clamp_min(values + 0.5, 0.0)
    else:
        dc, shs = pc.get_features_dc, pc.get_features_rest
    rendered_image, radii, accum_metric_counts = rasterizer(
        means3D=pc.get_xyz,
        means2D=screenspace_points,
        dc=dc,
        shs=shs,
        colors_precomp=colors_precomp,
        opacities=pc.get_opacity,
        scales=pc.get_scaling,
        rotations=pc.get_rotation,
        cov3D_precomp=None,
    )
    return {
        "render": rendered_image,
        "viewspace_points": screenspace_points,
        "visibility_filter": (radii > 0).nonzero(),
        "radii": radii,
        "accum_metric_counts": accum_metric_counts,
    }
