"""With --images-on disk, memory does not grow with the number of photos, under either trainer, and no bit changes."""

from __future__ import annotations

import gc
import threading
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from lapgs_plugin.checkouts.level_views import FullSizeImage, SceneImages
from lapgs_plugin.hooks import StageContext, StageHook
from lapgs_plugin.runs.image_store import AHEAD, ImageStore
from lapgs_plugin.scenes import images, load_scene
from lapgs_plugin.scenes.images import read_image
from lapgs_plugin.scenes.scene import View, with_pixels
from lapgs_plugin.training.settings import Densification, TrainSettings
from tests.cli.run_folder import write_scene
from tests.training_runs import plys, train
from tests.training_scene import ring_camera

SIZE = (97, 65)
SETTINGS = TrainSettings(
    iterations=2, levels=2, hierarchy="laplacian", sh_degree=0, densification=Densification(until=0)
)


class Alive(StageHook):
    """Note the most bytes of images at the start of any stage."""

    most = 0

    def before_render(self, context: StageContext) -> None:
        if context.iteration > 1:
            return
        tensors = (each for each in gc.get_objects() if type(each) is torch.Tensor)
        images = {each.data_ptr(): each.nbytes for each in tensors if each.shape[-2:] in ((65, 97), (33, 49))}
        self.most = max(self.most, sum(images.values()))


def masked_scene(folder: Path, photos: int) -> Path:
    scene = write_scene(folder, [f"photos/{i:02d}.png" for i in range(photos)], SIZE)
    mask = np.full(SIZE[::-1], 255, np.uint8)
    mask[:, :20] = 0
    (scene / "masks" / "photos").mkdir(parents=True)
    for i in range(photos):
        Image.fromarray(mask).save(scene / "masks" / "photos" / f"{i:02d}.png")
    return scene


def trained(folder: Path, scene: Path, where: str) -> tuple[int, list[bytes]]:
    """Most bytes of images, and the fields."""
    alive, loaded = Alive(), load_scene(scene, eval=True, progress=False, hold=where != "disk")
    loaded = replace(loaded, points=loaded.points[:200], colors=loaded.colors[:200])
    archive = train(folder, loaded, replace(SETTINGS, images_on=where), user_hooks=[alive])
    return alive.most, plys(archive)


def test_training_holds_no_more_images_of_more_photos(tmp_path: Path) -> None:
    few, many = (masked_scene(tmp_path / str(count), count) for count in (8, 32))
    on_disk = {count: trained(tmp_path / f"{count} disk", scene, "disk") for count, scene in ((8, few), (32, many))}
    in_memory = trained(tmp_path / "memory", many, "memory")
    assert on_disk[32][1] == in_memory[1], "the same bits"
    photo = 3 * 4 * SIZE[0] * SIZE[1]
    assert in_memory[0] > 32 * photo
    assert on_disk[32][0] <= on_disk[8][0] + 2 * photo


