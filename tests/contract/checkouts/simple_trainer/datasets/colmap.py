"""Read a COLMAP scene as gsplat's examples do: a normalised world, and images from the disk at each access."""

from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pycolmap
import torch


class Parser:
    def __init__(self, data_dir, factor=1, normalize=True, test_every=8):
        self.test_every = test_every
        model = pycolmap.Reconstruction(Path(data_dir, "sparse/0"))
        folder = Path(data_dir, "images" + (f"_{factor}" if factor > 1 else ""))
        images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
        self.image_names = [image.name for image in images]
        self.image_paths = [str(folder / name) for name in self.image_names]
        self.camera_ids = [image.camera_id for image in images]
        height, width = imageio.imread(self.image_paths[0]).shape[:2]
        self.Ks_dict, self.imsize_dict, self.mask_dict = {}, {}, {}
        for key, camera in model.cameras.items():
            K = camera.calibration_matrix()
            K[0] *= width / camera.width
            K[1] *= height / camera.height
            self.Ks_dict[key], self.imsize_dict[key], self.mask_dict[key] = K, (width, height), None
        poses = np.stack([np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in images])
        self.camtoworlds = np.linalg.inv(poses)
        points = [model.points3D[i] for i in sorted(model.points3D)]
        self.points = np.array([point.xyz for point in points], np.float32)
        self.points_rgb = np.array([point.color for point in points], np.uint8)
        self.transform = np.eye(4)
        if normalize:  # centred, of size 1, and turned, as theirs is
            centre = self.camtoworlds[:, :3, 3].mean(0)
            scale = 1 / np.abs(self.camtoworlds[:, :3, 3] - centre).max()
            turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
            self.transform[:3, :3] = scale * turn
            self.transform[:3, 3] = -scale * turn @ centre
            self.points = (self.points @ self.transform[:3, :3].T + self.transform[:3, 3]).astype(np.float32)
            self.camtoworlds[:, :3, 3] = self.camtoworlds[:, :3, 3] @ self.transform[:3, :3].T + self.transform[:3, 3]
            self.camtoworlds[:, :3, :3] = turn @ self.camtoworlds[:, :3, :3]
        places = self.camtoworlds[:, :3, 3]
        self.scene_scale = np.linalg.norm(places - places.mean(0), axis=1).max()


class Dataset:
    def __init__(self, parser, split="train", patch_size=None, load_depths=False):
        self.parser, self.load_depths = parser, load_depths
        indices = np.arange(len(parser.image_names))
        held_out = indices % parser.test_every == 0
        self.indices = indices[~held_out if split == "train" else held_out]

    def __len__(self):
        return len(self.indices)

    def __getitem__(self, item):
        index = self.indices[item]
        camera = self.parser.camera_ids[index]
        image = imageio.imread(self.parser.image_paths[index])[..., :3]
        data = {
            "K": torch.from_numpy(self.parser.Ks_dict[camera].copy()).float(),
            "camtoworld": torch.from_numpy(self.parser.camtoworlds[index]).float(),
            "image": torch.from_numpy(image).float(),
            "image_id": item,
        }
        if (mask := self.parser.mask_dict[camera]) is not None:
            data["mask"] = torch.from_numpy(mask).bool()
        if self.load_depths:
            pose = np.linalg.inv(self.parser.camtoworlds[index])
            local = self.parser.points[:50] @ pose[:3, :3].T + pose[:3, 3]
            pixels = local @ self.parser.Ks_dict[camera].T
            data["points"] = torch.from_numpy(pixels[:, :2] / pixels[:, 2:]).float()
            data["depths"] = torch.from_numpy(local[:, 2]).float()
        return data
