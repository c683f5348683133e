"""Features and matches of a recording, frame by frame, for programs that start from them: hloc, COLMAP."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from improvo.export.settings import FeatureExportSettings
from improvo.files import write_picture
from improvo.frontend import Frontend
from improvo.frontend.masking import features_of
from improvo.sequences import Sequence
from improvo.tracking.matching import distance_threshold, match_units, unit_descriptors
from improvo.types import Features, Float32, Int64

_FRAME = re.compile(r"\d{6,}\.png")  # a picture of a frame, as it is named here


@dataclass(frozen=True)
class MatchedFrame:
    """A frame with its features and its matches with earlier frames."""

    number: int  # in the order of the frames that could be read, from 0
    name: str  # of its picture, by its number in the recording
    features: Features
    unit: Float32  # (N, D) descriptors of unit length; bits of a binary one as ±1 / sqrt(D)
    matches: tuple[tuple[str, Int64], ...]  # name of the earlier frame, (K, 2) its rows and rows of this one


def partners(number: int, window: int, loop_every: int) -> list[int]:
    """The earlier frames, in order, with which frame `number` is matched."""
    near = range(max(number - window, 0), number)
    if loop_every == 0 or number % loop_every:
        return list(near)
    return [*range(0, near.start, loop_every), *near]


def matched_frames(
    sequence: Sequence,
    frontend: Frontend,
    settings: FeatureExportSettings,
    images: Path | None = None,
    advance: Callable[[], None] = lambda: None,
) -> Iterator[MatchedFrame]:
    """The frames of a recording in order; only descriptors that are still needed are kept.

    Args:
        sequence: frames that cannot be read are left out.
        frontend: gives the features.
        settings: which pairs.
        images: a folder for the frames as delivered, in colour where there is any; None writes none. Frames of an
            earlier export that this one does not have leave it in the end, since hloc takes all that are there.
        advance: is called after every frame.
    """
    kept: dict[int, tuple[str, Float32]] = {}
    names: set[str] = set()
    for number, frame in enumerate(sequence):
        name = f"{frame.source_index:06d}.png"
        features = features_of(frontend, frame)
        unit = unit_descriptors(features)
        threshold = distance_threshold(features, settings.max_distance)
        matches = []
        for earlier in partners(number, settings.window, settings.loop_every):
            other, descriptors = kept[earlier]
            found = match_units(descriptors, unit, threshold)
            if len(found) >= settings.min_matches:
                matches.append((other, found))
        kept[number] = name, unit
        past = number - settings.window
        if past >= 0 and (settings.loop_every == 0 or past % settings.loop_every):
            del kept[past]
        if images is not None:
            write_picture(images / name, sequence.colour(sequence.row(frame)))
            names.add(name)
        yield MatchedFrame(number, name, features, unit, tuple(matches))
        advance()
    for path in images.glob("*.png") if images is not None else ():
        if path.name not in names and _FRAME.fullmatch(path.name):
            path.unlink()
