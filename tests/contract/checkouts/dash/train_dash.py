"""Training with DashGaussian's schedule of sizes and Gaussians."""

from random import randint

import torch
from arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_renderer import network_gui, render
from scene import GaussianModel, Scene
from utils.loss_utils import l1_loss, ssim
from utils.plain_main import LossBar, background_of, parsed, parser_of, prepare_output_and_logger
from utils.schedule_utils import TrainingScheduler


def training(dataset, opt, pipe, testing_iterations, saving_iterations, checkpoint_iterations, checkpoint, debug_from):
    first_iter = 0
    prepare_output_and_logger(dataset)
    gaussians = GaussianModel(dataset.sh_degree, opt.optimizer_type)
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    background = background_of(dataset)
    viewpoint_stack = scene.getTrainCameras().copy()
    scheduler = TrainingScheduler(opt, pipe, gaussians, [cam.original_image for cam in scene.getTrainCameras()])
    render_scale = scheduler.get_res_scale(1)
    progress_bar = LossBar(first_iter, opt.iterations)
    first_iter += 1
    for iteration in range(first_iter, opt.iterations + 1):
        gaussians.update_learning_rate(iteration)
        if iteration % 1000 == 0:
            gaussians.oneupSHdegree()
        if not viewpoint_stack:
            viewpoint_stack = scene.getTrainCameras().copy()
        viewpoint_cam = viewpoint_stack.pop(randint(0, len(viewpoint_stack) - 1))
        gt_image = viewpoint_cam.original_image.cuda()
        if render_scale > 1:
            gt_image = torch.nn.functional.interpolate(
                gt_image[None],
                scale_factor=1 / render_scale,
                mode="bilinear",
                recompute_scale_factor=True,
                antialias=True,
            )[0]
        render_pkg = render(viewpoint_cam, gaussians, pipe, background, render_size=gt_image.shape[-2:])
        image, viewspace_point_tensor = render_pkg["render"], render_pkg["viewspace_points"]
        visibility_filter, radii = render_pkg["visibility_filter"], render_pkg["radii"]
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
                    densify_rate = scheduler.get_densify_rate(iteration, len(gaussians.get_xyz), render_scale)
                    momentum_add = gaussians.prune_and_densify(
                        opt.densify_grad_threshold,
                        0.005,
                        scene.cameras_extent,
                        size_threshold,
                        radii,
                        densify_rate=densify_rate,
                    )
                    scheduler.update_momentum(momentum_add)
                    render_scale = scheduler.get_res_scale(iteration)
                if iteration % opt.opacity_reset_interval == 0:
                    gaussians.reset_opacity()
            if iteration < opt.iterations:
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)


if __name__ == "__main__":
    parser, (lp, op, pp) = parser_of(ModelParams, OptimizationParams, PipelineParams)
    parser.add_argument("--disable_viewer", action="store_true", default=False)
    args = parsed(parser)
    if not args.disable_viewer:
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
    )
    print("\nTraining complete.")
