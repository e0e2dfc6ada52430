"""Test the patch engine on source trees of our own writing, and the recipes of this package.

The programs below are lists of tokens with a space between any two. A test lays them out in any way (line endings,
indentation, comments, spliced lines) and knows the place of an edit by its index, without our tokeniser.
"""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from lapgs_plugin.cli.patch import app
from lapgs_plugin.errors import PatchError
from lapgs_plugin.patching.engine import ALL_SETS, State, Target, find_targets, plan_apply, plan_revert, status
from lapgs_plugin.patching.files import read_only, uncommitted, write_all
from lapgs_plugin.patching.recipe import Anchor, Check, Edit, Recipe, load_recipes
from lapgs_plugin.rasterizers.signed_color import signed_degree
from lapgs_plugin.reference_raster.layout import SIGNED_COLOR_BIT
from tests.contract.stub_runs import CHECKOUTS
from tests.folders import snapshot
from tests.refusals import refuses

# An anchor is written between [name and name], so that its index among the tokens is known.
PROGRAMS = {
    "kernels/shade.cu": """
#include "shade.h"
[wide #include <vector> wide]
struct Colour { float r ; float g ; } ;
float shade ( int deg ) ;
float darker ( int deg ) { if ( deg > 0 ) { return 1'0.5e-1f ; } result += 0.5f ; return shade ( deg ) ; }
float shade ( int i , [calls int deg calls] , bool * flags ) {
float result = base [ i ] ;
[strip if ( deg > 0 ) strip] { result = result - 1.5f * ( deg - 2 ) ; }
[raw result += 0.5f ; raw]
flags [ i ] = result < 0 ;
return [max space :: top ( result , 0.0f ) max] ;
}
void launch ( ) { shade < 3 > << < 1 , 2 >> > ( 7 ) ; }
void Box :: shade ( ) { if ( deg > 0 ) { } }
""",
    "kernels/host.h": """
#pragma once
#define SHADE ( deg ) if ( deg > 0 ) { result += 0.5f ; }
[guard namespace kernels guard] { class Guard { int a ; } ; }
""",
}
DEG = "if (deg > 0)"
SHADE, HOST = "kernels/shade.cu", "kernels/host.h"
EDITS = {
    "strip": Edit("signed", "strip", SHADE, DEG, "shade", before="int flag = deg;\ndeg &= 7;"),
    "raw": Edit("signed", "raw", SHADE, "result += 0.5f;", "shade", before="if (flag) return 1;"),
    "max": Edit("build", "max", SHADE, "space::top(result, 0.0f)", "shade", replace="most(result)"),
    "wide": Edit("build", "wide", SHADE, "#include <vector>", before="#include <cstdint>"),
    "guard": Edit("build", "guard", HOST, "namespace kernels", before="/* why */\nint b;\n#if 1\n#endif"),
}
CHECK = Check("signed", "int deg", 1, "the degree is taken by value", (Anchor(SHADE, function="shade"),))
RECIPE = Recipe(
    name="shade",
    title="a small shader",
    present=(Anchor(SHADE),),
    reinstall="make {folder}",
    edit=tuple(EDITS.values()),
    check=(CHECK,),
)


@dataclass
class Program:
    """Hold the tokens of one file, each directive one token, and the ranges of its anchors."""

    tokens: list[str]
    anchors: dict[str, range]

    @classmethod
    def parse(cls, text: str) -> Program:
        tokens: list[str] = []
        starts: dict[str, int] = {}
        anchors: dict[str, range] = {}
        for line in text.strip().split("\n"):
            words = line.split(" ")
            names = [word[1:] for word in words if re.fullmatch(r"\[\w{3,}", word)]
            directive = any(word.startswith("#") for word in words)
            for word in words:
                if word.startswith("[") and word[1:] in names:
                    starts[word[1:]] = len(tokens)
                    if directive:
                        tokens.append(" ".join(w for w in words if w.strip("[]") not in names))
                elif word.endswith("]") and word[:-1] in starts:
                    anchors[word[:-1]] = range(starts[word[:-1]], len(tokens))
                elif directive and not names:
                    tokens.append(line)
                    break
                elif not directive:
                    tokens.append(word)
        return cls(tokens, anchors)


BOM = "\xef\xbb\xbf"
PARSED = {file: Program.parse(text) for file, text in PROGRAMS.items()}
TRIVIA = (
    " ",
    "\n",
    "\n\t",
    "\r\n",
    "\r\n    ",
    "\t",
    " /* x; { */ ",
    " // y } \n",
    " // z\r\n\t",
    " \\\n ",
    "\n\n /*\n*/",
    "\r ",
)


def lay_out(tokens: list[str], trivia: Iterator[str]) -> bytes:
    """Return the program as a file with trivia between any two tokens; directives get their own lines."""
    out = []
    for token in tokens:
        gap = next(trivia)
        if token.startswith("#"):
            out += ["" if not out or out[-1].endswith("\n") else "\n", token, "\r\n" if "\r" in gap else "\n"]
        else:
            out += [token, gap]
    return "".join(out).encode("latin-1")


def plain() -> Iterator[str]:
    while True:
        yield " "


@st.composite
def trees(draw: st.DrawFn, programs: dict[str, Program] = PARSED) -> dict[str, bytes]:
    """Draw the files of the small shader in any layout, with or without a final newline."""
    tree = {}
    for file, program in programs.items():
        choices = draw(st.lists(st.integers(0, len(TRIVIA) - 1), min_size=8, max_size=8))
        favourite = draw(st.sampled_from([" ", "\n", "\r\n"]))
        gaps = (TRIVIA[choices[i % 8]] if (i * 7 + choices[0]) % 5 < 2 else favourite for i in range(10_000))
        data = BOM.encode("latin-1") * draw(st.booleans()) + lay_out(program.tokens, gaps)
        tree[file] = data.rstrip(b" \t\r\n\\") if draw(st.booleans()) else data + "// caf\xe9 \x00".encode("latin-1")
    return tree


def write_tree(root: Path, tree: dict[str, bytes]) -> Target:
    shutil.rmtree(root, ignore_errors=True)
    for file, data in tree.items():
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).write_bytes(data)
    return Target(RECIPE, root)


def apply(target: Target, *sets: str) -> dict[str, bytes]:
    write_all(plan_apply(target, sets))
    return snapshot(target.folder)


def revert(target: Target, *sets: str) -> dict[str, bytes]:
    write_all(plan_revert(target, sets))
    return snapshot(target.folder)


def states(target: Target) -> dict[str, State]:
    return {edits.set: edits.state for edits in status(target)}


