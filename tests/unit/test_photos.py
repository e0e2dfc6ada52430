"""Photos and videos as people have them: HEIC, masks, EXIF, several cameras, clips; and what goes wrong with them."""

from __future__ import annotations

import io
import logging
import os
import re
import shutil
import sqlite3
import struct
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import imageio_ffmpeg
import numpy as np
import pillow_heif
import pycolmap
import pytest
import torch
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from lapgs_plugin.errors import LapgsError, MissingExtraError, SceneError, UserInputError
from lapgs_plugin.scenes import load_scene
from lapgs_plugin.scenes.images import write_image
from lapgs_plugin.scenes.prepare import left_out, pipeline
from lapgs_plugin.scenes.prepare import photos as photos_module
from lapgs_plugin.scenes.prepare.clip import judge, pick_frames, sharp_and_moving, write_frames
from lapgs_plugin.scenes.prepare.colmap import HAS_GLOBAL, chosen_matcher
from lapgs_plugin.scenes.prepare.colmap_worker import __main__ as colmap_worker
from lapgs_plugin.scenes.prepare.inputs import camera_mode
from lapgs_plugin.scenes.prepare.job import Job
from lapgs_plugin.scenes.prepare.left_out import few_points, left_out_because
from lapgs_plugin.scenes.prepare.photos import Photos, find_photos
from lapgs_plugin.scenes.prepare.pipeline import PrepareResult, prepare_scene
from lapgs_plugin.scenes.prepare.settings import PrepareSettings
from lapgs_plugin.scenes.prepare.writing import write_scene
from lapgs_plugin.scenes.sample.raycast import render
from tests.refusals import refuses
from tests.unit.test_prepare import FOCAL, SIZE, WORLD, _arc, _centre_errors

ORIENTATION, UPSIDE_DOWN = 274, 3
RANDOM = np.random.default_rng(0)
WALL = np.kron(RANDOM.integers(0, 255, (12, 60, 3)), np.ones((8, 8, 1))).astype(np.uint8)  # (96, 480, 3)


def _pixels(index: int) -> NDArray[np.uint8]:
    return np.rint(render(WORLD, _arc(SIZE, FOCAL)[index]).clip(0, 1) * 255).astype(np.uint8)


