"""Density control as a Markov chain (Kheradmand et al. 2024): move Gaussians that have become transparent, add some up
to a limit, and shake positions. Unlike theirs, it moves and adds them where images are wrong, removes transparent
Gaussians of residuals instead of moving them, and bounds the sizes of residuals on large images.

In plain PyTorch, so that a CPU trains with it as well; gsplat has the same steps for CUDA alone.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from gsplat.strategy.ops import remove
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.hierarchy.settings import is_large
from lapgs_plugin.ops.position_noise import add_noise
from lapgs_plugin.ops.position_noise.in_torch import displacements
from lapgs_plugin.reference_raster.layout import JACOBIAN_LIMIT, NEAR_DEPTH
from lapgs_plugin.stages.opacity_weight import COLORLESS
from lapgs_plugin.training.densification import DensityControl, ViewScores, add_gradients
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.schedule import StageSchedule
from lapgs_plugin.training.strategies import USUAL_EXTENT, Mcmc

START_SCALE = 0.1
"""Factor on the sizes of a field that starts from points, as MCMC's authors have it."""
START_OPACITY = 0.5
"""Opacity of a field that starts from points, as MCMC's authors have it."""
DEAD_OPACITY = 0.01
"""Gaussians with at most this opacity are moved. MCMC's authors wait until it is half of that."""
LEAST_OPACITY = 0.005
"""Opacity of copies, at least. Gaussians of a residual that are fainter are removed: these are half of all and more
where a base needs no correction, and as many copies would undo what others have learned since the last refinement."""
STATISTICS_VIEWS = 40
"""Views before each refinement whose gradients say where Gaussians are needed."""
MOST_COPIES = 51
"""Gaussians that one Gaussian becomes at once, at most."""
NOISE = 5e5
"""Noise of positions, in units of their step size and of the Gaussian's covariance."""
NOISE_VIEWS = 8
"""Views after which positions get the noise of all steps since: as many as a step has on a GPU if nothing else is asked
for. After each single view it would take a CPU a fifth of the training time."""
GROWTH = 1.05
"""Least factor on the number of Gaussians each time that some are added: MCMC's."""
GROWTH_OF_STAGE = 350.0
"""Factor by which all additions of a stage let the number grow, so that short stages grow as much as those of a run of
30,000 iterations."""
MOST_GROWTH = 1.5
"""Largest factor each time that some are added."""
SOLID = 0.1
"""Gaussians above this opacity would get less than a ten thousandth of the noise, and on a CPU they get none."""
MOST_SIGMA = 32.0
"""Largest standard deviation, in pixels, of a residual's Gaussians on a large image. The loss has the mean opacity, so
that faint Gaussians grow, and those that cover whole views take time and memory in each of its tiles. Detail that is
so coarse is the base's."""


def mcmc_start(field: GaussianField, scale: float) -> GaussianField:
    """Return a field from points with its sizes times `scale`, half opaque."""
    return field.with_parameters(
        {
            "log_scales": field.log_scales + math.log(scale),
            "opacity_logits": torch.full_like(field.opacity_logits, math.log(START_OPACITY / (1 - START_OPACITY))),
        }
    )


