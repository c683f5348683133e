"""Gaps of the pose protocol in seconds, or by how much of one frame the other shows, as numbers of frames.

The paper's 30, 60 and 90 frames are 1, 2 and 3 seconds of 30 Hz video. Between keyframes or in slow recordings as many
frames lie in different rooms, so every frontend fails there and the table says nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from improvo.errors import ConfigError, InputError
from improvo.evaluation.pose.pairs import draw_pairs
from improvo.evaluation.settings import PoseSettings
from improvo.evaluation.trajectory.protocol import clean_truth
from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.sequences import Sequence as Frames
from improvo.types import Float32, Float64

SLOW = 0.1  # seconds between frames, beyond which 30 frames are too many
_PAIRS = 12  # at which overlap is measured, for each gap
_EVERY = 8  # pixels of a depth map between those that are looked at


def with_gaps_in_frames(settings: PoseSettings, sequences: Sequence[Frames], fewer: bool = False) -> PoseSettings:
    """The settings with `gaps` in frames, from `gap_seconds` or `overlaps` where there are any.

    Args:
        settings: of the protocol.
        sequences: that will be evaluated.
        fewer: take as many gaps as a recording has, where it has fewer than overlaps were asked for.

    Raises:
        ConfigError: the sequences differ in the number of frames that this means.
        InputError: a recording without depth and true poses, which overlaps need, or too short.
    """
    if not settings.gap_seconds and not settings.overlaps:
        return settings
    found = {}
    for sequence in sequences:
        by_time = settings.gap_seconds
        gaps = gaps_of_seconds(sequence, by_time) if by_time else gaps_of_overlaps(sequence, settings.overlaps, fewer)
        found[sequence.name] = gaps
    if len(set(found.values())) > 1:
        each = "; ".join(f"{name}: {' '.join(map(str, gaps))}" for name, gaps in found.items())
        raise ConfigError(f"gaps are other numbers of frames in each sequence ({each}); evaluate them one by one")
    return replace(settings, gaps=next(iter(found.values())), gap_seconds=(), overlaps=())


def is_slow(sequence: Frames) -> bool:
    """Whether frames are so far apart in time that gaps are better chosen by overlap."""
    return len(sequence) > 1 and float(np.median(np.diff(sequence.times))) > SLOW


def gaps_of_seconds(sequence: Frames, seconds: Sequence[float]) -> tuple[int, ...]:
    """Frames that lie so many seconds apart, in the median of the recording.

    Raises:
        ConfigError: two of them are the same number of frames.
        InputError: the recording has one frame.
    """
    if len(sequence) < 2:
        raise InputError(f"{sequence.path}: has one frame, so nothing lies between two")
    step = float(np.median(np.diff(sequence.times)))
    gaps = tuple(max(1, round(each / step)) for each in seconds)
    if len(set(gaps)) < len(gaps):
        words = " ".join(f"{each:g}s" for each in seconds)
        raise ConfigError(f"--gaps {words}: at {1 / step:.3g} frames a second they are {gaps} frames; choose others")
    return gaps


def gaps_of_overlaps(sequence: Frames, overlaps: Sequence[float], fewer: bool = False) -> tuple[int, ...]:
    """The widest gaps at which a frame still shows so much of the other, in the median of some pairs.

    Args:
        sequence: with depth and true poses.
        overlaps: shares, the largest first.
        fewer: take as many as there are, at least one.

    Raises:
        InputError: no depth or true poses, or a recording too short for different gaps.
    """
    if sequence.ground_truth is None:
        raise InputError(f"{sequence.path}: has no true poses, from which overlap is known; use a sequence with them")
    truth, unusable = clean_truth(sequence.ground_truth)
    depths: dict[int, Float32 | None] = {}

    def depth(row: int) -> Float32 | None:
        if row not in depths:
            depths[row] = sequence.depth(row)
        return depths[row]

    def has_depth(row: int) -> bool:
        found = depth(row)
        return found is not None and bool(np.isfinite(found).any())

    def shown(gap: int) -> float:
        pairs = draw_pairs(~unusable, has_depth, gap, _PAIRS, np.random.default_rng([0, gap]))
        values = []
        for a, b in pairs.tolist():
            found = depth(a)
            assert found is not None  # has_depth
            b_from_a = se3.inverse(truth.world_from_cam[b]) @ truth.world_from_cam[a]
            values.append(overlap(sequence.camera, found, b_from_a))
        return float(np.median(values)) if values else float("nan")

    gaps = widest_gaps(shown, len(sequence), overlaps)
    if len(gaps) < (1 if fewer else len(overlaps)):
        raise InputError(
            f"{sequence.path}: {len(sequence)} frames have no {len(overlaps)} different gaps with overlaps of "
            f"{' '.join(f'{share:g}' for share in overlaps)}; give --gaps in frames"
        )
    return gaps


def widest_gaps(shown: Callable[[int], float], frames: int, overlaps: Sequence[float]) -> tuple[int, ...]:
    """For each share, largest first, the last gap before the overlap falls below it; different ones, increasing."""
    gaps: list[int] = []
    wanted = list(overlaps)
    before = 0
    for gap in series(frames):
        share = shown(gap)
        while wanted and (share < wanted[0] or np.isnan(share)):
            candidate = max(before, gaps[-1] + 1 if gaps else 1)
            if np.isnan(share) or candidate > gap:
                return tuple(gaps)
            gaps.append(candidate)
            wanted.pop(0)
        if not wanted:
            break
        before = gap
    return tuple(gaps)


def overlap(camera: Camera, depth: Float32, b_from_a: Float64) -> float:
    """Share of the known depth (H, W) of a frame that lies within the picture of another.

    Args:
        camera: of both.
        depth: at the camera's size or smaller; NaN or 0 where it is not known.
        b_from_a: (4, 4).
    """
    height, width = depth.shape
    sampled = depth[_EVERY // 2 :: _EVERY, _EVERY // 2 :: _EVERY].astype(np.float64)
    rows, columns = np.nonzero(sampled > 0)
    if len(rows) == 0:
        return 0.0
    scale = np.array([camera.width / width, camera.height / height])
    places = (np.stack([columns, rows], axis=1) * _EVERY + _EVERY // 2 + 0.5) * scale - 0.5
    seen = se3.transform(b_from_a, camera.unproject(places, sampled[rows, columns]))
    ahead = seen[:, 2] > 1e-6
    pixels = camera.project(np.where(ahead[:, None], seen, [0.0, 0.0, 1.0]))
    inside = (pixels >= 0).all(axis=1) & (pixels <= (camera.width - 1, camera.height - 1)).all(axis=1)
    return float((ahead & inside).mean())


def series(frames: int) -> list[int]:
    """1, 2, 3, ... then in steps of about a tenth."""
    found, gap = [], 1
    while gap < frames:
        found.append(gap)
        gap += max(1, gap // 10)
    return found
