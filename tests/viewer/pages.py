"""Request a page as browsers do that come from other pages."""

from __future__ import annotations

import urllib.error
import urllib.request


def statuses(address: str) -> list[int]:
    """Return the status for a browser that opened the page, for a foreign page, and for a foreign name."""
    requests: list[dict[str, str]] = [{}, {"Origin": "http://evil.example"}, {"Host": "evil.example"}]
    return [_status(urllib.request.Request(address, headers=headers)) for headers in requests]


def _status(request: urllib.request.Request) -> int:
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as refused:
        with refused:
            return refused.code
