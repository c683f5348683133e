"""What the loop says while it runs: progress on stderr, results as lines."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from improvo.improvement.folder import Candidate
from improvo.improvement.settings import ValidationSettings
from improvo.improvement.split import Split
from improvo.improvement.validation import Validation, gain, gain_words, loose
from improvo.labeling.store import DONE, SequenceRecord
from improvo.terminal import counted, progress

Tick = Callable[..., None]  # told that so many more are done; one if it is not told how many


class ImprovementProgress:
    """What the loop reports to; by itself it shows nothing.

    Args:
        line: is given each line of the results.
        shown: whether progress is shown on stderr.
    """

    def __init__(self, line: Callable[[str], None] = lambda text: None, shown: bool = False) -> None:
        self._line, self.shown = line, shown
        self._said: set[tuple[str, str]] = set()

    @contextmanager
    def bar(self, words: str, unit: str, total: int | None = None) -> Iterator[Tick]:
        """Show how far a step is; call what it gives.

        Args:
            words: what is being done.
            unit: of what is counted, in the singular.
            total: how many there are, where that is known.
        """
        with progress(words, unit, total, self.shown) as bar:
            yield bar.advance

    def line(self, text: str) -> None:
        """One line of the results."""
        self._line(text)

    def labeled(self, what: str, record: SequenceRecord) -> None:
        """A sequence was labelled, or why not; said once."""
        if (what, record.name) in self._said:
            return
        self._said.add((what, record.name))
        if record.state != DONE:
            self.line(f"{what}, {record.name}: not labelled: {record.reason}")
            return
        self.line(
            f"{what}, {record.name}: {record.tracked} of {counted(record.frames, 'frame')} with a pose; "
            f"{record.stable} stable, {record.unstable} unstable tracks"
        )

    def split(self, split: Split) -> None:
        """What is held back."""
        for reason in split.unusable:
            self.line(f"left out: {reason}")
        self.line(f"held back, never trained on: {split.words}")

    def validated(
        self,
        candidate: Candidate,
        validation: Validation,
        start: Validation,
        settings: ValidationSettings,
        faults: str | None = None,
    ) -> None:
        """A summary of one candidate.

        Args:
            candidate: the frontend.
            validation: what was measured of it.
            start: what was measured of the frontend at the start.
            settings: of the validation.
            faults: why it is not better than the best one before it; empty where it is, None for start and control.
        """
        name = loose(settings.matches)
        shares = " / ".join(f"{validation.mean(name, level):.3f}" for level in validation.levels)
        gaps = ", ".join(validation.gap_words(level) for level in validation.levels)
        text = (
            f"{candidate.name}: {shares} of its matches are right within {settings.matches.right_px[1]:g} px at {gaps}"
        )
        if validation is not start:
            text += f"; all gaps against the start: {gain_words(validation, start, settings.matches)}"
            for one in validation.earlier:
                text += f"; {one}, share: {gain(validation, start, name, settings.matches, earlier=one).words}"
        text += f"; {validation.tracked} of {validation.frames} frames tracked in "
        text += counted(validation.segments, "segment")
        if faults is not None:
            text += f"; not better ({faults}), not kept" if faults else "; better, kept"
        self.line(text)
