"""Test means and deviations against arithmetic by hand, and written tables against expected text."""

from __future__ import annotations

import csv
import json
import statistics
import sys
from pathlib import Path
from typing import Any

import pytest

from lapgs_bench.experiments import exports
from lapgs_bench.experiments.aggregate import Cell, ResultTable, make_table
from lapgs_bench.experiments.expansion import PlannedRun, plan_runs
from lapgs_bench.experiments.rows import result_row
from lapgs_bench.experiments.schema import Experiment
from lapgs_bench.experiments.settings import Selection
from lapgs_bench.experiments.tables import latex, markdown
from lapgs_plugin.errors import MissingExtraError, RunFolderError
from tests.experiments.examples import copying_jobs, tiny_run

SCENES = ("bonsai", "counter")


def paper_experiment(**changes: Any) -> Experiment:
    values = {
        "name": "main",
        "title": "Main_comparison",
        "seeds": [0, 1],
        "scenes": [{"dataset": "mipnerf360", "only": list(SCENES)}],
        "backbones": {"fastgs": {"checkout": "fastgs"}},
        "variants": [
            {"name": "bare", "method": "bare", "baseline": True, "paper": "FastGS"},
            {"name": "two", "options": {"levels": 2}, "paper": "Ours(FastGS)"},
        ],
        "table": {"paper": "main_1k", "columns": ["minutes", "psnr", "gaussians_millions"]},
    }
    return Experiment.model_validate({**values, **changes})


def record(run: PlannedRun) -> dict[str, Any]:
    """Make figures that differ for every run and are easy to add up."""
    spec = run.spec
    scene = SCENES.index(spec.scene) if spec.scene in SCENES else 0
    seconds = (300.0 if spec.method == "bare" else 240.0) + 60.0 * scene + 6.0 * spec.seed
    row = {"train_seconds": seconds, "psnr": 30.0 - scene - 0.5 * (spec.method != "bare") + 0.1 * spec.seed}
    if spec.method == "bare":
        return {**row, "gaussians": 800_000, "gaussians_level_0": 800_000}
    return {**row, "gaussians": 900_000, "gaussians_level_0": 500_000, "gaussians_level_1": 400_000}


def table_of(experiment: Experiment, missing: int | None = None) -> ResultTable:
    planned = plan_runs(experiment, Selection())
    records = {run.spec.run_id: record(run) for i, run in enumerate(planned) if i != missing}
    return make_table(experiment, planned, records)


def cell(table: ResultTable, row: int, column: str) -> Cell:
    return table.groups[0].rows[row].cells[column]


def test_a_figure_that_is_no_number_is_named_with_its_run() -> None:
    experiment = paper_experiment()
    planned = plan_runs(experiment, Selection())
    records = {run.spec.run_id: {**record(run), "run": run.spec.run_id, "psnr": "good"} for run in planned}
    with pytest.raises(RunFolderError, match=rf"results of {planned[0].spec.run_id} have psnr 'good', expected a num"):
        make_table(experiment, planned, records)


def test_means_over_scenes_and_deviations_over_seeds() -> None:
    table = table_of(paper_experiment())
    minutes = cell(table, 0, "minutes")
    # Scenes take 5 and 6 minutes with seed 0, a tenth more with seed 1.
    assert minutes.values == (pytest.approx(5.55),)
    assert minutes.deviation == pytest.approx(statistics.stdev([5.5, 5.6]))
    assert minutes.seeds == 2
    assert cell(table, 1, "gaussians_millions").values == (pytest.approx(0.4), pytest.approx(0.5)), "coarsest first"
    two = table.groups[0].rows[1]
    assert two.speedup.measured == pytest.approx(5.55 / 4.55)
    assert two.psnr_gain.measured == pytest.approx(-0.5)
    assert table.groups[0].rows[0].is_baseline


def test_the_papers_figures_are_of_the_same_scenes() -> None:
    two = table_of(paper_experiment()).groups[0].rows[1]
    assert two.cells["minutes"].paper is not None
    assert two.cells["minutes"].paper.value == pytest.approx((3.58 + 3.23) / 2)
    assert two.speedup.paper == pytest.approx((4.19 + 3.56) / (3.58 + 3.23))
    assert two.psnr_gain.paper == pytest.approx((32.43 + 29.43 - 33.08 - 29.60) / 2)