def bare(data: bytes) -> str:
    """Return a file without comments, spliced lines and white space."""
    text = re.sub(r"\\\r?\n", "", data.decode("latin-1"))
    return re.sub(r"\s", "", re.sub(r"//[^\n]*|/\*.*?\*/", " ", text, flags=re.DOTALL))


def expected(file: str, sets: set[str]) -> str:
    """Return a patched file without comments and white space, made by inserting each text by token index."""
    program = PARSED[file]
    tokens = list(program.tokens)
    edits = [edit for edit in EDITS.values() if edit.file == file and edit.set in sets]
    for edit in sorted(edits, key=lambda edit: program.anchors[edit.name].start, reverse=True):
        span = program.anchors[edit.name]
        tokens[span.start : span.start if edit.replace is None else span.stop] = [edit.put]
    return bare("\n".join(tokens).encode())


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tree") / "shader"


@settings(deadline=None, max_examples=60)
@given(tree=trees())
def test_apply_puts_every_text_where_it_belongs_and_revert_takes_it_out_to_the_byte(
    root: Path, tree: dict[str, bytes]
) -> None:
    target = write_tree(root, tree)
    once = apply(target, ALL_SETS)
    assert {file: bare(data).removeprefix(BOM) for file, data in once.items()} == {
        file: expected(file, {"signed", "build"}) for file in tree
    }
    assert apply(target, ALL_SETS) == once
    assert revert(target, ALL_SETS) == tree


@settings(deadline=None, max_examples=30)
@given(tree=trees())
def test_sets_come_and_go_independently(root: Path, tree: dict[str, bytes]) -> None:
    target = write_tree(root, tree)
    build = apply(target, "build")
    both = apply(target, "signed")
    assert both == apply(write_tree(root, tree), ALL_SETS)
    assert revert(target, "signed") == build
    assert revert(target, "build") == tree
    apply(target, "signed")
    assert apply(target, "build") == both


@settings(deadline=None, max_examples=80)
@given(data=st.data())
def test_a_tree_without_any_one_anchor_is_refused_and_untouched(root: Path, data: st.DataObject) -> None:
    file, name = data.draw(st.sampled_from([(file, name) for file, p in PARSED.items() for name in p.anchors]))
    tokens, span = PARSED[file].tokens, PARSED[file].anchors[name]
    lost = data.draw(st.sampled_from(span))
    broken = data.draw(trees({**PARSED, file: Program(tokens[:lost] + tokens[lost + 1 :], {})}))
    target = write_tree(root, broken)
    refuses(PatchError, rf"{file}:\d+: expected `.*` once .*but found it nowhere", plan_apply, target, [ALL_SETS])
    assert snapshot(root) == broken
    assert {name for name, state in states(target).items() if state is State.IMPOSSIBLE} == {
        EDITS[name].set if name in EDITS else CHECK.set
    }


@pytest.mark.parametrize("name", EDITS)
def test_an_anchor_that_stands_twice_is_refused(root: Path, name: str) -> None:
    file = EDITS[name].file
    program = PARSED[file]
    span = program.anchors[name]
    tokens = [*program.tokens[: span.stop], ";", *program.tokens[span.start :]]
    target = write_tree(root, {other: lay_out(p.tokens, plain()) for other, p in PARSED.items()})
    (root / file).write_bytes(lay_out(tokens, plain()))
    refuses(PatchError, "but found it twice", plan_apply, target, [ALL_SETS])


@pytest.fixture
def tree() -> dict[str, bytes]:
    return {file: lay_out(program.tokens, iter(["\n"] * 1000)) for file, program in PARSED.items()}


@pytest.fixture
def target(tmp_path: Path, tree: dict[str, bytes]) -> Target:
    return write_tree(tmp_path / "shader", tree)


def test_a_message_names_the_place_what_was_expected_and_that_nothing_happened(target: Target) -> None:
    path = target.folder / SHADE
    path.write_bytes(path.read_bytes().replace(b"0.5f\n;\nflags", b"0.25f\n;\nflags"))
    line = path.read_bytes()[: path.read_bytes().index(b"shade\n(\nint\ni")].count(b"\n") + 1
    facts = (
        rf"shade\.cu:{line}: .*`result \+= 0\.5f;` once in shade .*signed/raw.*nothing was changed.*lapgs help patches"
    )
    refuses(PatchError, facts, plan_apply, target, ["signed"])


def test_a_function_defined_twice_or_never_is_refused(target: Target) -> None:
    path = target.folder / SHADE
    source = path.read_bytes()
    never = source.replace(b"shade\n(\nint\ni", b"tone\n(\nint\ni")
    for changed, count in ((source + b"float shade(int a) { return a; }", 2), (never, 0)):
        path.write_bytes(changed)
        refuses(PatchError, f"one definition of shade, found {count}", plan_apply, target, ["signed"])
    path.unlink()
    refuses(PatchError, r"kernels/shade\.cu: expected this file", plan_apply, target, ["signed"])


def test_what_looks_like_code_in_strings_comments_and_macros_is_not_code(target: Target) -> None:
    path = target.folder / SHADE
    decoys = (
        b'const char* a = "if (deg > 0) { \\" // "; const char* b = R"x(if (deg > 0) )" })x";\n'
        b"char c = '\"', d = '{';\n"
        b"/* if (deg > 0) { */ // result += 0.5f; } \\\n if (deg > 0) {\n"
        b"#define LONG if (deg > 0) { \\\n result += 0.5f; /* { \n */ result += 0.5f;\n"
    )
    path.write_bytes(path.read_bytes().replace(b"flags\n[", decoys + b"flags\n["))
    before = path.read_bytes()
    after = apply(target, ALL_SETS)[SHADE]
    assert decoys in after
    assert after.count(b">>> lapgs") == 4
    assert revert(target, ALL_SETS)[SHADE] == before


def test_a_replaced_text_with_comments_and_backslashes_comes_back(target: Target) -> None:
    path = target.folder / SHADE
    odd = b"space /* a */ :: \\\r\n top(result, // *\\/ \\* \n /*\\*/ 0.0f)"
    path.write_bytes(path.read_bytes().replace(b"space\n::\ntop\n(\nresult\n,\n0.0f\n)", odd))
    before = path.read_bytes()
    assert odd in before
    assert b"most(result)" in apply(target, ALL_SETS)[SHADE]
    assert revert(target, ALL_SETS)[SHADE] == before


