"""Test that whatever the program names comes with it: experiments, recipes, pages of the documentation."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from lapgs_plugin.cli.help import topics
from tests.package_strings import PACKAGES, ROOT, said

BUILD = """
import sys
from setuptools import setup  # replaces distutils
from distutils.core import run_setup
words = "-q build_py --no-compile --build-lib FOLDER dist_info --output-dir FOLDER".replace("FOLDER", sys.argv[1])
run_setup("setup.py", words.split(), "commandline").run_commands()
"""
USE = """
from lapgs_plugin.cli.app import app
for words in ("help", "help patches", "bench smoke --dry-run --no-eval"):
    app(words.split(), standalone_mode=False)
from lapgs_plugin.patching.recipe import load_recipes
print(__import__("lapgs_plugin").__file__, *(recipe.name for recipe in load_recipes()))
"""
REPOSITORY = re.compile(r"\b(docs|benchmarks|tests|patches)/\w+\.\w+")
"""Files of the repository, which an installed package does not have there."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that a wheel installs."""
    folder = tmp_path_factory.mktemp("site")
    subprocess.run([sys.executable, "-c", BUILD, folder], cwd=ROOT, check=True)
    return folder


def test_the_commands_of_an_installed_wheel_find_their_files(site: Path, tmp_path: Path) -> None:
    words, environment = [sys.executable, "-c", USE], {"PYTHONPATH": str(site)}
    out = subprocess.run(words, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout
    assert [*topics()] == re.findall(r"^lapgs help (\S+)", out, re.MULTILINE)
    assert (ROOT / "patches/README.md").read_text() in out
    assert len(re.findall(r"^# sample-", out, re.MULTILINE)) == 8, "four variants, two seeds"
    package, *recipes = out.splitlines()[-1].split()
    assert Path(package) == site / "lapgs_plugin/__init__.py"
    assert set(recipes) == {path.stem for path in ROOT.glob("patches/*.toml")}


def test_a_wheel_has_every_file_of_the_packages(site: Path) -> None:
    paths = {path for package in PACKAGES for path in (ROOT / package).rglob("*")}
    own = {path for path in paths if path.is_file() and "__pycache__" not in path.parts}
    lacking = {str(path.relative_to(ROOT)) for path in own if not (site / path.relative_to(ROOT)).is_file()}
    assert lacking == {"lapgs_plugin/README.md"}  # the map of the code, for its developers


def test_messages_name_pages_that_exist() -> None:
    texts = [*said(), *((path.name, path.read_text()) for path in ROOT.glob("patches/*.toml"))]
    assert [(where, text) for where, text in texts if REPOSITORY.search(text)] == []
    pages = {(where, page) for where, text in texts for page in re.findall(r"`lapgs help ([a-z]+)", text)}
    assert {page for _, page in pages} >= {"extending", "patches", "rasterizers"}
    assert [pair for pair in pages if pair[1] not in topics()] == []
