"""What a person is told while the loop runs: progress on stderr, results as lines."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from improvo.improvement.candidate import Candidate
from improvo.improvement.held_back import Split
from improvo.improvement.judgement import Judgement, gain_interval
from improvo.labeling.store import DONE, SequenceRecord

Tick = Callable[..., None]  # told that so many more are done; one if it is not told how many


class Telling:
    """Says it.

    Args:
        line: is given each line of the results.
        progress: whether bars are shown on stderr.
    """

    def __init__(self, line: Callable[[str], None] = lambda text: None, progress: bool = False) -> None:
        self._line, self.progress = line, progress
        self._told: set[tuple[str, str]] = set()

    @contextmanager
    def bar(self, words: str, unit: str, total: int | None = None) -> Iterator[Tick]:
        """A progress bar with its rate and what remains; call what it gives."""
        from tqdm import tqdm

        with tqdm(desc=words, unit=unit, total=total, smoothing=0.1, disable=not self.progress) as bar:

            def tick(count: int = 1) -> None:
                bar.update(count)

            yield tick

    def line(self, text: str) -> None:
        """One line, past the bars."""
        from tqdm import tqdm

        with tqdm.external_write_mode():
            self._line(text)

    def record(self, what: str, record: SequenceRecord) -> None:
        """A sequence was labelled, or why not; said once."""
        if (what, record.name) in self._told:
            return
        self._told.add((what, record.name))
        if record.state != DONE:
            self.line(f"{what}, {record.name}: not labelled: {record.reason}")
            return
        self.line(
            f"{what}, {record.name}: {record.tracked} of {record.frames} frames with a pose; "
            f"{record.stable} stable, {record.unstable} unstable tracks"
        )

    def split(self, split: Split) -> None:
        """What is held back."""
        for reason in split.unusable:
            self.line(f"left out: {reason}")
        self.line(f"held back, never trained on: {split.words}")

    def judged(self, candidate: Candidate, judgement: Judgement, start: Judgement, better: bool | None) -> None:
        """A summary of one candidate; `better` is None for the start."""
        gaps = " / ".join(map(str, judgement.gaps))
        counts = " / ".join(f"{judgement.surviving(gap):.1f}" for gap in judgement.gaps)
        text = f"{candidate.name}: {counts} matches survive {gaps} frames, {judgement.score:.1f} in all"
        if better is not None:
            text += f" ({gain_words(judgement, start)})"
        text += f"; {judgement.tracked} of {judgement.frames} frames tracked"
        self.line(text if better is None else f"{text}; {'better, kept' if better else 'not better, not kept'}")


def gain_words(judgement: Judgement, start: Judgement) -> str:
    """The gain in surviving matches over the start, with its interval."""
    gain = judgement.score - start.score
    low, high = gain_interval(judgement, start)
    if start.score <= 0:
        return f"{gain:+.1f}, 95 % interval {low:+.1f} to {high:+.1f}"
    share = 100 / start.score
    return f"{gain * share:+.0f} %, 95 % interval {low * share:+.0f} to {high * share:+.0f} %"