def test_blocks_have_the_indentation_and_line_ending_of_their_place(target: Target) -> None:
    path = target.folder / HOST
    path.write_bytes(b"#pragma once\r\n\t  namespace kernels { }\r\nint last;\n")
    text = apply(target, "build")[HOST]
    lines = text.split(b"\r\n")
    assert re.fullmatch(rb"\t  // >>> lapgs build/guard [0-9a-f]{8}", lines[1])
    assert lines[2:7] == [b"\t  /* why */", b"\t  int b;", b"\t  #if 1", b"\t  #endif", b"\t  // <<< lapgs"]


def test_changes_of_the_user_outside_the_blocks_stay(target: Target, tree: dict[str, bytes]) -> None:
    apply(target, ALL_SETS)
    path = target.folder / SHADE
    path.write_bytes(b"// mine\n" + path.read_bytes().replace(b"darker", b"dimmer"))
    assert revert(target, ALL_SETS) == {**tree, SHADE: b"// mine\n" + tree[SHADE].replace(b"darker", b"dimmer")}


def test_a_block_changed_by_hand_is_refused_both_ways(target: Target) -> None:
    apply(target, ALL_SETS)
    path = target.folder / SHADE
    path.write_bytes(path.read_bytes().replace(b"deg &= 7;", b"deg &= 15;"))
    line = path.read_bytes()[: path.read_bytes().index(b"// >>> lapgs signed/strip")].count(b"\n") + 1
    for plan in (plan_apply, plan_revert):
        with pytest.raises(PatchError, match=rf"shade\.cu:{line}: the block signed/strip is not as lapgs wrote it"):
            plan(target, [ALL_SETS])
    assert states(target)["signed"] is State.IMPOSSIBLE


def test_a_block_that_was_only_reformatted_can_be_taken_out(target: Target) -> None:
    apply(target, "signed")
    path = target.folder / SHADE
    path.write_bytes(path.read_bytes().replace(b"int flag = deg;\ndeg &= 7;", b"  int flag  = deg;\n    deg &= 7;"))
    assert b">>> lapgs" not in b"".join(revert(target, "signed").values())


@pytest.mark.parametrize("marker", [b"// <<< lapgs\n", b"/*<<< lapgs*/"])
def test_half_a_block_is_refused(target: Target, marker: bytes) -> None:
    apply(target, ALL_SETS)
    path = target.folder / SHADE
    source = path.read_bytes()
    for parts in (source.split(marker, 1), source.rsplit(marker, 1)):
        path.write_bytes(b"".join(parts))
        for plan in (plan_apply, plan_revert):
            for name in (ALL_SETS, *RECIPE.sets):
                refuses(PatchError, "half a lapgs block", plan, target, [name])


def test_states(target: Target) -> None:
    assert states(target) == {"signed": State.NOT_APPLIED, "build": State.NOT_APPLIED}
    apply(target, "build")
    assert states(target) == {"signed": State.NOT_APPLIED, "build": State.APPLIED}
    before = (target.folder / HOST).read_bytes()
    revert(target, "build")
    (target.folder / HOST).write_bytes(before)
    assert states(target) == {"signed": State.NOT_APPLIED, "build": State.INCOMPLETE}
    apply(target, "signed")
    assert states(target) == {"signed": State.APPLIED, "build": State.APPLIED}


def test_a_set_that_is_opt_in_goes_in_by_name_only_and_out_with_all(target: Target, tree: dict[str, bytes]) -> None:
    chosen = replace(target, recipe=replace(target.recipe, opt_in=("build",)))
    apply(chosen, ALL_SETS)
    assert states(chosen) == {
        "signed": State.APPLIED,
        "build": State.NOT_APPLIED,
    }
    apply(chosen, "build")
    assert set(states(chosen).values()) == {State.APPLIED}
    after = snapshot(target.folder)
    apply(chosen, ALL_SETS)
    assert snapshot(target.folder) == after
    assert revert(chosen, ALL_SETS) == tree


def test_edits_of_another_version_are_renewed(target: Target, tree: dict[str, bytes]) -> None:
    older = replace(RECIPE, edit=(replace(EDITS["raw"], name="old", before="return 2;"),))
    write_all(plan_apply(Target(older, target.folder), ["signed"]))
    assert states(target)["signed"] is State.INCOMPLETE
    renewed = apply(target, "signed")
    assert renewed == apply(write_tree(target.folder, tree), "signed")
    newer = replace(RECIPE, edit=(EDITS["guard"],))
    facts = "signed is not among its sets of edits.*`lapgs patch revert`"
    refuses(PatchError, facts, plan_apply, Target(newer, target.folder), ["build"])


# --- writing ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("failing_call", [1, 2])
@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_write_that_fails_leaves_every_file_as_it_was(
    target: Target, tree: dict[str, bytes], monkeypatch: pytest.MonkeyPatch, failing_call: int, error: BaseException
) -> None:
    calls = 0
    replace = Path.replace

    def fail_once(source: Path, destination: Path) -> Path:
        nonlocal calls
        calls += 1
        if calls == failing_call:
            raise error
        return replace(source, destination)

    changes = plan_apply(target, [ALL_SETS])
    assert len(changes) == 2
    monkeypatch.setattr(Path, "replace", fail_once)
    with pytest.raises(PatchError if isinstance(error, OSError) else KeyboardInterrupt):
        write_all(changes)
    assert snapshot(target.folder) == tree


def test_a_file_changed_meanwhile_is_not_overwritten(target: Target, tree: dict[str, bytes]) -> None:
    changes = plan_apply(target, [ALL_SETS])
    (target.folder / HOST).write_bytes(b"new")
    refuses(PatchError, "changed by another program", write_all, changes)
    assert snapshot(target.folder) == {**tree, HOST: b"new"}


def test_permissions_and_links_stay(target: Target, tmp_path: Path) -> None:
    path = target.folder / SHADE
    moved = tmp_path / "elsewhere.cu"
    path.rename(moved)
    moved.chmod(0o755)
    path.symlink_to(moved)
    apply(target, ALL_SETS)
    assert path.is_symlink()
    assert b">>> lapgs" in moved.read_bytes()
    assert stat.S_IMODE(moved.stat().st_mode) == 0o755


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root may give files away")
def test_files_of_others_stay_theirs(target: Target) -> None:
    """As after `lapgs patch apply` in a container that has somebody's checkout mounted."""
    files = [target.folder / file for file in PROGRAMS]
    for path in files:
        os.chown(path, 1234, 4321)
    apply(target, ALL_SETS)
    assert [(path.stat().st_uid, path.stat().st_gid) for path in files] == [(1234, 4321)] * 2


