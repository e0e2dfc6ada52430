"""What the three GaussianModels have in common: parameters, files, and the surgery when their number changes."""

from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement
from torch import nn
from utils.general_utils import build_rotation, get_expon_lr_func, inverse_sigmoid

ATTRIBUTES = {
    "xyz": "_xyz",
    "f_dc": "_features_dc",
    "f_rest": "_features_rest",
    "opacity": "_opacity",
    "scaling": "_scaling",
    "rotation": "_rotation",
}
"""Names of the optimizers' groups, and the attributes that hold their parameters."""


class GaussianBase:
    statistics = ("xyz_gradient_accum", "denom")

    def __init_subclass__(cls):
        # The real classes have no base: whoever looks into one finds everything in its own namespace.
        for name, value in vars(GaussianBase).items():
            if not name.startswith("__") and name not in vars(cls):
                setattr(cls, name, value)

    # There is no tmp_radii before the first densification, and prune_points needs it.
    def __init__(self, sh_degree, optimizer_type="default"):
        self.active_sh_degree = 0
        self.optimizer_type = optimizer_type
        self.max_sh_degree = sh_degree
        for attribute in (*ATTRIBUTES.values(), *self.statistics, "max_radii2D"):
            setattr(self, attribute, torch.empty(0))
        self.optimizer = None
        self.percent_dense = 0
        self.spatial_lr_scale = 0
        self.setup_functions()

    def setup_functions(self):
        self.scaling_activation = torch.exp
        self.scaling_inverse_activation = torch.log
        self.opacity_activation = torch.sigmoid
        self.inverse_opacity_activation = inverse_sigmoid
        self.rotation_activation = nn.functional.normalize

    @property
    def get_scaling(self):
        return self.scaling_activation(self._scaling)

    @property
    def get_rotation(self):
        return self.rotation_activation(self._rotation)

    @property
    def get_xyz(self):
        return self._xyz

    @property
    def get_features(self):
        return torch.cat((self._features_dc, self._features_rest), dim=1)

    @property
    def get_features_dc(self):
        return self._features_dc

    @property
    def get_features_rest(self):
        return self._features_rest

    @property
    def get_opacity(self):
        return self.opacity_activation(self._opacity)

    def oneupSHdegree(self):
        self.active_sh_degree = min(self.active_sh_degree + 1, self.max_sh_degree)

    def _start(self, points, features_dc, dist2):
        """Fresh Gaussians: (n, 3) positions, (n, 3) first SH coefficients, (n,) squared sizes."""
        rots = torch.zeros((len(points), 4), device="cuda")
        rots[:, 0] = 1
        opacities = 0.1 * torch.ones((len(points), 1), dtype=torch.float, device="cuda")
        tensors = {
            "xyz": points,
            "f_dc": features_dc[:, None],
            "f_rest": torch.zeros((len(points), (self.max_sh_degree + 1) ** 2 - 1, 3), device="cuda"),
            "opacity": self.inverse_opacity_activation(opacities),
            "scaling": torch.log(torch.sqrt(dist2))[:, None].repeat(1, 3),
            "rotation": rots,
        }
        self._adopt({name: nn.Parameter(tensor.requires_grad_(True)) for name, tensor in tensors.items()})
        self.max_radii2D = torch.zeros(len(points), device="cuda")

    def _adopt(self, tensors):
        for name, tensor in tensors.items():
            setattr(self, ATTRIBUTES[name], tensor)

    def _forget_statistics(self):
        for name in self.statistics:
            setattr(self, name, torch.zeros((len(self._xyz), 1), device="cuda"))

    def _groups(self, rates):
        """Parameter groups by name, and the schedule of the positions."""
        return [{"params": [getattr(self, ATTRIBUTES[name])], "lr": rate, "name": name} for name, rate in rates.items()]

    def _schedule_positions(self, training_args):
        self.xyz_scheduler_args = get_expon_lr_func(
            lr_init=training_args.position_lr_init * self.spatial_lr_scale,
            lr_final=training_args.position_lr_final * self.spatial_lr_scale,
            lr_delay_mult=training_args.position_lr_delay_mult,
            max_steps=training_args.position_lr_max_steps,
        )

    def update_learning_rate(self, iteration):
        for group in self.optimizer.param_groups:
            if group["name"] == "xyz":
                group["lr"] = self.xyz_scheduler_args(iteration)
                return group["lr"]
        return None

    def _optimizers(self):
        found = (self.optimizer, getattr(self, "shoptimizer", None))
        return [optimizer for optimizer in found if optimizer is not None]

    def capture(self):
        return (
            self.active_sh_degree,
            *(getattr(self, attribute) for attribute in ATTRIBUTES.values()),
            self.max_radii2D,
            *(getattr(self, name) for name in self.statistics),
            *(optimizer.state_dict() for optimizer in self._optimizers()),
            self.spatial_lr_scale,
        )

    def restore(self, model_args, training_args):
        values = iter(model_args)
        self.active_sh_degree = next(values)
        self._adopt({name: next(values) for name in ATTRIBUTES})
        self.max_radii2D = next(values)
        statistics = {name: next(values) for name in self.statistics}
        *states, self.spatial_lr_scale = values
        self.training_setup(training_args)
        vars(self).update(statistics)
        for optimizer, state in zip(self._optimizers(), states, strict=True):
            optimizer.load_state_dict(state)

    def save_ply(self, path):
        rest = 3 * self._features_rest.shape[1]
        names = [
            "x",
            "y",
            "z",
            "nx",
            "ny",
            "nz",
            *(f"f_dc_{i}" for i in range(3)),
            *(f"f_rest_{i}" for i in range(rest)),
        ]
        names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
        features = [part.transpose(1, 2).flatten(1) for part in (self._features_dc, self._features_rest)]
        columns = (self._xyz, torch.zeros_like(self._xyz), *features, self._opacity, self._scaling, self._rotation)
        table = torch.cat(columns, dim=1).detach().cpu().numpy()
        vertices = np.empty(len(table), dtype=[(name, "f4") for name in names])
        for name, column in zip(names, table.T, strict=True):
            vertices[name] = column
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        PlyData([PlyElement.describe(vertices, "vertex")]).write(str(path))

    def reset_opacity(self):
        opacities_new = self.inverse_opacity_activation(self.get_opacity.clamp(max=0.01))
        self._adopt(self.replace_tensor_to_optimizer(opacities_new, "opacity"))

    def replace_tensor_to_optimizer(self, tensor, name):
        """A parameter with other values, its moments zero; the optimizer must have stepped before."""
        for group in self.optimizer.param_groups:
            if group["name"] == name:
                state = self.optimizer.state.pop(group["params"][0])
                state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(tensor), torch.zeros_like(tensor)
                group["params"][0] = nn.Parameter(tensor.requires_grad_(True))
                self.optimizer.state[group["params"][0]] = state
                return {name: group["params"][0]}
        return {}

    def _change_rows(self, change):
        """Put every parameter and its moments through `change(name, tensor, is_moment)`; the parameters by name."""
        optimizable_tensors = {}
        for optimizer in self._optimizers():
            for group in optimizer.param_groups:
                name = group["name"]
                state = optimizer.state.pop(group["params"][0], None)
                group["params"][0] = nn.Parameter(change(name, group["params"][0], False).requires_grad_(True))
                if state is not None:
                    state["exp_avg"] = change(name, state["exp_avg"], True)
                    state["exp_avg_sq"] = change(name, state["exp_avg_sq"], True)
                    optimizer.state[group["params"][0]] = state
                optimizable_tensors[name] = group["params"][0]
        return optimizable_tensors

    def _prune_optimizer(self, mask):
        return self._change_rows(lambda name, tensor, is_moment: tensor[mask])

    def cat_tensors_to_optimizer(self, tensors_dict):
        def extend(name, tensor, is_moment):
            extension = tensors_dict[name]
            return torch.cat((tensor, torch.zeros_like(extension) if is_moment else extension), dim=0)

        return self._change_rows(extend)

    def prune_points(self, mask):
        valid_points_mask = ~mask
        self._adopt(self._prune_optimizer(valid_points_mask))
        for name in (*self.statistics, "max_radii2D"):
            setattr(self, name, getattr(self, name)[valid_points_mask])
        if self.tmp_radii is not None:
            self.tmp_radii = self.tmp_radii[valid_points_mask]

    def densification_postfix(
        self, new_xyz, new_features_dc, new_features_rest, new_opacities, new_scaling, new_rotation, new_tmp_radii
    ):
        new = (new_xyz, new_features_dc, new_features_rest, new_opacities, new_scaling, new_rotation)
        self._adopt(self.cat_tensors_to_optimizer(dict(zip(ATTRIBUTES, new, strict=True))))
        self.tmp_radii = torch.cat((self.tmp_radii, new_tmp_radii))
        self._forget_statistics()
        self.max_radii2D = torch.zeros(len(self._xyz), device="cuda")

    def _clone(self, mask):
        copies = [getattr(self, attribute)[mask] for attribute in ATTRIBUTES.values()]
        self.densification_postfix(*copies, self.tmp_radii[mask])

    def _split(self, mask, N):
        """Replace the masked Gaussians by N smaller ones each, drawn from them; `mask` may be of fewer Gaussians."""
        mask = torch.cat((mask, mask.new_zeros(len(self._xyz) - len(mask))))
        xyz, *others = (getattr(self, attribute)[mask] for attribute in ATTRIBUTES.values())
        stds = self.get_scaling[mask].repeat(N, 1)
        features_dc, features_rest, opacity, _, rotation = (
            tensor.repeat(N, *[1] * (tensor.ndim - 1)) for tensor in others
        )
        offsets = build_rotation(rotation) @ torch.normal(torch.zeros_like(stds), stds)[..., None]
        scaling = self.scaling_inverse_activation(stds / (0.8 * N))
        new = (xyz.repeat(N, 1) + offsets[..., 0], features_dc, features_rest, opacity, scaling, rotation)
        self.densification_postfix(*new, self.tmp_radii[mask].repeat(N))
        self.prune_points(torch.cat((mask, mask.new_zeros(N * int(mask.sum())))))

    def _useless(self, min_opacity, extent, max_screen_size):
        """(n,) bool: nearly transparent, or, given a screen size, too large."""
        prune_mask = (self.get_opacity < min_opacity)[:, 0]
        if max_screen_size:
            prune_mask = prune_mask | (self.max_radii2D > max_screen_size)
            prune_mask = prune_mask | (self.get_scaling.max(dim=1).values > 0.1 * extent)
        return prune_mask

    def _prune_half(self, prune_mask, scores):
        """Draw half as many Gaussians as are masked, by their scores, and prune those drawn that are masked."""
        remove_budget = int(0.5 * prune_mask.sum())
        if remove_budget:
            weights = torch.zeros(len(self._xyz), device="cuda")
            weights[: len(scores)] = 1 / (1e-6 + scores)
            drawn = torch.zeros_like(prune_mask)
            drawn[torch.multinomial(weights, remove_budget, replacement=False)] = True
            self.prune_points(prune_mask & drawn)

    def add_densification_stats(self, viewspace_point_tensor, update_filter):
        self.xyz_gradient_accum[update_filter] += torch.norm(
            viewspace_point_tensor.grad[update_filter, :2], dim=-1, keepdim=True
        )
        self.denom[update_filter] += 1
