"""Training that replaces the Gaussians by points at their depths, and draws some of them by their shares."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))

from random import randint

import numpy as np
import torch
from arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_renderer import network_gui, render_depth, render_imp
from scene import GaussianModel, Scene
from utils.loss_utils import l1_loss, ssim
from utils.plain_main import LossBar, background_of, parsed, parser_of, prepare_output_and_logger
from utils.sh_utils import SH2RGB


def training(  # noqa: PLR0912, PLR0915 - one long function, as in the code that this stands for
    dataset,
    opt,
    pipe,
    testing_iterations,
    saving_iterations,
    checkpoint_iterations,
    checkpoint,
    debug_from,
    args,
):
    first_iter = 0
    prepare_output_and_logger(dataset)
    gaussians = GaussianModel(sh_degree=0)
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    background = background_of(dataset)
    viewpoint_stack = None
    progress_bar = LossBar(first_iter, opt.iterations)
    first_iter += 1
    for iteration in range(first_iter, opt.iterations + 1):
        simp_iteration1 = args.simp_iteration1
        if iteration < simp_iteration1:
            gaussians.update_learning_rate(iteration)
        else:
            gaussians.update_learning_rate(iteration - simp_iteration1 + 5000)
        if iteration % 1000 == 0 and iteration > simp_iteration1:
            gaussians.oneupSHdegree()
        if not viewpoint_stack:
            viewpoint_stack = scene.getTrainCameras().copy()
        viewpoint_cam = viewpoint_stack.pop(randint(0, len(viewpoint_stack) - 1))
        render_pkg = render_imp(viewpoint_cam, gaussians, pipe, background)
        image, viewspace_point_tensor = render_pkg["render"], render_pkg["viewspace_points"]
        visibility_filter, radii = render_pkg["visibility_filter"], render_pkg["radii"]
        gt_image = viewpoint_cam.original_image.cuda()
        loss = (1.0 - opt.lambda_dssim) * l1_loss(image, gt_image) + opt.lambda_dssim * (1.0 - ssim(image, gt_image))
        loss.backward()
        with torch.no_grad():
            progress_bar.note(iteration, loss)
            if iteration in saving_iterations:
                scene.save(iteration)
            if iteration < opt.densify_until_iter:
                gaussians.max_radii2D[visibility_filter] = torch.max(
                    gaussians.max_radii2D[visibility_filter], radii[visibility_filter]
                )
                gaussians.add_densification_stats(viewspace_point_tensor, visibility_filter)
                small = len(gaussians._xyz) < args.num_max
                at = iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0
                if at and iteration % 5000 != 0 and small:
                    size_threshold = 20 if iteration > opt.opacity_reset_interval else None
                    gaussians.densify_and_prune_split(
                        opt.densify_grad_threshold, 0.005, scene.cameras_extent, size_threshold, None
                    )
                if iteration % 5000 == 0:
                    found, colors = [], []
                    for view in scene.getTrainCameras():
                        package = render_depth(view, gaussians, pipe, background)
                        share = (1 - package["accum_alpha"]).reshape(-1).cpu().numpy()
                        count = args.num_depth // len(scene.getTrainCameras())
                        drawn = np.random.choice(len(share), size=count, p=share / share.sum(), replace=False)
                        found.append(package["out_pts"].permute(1, 2, 0).reshape(-1, 3)[drawn])
                        colors.append(view.original_image[0:3].permute(1, 2, 0).reshape(-1, 3)[drawn])
                    gaussians.reinitial_pts(torch.cat(found), torch.cat(colors))
                    gaussians.training_setup(opt)
                    viewpoint_stack = scene.getTrainCameras().copy()
            if iteration == simp_iteration1:
                score = shares(scene, gaussians, pipe, background).cpu().numpy().astype(np.float64)
                count = int(len(score) * args.sampling_factor * (score != 0).mean())
                kept = np.random.choice(len(score), size=count, p=score / score.sum(), replace=False)
                mask = torch.ones(len(score), dtype=torch.bool)
                mask[kept] = False
                gaussians.prune_points(mask)
                gaussians.max_sh_degree = dataset.sh_degree
                gaussians.reinitial_pts(gaussians._xyz, SH2RGB(gaussians._features_dc + 0)[:, 0])
                gaussians.training_setup(opt)
                viewpoint_stack = scene.getTrainCameras().copy()
            if iteration == args.simp_iteration2:
                score = shares(scene, gaussians, pipe, background)
                gaussians.prune_points(score <= score.quantile(0.01))
                gaussians.training_setup(opt)
            if iteration < opt.iterations:
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)


def shares(scene, gaussians, pipe, background):
    score = torch.zeros(len(gaussians._xyz)).cuda()
    for view in scene.getTrainCameras():
        score += render_imp(view, gaussians, pipe, background)["accum_weights"]
    return score


if __name__ == "__main__":
    parser, (lp, op, pp) = parser_of(ModelParams, OptimizationParams, PipelineParams)
    parser.add_argument("--simp_iteration1", type=int, default=15_000)
    parser.add_argument("--simp_iteration2", type=int, default=20_000)
    parser.add_argument("--num_depth", type=int, default=3_500_000)
    parser.add_argument("--num_max", type=int, default=4_500_000)
    parser.add_argument("--sampling_factor", type=float, default=0.5)
    parser.add_argument("--imp_metric", required=True, type=str, default=None)
    args = parsed(parser)
    network_gui.init(args.ip, args.port)
    training(
        lp.extract(args),
        op.extract(args),
        pp.extract(args),
        args.test_iterations,
        args.save_iterations,
        args.checkpoint_iterations,
        args.start_checkpoint,
        args.debug_from,
        args,
    )
    print("\nTraining complete.")
