"""Read JSON, TOML and XML that may be damaged, edited by hand or malicious.

All of this package reads such files here. Size, nesting and numbers are limited first; then values are validated
against a type, those of XML by its reader. Every error is one line with the file, the key, the value, the expectation
and advice.
Readers of other formats call `require_regular` before they open a file.

A type is anything that pydantic validates. Dataclasses with `STRICT` as their `__pydantic_config__`, and dictionaries
that derive from `Strict`, accept no other types, no unknown keys and no NaN.
"""

from __future__ import annotations

import codecs
import errno
import math
import os
import re
import reprlib
import stat
import sys
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from typing_extensions import TypedDict  # pydantic cannot read that of `typing` before Python 3.12

from lapgs_plugin.errors import UserInputError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    from pydantic import TypeAdapter, ValidationError

MIB = 2**20
JSON_MIB = 32
"""Largest JSON, XML or text file with cameras or a history, in MiB. Other JSON files may have an eighth of that."""
BYTES_A_VALUE = 16
"""Bytes for each value that a file may hold: a file of at most n bytes may hold n / 16 values."""
JSON_MIB_VARIABLE = "LAPGS_JSON_MIB"
"""Environment variable that replaces `JSON_MIB`."""
TEXT_BYTES = MIB
"""Largest TOML or other text file; these are written by hand."""
DEPTH = 100
"""Deepest nesting of tables and lists."""
KEY_PARTS = 32
"""Most parts of a dotted TOML key; a parser's memory grows with their square."""
LARGEST_INTEGER = 2**63
LARGEST_FLOAT = 2.0**128
"""Float32 numbers are smaller; sums and products of larger ones could be inf."""

STRICT: Any = {"strict": True, "extra": "forbid", "allow_inf_nan": False}
"""`__pydantic_config__` of a dataclass whose values come from a file."""
_STRICT_WITH_MORE: Any = {**STRICT, "extra": "allow"}

_KEY_PART = r"""(?:[A-Za-z0-9_-]+|"[^"\n]*"|'[^'\n]*')"""
_LONG_KEY = re.compile(rf"""(?<![A-Za-z0-9_"'-]){_KEY_PART}(?:[ \t]*\.[ \t]*{_KEY_PART}){{{KEY_PARTS}}}""")


class Strict(TypedDict):
    """Type a dictionary from a file, all of whose keys must be there unless they are `NotRequired`."""

    __pydantic_config__ = STRICT  # type: ignore[misc]  # what pydantic documents


class StrictWithMore(TypedDict):
    """Type the used keys of a dictionary from a file, which may have others."""

    __pydantic_config__ = _STRICT_WITH_MORE  # type: ignore[misc]  # what pydantic documents


def require_regular(path: Path) -> None:
    """Check that a path is a regular file, or a link to one, that fits into this machine's memory.

    Reading a pipe may wait for ever, and reading a device may never end.

    Raises:
        OSError: it is not, or is missing.
    """
    status = path.stat()
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "a pipe, socket or device, no file", str(path))
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else sys.maxsize
    if status.st_size > memory:
        raise OSError(errno.EFBIG, f"it has {status.st_size:,} bytes, more than this machine's memory", str(path))


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
        error: class to raise.
        advice: about a damaged file; ends the message.
        finite: refuse NaN and Infinity, which are not JSON but which some programs write.

    Returns:
        A `kind`.

    Raises:
        UserInputError: as `error`: the file cannot be read, is too large, is not JSON, or holds something else.
    """
    data = _read_json_bytes(path, 1 if kind is Any else 8, error, advice).removeprefix(codecs.BOM_UTF8)
    return parse_json(data, str(path), kind, error=error, advice=advice, finite=finite)


def read_json_lines(
    path: Path,
    kind: Any = Any,
    *,
    error: type[UserInputError] = UserInputError,
    advice: str = "delete that line",
) -> list[Any]:
    """Read a file with one JSON value per line. Text after the last line break is incomplete and ignored.

    Args, Raises:
        As `read_json`; `kind` is the type of one line, and messages name the line.
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
    """Parse JSON in memory, otherwise as `read_json`; messages call it `name`."""
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
    """Read a TOML file; arguments and errors as in `read_json`. Dates are refused."""
    text = read_text(path, error=error, advice=advice)
    if (long := _LONG_KEY.search(text)) is not None:
        raise error(f"{path} has the key {shortened(long.group())}, expected at most {KEY_PARTS} parts; {advice}")
    try:
        value = tomllib.loads(text)
    except (ValueError, RecursionError) as cause:
        reason = "nested too deep" if isinstance(cause, RecursionError) else cause
        raise error(f"{path} is not TOML: {reason}; {advice}") from None
    return checked(value, kind, str(path), error=error, advice=advice, finite=finite)


