"""Training: the loop, its output folder and its report."""

import os
import uuid
from argparse import Namespace
from pathlib import Path
from random import randint

import torch
from arguments import ModelParams, OptimizationParams, PipelineParams
from fused_ssim import fused_ssim as fast_ssim
from gaussian_renderer import network_gui_ws, render_fastgs
from scene import GaussianModel, Scene
from tqdm import tqdm
from utils.fast_utils import compute_gaussian_score_fastgs, sampling_cameras
from utils.image_utils import psnr
from utils.loss_utils import l1_loss
from utils.plain_main import parsed, parser_of

try:
    from torch.utils.tensorboard import SummaryWriter

    TENSORBOARD_FOUND = True
except ImportError:
    TENSORBOARD_FOUND = False


def training(  # noqa: PLR0912, PLR0915 - one long function, as in the code that this stands for
    dataset,
    opt,
    pipe,
    testing_iterations,
    saving_iterations,
    checkpoint_iterations,
    checkpoint,
    debug_from,
    websockets,
):
    first_iter = 0
    prepare_output_and_logger(dataset)
    gaussians = GaussianModel(dataset.sh_degree, opt.optimizer_type)
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    if checkpoint:
        (model_params, first_iter) = torch.load(checkpoint)
        gaussians.restore(model_params, opt)
    bg_color = [1, 1, 1] if dataset.white_background else [0, 0, 0]
    background = torch.tensor(bg_color, dtype=torch.float32, device="cuda")
    iter_start, iter_end, optim_start, optim_end = (torch.cuda.Event(enable_timing=True) for _ in range(4))
    total_time = 0.0
    viewpoint_stack = scene.getTrainCameras().copy()
    ema_loss_for_log = 0.0
    progress_bar = tqdm(range(first_iter, opt.iterations), desc="Training progress")
    first_iter += 1
    bg = torch.rand((3), device="cuda") if opt.random_background else background
    for iteration in range(first_iter, opt.iterations + 1):
        if websockets and 0 <= network_gui_ws.curr_id < len(scene.getTrainCameras()):
            cam = scene.getTrainCameras()[network_gui_ws.curr_id]
            net_image = render_fastgs(cam, gaussians, pipe, background, opt.mult, 1.0)["render"]
            network_gui_ws.latest_width = cam.image_width
            network_gui_ws.latest_height = cam.image_height
            pixels = (net_image.clamp(min=0, max=1.0) * 255).byte().permute(1, 2, 0).contiguous()
            network_gui_ws.latest_result = memoryview(pixels.cpu().numpy())
        iter_start.record()
        gaussians.update_learning_rate(iteration)
        if iteration % 1000 == 0:
            gaussians.oneupSHdegree()
        if not viewpoint_stack:
            viewpoint_stack = scene.getTrainCameras().copy()
        viewpoint_cam = viewpoint_stack.pop(randint(0, len(viewpoint_stack) - 1))
        if (iteration - 1) == debug_from:
            pipe.debug = True
        render_pkg = render_fastgs(viewpoint_cam, gaussians, pipe, bg, opt.mult)
        image, viewspace_point_tensor = render_pkg["render"], render_pkg["viewspace_points"]
        visibility_filter, radii = render_pkg["visibility_filter"], render_pkg["radii"]
        gt_image = viewpoint_cam.original_image.cuda()
        Ll1 = l1_loss(image, gt_image)
        ssim_value = fast_ssim(image.unsqueeze(0), gt_image.unsqueeze(0))
        loss = (1.0 - opt.lambda_dssim) * Ll1 + opt.lambda_dssim * (1.0 - ssim_value)
        loss.backward()
        iter_end.record()
        with torch.no_grad():
            ema_loss_for_log = 0.4 * loss.item() + 0.6 * ema_loss_for_log
            if iteration % 10 == 0:
                progress_bar.set_postfix({"Loss": f"{ema_loss_for_log:.7f}"})
                progress_bar.update(10)
            if iteration == opt.iterations:
                progress_bar.close()
            iter_time = iter_start.elapsed_time(iter_end)
            if iteration in saving_iterations:
                print(f"\n[ITER {iteration}] Saving Gaussians")
                scene.save(iteration)
            optim_start.record()
            if iteration < opt.densify_until_iter:
                gaussians.max_radii2D[visibility_filter] = torch.max(
                    gaussians.max_radii2D[visibility_filter], radii[visibility_filter]
                )
                gaussians.add_densification_stats(viewspace_point_tensor, visibility_filter)
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    size_threshold = 20 if iteration > opt.opacity_reset_interval else None
                    camlist = sampling_cameras(scene.getTrainCameras().copy())
                    importance_score, pruning_score = compute_gaussian_score_fastgs(
                        camlist, gaussians, pipe, bg, opt, DENSIFY=True
                    )
                    gaussians.densify_and_prune_fastgs(
                        max_screen_size=size_threshold,
                        min_opacity=0.005,
                        extent=scene.cameras_extent,
                        radii=radii,
                        args=opt,
                        importance_score=importance_score,
                        pruning_score=pruning_score,
                    )
                at_start = dataset.white_background and iteration == opt.densify_from_iter
                if iteration % opt.opacity_reset_interval == 0 or at_start:
                    gaussians.reset_opacity()
            if iteration % 3000 == 0 and iteration > 15_000 and iteration < 30_000:
                camlist = sampling_cameras(scene.getTrainCameras().copy())
                _, pruning_score = compute_gaussian_score_fastgs(camlist, gaussians, pipe, bg, opt)
                gaussians.final_prune_fastgs(min_opacity=0.1, pruning_score=pruning_score)
            if iteration < opt.iterations:
                if opt.optimizer_type == "default":
                    gaussians.optimizer_step(iteration)
                elif opt.optimizer_type == "sparse_adam":
                    visible = radii > 0
                    gaussians.optimizer.step(visible, radii.shape[0])
                    gaussians.optimizer.zero_grad(set_to_none=True)
            optim_end.record()
            torch.cuda.synchronize()
            total_time += (iter_time + optim_start.elapsed_time(optim_end)) / 1e3
    print(f"Gaussian number: {gaussians._xyz.shape[0]}")
    print(f"Training time: {total_time}")


