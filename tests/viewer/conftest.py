"""Share the scene and run of the commands' tests."""

from tests.cli.conftest import run, scene

__all__ = ["run", "scene"]
