"""A view to train on: its image, mask and depth, and the transposed matrices that the rasterizer takes."""

import cv2
import numpy as np
import torch
from torch import nn
from utils.general_utils import PILtoTorch
from utils.graphics_utils import getProjectionMatrix, getWorld2View2

NO_SHIFT = np.zeros(3)


class Camera(nn.Module):
    def __init__(
        self,
        resolution,
        colmap_id,
        R,
        T,
        FoVx,
        FoVy,
        depth_params,
        image,
        invdepthmap,
        image_name,
        uid,
        trans=NO_SHIFT,
        scale=1.0,
        data_device="cuda",
        train_test_exp=False,
        is_test_dataset=False,
        is_test_view=False,
    ):
        super().__init__()
        self.uid = uid
        self.colmap_id = colmap_id
        self.R = R
        self.T = T
        self.FoVx = FoVx
        self.FoVy = FoVy
        self.image_name = image_name
        self.data_device = torch.device(data_device)
        pixels = PILtoTorch(image, resolution)
        alpha = pixels[3:4] if len(pixels) == 4 else torch.ones_like(pixels[:1])
        self.alpha_mask = alpha.to(self.data_device)
        if train_test_exp and is_test_view:
            # The left half of a test view trains its exposure, the right half is tested.
            middle = self.alpha_mask.shape[-1] // 2
            self.alpha_mask[..., slice(None, middle) if is_test_dataset else slice(middle, None)] = 0
        self.original_image = pixels[:3].clamp(0.0, 1.0).to(self.data_device)
        self.image_height, self.image_width = self.original_image.shape[1:]
        self.invdepthmap = None
        self.depth_reliable = False
        if invdepthmap is not None:
            self._take_depth(cv2.resize(invdepthmap, resolution), depth_params)
        self.zfar = 100.0
        self.znear = 0.01
        self.trans = trans
        self.scale = scale
        self.world_view_transform = torch.tensor(getWorld2View2(R, T, trans, scale)).transpose(0, 1).cuda()
        self.projection_matrix = getProjectionMatrix(self.znear, self.zfar, FoVx, FoVy).transpose(0, 1).cuda()
        self.full_proj_transform = self.world_view_transform @ self.projection_matrix
        self.camera_center = self.world_view_transform.inverse()[3, :3]

    def _take_depth(self, inverse_depth, depth_params):
        """Scale and shift as the scene says; a scale far from the scene's median is not believed."""
        inverse_depth[inverse_depth < 0] = 0
        self.depth_mask = torch.ones_like(self.alpha_mask)
        self.depth_reliable = True
        if depth_params is not None:
            if not 0.2 <= depth_params["scale"] / depth_params["med_scale"] <= 5:
                self.depth_reliable = False
                self.depth_mask *= 0
            if depth_params["scale"] > 0:
                inverse_depth = inverse_depth * depth_params["scale"] + depth_params["offset"]
        self.invdepthmap = torch.from_numpy(inverse_depth[None]).to(self.data_device)


class MiniCam:
    """A viewer's view."""

    def __init__(self, width, height, fovy, fovx, znear, zfar, world_view_transform, full_proj_transform):
        self.image_width = width
        self.image_height = height
        self.FoVy = fovy
        self.FoVx = fovx
        self.znear = znear
        self.zfar = zfar
        self.world_view_transform = world_view_transform
        self.full_proj_transform = full_proj_transform
        self.camera_center = torch.inverse(world_view_transform)[3, :3]
