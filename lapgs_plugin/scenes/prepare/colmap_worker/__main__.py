"""Run a step of COLMAP: `python colmap_worker`, with one line of JSON on its input.

It is a separate process for three reasons. COLMAP aborts when the disk is full or memory runs out. An interrupted step
can be killed. And COLMAP's SQLite and Python's must not open a database in one process, because closing one connection
drops the locks of the other. The worker is started by its path, so that it does not import torch.
"""

from __future__ import annotations

import json
import math
import os
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

SEED = 0
"""Seed of COLMAP's random choices, and of those of features for a vocabulary."""
FISHEYE_FOCAL = 0.4
"""Focal length of a fisheye lens in longer sides of the photo, to start from: 143 degrees across."""

MOST_DESCRIPTORS = 65_536
"""Most features that a vocabulary is made of."""
DESCRIPTORS_A_WORD = 50
FEWEST_WORDS, MOST_WORDS = 64, 1024
EMBEDDING = 64
"""Dimensions of an embedding, the only number that COLMAP has for SIFT."""
ROUNDS = 6
"""Rounds of clustering, which take seconds without showing progress."""

PAIRS_A_THREAD = 4
"""Pairs that a thread matches between two moves of the progress bar: COLMAP saves the pairs of a block together."""


def main() -> None:
    """Run the step in the first line of the input. Exit when the input closes, because then the parent has died."""
    pycolmap.logging.logtostderr = True  # and not to files in /tmp as well
    job = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    {"features": find_features, "pairs": match_pairs, "rig": configure_rig, "map": map_photos}[job["step"]](job)


def _end_with_parent() -> None:
    sys.stdin.read()
    os._exit(1)


def find_features(job: dict[str, Any]) -> None:
    """Extract features.

    Keys: database, photos, names, camera_model, camera_mode (a name), max_size and masks (or None), rig (a list of
    cameras, the reference first: prefix of its images' names, turn (3, 3) against the reference, size, params of a
    PINHOLE camera).
    """
    mode = pycolmap.CameraMode.__members__[job["camera_mode"]]
    reader = pycolmap.ImageReaderOptions(camera_model=job["camera_model"])
    fisheye = "FISHEYE" in job["camera_model"]
    if fisheye:
        reader.default_focal_length_factor = FISHEYE_FOCAL
    if job["masks"] is not None:
        reader.mask_path = job["masks"]
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
        if fisheye:  # lines are so bent that no pair has a geometry without calibration
            with pycolmap.Database.open(job["database"]) as database:
                for camera in database.read_all_cameras():
                    camera.has_prior_focal_length = True
                    database.update_camera(camera)
    pycolmap.extract_features(job["database"], job["photos"], job["names"], mode, reader, options)
    if job["rig"]:
        with pycolmap.Database.open(job["database"]) as database:
            pycolmap.apply_rig_config([pycolmap.RigConfig(cameras=list(map(_sensor, job["rig"])))], database)


def _sensor(values: dict[str, Any]) -> pycolmap.RigConfigCamera:
    width, height = values["size"]
    camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=values["params"])
    camera.has_prior_focal_length = True
    turn, reference = np.array(values["turn"]), values["turn"] == np.eye(3).tolist()
    sensor = pycolmap.RigConfigCamera(ref_sensor=reference, image_prefix=values["prefix"], camera=camera)
    if not reference:
        sensor.cam_from_rig = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), np.zeros(3))
    return sensor


def configure_rig(job: dict[str, Any]) -> None:
    """Make photos of one moment a frame of a rig.

    Keys: database, prefixes (of the images' names by camera, the reference first), model (a folder of placed images,
    whose mean poses are the rig's).
    """
    sensors = [
        pycolmap.RigConfigCamera(ref_sensor=index == 0, image_prefix=prefix)
        for index, prefix in enumerate(job["prefixes"])
    ]
    placed = pycolmap.Reconstruction(job["model"])
    with pycolmap.Database.open(job["database"]) as database:
        pycolmap.apply_rig_config([pycolmap.RigConfig(cameras=sensors)], database, placed)


