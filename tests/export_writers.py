"""Write exports of other programs from known cameras, by what their manuals say; shares no code with the readers."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Capture:
    """Known cameras: OpenCV's lens, world to camera in its axes, pixels from the corner of the image."""

    size: tuple[int, int]
    focal: tuple[float, float]
    center: tuple[float, float]
    names: list[str]
    turns: Array  # (v, 3, 3)
    shifts: Array  # (v, 3)
    xyz: Array  # (n, 3)
    rgb: NDArray[np.uint8]  # (n, 3)
    radial: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)
    depths: dict[str, NDArray[np.float32]] = field(default_factory=dict)

    @property
    def centers(self) -> Array:
        """Positions of the cameras (v, 3)."""
        return -np.einsum("vji,vj->vi", self.turns, self.shifts)

    def pixels(self, view: int) -> Array:
        """Return where the points in front of a view are, by OpenCV, (m, 2)."""
        matrix = np.array([[self.focal[0], 0, self.center[0]], [0, self.focal[1], self.center[1]], [0, 0, 1.0]])
        turn, _ = cv2.Rodrigues(self.turns[view])
        points = self.xyz[self.in_front(view)]
        terms = np.array([*self.radial[:2], *self.tangential, self.radial[2]])
        return cv2.projectPoints(points, turn, self.shifts[view], matrix, terms)[0].reshape(-1, 2)

    def in_front(self, view: int) -> NDArray[np.bool_]:
        """Return which points are well in front of a view and near its axis, where polynomials are monotonic."""
        local = self.xyz @ self.turns[view].T + self.shifts[view]
        return (local[:, 2] > 0.1) & (np.abs(local[:, :2]).max(axis=1) < local[:, 2])


def from_colmap(folder: Path, views: int = 12) -> Capture:
    """Return some views of a COLMAP model with a PINHOLE or SIMPLE_RADIAL camera."""
    model = pycolmap.Reconstruction(folder)
    images = sorted(model.images.values(), key=lambda image: image.name)[:views]
    camera = model.cameras[images[0].camera_id]
    radial = (float(camera.params[3]), 0.0, 0.0) if camera.model.name == "SIMPLE_RADIAL" else (0.0, 0.0, 0.0)
    poses = np.stack([image.cam_from_world().matrix() for image in images])
    points = list(model.points3D.values())[::50]
    return Capture(
        (camera.width, camera.height),
        (camera.focal_length_x, camera.focal_length_y),
        (camera.principal_point_x, camera.principal_point_y),
        [image.name for image in images],
        poses[:, :, :3],
        poses[:, :, 3],
        np.stack([point.xyz for point in points]),
        np.stack([point.color for point in points]),
        radial,
    )


def synthetic(distorted: bool = False) -> Capture:
    """Return six small views of points in front of them."""
    random = np.random.default_rng(5)
    turns = Rotation.from_rotvec(random.uniform(-0.4, 0.4, (6, 3)))
    xyz = random.uniform((-2, -2, 4), (2, 2, 8), (200, 3))
    capture = Capture(
        (192, 128),
        (170.0, 170.0),
        (98.5, 61.25),
        [f"shot {view} a.png" for view in range(6)],
        turns.as_matrix(),
        random.uniform(-1, 1, (6, 3)),
        xyz,
        random.integers(0, 256, (200, 3), dtype=np.uint8),
    )
    return replace(capture, radial=(-0.05, 0.02, -0.004), tangential=(0.002, -0.003)) if distorted else capture