def read_text(
    path: Path, *, error: type[UserInputError] = UserInputError, advice: str = "restore it", written: bool = False
) -> str:
    """Read a text file; arguments and errors as in `read_json`.

    Args:
        path, error, advice: as `read_json` takes them.
        written: a program wrote the file, which may then be as large as a JSON file; else at most `TEXT_BYTES`.
    """
    if written:
        data = _read(path, *_written_limit(error), error, advice)
    else:
        data = _read(path, TEXT_BYTES, "expected a file written by hand", error, advice)
    try:
        return data.decode("utf-8-sig")  # editors on Windows write the mark
    except UnicodeDecodeError as cause:
        raise error(
            f"{path} is not readable: byte {cause.start} is {shortened(data[cause.start : cause.start + 1])}, expected "
            f"UTF-8 text; {advice}"
        ) from None


def read_xml(path: Path, *, error: type[UserInputError] = UserInputError, advice: str = "restore it") -> Element:
    """Read an XML file without a document type, in UTF-8; return its root. Arguments and errors as in `read_json`."""
    text, (limit, how_to_raise) = read_text(path, error=error, advice=advice, written=True), _written_limit(error)
    if text.count("<") > limit // BYTES_A_VALUE:
        raise error(f"{path} has more than {limit // BYTES_A_VALUE:,} tags, the most that are read; {how_to_raise}")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # entities multiply
        raise error(f"{path} declares a document type or entities, expected plain XML; {advice}")
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as cause:
        raise error(f"{path} is not readable as XML ({cause}); {advice}") from None


def checked(
    value: Any,
    kind: Any,
    name: str,
    *,
    error: type[UserInputError] = UserInputError,
    advice: str,
    finite: bool = True,
) -> Any:
    """Validate parsed values and convert them to `kind`, such as a dictionary to a dataclass.

    Args:
        value: of dictionaries, lists, strings, numbers, booleans and None.
        kind: type to convert to.
        name: of the source, for messages.
        error: class to raise.
        advice: ends the message.
        finite: refuse NaN and Infinity.

    Raises:
        UserInputError: as `error`: it is not a `kind`, nested too deep, or holds a number out of range.
    """
    _require_plain(value, name, error, advice, finite)
    if kind is Any:
        return value
    from pydantic import ValidationError
    from pydantic_core import to_json

    try:
        # As JSON, because strict validation of Python objects would refuse a list for a tuple.
        return _adapter(kind).validate_json(to_json(value))
    except ValidationError as cause:
        raise error(f"{name} is damaged: {problem(cause)}; {advice}") from None


def shortened(value: Any) -> str:
    """Return a value's repr for a message, at most 80 characters."""
    brief = reprlib.Repr()
    brief.maxstring = brief.maxother = brief.maxlong = 60
    brief.maxlevel, brief.maxdict, brief.maxlist = 2, 2, 4
    text = brief.repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def usable_path(text: str) -> str:
    """Check that text can be a path: without NUL, and not longer than file systems allow.

    Raises:
        ValueError: it is not a path.
    """
    if "\0" in text or len(os.fsencode(text)) >= 4096 or any(len(os.fsencode(part)) > 255 for part in text.split("/")):
        raise ValueError(f"{shortened(text)} is no path, expected one of at most 255 bytes a name and without NUL")
    return text


