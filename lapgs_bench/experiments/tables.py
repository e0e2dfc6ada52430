"""Write a table of results as Markdown and LaTeX, with the paper's figures beside the measured ones."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from lapgs_bench.experiments.aggregate import COLUMNS, Cell, Column, Group, Ratio, ResultTable, TableRow

GROUPS_BESIDE = 3
"""Data sets or scenes side by side in a LaTeX table, as in the paper."""
ARROWS = {"lower": "↓", "higher": "↑", "": ""}
TEX = {
    **{"N_GS": r"$N_{\mathrm{GS}}$", "rho": r"$\rho$", "↓": r"$\downarrow$", "↑": r"$\uparrow$", "±": r"$\pm$"},
    **{"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"},
}
"""Words and characters in LaTeX, besides the characters that a backslash escapes."""
SPEEDUP, GAIN = "Speed-up", "Change of PSNR (dB)"
NO_VALUE = "-"
PAPER_CONDITIONS = "30,000 iterations unless said; NVIDIA L40 at 1K, Pro6000 at 2K and 4K"


def markdown(table: ResultTable) -> str:
    """Write the table as Markdown."""
    lines = [f"# {table.experiment.title}", "", _legend(table), ""]
    shape = table.experiment.table
    write = _markdown_transposed if shape.transposed else _markdown_rows
    for group in (*table.groups, *table.scenes):
        lines += [f"## {group.title}", "", *write(group, shape.columns), ""]
        lines += [*group.notes, ""] if group.notes else []
    return "\n".join(lines).rstrip() + "\n"


def latex(table: ResultTable) -> str:
    r"""Write the table as LaTeX; it needs booktabs and prints the paper's figures through \paper{...}."""
    parts = [
        "% Needs \\usepackage{booktabs,multirow}. Measured figures; the paper's in small print.",
        r"\providecommand{\paper}[1]{{\scriptsize\,[#1]}}",
    ]
    title, label = table.experiment.title, table.experiment.name
    parts += _latex_table(table, table.groups, title, label)
    if table.scenes:
        parts += ["", *_latex_table(table, table.scenes, f"{title}, scene by scene", f"{label}-scenes")]
    return "\n".join(parts) + "\n"


def _legend(table: ResultTable) -> str:
    seeds = max((cell.seeds for group in table.groups for row in group.rows for cell in row.cells.values()), default=0)
    spread = f"Means ± sample deviation over {seeds} seeds" if seeds > 1 else "One seed"
    has_paper = any(c.paper for group in table.groups for row in group.rows for c in row.cells.values())
    paper = f"; the paper's figures in brackets ({PAPER_CONDITIONS})" if has_paper else ""
    bases = {row.label for group in table.groups for row in group.rows if row.is_baseline}
    against = f"Speed-up and change of PSNR are against {', '.join(sorted(bases))}."
    return f"Measured: {table.measured}. {spread}{paper}. {against}"


def _markdown_rows(group: Group, columns: Sequence[str]) -> Iterator[str]:
    yield _markdown_line(["", *map(_heading, columns), SPEEDUP, GAIN])
    yield _markdown_line(["---"] * (len(columns) + 3))
    section = ""
    for row in group.rows:
        if row.section != section:
            section = row.section
            yield _markdown_line([f"**{section}**", *[""] * (len(columns) + 2)])
        yield _markdown_line([row.label, *(_text(row.cells[name], COLUMNS[name]) for name in columns), *_ratios(row)])


def _heading(column: str) -> str:
    return COLUMNS[column].heading + ARROWS[COLUMNS[column].better]


def _markdown_transposed(group: Group, columns: Sequence[str]) -> Iterator[str]:
    yield _markdown_line(["", *(row.label for row in group.rows)])
    yield _markdown_line(["---"] * (len(group.rows) + 1))
    for name in columns:
        yield _markdown_line([COLUMNS[name].heading, *(_text(row.cells[name], COLUMNS[name]) for row in group.rows)])


def _markdown_line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _ratios(row: TableRow) -> list[str]:
    if row.is_baseline:
        return ["", ""]
    return [_ratio(row.speedup, "{:.2f}x"), _ratio(row.psnr_gain, "{:+.2f}")]


def _ratio(ratio: Ratio, pattern: str) -> str:
    measured = NO_VALUE if ratio.measured is None else pattern.format(ratio.measured)
    return measured if ratio.paper is None else f"{measured} [{pattern.format(ratio.paper)}]"


