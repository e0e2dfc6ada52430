"""What documents say holds: links lead somewhere, commands parse, options exist, figures stand where they belong."""

from __future__ import annotations

import importlib.util
import math
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from lapgs_plugin import limits
from lapgs_plugin.cli.app import all_commands
from lapgs_plugin.cli.rehearsal import Rehearsal
from lapgs_plugin.untrusted import JSON_MIB, JSON_MIB_VARIABLE
from tests.docs.documents import DOCUMENTS, PAGES, ROOT, commands, name_of, prose


def _script(name: str) -> Any:
    """Load a script that writes documents."""
    spec = importlib.util.spec_from_file_location(name, ROOT / f"docs/{name}.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patched:
        patched.syspath_prepend(ROOT / "docs")  # where a script finds others
        spec.loader.exec_module(script)
    return script


tables, curves = _script("tables"), _script("curves")

WITH_COMMANDS = [path for path in PAGES if commands(path)]
OF_OTHERS = {
    # of scripts of the backbones
    "--benchmark_dir", "--cams", "--cap_max", "--checkpoint_iterations", "--convert_SHs_python", "--debug_from",
    "--densification_interval", "--densify_from_iter", "--densify_until_iter", "--depth_loss", "--disable_viewer",
    "--filter3d", "--gaussiansN", "--grad_abs_thresh", "--gs_type", "--highfeature_lr", "--ho_iteration",
    "--kernel_size", "--lambda_bce", "--loss_thresh", "--max_n_gaussian", "--mult", "--mv",
    "--opacity_reset_interval", "--optimizer_type", "--position_lr_final", "--position_lr_max_steps",
    "--prune_iterations", "--random_background", "--ray_jitter", "--S_estimator", "--save_iterations", "--sh_lower",
    "--start_checkpoint", "--target_primitives", "--test_iterations", "--use_train_speedup",
    # of the authors' release
    "--iter_plan",
    # of the extension in docs/extending.md
    "--duplicates",
    # of gsplat's trainer, pip and mkdocs
    "--app_opt", "--data_dir", "--data_factor", "--disable_video", "--max_steps", "--patch_size",
    "--opacity_reg", "--pose_opt", "--random_bkgd", "--result_dir", "--index-url", "--no-build-isolation",
    # of nerfstudio, before a point
    "--pipeline",
}  # fmt: skip
"""Options in documents that are not of `lapgs`."""


def parsed(words: list[str]) -> tuple[Any, Any]:
    """Parse a command line as the program does, and return the command and its context."""
    command, name = all_commands(), "lapgs"
    parent: Any = None
    while True:
        context = command.make_context(name, list(words), parent=parent, obj=Rehearsal())
        if not hasattr(command, "commands"):
            return command, context
        rest = [*getattr(context, "_protected_args", ()), *context.args]
        name, command, words = command.resolve_command(context, rest)
        parent = context


@pytest.mark.parametrize("document", WITH_COMMANDS, ids=name_of)
def test_every_command_parses(document: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The rehearsal of `lapgs run` recognises a checkout; its script is never started.
    shutil.copytree(ROOT / "tests/contract/checkouts/graphdeco", tmp_path / "checkout")
    monkeypatch.chdir(tmp_path / "checkout")
    Path("ms").mkdir()
    for script in ("train_dash.py", "ms/train.py"):  # of forks
        shutil.copy("train.py", script)
    shutil.copy(ROOT / "tests/contract/checkouts/simple_trainer/simple_trainer.py", ".")
    config = Path("runs/garden/run.toml")  # a command with --config reads it when it is parsed
    config.parent.mkdir(parents=True)
    config.write_text('scene = "data/garden"\n')
    for words in commands(document):
        command, context = parsed(words)
        params = context.params
        if words[0] in ("train", "run") and not (params.get("view") or params.get("resume") or params.get("off")):
            with context:
                command.invoke(context)  # makes the settings, which checks their values, and ends


def test_a_renamed_option_would_be_found() -> None:
    with pytest.raises(Exception, match="No such option: --levls"):
        parsed(["train", "scene", "-o", "run", "--levls", "2"])
    with pytest.raises(Exception, match="No such command 'evaluate'"):
        parsed(["evaluate", "run"])


def every_option() -> set[str]:
    options, waiting = {"--help"}, [all_commands()]
    while waiting:
        command: Any = waiting.pop()
        waiting += getattr(command, "commands", {}).values()
        options |= {name for each in command.params for name in (*each.opts, *each.secondary_opts)}
    return options


@pytest.mark.parametrize("document", PAGES, ids=name_of)
def test_options_in_the_text_exist(document: Path) -> None:
    named = set(re.findall(r"(?<![\w-])--[A-Za-z][\w-]*[A-Za-z]", prose(document)))
    assert named - every_option() - OF_OTHERS == set()


@pytest.mark.parametrize("document", DOCUMENTS, ids=name_of)
def test_links_lead_to_files(document: Path) -> None:
    for target in re.findall(r"\]\((?!https?:|#)([^)#\s]+)", prose(document)):
        assert (document.parent / target).exists(), target


def test_documents_that_the_code_names_exist() -> None:
    for path in (*ROOT.glob("lapgs_plugin/**/*.py"), *ROOT.glob("lapgs_bench/**/*.py")):
        for named in re.findall(r"(?<![\w/])(?:docs|patches)/[\w./-]+\.md", path.read_text(encoding="utf-8")):
            assert (ROOT / named).is_file(), (path, named)


def test_limits_are_those_of_the_code() -> None:
    in_code = {
        limit.variable: f"{limit.default:,}" for limit in vars(limits).values() if isinstance(limit, limits.Limit)
    }
    in_code[JSON_MIB_VARIABLE] = str(JSON_MIB)
    rows = re.findall(
        r"^\| `(LAPGS_\w+)` \| ([\d,]+) \|", (ROOT / "docs/scenes.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert dict(rows) == in_code


def test_the_readme_is_a_screen_and_a_half() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 80


def test_the_results_can_be_read_at_once() -> None:
    assert len((ROOT / "docs/results.md").read_text(encoding="utf-8").splitlines()) <= 160


@pytest.mark.parametrize("document", tables.DOCUMENTS, ids=name_of)
def test_tables_show_the_data_files(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    assert tables.rewritten(text) == text, "run docs/tables.py"


def test_curves_show_the_data_file() -> None:
    assert curves.IMAGE.read_text(encoding="utf-8") == curves.drawn(curves.runs_of_data()), "run docs/curves.py"
    runs = [{**run, "lpips": str(2 * float(run["lpips"]))} for run in curves.runs_of_data()]
    assert curves.drawn(runs) != curves.drawn(curves.runs_of_data())


def test_tables_show_means_over_seeds_and_ratios_to_the_baseline() -> None:
    """On bonsai one field takes 31.3 and 32.1 s, laplacian 24.1 and 24.1 s, which is 1.32x."""
    (row,) = [line for line in tables.train().splitlines() if line.startswith("|  | laplacian | 24.1 ")]
    assert [cell.strip() for cell in row.split("|")[4:6]] == ["1.32x", "31.95"]


def test_a_table_reads_the_curves_at_equal_time() -> None:
    """On bonsai nested has LPIPS 0.0692 and 0.0689 after 23.2 s; one field 0.0672 after 20.6, 0.0627 after 31.7."""
    (row,) = [line for line in tables.equal_time().splitlines() if line.startswith("| bonsai") and "nested" in line]
    cells = [cell.strip() for cell in row.split("|")]
    then = 0.0672 - (0.0672 - 0.06265) * math.log(23.2 / 20.6) / math.log(31.7 / 20.6)
    assert cells[10] == f"{0.06905 / then - 1:+.1%}"
    assert cells[11] == f"{23.2 / 31.7:.2f}"


@pytest.mark.parametrize("document", [path for path in PAGES if path.name != "results.md"], ids=name_of)
def test_measured_figures_stand_in_the_results(document: Path) -> None:
    text = "\n".join(line for line in prose(document).splitlines() if document.name != "README.md" or line[:1] != "|")
    assert re.findall(r"\d[\d.]* dB|\d[\d.]*x as fast|\d+\.\d+ m?s\b", text) == []