def write_photos(folder: Path, capture: Capture, names: list[str] | None = None) -> None:
    """Write a photo of the capture's size for each name."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(names or capture.names):
        color = (40 * (index % 6), 90, 160)
        Image.new("RGB", capture.size, color).save(folder / name)


def write_ply(file: Path, xyz: Array, rgb: NDArray[np.uint8]) -> None:
    """Write coloured points."""
    kinds = [(axis, "f8") for axis in "xyz"] + [(color, "u1") for color in ("red", "green", "blue")]
    rows = np.array([(*point, *color) for point, color in zip(xyz, rgb, strict=True)], dtype=kinds)
    PlyData([PlyElement.describe(rows, "vertex")]).write(file)


def write_metashape(folder: Path, capture: Capture) -> None:
    """Write a chunk in coordinates of its own, with its transform; PLY in the world; labels without suffix."""
    turn, scale, shift = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix(), 2.5, np.array([3.0, -4.0, 5.0])
    width, height = capture.size
    terms = {
        "f": capture.focal[1],
        "cx": capture.center[0] - width / 2,
        "cy": capture.center[1] - height / 2,
        "b1": capture.focal[0] - capture.focal[1],
        **{f"k{power}": value for power, value in enumerate(capture.radial, 1)},
        "p1": capture.tangential[1],
        "p2": capture.tangential[0],
    }
    lens = "".join(f"<{key}>{value!r}</{key}>" for key, value in terms.items() if value)
    cameras = ""
    for index, name in enumerate(capture.names):
        pose = np.eye(4)
        pose[:3, :3] = turn.T @ capture.turns[index].T
        pose[:3, 3] = turn.T @ (capture.centers[index] - shift) / scale
        numbers = " ".join(repr(float(value)) for value in pose.ravel())
        cameras += (
            f'<camera id="{index}" sensor_id="0" component_id="0" label="{Path(name).stem}">'
            f"<transform>{numbers}</transform><orientation>1</orientation></camera>"
        )
    (folder / "cameras.xml").write_text(
        f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0">
  <chunk label="Chunk 1" enabled="true">
    <sensors next_id="1"><sensor id="0" label="lens" type="frame">
      <resolution width="{width}" height="{height}"/>
      <calibration type="frame" class="initial"><resolution width="{width}" height="{height}"/><f>1</f></calibration>
      <calibration type="frame" class="adjusted"><resolution width="{width}" height="{height}"/>{lens}</calibration>
    </sensor></sensors>
    <components next_id="1" active_id="0"><component id="0" label="Component 1"><transform>
      <rotation locked="false">{" ".join(repr(float(v)) for v in turn.ravel())}</rotation>
      <translation locked="false">{" ".join(repr(float(v)) for v in shift)}</translation>
      <scale locked="false">{scale!r}</scale>
    </transform></component></components>
    <cameras next_id="99" next_group_id="1"><group id="0" label="Group" type="folder">{cameras}</group>
      <camera id="98" sensor_id="0" label="never aligned"/></cameras>
  </chunk>
</document>
"""
    )
    write_ply(folder / "points.ply", capture.xyz, capture.rgb)
    write_photos(folder / "images", capture)


