"""Settings of `improvo info`, importable without heavy modules."""

from __future__ import annotations

from dataclasses import dataclass, field

from improvo.errors import ConfigError
from improvo.sequences.base import SequenceSettings


@dataclass(frozen=True)
class InfoSettings:
    """`improvo info`."""

    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    samples: int = 120  # pairs of neighbouring frames that are decoded, spread over the recording

    def __post_init__(self) -> None:
        if self.samples < 1:
            raise ConfigError(f"samples={self.samples}: must be at least 1")
