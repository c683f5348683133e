"""The classical frontends keep the one contract, and see the corners where they are."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from improvo.errors import ConfigError, MissingExtraError
from improvo.frontend.classical import spread_over_image
from improvo.frontend.registry import CLASSICAL, load_frontend
from improvo.frontend.settings import NetworkOptions
from improvo.types import UInt8


@pytest.fixture(scope="module")
def picture() -> UInt8:
    """Overlapping random rectangles, slightly blurred."""
    rng = np.random.default_rng(3)
    image = np.full((240, 320), 128, np.uint8)
    for _ in range(120):
        x, y, width, height = (int(v) for v in (*rng.integers(0, (320, 240)), *rng.integers(8, 60, 2)))
        cv2.rectangle(image, (x, y), (x + width, y + height), int(rng.integers(20, 236)), -1)
    return cv2.GaussianBlur(image, (3, 3), 0.7)


@pytest.mark.parametrize("name", CLASSICAL)
def test_features_are_sorted_bounded_and_of_one_kind(name: str, picture: UInt8) -> None:
    features = load_frontend(name, max_keypoints=100)(picture)
    assert 30 < len(features) <= 100
    assert features.keypoints.shape == (len(features), 2)
    assert features.keypoints.dtype == np.float32
    assert (np.diff(features.scores) <= 0).all()
    assert features.binary == (name in ("orb", "akaze"))
    if not features.binary:
        np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-5)
    assert features.stability is None
    assert (features.weights() == 1.0).all()


@pytest.mark.parametrize("name", CLASSICAL)
def test_the_same_picture_gives_the_same_features(name: str, picture: UInt8) -> None:
    first, second = (load_frontend(name, max_keypoints=200)(picture) for _ in range(2))
    assert first.keypoints.tobytes() == second.keypoints.tobytes()
    assert first.descriptors.tobytes() == second.descriptors.tobytes()


@pytest.mark.parametrize("name", CLASSICAL)
def test_shifting_the_picture_shifts_the_keypoints(name: str, picture: UInt8) -> None:
    shift = np.array([16, 8])
    inner = picture[40:200, 40:280]
    moved = picture[40 - shift[1] : 200 - shift[1], 40 - shift[0] : 280 - shift[0]]
    frontend = load_frontend(name, max_keypoints=150)
    before, after = frontend(inner).keypoints + shift, frontend(moved).keypoints
    distance = np.linalg.norm(before[:, None] - after[None], axis=2).min(axis=1)
    inside = ((before > 30) & (before < np.array([210, 130]))).all(axis=1)
    assert inside.sum() > 10
    tolerance = 1.0 if name == "orb" else 0.2  # ORB's coarse levels sit on a grid of several pixels
    assert np.median(distance[inside]) < tolerance


def test_a_plain_picture_has_no_features() -> None:
    plain = np.full((120, 160), 77, np.uint8)
    for name in CLASSICAL:
        assert len(load_frontend(name)(plain)) == 0


def test_colour_is_read_as_grey(picture: UInt8) -> None:
    frontend = load_frontend("orb", max_keypoints=50)
    colour = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    np.testing.assert_array_equal(frontend(colour).keypoints, frontend(picture).keypoints)


def test_odometry_finds_points_on_a_weak_texture(picture: UInt8) -> None:
    weak = (100 + (picture.astype(np.float32) - 128) * 0.12).astype(np.uint8)
    assert len(load_frontend("sift")(weak)) > 2 * len(load_frontend("sift", opencv_defaults=True)(weak))


def test_spreading_takes_from_every_cell_before_seconds() -> None:
    crowd = np.tile(np.array([[5.0, 5.0]], np.float32), (90, 1))
    lonely = np.array([[150.0, 100.0]], np.float32)
    chosen = spread_over_image(np.concatenate([crowd, lonely]), (120, 160), 10)
    assert 90 in chosen
    assert len(chosen) == 10


def test_unknown_names_and_options_are_refused() -> None:
    with pytest.raises(ConfigError, match="sift"):
        load_frontend("shift")
    with pytest.raises(ConfigError, match="not a network"):
        load_frontend("orb", network=NetworkOptions(threshold=0.1))


def test_surf_without_its_library_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mahotas", None)
    monkeypatch.setattr("improvo.frontend.classical._opencv_surf", lambda threshold: None)
    with pytest.raises(MissingExtraError, match=r"pip install 'improvo\[surf\]'"):
        load_frontend("surf")


def test_akaze_without_opencv_contrib_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("improvo.frontend.classical._opencv", SimpleNamespace())
    with pytest.raises(ConfigError, match="opencv-contrib-python"):
        load_frontend("akaze")
