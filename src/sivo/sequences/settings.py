"""Settings of `sivo info`, importable without heavy modules."""

from __future__ import annotations

from dataclasses import dataclass, field

from sivo.sequences.base import SequenceSettings


@dataclass(frozen=True)
class InfoSettings:
    """`sivo info`."""

    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    samples: int = 120  # pairs of neighbouring frames that are decoded, spread over the recording
