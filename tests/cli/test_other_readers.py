"""Open exports with other people's readers: splat-transform, the engine of PlayCanvas, Babylon, and Adobe's spz.

They come from npm: make a folder, run `npm install @playcanvas/splat-transform @adobe/spz @babylonjs/core
@babylonjs/loaders node@22` there, and set LAPGS_NPM to it. splat-transform brings the engine; its versions for older
nodes cannot read levels of detail.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.y_up import y_up
from lapgs_plugin.runs.archive import RunArchive
from tests.cli.run_folder import write_run, write_scene
from tests.cli.test_export import lapgs_export

FOLDER = Path(os.environ.get("LAPGS_NPM", "nowhere")).absolute()
MODULES = FOLDER / "node_modules"
pytestmark = [
    pytest.mark.npm,
    pytest.mark.skipif(not MODULES.is_dir(), reason="needs packages of npm in the folder LAPGS_NPM"),
]

READ_SPZ = """
import fs from 'node:fs';
import open from '@adobe/spz';
const spz = await open({ print() {} });
const field = spz.loadSpzFromBuffer(new Uint8Array(fs.readFileSync(process.argv[1])), {
    to: spz.CoordinateSystem.RDF });
const names = ['positions', 'scales', 'rotations', 'alphas', 'colors', 'sh'];
console.log(JSON.stringify(Object.fromEntries(names.map(name => [name, Array.from(field[name])]))));
"""

READ_GLB = """
import fs from 'node:fs';
import * as pc from 'playcanvas';
const canvas = { width: 4, height: 4, style: {}, addEventListener() {}, removeEventListener() {},
    getBoundingClientRect: () => ({ width: 4, height: 4 }) };
