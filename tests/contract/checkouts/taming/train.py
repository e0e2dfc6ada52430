"""Training: the loop, its output folder and its report."""

import os
import random
import time
import uuid
from argparse import Namespace
from pathlib import Path
from random import randint

import numpy as np
import torch
from arguments import ModelParams, OptimizationParams, PipelineParams
from fused_ssim import fused_ssim as fast_ssim
from gaussian_renderer import network_gui_ws, render
from scene import GaussianModel, Scene
from tqdm import tqdm
from utils.image_utils import psnr
from utils.loss_utils import l1_loss
from utils.plain_main import parsed, parser_of
from utils.taming_utils import compute_gaussian_score, get_count_array, get_edges

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
    score_coefficients,
    args,
):
    first_iter = 0
    densify_iter_num = 0
    tb_writer = prepare_output_and_logger(dataset)
    gaussians = GaussianModel(dataset.sh_degree, opt.optimizer_type)
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    if checkpoint:
        (model_params, first_iter) = torch.load(checkpoint)
        gaussians.restore(model_params, opt)
    bg_color = [1, 1, 1] if dataset.white_background else [0, 0, 0]
    background = torch.tensor(bg_color, dtype=torch.float32, device="cuda")
    iter_start, iter_end, start_time, end_time = (torch.cuda.Event(enable_timing=True) for _ in range(4))
    viewpoint_stack = scene.getTrainCameras().copy()
    time_taken = {"forward": [], "backward": [], "step": []}

    def timed(what):
        if args.benchmark_dir:
            end_time.record()
            torch.cuda.synchronize()
            time_taken[what].append(start_time.elapsed_time(end_time))

    all_edges = []
    for view in scene.getTrainCameras():
        edges_loss = get_edges(view.original_image).squeeze().cuda()
        all_edges.append(((edges_loss - edges_loss.min()) / (edges_loss.max() - edges_loss.min())).cpu())
    counts_array = None
    ema_loss_for_log = 0.0
    progress_bar = tqdm(range(first_iter, opt.iterations), desc="Training progress")
    first_iter += 1
    bg = torch.rand((3), device="cuda") if opt.random_background else background
    start = time.time()
    for iteration in range(first_iter, opt.iterations + 1):
        if websockets and 0 <= network_gui_ws.curr_id < len(scene.getTrainCameras()):
            cam = scene.getTrainCameras()[network_gui_ws.curr_id]
            net_image = render(cam, gaussians, pipe, background, 1.0)["render"]
            network_gui_ws.latest_width = cam.image_width
            network_gui_ws.latest_height = cam.image_height
            pixels = (net_image.clamp(min=0, max=1.0) * 255).byte().permute(1, 2, 0).contiguous()
            network_gui_ws.latest_result = memoryview(pixels.cpu().numpy())
        iter_start.record()
        if counts_array is None:
            counts_array = get_count_array(len(scene.gaussians.get_xyz), args.budget, opt, mode=args.mode)
            print(counts_array)
        gaussians.update_learning_rate(iteration)
        if iteration % 1000 == 0:
            gaussians.oneupSHdegree()
        if not viewpoint_stack:
            viewpoint_stack = scene.getTrainCameras().copy()
        viewpoint_cam = viewpoint_stack.pop(randint(0, len(viewpoint_stack) - 1))
        if (iteration - 1) == debug_from:
            pipe.debug = True
        start_time.record()
        render_pkg = render(viewpoint_cam, gaussians, pipe, bg)
        image, viewspace_point_tensor = render_pkg["render"], render_pkg["viewspace_points"]
        visibility_filter, radii = render_pkg["visibility_filter"], render_pkg["radii"]
        gt_image = viewpoint_cam.original_image.cuda()
        Ll1 = l1_loss(image, gt_image)
        ssim_value = fast_ssim(image.unsqueeze(0), gt_image.unsqueeze(0))
        loss = (1.0 - opt.lambda_dssim) * Ll1 + opt.lambda_dssim * (1.0 - ssim_value)
        timed("forward")
        start_time.record()
        loss.backward()
        timed("backward")
        iter_end.record()
        with torch.no_grad():
            ema_loss_for_log = 0.4 * loss.item() + 0.6 * ema_loss_for_log
            if iteration % 10 == 0:
                progress_bar.set_postfix({"Loss": f"{ema_loss_for_log:.7f}"})
                progress_bar.update(10)
            if iteration == opt.iterations:
                progress_bar.close()
            elapsed = iter_start.elapsed_time(iter_end)
            training_report(
                tb_writer, iteration, Ll1, loss, l1_loss, elapsed, testing_iterations, scene, render, (pipe, background)
            )
            if iteration in saving_iterations:
                print(f"\n[ITER {iteration}] Saving Gaussians")
                scene.save(iteration)
            if iteration < opt.densify_until_iter:
                gaussians.max_radii2D[visibility_filter] = torch.max(
                    gaussians.max_radii2D[visibility_filter], radii[visibility_filter]
                )
                gaussians.add_densification_stats(viewspace_point_tensor, visibility_filter)
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    size_threshold = 20 if iteration > opt.opacity_reset_interval else None
                    my_viewpoint_stack = scene.getTrainCameras().copy()
                    edges_stack = all_edges.copy()
                    num_cams = len(my_viewpoint_stack) if args.cams == -1 else args.cams
                    edge_losses = []
                    camlist = []
                    for _ in range(num_cams):
                        loc = random.randint(0, len(my_viewpoint_stack) - 1)
                        camlist.append(my_viewpoint_stack.pop(loc))
                        edge_losses.append(edges_stack.pop(loc))
                    gaussian_importance = compute_gaussian_score(
                        scene, camlist, edge_losses, gaussians, pipe, bg, score_coefficients, opt
                    )
                    gaussians.densify_with_score(
                        scores=gaussian_importance,
                        max_screen_size=size_threshold,
                        min_opacity=0.005,
                        extent=scene.cameras_extent,
                        budget=counts_array[densify_iter_num + 1],
                        radii=radii,
                        iter_num=densify_iter_num,
                    )
                    densify_iter_num += 1
                at_start = dataset.white_background and iteration == opt.densify_from_iter
                if iteration % opt.opacity_reset_interval == 0 or at_start:
                    gaussians.reset_opacity()
            if iteration == args.ho_iteration:
                print("Release opacity limit")
                gaussians.modify_functions()
            start_time.record()
            if iteration < opt.iterations:
                if opt.optimizer_type == "default":
                    gaussians.optimizer.step()
                    gaussians.optimizer.zero_grad(set_to_none=True)
                    if not args.sh_lower or iteration % 16 == 0:
                        gaussians.shoptimizer.step()
                        gaussians.shoptimizer.zero_grad(set_to_none=True)
                elif opt.optimizer_type == "sparse_adam":
                    visible = radii > 0
                    gaussians.optimizer.step(visible, radii.shape[0])
                    gaussians.optimizer.zero_grad(set_to_none=True)
            timed("step")
            if iteration in checkpoint_iterations:
                print(f"\n[ITER {iteration}] Saving Checkpoint")
                torch.save((gaussians.capture(), iteration), f"{scene.model_path}/chkpnt{iteration}.pth")
        if args.benchmark_dir:
            Path(args.benchmark_dir).mkdir(parents=True, exist_ok=True)
            for what, times in time_taken.items():
                np.save(Path(args.benchmark_dir, f"{what}.npy"), np.array(times))
    end = time.time()
    scene.save(iteration)
    print(f"Time taken by {os.getenv('OAR_JOB_ID')}: {end - start}s")


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
    """Quality of test views and some training views."""
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
    parser.add_argument("--cams", type=int, default=10)
    parser.add_argument("--budget", type=float, default=20)
    parser.add_argument("--mode", type=str, default="multiplier", choices=["multiplier", "final_count"])
    parser.add_argument("--websockets", action="store_true", default=False)
    parser.add_argument("--ho_iteration", type=int, default=15000)
    parser.add_argument("--sh_lower", action="store_true", default=False)
    parser.add_argument("--benchmark_dir", type=str, default=None)
    parser.set_defaults(checkpoint_iterations=[30_000])
    args = parsed(parser)
    if args.websockets:
        network_gui_ws.init(args.ip, args.port)
    torch.autograd.set_detect_anomaly(args.detect_anomaly)
    score_coefficients = {
        "view_importance": 50,
        "edge_importance": 50,
        "mse_importance": 50,
        "grad_importance": 25,
        "dist_importance": 50,
        "opac_importance": 100,
        "dept_importance": 5,
        "loss_importance": 10,
        "radii_importance": 10,
        "scale_importance": 25,
        "count_importance": 0.1,
        "blend_importance": 50,
    }
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
        score_coefficients,
        args,
    )
    print("\nTraining complete.")