def test_read_only_files_and_folders_are_found_even_by_root(target: Target) -> None:
    changes = plan_apply(target, [ALL_SETS])
    assert read_only(changes) == []
    folder, file = target.folder / "kernels", target.folder / HOST
    file.chmod(0o444)
    folder.chmod(0o555)
    try:
        assert read_only(changes) == [folder, file]
    finally:
        folder.chmod(0o755)


def git(folder: Path, *arguments: str) -> bytes:
    identity = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "protocol.file.allow=always")
    return subprocess.run(["git", *identity, *arguments], cwd=folder, check=True, capture_output=True).stdout


@pytest.mark.parametrize("autocrlf", ["false", "true"])
def test_uncommitted_changes_are_those_that_are_not_ours(target: Target, tmp_path: Path, autocrlf: str) -> None:
    git(target.folder, "init")
    git(target.folder, "add", ".")
    git(target.folder, "commit", "-m", "all")
    outer = tmp_path / "outer"
    outer.mkdir()
    git(outer, "init")
    git(outer, "-c", f"core.autocrlf={autocrlf}", "submodule", "add", str(target.folder), "submodules/shader")
    inner = Target(RECIPE, outer / "submodules/shader")
    git(inner.folder, "config", "core.autocrlf", autocrlf)
    files = [inner.folder / file for file in PROGRAMS]
    if autocrlf == "true":
        for path in files:
            path.write_bytes(path.read_bytes().replace(b"\r\n", b"\n").replace(b"\n", b"\r\n"))
    assert uncommitted(files) == []
    apply(inner, "build")
    assert uncommitted(files) == []
    files[1].write_bytes(files[1].read_bytes() + b"// mine\n")
    assert uncommitted(files) == [files[1]]
    git(inner.folder, "add", ".")
    assert uncommitted(files) == [files[1]]


def test_committed_edits_are_no_uncommitted_changes(target: Target) -> None:
    git(target.folder, "init")
    files = [target.folder / file for file in PROGRAMS]
    apply(target, "signed")
    git(target.folder, "add", ".")
    git(target.folder, "commit", "-m", "patched")
    assert uncommitted(files) == []
    apply(target, "build")
    assert uncommitted(files) == []
    revert(target, ALL_SETS)
    assert uncommitted(files) == []
    files[1].write_bytes(files[1].read_bytes() + b"// mine\n")
    assert uncommitted(files) == [files[1]]


@pytest.mark.parametrize("autocrlf", ["true", "input"])
def test_line_endings_that_git_leaves_alone_are_no_uncommitted_changes(target: Target, autocrlf: str) -> None:
    """A file that was committed with CRLF is not converted."""
    files = [target.folder / file for file in PROGRAMS]
    for path in files:
        path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    git(target.folder, "init")
    git(target.folder, "-c", "core.autocrlf=false", "add", ".")
    git(target.folder, "commit", "-m", "all")
    git(target.folder, "config", "core.autocrlf", autocrlf)
    assert git(target.folder, "status", "--short") == b""
    assert uncommitted(files) == []
    apply(target, ALL_SETS)
    assert uncommitted(files) == []
    files[1].write_bytes(files[1].read_bytes() + b"// mine\r\n")
    assert uncommitted(files) == [files[1]]


def test_without_git_nothing_is_uncommitted(target: Target, monkeypatch: pytest.MonkeyPatch) -> None:
    files = [target.folder / file for file in PROGRAMS]
    assert uncommitted(files) == []
    monkeypatch.setenv("PATH", "")
    assert uncommitted(files) == []


KILLED_AT = """
import os, pathlib, signal, sys
from lapgs_plugin.patching.engine import find_targets, plan_apply, plan_revert
from lapgs_plugin.patching.files import alone, write_all

WRITES = {"open", "os.chmod", "os.rename", "os.remove"}
planners = {"apply": plan_apply, "revert": plan_revert}


def write(checkout, command):
    targets = find_targets(checkout)
    with alone(targets):
        write_all([change for target in targets for change in planners[command](target, ["all"])])


def child(checkout, command, at):
    count, inside = 0, str(checkout)

    def die_at(event, arguments):
        nonlocal count
        reads = event == "open" and arguments[2] & os.O_ACCMODE == os.O_RDONLY
        if event in WRITES and not reads and isinstance(arguments[0], str) and arguments[0].startswith(inside):
            tick()

    def tick():
        nonlocal count
        count += 1
        if count == at:
            os.kill(os.getpid(), signal.SIGKILL)

    fsync = os.fsync
    os.fsync = lambda descriptor: (tick(), fsync(descriptor), tick())
    sys.addaudithook(die_at)
    write(checkout, command)
    os._exit(0)


for command in planners:
    at = 1
    while True:
        checkout = pathlib.Path(sys.argv[1], f"{command}-{at}")
        os.system(f"cp -r '{sys.argv[2]}' '{checkout}'")
        if command == "revert":
            write(checkout, "apply")
        process = os.fork()
        if process == 0:
            child(checkout, command, at)
        if os.waitpid(process, 0)[1] == 0:
            break
        at += 1
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="kills with SIGKILL")
def test_killed_at_any_write_the_next_command_leaves_nothing_behind(rasterizer: Path, tmp_path: Path) -> None:
    checkout = rasterizer.parents[1]
    (rasterizer / "cuda_rasterizer/.forward.cu.notes.lapgs").write_text("mine")  # not a temporary file of ours
    before = snapshot(checkout)
    write_all(plan_apply(find_targets(checkout)[0], [ALL_SETS]))
    after = snapshot(checkout)
    lapgs_patch("revert", checkout)
    copies = tmp_path / "copies"
    copies.mkdir()
    subprocess.run([sys.executable, "-c", KILLED_AT, str(copies), str(checkout)], check=True)
    checkouts = sorted(copies.iterdir())
    # Opening, both sides of the sync, the mode and the renaming of four files, and one run to the end, both ways.
    assert len(checkouts) >= 2 * (4 * 5 + 1)
    left = 0
    for number, copy in enumerate(checkouts):
        tree = snapshot(copy)
        temporaries = tree.keys() - before.keys()
        assert all(re.fullmatch(r"\..*\.[a-z0-9_]{8}\.lapgs", Path(name).name) for name in temporaries)
        assert all(tree[name] in (before[name], after[name]) for name in before)
        left += bool(temporaries)
        lapgs_patch(("status", "apply", "revert")[number % 3], copy)
        assert snapshot(copy).keys() == before.keys()
        lapgs_patch("apply", copy)
        assert snapshot(copy) == after
        lapgs_patch("revert", copy)
        assert snapshot(copy) == before
    assert left > len(checkouts) // 2, "most of these deaths leave something"


@pytest.mark.skipif(sys.platform == "win32", reason="folders have no locks there")
def test_temporary_files_of_a_process_that_lives_stay(rasterizer: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = rasterizer / "cuda_rasterizer"
    theirs = folder / ".forward.cu.abcd_123.lapgs"
    theirs.write_text("half")
    before = snapshot(rasterizer)
    program = "import fcntl, os, sys; fcntl.flock(os.open(sys.argv[1], os.O_RDONLY), 2); print('has it', flush=True); "
    with subprocess.Popen(
        [sys.executable, "-c", f"{program}sys.stdin.read()", str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"has it\n"
        monkeypatch.setattr("lapgs_plugin.patching.files.PATIENCE", 0.0)
        for command in ("status", "apply", "revert"):
            with pytest.raises(PatchError, match="cuda_rasterizer: another `lapgs patch` works on it; wait"):
                lapgs_patch(command, rasterizer)
        assert snapshot(rasterizer) == before
        other.kill()
    lapgs_patch("status", rasterizer)
    assert not theirs.exists()


# --- the recipes of this package, on a rasterizer of our own writing --------------------------------------------------

RASTERIZER = {
    "diff_gaussian_rasterization/__init__.py": "",
    "rasterize_points.cu": """
