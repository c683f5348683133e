"""Calibrations in the notations of other tools: the numbers are those of the file, or the file is refused by name."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from camera_notations import (
    BASALT,
    BROWN,
    BROWN5,
    BROWN8,
    CX,
    CY,
    FILE_STORAGE,
    FISHEYE,
    FX,
    FX_TO_CY,
    FY,
    GYROFLOW,
    INTRINSICS,
    KITTI_RAW,
    MATRIX,
    METASHAPE,
    OAK,
    READ,
    REFUSED,
    SIZE,
    ZED,
    K,
)
from improvo.errors import InputError
from improvo.geometry.camera import Camera
from improvo.geometry.camera_files import load_calibration


def written(folder: Path, name: str, content: str | bytes) -> str:
    name, _, camera = name.partition("#")
    data = content.encode() if isinstance(content, str) else content
    (folder / name).write_bytes(data)
    return str(folder / name) + (f"#{camera}" if camera else "")


@pytest.mark.parametrize("ends", ["unix", "windows", "mark"])
@pytest.mark.parametrize("case", READ, ids=[case[0] for case in READ])
def test_the_numbers_are_those_of_the_file(
    tmp_path: Path, case: tuple[str, str, tuple[float, ...], str, bool], ends: str
) -> None:
    name, content, distortion, model, sized = case
    if ends == "windows":
        content = content.replace("\n", "\r\n")
    if ends == "mark":
        content = "\ufeff" + content
    calibration = load_calibration(written(tmp_path, name, content))
    camera = calibration.camera(*(calibration.size or SIZE))
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], INTRINSICS, rtol=0, atol=1e-9)
    assert camera.distortion_model == model
    np.testing.assert_allclose(camera.distortion, distortion, rtol=0, atol=1e-12)
    if sized:
        assert calibration.size == SIZE


def test_npz_of_an_opencv_script(tmp_path: Path) -> None:
    np.savez(tmp_path / "calib.npz", mtx=np.array(MATRIX), dist=np.array([BROWN5]), rvecs=np.zeros((9, 3, 1)))
    camera = load_calibration(str(tmp_path / "calib.npz")).camera(*SIZE)
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion) == (*INTRINSICS, BROWN5)


@pytest.mark.parametrize(("distortion", "fisheye"), [(BROWN, False), (BROWN5, False), (BROWN8, False), (FISHEYE, True)])
def test_points_land_where_opencv_puts_them(tmp_path: Path, distortion: tuple[float, ...], fisheye: bool) -> None:
    content = FILE_STORAGE.format(fisheye=int(fisheye), count=len(distortion), distortion=list(distortion))
    camera = load_calibration(written(tmp_path, "camera.yml", content)).camera(*SIZE)
    rays = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2))
    points = np.concatenate([rays, np.ones((50, 1))], axis=1)[:, None]
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    expected, _ = project(points, np.zeros((3, 1)), np.zeros((3, 1)), camera.K, np.array(distortion))
    ours = camera.distort(rays) * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    np.testing.assert_allclose(ours, expected.reshape(-1, 2), rtol=0, atol=1e-9)


@pytest.mark.parametrize("suffix", ["txt", "bin"])
def test_colmap_cameras_as_pycolmap_writes_and_projects_them(tmp_path: Path, suffix: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    models = {
        "SIMPLE_PINHOLE": [400, 376, 240],
        "PINHOLE": [400, 401, 376, 240],
        "SIMPLE_RADIAL": [400, 376, 240, 0.1],
        "RADIAL": [400, 376, 240, 0.1, -0.02],
        "OPENCV": [400, 401, 376, 240, *BROWN],
        "FULL_OPENCV": [400, 401, 376, 240, *BROWN8],
        "OPENCV_FISHEYE": [400, 401, 376, 240, *FISHEYE],
        "SIMPLE_RADIAL_FISHEYE": [400, 376, 240, 0.1],
        "RADIAL_FISHEYE": [400, 376, 240, 0.1, -0.02],
        "FOV": [400, 401, 376, 240, 0.9],
    }
    reconstruction = pycolmap.Reconstruction()
    theirs = {}
    for number, (model, parameters) in enumerate(models.items(), start=1):
        theirs[number] = pycolmap.Camera(model=model, width=752, height=480, params=parameters, camera_id=number)
        reconstruction.add_camera(theirs[number])
    (reconstruction.write_text if suffix == "txt" else reconstruction.write_binary)(str(tmp_path))
    rays = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2))
    for number, camera in theirs.items():
        ours = load_calibration(f"{tmp_path / f'cameras.{suffix}'}#{number}").camera(*SIZE)
        expected = camera.img_from_cam(np.concatenate([rays, np.ones((50, 1))], axis=1)) - 0.5
        pixels = ours.distort(rays) * [ours.fx, ours.fy] + [ours.cx, ours.cy]
        np.testing.assert_allclose(pixels, expected, rtol=0, atol=1e-9, err_msg=str(camera))
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "sparse" / "0" / f"cameras.{suffix}").write_bytes((tmp_path / f"cameras.{suffix}").read_bytes())
    assert load_calibration(str(tmp_path)).size == SIZE


@pytest.mark.parametrize("suffix", ["txt", "bin"])
@pytest.mark.parametrize("second", ["unsupported", "unknown", "impossible"])
def test_a_camera_that_is_not_asked_for_need_not_be_supported(tmp_path: Path, suffix: str, second: str) -> None:
    """The first is taken where none is named; to ask for the other says what is wrong with it."""
    model, number, values = {
        "unsupported": ("THIN_PRISM_FISHEYE", 10, [1.0] * 12),
        "unknown": ("OF_TOMORROW", 99, [1.0] * 3),
        "impossible": ("PINHOLE", 1, [-400.0, 401, 376, 240]),
    }[second]
    first = [400.0, 401, 376, 240]
    path = tmp_path / f"cameras.{suffix}"
    if suffix == "txt":
        path.write_text(
            f"1 PINHOLE 752 480 {' '.join(map(str, first))}\n7 {model} 752 480 {' '.join(map(str, values))}\n"
        )
    else:
        rows = [
            struct.pack(f"<iiQQ{len(p)}d", camera, n, *SIZE, *p)
            for camera, n, p in ((1, 1, first), (7, number, values))
        ]
        path.write_bytes(struct.pack("<Q", 2) + b"".join(rows))
    for camera in ("", "#1"):
        assert load_calibration(f"{path}{camera}").intrinsics == (400, 401, 375.5, 239.5)
    with pytest.raises(InputError, match=r"not supported|fx"):
        load_calibration(f"{path}#7")


PAIR = """%YAML:1.0
---
M1: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 400., 0., 376., 0., 401., 240., 0., 0., 1. ]
D1: !!opencv-matrix
   rows: 1
   cols: 4
   dt: d
   data: [ -0.28, 0.07, 0., 0. ]
