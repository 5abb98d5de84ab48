"""The report as LaTeX tables in the style of booktabs."""

from __future__ import annotations

from srlrace.report.layout import OTHERS_TITLE, Grid, footnotes, grid, heading, others_grid
from srlrace.report.markdown import TEXT_COLUMNS
from srlrace.report.model import Report, Table

REPLACEMENTS = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#", "%": r"\%", "_": r"\_",
    "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "[": r"{[}", "]": r"{]}", '"': r"\textquotedbl{}", "`": r"\textasciigrave{}",
}  # fmt: skip
PREAMBLE = "% \\usepackage{booktabs}; \\usepackage[T1]{fontenc}\n"


def render_latex(report: Report) -> str:
    """Return the tables, each a float of its own, to be \\input into a document."""
    parts = [latex_table(table) for table in report.tables]
    if report.others:
        parts.append(_float(others_grid(report.others), OTHERS_TITLE, "others", ()))
    return PREAMBLE + "\n".join(parts)


def latex_table(table: Table) -> str:
    """Return one table with its caption, label and footnotes."""
    return _float(grid(table), heading(table), table.experiment.name, footnotes(table))


def escape(text: str) -> str:
    """Return text that LaTeX prints as it is, on one line."""
    return "".join(REPLACEMENTS.get(character, character) for character in " ".join(text.split()))


def _float(grid: Grid, caption: str, label: str, notes: tuple[str, ...]) -> str:
    columns = "".join("l" if name in TEXT_COLUMNS else "r" for name in grid.head)
    rows = "".join(f"{' & '.join(map(escape, row))} \\\\\n" for row in grid.rows)
    lines = "".join(f"\\par {escape(line)}\n" for line in notes)
    return (
        "\\begin{table*}[t]\n\\centering\n"
        f"\\caption{{{escape(caption)}}}\n\\label{{tab:{label}}}\n"
        f"\\begin{{tabular}}{{{columns}}}\n\\toprule\n"
        f"{' & '.join(map(escape, grid.head))} \\\\\n\\midrule\n{rows}\\bottomrule\n\\end{{tabular}}\n"
        f"\\begin{{minipage}}{{\\linewidth}}\\footnotesize\n{lines}\\end{{minipage}}\n\\end{{table*}}\n"
    )
