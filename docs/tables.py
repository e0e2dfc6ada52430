"""Write the tables of docs/results.md and its note from the measured runs in docs/data/.

Run `python docs/tables.py` after changing a data file; a test compares the document with it. A table stands between
`<!-- table: NAME -->` and `<!-- end -->`. Each row of a data file is one run; a table shows means over seeds.

`lapgs report RUN --csv docs/data/train.csv` appends the row of a measured run to train.csv. Replace
the method "own script" of an imported run by the script's name there, such as FastGS.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from statistics import fmean

from curves import Point, at_time, points_of

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "docs/data"
DOCUMENTS = (ROOT / "docs/results.md", ROOT / "docs/notes/2026-11-results.md")
MARKED = re.compile(r"(<!-- table: ([\w-]+) -->\n).*?(<!-- end -->)", re.DOTALL)

Run = Mapping[str, str]
Runs = Sequence[Run]
METHODS = ("FastGS", "own script", "one field", "nested", "laplacian")
QUALITY = {
    "PSNR (dB)": ("psnr", "{:.2f}"),
    "after fit (dB)": ("psnr_fit", "{:.2f}"),
    "SSIM": ("ssim", "{:.4f}"),
    "LPIPS": ("lpips", "{:.4f}"),
}
OURS = "--rasterizer lapgs"
"""Option of runs of checkouts with our rasterizer; their own scripts beside them have their own."""
EARLIEST = 0.7
"""Seconds, by those of the first point of a curve, before which it is not read."""
COST = {"peak GB": ("peak_gb", "{:.2f}")}


def rewritten(text: str) -> str:
    """Return a document with the contents of its tables made anew."""
    return MARKED.sub(lambda match: match[1] + TABLES[match[2]]() + match[3], text)


def runs_of(name: str) -> Runs:
    """Return the runs of a data file."""
    with (DATA / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def mean(runs: Runs, column: str) -> float | None:
    """Return the mean of a column over the runs that have it; None if none has."""
    values = [float(run[column]) for run in runs if run[column]]
    return fmean(values) if values else None


def shown(value: float | None, form: str) -> str:
    return "" if value is None else form.format(value)


def grouped(runs: Runs, *columns: str) -> dict[tuple[str, ...], dict[str, list[Run]]]:
    """Return runs by the values of columns, then by method, in the order of the file."""
    groups: dict[tuple[str, ...], dict[str, list[Run]]] = {}
    for run in runs:
        groups.setdefault(tuple(run[name] for name in columns), {}).setdefault(run["method"], []).append(run)
    return groups


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; text columns are the first two."""
    lines = [header, ["---" if n < 2 else "--:" for n in range(len(header))], *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def measured(runs: Runs, baseline: Runs, columns: Mapping[str, tuple[str, str]]) -> list[str]:
    """Return the cells of a group of runs: seconds, how many times as fast as the baseline, and the named columns."""
    seconds, base = mean(runs, "seconds"), mean(baseline, "seconds")
    ratio = base / seconds if seconds and base and runs is not baseline else None
    cells = [shown(mean(runs, name), form) for name, form in columns.values()]
    return [shown(seconds, "{:.1f}"), shown(ratio, "{:.2f}x"), *cells]


def compared(name: str, baseline: str, titles: Callable[[Run], str], groups: Sequence[str], with_fit: bool) -> str:
    """Return a table with a row for each method of each group of runs."""
    columns = {**{title: QUALITY[title] for title in QUALITY if with_fit or title != "after fit (dB)"}, **COST}
    header = ["", "method", "seconds", f"against {baseline}", *columns, "runs"]
    rows = []
    for methods in grouped(runs_of(name), *groups).values():
        first = titles(next(iter(methods.values()))[0])
        for method in sorted(methods, key=METHODS.index):
            cells = measured(methods[method], methods[baseline], columns)
            rows.append([first, method, *cells, str(len(methods[method]))])
            first = ""
    return markdown(header, rows)


def scene_title(run: Run) -> str:
    return f"{run['scene']}, {run['views']} of {run['width']}x{run['height']}"


def train() -> str:
    """Return `lapgs train` on a GPU beside FastGS's own script."""
    return compared("train", "one field", scene_title, ("scene",), with_fit=True)


def equal_time() -> str:
    """Return the shortest and longest runs of hierarchies against one field: after the same seconds, at its best."""
    gains = ["PSNR", "after fit", "LPIPS"]
    header = ["", "method", "shortest: seconds", *gains, "default: seconds", *gains]
    header += ["against its best: time", "after fit", "LPIPS"]
    rows = []
    runs = runs_of("curves")
    for scene in dict.fromkeys(run["scene"] for run in runs):
        here = [run for run in runs if run["scene"] == scene]
        field = points_of(here, "one field")
        most = max(field, key=lambda point: point["psnr_fit"])
        first = scene_title(here[0])
        for method in ("nested", "laplacian"):
            points = points_of(here, method)
            last = points[-1]
            cells = [
                cell
                for point in (points[0], last)
                for cell in (f"{point['seconds']:.1f}", *at_equal_time(point, field))
            ]
            cells += [f"{last['seconds'] / most['seconds']:.2f}", f"{last['psnr_fit'] - most['psnr_fit']:+.2f}"]
            rows.append([first, method, *cells, f"{last['lpips'] / most['lpips'] - 1:+.1%}"])
            first = ""
    return markdown(header, rows)


def at_equal_time(point: Point, field: Sequence[Point]) -> list[str]:
    """Return how much more PSNR, as it is and after the fit, and LPIPS a point has than one field by then.

    The cells are empty where one field was not measured so early.
    """
    if point["seconds"] < EARLIEST * field[0]["seconds"]:
        return [""] * 3
    then = at_time(field, point["seconds"])
    gains = [f"{point[name] - then[name]:+.2f}" for name in ("psnr", "psnr_fit")]
    return [*gains, f"{point['lpips'] / then['lpips'] - 1:+.1%}"]


def ours() -> str:
    """Return checkouts that our rasterizer renders beside their own scripts, one a row."""
    columns = {"PSNR": ("psnr", "{:.2f} dB"), "peak": ("peak_gb", "{:.2f} GB")}
    methods = [method for method in METHODS if method != "FastGS"]
    rows = []
    runs = [run for run in runs_of("checkouts") if run["options"] == OURS]
    for (checkout, scene), groups in grouped(runs, "checkout", "scene").items():
        cells = [measured(groups[method], groups["own script"], columns) for method in methods]
        rows.append([checkout, scene, *(f"{cell[0]} s, " + ", ".join(filter(None, cell[1:])) for cell in cells)])
    return markdown(["", "scene", *methods], rows)


def checkouts(fastgs: bool) -> str:
    """Return checkouts with their own rasterizer under `lapgs run` beside their own scripts: FastGS, or the others."""

    def title(run: Run) -> str:
        options = f", `{run['options']}`" if run["options"] else ""
        return f"{run['checkout']}, {run['scene']}{options} ({run['gpu']}, {run['date']})"

    runs = [run for run in runs_of("checkouts") if run["options"] != OURS and (run["checkout"] == "FastGS") == fastgs]
    columns = {title: QUALITY[title] for title in ("PSNR (dB)", "LPIPS")} | {"peak GB": COST["peak GB"]}
    rows = []
    for methods in grouped(runs, "checkout", "scene").values():
        first = title(methods["own script"][0])
        for method in sorted(methods, key=METHODS.index):
            rows.append([first, method, *measured(methods[method], methods["own script"], columns)])
            first = ""
    return markdown(["", "method", "seconds", "against its script", *columns], rows)


def cpu() -> str:
    """Return `lapgs train` without a GPU."""
    columns = {"PSNR (dB)": QUALITY["PSNR (dB)"]}
    rows = []
    for (scene,), methods in grouped(runs_of("cpu"), "scene").items():
        for n, (method, runs) in enumerate(methods.items()):
            rows.append(["" if n else scene, method, *measured(runs, methods["one field"], columns), str(len(runs))])
    return markdown(["", "method", "seconds", "against one field", *columns, "runs"], rows)


TABLES: dict[str, Callable[[], str]] = {
    "train": train,
    "equal-time": equal_time,
    "ours": ours,
    "fastgs": lambda: checkouts(fastgs=True),
    "forks": lambda: checkouts(fastgs=False),
    "cpu": cpu,
}

if __name__ == "__main__":
    for document in DOCUMENTS:
        document.write_text(rewritten(document.read_text(encoding="utf-8")), encoding="utf-8")