int RasterizeGaussiansCUDA(const int degree) { return CudaRasterizer::Rasterizer::forward(degree); }
int RasterizeGaussiansBackwardCUDA(const int degree) { return CudaRasterizer::Rasterizer::backward(degree); }
""",
    "cuda_rasterizer/forward.cu": """
Colour computeColorFromSH(int idx, int deg, const Colour* sh, bool* clamped)
{
	Colour result = sh[0] * 0.25f;
	if (deg > 0)
		for (int i = 1; i < (deg + 1) * (deg + 1); ++i)
			result += sh[i] * (0.5f + i);
	result += 0.5f;
	clamped[3 * idx + 0] = result.x < 0;
	clamped[3 * idx + 1] = result.y < 0;
	clamped[3 * idx + 2] = result.z < 0;
	return largest(result, 0.0f);
}
void preprocessCUDA(int D) { colour = computeColorFromSH(0, D, coefficients, flags); }
namespace FORWARD { void preprocess(int D); }
void FORWARD::preprocess(int D) { preprocessCUDA(D); }
""",
    "cuda_rasterizer/backward.h": "// declarations",
    "cuda_rasterizer/backward.cu": """
namespace backward_pass {
void computeColorFromSH(int idx, int deg, const bool* clamped, Colour* gradient)
{
	for (int i = 0; i < 16; ++i)
		gradient[i] = Colour();
	Colour d(!clamped[3 * idx], !clamped[3 * idx + 1], !clamped[3 * idx + 2]);
	gradient[0] = d * 0.25f;
	if (deg > 0)
		for (int i = 1; i < (deg + 1) * (deg + 1); ++i)
			gradient[i] = d * (0.5f + i);
}
void preprocessCUDA(int D) { computeColorFromSH(0, D, flags, gradients); }
}
namespace BACKWARD { void preprocess(int D); }
void BACKWARD::preprocess(int D) { backward_pass::preprocessCUDA(D); }
""",
    "cuda_rasterizer/rasterizer_impl.h": "#include <iostream>\n",
    "cuda_rasterizer/rasterizer_impl.cu": """
#include "backward.h"
struct GeometryState {};
int CudaRasterizer::Rasterizer::forward(int D)
{
	const float focal_y = 1.0f;
	FORWARD::preprocess(D);
	return focal_y > 0;
}
int CudaRasterizer::Rasterizer::backward(int D)
{
	GeometryState geomState = GeometryState();
	BACKWARD::preprocess(D);
	return sizeof(geomState) > 0;
}
""",
}
MAIN = """
#include <cstdio>
#include <cstdlib>
#include "cuda_rasterizer/rasterizer_impl.h"
struct Colour
{
	float x, y, z;
	Colour(float a = 0, float b = 0, float c = 0) : x(a), y(b), z(c) {}
	Colour operator*(float s) const { return Colour(x * s, y * s, z * s); }
	void operator+=(const Colour& o) { x += o.x; y += o.y; z += o.z; }
	void operator+=(float s) { *this += Colour(s, s, s); }
};
Colour largest(Colour a, float b) { return Colour(a.x > b ? a.x : b, a.y > b ? a.y : b, a.z > b ? a.z : b); }
Colour colour, coefficients[16], gradients[16];
bool flags[3] = { true, true, true };
namespace CudaRasterizer { struct Rasterizer { static int forward(int D); static int backward(int D); }; }
#include "cuda_rasterizer/forward.cu"
#include "cuda_rasterizer/backward.cu"
#include "cuda_rasterizer/rasterizer_impl.cu"
#include "rasterize_points.cu"
int main(int, char** argv)
{
	for (int i = 0; i < 16; ++i)
		coefficients[i] = Colour(i % 3 - 1.1f, 0.3f * i - 2, 0.1f * i);
	RasterizeGaussiansCUDA(atoi(argv[1]));
	std::printf("%.9g %.9g %.9g %d %d %d", colour.x, colour.y, colour.z, flags[0], flags[1], flags[2]);
	RasterizeGaussiansBackwardCUDA(atoi(argv[1]));
	for (int i = 0; i < 16; ++i)
		std::printf(" %g %g %g", gradients[i].x, gradients[i].y, gradients[i].z);
}
"""


@pytest.fixture
def rasterizer(tmp_path: Path) -> Path:
    """Write a checkout with one rasterizer that has all places of the recipes, in functions that do next to nothing."""
    folder = tmp_path / "checkout" / "submodules" / "diff-gaussian-rasterization"
    for file, text in RASTERIZER.items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(text)
    return folder


def test_every_recipe_has_a_way_to_reinstall_and_edits_with_different_names() -> None:
    recipes = load_recipes()
    names = {recipe.name for recipe in recipes}
    assert names >= {"fastgs", "taming", "taming-rasterizer", "graphdeco", "graphdeco-accel"}
    for recipe in recipes:
        labels = [edit.label for edit in recipe.edit]
        assert len(labels) == len(set(labels))
        assert "{folder}" in recipe.reinstall
        assert "build-cuda13" in recipe.sets


def test_the_flag_is_the_sign_bit_of_a_c_int() -> None:
    for degree in range(4):
        as_int = ctypes.c_int(signed_degree(degree))
        assert as_int.value == signed_degree(degree) < 0
        assert as_int.value & 0x7FFFFFFF == degree
    assert signed_degree(0) == SIGNED_COLOR_BIT


TILES = """
int processTiles(Ends bbox_min, Ends bbox_max, Ends rect_min)
{
	Ends intersect_max_line;
	int min_line = 0, tiles_count = 0;
	min_line = rect_min.x * BLOCK_U;
	int min_tile_v = 5, max_tile_v = 5 + intersect_max_line.y - intersect_max_line.x;
	tiles_count += max_tile_v - min_tile_v;
	return tiles_count + min_line + bbox_min.x + bbox_max.x;
}
int duplicateToTilesTouched() { return processTiles({ 0, 2 }, { 0, 7 }, { 0, 0 }); }
"""
"""The structure of Speedy-Splat's count of tiles: the ends of a row are used before they are set."""


