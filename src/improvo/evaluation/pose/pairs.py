"""The random image pairs of the pose protocol, the same for every frontend."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from improvo.errors import InputError
from improvo.evaluation.trajectory.protocol import clean_truth
from improvo.sequences import Sequence
from improvo.types import Float64, Int64

_FEWEST_BLOCKS = 8


@dataclass(frozen=True)
class SequencePairs:
    """The pairs that one sequence gives."""

    name: str
    path: str
    frames: int
    world_from_cam: Float64  # (frames, 4, 4) true poses, NaN where invalid
    invalid_poses: tuple[int, ...]  # frames whose true pose is missing, NaN or not rigid; never part of a pair
    pairs: dict[int, Int64]  # gap -> (K, 2) frames A and B = A + gap, sorted by A


def draw_pairs(
    usable: NDArray[np.bool_], has_depth: Callable[[int], bool], gap: int, count: int, rng: np.random.Generator
) -> Int64:
    """Up to `count` random pairs (K, 2) of frames A and A + gap, without repetition, sorted by A.

    Args:
        usable: (N,) whether a frame has a valid true pose.
        has_depth: whether a frame has depth; asked only for frames that are drawn, since it may cost a decoding.
        gap: frames between the two, as delivered (after any stride).
        count: pairs wanted.
        rng: source of randomness.
    """
    candidates = np.flatnonzero(usable[:-gap] & usable[gap:]) if gap < len(usable) else np.zeros(0, np.int64)
    chosen: list[int] = []
    for candidate in rng.permutation(candidates):
        if len(chosen) == count:
            break
        if has_depth(int(candidate)):
            chosen.append(int(candidate))
    first = np.sort(np.array(chosen, np.int64))
    return np.stack([first, first + gap], axis=1)


def pairs_of_sequence(sequence: Sequence, gaps: tuple[int, ...], count: int, seed: int) -> SequencePairs:
    """Pairs of one sequence for every gap.

    They depend on the seed, the gap, and the sequence's name and length: not on the frontends, on the other gaps or
    on the other sequences of the run.

    Args:
        sequence: with true poses and depth.
        gaps: frames between the two of a pair.
        count: pairs per gap.
        seed: of the choice.

    Raises:
        InputError: the sequence has no true poses, or no depth.
    """
    name, path = sequence.name, str(sequence.path)
    if sequence.ground_truth is None:
        raise InputError(f"{path}: has no true poses, which the pose protocol needs; use a sequence that has them")
    truth, unusable = clean_truth(sequence.ground_truth)
    if unusable.all():
        raise InputError(f"{path}: has no valid true pose among {len(truth)} frames; check its trajectory file")

    known: dict[int, bool] = {}

    def has_depth(index: int) -> bool:
        if index not in known:
            depth = sequence.depth(index)
            known[index] = depth is not None and bool(np.isfinite(depth).any())
        return known[index]

    pairs = {}
    for gap in gaps:
        rng = np.random.default_rng([seed, gap, zlib.crc32(name.encode())])
        pairs[gap] = draw_pairs(~unusable, has_depth, gap, count, rng)
    if known and not any(known.values()):
        raise InputError(f"{path}: has no depth, which the pose protocol needs; use an RGB-D sequence")
    invalid = tuple(int(i) for i in np.flatnonzero(unusable))
    return SequencePairs(name, path, len(truth), truth.world_from_cam, invalid, pairs)


def overlapping(pairs: Int64) -> int:
    """How many neighbouring pairs (K, 2) of a gap are drawn together for an interval; the pairs are in order.

    As many as lie within one gap: from its first pair to its last, these look at some of the same frames. At most an
    eighth of all, since the fewer blocks there are, the more alike are the resamples, and the interval would be narrow
    for want of pairs.
    """
    if len(pairs) < 2:
        return 1
    spacing = float(np.median(np.diff(pairs[:, 0])))
    within = int(np.ceil((pairs[0, 1] - pairs[0, 0]) / max(spacing, 1.0)))
    return max(1, min(within, -(-len(pairs) // _FEWEST_BLOCKS)))


def refuse_empty_gaps(sequences: list[SequencePairs], gaps: tuple[int, ...]) -> None:
    """Raise if some gap has no pair in any sequence.

    Raises:
        InputError: names the gap and the longest sequence.
    """
    for gap in gaps:
        if any(len(s.pairs[gap]) for s in sequences):
            continue
        longest = max(sequences, key=lambda s: s.frames)
        if gap >= longest.frames:
            reason = f"the longest sequence has {longest.frames} frames"
        else:
            reason = "no two frames that far apart have depth in the first and valid poses in both"
        raise InputError(f"{longest.path}: gap {gap} gives no pairs ({reason}); choose a smaller --gaps")