def test_means_use_the_scenes_that_every_row_has() -> None:
    experiment = paper_experiment()
    planned = plan_runs(experiment, Selection())
    lost = next(
        i for i, run in enumerate(planned) if (run.spec.scene, run.spec.seed, run.variant) == ("counter", 1, "two")
    )
    table = table_of(experiment, lost)
    (group,) = table.groups
    assert cell(table, 1, "minutes").values == (pytest.approx(4.5),), "seed 0 alone has both scenes"
    assert cell(table, 1, "minutes").deviation is None
    assert group.notes == ("1 of 8 runs are missing.",)

    both = [i for i, run in enumerate(planned) if (run.spec.scene, run.variant) == ("counter", "two")]
    records = {run.spec.run_id: record(run) for i, run in enumerate(planned) if i not in both}
    (group,) = make_table(experiment, planned, records).groups
    assert group.rows[0].cells["minutes"].values == (pytest.approx(5.05),), "bonsai alone, in every row"
    assert "Means over bonsai: the scenes that every row has." in group.notes


def test_the_papers_means_over_a_data_set_are_noted() -> None:
    experiment = paper_experiment(
        variants=[{"name": "1/3", "options": {"split": "1/3,2/3"}, "paper": "(10000, 20000)"}],
        table={"paper": "split", "columns": ["minutes"]},
    )
    (group,) = table_of(experiment).groups
    assert group.notes == ("The paper's figures are means over all 9 scenes of Mip-NeRF 360.",)
    assert "[3.96]" in markdown(table_of(experiment))


def test_rows_that_are_only_printed() -> None:
    shape = {"paper": "main_1k", "printed": ["Opti3DGS"], "columns": ["minutes", "psnr"]}
    table = table_of(paper_experiment(table=shape))
    assert markdown(table).count("| Opti3DGS (printed only) | - [15.99] | - [30.53] | - | - |") == 1  # of both scenes
    assert "Opti3DGS (printed only) & -" in latex(table)
    sections = [{"name": "bare", "method": "bare", "section": "Bare"}, {"name": "two", "section": "Levels"}]
    text = markdown(table_of(paper_experiment(table=shape, variants=sections)))
    assert text.index("**Levels**") < text.index("**As printed**") < text.index("Opti3DGS")


def test_markdown() -> None:
    lines = markdown(table_of(paper_experiment())).splitlines()
    assert lines[0] == "# Main_comparison"
    assert "## Mip-NeRF 360 (bonsai, counter)" in lines
    assert "| bare | 5.55 ±0.07 [3.88] | 29.55 ±0.07 [31.34] | 0.80 ±0.00 [0.66] |  |  |" in lines
    two = "| two | 4.55 ±0.07 [3.41] | 29.05 ±0.07 [30.93] | 0.40/0.50 ±0.00 [0.56/0.41] "
    assert two + "| 1.22x [1.14x] | -0.50 [-0.41] |" in lines
    assert len({line.count("|") for line in lines if line.startswith("|")}) == 1


def test_rows_after_a_section_may_have_none() -> None:
    variants = [{"name": "one", "section": "Alone"}, {"name": "two", "options": {"levels": 2}}]
    text = markdown(table_of(paper_experiment(variants=variants, table={"columns": ["minutes"]})))
    rows = [line for line in text.splitlines() if line.startswith("|")][2:]
    assert [row.split("|")[1].strip() for row in rows] == ["**Alone**", "one", "", "two"]


def test_latex() -> None:
    text = latex(
        table_of(paper_experiment(table={"paper": "main_1k", "columns": ["minutes", "psnr"], "by_scene": True}))
    )
    assert text.count(r"\begin{table*}") == text.count(r"\end{table*}") == 2, "the data set, and its scenes"
    assert r"\caption{Main\_comparison.}" in text
    assert r"bare & 5.55 $\pm$0.07\paper{3.88} & 29.55 $\pm$0.07\paper{31.34} &  &  \\" in text
    assert r"\multicolumn{4}{c}{\textbf{bonsai}} & \multicolumn{4}{c}{\textbf{counter}} \\" in text
    for table in text.split(r"\begin{tabular}{l")[1:]:
        columns = len(table.partition("}")[0]) + 1
        rows = [line for line in table.splitlines() if line.endswith(r"\\") and "multicolumn" not in line]
        assert {line.count(" & ") + 1 for line in rows} == {columns}


