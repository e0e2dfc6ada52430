"""Find code in C++ and CUDA sources by its tokens, regardless of formatting.

Text is decoded as latin-1, one character a byte: every position is a byte position, and decoding changes no byte of a
file, valid UTF-8 or not.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

_LEXER = re.compile(
    r"""
      (?P<space>\s+)
    | (?P<hidden>\\\r?\n | //(?:\\\r?\n|[^\n])* | /\*.*?(?:\*/|\Z))  # spliced lines and comments
    | (?:u8|[uUL])?R"(?P<fence>[^()\\\s]{0,16})\(.*?\)(?P=fence)"
    | (?:u8|[uUL])?"(?:\\.|[^"\\\n])*"
    | (?:u8|[uUL])?'(?:\\.|[^'\\\n])*'
    | \.?\d(?:[eEpP][+-]|'(?=\w)|[\w.])*
    | [A-Za-z_]\w*
    | .
    """,
    re.VERBOSE | re.DOTALL | re.ASCII,
)
_AFTER_PARAMETERS = frozenset({"const", "noexcept", "override", "final"})
_CONDITIONS = frozenset({"if", "ifdef", "ifndef"})
_CLOSING = {"(": ")", "{": "}"}


class Token(NamedTuple):
    """Hold a token and its position. Punctuation is one character each, so `>>` and `> >` are the same."""

    text: str
    start: int
    end: int
    in_directive: bool


def tokenize(source: str) -> list[Token]:
    """Return the tokens of a source file, without white space, comments and line splices."""
    tokens: list[Token] = []
    at_line_start, in_directive = True, False
    for match in _LEXER.finditer(source):
        if match["hidden"] is not None:
            continue
        if match["space"] is not None:
            if "\n" in match[0]:
                at_line_start, in_directive = True, False
            continue
        in_directive = in_directive or (at_line_start and match[0] == "#")
        at_line_start = False
        tokens.append(Token(match[0], match.start(), match.end(), in_directive))
    return tokens


def occurrences(tokens: Sequence[Token], pattern: str, span: range) -> list[range]:
    """Return where a sequence of tokens occurs inside `span`, as ranges of token indices.

    Bodies of macros are skipped, since no line can be inserted there. A pattern that starts with `#` finds directives.
    """
    wanted = [token.text for token in tokenize(pattern)]
    directives = wanted[:1] == ["#"]
    texts = [token.text for token in tokens]
    candidates = (i for i in range(span.start, span.stop - len(wanted) + 1) if texts[i] == wanted[0])
    matches = (range(i, i + len(wanted)) for i in candidates if texts[i : i + len(wanted)] == wanted)
    return [match for match in matches if directives or not any(tokens[i].in_directive for i in match)]


def unconditional(tokens: Sequence[Token], directive: str) -> bool:
    """Return whether the file has a directive outside of every #if, so that it always applies."""
    depth = 0
    starts = {match.start for match in occurrences(tokens, directive, range(len(tokens)))}
    for i, token in enumerate(tokens):
        if i in starts and depth == 0:
            return True
        if token.text == "#" and token.in_directive and i + 1 < len(tokens):
            depth += (tokens[i + 1].text in _CONDITIONS) - (tokens[i + 1].text == "endif")
    return False


def definitions(tokens: Sequence[Token], name: str) -> list[range]:
    """Return the definitions of functions called `name` (qualified as in the file), from the name to the last brace."""
    bodies = []
    for match in occurrences(tokens, name, range(len(tokens))):
        if match.start > 0 and tokens[match.start - 1].text == ":":
            continue  # the same name in another class or namespace
        end = _matching(tokens, match.stop, "(")
        while end is not None and end < len(tokens) and tokens[end].text in _AFTER_PARAMETERS:
            end += 1
        end = None if end is None else _matching(tokens, end, "{")
        if end is not None:
            bodies.append(range(match.start, end))
    return bodies


def _matching(tokens: Sequence[Token], start: int, opening: str) -> int | None:
    """Return the index after the bracket that closes the one at `start`, or None without one."""
    if start >= len(tokens) or tokens[start].text != opening:
        return None
    depth = 0
    for i in range(start, len(tokens)):
        if not tokens[i].in_directive:  # a macro's brackets need not balance
            depth += (tokens[i].text == opening) - (tokens[i].text == _CLOSING[opening])
        if depth == 0:
            return i + 1
    return None
