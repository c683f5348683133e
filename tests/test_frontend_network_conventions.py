"""Where the network frontend puts its keypoints, descriptors and stability: to the pixel, on networks made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from improvo.errors import ConfigError, InputError
from improvo.frontend.corners import refine_to_corners
from improvo.frontend.decoding import find_keypoints, refine, sample_descriptors
from improvo.frontend.network import NetworkFrontend
from improvo.frontend.settings import NetworkSettings
from improvo.types import UInt8
from network_examples import brightness_weights, lit_pixel_weights, random_weights

SIZE = (101, 133)  # height, width: neither a multiple of 8


@pytest.fixture(scope="module")
def lit_pixels() -> NetworkFrontend:
    return NetworkFrontend(lit_pixel_weights(), NetworkSettings(subpixel_radius=0, corner_radius=0))


def image_of(pixels: np.ndarray, size: tuple[int, int] = SIZE) -> UInt8:
    image = np.zeros(size, np.uint8)
    image[pixels[:, 1], pixels[:, 0]] = 255
    return image


def in_order(keypoints: np.ndarray) -> list[tuple[float, float]]:
    return sorted((float(x), float(y)) for x, y in keypoints)


def spread_pixels(seed: int = 0) -> np.ndarray:
    """One pixel at a random place in the middle of each 24×24 tile: every place in a cell occurs over the seeds."""
    random = np.random.default_rng(seed)
    corners = np.stack(np.meshgrid(np.arange(4, 104, 24), np.arange(4, 76, 24)), axis=-1).reshape(-1, 2)
    return corners + random.integers(0, 8, corners.shape)


@pytest.mark.parametrize("seed", range(6))
def test_keypoints_are_the_lit_pixels(lit_pixels, seed):
    pixels = spread_pixels(seed)
    assert in_order(lit_pixels(image_of(pixels)).keypoints) == in_order(pixels)


@pytest.mark.parametrize("shift", [(1, 0), (0, 1), (3, 5), (7, 2), (8, 8)])
def test_shifting_the_image_shifts_the_keypoints(lit_pixels, shift):
    image = image_of(spread_pixels())
    shifted = np.roll(image, shift[::-1], axis=(0, 1))
    assert in_order(lit_pixels(shifted).keypoints) == in_order(lit_pixels(image).keypoints + shift)


@pytest.mark.parametrize("axis", [0, 1])
def test_flipping_the_image_mirrors_the_keypoints(lit_pixels, axis):
    image = image_of(spread_pixels())
    mirrored = lit_pixels(image).keypoints.copy()
    mirrored[:, 1 - axis] = SIZE[axis] - 1 - mirrored[:, 1 - axis]
    assert len(mirrored) == 15
    assert in_order(lit_pixels(np.ascontiguousarray(np.flip(image, axis))).keypoints) == in_order(mirrored)


def test_keypoints_stay_out_of_the_border_and_of_the_padding(lit_pixels):
    height, width = SIZE
    inside = np.array([[4, 4], [width - 5, 30], [60, height - 5]])
    outside = np.array([[3, 50], [100, 3], [width - 4, 70], [30, height - 4]])
    image = image_of(np.concatenate([inside, outside]))
    assert in_order(lit_pixels(image).keypoints) == in_order(inside)
    everywhere = NetworkFrontend(lit_pixel_weights(), NetworkSettings(border=0, subpixel_radius=0, corner_radius=0))
    corner = np.array([[width - 1, height - 1]])  # repeated by the padding, which must not count
    assert in_order(everywhere(image_of(corner)).keypoints) == in_order(corner)


def test_stability_logits_are_interpolated_between_cell_centres():
    height, width = 40, 96
    brightness = np.linspace(0, 1, width, dtype=np.float32)
    image = np.tile(brightness, (height, 1))
    probability = NetworkFrontend(brightness_weights()).stability_map(image)
    logit = np.log(probability / (1 - probability))
    # A cell's brightest pixel is its last, 8j + 7, and its value stands at the cell's centre, 8j + 3.5.
    inner = np.arange(4, width - 4)
    np.testing.assert_allclose(logit[20, inner], (inner + 3.5) / (width - 1), atol=1e-5)
    assert np.allclose(probability, probability[0])


def test_stability_at_keypoints_is_the_dense_map_there():
    frontend = NetworkFrontend(random_weights(), NetworkSettings(subpixel_radius=0, corner_radius=0))
    image = np.random.default_rng(1).integers(0, 256, (77, 90), np.uint8)
    features = frontend(image)
    dense = frontend.stability_map(image)
    assert dense.shape == image.shape
    assert len(features) > 20
    assert np.ptp(features.stability) > 0.01
    x, y = features.keypoints.astype(int).T
    np.testing.assert_allclose(features.stability, dense[y, x], atol=1e-6)


def test_descriptors_are_sampled_as_torch_samples_them():
    torch = pytest.importorskip("torch")
    from improvo.frontend import superpoint

    random = np.random.default_rng(0)
    cells = random.normal(size=(6, 9, 16)).astype(np.float32)
    keypoints = random.uniform(-0.5, (71.5, 47.5), (200, 2)).astype(np.float32)
    theirs = superpoint.sample_descriptors(
        torch.from_numpy(cells).permute(2, 0, 1)[None], torch.from_numpy(keypoints)[None]
    )
    np.testing.assert_allclose(sample_descriptors(cells, keypoints), theirs[0].numpy(), atol=2e-6)
    centre = np.array([[8 * 4 + 3.5, 8 * 2 + 3.5]], np.float32)
    np.testing.assert_allclose(sample_descriptors(cells, centre)[0], cells[2, 4] / np.linalg.norm(cells[2, 4]), 1e-5)


def test_suppression_keeps_the_best_of_each_neighbourhood():
    heat = np.zeros((40, 40), np.float32)
    heat[10, 10], heat[10, 14], heat[10, 19], heat[30, 30] = 0.9, 0.8, 0.7, 0.0004
    found = find_keypoints(heat, NetworkSettings(nms_radius=4))
    assert found.tolist() == [[10, 10], [19, 10]]
    assert find_keypoints(heat, NetworkSettings(nms_radius=3)).tolist() == [[10, 10], [14, 10], [19, 10]]
    assert find_keypoints(heat, NetworkSettings(nms_radius=3, max_keypoints=2)).tolist() == [[10, 10], [14, 10]]
    assert [30, 30] in find_keypoints(heat, NetworkSettings(threshold=0.0001)).tolist()


def test_refinement_finds_the_centre_of_a_blob():
    y, x = np.mgrid[0:30, 0:40]
    centre = np.array([17.3, 11.8])
    heat = np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * 0.7**2)).astype(np.float32)
    refined = refine(heat, np.array([[17, 12]]), radius=2)
    np.testing.assert_allclose(refined[0], centre, atol=0.05)
    assert NetworkSettings().subpixel_radius == 4  # the default moves keypoints, and never out of the picture
    features = NetworkFrontend(random_weights(), NetworkSettings(border=0, corner_radius=0))(image_of(spread_pixels()))
    assert (features.keypoints % 1 != 0).any()
    assert (features.keypoints >= 0).all()
    assert (features.keypoints <= [SIZE[1] - 1, SIZE[0] - 1]).all()


def test_nothing_found_gives_empty_features(lit_pixels):
    for size in ((101, 133), (8, 8), (3, 5), (1, 1)):
        features = lit_pixels(np.zeros(size, np.uint8))
        assert features.keypoints.shape == (0, 2)
        assert features.descriptors.shape == (0, 64)
        assert features.scores.shape == features.stability.shape == (0,)


def test_colour_and_float_give_what_grey_uint8_gives():
    frontend = NetworkFrontend(random_weights(), NetworkSettings(subpixel_radius=0, corner_radius=0))
    grey = np.random.default_rng(2).integers(0, 256, (64, 80), np.uint8)
    expected = frontend(grey)
    assert len(expected) > 10
    for image in (grey / 255, (grey / 255).astype(np.float32), np.stack([grey] * 3, axis=2), grey[..., None]):
        features = frontend(image)
        assert np.array_equal(features.keypoints, expected.keypoints)
        np.testing.assert_allclose(features.descriptors, expected.descriptors, atol=1e-4)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((20, 20, 4), np.uint8), "shape"),
        (np.zeros((0, 20), np.uint8), "shape"),
        (np.zeros(20, np.uint8), "shape"),
        (np.zeros((20, 20), np.uint16), "uint16"),
        (np.full((20, 20), np.nan), "NaN"),
        (np.full((20, 20), 200.0), r"\[0, 1\]"),
    ],
)
def test_other_images_are_refused(lit_pixels, image, message):
    with pytest.raises(InputError, match=message):
        lit_pixels(image)


@pytest.mark.parametrize(
    "setting",
    [{"max_keypoints": 0}, {"threshold": 1.5}, {"nms_radius": -1}, {"threads": -1}, {"runtime": "tpu"}],
)
def test_impossible_settings_are_refused(setting):
    with pytest.raises(ConfigError, match=next(iter(setting))):
        NetworkSettings(**setting)


def test_keypoints_move_to_the_corner_beside_them():
    board = np.full((80, 100), 0.2, np.float32)
    board[:40, :50] = board[40:, 50:] = 0.8  # the corner is between the pixels, at (49.5, 39.5)
    near = np.array([[52.0, 37.0], [46.3, 42.4], [49.0, 40.0]], np.float32)
    far = np.array([[20.0, 20.0], [70.0, 60.0], [0.0, 0.0], [99.0, 79.0]], np.float32)
    moved, found = refine_to_corners(board, np.concatenate([near, far]), 5)
    np.testing.assert_array_equal(found, [True] * 3 + [False] * 4)
    np.testing.assert_allclose(moved[:3], [[49.5, 39.5]] * 3, atol=0.01)
    np.testing.assert_array_equal(moved[3:], far)  # nothing but plain ground there
    np.testing.assert_array_equal(refine_to_corners(board, near, 1)[0][0], near[0])  # too far for this radius
    assert refine_to_corners(board, np.zeros((0, 2), np.float32), 5)[0].shape == (0, 2)


def test_where_the_picture_shows_nothing_there_are_no_keypoints():
    image = np.full((64, 96), 255, np.uint8)
    image[20:40, 20:40] = 100
    everywhere = {"nms_radius": 0, "threshold": 0.0, "max_keypoints": 10000}
    keypoints = NetworkFrontend(random_weights(), NetworkSettings(**everywhere))(image).keypoints
    assert len(keypoints) > 4
    assert keypoints.max() < 42  # the rest is saturated
    assert keypoints.min() > 17


def test_keypoints_that_meet_at_one_corner_are_one_feature():
    image = np.full((64, 96), 50, np.uint8)
    image[:40, :50] = image[40:, 50:] = 200
    everywhere = {"subpixel_radius": 0, "nms_radius": 0, "threshold": 0.0, "max_keypoints": 10000}
    moved = NetworkFrontend(lit_pixel_weights(), NetworkSettings(**everywhere))(image)
    alone = NetworkFrontend(lit_pixel_weights(), NetworkSettings(**everywhere, corner_radius=0))(image)
    refined, found = refine_to_corners(image.astype(np.float32) / 255, alone.keypoints, NetworkSettings().corner_radius)
    places = np.round(moved.keypoints)
    assert len(np.unique(places, axis=0)) == len(places) == len(np.unique(np.round(refined[found]), axis=0))
    near = 17 * 17  # pixels from which the corner's response, itself some pixels wide, is within reach
    assert 50 < found.sum() - len(moved) < near