def test_titles_in_latex_keep_their_characters() -> None:
    text = latex(table_of(paper_experiment(title=r"a@b ^2 {x} \y ~ $5 rho rhombus N_GS")))
    escaped = r"a@b \textasciicircum{}2 \{x\} \textbackslash{}y \textasciitilde{} \$5 $\rho$ rhombus $N_{\mathrm{GS}}$."
    assert rf"\caption{{{escaped}}}" in text


def test_transposed_tables_have_a_column_for_each_variant() -> None:
    table = table_of(paper_experiment(table={"columns": ["psnr", "minutes"], "transposed": True}))
    assert "|  | bare | two |" in markdown(table)
    assert "| PSNR | 29.55 ±0.07 | 29.05 ±0.07 |" in markdown(table)
    assert r"PSNR & 29.55 $\pm$0.07 & 29.05 $\pm$0.07 \\" in latex(table)


def test_the_row_of_a_run(tmp_path: Path) -> None:
    (job,) = copying_jobs(tmp_path, 1)
    tiny_run(Path(job.folder), psnr=21.5)
    row = result_row(job)
    assert (row["psnr"], row["ssim"], row["measured_by"]) == (21.5, 0.5, "lapgs eval")
    assert (row["gaussians"], row["gaussians_level_1"], row["peak_gaussians"]) == (8, 3, 6)
    assert row["mean_gaussians"] == pytest.approx((3 * 10 + 5 * 20) / 30), "by iterations"
    assert (row["train_seconds"], row["overhead_pyramid_seconds"]) == (12.0, 1.0)
    assert (row["peak_memory_bytes"], row["peak_memory_without_images_bytes"]) == (500, 450)
    assert row["forward_ms"] == pytest.approx(1000 * 2.0 / 30)
    assert row["iteration_ms"] == pytest.approx(1000 * 6.0 / 30)
    assert not any(isinstance(value, (dict, list)) for value in row.values()), "flat"
    assert json.loads(row["options"]) == {"levels": 2}


def test_csv_is_tidy(tmp_path: Path) -> None:
    rows = [{"run": "a", "psnr": 30.25, "note": 'x,"y'}, {"run": "b", "ssim": 0.5}]
    exports.write_csv(tmp_path / "r.csv", rows)
    with (tmp_path / "r.csv").open(newline="") as stream:
        written = list(csv.DictReader(stream))
    assert written == [
        {"run": "a", "psnr": "30.25", "note": 'x,"y', "ssim": ""},
        {"run": "b", "psnr": "", "note": "", "ssim": "0.5"},
    ]


def test_names_that_look_like_numbers_stay_names(tmp_path: Path) -> None:
    rows = [{"variant": "0.50", "scene": "1e3", "psnr": 30.25}, {"variant": "0.5", "scene": "007", "psnr": 31}]
    exports.write_csv(tmp_path / "r.csv", rows)
    assert exports.read_csv(tmp_path / "r.csv") == rows


def test_parquet_has_types_and_nulls(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    exports.write_parquet(tmp_path / "r.parquet", [{"run": "a", "psnr": 30.25}, {"run": "b", "gaussians": 7}])
    table = parquet.read_table(tmp_path / "r.parquet")
    assert table.to_pylist() == [
        {"run": "a", "psnr": 30.25, "gaussians": None},
        {"run": "b", "psnr": None, "gaussians": 7},
    ]
    assert str(table.schema.field("gaussians").type) == "int64"


def test_figures_of_two_types_are_no_parquet(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    with pytest.raises(RunFolderError, match=r"r.parquet is not written: runs differ in the type of a figure"):
        exports.write_parquet(tmp_path / "r.parquet", [{"psnr": 30.25}, {"psnr": [1]}])
    assert not list(tmp_path.iterdir())


def test_without_pyarrow_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match=r"lapgs_plugin\[parquet\]"):
        exports.write_parquet(tmp_path / "r.parquet", [{"run": "a"}])
    assert not list(tmp_path.iterdir())
