"""The site builds without a warning, needs no network, and names every command and option."""

from __future__ import annotations

import html
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from lapgs_plugin.cli.app import all_commands
from tests.docs.documents import ROOT

LOADED = re.compile(r"""<(?:script|img|link rel="stylesheet")[^>]*?(?:src|href)=["']?(https?:)?//""")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    build = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},  # advice of the theme about its successor
        capture_output=True,
        text=True,
        check=False,
    )
    assert build.returncode == 0, build.stderr
    return folder


def every_command(command: Any, words: str) -> Iterator[tuple[str, Any]]:
    yield words, command
    for name, below in getattr(command, "commands", {}).items():
        yield from every_command(below, f"{words} {name}")


def test_every_document_is_a_page(site: Path) -> None:
    pages = {path.relative_to(site).as_posix() for path in site.rglob("*.html")}
    documents = {
        path.relative_to(ROOT / "docs").with_suffix(".html").as_posix() for path in (ROOT / "docs").rglob("*.md")
    }
    assert documents <= pages
    assert {"index.html", "code.html", "patches.html", "changelog.html", "commands.html"} <= pages


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        assert not LOADED.search(page.read_text(encoding="utf-8")), page
    for sheet in site.rglob("*.css"):
        assert "url(http" not in sheet.read_text(encoding="utf-8"), sheet


def test_the_reference_has_every_command_and_option(site: Path) -> None:
    page = (site / "commands.html").read_text(encoding="utf-8")
    commands = list(every_command(all_commands(), "lapgs"))
    assert len(commands) > 15
    for words, command in commands:
        title = re.search(rf'<h2 id="[^"]*">{words}<.*?(?=<h2 |\Z)', page, re.DOTALL)
        assert title, words
        section = html.unescape(re.sub(r"<[^>]+>", "", title[0]))
        for parameter in command.params:
            for name in (*parameter.opts, *parameter.secondary_opts):
                assert name.lower() in section.lower(), (words, name)
            if parameter.help and parameter.help[0].isalpha():
                assert parameter.help.split()[0] in section, (words, parameter.name)
            if parameter.name == "iterations" and words == "lapgs train":
                assert "default: 30000" in section