@lru_cache(maxsize=64)
def _adapter(kind: Any) -> TypeAdapter[Any]:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def _read_json_bytes(path: Path, part: int, error: type[UserInputError], advice: str) -> bytes:
    """Read a JSON file of at most one `part`-th of the limit, with no more values than fit into that."""
    whole, how_to_raise = _written_limit(error)
    data = _read(path, whole // part, how_to_raise, error, advice)
    most = whole // part // BYTES_A_VALUE
    if sum(data.count(mark) for mark in (b",", b"[", b"{")) > most:
        raise error(f"{path} holds more than {most:,} values, the most that are read; {how_to_raise}, or {advice}")
    return data


def _written_limit(error: type[UserInputError]) -> tuple[int, str]:
    """Return the size of the largest file that is read if a program wrote it, and how to raise that."""
    text = os.environ.get(JSON_MIB_VARIABLE, str(JSON_MIB))
    if not re.fullmatch("[1-9][0-9]{0,5}", text):
        raise error(f"{JSON_MIB_VARIABLE}={shortened(text)}: expected a number of MiB such as {4 * JSON_MIB}")
    return int(text) * MIB, f"set {JSON_MIB_VARIABLE} to more than {text} if it is right"


def _read(path: Path, limit: int, how_to_raise: str, error: type[UserInputError], advice: str) -> bytes:
    """Read a file of at most `limit` bytes."""
    data = bytearray()
    try:
        require_regular(path)
        with path.open("rb") as stream:
            # In parts, because a single read would allocate its whole limit.
            while len(data) <= limit and (part := stream.read(MIB)):
                data += part
    except (OSError, ValueError) as cause:  # ValueError: a NUL in the path
        reason = getattr(cause, "strerror", None) or cause
        raise error(f"{path} cannot be read: {reason}; expected a file that this user may read; {advice}") from cause
    if len(data) > limit:
        raise error(f"{path} is larger than {limit / MIB:g} MiB, the most that is read; {how_to_raise}, or {advice}")
    return bytes(data)


def _require_plain(value: Any, name: str, error: type[UserInputError], advice: str, finite: bool) -> None:
    """Refuse deep nesting, unusable numbers and types other than JSON's."""
    layer = [value]
    for _ in range(DEPTH):
        inner: list[Any] = []
        for item in layer:
            if isinstance(item, dict):
                inner.extend(item)
                inner.extend(item.values())
            elif isinstance(item, list):
                inner.extend(item)
            elif (unusable := _unusable(item, finite)) is not None:
                raise error(f"{name} holds the {unusable}; {advice}")
        layer = inner
        if not layer:
            return
    raise error(f"{name} is nested more than {DEPTH} deep, expected fewer levels; {advice}")


def _unusable(value: Any, finite: bool) -> str | None:
    """Describe the problem of a value that is neither table nor list; None without one."""
    if isinstance(value, str):
        # A lone surrogate, from a file name that is not UTF-8 or from an escape.
        broken = not value.isascii() and re.search("[\ud800-\udfff]", value)
        return f"text {shortened(value)}, expected UTF-8" if broken else None
    if isinstance(value, float):
        usable = math.isfinite(value) and abs(value) < LARGEST_FLOAT
        return f"number {value}, expected finite numbers below {LARGEST_FLOAT:.2g}" if finite and not usable else None
    if isinstance(value, int):
        return f"number {_digits(value)}, expected 64 bits at most" if abs(value) > LARGEST_INTEGER else None
    if value is None:
        return None
    return f"{type(value).__name__} {shortened(value)}, expected text, numbers, lists and tables"


def _digits(value: int) -> str:
    """Describe a large integer; Python refuses to print more than 4,300 digits."""
    return f"of {value.bit_length()} bits" if value.bit_length() > 300 else shortened(value)


def problem(error: ValidationError) -> str:
    """Describe the first problem: its key, its value and the expectation."""
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
