"""Read JSON and TOML that may be damaged, edited by hand or made to do harm.

Everything of this package that reads such a file reads it here: bounded in size, nesting and numbers before anything is
made of it, then checked against the type that its values should have. Whatever is wrong ends in one line that names the
file, the key, the value, what was expected and what to do.

A type is anything that pydantic validates. Dataclasses and TypedDicts that set `STRICT` as their `__pydantic_config__`
accept no other type than the one they name, no unknown key and no NaN.
"""

from __future__ import annotations

import math
import os
import re
import reprlib
import sys
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lapgs_plugin.errors import UserInputError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

if TYPE_CHECKING:
    from pydantic import TypeAdapter, ValidationError

MIB = 2**20
JSON_MIB = 32
"""Largest JSON file that is read, where cameras or a history are in it. Others may have an eighth of it."""
BYTES_A_VALUE = 16
"""The fewest on average in the largest file: values, not bytes, are what takes memory and time."""
JSON_MIB_VARIABLE = "LAPGS_JSON_MIB"
"""Environment variable that raises `JSON_MIB`."""
TEXT_BYTES = MIB
"""Largest TOML file or other text that is read; people write them by hand."""
DEPTH = 100
"""Deepest nesting of tables and lists."""
KEY_PARTS = 32
"""Most parts of a dotted key in TOML. A parser takes memory for the square of them."""
LARGEST_INTEGER = 2**63

STRICT: Any = {"strict": True, "extra": "forbid", "allow_inf_nan": False}
"""`__pydantic_config__` of a dataclass or TypedDict whose values come from a file."""
STRICT_WITH_MORE: Any = {**STRICT, "extra": "allow"}
"""The same for one that may hold further keys."""

_KEY_PART = r"""(?:[A-Za-z0-9_-]+|"[^"\n]*"|'[^'\n]*')"""
_LONG_KEY = re.compile(rf"""(?<![A-Za-z0-9_"'-]){_KEY_PART}(?:[ \t]*\.[ \t]*{_KEY_PART}){{{KEY_PARTS}}}""")


def read_json(
    path: Path,
    kind: Any = Any,
    *,
    error: type[UserInputError] = UserInputError,
    advice: str = "restore it",
    finite: bool = True,
) -> Any:
    """Read a JSON file.

    Args:
        path: of the file.
        kind: type of its value; Any accepts all JSON.
        error: what is raised.
        advice: what to do about a damaged file; ends the message.
        finite: refuse NaN and Infinity, which are no JSON; other programs write them where nobody looks.

    Returns:
        A `kind`.

    Raises:
        UserInputError: as `error`: the file cannot be read, is too large, is not JSON, or holds something else.
    """
    data = _read_json_bytes(path, 1 if kind is Any else 8, error, advice)
    return parse_json(data, str(path), kind, error=error, advice=advice, finite=finite)


def read_json_lines(
    path: Path,
    kind: Any = Any,
    *,
    error: type[UserInputError] = UserInputError,
    advice: str = "delete that line",
) -> list[Any]:
    """Read a file of one JSON value a line. What follows the last line break was never finished and is left out.

    Args, Raises:
        As `read_json`; `kind` is of one line, and the message says which.
    """
    data = _read_json_bytes(path, 1, error, "remove it")
    lines = data.split(b"\n")[:-1]
    return [
        parse_json(line, f"{path} line {number}", kind, error=error, advice=advice)
        for number, line in enumerate(lines, start=1)
    ]


def parse_json(
    text: str | bytes,
    name: str,
    kind: Any = Any,
    *,
    error: type[UserInputError] = UserInputError,
    advice: str,
    finite: bool = True,
) -> Any:
    """As `read_json`, from text in memory that messages call `name`."""
    from pydantic_core import from_json

    try:
        value = from_json(text, allow_inf_nan=not finite)
    except ValueError as cause:
        raise error(f"{name} is not readable as JSON ({cause}); {advice}") from None
    return checked(value, kind, name, error=error, advice=advice, finite=finite)


def read_toml(
    path: Path,
    kind: Any = Any,
    *,
    error: type[UserInputError] = UserInputError,
    advice: str = "correct it",
    finite: bool = True,
) -> Any:
    """Read a TOML file; arguments as `read_json` takes them. Dates are no values that this package knows."""
    text = read_text(path, error=error, advice=advice)
    if (long := _LONG_KEY.search(text)) is not None:
        raise error(f"{path} has the key {shortened(long.group())}, expected at most {KEY_PARTS} parts; {advice}")
    try:
        value = tomllib.loads(text)
    except (ValueError, RecursionError) as cause:
        reason = "nested too deep" if isinstance(cause, RecursionError) else cause
        raise error(f"{path} is not TOML: {reason}; {advice}") from None
    return checked(value, kind, str(path), error=error, advice=advice, finite=finite)


def read_text(path: Path, *, error: type[UserInputError] = UserInputError, advice: str = "restore it") -> str:
    """Read a text file of at most `TEXT_BYTES`; arguments as `read_json` takes them."""
    data = _read(path, TEXT_BYTES, "expected a file written by hand", error, advice)
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as cause:
        raise error(
            f"{path} is not readable: byte {cause.start} is {shortened(data[cause.start : cause.start + 1])}, expected "
            f"UTF-8 text; {advice}"
        ) from None


