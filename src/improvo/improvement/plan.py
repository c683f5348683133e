"""What the loop will cost: its parts measured on a sample, or where there is no torch, by the figures of `estimate`."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from improvo.errors import InputError
from improvo.frontend.weights_files import load_weights
from improvo.improvement.earlier import earlier_runs
from improvo.improvement.estimate import Costs, Estimate, estimate
from improvo.improvement.plan_sample import measure
from improvo.improvement.rounds import starting_weights
from improvo.improvement.settings import ImproveSettings
from improvo.improvement.split import frames_there, whole_held_back
from improvo.labeling.plan import LabelPlan, plan_labels
from improvo.sequences import open_sequence

_MOST_ROUNDS = 2  # that are made without being asked for: a third one gains here, and costs other places more
_USUAL_MINUTES = 30.0  # that they may take
_AND_A_HALF = 1.5  # times what one round takes, which they may take where that is more


@dataclass(frozen=True)
class ImprovePlan:
    """Of some rounds."""

    once: LabelPlan  # all recordings labelled once, by the frontend at the start
    needed: Estimate
    rounds: int  # at most
    measured: bool  # whether depth, training and validation are, on this machine; then their minutes are of one core

    @property
    def labelings(self) -> float:
        """How often all recordings are labelled, over all rounds; parts of them more often than others."""
        return self.needed.labeled_frames / max(self.once.frames, 1)


def plan_improvement(
    sequences: Sequence[Path],
    settings: ImproveSettings,
    rounds: int | None = None,
    evaluate: Sequence[Path] = (),
    on_frames: Callable[[int], None] = lambda count: None,
    after: Path | None = None,
) -> ImprovePlan:
    """Label a sample with the weights that the loop starts from, and reckon.

    What an earlier loop left is replayed and judged too. That costs little beside the rest, and is not counted.

    Args:
        sequences, settings, rounds, evaluate, after: see `improve`.
        on_frames: is told the number of further frames of the sample processed.

    Raises:
        InputError: no sample could be labelled, weights cannot be read, or `after` is no finished folder.
    """
    earlier = earlier_runs(after)
    sequences = earlier.without_known(sequences)
    earlier.refuse_taught(evaluate)
    weights = earlier.first_weights(settings.frontend.name)
    frontend = replace(settings.frontend, name=str(weights))
    paths = list(dict.fromkeys([*sequences, *evaluate]))
    pixels = _pixels(paths, settings)
    rounds = rounds or first_estimate(sequences, settings, None, evaluate)[0]
    with tempfile.TemporaryDirectory(prefix="improvo-plan-") as folder:
        store = Path(folder) / "labels"
        run_settings = settings.run_settings(settings.sequence, frontend)
        once = plan_labels(paths, run_settings, on_frames=on_frames, folder=store)
        costs = Costs.usual(pixels, _parameters(weights))
        measured = measure(store, weights, settings, replace(costs, frame=once.frame_seconds))
    held_back = (
        round(once.frames * len(evaluate) / len(paths)) if evaluate else _held_back(once.frames, len(paths), settings)
    )
    whole = len(evaluate) or whole_held_back(len(paths), settings.split)
    training = once.frames - held_back
    needed = estimate(settings, rounds, training, held_back, pixels, measured or costs, whole)
    return ImprovePlan(once, needed, rounds, measured is not None)


def first_estimate(
    sequences: Sequence[Path], settings: ImproveSettings, rounds: int | None, evaluate: Sequence[Path] = ()
) -> tuple[int, Estimate | None]:
    """What all of it takes, from the lengths of the recordings alone; nothing of what is done already is taken off.

    Args:
        sequences, settings, rounds, evaluate: see `improve`.

    Returns:
        How many rounds there are at most, and what they take: None where no recording can be opened, which the loop
        itself will say.
    """
    named = {path.resolve() for path in evaluate}
    training = held_back = 0
    for path in dict.fromkeys([*sequences, *evaluate]):
        with suppress(InputError):
            frames = frames_there(path, settings.sequence)
            held_back += frames if path.resolve() in named else 0
            training += 0 if path.resolve() in named else frames
    if not evaluate:
        held_back = _held_back(training, len(sequences), settings)
        training -= held_back
    if training + held_back == 0:
        return rounds or 1, None
    paths = [*sequences, *evaluate]
    pixels = _pixels(paths, settings)
    costs = Costs.usual(pixels, _parameters(starting_weights(settings.frontend.name)))
    whole = len(evaluate) or whole_held_back(len(paths), settings.split)

    def needed(settings: ImproveSettings, rounds: int) -> Estimate:
        return estimate(settings, rounds, training, held_back, pixels, costs, whole)

    most = rounds or usual_rounds(settings, needed)
    return most, needed(settings, most)


def usual_rounds(settings: ImproveSettings, needed: Callable[[ImproveSettings, int], Estimate]) -> int:
    """How many rounds the loop makes at most where none are asked for: what fits in half an hour, or costs little more.

    Known from the lengths of the recordings alone, and whether there is a control or not, so that a run that was
    stopped goes on as it was begun.

    Args:
        settings: of the loop.
        needed: estimates so many rounds.
    """
    settings = replace(settings, control=False)
    minutes = [needed(settings, rounds).minutes for rounds in range(1, _MOST_ROUNDS + 1)]
    return sum(each <= max(_USUAL_MINUTES, _AND_A_HALF * minutes[0]) for each in minutes)


def _held_back(frames: int, recordings: int, settings: ImproveSettings) -> int:
    """Frames of all recordings that are held back, where the user names none."""
    return (
        settings.split.frames_of_one(frames) if recordings == 1 else round(settings.split.share_of_sequences * frames)
    )


def _parameters(weights: Path) -> int:
    return sum(tensor.size for tensor in load_weights(weights).tensors.values())


def _pixels(paths: Sequence[Path], settings: ImproveSettings) -> int:
    """Of a frame of the first recording that can be opened."""
    for path in paths[:-1]:
        try:
            camera = open_sequence(path, settings.sequence).camera
        except InputError:
            continue
        return camera.width * camera.height
    camera = open_sequence(paths[-1], settings.sequence).camera
    return camera.width * camera.height
