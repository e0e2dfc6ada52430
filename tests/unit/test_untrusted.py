"""JSON and TOML of unknown origin are limited and validated; every error is one line."""

from __future__ import annotations

import json
import tracemalloc
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import pytest

from lapgs_plugin import untrusted
from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.untrusted import STRICT, read_json, read_json_lines, read_text, read_toml, shortened
from tests.refusals import refuses

MEMORY = 60 * 2**20
"""Bytes that a refused file of a megabyte may take; the worst took 31 MiB."""


@dataclass(frozen=True)
class Inner:
    __pydantic_config__: ClassVar[Any] = STRICT
    size: tuple[int, int]


@dataclass(frozen=True)
class Outer:
    __pydantic_config__: ClassVar[Any] = STRICT
    name: str
    share: float = 1.0
    inner: tuple[Inner, ...] = ()

    def __post_init__(self) -> None:
        if self.share > 1.0:
            raise UserInputError(f"share is {self.share}, expected at most 1")


UNREADABLE_JSON = [
    (b"", "is not readable as JSON"),
    (b"{", "is not readable as JSON"),
    (b"[" * 200_000, "recursion limit"),
    (b'{"a":' * 200_000, "recursion limit"),
    (b"[" * 150 + b"]" * 150, "nested more than 100 deep"),
    (b"1" * 5_000, "is not readable as JSON|holds the number"),
    (b"1" * 30, "holds the number 1{30}, expected 64 bits"),
    (b"[1e999]", "holds the number inf, expected finite"),
    (b"[-1e39]", r"holds the number -1e\+39, expected finite numbers below 3\.4e\+38"),
    (b"NaN", "is not readable as JSON"),
    (b"[-Infinity]", "is not readable as JSON"),
    (b'"\xff"', "is not readable as JSON"),
    (b"\x00", "is not readable as JSON"),
]
UNREADABLE_TOML = [
    (b"a = " + b"[" * 200_000, "nested too deep"),
    (b"a = " + b"{a = " * 100_000, "nested too deep"),
    (b"a = " + b"[" * 150 + b"]" * 150, "nested more than 100 deep"),
    (b"a" + b".a" * 200_000 + b" = 1", "has the key 'a.a.*expected at most 32 parts"),
    (b"[a" + b' . "a"' * 100_000 + b"]", "expected at most 32 parts"),
    (b"[[a" + b".'a'" * 100_000 + b"]]", "expected at most 32 parts"),
    (b"a = " + b"1" * 5_000, "is not TOML"),
    (b"a = " + b"1" * 30, "expected 64 bits"),
    (b"a = inf", "expected finite"),
    (b"a = nan", "expected finite"),
    (b"a = 2020-01-01", "holds the date"),
    (b'a = "\xff"', "byte 5 is b'.xff', expected UTF-8"),
    (b"a = ", "is not TOML"),
    (b" " * (2**20 + 1), "is larger than 1 MiB"),
]


def refused(read: Any, path: Path, message: str, advice: str = "do this") -> None:
    """Check that reading is refused in one line that names the file, in little memory."""
    tracemalloc.start()
    try:
        with pytest.raises(UserInputError, match=message) as caught:
            read(path, error=RunFolderError, advice="do this")
        taken = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert isinstance(caught.value, RunFolderError)
    assert str(path) in str(caught.value)
    assert advice in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500
    assert taken < MEMORY


@pytest.mark.parametrize(("contents", "message"), UNREADABLE_JSON, ids=range(len(UNREADABLE_JSON)))
def test_json_that_is_refused(tmp_path: Path, contents: bytes, message: str) -> None:
    (tmp_path / "a.json").write_bytes(contents)
    refused(read_json, tmp_path / "a.json", message)
    (tmp_path / "a.jsonl").write_bytes(b"1\n" + contents + b"\n")
    refused(read_json_lines, tmp_path / "a.jsonl", f"a.jsonl line 2 .*({message})")


@pytest.mark.parametrize(("contents", "message"), UNREADABLE_TOML, ids=range(len(UNREADABLE_TOML)))
def test_toml_that_is_refused(tmp_path: Path, contents: bytes, message: str) -> None:
    (tmp_path / "a.toml").write_bytes(contents)
    refused(read_toml, tmp_path / "a.toml", message)


