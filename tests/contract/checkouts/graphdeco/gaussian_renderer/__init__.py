"""One image of the Gaussians, with what densification needs: exposure applied, clamped to [0, 1]."""

import math

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer
from scene.gaussian_model import GaussianModel
from utils.sh_utils import eval_sh


def render(
    viewpoint_camera,
    pc: GaussianModel,
    pipe,
    bg_color: torch.Tensor,
    scaling_modifier=1.0,
    separate_sh=False,
    override_color=None,
    use_trained_exp=False,
):
    screenspace_points = torch.zeros_like(pc.get_xyz, requires_grad=True, device="cuda") + 0
    if screenspace_points.requires_grad:  # not under no_grad
        screenspace_points.retain_grad()
    raster_settings = GaussianRasterizationSettings(
        image_height=int(viewpoint_camera.image_height),
        image_width=int(viewpoint_camera.image_width),
        tanfovx=math.tan(viewpoint_camera.FoVx * 0.5),
        tanfovy=math.tan(viewpoint_camera.FoVy * 0.5),
        bg=bg_color,
        scale_modifier=scaling_modifier,
        viewmatrix=viewpoint_camera.world_view_transform,
        projmatrix=viewpoint_camera.full_proj_transform,
        sh_degree=pc.active_sh_degree,
        campos=viewpoint_camera.camera_center,
        prefiltered=False,
        debug=pipe.debug,
        antialiasing=pipe.antialiasing,
    )
    rasterizer = GaussianRasterizer(raster_settings=raster_settings)
    colors = {"shs": None, "colors_precomp": None}
    if override_color is not None:
        colors["colors_precomp"] = override_color
    elif pipe.convert_SHs_python:
        directions = torch.nn.functional.normalize(pc.get_xyz - viewpoint_camera.camera_center)
        values = eval_sh(pc.active_sh_degree, pc.get_features.transpose(1, 2), directions)
        colors["colors_precomp"] = torch.clamp_min(values + 0.5, 0.0)
    elif separate_sh:
        colors.update(dc=pc.get_features_dc, shs=pc.get_features_rest)
    else:
        colors["shs"] = pc.get_features
    rendered_image, radii, depth_image = rasterizer(
        means3D=pc.get_xyz,
        means2D=screenspace_points,
        opacities=pc.get_opacity,
        scales=pc.get_scaling,
        rotations=pc.get_rotation,
        cov3D_precomp=None,
        **colors,
    )
    if use_trained_exp:
        exposure = pc.get_exposure_from_name(viewpoint_camera.image_name)
        exposed = torch.matmul(rendered_image.permute(1, 2, 0), exposure[:3, :3]).permute(2, 0, 1)
        rendered_image = exposed + exposure[:3, 3, None, None]
    return {
        "render": rendered_image.clamp(0, 1),
        "viewspace_points": screenspace_points,
        "visibility_filter": (radii > 0).nonzero(),
        "radii": radii,
        "depth": depth_image,
    }