def checked(
    value: Any,
    kind: Any,
    name: str,
    *,
    error: type[UserInputError] = UserInputError,
    advice: str,
    finite: bool = True,
) -> Any:
    """Make a `kind` of parsed values, such as a dataclass of a dictionary.

    Args:
        value: of dictionaries, lists, text, numbers, truth values and None.
        kind: the type that it should have.
        name: how the message calls where it comes from.
        error: what is raised.
        advice: what to do; ends the message.
        finite: refuse NaN and Infinity.

    Raises:
        UserInputError: as `error`: it has another type, an unusual one, or a number out of range.
    """
    _require_plain(value, name, error, advice, finite)
    if kind is Any:
        return value
    from pydantic import ValidationError
    from pydantic_core import to_json

    try:
        # As JSON, because strict validation of Python's values would refuse a list as a tuple.
        return _adapter(kind).validate_json(to_json(value))
    except ValidationError as cause:
        raise error(f"{name} is damaged: {problem(cause)}; {advice}") from None


def shortened(value: Any) -> str:
    """A value for a message: its repr, at most about 80 characters of it."""
    brief = reprlib.Repr()
    brief.maxstring = brief.maxother = brief.maxlong = 60
    brief.maxlevel, brief.maxdict, brief.maxlist = 2, 2, 4
    text = brief.repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def usable_path(text: str) -> str:
    """Check that text can name a file: no NUL in it, and nothing longer than file systems take.

    Raises:
        ValueError: it cannot.
    """
    if "\0" in text or len(os.fsencode(text)) >= 4096 or any(len(os.fsencode(part)) > 255 for part in text.split("/")):
        raise ValueError(f"{shortened(text)} is no path, expected one of at most 255 bytes a name and without NUL")
    return text


@lru_cache(maxsize=64)
def _adapter(kind: Any) -> TypeAdapter[Any]:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def _read_json_bytes(path: Path, part: int, error: type[UserInputError], advice: str) -> bytes:
    """A whole JSON file of at most one `part` of the limit, with no more values than fit into that."""
    whole = _json_bytes(error)
    how_to_raise = f"set {JSON_MIB_VARIABLE} to more than {whole // MIB} if it is right"
    data = _read(path, whole // part, how_to_raise, error, advice)
    most = whole // part // BYTES_A_VALUE
    if sum(data.count(mark) for mark in (b",", b"[", b"{")) > most:
        raise error(f"{path} holds more than {most:,} values, the most that are read; {how_to_raise}, or {advice}")
    return data


def _json_bytes(error: type[UserInputError]) -> int:
    """The largest JSON file that is read."""
    text = os.environ.get(JSON_MIB_VARIABLE, str(JSON_MIB))
    if not re.fullmatch("[1-9][0-9]{0,5}", text):
        raise error(f"{JSON_MIB_VARIABLE}={shortened(text)}: expected a number of MiB such as {4 * JSON_MIB}")
    return int(text) * MIB


def _read(path: Path, limit: int, how_to_raise: str, error: type[UserInputError], advice: str) -> bytes:
    """A whole file, unless it is larger than `limit` bytes."""
    data = bytearray()
    try:
        with path.open("rb") as stream:
            # By parts: a single call takes memory for all that it is asked for.
            while len(data) <= limit and (part := stream.read(MIB)):
                data += part
    except (OSError, ValueError) as cause:  # ValueError: a NUL in the path
        reason = getattr(cause, "strerror", None) or cause
        raise error(f"{path} cannot be read: {reason}; expected a file that this user may read; {advice}") from cause
    if len(data) > limit:
        raise error(f"{path} is larger than {limit / MIB:g} MiB, the most that is read; {how_to_raise}, or {advice}")
    return bytes(data)


def _require_plain(value: Any, name: str, error: type[UserInputError], advice: str, finite: bool) -> None:
    """Refuse deep nesting, numbers that nothing can be computed with, and other types than JSON's."""
    layer = [value]
    for _ in range(DEPTH):
        inner: list[Any] = []
        for each in layer:
            if isinstance(each, dict):
                inner.extend(each)
                inner.extend(each.values())
            elif isinstance(each, list):
                inner.extend(each)
            elif (unusable := _unusable(each, finite)) is not None:
                raise error(f"{name} holds the {unusable}; {advice}")
        layer = inner
        if not layer:
            return
    raise error(f"{name} is nested more than {DEPTH} deep, expected fewer levels; {advice}")


def _unusable(value: Any, finite: bool) -> str | None:
    """What is wrong with a value that is no table and no list; None where nothing is."""
    if isinstance(value, str):
        # Half a character: of a file's name that is no UTF-8, or from an escape.
        broken = not value.isascii() and re.search("[\ud800-\udfff]", value)
        return f"text {shortened(value)}, expected UTF-8" if broken else None
    if isinstance(value, float):
        return f"number {value}, expected finite numbers" if finite and not math.isfinite(value) else None
    if isinstance(value, int):
        return f"number {_digits(value)}, expected 64 bits at most" if abs(value) > LARGEST_INTEGER else None
    if value is None:
        return None
    return f"{type(value).__name__} {shortened(value)}, expected text, numbers, lists and tables"


def _digits(value: int) -> str:
    """A large whole number for a message; Python refuses to write one of over 4,300 digits."""
    return f"of {value.bit_length()} bits" if value.bit_length() > 300 else shortened(value)


def problem(error: ValidationError) -> str:
    """Say the first thing that is wrong, with its place, its value and what was expected."""
    first = error.errors(include_url=False)[0]
    where = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
    where = where if len(where) <= 120 else where[:117] + "..."
    if first["type"] == "missing":
        return f"it lacks {where}"
    if first["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
        return f"it has an unknown key {where}"
    message = re.sub(r"^Value error, ", "", first["msg"])
    if first["type"] == "value_error":
        return f"{where}: {message}" if where else message
    expected = re.sub(r"^(Input|[A-Za-z]+) should (be|have) ", "", message)
    return f"{where or 'it'} is {shortened(first['input'])}, expected {expected}"