P1: !!opencv-matrix
   rows: 3
   cols: 4
   dt: d
   data: [ 380., 0., 370., 0., 0., 380., 240., 0., 0., 0., 1., 0. ]
P2: [380., 0., 370., -9., 0., 380., 240., 0., 0., 0., 1., 0.]
Tr: 0
"""


def test_rows_of_a_stereo_pair_in_yaml_are_not_those_of_kitti(tmp_path: Path) -> None:
    flat = FX_TO_CY.format("") + "k1: -0.28\nk2: 0.07\np1: 0\np2: 0\nP1: [380, 0, 370, 0, 0, 380, 240, 0, 0, 0, 1, 0]\n"
    for name, content in (("a.yml", PAIR), ("b.yml", K + "dist_coeffs: [-0.28, 0.07, 0, 0]\nTr: 0\n"), ("c.yml", flat)):
        calibration = load_calibration(written(tmp_path, name, content))
        assert calibration.distortion[:4] == (-0.28, 0.07, 0, 0)
    kitti = "P0: 400 0 376 0 0 401 240 0 0 0 1 0\nP1: 4e2 0 376 -2.1e+02 0 401 240 0 0 0 1 0\n"
    for content in (kitti, kitti.replace("\n", "\r\n"), kitti.replace(": ", ":\t")):
        assert load_calibration(written(tmp_path, "calib.txt", content)).intrinsics == (400, 401, 376, 240)
        assert load_calibration(written(tmp_path, "calib.txt#P1", content)).intrinsics == (400, 401, 376, 240)


def test_the_camera_of_the_images_size_is_taken(tmp_path: Path) -> None:
    calibration = load_calibration(written(tmp_path, "SN1.conf", ZED.replace("LEFT_CAM_HD", "LEFT_CAM_VGA")))
    assert calibration.camera(2208, 1242).fx == 1400
    assert calibration.camera(672, 376).fx == FX
    raw = load_calibration(written(tmp_path, "calib_cam_to_cam.txt", KITTI_RAW))
    assert raw.camera(*SIZE).distortion == ()
    assert raw.camera(1392, 512).distortion == (-0.37, 0.2, 0.001, 0.002, -0.07)


@pytest.mark.parametrize(("content", "named"), REFUSED)
def test_what_is_not_understood_is_named_and_never_dropped(tmp_path: Path, content: str, named: str) -> None:
    with pytest.raises(InputError) as error:
        load_calibration(written(tmp_path, "camera.yaml", content))
    message = str(error.value)
    assert "camera.yaml" in message
    assert named in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("metashape.xml", METASHAPE.replace("</k3>", "</k3><k4>0.1</k4>")),
        ("metashape.xml", METASHAPE.replace("</k3>", "</k3><b2>0.1</b2>")),
        ("gyroflow.json", json.dumps({**GYROFLOW, "input_horizontal_stretch": 1.33})),
        ("gyroflow.json", json.dumps({**GYROFLOW, "digital_lens": "gopro_superview"})),
        ("oak.json", json.dumps(OAK).replace("0, 0, 0, 0, 0, 0]", "0.1, 0, 0, 0, 0, 0]")),
        ("basalt.json", json.dumps(BASALT).replace("kb4", "ds")),
        ("cameras.sfm", "{}"),
        ("calib.pkl", "x"),
        ("cameras.txt", "1 THIN_PRISM_FISHEYE 752 480 1 1 1 1 1 1 1 1 1 1 1 1"),
        ("cameras.bin", "short"),
        ("dso.txt", "400 401 376 240 0.9\n"),
        ("trajectory.txt", "0.0 1 2 3 0 0 0 1\n0.1 1 2 3 0 0 0 1\n"),
        ("kitti.txt", "P1: 1 2\n"),
        ("bad.xml", "<a><b></a>"),
        ("bad.json", "{"),
        ("bad.ini", "[A]\nfx\n"),
        ("deep.yaml", "[" * 3000),
        ("binary.yaml", "\0\1\2"),
    ],
)
def test_what_cannot_be_read_is_one_line_that_names_the_file(tmp_path: Path, name: str, content: str) -> None:
    with pytest.raises(InputError) as error:
        load_calibration(written(tmp_path, name, content))
    assert name in str(error.value)
    assert "\n" not in str(error.value)


def test_what_says_nothing_about_the_lens_is_no_error(tmp_path: Path) -> None:
    extras: dict[str, Any] = {
        "camera_name": "left",
        "serial_number": 1234,
        "k3": 0,
        "reprojection_error": 0.3,
        "R": [1, 0, 0, 0, 1, 0, 0, 0, 1],
        "board_size": [9, 6],
        "date": "2026-08-01",
        "baseline": 0.12,
        "T_cam_body": [0, 0, 0, 1],
    }
    text = FX_TO_CY.format("") + "".join(f"{key}: {json.dumps(value)}\n" for key, value in extras.items())
    assert load_calibration(written(tmp_path, "camera.yaml", text)).camera(*SIZE).distortion in ((), (0.0,) * 5)


def test_a_camera_of_several_is_chosen_by_name(tmp_path: Path) -> None:
    sides = (("left", 400), ("right", 500))
    text = "".join(f"{side}:\n  K: [[{f}, 0, 300], [0, {f}, 200], [0, 0, 1]]\n" for side, f in sides)
    path = written(tmp_path, "stereo.yaml", text)
    assert [load_calibration(path + name).camera(*SIZE).fx for name in ("", "#right", "#1")] == [400, 500, 500]
    with pytest.raises(InputError, match="it has left, right"):
        load_calibration(path + "#middle")


def test_a_folder_without_a_calibration_says_so(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"is a folder without cameras\.bin"):
        load_calibration(str(tmp_path))


def test_own_camera_yaml_is_what_it_was(tmp_path: Path) -> None:
    text = (
        "model: pinhole\nwidth: 752\nheight: 480\nfx: 458.654\nfy: 457.296\ncx: 367.215\ncy: 248.375\ndistortion: []\n"
    )
    assert load_calibration(written(tmp_path, "camera.yaml", text)).camera(*SIZE) == Camera(*SIZE, *INTRINSICS)


@pytest.mark.parametrize(
    "text",
    ["458.654,457.296,367.215,248.375", "458.654 457.296 367.215 248.375", "458,654 457,296 367,215 248,375"],
)
def test_numbers_after_camera_in_any_spelling(text: str) -> None:
    assert load_calibration(text).camera(*SIZE) == Camera(*SIZE, *INTRINSICS)


def test_replica_keeps_the_scale_of_depth_beside_the_camera(tmp_path: Path) -> None:
    content = {"camera": {"w": 752, "h": 480, "fx": FX, "fy": FY, "cx": CX, "cy": CY, "scale": 6553.5}}
    assert load_calibration(written(tmp_path, "cam_params.json", json.dumps(content))).depth_scale == 6553.5
    content["camera"]["scale"] = 0.5
    with pytest.raises(InputError, match="`scale` could be"):
        load_calibration(written(tmp_path, "cam_params.json", json.dumps(content)))


def test_arkit_scenes(tmp_path: Path) -> None:
    camera = load_calibration(written(tmp_path, "1.pincam", f"752 480 {FX} {FY} {CX} {CY}")).camera(*SIZE)
    assert camera == Camera(*SIZE, *INTRINSICS)
    with pytest.raises(InputError, match="is no calibration"):
        load_calibration(written(tmp_path, "2.txt", f"{FX} {FY} {CX} {CY} -0.3 0.1"))