def test_files_that_are_not_there_or_no_files(tmp_path: Path) -> None:
    for read, advice in (
        (read_json, "do this"),
        (read_json_lines, "remove it"),
        (read_toml, "do this"),
        (read_text, "do this"),
    ):
        refused(read, tmp_path / "nothing", "cannot be read: No such file", advice)
        refused(read, tmp_path, "cannot be read: Is a directory", advice)
        refused(read, Path("/dev/zero"), "cannot be read: a pipe, socket or device", advice)


def test_a_json_file_that_is_too_large_says_how_to_read_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(untrusted, "JSON_MIB", 1)
    path = tmp_path / "a.json"
    path.write_bytes(b'"' + b"a" * 2**20 + b'"')
    refused(read_json, path, "is larger than 1 MiB, the most that is read; set LAPGS_JSON_MIB to more than 1")
    refused(read_json_lines, path, "is larger than 1 MiB", "remove it")
    refused(lambda path, **about: read_json(path, str, **about), path, "is larger than 0.125 MiB")
    path.write_bytes(b"[" + b"1," * 70_000 + b"1]")
    refused(read_json, path, "holds more than 65,536 values, the most that are read; set LAPGS_JSON_MIB")
    path.write_bytes(b'"' + b"a" * 2**20 + b'"')
    monkeypatch.setenv("LAPGS_JSON_MIB", "2")
    assert len(read_json(path)) == 2**20
    monkeypatch.setenv("LAPGS_JSON_MIB", "much")
    refuses(UserInputError, "LAPGS_JSON_MIB='much': expected a number of MiB", read_json, path)


def test_what_is_right_comes_back(tmp_path: Path) -> None:
    values = {"name": "Fuß.a.b", "share": 0.1, "inner": [{"size": [3, 4]}]}
    (tmp_path / "a.json").write_text(json.dumps(values))
    assert read_json(tmp_path / "a.json") == values
    assert read_json(tmp_path / "a.json", Outer) == Outer("Fuß.a.b", 0.1, (Inner((3, 4)),))
    (tmp_path / "a.toml").write_text('# a.b.c\nname = "Fuß.a.b"\nshare = 1\n[[inner]]\nsize = [3, 4]', encoding="utf-8")
    assert read_toml(tmp_path / "a.toml", Outer) == Outer("Fuß.a.b", 1.0, (Inner((3, 4)),))
    (tmp_path / "a.jsonl").write_text("1\n[2]\n{torn")
    assert read_json_lines(tmp_path / "a.jsonl") == [1, [2]]
    (tmp_path / "a.json").write_text("[NaN, Infinity]")  # as other programs write where nobody looks
    assert len(read_json(tmp_path / "a.json", finite=False)) == 2


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([], "it is .., expected an object"),
        ({}, "it lacks name"),
        ({"name": 3}, "name is 3, expected a valid string"),
        ({"name": "a", "colour": 1}, "it has an unknown key colour"),
        ({"name": "a", "share": "1"}, "share is '1', expected a valid number"),
        ({"name": "a", "share": True}, "share is True, expected a valid number"),
        ({"name": "a", "share": 2}, r"share is 2\.0, expected at most 1"),
        ({"name": "a", "inner": {}}, "inner is .., expected a valid array"),
        ({"name": "a", "inner": [{"size": [1, 2.5]}]}, r"inner\[0\]\.size\[1\] is 2\.5, expected a valid integer"),
        ({"name": "a", "inner": [{"size": [1]}]}, r"it lacks inner\[0\]\.size\[1\]"),
        ({"name": ["a" * 10_000] * 100}, r"name is \['a+\.\.\.a+'.*expected a valid string"),
    ],
)
def test_values_of_another_type_are_named(tmp_path: Path, values: Any, message: str) -> None:
    (tmp_path / "a.json").write_text(json.dumps(values))
    refused(lambda path, **about: read_json(path, Outer, **about), tmp_path / "a.json", f"is damaged: {message}")


def test_values_are_shortened() -> None:
    for value in ("a" * 10_000, b"\x1b" * 10_000, list(range(10_000)), {i: [i] * 99 for i in range(999)}, 10**300):
        assert len(shortened(value)) <= 80
        assert shortened(value).isprintable()