@pytest.mark.skipif(shutil.which("c++") is None, reason="needs a C++ compiler")
def test_speedy_splats_tiles_are_counted_as_they_are_listed(rasterizer: Path, tmp_path: Path) -> None:
    """`Ends` stands for a value that is not set. A row without an end has no tile, and not fewer than none."""
    (rasterizer / "cuda_rasterizer/auxiliary.h").write_text(TILES)
    main = "#include <algorithm>\nusing std::max;\n#define BLOCK_U 16\nstruct Ends { int x = 10, y = 13; };\n"
    main += '#include "cuda_rasterizer/auxiliary.h"\nint main() { return duplicateToTilesTouched(); }\n'
    (rasterizer / "main.cpp").write_text(main)

    def count(name: str) -> int:
        subprocess.run(["c++", "-std=c++17", "-o", str(tmp_path / name), "main.cpp"], cwd=rasterizer, check=True)
        return subprocess.run([str(tmp_path / name)], check=False).returncode

    (target,) = find_targets(rasterizer)
    assert target.recipe.name == "speedy-splat"
    apply(target, ALL_SETS)
    assert count("before") == 3, "not part of all"
    apply(target, "robustness")
    assert count("after") == 0


@pytest.mark.skipif(shutil.which("c++") is None, reason="needs a C++ compiler")
def test_patched_code_is_signed_when_asked_and_otherwise_what_it_was(rasterizer: Path, tmp_path: Path) -> None:
    (rasterizer / "main.cpp").write_text(MAIN)

    def build(name: str) -> Callable[[int], list[float]]:
        program = tmp_path / name
        flags = ["-std=c++17", "-Wall", "-Wextra", "-Werror", "-o", str(program)]
        subprocess.run(["c++", *flags, "main.cpp"], cwd=rasterizer, check=True)
        return lambda degree: [
            float(word) for word in subprocess.check_output([str(program), str(degree)], text=True).split()
        ]

    before = build("before")
    write_all(plan_apply(find_targets(rasterizer)[0], [ALL_SETS]))
    after = build("after")
    clamped_somewhere = False
    for degree in range(4):
        clamped, signed = after(degree), after(signed_degree(degree))
        assert clamped == before(degree)
        weights = [0.25, *(0.5 + i for i in range(1, 16))]
        coefficients = [(i % 3 - 1.1, 0.3 * i - 2, 0.1 * i) for i in range(16)]
        used = range((degree + 1) ** 2)
        raw = [sum(weights[i] * coefficients[i][channel] for i in used) for channel in range(3)]
        assert signed[:3] == pytest.approx(raw, rel=1e-5, abs=1e-5)  # float32 sums of up to 16 terms: 3e-6 seen
        assert signed[3:6] == [0, 0, 0]
        assert clamped[:3] == pytest.approx([max(value + 0.5, 0) for value in raw], rel=1e-5, abs=1e-5)
        assert signed[6:] == [weights[i] if i in used else 0 for i in range(16) for _ in range(3)]
        clamped_somewhere = clamped_somewhere or any(clamped[3:6])
        # A build without the flag must not read coefficients that a field of degree 0 lacks.
        assert before(signed_degree(degree)) == before(0)
    assert clamped_somewhere


def test_a_rasterizer_where_something_else_reads_the_degree_is_refused(rasterizer: Path) -> None:
    path = rasterizer / "cuda_rasterizer/forward.cu"
    path.write_text(path.read_text().replace("{ colour =", "{ if (D > 3) return; colour ="))
    with pytest.raises(PatchError, match=r"preprocessCUDA but found it 3 times.*other code uses the degree"):
        plan_apply(find_targets(rasterizer)[0], ["signed-color"])


@pytest.mark.parametrize(
    ("has", "needed"),
    [
        ("#include <cstdint>\n", False),
        ("  #  include  <stdint.h> // theirs\n", False),
        ("#if 1\n#endif\n#include <cstdint>\n", False),
        ("// #include <cstdint>\n", True),
        ("#ifdef _WIN32\n#include <cstdint>\n#endif\n", True),
        ("#if A\n#if B\n#endif\n#include <cstdint>\n#endif\n", True),
    ],
)
def test_a_header_that_the_source_has_is_not_included_again(rasterizer: Path, has: str, needed: bool) -> None:
    path = rasterizer / "cuda_rasterizer/rasterizer_impl.h"
    path.write_text(has + path.read_text())
    before = snapshot(rasterizer)
    (target,) = find_targets(rasterizer)
    assert states(target)["build-cuda13"] is (State.NOT_APPLIED if needed else State.NOT_NEEDED)
    after = apply(target, ALL_SETS)
    name = "cuda_rasterizer/rasterizer_impl.h"
    assert after[name].count(b">>> lapgs") == needed
    assert (after[name] == before[name]) is not needed
    assert apply(target, ALL_SETS) == after
    assert revert(target, ALL_SETS) == before


@pytest.mark.parametrize("recipe", ["simple-knn", "taming-rasterizer", "fastgs", "taming"])
def test_float_limits_are_included_once(tmp_path: Path, recipe: str) -> None:
    (edit,) = (one for one in {r.name: r for r in load_recipes()}[recipe].edit if one.name == "cfloat")
    only = Recipe("only", "only", (Anchor(edit.file),), edit=(edit,))
    path = tmp_path / edit.file
    path.parent.mkdir(parents=True, exist_ok=True)
    for own, times in (("", 1), ("#include <cfloat>\n", 1), ("#include <float.h>\n", 0)):
        path.write_text(own + edit.find + "\n")
        before = path.read_bytes()
        for _ in range(2):
            write_all(plan_apply(Target(only, tmp_path), [ALL_SETS]))
            assert path.read_text().count("#include <cfloat>") == times
        write_all(plan_revert(Target(only, tmp_path), [ALL_SETS]))
        assert path.read_bytes() == before