def test_photos_at_full_size_stay_in_their_own_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No copy of them is written, the thread that trains decodes none, and no bit changes."""
    scene = write_scene(tmp_path / "scene", [f"photos/{i:02d}.png" for i in range(12)], SIZE)
    written: dict[int, set[str]] = {}
    readers: list[threading.Thread] = []

    class Written(StageHook):
        def before_render(self, context: StageContext) -> None:
            files = (tmp_path / "disk").rglob("*.bin")
            written.setdefault(context.stage.level, set()).update(file.parent.name for file in files)

    def noted(*args: Any, **options: Any) -> torch.Tensor:
        readers.append(threading.current_thread())
        return read_image(*args, **options)

    def fields(where: str) -> list[bytes]:
        loaded = load_scene(scene, progress=False, hold=where != "disk")
        loaded = replace(loaded, points=loaded.points[:200], colors=torch.rand(200, 3))  # photos are compared at points
        settings = replace(SETTINGS, hierarchy="nested", iterations=24, images_on=where)
        return plys(train(tmp_path / where, loaded, settings, user_hooks=[Written()]))

    in_memory = fields("memory")
    monkeypatch.setattr(images, "read_image", noted)
    assert fields("disk") == in_memory
    assert written == {1: {"targets_1"}, 0: set()}
    assert len(readers) >= 3 * 12, "to compare them, for level 1, and whenever a view is trained on at full size"
    assert threading.main_thread() not in readers


def test_files_are_read_several_views_ahead(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, uses = masked_scene(tmp_path / "scene", 16), []
    waiting: set[str] = set()
    prefetch, get = ImageStore.prefetch, ImageStore.get_stored

    def noted_prefetch(self: ImageStore, name: str) -> None:
        waiting.add(name)
        prefetch(self, name)

    def noted_get(self: ImageStore, *names: str) -> torch.Tensor:
        uses.extend((name, frozenset(waiting)) for name in names)
        image = get(self, *names)
        waiting.difference_update(names)
        return image

    loaded = load_scene(scene, masks="none", progress=False, hold=False)  # without masks there is one store
    few = replace(loaded, points=loaded.points[:200], colors=loaded.colors[:200])
    monkeypatch.setattr(ImageStore, "prefetch", noted_prefetch)
    monkeypatch.setattr(ImageStore, "get_stored", noted_get)
    settings = replace(SETTINGS, iterations=AHEAD + 16, levels=1, images_on="disk", views_per_step="1")
    train(tmp_path / "run", few, settings)
    order = [name for name, _ in uses]
    assert len(order) == AHEAD + 16
    for number, (_, asked_for) in enumerate(uses[1:-AHEAD], start=2):  # nothing comes before the first view
        assert {*order[number : number + AHEAD - 2]} - {order[number - 1]} <= asked_for


def test_a_view_of_a_scene_that_holds_no_images_reads_them(tmp_path: Path) -> None:
    path = masked_scene(tmp_path, 4)
    held, read = (load_scene(path, progress=False, hold=hold) for hold in (True, False))
    for view, other in zip(held.train, read.train, strict=True):
        moved = other.at(replace(other.camera, fx=9.0))
        for again in (other, moved):
            assert again.masked
            assert torch.equal(view.image, again.image)
            assert view.mask is not None
            assert again.mask is not None
            assert torch.equal(view.mask, again.mask)
        assert moved.camera.fx == 9.0
        image = weakref.ref(other.image)
        assert image() is None, "kept by nobody"
    assert [view.on_disk for view in held.train] == [False] * 4
    for view, other in zip(held.train, with_pixels(read.train), strict=True):
        assert not other.on_disk
        assert other.image is other.image
        assert torch.equal(view.image, other.image)
    assert list(with_pixels(held.train)) == list(held.train)
    assert not View("a", ring_camera(0.0), torch.zeros(3, *SIZE[::-1])).masked


def test_a_checkouts_photos_and_masks_wait_in_a_file_without_a_name(tmp_path: Path) -> None:
    images = SceneImages()
    images.keep_on_disk(tmp_path)

    class Camera:
        def __init__(self, image: torch.Tensor) -> None:
            self.image_name, self.original_image, self.alpha_mask = "photo", image, torch.ones_like(image[:1])

    Camera.__init__ = images.adopting(Camera.__init__)  # type: ignore[method-assign]
    photos = [torch.randint(0, 256, (3, 5 + i, 7)) / 255 for i in range(5)] + [torch.rand(3, 4, 4).half().float()]
    cameras = [Camera(photo.clone()) for photo in photos]
    stored = [images[images.key(camera)] for camera in cameras]
    for photo, kept in [*zip(photos, stored, strict=True)][::-1]:
        assert isinstance(kept, FullSizeImage)
        assert kept.size == (photo.shape[2], photo.shape[1])
        assert torch.equal(kept.load(torch.device("cpu")), photo)
        image = weakref.ref(kept.stored())
        assert image() is None, "kept by nobody"
    masks = [camera.alpha_mask for camera in cameras]
    assert all(torch.equal(mask, torch.ones_like(photo[:1])) for mask, photo in zip(masks, photos, strict=True))
    assert {mask.untyped_storage().nbytes() for mask in masks} == {4}
    assert [kept.exact for kept in stored] == [True] * 5 + [False]
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("name", ["photos/03.png", "photos"])
def test_photos_may_be_links(tmp_path: Path, name: str) -> None:
    scene = write_scene(tmp_path / "scene")
    expected = load_scene(scene, progress=False)
    (scene / name).rename(tmp_path / "elsewhere")
    (scene / name).symlink_to(tmp_path / "elsewhere")
    read = load_scene(scene, progress=False)
    assert all(torch.equal(a.image, b.image) for a, b in zip(expected.train, read.train, strict=True))
