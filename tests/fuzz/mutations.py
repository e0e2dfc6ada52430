"""Damage to files: of values in a tree (JSON, TOML, Python literals, tensors), of words in a text, of bytes.

Every function takes the random numbers from outside and uses no others: the same numbers, the same damage.
"""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Callable
from random import Random
from typing import Any

Emit = Callable[[Any], str]
"""From a tree to the text of a file."""


class Raw(str):
    """Text to be written as it is where a value belongs."""

    __slots__ = ()


class Again(str):
    """A key that may stand beside an equal one."""

    __slots__ = ()
    __hash__ = object.__hash__

    def __eq__(self, other: object) -> bool:
        return self is other


DEEP = 200_000
LONG_NUMBER = "9" * 5_000
NUMBERS: tuple[Any, ...] = (
    *(0, -1, 1, 2, 7, -5, 99, 10**9, -(10**9), 2**31, 2**63, 10**30, 0.5, -0.25, 1e-300, 1e300, 1e308, -1e18),
    *(Raw("NaN"), Raw("Infinity"), Raw("-Infinity"), Raw("1e999"), Raw(LONG_NUMBER), Raw("-" + LONG_NUMBER)),
)
TEXTS: tuple[Any, ...] = (
    *("", "x", "5", "nan", "/", "..", "../..", ".", "/dev/zero", "/dev/null", "x" * 300, "y" * 100_000, "\0", "a\0b"),
    *("two\nlines", "\x1b[31mred", "\x9b31m", "é", "\u202e", "\ud800", "a/b" * 100, "%s{}", "__import__('os')"),
)
CONTAINERS: tuple[Any, ...] = (
    *([], {}, [None], [[]], [[[[1.0]]]], {"a": 1}, {"": None}, [1, 2, 3], [1e9] * 16, [0] * 10_000),
    *(Raw("[" * DEEP), Raw("[" * DEEP + "]" * DEEP), Raw('{"a":' * DEEP + "1" + "}" * DEEP)),
)
OTHERS: tuple[Any, ...] = (None, True, False)
LIES = (
    0,
    1,
    2,
    3,
    255,
    65_535,
    65_536,
    100_000,
    2**24,
    10**9,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**40,
    2**62,
    2**63,
    2**64 - 1,
)
"""What sizes and counts in binary headers are replaced by."""
BAD_UTF8 = (b"\xff", b"\xc3", b"\xed\xa0\x80", b"\x80abc", b"\xff\xfe", b"\xef\xbb\xbf")


def any_value(random: Random) -> Any:
    """A value that hardly any file expects where it is put."""
    return random.choice(random.choice((NUMBERS, NUMBERS, TEXTS, CONTAINERS, OTHERS)))


def damaged_tree(tree: Any, random: Random, value: Callable[[Random], Any] = any_value) -> Any:
    """The tree with one node replaced, removed, doubled, renamed or wrapped; nodes near the root as often as leaves.

    Args:
        tree: dicts, lists and leaves; not changed.
        random: what is drawn from.
        value: what nodes are replaced by.
    """
    if not isinstance(tree, (dict, list)) or not tree or random.random() < 0.08:
        return _damaged_node(tree, random, value)
    keys = list(tree) if isinstance(tree, dict) else list(range(len(tree)))
    key = random.choice(keys)
    child = tree[key]
    if isinstance(child, (dict, list)) and child and random.random() < 0.7:
        return _with(tree, key, damaged_tree(child, random, value))
    action = random.randrange(10)
    if action == 0:
        return _without(tree, key)
    if action == 1:
        return _doubled(tree, key, _damaged_node(child, random, value))
    if action == 2 and isinstance(tree, dict):
        return {(f"{name}_" if name == key else name): each for name, each in tree.items()}
    return _with(tree, key, _damaged_node(child, random, value))


def _damaged_node(node: Any, random: Random, value: Callable[[Random], Any]) -> Any:
    action = random.randrange(8)
    if action == 0:
        return [node]
    if action == 1 and isinstance(node, (int, float)):
        return random.choice((-node, node * 1_000_000_007, node + 0.5, str(node), node * 1e-9))
    if action == 2 and isinstance(node, list) and node:
        return random.choice((node[:-1], node + node, node * 1_000, node[::-1], {"0": node[0]}))
    if action == 3 and isinstance(node, str):
        return random.choice((node * 100, node.upper(), node + "\n", node + "/../x", node[:-1], [node]))
    return value(random)


def _with(tree: Any, key: Any, value: Any) -> Any:
    if isinstance(tree, dict):
        return {**tree, key: value}
    return [value if index == key else each for index, each in enumerate(tree)]


def _without(tree: Any, key: Any) -> Any:
    if isinstance(tree, dict):
        return {name: each for name, each in tree.items() if name != key}
    return tree[:key] + tree[key + 1 :]


def _doubled(tree: Any, key: Any, value: Any) -> Any:
    if isinstance(tree, dict):
        return {**tree, Again(key): value}
    return [*tree[:key], value, *tree[key:]]


# Trees as text.


