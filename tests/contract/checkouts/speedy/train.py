"""Training with pruning by scores: softly while it densifies, harder afterwards."""

from random import randint

import torch
from arguments import ModelParams, OptimizationParams, PipelineParams
from compute_scene_metrics import scene_metrics
from gaussian_renderer import network_gui, render
from scene import GaussianModel, Scene
from utils.loss_utils import l1_loss, ssim
from utils.plain_main import LossBar, background_of, parsed, parser_of, prepare_output_and_logger


def score_func(view, gaussians, pipeline, background, scores):
    img_scores = torch.zeros_like(scores)
    img_scores.requires_grad = True
    image = render(view, gaussians, pipeline, background, scores=img_scores)["render"]
    image.sum().backward()
    scores += img_scores.grad


def prune(scene, gaussians, pipe, background, prune_ratio):
    iter_start, iter_end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    iter_start.record()
    with torch.enable_grad():
        scores = torch.zeros_like(gaussians.get_opacity)
        for view in scene.getTrainCameras():
            score_func(view, gaussians, pipe, background, scores)
    gaussians.prune_gaussians(prune_ratio, scores)
    iter_end.record()
    return iter_start.elapsed_time(iter_end)


def training(
    dataset,
    opt,
    pipe,
    testing_iterations,
    visualize_iterations,
    saving_iterations,
    checkpoint_iterations,
    checkpoint,
    debug_from,
):
    first_iter = 0
    prepare_output_and_logger(dataset)
    gaussians = GaussianModel(dataset.sh_degree)
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    background = background_of(dataset)
    viewpoint_stack = None
    progress_bar = LossBar(first_iter, opt.iterations)
    first_iter += 1
    for iteration in range(first_iter, opt.iterations + 1):
        gaussians.update_learning_rate(iteration)
        if iteration % 1000 == 0:
            gaussians.oneupSHdegree()
        if not viewpoint_stack:
            viewpoint_stack = scene.getTrainCameras().copy()
        viewpoint_cam = viewpoint_stack.pop(randint(0, len(viewpoint_stack) - 1))
        render_pkg = render(viewpoint_cam, gaussians, pipe, background)
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
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    size_threshold = 20 if iteration > opt.opacity_reset_interval else None
                    gaussians.densify_and_prune(opt.densify_grad_threshold, 0.005, scene.cameras_extent, size_threshold)
                if (
                    (iteration >= opt.prune_from_iter)
                    and (iteration < opt.prune_until_iter)
                    and (iteration % opt.prune_interval == 0)
                ):
                    prune(scene, gaussians, pipe, background, opt.densify_prune_ratio)
                if iteration % opt.opacity_reset_interval == 0:
                    gaussians.reset_opacity()
            if iteration < opt.iterations:
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
            if (
                (iteration >= opt.densify_until_iter)
                and (iteration >= opt.prune_from_iter)
                and (iteration < opt.prune_until_iter)
                and (iteration % opt.prune_interval == 0)
            ):
                prune(scene, gaussians, pipe, background, opt.after_densify_prune_ratio)
            if iteration in testing_iterations:
                scene_metrics(iteration, "test", scene.getTestCameras(), scene, render, (pipe, background))


if __name__ == "__main__":
    parser, (lp, op, pp) = parser_of(ModelParams, OptimizationParams, PipelineParams)
    parser.add_argument("--visualize_iterations", nargs="+", type=int, default=[7_000, 30_000])
    args = parsed(parser)
    network_gui.init(args.ip, args.port)
    training(
        lp.extract(args),
        op.extract(args),
        pp.extract(args),
        args.test_iterations,
        args.visualize_iterations,
        args.save_iterations,
        args.checkpoint_iterations,
        args.start_checkpoint,
        args.debug_from,
    )
    print("\nTraining complete.")