def write_realitycapture(folder: Path, capture: Capture) -> None:
    """Write a registration: heading, pitch, roll of a camera that looks along -z; f in mm of 35 mm film."""
    width, height = capture.size
    side = max(width, height)
    rows = [f"#cameras {len(capture.names)}", "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for index, name in enumerate(capture.names):
        axes = capture.turns[index].T @ np.diag([1, -1, -1])  # Rz(-heading) Rx(pitch) Ry(roll), multiplied out
        heading = np.degrees(np.arctan2(axes[0, 1], axes[1, 1]))
        pitch, roll = np.degrees([np.arcsin(axes[2, 1]), np.arctan2(-axes[2, 0], axes[2, 2])])
        numbers = [
            *capture.centers[index],
            *(heading, pitch, roll, capture.focal[0] * 36 / side),
            (capture.center[0] - width / 2) / side,
            (capture.center[1] - height / 2) / side,
            *(*capture.radial, 0.0, *capture.tangential),
        ]
        rows.append(",".join([name, *(repr(float(number)) for number in numbers)]))
    (folder / "registration.csv").write_text("\r\n".join(rows) + "\r\n")
    write_ply(folder / "points.PLY", capture.xyz, capture.rgb)
    write_photos(folder / "images", capture)


def write_bundler(folder: Path, capture: Capture) -> None:
    """Write Bundler's file: cameras look along -z, y is up; the first camera was not placed."""
    flip = np.diag([1.0, -1.0, -1.0])
    lines = ["# Bundle file v0.3", f"{len(capture.names) + 1} {len(capture.xyz)}", "0 0 0", *["0 0 0"] * 4]
    for turn, shift in zip(capture.turns, capture.shifts, strict=True):
        rows = [[capture.focal[0], *capture.radial[:2]], *(flip @ turn), flip @ shift]
        lines += [" ".join(repr(float(value)) for value in row) for row in rows]
    for point, color in zip(capture.xyz, capture.rgb, strict=True):
        lines += [" ".join(repr(float(v)) for v in point), " ".join(map(str, color)), "2 0 0 1.5 2.5 1 7 -3.5 4"]
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    (folder / "list.txt").write_text("\n".join(["lost.jpg", *(f"{name} 0 1234.5" for name in capture.names)]) + "\n")
    write_photos(folder / "images", capture)


def write_opensfm(folder: Path, capture: Capture) -> None:
    """Write OpenDroneMap's project: lengths as shares of the longer side, rotations as axis times angle."""
    side = max(capture.size)
    camera = {
        "projection_type": "brown",
        "width": capture.size[0],
        "height": capture.size[1],
        "focal_x": capture.focal[0] / side,
        "focal_y": capture.focal[1] / side,
        "c_x": (capture.center[0] - capture.size[0] / 2) / side,
        "c_y": (capture.center[1] - capture.size[1] / 2) / side,
        **{f"k{power}": value for power, value in enumerate(capture.radial, 1)},
        "p1": capture.tangential[0],
        "p2": capture.tangential[1],
    }
    shots = {
        name: {
            "rotation": cv2.Rodrigues(turn)[0].ravel().tolist(),
            "translation": shift.tolist(),
            "camera": "v2 a b",
            "orientation": 1,
        }
        for name, turn, shift in zip(capture.names, capture.turns, capture.shifts, strict=True)
    }
    points = {
        str(key): {"color": color.tolist(), "coordinates": point.tolist()}
        for key, (point, color) in enumerate(zip(capture.xyz, capture.rgb, strict=True))
    }
    small = {"cameras": {}, "shots": {}, "points": {}}
    (folder / "opensfm").mkdir(parents=True)
    file = folder / "opensfm/reconstruction.json"
    file.write_text(json.dumps([small, {"cameras": {"v2 a b": camera}, "shots": shots, "points": points}]))
    write_photos(folder / "images", capture)


def _arkit_poses(capture: Capture) -> Array:
    """Return camera to world (v, 3, 4) of cameras that look along -z, y up."""
    turns = capture.turns.transpose(0, 2, 1) @ np.diag([1.0, -1.0, -1.0])
    return np.concatenate([turns, capture.centers[:, :, None]], 2)


def write_record3d(folder: Path, capture: Capture) -> None:
    """Write EXR + RGB: a quaternion x, y, z, w and a position for each frame."""
    (fx, fy), (cx, cy) = capture.focal, capture.center
    poses = [[*pycolmap.Rotation3d(pose[:, :3]).quat, *pose[:, 3]] for pose in _arkit_poses(capture)]
    metadata = {
        **{"w": capture.size[0], "h": capture.size[1], "dw": 48, "dh": 32, "fps": 60},
        "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1],
        "poses": [[float(value) for value in pose] for pose in poses],
    }
    (folder / "EXR_RGBD").mkdir()
    (folder / "EXR_RGBD/metadata.json").write_text(json.dumps(metadata))
    write_photos(folder / "EXR_RGBD/rgb", capture, [f"{index}.jpg" for index in range(len(poses))])


def write_polycam(folder: Path, capture: Capture) -> None:
    """Write raw data: a file for each camera, named by its time."""
    keyframes = folder / "keyframes"
    times = [str(12345678 + 1000 * index) for index in range(len(capture.names))]
    (keyframes / "corrected_cameras").mkdir(parents=True)
    for time, pose in zip(times, _arkit_poses(capture), strict=True):
        camera = {f"t_{row}{column}": float(pose[row, column]) for row in range(3) for column in range(4)}
        camera |= {"fx": capture.focal[0], "fy": capture.focal[1], "cx": capture.center[0], "cy": capture.center[1]}
        camera |= {"width": capture.size[0], "height": capture.size[1], "blur_score": 90.0}
        (keyframes / f"corrected_cameras/{time}.json").write_text(json.dumps(camera))
    write_photos(keyframes / "corrected_images", capture, [f"{time}.jpg" for time in times])


def write_arkitscenes(folder: Path, capture: Capture) -> None:
    """Write a scene of the data set; a photo has no pose, names of lenses are a millisecond off."""
    frames = folder / "41069021_frames"
    (frames / "lowres_wide_intrinsics").mkdir(parents=True)
    (width, height), (fx, fy), (cx, cy) = capture.size, capture.focal, capture.center
    rows, names = [], ["41069021_99.000.png"]
    for index, (turn, shift) in enumerate(zip(capture.turns, capture.shifts, strict=True)):
        time = 100.1 + index
        values = [time + 0.002, *cv2.Rodrigues(turn)[0].ravel(), *shift]
        rows.append(" ".join(repr(float(value)) for value in values))
        names.append(f"41069021_{time:.3f}.png")
        pincam = frames / f"lowres_wide_intrinsics/41069021_{time - 0.001:.3f}.pincam"
        pincam.write_text(" ".join(map(str, (width, height, fx, fy, cx, cy))))
    (frames / "lowres_wide.traj").write_text("\n".join(rows) + "\n")
    write_photos(frames / "lowres_wide", capture, names)
    write_ply(folder / "41069021_3dod_mesh.ply", capture.xyz, capture.rgb)


WRITERS = {
    "metashape": write_metashape,
    "realitycapture": write_realitycapture,
    "bundler": write_bundler,
    "opensfm": write_opensfm,
    "record3d": write_record3d,
    "polycam": write_polycam,
    "arkitscenes": write_arkitscenes,
}
"""Writers by the name of the reader."""
