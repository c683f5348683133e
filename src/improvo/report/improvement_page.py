"""`report.html` of self-improvement: is the frontend better than before, by how much, and what did it cost?"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from improvo.report.charts import line_chart
from improvo.report.page import Page, plain
from improvo.report.plain_words import LABEL_WORDS


@dataclass(frozen=True)
class Measure:
    """A measure that is compared over all rounds."""

    name: str  # with its unit, and the solver where one matters: "rotation < 5 degrees, gap 30, poselib"
    meaning: str
    larger_is_better: bool = True
    digits: int = 3


@dataclass(frozen=True)
class Round:
    """One frontend and its results; the first is the one before any improvement."""

    name: str
    values: dict[str, float] = field(default_factory=dict)  # by name of the measure
    labels: dict[str, int] = field(default_factory=dict)  # tracks by label, as made with this frontend
    seconds: dict[str, float] = field(default_factory=dict)  # by stage: label, train, evaluate
    pictures: tuple[tuple[Path, str], ...] = ()  # PNG files with their captions
    losses: dict[str, list[float]] = field(default_factory=dict)  # of its training by name, and `step`
    aside: bool = False  # a control, which no other round follows from


def write_improvement_page(
    path: Path,
    title: str,
    lead: str,
    measures: Sequence[Measure],
    rounds: Sequence[Round],
    notes: Sequence[str] = (),
    best: int = -1,
    verdict: str = "",
    gains: Sequence[Sequence[str]] = (),
) -> None:
    """Write the page.

    Args:
        path: the HTML file.
        title: of the page.
        lead: what was improved on what, in a line.
        measures: in the order of their weight; the first heads the page.
        rounds: at least one; the first is the frontend before.
        notes: what the reader should know, in plain words.
        best: the round that is held against the first.
        verdict: which round is kept, and why; each line is a paragraph.
        gains: a header and a row for each round after the first, gains over the first with their intervals.
    """
    first, last = rounds[0], rounds[best]
    page = Page(title, lead)
    page.tiles(
        [
            (_change(measure, first, last), measure.name)
            for measure in measures[:4]
            if measure.name in first.values and measure.name in last.values
        ]
    )
    for paragraph in verdict.splitlines():
        page.paragraph(paragraph)
    page.heading("What to look out for")
    nothing = "every measure is at least as good as before" if best else "the weights are those at the start"
    page.warnings([*notes, *_setbacks(measures, first, last)], f"Nothing: {nothing}.")
    if len(gains) > 1:
        page.heading("Gain over the start")
        page.table(list(gains[0]), [list(row) for row in gains[1:]], "In brackets 95 % intervals over the same pairs.")
    page.heading("Before and after")
    page.table(
        ["", *(entry.name for entry in rounds)],
        [[measure.name, *_cells(measure, rounds)] for measure in measures],
        "The best of each row is bold.",
    )
    page.details("What the rows mean", _meanings(measures))
    # where nothing was kept, the last try is held against the start
    tried = [entry for entry in rounds[1:] if not entry.aside]
    after, kept = (last, "") if last is not first else (tried[-1] if tried else None, ", not kept")
    for place in range(max(len(entry.pictures) for entry in rounds)):
        shown = [
            (picture, f"{entry.name}{kept if entry is after else ''}: {caption}")
            for entry in (first, after)
            if entry is not None
            for picture, caption in entry.pictures[place : place + 1]
        ]
        page.side_by_side(shown)
    in_order = [entry for entry in rounds if not entry.aside]
    if len(in_order) > 2:
        _curves(page, measures, in_order)
    names = list(dict.fromkeys(name for entry in rounds for name in entry.labels))
    if names:
        page.heading("Labels")
        page.table(
            ["made with", *names],
            [[entry.name, *(f"{entry.labels.get(name, 0):,}" for name in names)] for entry in rounds if entry.labels],
            "Tracks by label; more and longer tracks teach more. " + LABEL_WORDS,
        )
    page.heading("Time")
    for entry in rounds:
        if entry.seconds:
            page.html(f"<h3>{plain(entry.name)}</h3>")
            page.bars(("stage", "seconds"), [(name, value, f"{value:.1f}") for name, value in entry.seconds.items()])
    for entry in rounds:
        _losses(page, entry)
    page.write(path)


def _change(measure: Measure, first: Round, last: Round) -> str:
    before, after = first.values[measure.name], last.values[measure.name]
    return f"{before:.{measure.digits}f} → {after:.{measure.digits}f}"


def _setbacks(measures: Sequence[Measure], first: Round, last: Round) -> list[str]:
    """Measures that got worse, said plainly."""
    lines = []
    for measure in measures:
        before, after = first.values.get(measure.name), last.values.get(measure.name)
        if before is None or after is None:
            continue
        gain = (round(after, measure.digits) - round(before, measure.digits)) * (1 if measure.larger_is_better else -1)
        if gain < 0:  # as the page shows it
            lines.append(f"Worse than before: {measure.name}, {_change(measure, first, last)}.")
    return lines


def _meanings(measures: Sequence[Measure]) -> str:
    """What each measure is, those with the same meaning together."""
    names: dict[str, list[str]] = {}
    for measure in measures:
        names.setdefault(measure.meaning, []).append(measure.name)
    lines = [textwrap.fill(f"{'; '.join(name)}: {meaning}", 100) for meaning, name in names.items()]
    return "\n\n".join(lines)


def _cells(measure: Measure, rounds: Sequence[Round]) -> list[str]:
    values = [entry.values.get(measure.name) for entry in rounds]
    cells = ["-" if value is None else f"{value:.{measure.digits}f}" for value in values]
    known = [value for value in values if value is not None]
    if len(set(cells)) < 2:  # nothing to choose from
        return cells
    best = (max if measure.larger_is_better else min)(known)
    printed = f"{best:.{measure.digits}f}"
    return [f"**{cell}**" if cell == printed else cell for cell in cells]


def _curves(page: Page, measures: Sequence[Measure], rounds: Sequence[Round]) -> None:
    page.heading("Over the rounds")
    x = np.arange(len(rounds), dtype=np.float64)
    for measure in measures[:4]:
        y = np.array([entry.values.get(measure.name, np.nan) for entry in rounds])
        chart = line_chart(x, y, measure.name, across_of="round")
        page.html(f"<figure>{chart}<figcaption>{plain(measure.name)} over the rounds.</figcaption></figure>")


def _losses(page: Page, entry: Round) -> None:
    """How the training of a round went."""
    names = [name for name in entry.losses if name != "step"]
    if not names or len(entry.losses["step"]) < 2:
        return
    page.heading(f"Training of {entry.name}")
    for name in names:
        chart = line_chart(np.array(entry.losses["step"]), np.array(entry.losses[name]), name, across_of="step")
        page.html(f"<figure>{chart}<figcaption>Loss over the steps: {plain(name)}.</figcaption></figure>")
