"""Registries: names of this package and of installed ones, what is refused, and which backbone a checkout is."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from lapgs_plugin.adapters import registry as backbones
from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.adapters.info import FAMILY_FILES
from lapgs_plugin.adapters.registry import BACKBONES, OWN, adapter_class, all_adapters, recognise
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.settings import HierarchySettings
from lapgs_plugin.hierarchy.supervision import SUPERVISIONS, Reconstructed, Supervision
from lapgs_plugin.registry import Registry
from tests.plugin_package import install_package
from tests.refusals import refuses

ENTRIES = """\
[lapgs_plugin.supervisions]
halved = tiny_loss:HALVED
reconstructed = tiny_loss:HALVED
broken = tiny_loss:ABSENT
wrong = tiny_loss:Halved
[lapgs_plugin.backbones]
number = tiny_loss:NUMBER
other = tiny_loss:Halved
"""
SOURCE = """\
from lapgs_plugin.hierarchy.supervision import Supervision

class Halved(Supervision):
    def pair(self, image, target, accumulated, coarse_target):
        return image / 2, target / 2

HALVED = Halved()
NUMBER = 3
"""


@pytest.fixture
def _package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_package(tmp_path, monkeypatch, "tiny_loss", ENTRIES, SOURCE)


@pytest.mark.usefixtures("_package")
def test_a_packages_supervision_is_chosen_by_name() -> None:
    assert list(SUPERVISIONS)[:3] == ["reconstructed", "online_residual", "gt_laplacian"]
    assert "halved" in list(SUPERVISIONS)
    settings = HierarchySettings(hierarchy="laplacian", supervision="halved")
    assert SUPERVISIONS[settings.supervision].pair(2, 4, 0, None) == (1, 2)  # type: ignore[arg-type]  # numbers for images
    assert type(SUPERVISIONS["reconstructed"]) is Reconstructed, "names of this package cannot be taken"


@pytest.mark.usefixtures("_package")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("broken", "tiny_loss:ABSENT cannot be loaded: AttributeError"),
        ("wrong", "tiny_loss:Halved is the class Halved, expected an instance of Supervision"),
        ("missing", "--supervision missing: expected reconstructed, online_residual, gt_laplacian, broken, halved"),
    ],
)
def test_entries_that_are_no_supervision_are_one_line(name: str, message: str) -> None:
    with pytest.raises(UserInputError) as caught:
        HierarchySettings(hierarchy="laplacian", supervision=name)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("_package")
@pytest.mark.parametrize(("name", "received"), [("number", "a int"), ("other", "Halved")])
def test_entries_that_are_no_adapter_are_one_line(name: str, received: str) -> None:
    with pytest.raises(UserInputError, match=f"{received}, expected a subclass of BackboneAdapter; fix or uninstall"):
        adapter_class(Path(), name)


def test_an_adapter_without_info_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = "from lapgs_plugin.adapters.base import BackboneAdapter\nclass Bare(BackboneAdapter): pass\n"
    install_package(tmp_path, monkeypatch, "tiny_fork", "[lapgs_plugin.backbones]\nbare = tiny_fork:Bare\n", source)
    refuses(UserInputError, r"--backbone bare: tiny_fork.Bare has no BackboneInfo called info; fix", all_adapters)


def test_own_entries_may_be_instances_or_be_loaded_when_they_are_looked_up() -> None:
    lazy = "lapgs_plugin.hierarchy.supervision:Reconstructed"
    registry: Registry[type[Supervision]] = Registry(
        "--loss", "nobody", Supervision, {"a": Reconstructed, "b": lazy}, classes=True
    )
    assert registry["a"] is registry["b"] is Reconstructed
    with pytest.raises(UserInputError, match="--loss c: expected a or b"):
        registry["c"]


def test_every_file_beside_the_registry_is_a_backbone() -> None:
    folder = Path(backbones.__file__).parent
    assert set(OWN) == {path.stem for path in folder.glob("*.py")} - {"__init__", "base", "generic", "info", "registry"}
    assert [adapter.info.name for adapter in all_adapters()] == list(BACKBONES)


def test_recognising_a_checkout_imports_no_torch(tmp_path: Path) -> None:
    make_checkout(tmp_path)
    code = (
        "import sys; from pathlib import Path; from lapgs_plugin.adapters.registry import known_extensions, recognise; "
        f"assert recognise(Path({str(tmp_path)!r})) and known_extensions(); sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def make_checkout(folder: Path, *more: str) -> None:
    for name in (*FAMILY_FILES, *more):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def adapter(name: str, *own_files: str, fork_of: tuple[str, ...] = ()) -> type[BackboneAdapter]:
    info = replace(BACKBONES[OWN[0]].info, name=name, own_files=own_files, fork_of=fork_of)
    return type(name, (BackboneAdapter,), {"info": info})


@pytest.mark.parametrize(
    ("files", "known", "received"),
    [
        ((), [adapter("plain")], "plain"),
        (("a.py",), [adapter("plain"), adapter("fork", "a.py")], "fork"),
        (("a.py",), [adapter("plain"), adapter("fork", "b.py")], "plain"),
        (("a.py", "b.py"), [adapter("one", "a.py"), adapter("two", "b.py", fork_of=("one",))], "two"),
        (("a.py", "b.py"), [adapter("two", "b.py", fork_of=("one",)), adapter("plain"), adapter("one", "a.py")], "two"),
    ],
)
def test_a_fork_wins_against_the_code_it_was_forked_from(
    files: tuple[str, ...],
    known: list[type[BackboneAdapter]],
    received: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    make_checkout(tmp_path, *files)
    monkeypatch.setattr(backbones, "all_adapters", lambda: tuple(known))
    recognised = recognise(tmp_path)
    assert recognised is not None
    assert recognised.info.name == received


def test_two_backbones_that_both_recognise_a_checkout_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_checkout(tmp_path, "a.py", "b.py")
    monkeypatch.setattr(backbones, "all_adapters", lambda: (adapter("one", "a.py"), adapter("two", "b.py")))
    with pytest.raises(UserInputError, match="is recognised as a checkout of one and two; choose one with --backbone"):
        recognise(tmp_path)
