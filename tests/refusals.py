"""Check that a call is refused as users see it: by an error of one line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from lapgs_plugin.errors import LapgsError


def refuses(kind: type[LapgsError], facts: str, call: Callable[..., object], *arguments: Any, **options: Any) -> str:
    """Call with arguments, check that it raises one line of an error, and return the line.

    Args:
        kind: class of the error.
        facts: pattern to find in the line, such as the file, the value and the expectation.
        call: function that has to raise.
        arguments, options: of the call.
    """
    with pytest.raises(kind, match=facts) as caught:
        call(*arguments, **options)
    line = str(caught.value)
    assert "\n" not in line
    return line
