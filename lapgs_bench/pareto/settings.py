"""Declare the options of `lapgs bench pareto`."""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from lapgs_bench.experiments.settings import Selection
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.files import is_file
from lapgs_plugin.options import option

CHECKOUTS = "Checkouts"


def parse_budgets(text: str) -> list[float]:
    """Return budgets in seconds.

    >>> parse_budgets("5,10,20")
    [5.0, 10.0, 20.0]

    Raises:
        UserInputError: they are no positive, rising numbers.
    """
    try:
        budgets = [float(part) for part in text.split(",")]
    except ValueError as error:
        raise UserInputError(f"--budgets {text}: expected seconds separated by commas, such as 5,10,20,40") from error
    if not all(0.0 < budget < math.inf for budget in budgets):
        raise UserInputError(f"--budgets {text}: expected seconds above 0, such as 5,10,20,40")
    if any(after <= before for before, after in pairwise(budgets)):
        raise UserInputError(f"--budgets {text}: expected rising seconds, such as 5,10,20,40")
    return budgets


@dataclass(frozen=True)
class ParetoSettings:
    """Choose the budgets, the methods and the scene's images.

    Raises:
        UserInputError: budgets or seeds are no such lists, or a file is missing.
    """

    budgets_text: str = option(
        "5,10,20,40", "Seconds of optimization of each method's runs, rising.", names=("--budgets",), metavar="SECONDS"
    )
    seeds: str = option("0", "Seeds, such as 0,1. Points are means over them.")
    out: Path | None = option(None, "Folder for runs and results. Default: runs/pareto/SCENE.", names=("--out", "-o"))
    resolution: str = option("full", "Image size, as for `lapgs train`.")
    images: str = option("images", "Image folder of the scene, such as images_4.")
    rasterizer: str = option("auto", "Rasterizer of `lapgs train`.")
    lpips_weights: list[Path] | None = option(None, "Weights of an LPIPS network for `lapgs eval`. Repeatable.")
    checkouts: list[Path] | None = option(
        None,
        "Also run this checkout: its script by itself and under `lapgs run`. Repeatable.",
        panel=CHECKOUTS,
        names=("--checkout",),
    )
    checkout_options: list[str] | None = option(
        None,
        "Options of the checkout's script in one text, such as '--mult 0.7'. Once for all checkouts, or once for each.",
        panel=CHECKOUTS,
    )
    device: str = option("auto", "Device of checkouts: cuda, cpu or auto, as for `lapgs run`.", panel=CHECKOUTS)

    def __post_init__(self) -> None:
        _ = self.budgets, self.seed_list, self.script_options
        for file in self.lpips_weights or []:
            if not is_file(file):
                raise UserInputError(f"--lpips-weights {file}: no such file; expected the weights of an LPIPS network")

    @property
    def budgets(self) -> list[float]:
        """Seconds of optimization."""
        return parse_budgets(self.budgets_text)

    @property
    def seed_list(self) -> list[int]:
        """Seeds of all methods."""
        return Selection(seeds=self.seeds).seeds_or([])

    @property
    def script_options(self) -> list[tuple[Path, list[str]]]:
        """Checkouts with the options of their scripts."""
        checkouts, texts = self.checkouts or [], self.checkout_options or [""]
        if not checkouts and self.checkout_options:
            raise UserInputError(f"--checkout-options {texts[0]!r}: there is no --checkout; give its folder")
        if len(texts) not in (1, len(checkouts)):
            raise UserInputError(
                f"--checkout-options is given {len(texts)} times for {len(checkouts)} checkouts; give it once for all, "
                "or once for each"
            )
        if len(texts) == 1:
            texts = texts * len(checkouts)
        try:
            return [(folder, shlex.split(text)) for folder, text in zip(checkouts, texts, strict=True)]
        except ValueError as error:
            raise UserInputError(f"--checkout-options {texts!r}: {error}; expected options as in a shell") from error