def test_a_header_included_twice_by_an_earlier_version_is_taken_out(rasterizer: Path) -> None:
    path = rasterizer / "cuda_rasterizer/rasterizer_impl.h"
    path.write_text("#include <cstdint>\n" + path.read_text())
    before = snapshot(rasterizer)
    (target,) = find_targets(rasterizer)
    edits = tuple(replace(edit, unless=()) for edit in target.recipe.edit)
    older = replace(target, recipe=replace(target.recipe, edit=edits))
    write_all(plan_apply(older, ["build-cuda13"]))
    assert path.read_text().count("#include <cstdint>") == 2
    assert states(target)["build-cuda13"] is State.INCOMPLETE
    assert apply(target, "build-cuda13") == before


@pytest.mark.parametrize("depth", [0, 1, 2, 3])  # as of a checkout in a checkout, which doctor finds, too
def test_a_checkout_is_the_rasterizer_or_a_folder_above_it(rasterizer: Path, depth: int) -> None:
    checkout = [rasterizer, *rasterizer.parents][depth]
    (target,) = find_targets(checkout)
    assert (target.recipe.name, target.folder) == ("graphdeco", rasterizer)


def test_a_rasterizer_that_a_link_leads_to_is_one(rasterizer: Path) -> None:
    checkout = rasterizer.parents[1]
    (checkout / "raster").symlink_to(rasterizer)
    (checkout / "elsewhere").symlink_to(shutil.copytree(rasterizer, checkout.parent / "other"))
    assert [target.folder for target in find_targets(checkout)] == [checkout / "elsewhere", checkout / "raster"]


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="Windows has other permissions")
def test_a_folder_that_may_not_be_read_is_no_rasterizer(rasterizer: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As lost+found, or what another user's container wrote into the checkout."""
    folder = rasterizer / "output"
    folder.mkdir(mode=0)
    recipes = load_recipes()
    monkeypatch.chdir(rasterizer)  # whose parents are root's alone
    user = os.geteuid()
    if user == 0:
        os.seteuid(1234)
    try:
        assert [recipe.name for recipe in recipes if recipe.recognises(Path())] == ["graphdeco"]
        assert not any(recipe.recognises(Path("output")) for recipe in recipes)
    finally:
        os.seteuid(user)


def test_a_folder_without_a_rasterizer_is_an_error(tmp_path: Path) -> None:
    refuses(PatchError, r"known: .*graphdeco.*are its submodules checked out\?", find_targets, tmp_path)
    refuses(PatchError, "no such folder", find_targets, tmp_path / "missing")


HEAD = 'name = "new"\ntitle = "New"\npresent = []\n'
EDIT = HEAD + '[[edit]]\nset = "a"\nname = "b"\nfile = "c"\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name = [", "is not TOML"),
        ('name = "new"\ntitle = "New"', "it lacks present"),
        (HEAD.replace("new", "old"), "its name is 'old'"),
        (HEAD + 'extends = "old"', "extends 'old', expected one of"),
        (HEAD + '[[edit]]\nset = "a"', "lapgs help patches"),
        (EDIT + 'find = "d"\nafter = "e"', "unknown key edit[0].after"),
        (EDIT + 'find = "d"', "either `before` or `replace`"),
        (HEAD + 'extends = "new"', "without a circle"),
        (HEAD.replace('"New"', "5"), "title is 5"),
        (HEAD.replace("[]", "[3]"), "present[0] is 3"),
        (EDIT + 'find = "d"\nbefore = "e"\nunless = ["include"]', "directives that start with #"),
        (EDIT + 'find = " "\nbefore = "e"', "nothing to find"),
        (EDIT.replace('"a"', '"a b"') + 'find = "d"\nbefore = "e"', "'a b' is no name of a set or an edit"),
        (EDIT.replace('"b"', '"a.b"') + 'find = "d"\nbefore = "e"', "'a.b' is no name of a set or an edit"),
    ],
)
def test_a_recipe_with_a_mistake_is_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "new.toml").write_text(text)
    refuses(PatchError, rf"new\.toml.*{re.escape(message)}", load_recipes, tmp_path)


def test_a_recipe_takes_over_the_edits_of_the_one_it_extends(tmp_path: Path) -> None:
    edit = '[[edit]]\nset = "a"\nname = "{}"\nfile = "c"\nfind = "d"\nbefore = "{}"\n'
    head = 'name = "{}"\ntitle = "T"\npresent = [{{ file = "{}" }}]\n'
    reinstall = "CUDA_HOME=${CUDA} make {folder}"
    base = head.format("base", "x") + f'reinstall = "{reinstall}"\n' + edit.format("one", 1) + edit.format("two", 2)
    child = head.format("child", "y") + 'extends = "base"\n' + edit.format("one", 3) + edit.format("three", 4)
    (tmp_path / "base.toml").write_text(base)
    (tmp_path / "child.toml").write_text(child)
    recipe = load_recipes(tmp_path)[1]
    assert Target(recipe, Path("/here")).reinstall == "CUDA_HOME=${CUDA} make /here"
    assert [(e.name, e.put) for e in recipe.edit] == [("one", "3"), ("two", "2"), ("three", "4")]
    assert (recipe.present, recipe.reinstall) == ((Anchor("y"),), reinstall)


# --- the command ------------------------------------------------------------------------------------------------------


