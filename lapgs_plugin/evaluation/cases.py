"""Build the cases that rasterizers are compared on: ordinary scenes, and adversarial ones that each test one decision.

A `Case` holds all arguments of one rasterizer call. Builders are deterministic and work in float64;
`Case.to(torch.float32)` rounds a case once, so that both precisions see the same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, RenderResult

BLACK, WHITE, COLORED = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.2, 0.7, 0.4)


@dataclass(frozen=True)
class Case:
    """The arguments of one rasterizer call; `sh_degree` None evaluates all degrees of the field."""

    name: str
    field: GaussianField
    camera: Camera
    background: tuple[float, float, float] = BLACK
    sh_degree: int | None = None

    def __repr__(self) -> str:
        return f"Case({self.name}: {len(self.field)} Gaussians, {self.camera.width}x{self.camera.height})"

    def to(self, dtype: torch.dtype) -> Case:
        return replace(self, field=self.field.to(dtype=dtype), camera=self.camera.to(dtype=dtype))

    def with_leaves(self) -> Case:
        """Return the case with fresh leaf tensors that require gradients."""
        leaves = {name: value.detach().clone().requires_grad_() for name, value in self.field.parameters.items()}
        return replace(self, field=self.field.with_parameters(leaves))

    @property
    def background_tensor(self) -> Tensor:
        return torch.tensor(self.background, dtype=self.field.means.dtype, device=self.field.means.device)

    def render(self, rasterizer: Rasterizer) -> RenderResult:
        return rasterizer(self.field, self.camera, background=self.background_tensor, sh_degree=self.sh_degree)


def pixel_weights(case: Case) -> Tensor:
    """Return (3, h, w) random weights of both signs; their product with an image is a loss without symmetry."""
    generator = torch.Generator().manual_seed(0)
    shape = (3, case.camera.height, case.camera.width)
    return torch.randn(shape, generator=generator, dtype=torch.float64).to(case.field.means)


# ----------------------------------------------------------------------------------------------------- cameras


def make_camera(
    width: int,
    height: int,
    *,
    focal: float | tuple[float, float] | None = None,
    principal_offset: tuple[float, float] = (0.0, 0.0),
    pose_seed: int | None = None,
) -> Camera:
    """Make a camera at the origin that looks along +z, or one with a random pose near it.

    Args:
        width, height: in pixels.
        focal: in pixels, one or (fx, fy); None for 60 degrees across the larger side.
        principal_offset: (x, y) in pixels from the image centre.
        pose_seed: seed of a random rotation of any angle and a translation of about a unit.
    """
    focal = max(width, height) * math.sqrt(3) / 2 if focal is None else focal
    fx, fy = focal if isinstance(focal, tuple) else (focal, focal)
    pose = torch.eye(4, dtype=torch.float64)
    if pose_seed is not None:
        generator = torch.Generator().manual_seed(pose_seed)
        orthogonal, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
        pose[:3, :3] = orthogonal * torch.linalg.det(orthogonal)
        pose[:3, 3] = torch.randn(3, generator=generator, dtype=torch.float64)
    return Camera(width, height, fx, fy, width / 2 + principal_offset[0], height / 2 + principal_offset[1], pose)


def to_world(points: Tensor, camera: Camera) -> Tensor:
    """Transform (n, 3) camera coordinates to world coordinates."""
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    return (points - translation) @ rotation


# ------------------------------------------------------------------------------------------------------ fields


def make_field(
    means: Tensor,
    *,
    scales: Tensor | float = 0.1,
    opacities: Tensor | float = 0.6,
    quaternions: Tensor | None = None,
    sh_degree: int = 0,
    signed: bool = False,
    seed: int = 0,
) -> GaussianField:
    """Make a float64 field at the given means, with random rotations and random SH.

    Args:
        means: (n, 3) world coordinates.
        scales: standard deviations, broadcast to (n, 3).
        opacities: in (0, 1), broadcast to (n,).
        quaternions: (n, 4) wxyz; None for random ones of length 0.3 to 3.
        sh_degree: 0 to 3.
        signed: see `GaussianField`.
        seed: of the rotations and colours.
    """
    n = len(means)
    generator = torch.Generator().manual_seed(seed)
    if quaternions is None:
        quaternions = torch.randn(n, 4, generator=generator, dtype=torch.float64)
        lengths = 0.3 + 2.7 * torch.rand(n, 1, generator=generator, dtype=torch.float64)
        quaternions = torch.nn.functional.normalize(quaternions, dim=-1) * lengths
    scales = torch.as_tensor(scales, dtype=torch.float64).expand(n, 3)
    opacities = torch.as_tensor(opacities, dtype=torch.float64).expand(n)
    sh = 0.4 * torch.randn(n, (sh_degree + 1) ** 2, 3, generator=generator, dtype=torch.float64)
    return GaussianField(means.double(), quaternions, scales.log(), torch.logit(opacities), sh, signed)


def points_in_view(n: int, camera: Camera, *, seed: int, near: float = 1.0) -> Tensor:
    """Return (n, 3) world points, uniform in depth and over the image, which they exceed by a tenth of its sides."""
    generator = torch.Generator().manual_seed(seed)
    u, v, d = torch.rand(3, n, generator=generator, dtype=torch.float64)
    depth = near + (6.0 - near) * d
    x = ((1.2 * u - 0.1) * camera.width - camera.cx) / camera.fx * depth
    y = ((1.2 * v - 0.1) * camera.height - camera.cy) / camera.fy * depth
    return to_world(torch.stack([x, y, depth], dim=-1), camera)


def random_case(
    n: int,
    width: int,
    height: int,
    *,
    seed: int = 0,
    sh_degree: int = 3,
    signed: bool = False,
    background: tuple[float, float, float] = COLORED,
    pixels: tuple[float, float] = (0.5, 4.0),
    camera: Camera | None = None,
    name: str = "random",
) -> Case:
    """Make an ordinary scene: n Gaussians in view, with standard deviations log-uniform between `pixels` on screen."""
    camera = make_camera(width, height, pose_seed=seed) if camera is None else camera
    generator = torch.Generator().manual_seed(seed + 1)
    means = points_in_view(n, camera, seed=seed + 2)
    depth = camera.local(means)[:, 2:]  # (n, 1)
    low, high = math.log(pixels[0]), math.log(pixels[1])
    sizes = torch.exp(low + (high - low) * torch.rand(n, 3, generator=generator, dtype=torch.float64))
    opacities = 0.02 + 0.96 * torch.rand(n, generator=generator, dtype=torch.float64)
    field = make_field(
        means, scales=sizes * depth / camera.fx, opacities=opacities, sh_degree=sh_degree, signed=signed, seed=seed + 3
    )
    return Case(name, field, camera, background)


# ----------------------------------------------------------------------------------- adversarial scenes, by name


def _camera_space(points: Sequence[Sequence[float]]) -> Tensor:
    return torch.tensor(points, dtype=torch.float64).reshape(-1, 3)


def no_gaussians() -> Case:
    """An empty field."""
    return Case("no_gaussians", make_field(torch.zeros(0, 3)), make_camera(20, 17), COLORED)


def one_gaussian() -> Case:
    """One Gaussian of three different scales."""
    camera = make_camera(37, 23, pose_seed=3)
    means = to_world(_camera_space([[0.1, -0.05, 2.0]]), camera)
    return Case("one_gaussian", make_field(means, scales=torch.tensor([[0.3, 0.1, 0.2]]), sh_degree=3), camera, WHITE)


def one_pixel() -> Case:
    """An image of a single pixel."""
    return random_case(40, 1, 1, seed=5, pixels=(0.2, 3.0), name="one_pixel")


def ragged_size() -> Case:
    """No side is a multiple of the tile; the last tiles are one pixel wide and high."""
    return random_case(120, 33, 49, seed=6, name="ragged_size")


def near_plane() -> Case:
    """Centres behind the camera, at it, on both sides of the culling depth 0.2, and huge on screen just past it."""
    camera = make_camera(40, 30)
    depths = [-2.0, -0.2, 0.0, 0.1, 0.2 - 1e-9, 0.2, 0.2 + 1e-9, 0.21, 0.5, 1.0]
    means = _camera_space([[0.02 * i - 0.1, 0.01 * i, z] for i, z in enumerate(depths)])
    scales = torch.tensor([0.01, 0.02, 0.03])
    return Case("near_plane", make_field(means, scales=scales, opacities=0.3, sh_degree=1), camera, COLORED)


def outside_frustum() -> Case:
    """Centres beyond 1.3 tan(fov / 2) on every side, large enough to reach the image: the Jacobian is clamped."""
    camera = make_camera(40, 30)
    means = [[s * 2.2, 0.1, 2.0 + 0.1 * s] for s in (-1, 1)] + [[0.1, s * 1.6, 2.0 + 0.2 * s] for s in (-1, 1)]
    means += [[s * 2.5, s * 2.0, 2.5 + 0.1 * s] for s in (-1, 1)] + [[9.0, 0.0, 2.0], [0.0, -30.0, 1.0]]
    field = make_field(_camera_space(means), scales=torch.tensor([0.9, 0.5, 0.7]), opacities=0.7, sh_degree=2)
    return Case("outside_frustum", field, camera, BLACK)


def saturated() -> Case:
    """Opacities of 0.993 and more stacked in depth: most pixels reach the 0.99 cap and the stop at 1e-4."""
    case = random_case(60, 40, 40, seed=8, sh_degree=1, pixels=(2.0, 9.0), name="saturated")
    logits = torch.linspace(5.0, 10.0, 60, dtype=torch.float64)
    return replace(case, field=case.field.with_parameters({"opacity_logits": logits}))


def crowd() -> Case:
    """Thousands of faint Gaussians over the same few pixels."""
    camera = make_camera(18, 18)
    generator = torch.Generator().manual_seed(9)
    means = torch.randn(3000, 3, generator=generator, dtype=torch.float64) * 0.05 + torch.tensor([0.0, 0.0, 3.0])
    field = make_field(means, scales=torch.tensor([0.2, 0.3, 0.5]), opacities=0.006)
    return Case("crowd", field, camera, WHITE)


def opaque_crowd() -> Case:
    """A thousand half-opaque Gaussians over the same few pixels: blending stops before most of them."""
    camera = make_camera(18, 18)
    generator = torch.Generator().manual_seed(10)
    means = torch.randn(1000, 3, generator=generator, dtype=torch.float64) * 0.2 + torch.tensor([0.0, 0.0, 3.0])
    field = make_field(means, scales=torch.tensor([0.1, 0.2, 0.3]), opacities=0.5, signed=True)
    return Case("opaque_crowd", field, camera, BLACK)


def needles() -> Case:
    """One axis a thousand times as long as the two others, in random directions."""
    camera = make_camera(48, 40)
    scales = torch.tensor([[1.0, 1e-3, 1e-3]], dtype=torch.float64)
    means = points_in_view(24, camera, seed=11, near=2.0)
    return Case("needles", make_field(means, scales=scales.expand(24, 3), sh_degree=1, seed=11), camera, COLORED)


def pancakes() -> Case:
    """Two axes a thousand times as long as the third, in random directions."""
    camera = make_camera(48, 40)
    scales = torch.tensor([[0.5, 0.5, 5e-4]], dtype=torch.float64)
    means = points_in_view(24, camera, seed=12, near=2.0)
    return Case("pancakes", make_field(means, scales=scales.expand(24, 3), sh_degree=1, seed=12), camera, COLORED)


def specks() -> Case:
    """Gaussians a thousandth of a pixel wide, visible only by the 0.3 px^2 added to the covariance."""
    return random_case(200, 40, 40, seed=13, pixels=(1e-4, 1e-3), name="specks")


def giants() -> Case:
    """Gaussians many times as wide as the screen."""
    case = random_case(12, 40, 35, seed=14, pixels=(50.0, 3000.0), name="giants")
    return replace(case, field=case.field.with_parameters({"opacity_logits": case.field.opacity_logits - 2.0}))


def same_depths() -> Case:
    """Groups of Gaussians at exactly the same point with different colours and shapes: only the index orders them."""
    case = random_case(60, 32, 32, seed=15, sh_degree=1, camera=make_camera(32, 32), name="same_depths")
    return replace(case, field=case.field.with_parameters({"means": case.field.means[torch.arange(60) % 12]}))


def same_plane() -> Case:
    """All centres at one exactly representable depth: bitwise ties at different places."""
    case = random_case(60, 32, 32, seed=16, sh_degree=1, camera=make_camera(32, 32), name="same_plane")
    means = torch.cat([case.field.means[:, :2], torch.full((60, 1), 4.0, dtype=torch.float64)], dim=1)
    return replace(case, field=case.field.with_parameters({"means": means}))


def off_centre() -> Case:
    """A principal point far from the image centre."""
    camera = make_camera(45, 38, principal_offset=(17.3, -11.9), pose_seed=17)
    return random_case(80, 45, 38, seed=17, camera=camera, name="off_centre")


def non_square_pixels() -> Case:
    """Focal lengths that differ by a factor of two and a half."""
    camera = make_camera(45, 38, focal=(30.0, 75.0), pose_seed=18)
    return random_case(80, 45, 38, seed=18, camera=camera, name="non_square_pixels")


def wide_angle() -> Case:
    """A field of view of 150 degrees."""
    camera = make_camera(48, 36, focal=24 / math.tan(math.radians(75)), pose_seed=19)
    return random_case(60, 48, 36, seed=19, camera=camera, pixels=(0.3, 2.0), name="wide_angle")


def clamped_colors() -> Case:
    """Half of the channels below 0, where an unsigned field clamps."""
    case = random_case(60, 40, 30, seed=20, sh_degree=2, name="clamped_colors")
    sh = case.field.sh.clone()
    sh[:, 0] -= 1.7
    return replace(case, field=case.field.with_parameters({"sh": sh}))


def signed_residual() -> Case:
    """An ordinary signed field over black."""
    return random_case(80, 40, 30, seed=21, signed=True, background=BLACK, name="signed_residual")


def lower_degree() -> Case:
    """A field of degree 3 rendered at degree 1."""
    return replace(random_case(80, 40, 30, seed=22, name="lower_degree"), sh_degree=1)


def large_quaternions() -> Case:
    """Quaternions of length 1e-4 to 1e4."""
    case = random_case(60, 40, 30, seed=23, sh_degree=1, name="large_quaternions")
    factors = torch.logspace(-4, 4, 60, dtype=torch.float64)[:, None]
    return replace(case, field=case.field.with_parameters({"quaternions": case.field.quaternions * factors}))


def invisible() -> Case:
    """Gaussians that are too faint, behind the camera or off the screen: only the background is visible."""
    camera = make_camera(30, 20)
    means = _camera_space([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0], [50.0, 0.0, 2.0]])
    return Case("invisible", make_field(means, scales=0.05, opacities=0.003), camera, COLORED)


ADVERSARIAL: dict[str, Callable[[], Case]] = {
    builder.__name__: builder
    for builder in (
        no_gaussians, one_gaussian, one_pixel, ragged_size, near_plane, outside_frustum, saturated, crowd,
        opaque_crowd, needles, pancakes, specks, giants, same_depths, same_plane, off_centre, non_square_pixels,
        wide_angle, clamped_colors, signed_residual, lower_degree, large_quaternions, invisible,
    )
}  # fmt: skip
"""Builders by name."""
