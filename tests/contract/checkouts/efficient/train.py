"""Training that unlocks SH late, and prunes by the largest shares at fixed iterations."""

from pathlib import Path
from random import randint

import torch
from arguments import ModelParams, OptimizationParams, PipelineParams
from scene import GaussianModel, Scene
from scene.renderer import render
from utils import plain_main
from utils.loss_utils import l1_loss, ssim
from utils.plain_main import LossBar, background_of, parsed, parser_of


def get_sparse_shs_mask(scene, gaussians, pipe, bg, opt):
    with torch.no_grad():
        weights = torch.zeros(len(gaussians._xyz))
        for cam in scene.getTrainCameras():
            pix_loss = torch.abs(render(cam, gaussians, pipe, bg)["render"] - cam.get_original_image().cuda())
            weights += render(cam, gaussians, pipe, bg, pix_loss=pix_loss)["loss_weight"]
        return weights >= weights.sort(descending=True).values[int(len(weights) * opt.sparse_rate)]


def training(
    dataset,
    opt,
    pipe,
    testing_iterations,
    saving_iterations,
    checkpoint_iterations,
    checkpoint,
    debug_from,
    no_gui,
    load_from_h5,
):
    first_iter = 0
    prepare_output_and_logger(dataset)
    gaussians = GaussianModel(dataset.sh_degree if opt.oneupSHdegree_from_iter == 0 else 0)
    scene = Scene(dataset, gaussians, shuffle=True)
    gaussians.training_setup(opt)
    background = background_of(dataset)
    viewpoint_stack = None
    progress_bar = LossBar(first_iter, opt.iterations)
    first_iter += 1
    sparse_cnt = opt.sparse_cnt
    for iteration in range(first_iter, opt.iterations + 1):
        gaussians.update_learning_rate(iteration)
        if opt.oneupSHdegree_from_iter > 0 and iteration == opt.oneupSHdegree_from_iter:
            gaussians.set_shs_memory(dataset.sh_degree)
            if opt.use_sparse_shs:
                gaussians.sparse_shs_degree = torch.zeros(len(gaussians._xyz), dtype=torch.int32).cuda()
        if iteration % opt.oneupSHdegree_interval == 0 and iteration >= opt.oneupSHdegree_from_iter:
            if opt.use_sparse_shs and sparse_cnt > 0:
                sparse_cnt -= 1
                gaussians.sparse_shs_degree[get_sparse_shs_mask(scene, gaussians, pipe, background, opt)] += 1
            gaussians.oneupSHdegree()
        if not viewpoint_stack:
            viewpoint_stack = scene.getTrainCameras().copy()
        viewpoint_cam = viewpoint_stack.pop(randint(0, len(viewpoint_stack) - 1))
        gt_image = viewpoint_cam.get_original_image().cuda()
        render_pkg = render(viewpoint_cam, gaussians, pipe, background)
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
                    gaussians.densify_and_prune(opt.densify_grad_threshold, 0.005, scene.cameras_extent, size_threshold)
            if opt.prune_by_max_weight and opt.prune_way == "p4" and iteration in [15000, 18000, 21000]:
                largest = torch.zeros(len(gaussians._xyz), dtype=torch.int32)
                for cam in scene.getTrainCameras():
                    largest += render(cam, gaussians, pipe, background, top_k=opt.top_k)["max_weight_pids"]
                gaussians.prune_points(largest < 1)
            if iteration < opt.iterations:
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)


def prepare_output_and_logger(args):
    assert args.ignore_check_output or not Path(args.model_path).exists(), "exists"
    plain_main.prepare_output_and_logger(args)


if __name__ == "__main__":
    parser, (lp, op, pp) = parser_of(ModelParams, OptimizationParams, PipelineParams)
    args = parsed(parser)
    training(
        lp.extract(args),
        op.extract(args),
        pp.extract(args),
        args.test_iterations,
        args.save_iterations,
        args.checkpoint_iterations,
        args.start_checkpoint,
        args.debug_from,
        args.no_gui,
        args.load_from_h5,
    )
    print("\nTraining complete.")