def lapgs_patch(*arguments: str | Path) -> str:
    """Return the output of `lapgs patch ...`; errors are raised."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)
    assert result.exit_code == 0
    return result.output


def test_a_rasterizers_folder_is_no_name_of_a_package(rasterizer: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """pip would look for `diff-gaussian-rasterization` in its index, and install whatever is there."""
    monkeypatch.chdir(rasterizer.parent)
    assert f"pip install --no-build-isolation ./{rasterizer.name}\n" in lapgs_patch("apply", rasterizer.name)


def test_the_command_from_status_to_revert(rasterizer: Path) -> None:
    checkout = rasterizer.parents[1]
    pristine = snapshot(checkout)
    assert re.search(r"signed-color +not applied\n +build-cuda13 +not applied", lapgs_patch("status", checkout))
    diff = lapgs_patch("diff", checkout, "--set", "build-cuda13")
    assert re.findall(r"^[+-].*", diff, re.MULTILINE)[:3:2] == [
        "--- a/submodules/diff-gaussian-rasterization/cuda_rasterizer/rasterizer_impl.h",
        "+// >>> lapgs build-cuda13/cstdint " + diff.split("build-cuda13/cstdint ")[1][:8],
    ]
    assert snapshot(checkout) == pristine
    output = lapgs_patch("apply", checkout)
    assert output.endswith(f"reinstall the changed extensions:\n  pip install --no-build-isolation {rasterizer}\n")
    assert re.search(r"signed-color +applied\n +build-cuda13 +applied", lapgs_patch("status", checkout))
    assert "nothing to do" in lapgs_patch("apply", checkout)
    assert "nothing to apply" in lapgs_patch("diff", checkout)
    lapgs_patch("revert", checkout, "--set", "signed-color")
    assert re.search(r"signed-color +not applied\n +build-cuda13 +applied", lapgs_patch("status", checkout))
    lapgs_patch("revert", checkout)
    assert snapshot(checkout) == pristine
    assert "nothing to remove" in lapgs_patch("revert", checkout)


def test_revert_takes_out_sets_that_only_another_version_has(rasterizer: Path) -> None:
    pristine = snapshot(rasterizer)
    lapgs_patch("apply", rasterizer)
    header = rasterizer / "cuda_rasterizer/rasterizer_impl.h"
    header.write_text(header.read_text().replace("build-cuda13/", "build-cuda14/"))
    lapgs_patch("revert", rasterizer)
    assert snapshot(rasterizer) == pristine


@pytest.mark.parametrize("ending", [b"\n", b"\r\n"])
@pytest.mark.parametrize("last", [b"\n", b""])
def test_git_applies_the_diff(rasterizer: Path, ending: bytes, last: bytes) -> None:
    """Also where an edit is near the end of a file, and where comments are no UTF-8."""
    for path in rasterizer.rglob("*.[ch]*"):
        text = path.read_bytes().replace(b"result += 0.5f;", b"result += 0.5f; // \xd6\xd0")
        path.write_bytes((text.rstrip(b"\n") + last).replace(b"\n", ending))
    command = [sys.executable, "-m", "lapgs_plugin", "patch", "diff", str(rasterizer)]
    diff = subprocess.run(command, check=True, capture_output=True, env={**os.environ, "PYTHONIOENCODING": "cp1252"})
    (rasterizer.parent / "lapgs.diff").write_bytes(diff.stdout)
    git(rasterizer, "apply", "../lapgs.diff")
    applied = snapshot(rasterizer)
    git(rasterizer, "apply", "--reverse", "../lapgs.diff")
    lapgs_patch("apply", rasterizer)
    assert snapshot(rasterizer) == applied


@pytest.mark.parametrize("inside", ["ms/train.py", "ms"])
def test_a_training_script_stands_for_its_checkout(rasterizer: Path, inside: str) -> None:
    """As for `lapgs doctor`."""
    checkout = rasterizer.parents[1]
    shutil.copytree(CHECKOUTS / "mini", checkout, dirs_exist_ok=True)
    assert str(rasterizer) in lapgs_patch("status", checkout / inside)
    assert "--- a/submodules/diff-gaussian-rasterization/" in lapgs_patch("diff", checkout / inside)


def test_the_command_refuses_before_it_writes(rasterizer: Path) -> None:
    with pytest.raises(PatchError, match=r"--set signed: expected one of build-cuda13, signed-color, all"):
        lapgs_patch("apply", rasterizer, "--set", "signed")
    git(rasterizer, "init")
    git(rasterizer, "add", ".")
    git(rasterizer, "commit", "-m", "all")
    path = rasterizer / "cuda_rasterizer/forward.cu"
    path.write_text("// mine\n" + path.read_text())
    before = snapshot(rasterizer / "cuda_rasterizer")
    with pytest.raises(PatchError, match=rf"uncommitted changes in {re.escape(str(path))}; commit them"):
        lapgs_patch("apply", rasterizer)
    assert f"uncommitted changes: {path}" in lapgs_patch("status", rasterizer)
    path.chmod(0o444)
    for command in ("apply", "apply --allow-dirty"):
        refuses(PatchError, rf"read-only: {re.escape(str(path))}", lapgs_patch, *command.split(), rasterizer)
    assert f"read-only: {path}" in lapgs_patch("status", rasterizer)
    assert snapshot(rasterizer / "cuda_rasterizer") == before
    path.chmod(0o644)
    lapgs_patch("apply", "--allow-dirty", rasterizer)
    lapgs_patch("revert", rasterizer)
    assert snapshot(rasterizer / "cuda_rasterizer") == before


def test_nothing_is_imported_for_the_help() -> None:
    program = "import sys, lapgs_plugin.cli.patch, lapgs_plugin.patching.files; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


# --- the real sources -------------------------------------------------------------------------------------------------


@pytest.mark.upstream
def test_real_sources_take_the_patch_and_give_it_back(tmp_path: Path) -> None:
    """Copy every extension in the checkouts below $LAPGS_UPSTREAM, as it is and with CRLF line endings."""
    folder = os.environ.get("LAPGS_UPSTREAM")
    if not folder:
        pytest.skip("needs checkouts of the backbones: set LAPGS_UPSTREAM to a folder that holds them")
    targets: list[Target] = []
    for checkout in sorted(Path(folder).iterdir()):
        with suppress(PatchError):  # the rasterizers of some forks have no recipe
            targets += find_targets(checkout)
    assert targets
    for number, upstream in enumerate(targets):
        for ending in (None, b"\r\n"):
            copy = tmp_path / f"{number}-{'as-is' if ending is None else 'crlf'}"
            shutil.copytree(upstream.folder, copy, ignore=shutil.ignore_patterns("third_party", ".git"))
            for path in copy.rglob("*.[ch]*"):
                if ending is not None:
                    path.write_bytes(path.read_bytes().replace(b"\r\n", b"\n").replace(b"\n", ending))
            before = snapshot(copy)
            (target,) = find_targets(copy)
            assert target.recipe.name == upstream.recipe.name
            after = apply(target, *target.recipe.sets)
            assert {targets.state for targets in status(target)} <= {State.APPLIED, State.NOT_NEEDED}
            blocks = sum(data.count(b">>> lapgs") for data in after.values())
            spared = [
                edit
                for edit in target.recipe.edit
                if any(directive.encode() in before[edit.file] for directive in edit.unless)
            ]
            assert blocks == len(target.recipe.edit) - len(spared)
            assert apply(target, *target.recipe.sets) == after
            assert revert(target, ALL_SETS) == before
