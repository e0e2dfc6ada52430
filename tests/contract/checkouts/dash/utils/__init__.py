"""Helpers: those of this checkout, and those that are the same in all stub checkouts."""

from pathlib import Path

__path__.append(str(Path(__file__).parents[2] / "shared" / "utils"))
