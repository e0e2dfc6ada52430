"""Render fields whose Gaussians are divided over ranks, with any rasterizer.

All ranks make each call together, each with its own Gaussians and its own camera. A rank sends every other one
the Gaussians that the other's camera may see, 14 numbers each: their colours are evaluated before, so that SH stay
where they are. Each rank renders what it received. Gradients go back the way that the Gaussians came.

A rank never has more than its share of the field and what its view sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, RenderResult, Semantics, degree_to_evaluate
from lapgs_plugin.fields.spherical_harmonics import SH_C0, sh_basis
from lapgs_plugin.training.ranks.group import Ranks

COLUMNS = (3, 4, 3, 1, 3)
"""Numbers of a Gaussian that is sent: centre, quaternion, logarithms of sizes, logit of the opacity, colour."""
SIGMAS = 3.4
"""Standard deviations beyond which no Gaussian reaches an opacity of 1/255: 3.33."""
BLUR = 1.0
"""Variance in px^2 that is added to the bound of a Gaussian's size on the image: more than any rasterizer adds."""
MARGIN = 16.0
"""Pixels around an image in which Gaussians count as visible: rasterizers cull by tiles."""


@dataclass
class _Delivery:
    """Hold which Gaussians went where in a render, and what comes back for them.

    Attributes:
        ranks: that exchange them.
        rows, views: (m,) own Gaussians that were sent, and to which rank's view.
        sent, received: numbers of Gaussians to, and from, each rank.
        sizes: of the images of all ranks.
        screen: centres of the render here, whose gradients come back, and the buffer of absolute ones, if any; empty if
            only its image counts.
        gradients: (ranks, n, 2) buffers for gradients by centres, and absolute ones, of own Gaussians in each view.
    """

    ranks: Ranks
    rows: Tensor
    views: Tensor
    sent: Sequence[int]
    received: Sequence[int]
    sizes: Sequence[tuple[int, int]]
    screen: list[Tensor] = field(default_factory=list)
    gradients: list[Tensor] = field(default_factory=list)

    def deliver(self, values: Tensor) -> Tensor:
        """Return the rows (r, c) that this rank's view gets, of those (m, c) that are sent."""
        return self.ranks.exchange(values, self.sent, self.received)

    def send_back(self, values: Tensor) -> Tensor:
        """Return the rows (m, c) of own Gaussians, given those (r, c) of the Gaussians that were received."""
        return self.ranks.exchange(values, self.received, self.sent)

    def spread(self, values: Tensor, count: int) -> Tensor:
        """Return values (m, ...) of own Gaussians in views as (ranks, count, ...), zeros where they were not sent."""
        whole = values.new_zeros(self.ranks.size, count, *values.shape[1:])
        whole[self.views, self.rows] = values
        return whole


