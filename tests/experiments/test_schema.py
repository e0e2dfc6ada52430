"""Test that experiment files are read as written, and that every mistake is one line that names it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lapgs_bench.experiments.aggregate import check_table
from lapgs_bench.experiments.expansion import plan_runs
from lapgs_bench.experiments.run import option_names
from lapgs_bench.experiments.schema import load_experiment
from lapgs_bench.experiments.settings import Selection
from lapgs_bench.experiments.standard import EXPERIMENTS
from lapgs_plugin.errors import UserInputError

GOOD = """
name = "x"
title = "X"
[[scenes]]
name = "a"
path = "a"
[backbones.cpu]
rasterizer = "cpu"
[backbones.fast]
checkout = "fastgs"
[[variants]]
name = "one"
options = { levels = 1 }
"""


def load(tmp_path: Path, text: str) -> Any:
    path = tmp_path / "x.toml"
    path.write_text(text)
    return load_experiment(path, option_names())


def test_defaults_are_those_of_the_paper(tmp_path: Path) -> None:
    experiment = load(tmp_path, GOOD)
    assert (experiment.iterations, experiment.seeds) == (30_000, [0])
    assert experiment.table.columns == ["minutes", "psnr", "ssim", "lpips", "gaussians_millions", "fps"]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('title = "X"', 'titel = "X"', ("unknown key titel", "did you mean title?")),
        ("options = {", "option = {", ("variants.0.option", "did you mean options?")),
        ('rasterizer = "cpu"', 'rasteriser = "cpu"', ("backbones.cpu.rasteriser", "did you mean rasterizer?")),
        ("levels = 1", "levles = 1", ("levles", "lapgs train", "did you mean levels?")),
        ("levels = 1", "fused_adam = true", ("fused_adam", "lapgs train")),
        ("levels = 1", "seed = 1", ("sets seed", "the experiment sets itself")),
        ("levels = 1", "eval = false", ("sets eval", "the experiment sets itself")),
        ("levels = 1", 'config = "run.toml"', ("sets config", "the experiment sets itself")),
        ('title = "X"', 'title = "X"\niterations = "many"', ("iterations", "'many'", "integer")),
        ('title = "X"', 'title = "X"\niterations = 0', ("iterations", "greater than or equal to 1")),
        ('title = "X"', 'title = "X"\nseeds = []', ("seeds",)),
        ('checkout = "fastgs"', 'checkout = "fastgs"\nscript = "../train.py"', ("backbones.fast.script", "pattern")),
        ('rasterizer = "cpu"', 'rasterizer = "cpu"\nscript = "ms/train.py"', ("script is for a checkout",)),
        ('title = "X"', "", ("title is missing",)),
        ('path = "a"', 'path = "a"\ndataset = "mipnerf360"', ("either dataset or name",)),
        ('name = "a"\npath = "a"', 'dataset = "mipnerf"', ("'mipnerf' is not known", "mipnerf360")),
        ('name = "a"\npath = "a"', 'dataset = "mipnerf360"\nonly = ["gardn"]', ("gardn", "garden")),
        ('checkout = "fastgs"', 'checkout = "fastgs"\npreset = "fastgs.huge"', ("fastgs.huge", "fastgs.big")),
        ('name = "one"', 'name = "one"\npreset = { fast = "fastgs.huge" }', ("fastgs.huge", "fastgs.ours")),
        ('name = "one"', 'name = "one"\npreset = { slow = "fastgs.ours" }', ("backbone 'slow'", "cpu, fast")),
        ('name = "one"', 'name = "one"\npreset = { cpu = "fastgs.ours" }', ("preset for cpu", "leave it out")),
        ('checkout = "fastgs"', "", ("either rasterizer", "checkout")),
        ('name = "one"', 'name = "one"\nbackbones = ["slow"]', ("backbone 'slow'", "cpu, fast")),
        ('name = "one"', 'name = "one"\nmethod = "naked"', ("method", "'naked'")),
        ("levels = 1 }", 'levels = 1 }\n[[variants]]\nname = "one"', ("two variants are called 'one'",)),
        ('name = "x"', 'name = "x y"', ("name", "'x y'")),
        ('name = "one"', r'name = "o\nne"', ("variants.0.name", r"'o\nne'")),
        ('name = "one"', 'name = ""', ("variants.0.name", "at least 1 character")),
        ('title = "X"', r'title = "X\ty"', ("title", r"'X\ty'")),
        ("[[variants]]", '[[scenes]]\nname = "a"\n[[variants]]', ("scene 'a' is listed twice",)),
        ('name = "one"', 'name = "one"\nmethod = "bare"', ("bare, which is one level; leave levels out",)),
        (
            'name = "one"\noptions = { levels = 1 }',
            'name = "one"\nmethod = "bare"\nbackbones = ["fast"]\noptions = { inherit = "xyz" }',
            ("options of `lapgs run` have no effect",),
        ),
        ('name = "one"', 'name = "one"\nbackbones = ["cpu"]\narguments = ["-x"]', ("no checkout whose script",)),
        ('name = "x"', "name = x", ("is not TOML",)),
    ],
)
def test_a_mistake_is_one_line_that_names_it(tmp_path: Path, old: str, new: str, words: tuple[str, ...]) -> None:
    assert old in GOOD
    with pytest.raises(UserInputError) as caught:
        load(tmp_path, GOOD.replace(old, new, 1))
    message = str(caught.value)
    assert "\n" not in message
    for word in ("x.toml", *words):
        assert word in message


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match=r"none\.toml cannot be read: No such file"):
        load_experiment(tmp_path / "none.toml", option_names())


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ('columns = ["psrn"]', ("'psrn' is not known", "did you mean psnr?")),
        ('paper = "main_8k"', ("main_8k", "main_4k")),
    ],
)
def test_mistakes_in_a_table(tmp_path: Path, table: str, words: tuple[str, ...]) -> None:
    experiment = load(tmp_path, f"{GOOD}[table]\n{table}\n")
    with pytest.raises(UserInputError) as caught:
        check_table(experiment)
    assert all(word in str(caught.value) for word in words)


def test_a_row_that_the_paper_does_not_have(tmp_path: Path) -> None:
    text = GOOD.replace('name = "one"', 'name = "one"\npaper = "Ours(FastGS"')
    with pytest.raises(UserInputError, match=r"no row 'Ours\(FastGS'; did you mean Ours\(FastGS\)\?"):
        check_table(load(tmp_path, text + '[table]\npaper = "main_1k"\n'))


@pytest.mark.parametrize("path", EXPERIMENTS.values(), ids=lambda path: path.stem)
def test_the_shipped_experiments(path: Path) -> None:
    experiment = load_experiment(path, option_names())
    paper = check_table(experiment)
    assert experiment.name == path.stem
    assert f"lapgs bench {path.stem}" in path.read_text()
    planned = plan_runs(experiment, Selection())
    kinds = {run.variant: run.spec.options.get("hierarchy") for run in planned if run.spec.method != "bare"}
    if path.stem == "smoke":
        assert len(planned) == 8, "four variants, two seeds"
        assert set(kinds.values()) == {"nested", "laplacian"}
        return
    assert [name for name, kind in kinds.items() if kind != "laplacian" and name not in ("nested", "one level")] == []
    if path.stem == "convergence":
        assert {figure.kind for figure in experiment.figures} == {"psnr_over_seconds", "gaussians_over_iterations"}
        assert all(run.spec.options["test_every"] == 1000 for run in planned), "bare runs, too"
        return
    assert paper is not None
    with_figures = [variant for variant in experiment.variants if variant.paper_row("fastgs")]
    assert len(with_figures) >= 2, "most rows stand beside the paper's"


def test_there_is_an_experiment_for_every_table() -> None:
    wanted = {"main_1k", "main_2k", "main_4k", "split", "levels", "loss", "inheritance", "inheritance_ratio", "peak"}
    assert EXPERIMENTS.keys() == wanted | {"breakdown", "convergence", "hierarchy", "smoke"}


@pytest.mark.parametrize(
    ("figure", "words"),
    [
        ('kind = "pie"', ("figures.0.kind", "'psnr_over_seconds'")),
        ('kind = "crops"\nscenes = ["b"]', ("figures.0", "scene 'b' is not in the experiment")),
        ('kind = "crops"\nview = "0.jpg"', ("figures.0", "view is for crops of one scene")),
        ('kind = "edges"\nscenes = ["a"]\nview = "0.jpg"', ("figures.0", "view is for crops of one scene")),
        (
            'kind = "crops"\n[[figures]]\nkind = "crops"\nscenes = ["a"]\nview = "0.jpg"',
            ("two draw the image crops",),
        ),
        (
            'kind = "peak_memory"\nscenes = ["a"]\n[[figures]]\nkind = "peak_memory"',
            ("two draw the image peak",),
        ),
        ('kind = "crops"\nscene = ["a"]', ("unknown key figures.0.scene", "did you mean scenes?")),
    ],
)
def test_mistakes_in_figures(figure: str, words: tuple[str, ...], tmp_path: Path) -> None:
    with pytest.raises(UserInputError) as caught:
        load(tmp_path, f"{GOOD}[[figures]]\n{figure}\n")
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_mistakes_in_printed_rows(tmp_path: Path) -> None:
    printed = 'printed = ["Opti3DG"]\n'
    with pytest.raises(UserInputError, match=r"there is no table\.paper whose rows these are"):
        check_table(load(tmp_path, f"{GOOD}[table]\n{printed}"))
    with pytest.raises(UserInputError, match=r"table.printed: .* main_1k has no row 'Opti3DG'; did you mean Opti3DGS"):
        check_table(load(tmp_path, f'{GOOD}[table]\npaper = "main_1k"\n{printed}'))
