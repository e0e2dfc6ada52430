"""Add the pages to the site that are not in docs/: README, map, patches, changelog, and a reference of all commands.

mkdocs calls `on_files` and `on_page_markdown`. Documents link to each other by their places in the repository; each
link is changed to the place on the site. Other files that are linked are copied to `source/`.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
ELSEWHERE = {
    "README.md": "index.md",
    "lapgs_plugin/README.md": "code.md",
    "patches/README.md": "patches.md",
    "CHANGELOG.md": "changelog.md",
}
"""Documents outside of docs/, and their pages."""
COMMANDS, COPIES = "commands.md", "source/"
LINK = re.compile(r"(?<=\]\()(?!https?:|mailto:|#)([^)#\s]+)(#[^)\s]*)?(?=\))")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add pages and copied files to what mkdocs found in docs/."""
    for document, page in ELSEWHERE.items():
        files.append(File.generated(config, page, content=(ROOT / document).read_text(encoding="utf-8")))
    for path in sorted({path for file in files.documentation_pages() for path in _linked(file)}):
        if _page_of(path).startswith(COPIES) and (ROOT / path).is_file():
            files.append(File.generated(config, _page_of(path), abs_src_path=str(ROOT / path)))
    files.append(File.generated(config, COMMANDS, content=command_reference()))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Change links to the places of their targets on the site."""
    here = page.file.src_uri
    if here == COMMANDS:
        return markdown
    document = _document_of(here)

    def on_site(match: re.Match[str]) -> str:
        target = _page_of(_resolved(document, match[1]))
        return posixpath.relpath(target, posixpath.dirname(here) or ".") + (match[2] or "")

    return LINK.sub(on_site, markdown)


def _linked(file: File) -> set[str]:
    """Return the paths in the repository to which a document links."""
    return {_resolved(_document_of(file.src_uri), target) for target, _ in LINK.findall(file.content_string)}


def _document_of(page: str) -> str:
    """Return the path in the repository of the document that a page is made from."""
    if page.startswith(COPIES):
        return page.removeprefix(COPIES)
    return next((document for document, name in ELSEWHERE.items() if name == page), f"docs/{page}")


def _page_of(document: str) -> str:
    """Return the path on the site of a file of the repository."""
    if document in ELSEWHERE:
        return ELSEWHERE[document]
    return document.removeprefix("docs/") if document.startswith("docs/") else COPIES + document


def _resolved(document: str, target: str) -> str:
    """Return the path in the repository that a link in a document leads to."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(document), target))


def command_reference() -> str:
    """Return a page with every command and option, from the code that parses them."""
    from lapgs_plugin.cli.app import all_commands

    lines = [
        "# Commands",
        "",
        "Every command with its options and defaults, as `lapgs COMMAND --help` prints them. This page is generated "
        "from the code.",
    ]
    for words, command in commands(all_commands(), ("lapgs",)):
        lines += ["", *_command_section(words, command)]
    return "\n".join(lines) + "\n"


def commands(command: Any, words: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield a command of the command line and those below it, with the words that call them."""
    yield words, command
    for name, below in getattr(command, "commands", {}).items():
        yield from commands(below, (*words, name))


def _command_section(words: tuple[str, ...], command: Any) -> Iterator[str]:
    context = typer.Context(command, info_name=" ".join(words))
    yield f"## {' '.join(words)}"
    yield ""
    yield from ("```text", " ".join((*words, *command.collect_usage_pieces(context))), "```", "")
    yield from _help_text(command.help or "")
    panels: dict[str, list[str]] = {}
    for each in command.get_params(context):
        names, text = each.get_help_record(context)
        title = getattr(each, "rich_help_panel", None) or ("Options" if names.startswith("-") else "Arguments")
        row = f"| `{names.strip()}` | {_escaped(' '.join(text.split()))} |"
        panels.setdefault(title, []).append(row)
    for title, rows in panels.items():
        yield from ("", f"| {title} | |", "|---|---|", *rows)


def _help_text(text: str) -> Iterator[str]:
    """Yield a help text as Markdown: its examples become code."""
    for paragraph in re.split(r"\n\s*\n", text.replace("\b", "")):
        lines = [line.strip() for line in paragraph.strip().splitlines()]
        if lines and all(line.startswith(("lapgs ", "ssh ")) for line in lines):
            yield from ("```sh", *lines, "```", "")
        else:
            yield from (_escaped(" ".join(lines)), "")


def _escaped(text: str) -> str:
    """Return a text that Markdown shows as it is, but for code between backticks."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(part if part.startswith("`") else re.sub(r"([\\*_\[\]<>|])", r"\\\1", part) for part in parts)
