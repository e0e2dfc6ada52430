"""Run a step of COLMAP: `python colmap_worker`, with one line of JSON on its input.

It is a separate process for three reasons. COLMAP aborts when the disk is full or memory runs out. An interrupted step
can be killed. And COLMAP's SQLite and Python's must not open a database in one process, because closing one connection
drops the locks of the other. The worker is started by its path, so that it does not import torch.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path
from typing import Any

import pycolmap

SEED = 0

PAIR_BLOCK = 10
"""Photos whose features are in memory at a time in exhaustive matching."""


def main() -> None:
    """Run the step in the first line of the input. Exit when the input closes, because then the parent has died."""
    job = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    {"features": _find_features, "pairs": _match_pairs, "map": _map}[job["step"]](job)


def _end_with_parent() -> None:
    sys.stdin.read()
    os._exit(1)


def _find_features(job: dict[str, Any]) -> None:
    """Extract features. Keys: database, photos, names, camera_model, single_camera, max_size (or None)."""
    mode = pycolmap.CameraMode.SINGLE if job["single_camera"] else pycolmap.CameraMode.AUTO
    reader = pycolmap.ImageReaderOptions(camera_model=job["camera_model"])
    options = pycolmap.FeatureExtractionOptions(use_gpu=pycolmap.has_cuda)
    if job["max_size"] is not None:
        options.max_image_size = job["max_size"]
    with pycolmap.Database.open(job["database"]) as database:
        known = database.num_images()
    if known != len(job["names"]):
        # Extraction numbers photos in the order in which its threads finish. Importing them first numbers them by name,
        # so that the same photos give the same scene.
        for suffix in ("", "-wal", "-shm"):
            Path(job["database"] + suffix).unlink(missing_ok=True)
        pycolmap.Database.open(job["database"]).close()
        pycolmap.import_images(job["database"], job["photos"], mode, job["names"], reader)
    pycolmap.extract_features(job["database"], job["photos"], job["names"], mode, reader, options)


def _match_pairs(job: dict[str, Any]) -> None:
    """Match features. Keys: database, matcher."""
    matching = pycolmap.FeatureMatchingOptions(use_gpu=pycolmap.has_cuda)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    if job["matcher"] == "exhaustive":
        blocks = pycolmap.ExhaustivePairingOptions(block_size=PAIR_BLOCK)
        pycolmap.match_exhaustive(job["database"], matching, blocks, verification)
    else:
        pycolmap.match_sequential(job["database"], matching, pycolmap.SequentialPairingOptions(), verification)


def _map(job: dict[str, Any]) -> None:
    """Recover models. Keys: database, photos, models (an empty folder), placed (a file that grows a byte per photo)."""
    options = pycolmap.IncrementalPipelineOptions(random_seed=SEED)
    options.mapper.random_seed = options.triangulation.random_seed = SEED
    with pycolmap.Database.open(job["database"]) as database:
        residuals = 2 * database.num_keypoints()  # at most
    if residuals < options.ba_min_num_residuals_for_cpu_multi_threading:
        # COLMAP's threads race for the initial pair, and another pair gives another scene. With so few features bundle
        # adjustment uses one thread anyway. With more it uses several, which sum in no fixed order, so that the same
        # photos give slightly different scenes.
        options.num_threads = 1
    with Path(job["placed"]).open("wb", buffering=0) as placed:

        def place(count: int) -> None:
            placed.write(b"." * count)

        pycolmap.incremental_mapping(
            *(job["database"], job["photos"], job["models"], options),
            initial_image_pair_callback=lambda: place(2),
            next_image_callback=lambda: place(1),
        )


if __name__ == "__main__":
    main()