def test_photos_of_a_phone_become_a_scene(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """One in HEIC, one upside down by EXIF, two of fog, masks over a third of each, pairs by retrieval, all at once."""
    photos, masks = tmp_path / "photos", tmp_path / "masks"
    photos.mkdir()
    hidden = np.zeros((SIZE[1], SIZE[0], 3), np.float32)
    hidden[:, SIZE[0] // 3 :] = 1
    for index in range(4):
        picture, mask = Image.fromarray(_pixels(index)), hidden
        if index == 1:
            pillow_heif.register_heif_opener()
            picture.save(photos / "01.heic", quality=95)
        elif index == 2:
            exif = Image.Exif()
            exif[ORIENTATION] = UPSIDE_DOWN
            picture.rotate(180).save(photos / "02.jpg", quality=98, subsampling=0, exif=exif)
            mask = hidden[::-1, ::-1]
        else:
            picture.save(photos / f"{index:02d}.png")
        name = "01.HEIC.png" if index == 1 else f"{index:02d}_mask.png"
        write_image(masks / name, torch.from_numpy(mask.copy()).permute(2, 0, 1))
    for name in ("fog.png", "more/fog.jpg"):
        write_image(photos / name, torch.full((3, SIZE[1], SIZE[0]), 0.7))
        write_image(masks / name, torch.from_numpy(hidden).permute(2, 0, 1))
    (photos / "._00.png").write_bytes(b"what some file managers leave")
    out = tmp_path / "scene"
    with caplog.at_level(logging.WARNING):
        result = make_scene(photos, out, matcher="retrieval", masks=masks)
    assert result.left_out == ("fog.png", "more/fog.jpg")
    assert "2 of 6 photos could not be placed: fog.png, more/fog.jpg" in caplog.text
    assert len(result.registered) == 4
    assert [title for title in result.seconds if title.startswith(("Matching", "Placing"))] == [
        *("Matching pairs", "Placing cameras", "Placing again", "Matching more", "Placing (incremental)"),
        *(["Placing (global)"] if HAS_GLOBAL else []),
    ]
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    assert _centre_errors(model).max() < 0.02  # seen 7.4e-4
    scene = load_scene(out, progress=False)
    by_name = {view.name: view for view in scene.train}
    assert sorted(by_name) == ["00.png", "01.jpg", "02.jpg", "03.png"]
    assert sorted(file.name for file in (out / "masks").iterdir()) == [f"{name}.png" for name in sorted(by_name)]
    for image in model.images.values():
        inside = by_name[image.name].mask
        assert inside is not None
        columns, rows = np.array([point.xy for point in image.points2D]).T.astype(int)
        far_inside = cv2.dilate(inside[0].numpy().astype(np.uint8), np.ones((7, 7)))  # masks are undistorted, too
        assert far_inside[rows.clip(0, far_inside.shape[0] - 1), columns.clip(0, far_inside.shape[1] - 1)].all()
    assert by_name["02.jpg"].mask is not None
    assert bool(by_name["02.jpg"].mask[0, :, 5].all())  # stored pixels, as COLMAP and trainers read them
    assert not bool(by_name["00.png"].mask[0, :, 5].any())


@pytest.mark.parametrize("orientation", [1, 3, 6, 8, 5])
def test_a_scene_is_turned_as_exif_says_of_most_photos(tmp_path: Path, orientation: int) -> None:
    """Pillow turns the photos, and pycolmap projects points into the turned images where their features are."""
    photos, model = tmp_path / "photos", pycolmap.Reconstruction()
    photos.mkdir()
    lens = pycolmap.Camera(camera_id=1, model="PINHOLE", width=96, height=64, params=[80, 70, 45, 33])
    model.add_camera_with_trivial_rig(lens)
    points = RANDOM.uniform(-1, 1, (20, 3))
    for index in range(3):
        exif = Image.Exif()
        exif[ORIENTATION] = orientation if index else 1
        Image.fromarray(WALL[:64, 9 * index : 9 * index + 96]).save(photos / f"{index}.png", exif=exif)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, 0.2 * index, 0.3])), np.array([0.1 * index, 0, 5]))
        features = [pycolmap.Point2D(lens.img_from_cam(pose * point)) for point in points]
        image = pycolmap.Image(name=f"{index}.png", points2D=features, camera_id=1, image_id=index + 1)
        model.add_image_with_trivial_frame(image, pose)
    files = {f"{index}.png": photos / f"{index}.png" for index in range(3)}
    job = Job(tmp_path / "work", Photos(photos, files), PrepareSettings(), progress=False)
    write_scene(job, model)
    written = pycolmap.Reconstruction(job.scene / "sparse" / "0")
    for image in written.images.values():
        with Image.open(photos / image.name) as stored, Image.open(job.scene / "images" / image.name) as whole:
            upright = ImageOps.exif_transpose(stored) if orientation != 5 else stored  # mirrored: left as it is
            assert whole.size == (image.camera.width, image.camera.height)
            if image.name != "0.png":
                assert np.abs(np.asarray(whole, np.int16) - np.asarray(upright)).max() <= 1
        for point, feature in zip(points, image.points2D, strict=True):
            assert np.abs(image.project_point(point) - feature.xy).max() < 1e-9  # seen 6e-14


def test_transparent_pixels_are_masks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    alpha = np.zeros((64, 96, 1), np.uint8)
    alpha[10:50, 20:70] = 255
    for index in range(3):
        pixels = WALL[:64, 4 * index : 4 * index + 96]
        cv2.imwrite(str(photos / f"{index}.png"), pixels if index == 2 else np.concatenate([pixels, alpha], axis=2))
    _stopping_before_colmap(photos, tmp_path / "scene", monkeypatch)
    masks = tmp_path / "scene" / ".prepare" / "masks"
    for index in range(3):  # COLMAP leaves out photos without a mask
        expected = np.full_like(alpha, 255) if index == 2 else alpha
        assert np.array_equal(cv2.imread(str(masks / f"{index}.png.png"))[..., :1], expected)


