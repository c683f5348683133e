"""Points of A carried into B by the estimated pose, with and without depth."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.report import match_picture
from improvo.report.match_picture import carry, paint_matches
from improvo.types import Features, UInt8

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)


def surface(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Depth at pixels, metres."""
    return 2.0 + 0.4 * np.sin(x / 25) + 0.3 * np.cos(y / 20)


def pair(seed: int = 0, wrong: int = 6) -> tuple[Features, Features, np.ndarray]:
    """Features of a wavy surface in two views; the last `wrong` matches lead elsewhere. And the depth of A."""
    rng = np.random.default_rng(seed)
    rows, columns = np.meshgrid(np.arange(120.0), np.arange(160.0), indexing="ij")
    depth = surface(columns, rows).astype(np.float32)
    pixels = rng.uniform([10, 10], [149, 109], (60, 2))
    z = surface(pixels[:, 0], pixels[:, 1])
    cam_b_from_a = se3.rigid(se3.so3_exp(np.array([0.01, 0.04, 0.0])), np.array([-0.3, 0.02, 0.05]))
    in_b = CAMERA.project(se3.transform(cam_b_from_a, CAMERA.unproject(pixels, z)))
    in_b[len(in_b) - wrong :, 1] += rng.uniform(15, 30, wrong) * rng.choice([-1, 1], wrong)  # across the motion
    descriptors = np.eye(60, 64, dtype=np.float32)
    ones = np.ones(60, np.float32)
    return (
        Features(pixels.astype(np.float32), descriptors, ones),
        Features(in_b.astype(np.float32), descriptors, ones),
        depth,
    )


@pytest.mark.parametrize("with_depth", [True, False])
def test_right_matches_agree_and_wrong_ones_do_not(with_depth: bool) -> None:
    a, b, depth = pair()
    matches = np.stack([np.arange(60)] * 2, axis=1)
    carried = carry(a, b, matches, depth if with_depth else None, CAMERA)
    right = carried.matches[:, 0] < 54
    assert right.sum() > 50
    assert carried.error[right].max() < (0.5 if with_depth else 2.0)
    assert (carried.error[~right] > 3).sum() >= 5
    residual = np.linalg.norm(carried.predicted - b.keypoints[carried.matches[:, 1]], axis=1)
    np.testing.assert_allclose(residual, carried.error, atol=1e-9)


def test_a_match_behind_the_second_camera_counts_as_a_wrong_one(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b, depth = pair()
    matches = np.stack([np.arange(60)] * 2, axis=1)
    ahead = se3.rigid(np.eye(3), np.array([0.0, 0.0, -2.1]))
    estimate = SimpleNamespace(cam_from_world=ahead, inliers=np.ones(60, bool))
    monkeypatch.setattr(match_picture, "with_robust_solver", lambda *others, **options: estimate)
    carried = carry(a, b, matches, depth, CAMERA)
    assert 0 < carried.behind < 60
    assert carried.behind + len(carried.matches) == 60


class Known:
    """Gives the features of A, then of B."""

    name = "known"

    def __init__(self, *features: Features) -> None:
        self._features = iter(features)

    def __call__(self, image: UInt8) -> Features:
        return next(self._features)


def test_panels_show_detections_flow_and_verdict() -> None:
    a, b, depth = pair()
    blank = np.zeros((120, 160), np.uint8)
    sheet = paint_matches(Known(a, b), blank, blank, depth, CAMERA, width=160)
    first, second, third = np.array_split(sheet[:120], 3, axis=1)

    def count(panel: np.ndarray, red: bool, green: bool, blue: bool) -> int:
        bright = panel > 120
        return int((bright == [red, green, blue]).all(axis=-1).sum())

    assert count(first, False, True, True) > 200  # cyan detections
    assert count(first, False, False, True) == 0
    assert count(second, False, False, True) > 100  # blue flow
    assert count(third, False, True, False) > 200  # green: right
    assert count(third, True, False, False) > 50  # red: wrong, with their residuals


def test_too_few_matches_give_no_pose_but_a_picture() -> None:
    a, b, depth = pair()
    few = np.arange(3)
    blank = np.zeros((120, 160), np.uint8)
    for known_depth in (depth, None):
        sheet = paint_matches(Known(a.take(few), b.take(few)), blank, blank, known_depth, CAMERA, width=160)
        assert sheet.shape[1] > 3 * 160