def prepare_output_and_logger(args):
    if not args.model_path:
        args.model_path = str(Path("output", os.getenv("OAR_JOB_ID") or str(uuid.uuid4())))
    print(f"Output folder: {args.model_path}")
    Path(args.model_path).mkdir(parents=True, exist_ok=True)
    Path(args.model_path, "cfg_args").write_text(str(Namespace(**vars(args))), encoding="utf-8")
    return SummaryWriter(args.model_path) if TENSORBOARD_FOUND else None


def training_report(
    tb_writer, iteration, Ll1, loss, l1_loss, elapsed, testing_iterations, scene: Scene, renderFunc, renderArgs
):
    """Quality of test views and some training views; nobody calls it here."""
    if iteration not in testing_iterations:
        return
    train_cameras = scene.getTrainCameras()
    some = [train_cameras[index % len(train_cameras)] for index in range(5, 30, 5)]
    for name, cameras in (("test", scene.getTestCameras()), ("train", some)):
        rows = []
        for viewpoint in cameras:
            image = torch.clamp(renderFunc(viewpoint, scene.gaussians, *renderArgs)["render"], 0.0, 1.0)
            gt_image = torch.clamp(viewpoint.original_image.to("cuda"), 0.0, 1.0)
            rows.append(torch.stack([l1_loss(image, gt_image), psnr(image, gt_image).mean()]))
        if rows:
            l1_test, psnr_test = torch.stack(rows).mean(0).tolist()
            print(f"\n[ITER {iteration}] Evaluating {name}: L1 {l1_test} PSNR {psnr_test}")


if __name__ == "__main__":
    parser, (lp, op, pp) = parser_of(ModelParams, OptimizationParams, PipelineParams)
    parser.add_argument("--detect_anomaly", action="store_true", default=False)
    parser.add_argument("--websockets", action="store_true", default=False)
    parser.add_argument("--benchmark_dir", type=str, default=None)
    parser.set_defaults(test_iterations=[30_000], save_iterations=[30_000], checkpoint_iterations=[30_000])
    args = parsed(parser)
    if args.websockets:
        network_gui_ws.init(args.ip, args.port)
    torch.autograd.set_detect_anomaly(args.detect_anomaly)
    training(
        lp.extract(args),
        op.extract(args),
        pp.extract(args),
        args.test_iterations,
        args.save_iterations,
        args.checkpoint_iterations,
        args.start_checkpoint,
        args.debug_from,
        args.websockets,
    )
    print("\nTraining complete.")