def _stopping_before_colmap(photos: Path, out: Path, monkeypatch: pytest.MonkeyPatch, **options: Any) -> None:
    def stop(*arguments: object) -> None:
        raise LapgsError("stopped")

    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "find_features", stop)
        refuses(LapgsError, "stopped", prepare_scene, photos, out, PrepareSettings(**options), progress=False)


def _write_clip(path: Path, frames: list[NDArray[np.uint8]], *options: str) -> Path:
    height, width = frames[0].shape[:2]
    writer = imageio_ffmpeg.write_frames(
        str(path), (width, height), fps=10, quality=10, macro_block_size=1, output_params=list(options)
    )
    writer.send(None)
    for frame in frames:
        writer.send(np.ascontiguousarray(frame).tobytes())
    writer.close()
    return path


def _blurred(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return cv2.GaussianBlur(frame, (0, 0), 2.0).astype(np.uint8)


def make_scene(photos: Path, out: Path, **options: Any) -> PrepareResult:
    return prepare_scene(photos, out, PrepareSettings(**options), progress=False)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """24 frames along a wall, of which every fourth is sharp."""
    frames = [WALL[:64, 6 * index : 6 * index + 96] for index in range(24)]
    blurred = [frame if index % 4 == 2 else _blurred(frame) for index, frame in enumerate(frames)]
    return _write_clip(tmp_path_factory.mktemp("clip") / "walk.mp4", blurred)


def test_sharp_frames_are_picked_evenly_and_written(clip: Path, tmp_path: Path) -> None:
    assert pick_frames(clip, 6, lambda done, total: None) == [2, 6, 10, 14, 18, 22]
    write_frames(clip, [2, 10], tmp_path, lambda done, total: None)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["frame_000002.jpg", "frame_000010.jpg"]
    written = cv2.imread(str(tmp_path / "frame_000010.jpg"))[..., ::-1].astype(np.float64)
    error = {number: np.abs(written - WALL[:64, 6 * number : 6 * number + 96]).mean() for number in (8, 10, 12)}
    assert min(error, key=error.__getitem__) == 10


def test_hdr_videos_of_phones_are_read(tmp_path: Path) -> None:
    path, frames = tmp_path / "hdr.mov", [WALL[:64, 12 * index : 12 * index + 96] for index in range(4)]
    writer = imageio_ffmpeg.write_frames(
        str(path), (96, 64), fps=10, quality=10, macro_block_size=1, pix_fmt_out="yuv420p10le"
    )
    writer.send(None)
    for frame in frames:
        writer.send(np.ascontiguousarray(frame).tobytes())
    writer.close()
    assert pick_frames(path, 4, lambda done, total: None) == [0, 1, 2, 3]
    write_frames(path, [0, 3], tmp_path, lambda done, total: None)
    written = cv2.imread(str(tmp_path / "frame_000003.jpg"))[..., ::-1].astype(np.float64)
    errors = [np.abs(written - frame).mean() for frame in frames]
    assert errors[3] < 20 < min(errors[:3])  # seen 5.9, and 82.7 of other frames


@pytest.mark.parametrize(("pixel", "width"), [("3/8", 36), ("4/3", 128), ("1/1", 96)])
def test_frames_get_square_pixels(tmp_path: Path, pixel: str, width: int) -> None:
    frames = [WALL[:64, 12 * index : 12 * index + 96] for index in range(4)]
    video = _write_clip(tmp_path / "phone.mp4", frames, "-vf", f"setsar={pixel}")
    assert len(pick_frames(video, 4, lambda done, total: None)) == 4
    write_frames(video, [3], tmp_path, lambda done, total: None)
    written = cv2.imread(str(tmp_path / "frame_000003.jpg"))[..., ::-1].astype(np.float64)
    assert written.shape == (64, width, 3)
    expected = cv2.resize(frames[3], (width, 64), interpolation=cv2.INTER_AREA)
    assert np.abs(written - expected).mean() < 30  # seen 15.6, and 79.8 of other frames


def test_a_clip_whose_size_changes_is_one_line_and_its_parts_are_read(tmp_path: Path) -> None:
    """Parts of MPEG transport streams make a stream when one is put behind the other."""
    frames = [WALL[:64, 12 * index : 12 * index + 96] for index in range(6)]
    parts = [
        _write_clip(tmp_path / "wide.ts", frames),
        _write_clip(tmp_path / "tall.ts", [np.rot90(frame) for frame in frames]),
    ]
    both = tmp_path / "both.ts"
    both.write_bytes(b"".join(part.read_bytes() for part in parts))
    with pytest.raises(
        SceneError, match=r"both\.ts: .* changes from 96x64 to 64x96 pixels, expected one size"
    ) as caught:
        make_scene(both, tmp_path / "scene")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "scene").exists()
    for part in parts:  # as the message advises
        assert len(pick_frames(part, 3, lambda done, total: None)) == 3