def as_json(tree: Any) -> str:
    if isinstance(tree, Raw):
        return str(tree)
    if isinstance(tree, dict):
        return "{" + ", ".join(f"{json.dumps(str(key))}: {as_json(value)}" for key, value in tree.items()) + "}"
    if isinstance(tree, list):
        return "[" + ", ".join(map(as_json, tree)) + "]"
    return json.dumps(tree)


def as_toml(tree: Any) -> str:
    """A document: one key a line, everything below it inline."""
    if not isinstance(tree, dict):
        return _toml(tree)
    return "".join(f"{_toml(str(key))} = {_toml(value)}\n" for key, value in tree.items())


def _toml(tree: Any) -> str:
    if isinstance(tree, Raw):
        return str(tree).replace("NaN", "nan").replace("Infinity", "inf").replace('{"a":', "{a=")
    if isinstance(tree, dict):
        return "{" + ", ".join(f"{_toml(str(key))} = {_toml(value)}" for key, value in tree.items()) + "}"
    if isinstance(tree, list):
        return "[" + ", ".join(map(_toml, tree)) + "]"
    return json.dumps(tree).replace("\\ud800", "\\uD800")  # null is no TOML, which is the point


def as_namespace(tree: Any) -> str:
    """As 3DGS codebases write their options."""
    if not isinstance(tree, dict):
        return _literal(tree)
    return "Namespace(" + ", ".join(f"{key}={_literal(value)}" for key, value in tree.items()) + ")"


def _literal(tree: Any) -> str:
    if isinstance(tree, Raw):
        return str(tree)
    if isinstance(tree, dict):
        return "{" + ", ".join(f"{str(key)!r}: {_literal(value)}" for key, value in tree.items()) + "}"
    if isinstance(tree, list):
        return "[" + ", ".join(map(_literal, tree)) + "]"
    return repr(tree)


def damaged_document(tree: Any, emit: Emit, random: Random) -> bytes:
    """A file whose values were damaged, and now and then its bytes."""
    kind = random.randrange(10)
    if kind == 0:
        return damaged_bytes(emit(tree).encode("utf-8", "surrogatepass"), random)
    for _ in range(1 if kind < 8 else 3):
        tree = damaged_tree(tree, random)
    return emit(tree).encode("utf-8", "surrogatepass")


# Bytes and words.


def damaged_bytes(data: bytes, random: Random) -> bytes:
    """Cut, flipped, overwritten, extended or emptied."""
    at = random.randrange(len(data) + 1)
    head, tail = data[:at], data[at:]
    length = random.randrange(1, 64)
    choices: tuple[bytes, ...] = (
        head,
        head + bytes([tail[0] ^ (1 << random.randrange(8))]) + tail[1:] if tail else head,
        head + random.choice(BAD_UTF8) + tail,
        head + bytes(len(tail[:length])) + tail[length:],
        head + tail[length:],
        data + random.choice((b"\0" * 100, b"garbage", data, b"\n\n", b"\xff" * 7)),
        random.choice((b"", b"\0", b"\n", tail, b"\xff\xfe" + data)),
        *[with_lie(data, at, random)] * 4,
    )
    return random.choice(choices)


def with_lie(data: bytes, where: int, random: Random) -> bytes:
    """An integer of 1, 2, 4 or 8 bytes overwritten by one that is too large, too small or negative."""
    size, order = random.choice((1, 2, 4, 8)), random.choice("<>")
    lie = random.choice(LIES) % 256**size
    return data[:where] + lie.to_bytes(size, "little" if order == "<" else "big") + data[where + size :]


WORDS = (
    *(
        "-5",
        "0",
        "1",
        "2",
        "1e9",
        "1000000000",
        "9" * 30,
        LONG_NUMBER,
        "nan",
        "-inf",
        "1e300",
        "0x10",
        "",
        "x",
        "\0",
        "é",
    ),
    *("a" * 300, "b" * 100_000, "list", "uchar", "double", "float", "int", "vertex", "ascii", "/", "../x", "\x1b[2J"),
)


def damaged_text(data: bytes, random: Random, until: bytes = b"") -> bytes:
    """A text, or the header of a file up to `until`, with words or lines replaced, removed, doubled or swapped."""
    end = data.index(until) if until and until in data else len(data)
    head, rest = data[:end].decode("utf-8", "surrogateescape"), data[end:]
    lines = head.split("\n")
    at = random.randrange(len(lines))
    action = random.randrange(8)
    if action == 0:
        del lines[at]
    elif action == 1:
        lines.insert(at, lines[at])
    elif action == 2:
        other = random.randrange(len(lines))
        lines[at], lines[other] = lines[other], lines[at]
    else:
        words = re.split(r"([ =,:]+)", lines[at])
        words[random.randrange(0, len(words), 2)] = random.choice(WORDS)
        lines[at] = "".join(words)
    return "\n".join(lines).encode("utf-8", "surrogateescape") + rest


def damaged_file(data: bytes, random: Random) -> bytes:
    """Of a binary format without a structure that we know of."""
    for _ in range(random.choice((1, 1, 1, 3))):
        data = damaged_bytes(data, random)
    return data


def pack_double(value: float) -> bytes:
    return struct.pack("<d", value)


DOUBLES = (math.nan, math.inf, -math.inf, 1e300, -1e300, 1e-300, 0.0, -1.0)