def _text(cell: Cell, column: Column) -> str:
    """Format a cell: 0.71/0.87 ±0.01 [0.70/0.88]."""
    measured = _number(cell.values, column) or NO_VALUE
    if cell.deviation is not None:
        measured += f" ±{cell.deviation:.{column.decimals}f}"
    return measured if cell.paper is None else f"{measured} [{_number(cell.paper.values, column)}]"


def _number(values: Sequence[float], column: Column) -> str:
    return "/".join(f"{value:,.{column.decimals}f}" for value in values)


def _latex_table(table: ResultTable, groups: Sequence[Group], title: str, label: str) -> list[str]:
    lines = [
        r"\begin{table*}[t]",
        r"\centering",
        rf"\caption{{{_escaped(title)}.}}",
        rf"\label{{tab:{label}}}",
        r"\small",
    ]
    shape = table.experiment.table
    if shape.transposed:
        for group in groups:
            lines += _latex_transposed(group, shape.columns)
    else:
        lines += _latex_blocks(groups, shape.columns)
    notes = dict.fromkeys([_legend(table), *(note for group in groups for note in group.notes)])
    return [*lines, *(rf"\par\footnotesize {_escaped(note)}" for note in notes), r"\end{table*}"]


def _latex_blocks(groups: Sequence[Group], columns: Sequence[str]) -> Iterator[str]:
    """Write groups side by side, in blocks below each other."""
    width = len(columns) + 2
    beside = min(GROUPS_BESIDE, len(groups))
    yield rf"\begin{{tabular}}{{l{('c' * width) * beside}}}"
    yield r"\toprule"
    for start in range(0, len(groups), beside):
        block = groups[start : start + beside]
        if start:
            yield r"\midrule\midrule"
        titles = [rf"\multicolumn{{{width}}}{{c}}{{\textbf{{{_escaped(group.title)}}}}}" for group in block]
        yield " & ".join(["", *titles]) + r" \\"
        yield "".join(rf"\cmidrule(lr){{{2 + i * width}-{1 + (i + 1) * width}}}" for i in range(len(block)))
        headings = [_escaped(_heading(name)) for name in columns]
        yield " & ".join(["", *[*headings, SPEEDUP, r"$\Delta$PSNR"] * len(block)]) + r" \\"
        yield r"\midrule"
        yield from _latex_rows(block, columns, 1 + width * beside)
    yield r"\bottomrule"
    yield r"\end{tabular}"


def _latex_rows(block: Sequence[Group], columns: Sequence[str], width: int) -> Iterator[str]:
    by_label = [{row.label: row for row in group.rows} for group in block]
    rows = {row.label: row for group in block for row in group.rows}
    section = ""
    for label, row in rows.items():
        if row.section != section:
            section = row.section
            yield rf"\multicolumn{{{width}}}{{l}}{{\textbf{{{_escaped(section)}}}}} \\"
        cells = []
        for found in by_label:
            own = found.get(label)
            if own is None:
                cells += [""] * (len(columns) + 2)
                continue
            texts = [*(_text(own.cells[name], COLUMNS[name]) for name in columns), *_ratios(own)]
            cells += map(_latex_marked, texts)
        yield " & ".join([_escaped(label), *cells]) + r" \\"


def _latex_transposed(group: Group, columns: Sequence[str]) -> Iterator[str]:
    yield rf"\begin{{tabular}}{{l{'c' * len(group.rows)}}}"
    yield r"\toprule"
    yield " & ".join([_escaped(group.title), *(_escaped(row.label) for row in group.rows)]) + r" \\"
    yield r"\midrule"
    for name in columns:
        cells = [_latex_marked(_text(row.cells[name], COLUMNS[name])) for row in group.rows]
        yield " & ".join([_escaped(COLUMNS[name].heading), *cells]) + r" \\"
    yield r"\bottomrule"
    yield r"\end{tabular}"


def _latex_marked(text: str) -> str:
    r"""Convert 1.0 ±0.1 [2.0] to 1.0 $\pm$0.1\paper{2.0}."""
    measured, bracket, paper = text.partition(" [")
    return _escaped(measured) + (rf"\paper{{{_escaped(paper.removesuffix(']'))}}}" if bracket else "")


def _escaped(text: str) -> str:
    return re.sub(r"N_GS|\brho\b|[&%#_${}~^\\↓↑±]", lambda found: TEX.get(found[0], f"\\{found[0]}"), text)