class McmcDensifier(DensityControl):
    """Move and add Gaussians between iterations. Opacities are never reset.

    Args:
        schedule: when the stage adds and moves.
        options: of the stage, with its limit.
        extent: scene extent in world units.
    """

    def __init__(self, schedule: StageSchedule, options: Mcmc, extent: float = USUAL_EXTENT) -> None:
        self._unit = extent / USUAL_EXTENT
        super().__init__(options.opacity_weight, options.scale_weight / self._unit)
        assert options.cap_max is not None, "`Mcmc.of_stage` sets it"
        self._schedule, self._most = schedule, options.cap_max
        # The last iteration with noise, and what has come up since; gradients since statistics began, and their views.
        # A residual's number of Gaussians when the stage began.
        self.state = {"noised": 0, "variance": 0.0, "grad2d": None, "count": None, "start": 0}
        times = (schedule.densify_until - schedule.densify_start) // schedule.densify_every
        self._growth = min(max(GROWTH, GROWTH_OF_STAGE ** (1.0 / max(times, 1))), MOST_GROWTH)

    def needs_statistics(self, iteration: int) -> bool:
        every = self._schedule.densify_every
        due = math.ceil(iteration / every) * every
        return self._schedule.refines(due) and due - iteration < STATISTICS_VIEWS

    def accumulate(self, result: RenderResult, camera: Camera) -> None:
        """Add the gradients by centres of a render, if its rasterizer has any; see `DensityControl`."""
        gradient = result.means2d.grad if result.absgrad2d is None else result.absgrad2d
        if gradient is not None:
            add_gradients(self.state, ("grad2d", "count"), gradient, result, camera)

    @torch.no_grad()
    def after_step(
        self,
        model: TrainableField,
        iteration: int,
        result: RenderResult | None,
        camera: Camera,
        scores: ViewScores | None = None,
    ) -> bool:
        if result is not None:
            self.accumulate(result, camera)
        if refines := self._schedule.refines(iteration):
            if model.signed:
                self._remove_dead(model)
            else:
                self._move_dead(model)
            self._add(model)
            self.state |= {"grad2d": None, "count": None}
        rate = model.optimizers["means"].param_groups[0]["lr"]  # of the step just taken, scaled for its views
        self.state["variance"] += rate**2
        if iteration - self.state["noised"] >= NOISE_VIEWS:
            shake(model, NOISE * math.sqrt(self.state["variance"]) / self._unit**2)
            self.state |= {"noised": iteration, "variance": 0.0}
            if model.signed and is_large(camera.size):
                bound_sizes(model, camera, MOST_SIGMA, NEAR_DEPTH * self._unit)
        return refines

    def opacity_weight(self, model: TrainableField, iteration: int) -> float:
        weight = super().opacity_weight(model, iteration)
        if not model.signed:
            return weight
        count = len(model) / self.share
        self.state["start"] = self.state["start"] or round(count)
        if iteration <= COLORLESS * self._schedule.densify_until:
            return 0.0
        # A mean over fewer Gaussians pulls harder at each: those that removal leaves would follow, to the last one.
        return weight * min(1.0, count / float(self.state["start"]))

    def _move_dead(self, model: TrainableField) -> None:
        opacities = torch.sigmoid(model.params["opacities"])
        dead = opacities <= DEAD_OPACITY
        places = dead.nonzero()[:, 0]
        if 0 < len(places) < len(dead):
            chosen = self.ranks.as_leader(_sample(torch.where(dead, 0.0, self._demand(model)), len(places)))
            model.forget_moments(_share(model, chosen))
            self._share_gradients(places, chosen)
            # What is moved keeps its moments: it was visible a moment ago, and its first steps would be long without.
            model.overwrite(places, chosen)

    def _remove_dead(self, model: TrainableField) -> None:
        opacities = torch.sigmoid(model.params["opacities"])
        faint = opacities < opacities.max().clamp_max(LEAST_OPACITY)  # never all of them
        if faint.any():
            remove(model.params, model.optimizers, self.state, faint)

    def _add(self, model: TrainableField) -> None:
        grown = max(int(self._growth * len(model)), len(model) + 1)  # 5 % of fewer than 20 Gaussians are none
        count = min(self._most, grown) - len(model)
        if count > 0:
            chosen = self.ranks.as_leader(_sample(self._demand(model), count))
            _share(model, chosen)
            model.append(chosen)

    def _demand(self, model: TrainableField) -> Tensor:
        """Return (n,) how much each Gaussian needs others at its place.

        That is its opacity, as MCMC's authors have it, times the mean norm of its gradient on the image, which is large
        where the image is wrong. Where a rasterizer has no such gradients it is the opacity alone.
        """
        opacities = torch.sigmoid(model.params["opacities"])
        norms, counts = self.state["grad2d"], self.state["count"]
        return opacities if norms is None else opacities * norms / counts.clamp_min(1)

    def _share_gradients(self, places: Tensor, chosen: Tensor) -> None:
        """Divide the gradients of Gaussians among them and their copies, which replace those at `places`."""
        norms, counts = self.state["grad2d"], self.state["count"]
        if norms is not None:
            norms /= torch.bincount(chosen, minlength=len(norms)) + 1
            norms[places], counts[places] = norms[chosen], counts[chosen]