def match_pairs(job: dict[str, Any]) -> None:
    """Match features.

    Keys: database, matcher, similar (photos to compare with by looks), every (distance of photos that sequential
    matching compares so, 0 for none), tree (a file to write), guided (match more features of pairs with a geometry; may
    be missing), rig (whether photos of a frame share a centre; may be missing). Pairs that the database has a geometry
    of are left alone.
    """
    matching = pycolmap.FeatureMatchingOptions(use_gpu=pycolmap.has_cuda, guided_matching=job.get("guided", False))
    if job.get("rig"):
        matching.rig_verification = matching.skip_image_pairs_in_same_frame = True
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    if job["matcher"] == "exhaustive":
        side = math.ceil(math.sqrt(PAIRS_A_THREAD * (os.cpu_count() or 1)))
        blocks = pycolmap.ExhaustivePairingOptions(block_size=max(2, side))
        pycolmap.match_exhaustive(job["database"], matching, blocks, verification)
    elif job["matcher"] == "retrieval":
        _make_tree(job["database"], job["tree"])
        alike = pycolmap.VocabTreePairingOptions(vocab_tree_path=job["tree"], num_images=job["similar"])
        pycolmap.match_vocabtree(job["database"], matching, alike, verification)
    else:
        neighbours = pycolmap.SequentialPairingOptions(expand_rig_images=bool(job.get("rig")))
        if job["every"]:
            _make_tree(job["database"], job["tree"])
            neighbours.loop_detection, neighbours.vocab_tree_path = True, job["tree"]
            neighbours.loop_detection_period, neighbours.loop_detection_num_images = job["every"], job["similar"]
        pycolmap.match_sequential(job["database"], matching, neighbours, verification)


def _make_tree(database: str, tree: str) -> None:
    """Write a vocabulary of the photos' own features, which finds photos that look alike. Nothing is downloaded."""
    with pycolmap.Database.open(database) as opened:
        by_image = [opened.read_descriptors(image.image_id) for image in opened.read_all_images()]
    used = [image for image in by_image if len(image.data)]
    share = min(1.0, MOST_DESCRIPTORS / max(sum(len(image.data) for image in used), 1))
    random = np.random.default_rng(SEED)
    chosen = [image.data[random.random(len(image.data)) < share] for image in used]
    descriptors = np.concatenate(chosen).astype(np.float32)
    words = int(np.clip(len(descriptors) // DESCRIPTORS_A_WORD, FEWEST_WORDS, MOST_WORDS))
    index = pycolmap.VisualIndex.create(descriptors.shape[1], EMBEDDING)
    index.build(
        pycolmap.VisualIndex.BuildOptions(num_visual_words=words, num_iterations=ROUNDS, num_rounds=1),
        pycolmap.FeatureDescriptorsFloat(used[0].type, descriptors),
    )
    index.write(tree)


def map_photos(job: dict[str, Any]) -> None:
    """Recover models.

    Keys: database, photos, models (an empty folder), placed (a file that gets a line per model, a byte per photo),
    mapper ("incremental" or "global"), camera_model (to fit instead of the database's; may be missing), rig (whether
    lenses and rig are known).
    """
    if "camera_model" in job:
        replace_cameras(job["database"], job["camera_model"])
    if job["mapper"] == "global":
        whole = pycolmap.GlobalPipelineOptions(random_seed=SEED)
        if job["rig"]:
            whole.mapper.refine_sensor_from_rig = False
            lenses = whole.mapper.bundle_adjustment
            lenses.refine_focal_length = lenses.refine_principal_point = lenses.refine_extra_params = False
        pycolmap.global_mapping(job["database"], job["photos"], job["models"], whole)
        return
    options = pycolmap.IncrementalPipelineOptions(random_seed=SEED)
    options.mapper.random_seed = options.triangulation.random_seed = SEED
    if job["rig"]:
        options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
        options.ba_refine_sensor_from_rig = False
    with pycolmap.Database.open(job["database"]) as database:
        residuals = 2 * database.num_keypoints()  # at most
    if residuals < options.ba_min_num_residuals_for_cpu_multi_threading:
        # COLMAP's threads race for the initial pair, and another pair gives another scene. With so few features bundle
        # adjustment uses one thread anyway. With more it uses several, which sum in no fixed order, so that the same
        # photos give slightly different scenes.
        options.num_threads = 1
    with Path(job["placed"]).open("wb", buffering=0) as placed:

        def record(photos: bytes) -> None:
            placed.write(photos)

        pycolmap.incremental_mapping(
            job["database"],
            job["photos"],
            job["models"],
            options,
            initial_image_pair_callback=lambda: record(b"\n.."),
            next_image_callback=lambda: record(b"."),
        )


def replace_cameras(path: str, model: str) -> None:
    """Give the cameras of a database another model without distortion, and the same focal length."""
    with pycolmap.Database.open(path) as database:
        for camera in database.read_all_cameras():
            focal = camera.mean_focal_length()
            other = pycolmap.Camera.create_from_model_name(camera.camera_id, model, focal, camera.width, camera.height)
            other.has_prior_focal_length = camera.has_prior_focal_length
            database.update_camera(other)


if __name__ == "__main__":
    main()
