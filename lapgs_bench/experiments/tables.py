"""Write a table of results as Markdown and LaTeX, with the paper's figures beside the measured ones."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from lapgs_bench.experiments.aggregate import COLUMNS, Cell, Column, Group, Ratio, ResultTable, TableRow
from lapgs_bench.experiments.schema import Table

GROUPS_BESIDE = 3
"""Data sets or scenes side by side in a LaTeX table, as in the paper."""
SPEEDUP, GAIN = "Speed-up", "Change of PSNR (dB)"
ARROWS = {"lower": "↓", "higher": "↑", "": ""}
TEX = {
    **{"N_GS": r"$N_{\mathrm{GS}}$", "rho": r"$\rho$", "↓": r"$\downarrow$", "↑": r"$\uparrow$", "±": r"$\pm$"},
    **{"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"},
    GAIN: r"$\Delta$PSNR",
}
"""Words and characters in LaTeX, besides the characters that a backslash escapes."""
NO_VALUE = "-"
PAPER_CONDITIONS = "30,000 iterations unless said; NVIDIA L40 at 1K, Pro6000 at 2K and 4K"


def markdown(table: ResultTable) -> str:
    """Write the table as Markdown."""
    lines = [f"# {table.experiment.title}", "", _legend(table), ""]
    for group in (*table.groups, *table.scenes):
        header, *rows = _grid(group, table.experiment.table)
        lines += [f"## {group.title}", "", _markdown_line(header), _markdown_line(["---"] * len(header))]
        lines += [_markdown_line(row if len(row) > 1 else _heading(row[0], len(header))) for row in rows]
        lines += ["", *group.notes, ""] if group.notes else [""]
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


def _grid(group: Group, shape: Table) -> Iterator[list[str]]:
    """Yield the cells of a group line by line, its headings first. A line of one cell is the heading of a section."""
    if shape.transposed:
        yield ["", *(row.label for row in group.rows)]
        for name in shape.columns:
            yield [COLUMNS[name].heading, *(_text(row.cells[name], COLUMNS[name]) for row in group.rows)]
        return
    yield ["", *(COLUMNS[name].heading + ARROWS[COLUMNS[name].better] for name in shape.columns), SPEEDUP, GAIN]
    section = ""
    for row in group.rows:
        if row.section != section:
            section = row.section
            yield [section]
        yield [row.label, *(_text(row.cells[name], COLUMNS[name]) for name in shape.columns), *_ratios(row)]


def _markdown_line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _heading(section: str, columns: int) -> list[str]:
    """Return the cells of a section's heading; rows without a section follow an empty line."""
    return [f"**{section}**" if section else "", *[""] * (columns - 1)]


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
    """Write groups side by side, in blocks below each other; transposed ones as tables of their own."""
    lines = [
        r"\begin{table*}[t]",
        r"\centering",
        rf"\caption{{{_escaped(title)}.}}",
        rf"\label{{tab:{label}}}",
        r"\small",
    ]
    shape, width = table.experiment.table, len(table.experiment.table.columns) + 2
    if shape.transposed:
        for group in groups:
            lines += _tabular(len(group.rows), [*_latex_lines([group], shape, group.title)])
    else:
        beside = min(GROUPS_BESIDE, len(groups))
        blocks: list[str] = []
        for start in range(0, len(groups), beside):
            block = groups[start : start + beside]
            titles = [rf"\multicolumn{{{width}}}{{c}}{{\textbf{{{_escaped(group.title)}}}}}" for group in block]
            rules = [rf"\cmidrule(lr){{{2 + i * width}-{1 + (i + 1) * width}}}" for i in range(len(block))]
            blocks += [r"\midrule\midrule"] if start else []
            blocks += [" & ".join(["", *titles]) + r" \\", "".join(rules), *_latex_lines(block, shape)]
        lines += _tabular(width * beside, blocks)
    notes = dict.fromkeys([_legend(table), *(note for group in groups for note in group.notes)])
    return [*lines, *(rf"\par\footnotesize {_escaped(note)}" for note in notes), r"\end{table*}"]


def _tabular(columns: int, lines: Sequence[str]) -> list[str]:
    return [rf"\begin{{tabular}}{{l{'c' * columns}}}", r"\toprule", *lines, r"\bottomrule", r"\end{tabular}"]


def _latex_lines(block: Sequence[Group], shape: Table, corner: str = "") -> Iterator[str]:
    """Write groups side by side, which have the same rows."""
    (_, *header), *rows = (
        [line[0][0], *(cell for cells in line for cell in cells[1:])]
        for line in zip(*(_grid(group, shape) for group in block), strict=True)
    )
    yield " & ".join(map(_escaped, [corner, *header])) + r" \\"
    yield r"\midrule"
    for label, *cells in rows:
        if cells:
            yield " & ".join([_escaped(label), *map(_latex_marked, cells)]) + r" \\"
        else:
            yield rf"\multicolumn{{{1 + len(header)}}}{{l}}{{\textbf{{{_escaped(label)}}}}} \\"


def _latex_marked(text: str) -> str:
    r"""Convert 1.0 ±0.1 [2.0] to 1.0 $\pm$0.1\paper{2.0}."""
    measured, bracket, paper = text.partition(" [")
    return _escaped(measured) + (rf"\paper{{{_escaped(paper.removesuffix(']'))}}}" if bracket else "")


def _escaped(text: str) -> str:
    special = rf"{re.escape(GAIN)}|N_GS|\brho\b|" + r"[&%#_${}~^\\↓↑±]"
    return re.sub(special, lambda match: TEX.get(match[0], f"\\{match[0]}"), text)
