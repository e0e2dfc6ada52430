"""Let runs of a checkout train beside each other on one machine: a port that is taken costs its viewer, not the run.

Scripts of the family listen for 3DGS's viewer at `--port`, 6009 unless it is given. A second run on the machine, as
`lapgs bench` starts them on several GPUs, would fail at that.
"""

from __future__ import annotations

import errno
import inspect
import logging
import socket
from collections.abc import Callable
from functools import wraps
from typing import Any

from lapgs_plugin.checkouts.attachment import Replacement
from lapgs_plugin.checkouts.profile import Profile

logger = logging.getLogger(__name__)

MODULE, LISTEN = "network_gui", "init"
"""The family's module for its viewer, and its function of host and port."""


def sharing_ports(profile: Profile) -> list[Replacement]:
    """Return the replacements of the functions that listen for a viewer."""
    held = [(module, name) for module, name in profile.named([LISTEN]) if module.__name__.endswith(f".{MODULE}")]
    found = [(module, name) for module, name in held if inspect.isfunction(getattr(module, name))]
    return [Replacement(*place, _at_a_free_port, "the main block, for a viewer") for place in found]


def _at_a_free_port(original: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(original)
    def init(host: str, port: int) -> Any:
        try:
            return original(host, port)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
        result = original(host, 0)  # any port that is free
        sockets = [each for each in original.__globals__.values() if isinstance(each, socket.socket)]
        at = ", ".join(str(each.getsockname()[1]) for each in sockets)
        logger.warning("port %s is taken, perhaps by another run; the checkout's viewer finds this run at %s", port, at)
        return result

    return init
