"""Tables in Markdown; the same text serves the terminal and the file."""

from __future__ import annotations

from collections.abc import Sequence


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table with aligned columns: the first to the left, the others to the right.

    Cells are names, too, of which any may have a bar or a line break in it.
    """
    header, *rows = ([cell.replace("|", "\\|").replace("\n", "\\n") for cell in row] for row in (header, *rows))
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]

    def line(cells: Sequence[str]) -> str:
        padded = [c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(cells, widths, strict=True))]
        return "| " + " | ".join(padded) + " |"

    rule = "|" + "|".join("-" * (w + 2) if i == 0 else "-" * (w + 1) + ":" for i, w in enumerate(widths)) + "|"
    return "\n".join([line(header), rule, *map(line, rows)])


def decimals(value: float | None, places: int = 3) -> str:
    """`.432` as in the paper's tables; 1.000 keeps its leading digit, and a missing value is a dash."""
    if value is None:
        return "-"
    text = f"{value:.{places}f}"
    return text[1:] if text.startswith("0.") else text


def significant(value: float | None) -> str:
    """Three significant digits without an exponent; a missing value is a dash."""
    if value is None:
        return "-"
    if abs(value) >= 100:
        return f"{value:.0f}"
    return f"{value:.3g}" if abs(value) >= 1e-3 else f"{value:.4f}".rstrip("0").rstrip(".")


def bold_best(cells: list[str], values: Sequence[float | None], largest: bool = True) -> list[str]:
    """The cells with the best value in bold, ties too, as they are printed.

    Args:
        cells: as printed.
        values: of the cells; None where there is none.
        largest: whether the largest value is the best.
    """
    known = [value for value in values if value is not None]
    if not known:
        return cells
    winner = max(known) if largest else min(known)
    printed = {cell for cell, value in zip(cells, values, strict=True) if value == winner}
    return [f"**{cell}**" if cell in printed else cell for cell in cells]


def columns_to_rows(labels: Sequence[str], columns: Sequence[list[str]]) -> list[list[str]]:
    """Table rows from a label column and cell columns."""
    return [[label, *(column[i] for column in columns)] for i, label in enumerate(labels)]
