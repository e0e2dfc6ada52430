"""Training: the loop, its output folder and its report."""

import os
import sys
import uuid
from argparse import Namespace
from pathlib import Path
from random import randint

import torch
from arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_renderer import network_gui, render
from scene import GaussianModel, Scene
from tqdm import tqdm
from utils.general_utils import get_expon_lr_func
from utils.image_utils import psnr
from utils.loss_utils import l1_loss, ssim
from utils.plain_main import parsed, parser_of

try:
    from torch.utils.tensorboard import SummaryWriter

    TENSORBOARD_FOUND = True
except ImportError:
    TENSORBOARD_FOUND = False

try:
    from fused_ssim import fused_ssim

    FUSED_SSIM_AVAILABLE = True
except ImportError:
    FUSED_SSIM_AVAILABLE = False

try:
    from diff_gaussian_rasterization import SparseGaussianAdam  # noqa: F401 - whether it is there decides

    SPARSE_ADAM_AVAILABLE = True
except ImportError:
    SPARSE_ADAM_AVAILABLE = False


def training(  # noqa: PLR0912, PLR0915 - one long function, as in the code that this stands for
    dataset, opt, pipe, testing_iterations, saving_iterations, checkpoint_iterations, checkpoint, debug_from
):
    if not SPARSE_ADAM_AVAILABLE and opt.optimizer_type == "sparse_adam":
        sys.exit("sparse adam is not installed, please install the accelerated rasterizer")
    first_iter = 0
    tb_writer = prepare_output_and_logger(dataset)
    gaussians = GaussianModel(dataset.sh_degree, opt.optimizer_type)
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    if checkpoint:
        (model_params, first_iter) = torch.load(checkpoint)
        gaussians.restore(model_params, opt)
    bg_color = [1, 1, 1] if dataset.white_background else [0, 0, 0]
    background = torch.tensor(bg_color, dtype=torch.float32, device="cuda")
    iter_start, iter_end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    use_sparse_adam = opt.optimizer_type == "sparse_adam" and SPARSE_ADAM_AVAILABLE
    depth_l1_weight = get_expon_lr_func(opt.depth_l1_weight_init, opt.depth_l1_weight_final, max_steps=opt.iterations)
    viewpoint_stack = scene.getTrainCameras().copy()
    ema_loss_for_log = 0.0
    ema_Ll1depth_for_log = 0.0
    progress_bar = tqdm(range(first_iter, opt.iterations), desc="Training progress")
    first_iter += 1
    for iteration in range(first_iter, opt.iterations + 1):
        if network_gui.conn is None:
            network_gui.try_connect()
        while network_gui.conn is not None:
            try:
                received = network_gui.receive()
                custom_cam, do_training, pipe.convert_SHs_python, pipe.compute_cov3D_python, *others = received
                keep_alive, scaling_modifier = others
                net_image_bytes = None
                if custom_cam is not None:
                    net_image = render(
                        custom_cam,
                        gaussians,
                        pipe,
                        background,
                        scaling_modifier=scaling_modifier,
                        use_trained_exp=dataset.train_test_exp,
                        separate_sh=SPARSE_ADAM_AVAILABLE,
                    )["render"]
                    pixels = (net_image.clamp(min=0, max=1.0) * 255).byte().permute(1, 2, 0).contiguous()
                    net_image_bytes = memoryview(pixels.cpu().numpy())
                network_gui.send(net_image_bytes, dataset.source_path)
                if do_training and (iteration < int(opt.iterations) or not keep_alive):
                    break
            except Exception:
                network_gui.conn = None
        iter_start.record()
        gaussians.update_learning_rate(iteration)
        if iteration % 1000 == 0:
            gaussians.oneupSHdegree()
        if not viewpoint_stack:
            viewpoint_stack = scene.getTrainCameras().copy()
        viewpoint_cam = viewpoint_stack.pop(randint(0, len(viewpoint_stack) - 1))
        if (iteration - 1) == debug_from:
            pipe.debug = True
        bg = torch.rand((3), device="cuda") if opt.random_background else background
        render_pkg = render(
            viewpoint_cam,
            gaussians,
            pipe,
            bg,
            use_trained_exp=dataset.train_test_exp,
            separate_sh=SPARSE_ADAM_AVAILABLE,
        )
        image, viewspace_point_tensor = render_pkg["render"], render_pkg["viewspace_points"]
        visibility_filter, radii = render_pkg["visibility_filter"], render_pkg["radii"]
        if viewpoint_cam.alpha_mask is not None:
            alpha_mask = viewpoint_cam.alpha_mask.cuda()
            image *= alpha_mask
        gt_image = viewpoint_cam.original_image.cuda()
        Ll1 = l1_loss(image, gt_image)
        if FUSED_SSIM_AVAILABLE:
            ssim_value = fused_ssim(image.unsqueeze(0), gt_image.unsqueeze(0))
        else:
            ssim_value = ssim(image, gt_image)
        loss = (1.0 - opt.lambda_dssim) * Ll1 + opt.lambda_dssim * (1.0 - ssim_value)
        Ll1depth = 0
        if depth_l1_weight(iteration) > 0 and viewpoint_cam.depth_reliable:
            invDepth = render_pkg["depth"]
            mono_invdepth = viewpoint_cam.invdepthmap.cuda()
            depth_mask = viewpoint_cam.depth_mask.cuda()
            weighted = depth_l1_weight(iteration) * torch.abs((invDepth - mono_invdepth) * depth_mask).mean()
            loss += weighted
            Ll1depth = weighted.item()
        loss.backward()
        iter_end.record()
        with torch.no_grad():
            ema_loss_for_log = 0.4 * loss.item() + 0.6 * ema_loss_for_log
            ema_Ll1depth_for_log = 0.4 * Ll1depth + 0.6 * ema_Ll1depth_for_log
            if iteration % 10 == 0:
                progress_bar.set_postfix(
                    {"Loss": f"{ema_loss_for_log:.7f}", "Depth Loss": f"{ema_Ll1depth_for_log:.7f}"}
                )
                progress_bar.update(10)
            if iteration == opt.iterations:
                progress_bar.close()
            elapsed = iter_start.elapsed_time(iter_end)
            how = (pipe, background, 1.0, SPARSE_ADAM_AVAILABLE, None, dataset.train_test_exp)
            training_report(
                tb_writer,
                iteration,
                Ll1,
                loss,
                l1_loss,
                elapsed,
                testing_iterations,
                scene,
                render,
                how,
                dataset.train_test_exp,
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
                    gaussians.densify_and_prune(
                        opt.densify_grad_threshold, 0.005, scene.cameras_extent, size_threshold, radii
                    )
                at_start = dataset.white_background and iteration == opt.densify_from_iter
                if iteration % opt.opacity_reset_interval == 0 or at_start:
                    gaussians.reset_opacity()
            if iteration < opt.iterations:
                gaussians.exposure_optimizer.step()
                gaussians.exposure_optimizer.zero_grad(set_to_none=True)
                if use_sparse_adam:
                    visible = radii > 0
                    gaussians.optimizer.step(visible, radii.shape[0])
                    gaussians.optimizer.zero_grad(set_to_none=True)
                else:
                    gaussians.optimizer.step()
                    gaussians.optimizer.zero_grad(set_to_none=True)
            if iteration in checkpoint_iterations:
                print(f"\n[ITER {iteration}] Saving Checkpoint")
                torch.save((gaussians.capture(), iteration), f"{scene.model_path}/chkpnt{iteration}.pth")


def prepare_output_and_logger(args):
    if not args.model_path:
        args.model_path = str(Path("output", (os.getenv("OAR_JOB_ID") or str(uuid.uuid4()))[:10]))
    print(f"Output folder: {args.model_path}")
    Path(args.model_path).mkdir(parents=True, exist_ok=True)
    Path(args.model_path, "cfg_args").write_text(str(Namespace(**vars(args))), encoding="utf-8")
    return SummaryWriter(args.model_path) if TENSORBOARD_FOUND else None


def training_report(
    tb_writer,
    iteration,
    Ll1,
    loss,
    l1_loss,
    elapsed,
    testing_iterations,
    scene: Scene,
    renderFunc,
    renderArgs,
    train_test_exp,
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
            if train_test_exp:
                image, gt_image = (pixels[..., pixels.shape[-1] // 2 :] for pixels in (image, gt_image))
            rows.append(torch.stack([l1_loss(image, gt_image), psnr(image, gt_image).mean()]))
        if rows:
            l1_test, psnr_test = torch.stack(rows).mean(0).tolist()
            print(f"\n[ITER {iteration}] Evaluating {name}: L1 {l1_test} PSNR {psnr_test}")


if __name__ == "__main__":
    parser, (lp, op, pp) = parser_of(ModelParams, OptimizationParams, PipelineParams)
    parser.add_argument("--detect_anomaly", action="store_true", default=False)
    parser.add_argument("--disable_viewer", action="store_true", default=False)
    args = parsed(parser)
    if not args.disable_viewer:
        network_gui.init(args.ip, args.port)
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
    )
    print("\nTraining complete.")