def test_frames_where_the_camera_stands_still_are_left_out() -> None:
    moving = [judge(WALL[:64, 8 * step : 8 * step + 96, 0]) for step in (0, 0, 0, 0, 1, 2, 3, 3)]
    assert sharp_and_moving(moving, 8) == [0, 4, 5, 6]


def test_a_video_gives_its_frames_to_colmap(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO):
        _stopping_before_colmap(clip, tmp_path / "scene", monkeypatch, frames=6)
    assert "walk.mp4: 6 sharp frames, evenly spread" in caplog.text
    copies = tmp_path / "scene" / ".prepare" / "photos"
    assert [file.name for file in sorted(copies.iterdir())] == [f"frame_{number:06d}.jpg" for number in range(2, 24, 4)]
    job = Job(copies.parent, find_photos(clip), PrepareSettings(), False)
    assert (chosen_matcher(job), len(job.names)) == ("sequential", 6)


def test_videos_that_cannot_be_used_are_one_line(clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(kind: type[Exception], message: str, video: Path, **options: Any) -> None:
        with pytest.raises(kind, match=message) as caught:
            make_scene(video, tmp_path / "scene", **options)
        assert "\n" not in str(caught.value)
        assert not (tmp_path / "scene").exists()

    still = _write_clip(tmp_path / "still.mp4", [WALL[:64, :96]] * 12)
    refused(SceneError, r"still\.mp4: 12 frames show the same view, expected a camera that moves", still)
    (tmp_path / "no.mp4").write_bytes(b"no clip" * 50)
    refused(SceneError, r"no\.mp4: the video cannot be decoded", tmp_path / "no.mp4")
    (tmp_path / "cut.mp4").write_bytes(clip.read_bytes()[:1000])
    refused(SceneError, r"cut\.mp4: the video cannot be decoded", tmp_path / "cut.mp4")
    refused(UserInputError, "--frames 1: expected at least 2", clip, frames=1)
    photos = tmp_path / "photos"
    for index in range(2):
        write_image(photos / f"{index}.png", torch.ones(3, 64, 80))
    refused(UserInputError, "--frames 9: it picks frames from a video, and .* is a folder", photos, frames=9)
    refused(SceneError, r"0\.png: one photo, expected a folder", photos / "0.png")
    monkeypatch.setattr("lapgs_plugin.errors.find_spec", lambda name: None)
    refused(MissingExtraError, r"needs imageio-ffmpeg: pip install 'lapgs_plugin\[video\]'", clip)


@pytest.fixture
def noise(tmp_path: Path) -> Path:
    folder = tmp_path / "noise"
    for index in range(3):
        write_image(folder / f"{index}.jpg", torch.from_numpy(RANDOM.random((3, 64, 80), dtype=np.float32)))
    return folder


def test_heic_without_its_library_is_named(noise: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pillow_heif.register_heif_opener()
    (noise / "IMG_1.HEIC").write_bytes(b"damaged")
    refuses(SceneError, r"IMG_1\.HEIC: the photo cannot be decoded", make_scene, noise, tmp_path / "scene")
    assert not (tmp_path / "scene").exists()
    Image.fromarray(WALL[:64, :96]).save(noise / "IMG_1.HEIC", "HEIF")
    shutil.copy(noise / "IMG_1.HEIC", noise / "0.jpg")
    assert find_photos(noise).converted == ("0.jpg", "IMG_1.jpg")
    shutil.copy(noise / "1.jpg", noise / "0.jpg")
    (noise / "2.jpg").write_bytes(b"")  # beside HEIC photos a copy is read, which is not the user's file
    with pytest.raises(SceneError, match=rf"^{re.escape(str(noise / '2.jpg'))}: not a readable image"):
        make_scene(noise, tmp_path / "scene")
    monkeypatch.setattr("lapgs_plugin.errors.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"1 HEIC photo \(IMG_1\.HEIC\) needs pillow-heif: pip install"):
        make_scene(noise, tmp_path / "scene")
    shutil.copy(noise / "0.jpg", noise / "IMG_1.jpg")
    monkeypatch.undo()
    refuses(SceneError, r"IMG_1\.HEIC and IMG_1\.jpg would both become IMG_1\.jpg", find_photos, noise)


def test_damaged_photos_are_listed_together(noise: Path, tmp_path: Path) -> None:
    for index in range(12):
        (noise / f"bad{index:02}.jpg").write_bytes(b"")
    with pytest.raises(SceneError) as caught:
        make_scene(noise, tmp_path / "scene")
    message = str(caught.value)
    assert message.startswith("12 of 15 photos cannot be used: bad00.jpg, bad01.jpg, ")
    assert "bad09.jpg and 2 more; the first: " in message
    assert f"{noise / 'bad00.jpg'}: not a readable image" in message
    assert not (tmp_path / "scene").exists()


@pytest.mark.parametrize("beside_webp", [False, True])
def test_a_photo_without_permission_is_said_so(
    beside_webp: bool, noise: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if beside_webp:  # the others are copied
        Image.fromarray(WALL[:64, :96]).save(noise / "3.webp")
    allowed = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "1.jpg" and allowed(path, mode))  # for root
    with pytest.raises(SceneError, match=rf"^{re.escape(str(noise / '1.jpg'))}: no permission to read it; "):
        make_scene(noise, tmp_path / "scene")


def test_webp_photos_become_jpeg_files_which_colmap_reads(
    tmp_path: Path, noise: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Image.fromarray(WALL[:64, :96]).save(noise / "3.jpg", "WEBP", quality=95)  # as browsers save some
    _stopping_before_colmap(noise, tmp_path / "scene", monkeypatch)
    photo = tmp_path / "scene" / ".prepare" / "photos" / "3.jpg"
    read = pycolmap.Bitmap.read(str(photo), as_rgb=True)
    assert np.abs(read.to_array().astype(np.float64) - WALL[:64, :96]).mean() < 16  # seen 8.4
    with pytest.raises(SceneError, match=r"--masks .*: 0\.jpg is the photo itself"):  # not the copy that COLMAP gets
        make_scene(noise, tmp_path / "other", masks=noise)
    Image.new("RGBA", (96, 64), (9, 9, 9, 0)).save(noise / "4.webp")
    with pytest.raises(SceneError, match=r"4\.webp: a WebP photo with transparency"):
        photos_module.convert_photo(noise / "4.webp", tmp_path / "4.jpg")


def _damaged_photo(kind: str, how: str) -> bytes:
    """A photo that is cut short, whose pixels are zeros, or whose header says more pixels than any camera has."""
    file = io.BytesIO()
    Image.fromarray(WALL[:64, :96]).save(file, kind)
    content = bytearray(file.getvalue())
    if how.startswith("cut"):
        return bytes(content[: int(len(content) * float(how[3:]))])
    if how == "zeros":  # of a copy that was interrupted
        pixels = content.index(b"mdat" if kind == "HEIF" else b"VP8") + 4
        return bytes(content[:pixels] + bytes(len(content) - pixels))
    if kind == "HEIF":
        for box in re.finditer(b"ispe", bytes(content)):
            content[box.end() + 4 : box.end() + 12] = struct.pack(">II", 60_000, 60_000)
        return bytes(content)
    canvas = bytes(4) + (59_999).to_bytes(3, "little") * 2
    chunks = b"WEBPVP8X" + struct.pack("<I", len(canvas)) + canvas + content[12:]
    return b"RIFF" + struct.pack("<I", len(chunks)) + chunks


@pytest.mark.parametrize("how", ["cut0.1", "cut0.5", "cut0.95", "zeros", "bomb"])
@pytest.mark.parametrize("kind", ["HEIF", "WEBP"])
def test_a_damaged_heic_or_webp_photo_is_one_line(kind: str, how: str, noise: Path, tmp_path: Path) -> None:
    pillow_heif.register_heif_opener()
    (noise / "bad.jpg").write_bytes(_damaged_photo(kind, how))  # as messengers name them
    why = "the photo cannot be decoded "
    if how == "bomb":  # libwebp takes memory for it, if there is any
        why = f"(the image is 60000x60000 pixels, expected at most{'|' + why if kind == 'WEBP' else ''})"
    line = refuses(SceneError, rf"^{re.escape(str(noise / 'bad.jpg'))}: {why}", make_scene, noise, tmp_path / "scene")
    assert r"\n" not in line
    assert not (tmp_path / "scene").exists()


def test_files_that_are_no_photos_are_named(noise: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("a.dng", "b.mov", ".c.jpg", ".thumbnails/0.jpg"):
        (noise / name).parent.mkdir(exist_ok=True)
        (noise / name).write_bytes(b"\0\0\0 ftypqt  ")
    assert list(find_photos(noise).files) == ["0.jpg", "1.jpg", "2.jpg"]
    assert "not photos, left out: a.dng, b.mov" in caplog.text
    (noise / "gone.jpg").symlink_to("elsewhere/gone.jpg")
    (noise / "loop.png").symlink_to("loop.png")
    os.mkfifo(noise / "pipe.heic")
    assert list(find_photos(noise).files) == ["0.jpg", "1.jpg", "2.jpg"]
    assert "links that lead nowhere, pipes or devices, left out: gone.jpg, loop.png, pipe.heic" in caplog.text
    with pytest.raises(SceneError, match=r"pipe\.heic: a pipe, socket or device; give a folder of photos, or a video"):
        find_photos(noise / "pipe.heic")


def test_photos_of_several_cameras_get_cameras_of_their_own(
    noise: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name, model in (("0.jpg", "One"), ("1.jpg", "One"), ("2.jpg", "Two")):
        exif = Image.Exif()
        exif[ExifTags.Base.Model] = model
        with Image.open(noise / name) as picture:
            picture.load()
        picture.save(noise / name, exif=exif)
    job = Job(tmp_path, find_photos(noise), PrepareSettings(), False)
    sizes = dict.fromkeys(job.names, (80, 64))
    with caplog.at_level(logging.INFO):
        assert camera_mode(job, sizes) == "AUTO"
    assert "photos of 2 cameras or sizes: 2 of 80x64 One; 1 of 80x64 Two" in caplog.text
    for asked, mode in (("one", "SINGLE"), ("folder", "PER_FOLDER"), ("image", "PER_IMAGE")):
        assert camera_mode(replace(job, settings=PrepareSettings(camera_per=asked)), sizes) == mode
    assert camera_mode(job, dict.fromkeys(("0.jpg", "1.jpg"), (80, 64))) == "SINGLE"
    mixed, per_folder = {"a/0.jpg": (80, 64), "a/1.jpg": (60, 40)}, PrepareSettings(camera_per="folder")
    line = "--camera-per folder: .*a/0.jpg has 80x64 pixels and .*a/1.jpg 60x40, expected one size"
    refuses(UserInputError, line, camera_mode, replace(job, settings=per_folder), mixed)
    apart = {"a/0.jpg": (80, 64), "b/1.jpg": (60, 40)}
    assert camera_mode(replace(job, settings=per_folder), apart) == "PER_FOLDER"


def test_masks_that_do_not_fit_photos_are_one_line(noise: Path, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    for index in range(2):
        write_image(masks / f"{index}.png", torch.ones(3, 64, 80))

    def refused(message: str) -> None:
        refuses(SceneError, message, make_scene, noise, tmp_path / "scene", masks=masks)
        assert not (tmp_path / "scene").exists()

    with pytest.raises(UserInputError, match=r"--masks .*nowhere: no such folder of masks"):
        make_scene(noise, tmp_path / "scene", masks=tmp_path / "nowhere")
    with pytest.raises(SceneError, match=r"--masks .*: 0\.jpg is the photo itself, expected its mask"):
        make_scene(noise, tmp_path / "scene", masks=noise)
    assert not (tmp_path / "scene").exists()
    shutil.copytree(masks, noise / "masks")
    assert list(find_photos(noise, noise / "masks").files) == ["0.jpg", "1.jpg", "2.jpg"]
    assert len(find_photos(noise, noise).files) == 5
    shutil.rmtree(noise / "masks")
    refused(r"1 of 3 photos have no mask, the first is 2\.jpg; expected 2\.jpg\.png, 2\.png or 2_mask\.png")
    write_image(masks / "2.png", torch.ones(3, 80, 64))
    refused(r"2\.png: the mask is 64x80 pixels, its photo 80x64 \(EXIF turns .*\); expected the same size")


def test_cameras_of_a_database_get_one_focal_length(tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    with pycolmap.Database.open(path) as database:
        camera = pycolmap.Camera(
            model="OPENCV", width=80, height=64, params=[90, 110, 40, 32, 0.1, 0, 0, 0], camera_id=1
        )
        database.write_camera(camera, use_camera_id=True)
    colmap_worker.replace_cameras(str(path), "RADIAL")
    with pycolmap.Database.open(path) as database:
        (camera,) = database.read_all_cameras()
    assert (camera.camera_id, camera.model.name, camera.width, camera.height) == (1, "RADIAL", 80, 64)
    assert camera.params.tolist() == [100, 40, 32, 0, 0]


def test_reasons_for_photos_without_a_place(tmp_path: Path) -> None:
    names = ["placed.jpg", "blurred.jpg", "alone.jpg", "mirror.jpg", "other_room.jpg"]
    with sqlite3.connect(tmp_path / "a.db") as database:
        database.execute("CREATE TABLE images (image_id, name)")
        database.execute("CREATE TABLE keypoints (image_id, rows)")
        database.execute("CREATE TABLE two_view_geometries (pair_id, rows)")
        for key, name in enumerate(names, start=1):
            database.execute("INSERT INTO images VALUES (?, ?)", (key, name))
            database.execute("INSERT INTO keypoints VALUES (?, ?)", (key, 20 if name == "blurred.jpg" else 900))
        for one, other, rows in ((1, 2, 50), (1, 3, 3), (1, 4, 60)):
            pair = pycolmap.image_pair_to_pair_id(one, other)
            database.execute("INSERT INTO two_view_geometries VALUES (?, ?)", (pair, rows))
    database.close()
    models = [SimpleNamespace(images={key: SimpleNamespace(has_pose=True)}) for key in (1, 5)]
    assert left_out_because(tmp_path / "a.db", models, names[1:]) == {
        left_out.BLURRED: ["blurred.jpg"],
        left_out.ALONE: ["alone.jpg"],
        left_out.UNSURE: ["mirror.jpg"],
        left_out.APART: ["other_room.jpg"],
    }


def test_cameras_that_rest_on_few_points_are_told() -> None:
    assert few_points(557, 29).startswith(
        "557 points for 29 photos, so few that cameras may be wrong"
    )  # a museum piece
    assert not few_points(12540, 50)  # fox


def test_many_photos_are_matched_by_retrieval(tmp_path: Path) -> None:
    for count, matcher in ((500, "exhaustive"), (501, "retrieval")):
        listed = photos_module.Photos(tmp_path, {f"{index}.jpg": tmp_path for index in range(count)})
        assert chosen_matcher(Job(tmp_path, listed, PrepareSettings(), False)) == matcher
