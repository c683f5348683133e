"""Every notation of a calibration gives the same camera, and errors say what to do."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from improvo.errors import InputError
from improvo.geometry.camera import Camera
from improvo.geometry.camera_files import calibration_yaml, from_field_of_view, load_calibration

CAMERA = Camera(752, 480, 458.654, 457.296, 367.215, 248.375, (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05))
FISHEYE = Camera(752, 480, 458.654, 457.296, 367.215, 248.375, (0.01, -0.02, 0.003, 0.0004), "fisheye")

ROS = """
image_width: 752
image_height: 480
camera_name: left
camera_matrix:
  rows: 3
  cols: 3
  data: [458.654, 0, 367.215, 0, 457.296, 248.375, 0, 0, 1]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: 5
  data: {distortion}
"""
KALIBR = """
cam0:
  camera_model: pinhole
  intrinsics: [458.654, 457.296, 367.215, 248.375]
  distortion_model: {model}
  distortion_coeffs: {distortion}
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  camera_model: pinhole
  intrinsics: [1, 1, 1, 1]
  distortion_model: radtan
  distortion_coeffs: [0, 0, 0, 0]
  resolution: [10, 10]
"""
EUROC = """
# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)
T_BS:
  cols: 4
  rows: 4
  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: {distortion}
"""
COLMAP = "# Camera list\n1 {model} 752 480 {parameters}\n"


def written(tmp_path: Path, text: str, name: str = "camera.yaml") -> str:
    (tmp_path / name).write_text(text)
    return str(tmp_path / name)


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE, Camera(4, 3, 2.0, 2.0, 1.5, 1.0, (0.9,), "fov")])
def test_own_file_round_trip_is_exact(tmp_path: Path, camera: Camera) -> None:
    loaded = load_calibration(written(tmp_path, calibration_yaml(camera, fps=29.97, depth_scale=5000.0)))
    assert loaded.camera(camera.width, camera.height) == camera
    assert (loaded.fps, loaded.depth_scale) == (29.97, 5000.0)


@pytest.mark.parametrize(
    "text",
    [
        ROS.format(model="plumb_bob", distortion=[*CAMERA.distortion, 0.0]),
        KALIBR.format(model="radtan", distortion=list(CAMERA.distortion)),
        EUROC.format(distortion=list(CAMERA.distortion)),
    ],
    ids=["ros", "kalibr", "euroc"],
)
def test_yaml_notations_of_other_tools(tmp_path: Path, text: str) -> None:
    camera = load_calibration(written(tmp_path, text)).camera(752, 480)
    np.testing.assert_array_equal(camera.K, CAMERA.K)
    assert camera.distortion[:4] == CAMERA.distortion
    assert not any(camera.distortion[4:])


@pytest.mark.parametrize("count", [4, 5, 8])
def test_opencv_file_as_opencv_writes_it(tmp_path: Path, count: int) -> None:
    distortion = np.array([*CAMERA.distortion, 0.1, 0.02, 0.03, 0.004])[:count]
    storage = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 752)
    storage.write("image_height", 480)
    storage.write("camera_matrix", CAMERA.K)
    storage.write("distortion_coefficients", distortion[None])
    storage.release()
    camera = load_calibration(str(tmp_path / "camera.yml")).camera(752, 480)
    np.testing.assert_allclose(camera.K, CAMERA.K)
    np.testing.assert_allclose(camera.distortion, distortion)


def test_fisheye_of_ros_and_kalibr(tmp_path: Path) -> None:
    for model, text in (("equidistant", ROS), ("equi", KALIBR), ("equidistant", KALIBR)):
        path = written(tmp_path, text.format(model=model, distortion=list(FISHEYE.distortion)))
        assert load_calibration(path).camera(752, 480) == FISHEYE


@pytest.mark.parametrize(
    ("model", "parameters", "expected"),
    [
        ("SIMPLE_PINHOLE", "400 376 240", Camera(752, 480, 400, 400, 375.5, 239.5)),
        ("PINHOLE", "400 401 376 240", Camera(752, 480, 400, 401, 375.5, 239.5)),
        ("SIMPLE_RADIAL", "400 376 240 0.1", Camera(752, 480, 400, 400, 375.5, 239.5, (0.1, 0, 0, 0))),
        ("RADIAL", "400 376 240 0.1 0.2", Camera(752, 480, 400, 400, 375.5, 239.5, (0.1, 0.2, 0, 0))),
        ("OPENCV", "400 401 376 240 1 2 3 4", Camera(752, 480, 400, 401, 375.5, 239.5, (1, 2, 3, 4))),
        (
            "FULL_OPENCV",
            "400 401 376 240 1 2 3 4 5 6 7 8",
            Camera(752, 480, 400, 401, 375.5, 239.5, (1, 2, 3, 4, 5, 6, 7, 8)),
        ),
        (
            "OPENCV_FISHEYE",
            "400 401 376 240 1 2 3 4",
            Camera(752, 480, 400, 401, 375.5, 239.5, (1, 2, 3, 4), "fisheye"),
        ),
        ("FOV", "400 401 376 240 0.9", Camera(752, 480, 400, 401, 375.5, 239.5, (0.9,), "fov")),
    ],
)
def test_colmap_models_and_their_half_pixel(tmp_path: Path, model: str, parameters: str, expected: Camera) -> None:
    path = written(tmp_path, COLMAP.format(model=model, parameters=parameters), "cameras.txt")
    assert load_calibration(path).camera(752, 480) == expected


def test_numbers_on_the_command_line() -> None:
    assert load_calibration("500,501,320,240").camera(640, 480) == Camera(640, 480, 500, 501, 320, 240)
    assert load_calibration("500, 501, 320, 240, -0.1, 0, 0, 0, 1e-3").camera(640, 480).distortion == (
        -0.1,
        0,
        0,
        0,
        1e-3,
    )


def test_field_of_view() -> None:
    camera = from_field_of_view(90.0, 640, 480).camera(640, 480)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (pytest.approx(320), pytest.approx(320), 319.5, 239.5)


def test_another_image_size_is_refused_with_both_sizes(tmp_path: Path) -> None:
    calibration = load_calibration(written(tmp_path, calibration_yaml(CAMERA)))
    with pytest.raises(
        InputError, match=r"camera.yaml: calibrated for 752x480 but the images are 640x480; give --camera"
    ):
        calibration.camera(640, 480)
    with pytest.raises(InputError, match=r"the shape is the same, so give --camera .* scaled"):
        calibration.camera(376, 240)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("width: [", "not valid YAML"),
        ("- 1\n- 2\n", "no `key: value` pairs"),
        ("width: 3\nheight: 4\nfx: 1\nfy: 1\ncx: 0\n", "has no cy"),
        ("width: 3\nheight: 4\nfx: -1\nfy: 1\ncx: 0\ncy: 0\n", "must be positive"),
        ("fx: .nan\nfy: 1\ncx: 0\ncy: 0\n", "must be positive"),
        ("fx: one\nfy: 1\ncx: 0\ncy: 0\n", "not what it should be"),
        ("fx: 1\nfy: 1\ncx: 0\ncy: 0\ndistortion_model: magic\n", "magic"),
        ("fx: 1\nfy: 1\ncx: 0\ncy: 0\nfps: -3\n", "fps"),
        ("camera_matrix: [1, 2]\n", "2 numbers, not 9"),
    ],
)
def test_bad_files_are_one_line_errors(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(InputError, match=reason) as error:
        load_calibration(written(tmp_path, text))
    assert "camera.yaml" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", ["1,2,3", "1,2,3,4,5", "none.yaml", "1,2,3,4e"])
def test_bad_command_line_values(text: str) -> None:
    with pytest.raises(InputError, match="--camera"):
        load_calibration(text)
