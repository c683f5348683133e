"""Two rigid motions in one picture are noticed; one motion, also with wrong matches or of a plane, is one."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_features import CAMERA

from improvo.geometry import se3
from improvo.geometry.a_contrario import disc_probability, line_probability, log10_false_alarms
from improvo.geometry.epipolar import half_line_distances, sampson_errors
from improvo.geometry.ransac import Ransac, relative_pose
from improvo.odometry.mapping.two_motions import has_second_motion, holds_beside
from improvo.types import Float64

RANSAC = Ransac(1.0, seed=0, min_iterations=200, max_iterations=2000)
WORLD = se3.rigid(se3.so3_exp(np.array([0.02, -0.05, 0.01])), np.array([0.3, 0.05, 0.1]))
OTHER = se3.rigid(se3.so3_exp(np.array([-0.03, 0.04, 0.0])), np.array([-0.1, 0.35, 0.0]))


def matches(
    b_from_a: Float64, count: int, seed: int, left: float = 0.0, right: float = 320.0, plane: bool = False
) -> tuple[Float64, Float64]:
    """Pixels (N, 2) in both views of points between two columns of the first, with 0.3 pixels of noise."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform((left, 0), (right, CAMERA.height), (count, 2))
    depth = np.full(count, 3.0) if plane else rng.uniform(2.0, 6.0, count)
    moved = CAMERA.project(se3.transform(b_from_a, CAMERA.unproject(pixels, depth)))
    return pixels, moved + rng.normal(scale=0.3, size=moved.shape)


def second(parts: list[tuple[Float64, Float64]], least_spread: float = 0.5) -> bool:
    before, after = (np.concatenate(each) for each in zip(*parts, strict=True))
    first = relative_pose(before, after, CAMERA, RANSAC)
    return has_second_motion(first.pose, CAMERA, before, after, RANSAC, least_spread)


def wrong(count: int, seed: int) -> tuple[Float64, Float64]:
    rng = np.random.default_rng(seed)
    size = (CAMERA.width, CAMERA.height)
    return rng.uniform((0, 0), size, (count, 2)), rng.uniform((0, 0), size, (count, 2))


def test_a_mover_over_half_of_the_picture_is_a_second_motion() -> None:
    assert second([matches(WORLD, 200, 1, right=160.0), matches(OTHER, 150, 2, left=160.0)])


def test_a_person_in_a_corner_is_too_small_to_matter() -> None:
    assert not second([matches(WORLD, 300, 1, right=280.0), matches(OTHER, 40, 2, left=280.0)])


@pytest.mark.parametrize("plane", [False, True])
@pytest.mark.parametrize("spoilt", [0, 60, 150])
def test_one_motion_with_wrong_matches_is_one(plane: bool, spoilt: int) -> None:
    for seed in range(5):
        assert not second([matches(WORLD, 200, seed, plane=plane), wrong(spoilt, seed)])


def test_a_turn_on_the_spot_is_one_motion() -> None:
    turn = WORLD.copy()
    turn[:3, 3] = 0.0
    assert not second([matches(turn, 250, 3), wrong(50, 3)])


def test_a_map_that_follows_one_of_two_motions_is_not_contradicted_by_the_other() -> None:
    parts = [matches(WORLD, 120, 1, right=150.0), matches(OTHER, 180, 2, left=150.0)]
    before, after = (np.concatenate(each) for each in zip(*parts, strict=True))
    world, other = (sampson_errors(each, CAMERA, before, after) for each in (WORLD, OTHER))
    assert holds_beside(world, other, after, CAMERA, 1.5)
    assert holds_beside(other, world, after, CAMERA, 1.5)


def test_a_wrong_map_of_the_only_motion_holds_beside_nothing() -> None:
    before, after = (np.concatenate(each) for each in zip(matches(WORLD, 250, 1), wrong(60, 1), strict=True))
    mirrored = WORLD.copy()
    mirrored[:3, 3] = (0.1, 0.3, -0.1)
    right, false = (sampson_errors(each, CAMERA, before, after) for each in (WORLD, mirrored))
    assert not holds_beside(false, right, after, CAMERA, 1.5)


def test_false_alarms_of_chance_and_of_a_motion() -> None:
    chance = line_probability(CAMERA.width, CAMERA.height, 1.0)
    assert log10_false_alarms(100, 8, chance, sample=5, models=10) > 0
    assert log10_false_alarms(100, 60, chance, sample=5, models=10) < -50
    assert log10_false_alarms(100, 5, chance, sample=5) == np.inf
    assert disc_probability(320, 240, 3.0) < line_probability(320, 240, 3.0)
    with pytest.raises(ValueError, match="probability"):
        log10_false_alarms(10, 11, 0.1, sample=3)


def test_chance_gives_about_as_many_agreements_as_expected() -> None:
    """With a fixed model the expected number of false alarms bounds how often chance agrees so well."""
    rng, chance = np.random.default_rng(0), 0.02
    hits = rng.binomial(100, chance, 20000)
    count = int(np.argmax([log10_false_alarms(100, k, chance, sample=0) < -1 for k in range(1, 30)])) + 1
    assert (hits >= count).mean() < 0.1


def test_a_match_beyond_infinity_is_far_from_its_half_line() -> None:
    sideways = se3.rigid(np.eye(3), np.array([-1.0, 0.0, 0.0]))  # points move to the left
    before = np.array([[160.0, 120.0], [160.0, 120.0], [160.0, 120.0], [160.0, 120.0]])
    after = np.array([[160.0, 120.0], [140.0, 120.0], [170.0, 120.0], [140.0, 124.0]])
    assert half_line_distances(sideways, CAMERA, before, after) == pytest.approx([0.0, 0.0, 10.0, 4.0], abs=1e-9)
