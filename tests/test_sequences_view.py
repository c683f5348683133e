"""Undistortion and resizing carry the camera exactly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from improvo.errors import InputError
from improvo.geometry.camera import Camera
from improvo.geometry.camera_files import calibration_yaml
from improvo.sequences import open_sequence
from improvo.sequences.rectification import Rectifier
from sequence_builders import CAMERA, images, write_images

BROWN = Camera(160, 120, 90.0, 91.0, 77.0, 62.0, (-0.29, 0.08, 0.001, -0.002))
CAMERAS = [
    BROWN,
    replace(BROWN, distortion=(0.1, -0.05, 0.0, 0.0, 0.01)),
    replace(BROWN, distortion=(-0.3, 0.1, 0.001, 0.0, 0.02, 0.01, -0.02, 0.003)),
    replace(BROWN, distortion=(0.02, -0.01, 0.003, -0.001), distortion_model="fisheye"),
    replace(BROWN, distortion=(0.9,), distortion_model="fov"),
]


def test_brown_and_fisheye_distort_as_opencv_does() -> None:
    rays = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2))
    points = np.concatenate([rays, np.ones((50, 1))], axis=1)
    for camera in CAMERAS[:4]:
        arguments = (points[:, None], np.zeros(3), np.zeros(3), camera.K, np.array(camera.distortion))
        if camera.distortion_model == "fisheye":
            expected = cv2.fisheye.projectPoints(*arguments)[0]
        else:
            expected = cv2.projectPoints(*arguments)[0]
        ours = camera.distort(rays) * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        np.testing.assert_allclose(ours, expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("raw", CAMERAS, ids=lambda camera: f"{camera.distortion_model}{len(camera.distortion)}")
def test_undistorted_view_shows_where_each_ray_goes_and_no_border(raw: Camera) -> None:
    """A picture that stores its own raw x coordinate shows, undistorted, where each pixel came from."""
    view = Rectifier(raw)
    assert view.camera.is_pinhole
    assert (view.camera.width, view.camera.height) == (raw.width, raw.height)
    xs = np.broadcast_to(np.arange(raw.width, dtype=np.uint8), (raw.height, raw.width)).copy()
    pixels = np.stack(np.meshgrid(np.arange(160.0), np.arange(120.0)), axis=-1)
    source = raw.distort(view.camera.unproject(pixels)[..., :2]) * [raw.fx, raw.fy] + [raw.cx, raw.cy]
    assert np.abs(view.image(xs) - source[..., 0]).max() <= 0.55  # rounding and the 1/32 px of remap
    assert source.min() >= -1e-3
    assert (source <= np.array([159, 119]) + 1e-3).all()
    touches = [source[..., 0].min(), source[..., 1].min(), 159 - source[..., 0].max(), 119 - source[..., 1].max()]
    assert min(touches) < 0.5  # the widest view: it reaches an edge
    assert "undistorted" in view.description


def test_depth_goes_the_same_way_by_nearest_pixel() -> None:
    view = Rectifier(BROWN)
    depth = np.where(np.arange(160) < 80, 1.0, 2.0).astype(np.float32) + np.zeros((120, 1), np.float32)
    result = view.depth(depth)
    assert set(np.unique(result)) == {1.0, 2.0}
    pixels = np.stack(np.meshgrid(np.arange(160.0), np.arange(120.0)), axis=-1)
    source = BROWN.distort(view.camera.unproject(pixels)[..., :2])[..., 0] * BROWN.fx + BROWN.cx
    clear = np.abs(source - 79.5) > 0.1
    np.testing.assert_array_equal(result[clear], np.where(source < 79.5, 1.0, 2.0)[clear])


def test_resizing_maps_pixel_edges_to_pixel_edges() -> None:
    raw = Camera(160, 120, 100.0, 100.0, 80.0, 60.0)
    view = Rectifier(raw, width=80)
    ramp = np.broadcast_to(np.arange(160, dtype=np.uint8), (120, 160)).copy()
    assert view.camera == raw.resized(80, 60)
    small = view.image(ramp)
    # pixel j of the small picture covers the pixels 2j and 2j + 1, whose mean is 2j + 0.5
    assert np.abs(small[0].astype(float) - (2 * np.arange(80) + 0.5)).max() <= 0.5
    ray_in_small = view.camera.unproject(np.array([20.0, 30.0]))
    np.testing.assert_allclose(raw.project(ray_in_small), [40.5, 60.5])


def test_distortion_that_no_view_can_undo_is_refused() -> None:
    with pytest.raises(InputError, match="cannot be undone"):
        Rectifier(replace(BROWN, cx=-50.0))


def test_sequence_delivers_the_undistorted_resized_view(tmp_path: Path) -> None:
    raw = replace(CAMERA, distortion=(-0.2, 0.05, 0.0, 0.0))
    write_images(tmp_path, images(2))
    (tmp_path / "camera.yaml").write_text(calibration_yaml(raw))
    sequence = open_sequence(tmp_path, width=48)
    expected = Rectifier(raw, 48)
    assert sequence.raw_camera == raw
    assert sequence.camera == expected.camera
    assert sequence[1].image.shape == (36, 48)
    np.testing.assert_array_equal(sequence[1].image, expected.image(images(2)[1]))
    assert "undistorted" in sequence.view
    assert "48x36" in sequence.view


WIDE = Camera(160, 160, 54.0, 54.0, 79.5, 79.5, (0.0, 0.0, 0.0, 0.0), "fisheye")  # 170 degrees


def field(view: Rectifier) -> float:
    return float(2 * np.degrees(np.arctan(0.5 * view.camera.width / view.camera.fx)))


def test_a_fisheye_keeps_the_resolution_of_its_middle() -> None:
    view = Rectifier(WIDE)
    assert view.camera.fx == pytest.approx(WIDE.fx)
    assert "--undistorted-fov shows up to 169" in view.description
    short = Rectifier(replace(WIDE, fx=30.0, fy=30.0))
    assert field(short) == pytest.approx(120.0)  # beyond that even the middle is given up
    assert Rectifier(BROWN).zoom < 1  # an ordinary lens is seen whole


def test_the_undistorted_field_of_view_can_be_chosen() -> None:
    assert field(Rectifier(WIDE, fov=150.0)) == pytest.approx(150.0)
    assert field(Rectifier(WIDE, fov=60.0)) == pytest.approx(60.0)
    widest = Rectifier(WIDE, fov=178.0)  # as far as the picture goes
    assert 165 < field(widest) < 178
    assert "--undistorted-fov" not in widest.description
    with pytest.raises(InputError, match="--undistorted-fov 200: must be between"):
        Rectifier(WIDE, fov=200.0)