class ShardedRasterizer(Rasterizer):
    """Render a field whose Gaussians are divided over ranks.

    `RenderResult` of a call is of the rank's own n Gaussians in the views of all ranks: radii and gradients by centres
    have a leading dimension of the ranks, and gradients are those of views as large as the rank's own. Centres are
    left zero.

    Args:
        rasterizer: renders what a view sees.
        ranks: that make every call together.
    """

    def __init__(self, rasterizer: Rasterizer, ranks: Ranks) -> None:
        self._inner, self._ranks = rasterizer, ranks
        self.name, self.devices = rasterizer.name, rasterizer.devices

    @property
    def semantics(self) -> Semantics:
        return self._inner.semantics

    def __call__(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> RenderResult:
        seen, delivery = self._seen(field, camera, sh_degree)
        result = self._inner(seen, camera, background=background, sh_degree=0)
        radii = delivery.spread(delivery.send_back(result.radii[:, None])[:, 0], len(field))
        differentiable = seen.means.requires_grad
        means2d = field.means.new_zeros(*radii.shape, 2, requires_grad=differentiable)
        absgrad2d = None
        if differentiable:
            means2d.grad = torch.zeros_like(means2d)
            delivery.screen, delivery.gradients = [result.means2d], [means2d.grad]
            if result.absgrad2d is not None:
                absgrad2d = torch.zeros_like(means2d)
                delivery.screen.append(result.absgrad2d)
                delivery.gradients.append(absgrad2d)
        return RenderResult(_connected(result.image, seen), result.transmittance, radii, means2d, absgrad2d)

    def render_image(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> Tensor:
        seen, _ = self._seen(field, camera, sh_degree)
        return _connected(self._inner.render_image(seen, camera, background=background, sh_degree=0), seen)

    def _seen(self, field: GaussianField, camera: Camera, sh_degree: int | None) -> tuple[GaussianField, _Delivery]:
        """Return the Gaussians of all ranks that a camera may see, with their colours from there."""
        cameras = self._ranks.gathered(camera)
        numbers, rows = torch.stack([may_see(view, field) for view in cameras]).nonzero().unbind(1)
        counts, one_each = torch.bincount(numbers, minlength=len(cameras)), [1] * len(cameras)
        # Both in one transfer, for which the processor waits.
        sent, received = torch.stack([counts, self._ranks.exchange(counts, one_each, one_each)]).tolist()
        delivery = _Delivery(self._ranks, rows, numbers, sent, received, [view.size for view in cameras])
        own = [field.means, field.quaternions, field.log_scales, field.opacity_logits[:, None]]
        means, *shape = (values.index_select(0, rows) for values in own)
        sights = _Sights(rows, sent, [view.position for view in cameras], degree_to_evaluate(field, sh_degree))
        colors: Tensor = _Colors.apply(field.sh, means, sights)  # type: ignore[no-untyped-call]  # torch's
        colors = colors if field.signed else (colors + 0.5).clamp(min=0)
        packed = torch.cat([means, *shape, colors / SH_C0], 1)
        arrived: Tensor = _Exchange.apply(packed, delivery)  # type: ignore[no-untyped-call]  # torch's
        means, quaternions, log_scales, logits, sh = (part.contiguous() for part in torch.split(arrived, [*COLUMNS], 1))
        return GaussianField(means, quaternions, log_scales, logits[:, 0], sh[:, None], signed=True), delivery


class _Exchange(torch.autograd.Function):
    """Map the numbers of own Gaussians that are sent, (m, 14), to those of the Gaussians that arrive, (r, 14)."""

    @staticmethod
    def forward(ctx: Any, packed: Tensor, delivery: _Delivery) -> Tensor:
        ctx.delivery = delivery
        return delivery.deliver(packed)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_arrived: Tensor) -> tuple[Tensor, None]:
        delivery: _Delivery = ctx.delivery
        returned, width = [by_arrived], sum(COLUMNS)
        if delivery.screen:
            centres, *absolute = delivery.screen
            if centres.grad is None:  # otherwise it is there: a render's own node comes before this one
                raise UserInputError(
                    "--shard: this rasterizer leaves RenderResult.means2d.grad empty, which ranks exchange; choose "
                    "another --rasterizer, or leave --shard out"
                )
            returned += [centres.grad, *absolute]
        back = delivery.send_back(torch.cat(returned, 1))
        parts = torch.split(back[:, width:], 2, 1) if delivery.screen else ()
        for buffer, values in zip(delivery.gradients, parts, strict=True):
            sizes = torch.tensor(delivery.sizes, dtype=values.dtype)
            factors = (sizes / sizes[delivery.ranks.rank]).to(values.device)
            buffer[delivery.views, delivery.rows] = values * factors[delivery.views]
        delivery.screen.clear()
        return back[:, :width], None


def _connected(image: Tensor, seen: GaussianField) -> Tensor:
    """Return an image whose backward pass reaches the exchange of Gaussians, also if it shows none."""
    return image if len(seen) else image + seen.means.sum()


@dataclass(frozen=True)
class _Sights:
    """Hold which Gaussians are sent to which cameras.

    Attributes:
        rows: (m,) of the field, those of each camera in turn.
        counts, positions: number of rows, and position (3,), of each camera.
        degree: highest SH degree to evaluate.
    """

    rows: Tensor
    counts: list[int]
    positions: Sequence[Tensor]
    degree: int

    def values(self, sh: Tensor, means: Tensor, view: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return the SH and centres of a view's Gaussians as new leaves, and their values (k, 3)."""
        rows, own = torch.split(self.rows, self.counts)[view], torch.split(means, self.counts)[view]
        coefficients = sh[:, : (self.degree + 1) ** 2].index_select(0, rows).requires_grad_()
        centres = own.detach().requires_grad_()
        directions = torch.nn.functional.normalize(centres - self.positions[view].to(centres), dim=1)
        return coefficients, centres, (sh_basis(directions, self.degree)[:, :, None] * coefficients).sum(1)


class _Colors(torch.autograd.Function):
    """Map the SH of a field, (n, k, 3), and centres (m, 3) of the Gaussians that are sent to SH values (m, 3).

    One view's are evaluated after the other, and again in the backward pass: SH of all would take as much memory as the
    field.
    """

    @staticmethod
    def forward(ctx: Any, sh: Tensor, means: Tensor, sights: _Sights) -> Tensor:
        ctx.save_for_backward(sh, means)
        ctx.sights = sights
        return torch.cat([sights.values(sh, means, view)[2] for view in range(len(sights.counts))])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_values: Tensor) -> tuple[Tensor, Tensor, None]:
        sights: _Sights = ctx.sights
        sh, means = ctx.saved_tensors
        by_sh, by_means = torch.zeros_like(sh), []
        for view, by_view in enumerate(torch.split(by_values, sights.counts)):
            with torch.enable_grad():
                coefficients, centres, values = sights.values(sh, means, view)
            by_coefficients, by_centres = torch.autograd.grad(
                values, (coefficients, centres), by_view, materialize_grads=True
            )
            rows = torch.split(sights.rows, sights.counts)[view]
            by_sh[:, : coefficients.shape[1]].index_add_(0, rows, by_coefficients)
            by_means.append(by_centres)
        return by_sh, torch.cat(by_means), None


@torch.no_grad()
def may_see(camera: Camera, field: GaussianField) -> Tensor:
    """Return a mask (n,) of all Gaussians that a rasterizer may blend into a camera's image, and some more.

    A Gaussian's size on the image is bounded by its largest axis and the norm of the projection's Jacobian.
    """
    x, y, depth = camera.local(field.means).unbind(1)
    x, y = x / depth, y / depth
    stretch = camera.fx**2 * (1 + x * x) + camera.fy**2 * (1 + y * y)
    largest = field.log_scales.amax(1).exp() / depth
    reach = SIGMAS * (largest * largest * stretch + BLUR).sqrt() + MARGIN
    x, y = camera.fx * x + camera.cx, camera.fy * y + camera.cy
    inside = (x > -reach) & (x < camera.width + reach) & (y > -reach) & (y < camera.height + reach)
    return inside & (depth > 0)
