"""Dropping keypoints that the stability head does not trust."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from improvo.cli.main import main
from improvo.errors import ConfigError
from improvo.frontend.registry import load_frontend
from improvo.frontend.stable_only import StableOnly
from improvo.simulation import bundled_sequence
from improvo.types import Features


class Scripted:
    name = "scripted"

    def __init__(self, stability: np.ndarray | None) -> None:
        self.stability = stability

    def __call__(self, image: Any) -> Features:
        count = 4
        places = np.arange(2 * count, dtype=np.float32).reshape(count, 2)
        return Features(places, np.eye(count, dtype=np.float32), np.ones(count, np.float32), self.stability)


def test_only_stable_keypoints_are_left_in_their_order() -> None:
    stability = np.array([0.9, 0.2, 0.5, 0.49], np.float32)
    kept = StableOnly(Scripted(stability), 0.5)(np.zeros((8, 8), np.uint8))
    assert kept.keypoints.tolist() == [[0, 1], [4, 5]]
    assert kept.stability is not None
    assert kept.stability.tolist() == [stability[0], stability[2]]


def test_a_frontend_without_the_head_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ConfigError, match="no stability head"):
        StableOnly(Scripted(None), 0.5)(np.zeros((8, 8), np.uint8))
    for name in ("sift", "superpoint-small"):
        with pytest.raises(ConfigError, match=f"frontend {name}: has no stability head"):
            load_frontend(name, least_stability=0.5)
    command = ["run", str(bundled_sequence()), "-o", str(tmp_path / "out"), "--frontend", "orb"]
    assert main([*command, "--set", "frontend.least_stability=0.5"]) == 2
    assert "least_stability must be 0" in capsys.readouterr().err.splitlines()[-1]
    assert main([*command, "--set", "frontend.least_stability=2"]) == 2


def test_the_shipped_head_drops_some_and_keeps_most() -> None:
    from improvo.sequences import open_sequence

    image = open_sequence(bundled_sequence())[60].image
    everything, stable = (load_frontend("superpoint-vo", 500, least_stability=least) for least in (0.0, 0.3))
    assert 0.4 * len(everything(image)) < len(stable(image)) < len(everything(image))
