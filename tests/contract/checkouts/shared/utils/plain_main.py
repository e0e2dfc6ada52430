"""The main block and the output folder of the 2023 release."""

import os
import sys
import uuid
from argparse import ArgumentParser, Namespace
from pathlib import Path

import torch
from tqdm import tqdm
from utils.general_utils import safe_state


def prepare_output_and_logger(args):
    if not args.model_path:
        args.model_path = str(Path("output", (os.getenv("OAR_JOB_ID") or str(uuid.uuid4()))[:10]))
    print(f"Output folder: {args.model_path}")
    Path(args.model_path).mkdir(parents=True, exist_ok=True)
    Path(args.model_path, "cfg_args").write_text(str(Namespace(**vars(args))), encoding="utf-8")


class LossBar:
    """A progress bar that shows a running mean of the loss every ten iterations."""

    def __init__(self, first, iterations):
        self.bar = tqdm(range(first, iterations), desc="Training progress")
        self.mean, self.iterations = 0.0, iterations

    def note(self, iteration, loss):
        self.mean = 0.4 * loss.item() + 0.6 * self.mean
        if iteration % 10 == 0:
            self.bar.set_postfix({"Loss": f"{self.mean:.7f}"})
            self.bar.update(10)
        if iteration == self.iterations:
            self.bar.close()


def background_of(dataset):
    return torch.tensor([1.0] * 3 if dataset.white_background else [0.0] * 3, device="cuda")


def parser_of(*groups):
    """A parser with the options of every script, and the groups of this one."""
    parser = ArgumentParser(description="Training script parameters")
    made = [group(parser) for group in groups]
    parser.add_argument("--ip", type=str, default="127.0.0.1")
    parser.add_argument("--port", type=int, default=6009)
    parser.add_argument("--debug_from", type=int, default=-1)
    parser.add_argument("--test_iterations", nargs="+", type=int, default=[7_000, 30_000])
    parser.add_argument("--save_iterations", nargs="+", type=int, default=[7_000, 30_000])
    parser.add_argument("--quiet", action="store_true")
    parser.add_argument("--checkpoint_iterations", nargs="+", type=int, default=[])
    parser.add_argument("--start_checkpoint", type=str, default=None)
    return parser, made


def parsed(parser):
    args = parser.parse_args(sys.argv[1:])
    args.save_iterations.append(args.iterations)
    print("Optimizing " + args.model_path)
    safe_state(args.quiet)
    return args