const options = new pc.AppOptions();
options.graphicsDevice = new pc.NullGraphicsDevice(canvas);
options.componentSystems = [pc.GSplatComponentSystem];
options.resourceHandlers = [pc.ContainerHandler];
const app = new pc.AppBase(canvas);
app.init(options);
const bytes = fs.readFileSync(process.argv[1]);
const contents = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
const asset = new pc.Asset('field', 'container', { url: 'field.glb', contents });
asset.on('error', (error) => { throw new Error(error); });
asset.ready(() => {
    const [vertices] = asset.resource.gsplats[0].resource.gsplatData.elements;
    const columns = vertices.properties.map(({ name, storage }) => [name, Array.from(storage)]);
    fs.writeSync(1, JSON.stringify(Object.fromEntries(columns)) + '\\n');
    process.exit(0);
});
app.assets.add(asset);
app.assets.load(asset);
"""

READ_GLB_BY_BABYLON = """
import fs from 'node:fs';
import { LoadAssetContainerAsync, NullEngine, Scene, SceneLoader } from '@babylonjs/core/index.js';
import '@babylonjs/loaders/glTF/index.js';
globalThis.Worker = class { postMessage() {} terminate() {} };  // sorts for a camera, which node has no use for
SceneLoader.OnPluginActivatedObservable.add((plugin) => {
    plugin.onMeshLoadedObservable.add((mesh) => { mesh._keepInRam = true; });
});
const bytes = new Uint8Array(fs.readFileSync(process.argv[1]));
const { meshes } = await LoadAssetContainerAsync(bytes, new Scene(new NullEngine()), { pluginExtension: '.glb' });
const [splats] = meshes.filter((mesh) => mesh.getClassName() === 'GaussianSplattingMesh');
const rows = { bytes: Array.from(new Uint8Array(splats.splatsData)), degree: splats.shDegree };
fs.writeSync(1, JSON.stringify(rows) + '\\n');
process.exit(0);
"""


def node(*arguments: object) -> str:
    """Run node in the folder of the packages and return what it prints."""
    own = MODULES / "node" / "bin" / "node"
    program = str(own) if own.is_file() else shutil.which("node") or pytest.skip("needs node")
    command = [program, *map(str, arguments)]
    return subprocess.run(command, cwd=FOLDER, check=True, capture_output=True, text=True, timeout=120).stdout


def columns(script: str, path: Path) -> dict[str, Any]:
    printed = node("--input-type=module", "-e", script, path)
    (line,) = [line for line in printed.splitlines() if line.startswith("{")]
    return {name: np.array(values) for name, values in json.loads(line).items()}


def transformed(source: Path, target: Path, *options: object) -> GaussianField:
    """Return what splat-transform reads from a file."""
    node(MODULES / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs", "-q", "-w", *options, source, target)
    return GaussianField.load_ply(target)


@pytest.fixture
def exported(tmp_path: Path) -> Path:
    run = write_run(tmp_path / "run", write_scene(tmp_path / "scene"), nested=True)
    lapgs_export(run, "--lod")
    return run


@pytest.mark.parametrize("level", [0, 1])
def test_splat_transform_reads_each_streamed_level(exported: Path, level: int, tmp_path: Path) -> None:
    field = RunArchive.open(exported).field(level)
    lod = exported / "export" / "lod" / "lod-meta.json"
    read = transformed(lod, tmp_path / "level.ply", "--select-lod", level)
    assert len(read) == len(field)
    nearest = torch.cdist(field.means, read.means).argmin(dim=1)
    assert len(nearest.unique()) == len(field)
    theirs = read.kept(nearest)
    torch.testing.assert_close(theirs.means, field.means, atol=3e-4, rtol=0)  # 5e-5 seen
    torch.testing.assert_close(theirs.log_scales, field.log_scales, atol=0.1, rtol=0)  # 0.024 seen
    torch.testing.assert_close(theirs.sh, field.sh, atol=0.1, rtol=0)  # 0.026 seen


def test_splat_transform_and_adobe_read_spz_4(exported: Path, tmp_path: Path) -> None:
    field, path = RunArchive.open(exported).field(0), exported / "export" / "lod" / "level_0.spz"
    read = y_up(transformed(path, tmp_path / "level.ply"))  # which leaves the axes as they are
    torch.testing.assert_close(read.means, field.means, atol=2e-6, rtol=0)
    torch.testing.assert_close(read.log_scales, field.log_scales, atol=0.032, rtol=0)
    adobe = columns(READ_SPZ, path)
    np.testing.assert_allclose(adobe["positions"].reshape(-1, 3), field.means.numpy(), atol=2e-6)
    np.testing.assert_allclose(adobe["scales"].reshape(-1, 3), field.log_scales.numpy(), atol=0.032)
    quaternions = torch.nn.functional.normalize(field.quaternions, dim=1).numpy()[:, [1, 2, 3, 0]]
    cosines = np.abs((adobe["rotations"].reshape(-1, 4) * quaternions).sum(1))
    assert cosines.min() > 0.9999  # 0.999999 seen


def test_the_engine_of_playcanvas_reads_gltf(exported: Path) -> None:
    field = y_up(RunArchive.open(exported).field(1))
    read = columns(READ_GLB, exported / "export" / "lod" / "level_1.glb")
    # The engine sorts Gaussians for its memory.
    engine = torch.tensor(np.stack([read[axis] for axis in "xyz"], axis=1)).float()
    nearest = torch.cdist(field.means, engine).argmin(dim=1).numpy()
    assert len(set(nearest.tolist())) == len(field)
    np.testing.assert_allclose(engine.numpy()[nearest], field.means.numpy(), atol=1e-6)
    np.testing.assert_allclose(read["f_dc_1"][nearest], field.sh[:, 0, 1].numpy(), atol=1e-6)
    assert np.isfinite(read["opacity"]).all()


def test_babylon_reads_gltf(exported: Path) -> None:
    if not (MODULES / "@babylonjs" / "loaders").is_dir():
        pytest.skip("needs @babylonjs/core and @babylonjs/loaders in the folder LAPGS_NPM")
    field = y_up(RunArchive.open(exported).field(0))
    read = columns(READ_GLB_BY_BABYLON, exported / "export" / "lod" / "level_0.glb")
    # A row is that of a .splat file: means and scales as float32, colours and opacity, quaternion w, x, y, z as bytes.
    rows = read["bytes"].astype(np.uint8).reshape(len(field), 32)
    geometry = rows[:, :24].copy().view(np.float32)
    np.testing.assert_array_equal(geometry[:, :3], field.means.numpy())
    np.testing.assert_allclose(geometry[:, 3:], field.log_scales.exp().numpy(), rtol=1e-6)
    assert int(read["degree"]) == field.sh_degree
    shown = (field.sh[:, 0] * 0.28209479177387814 + 0.5).clamp(0, 1).numpy() * 255
    np.testing.assert_allclose(rows[:, 24:27], shown, atol=0.51)
    quaternions = torch.nn.functional.normalize(field.quaternions, dim=1).numpy()
    np.testing.assert_allclose(rows[:, 28:], quaternions * 127.5 + 127.5, atol=0.51)
