"""A run of the pose protocol: features once per image, all pairs on all cores, one result."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from improvo.evaluation.pose.cache import read_cache, write_cache
from improvo.evaluation.pose.pairs import SequencePairs, pairs_of_sequence, refuse_empty_gaps
from improvo.evaluation.pose.protocol import ExtractionTask, Records, evaluate_pairs, extract, pair_tasks
from improvo.evaluation.settings import PoseSettings
from improvo.evaluation.sources import (
    FeatureSource,
    SequenceSource,
    file_name,
    refuse_equal_names,
    sequence_fingerprint,
)
from improvo.jobs.pool import Workers
from improvo.types import Features

EXTRACTION_CHUNK = 8  # images of one task


@dataclass(frozen=True)
class PoseRun:
    """What a run leaves: the raw records, and what is needed to read them."""

    records: Records
    sequences: list[SequencePairs]
    frontends: list[str]
    settings: PoseSettings
    unreadable: dict[str, tuple[int, ...]]  # sequence -> frames that cannot be decoded, whose pairs are left out


def run_pose_protocol(
    sources: list[SequenceSource],
    frontends: list[FeatureSource],
    settings: PoseSettings,
    cache: Path,
    workers: Workers | None = None,
) -> PoseRun:
    """Evaluate all frontends on the same pairs of all sequences.

    Args:
        sources: sequences with depth and true poses.
        frontends: with different labels.
        settings: of the protocol.
        cache: folder for features; those of earlier runs with the same settings are used, others refused.
        workers: processes; by default this one alone.

    Raises:
        InputError: a sequence without depth or poses, a gap without pairs, a cache made with other settings.
        ConfigError: two frontends or sequences of one name.
    """
    refuse_equal_names("frontends", [frontend.label for frontend in frontends])
    refuse_equal_names("sequences", [source.open().name for source in sources])
    workers = workers or Workers()
    sequences = list(workers.run(_draw, [(source, settings) for source in sources], "pairs"))
    refuse_empty_gaps(sequences, settings.gaps)
    caches, unreadable = [], {}
    for source, sequence in zip(sources, sequences, strict=True):
        frames = sorted({int(i) for pairs in sequence.pairs.values() for i in pairs.ravel()})
        folders, missing = _features_of(source, frontends, frames, cache, workers)
        caches.append(folders)
        if missing:
            unreadable[sequence.name] = missing
            for gap, pairs in sequence.pairs.items():
                sequence.pairs[gap] = pairs[~np.isin(pairs, missing).any(axis=1)]
    refuse_empty_gaps(sequences, settings.gaps)
    tasks = pair_tasks(sources, sequences, caches, settings)
    records = np.concatenate(list(workers.run(evaluate_pairs, tasks, "pose")))
    return PoseRun(records, sequences, [f.label for f in frontends], settings, unreadable)


def _draw(task: tuple[SequenceSource, PoseSettings]) -> SequencePairs:
    source, settings = task
    return pairs_of_sequence(source.open(), settings.gaps, settings.pairs, settings.seed)


def _features_of(
    source: SequenceSource,
    frontends: list[FeatureSource],
    frames: list[int],
    cache: Path,
    workers: Workers,
) -> tuple[list[Path], tuple[int, ...]]:
    """Make sure that the features of `frames` are cached; the cache folders, and frames that cannot be decoded."""
    sequence = source.open()
    where = sequence_fingerprint(source, sequence)
    folders, unreadable = [], set()
    for frontend in frontends:
        folder = cache / file_name(frontend.label) / file_name(sequence.name)
        fingerprint = {"frontend": frontend.fingerprint(), "sequence": where}
        known = read_cache(folder, fingerprint)
        wanted = [frame for frame in frames if frame not in unreadable and (known is None or frame not in known)]
        if wanted:
            chunks = [tuple(wanted[i : i + EXTRACTION_CHUNK]) for i in range(0, len(wanted), EXTRACTION_CHUNK)]
            tasks = [ExtractionTask(source, frontend, chunk) for chunk in chunks]
            features: dict[int, Features] = {} if known is None else {frame: known[frame] for frame in known.rows}
            for found in workers.run(extract, tasks, f"{frontend.label} on {sequence.name}"):
                features.update({frame: value for frame, value in found.items() if value is not None})
                unreadable |= {frame for frame, value in found.items() if value is None}
            known = None  # its files are open, and Windows replaces no open file
            if features:  # of frames none of which can be decoded there is nothing to keep
                write_cache(folder, fingerprint, features)
        folders.append(folder)
    return folders, tuple(sorted(unreadable))