def _sample(weights: Tensor, count: int) -> Tensor:
    """Draw `count` rows with replacement, each in proportion to its weight (n,) from 0."""
    sums = weights.double().cumsum(0)  # `torch.multinomial` takes 2^24 weights at most
    drawn = torch.rand(count, dtype=sums.dtype, device=sums.device) * sums[-1]
    return torch.searchsorted(sums, drawn, right=True).clamp_max(len(weights) - 1)


def _share(model: TrainableField, chosen: Tensor) -> Tensor:
    """Give Gaussians the opacity and the size with which they and their copies, one for each time that `chosen` (k,)
    names them, look as they did. Return their rows."""
    opacities, log_scales = model.params["opacities"], model.params["scales"]
    copies = torch.bincount(chosen)
    rows = copies.nonzero()[:, 0]
    shared, factors = copies_of(torch.sigmoid(opacities[rows]), (copies[rows] + 1).clamp_max(MOST_COPIES))
    opacities[rows] = torch.logit(shared.clamp(LEAST_OPACITY, 1.0 - torch.finfo(shared.dtype).eps))
    log_scales[rows] += torch.log(factors)[:, None]
    return rows


def copies_of(opacities: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return opacities and scales of equal Gaussians that together look like one: Kheradmand et al. 2024, equation 9.

    Its double sum is simplified by the sum of binomial coefficients C(i - 1, k) over i, which is C(N, k + 1).

    Args:
        opacities: (n,) of the single Gaussians, between 0 and 1.
        counts: (n,) integers from 1 to `MOST_COPIES`, N for each.

    Returns:
        (n,) opacities of each of the N Gaussians, and (n,) factors on their standard deviations.
    """
    single = opacities.double()  # the sum has alternating signs
    shared = 1.0 - (1.0 - single) ** (1.0 / counts.double())
    order = torch.arange(1, MOST_COPIES + 1, device=opacities.device)
    factors = single / (_coefficients(opacities.device)[counts] * shared[:, None] ** order).sum(1)
    return shared.to(opacities.dtype), factors.to(opacities.dtype)


@lru_cache(maxsize=4)
@torch.inference_mode(False)  # cached for later calls, whatever mode the first one is in
def _coefficients(device: torch.device) -> Tensor:
    """Return (N + 1, N) C(n, m) (-1)^(m - 1) / sqrt(m), m from 1, for up to N = `MOST_COPIES` copies."""
    orders = range(1, MOST_COPIES + 1)
    table = [[math.comb(n, m) * (-1) ** (m - 1) / math.sqrt(m) for m in orders] for n in range(MOST_COPIES + 1)]
    return torch.tensor(table, dtype=torch.float64, device=device)


@torch.no_grad()
def shake(model: TrainableField, amount: float) -> None:
    """Add noise to the positions of faint Gaussians, of the shape of each Gaussian.

    Args:
        model: edited in place.
        amount: factor on the covariance, times which a standard normal vector is added to a transparent Gaussian.
    """
    means, quaternions = model.params["means"], model.params["quats"]
    log_scales, logits = model.params["scales"], model.params["opacities"]
    if means.device.type != "cpu":
        add_noise(means, quaternions, log_scales, logits, amount)
        return
    rows = (torch.sigmoid(logits) < SOLID).nonzero()[:, 0]  # a GPU would wait for their number
    noise = torch.randn(len(rows), 3, dtype=means.dtype)
    means[rows] += displacements(quaternions[rows], log_scales[rows], logits[rows], noise, amount)


@torch.no_grad()
def bound_sizes(model: TrainableField, camera: Camera, most: float, near: float = NEAR_DEPTH) -> None:
    """Shrink the Gaussians that a camera sees to standard deviations of at most `most` pixels of its image.

    Args:
        model: edited in place.
        camera: its longer focal length counts.
        most: above 0.
        near: depth in world units from which on Gaussians are visible.
    """
    means, log_scales = model.params["means"], model.params["scales"]
    x, y, depths = camera.local(means).unbind(1)
    # The rasterizers' limits. Gaussians beyond them would be judged by a camera that they pass by.
    wide, high = (JACOBIAN_LIMIT * tangent for tangent in camera.tan_half_fov)
    seen = (depths > near) & (x.abs() < wide * depths) & (y.abs() < high * depths)
    bounds = torch.where(seen, depths * (most / max(camera.fx, camera.fy)), torch.inf).log()
    torch.minimum(log_scales, bounds[:, None], out=log_scales)
