"""Formats that no real file was at hand for, from bytes made by encoders: the round trip is exact."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import ros_encoders
import sequence_encoders as encoders
from improvo.geometry.camera import Camera
from improvo.geometry.se3 import rigid, so3_exp
from improvo.sequences import Sequence, open_recording, open_sequence
from sequence_builders import CAMERA, depths, images, poses
from sequence_encoders import Scene

COUNT = 6
FPS = 20.0
BODY_FROM_CAM = rigid(so3_exp(np.array([0.3, -0.2, 1.5])), np.array([0.02, -0.06, 0.01]))


def scene(count: int = COUNT) -> Scene:
    # times a binary fraction of a second apart: every format holds them exactly
    return Scene(CAMERA, 1000.0 + np.arange(count) * 0.25, images(count), depths(count), poses(count))


def float32_scene() -> Scene:
    """With intrinsics that 32-bit floats hold exactly."""
    return replace(scene(), camera=replace(CAMERA, fx=90.0, fy=91.0))


WRITERS: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "tum": ("tum", lambda path: encoders.write_tum(path / "s", scene())),
    "images": ("images", lambda path: encoders.write_image_folder(path / "s", scene())),
    "7scenes": ("7scenes", lambda path: encoders.write_seven_scenes(path / "s", scene(), fps=4.0)),
    "kitti": ("kitti", lambda path: encoders.write_kitti(path / "s", scene())),
    "euroc": ("euroc", lambda path: encoders.write_euroc(path / "s", scene(), BODY_FROM_CAM)),
    "sens-png": ("sens", lambda path: encoders.write_sens(path / "s.sens", float32_scene())),
    "sens-raw": ("sens", lambda path: encoders.write_sens(path / "s.sens", float32_scene(), "raw")),
    "scannet": ("scannet", lambda path: encoders.write_scannet_folder(path / "s", scene())),
    "nerfstudio": ("nerfstudio", lambda path: encoders.write_transforms(path / "s", scene())),
    "colmap": ("colmap", lambda path: encoders.write_colmap_project(path / "s", scene())),
    "colmap-undistorted": ("colmap", lambda path: encoders.write_colmap_project(path / "s", scene(), "sparse")),
    "polycam": ("polycam", lambda path: encoders.write_polycam(path / "s", scene())),
    "record3d": ("record3d", lambda path: encoders.write_r3d(path / "s.r3d", scene())),
    "ros1": ("rosbag", lambda path: ros_encoders.write_bag(path / "s.bag", scene(), 1)),
    "ros1-rgb8": ("rosbag", lambda path: ros_encoders.write_bag(path / "s.bag", scene(), 1, "rgb8")),
    "ros1-latency": ("rosbag", lambda path: ros_encoders.write_bag(path / "s.bag", scene(), 1, latency=1234567)),
    "ros1-compressed": ("rosbag", lambda path: ros_encoders.write_bag(path / "s.bag", scene(), 1, "compressed")),
    "ros2": ("rosbag", lambda path: ros_encoders.write_bag(path / "s", scene(), 2)),
    "ros2-bgra8": ("rosbag", lambda path: ros_encoders.write_bag(path / "s", scene(), 2, "bgra8")),
    "ros2-latency": ("rosbag", lambda path: ros_encoders.write_bag(path / "s", scene(), 2, latency=1234567)),
    "ros2-mcap": ("rosbag", lambda path: ros_encoders.write_bag(path / "s", scene(), 2, "bgr8", storage="mcap")),
    "ros2-mcap-latency": (
        "rosbag",
        lambda path: ros_encoders.write_bag(path / "s", scene(), 2, latency=1234567, storage="mcap"),
    ),
}
WITHOUT_TIME = ("7scenes", "scannet", "nerfstudio", "colmap", "colmap-undistorted")
WITHOUT_DEPTH = ("images", "kitti", "euroc", "record3d", "colmap", "colmap-undistorted")
WITHOUT_TRUTH = ("images",)


@pytest.mark.parametrize("name", WRITERS)
def test_round_trip_is_exact(tmp_path: Path, name: str) -> None:
    format, write = WRITERS[name]
    expected = scene()
    sequence = open_sequence(write(tmp_path))
    assert sequence.format == format
    assert len(sequence) == COUNT
    assert sequence.camera.is_pinhole
    np.testing.assert_allclose(sequence.camera.K, expected.camera.K, rtol=0, atol=1e-9)
    start = 0.0 if name in WITHOUT_TIME else 1000.0
    step = 1 / 30 if name in ("scannet", "nerfstudio", "colmap", "colmap-undistorted") else 0.25
    np.testing.assert_allclose(sequence.times, start + np.arange(COUNT) * step, rtol=0, atol=1e-9)
    for i, frame in enumerate(sequence):
        assert (frame.image == expected.images[i]).all()
        assert frame.source_index == i
    assert not sequence.skipped
    assert sequence.present.tolist() == sequence.indices.tolist()
    for i in (3, 0, 5, 2):
        assert (sequence[i].image == expected.images[i]).all()
        depth = sequence.depth(i)
        if name in WITHOUT_DEPTH:
            assert depth is None
        else:
            np.testing.assert_array_equal(depth, expected.depths[i])
    if name in WITHOUT_TRUTH:
        assert sequence.ground_truth is None
    else:
        assert sequence.ground_truth is not None
        tolerance = 1e-6 if name.startswith("sens") else 1e-9
        np.testing.assert_allclose(sequence.ground_truth.world_from_cam, expected.poses, atol=tolerance)


def test_icl_nuim_reflects_the_published_poses(tmp_path: Path) -> None:
    camera = Camera(640, 480, 481.2, 480.0, 319.5, 239.5)
    expected = Scene(camera, np.arange(3) / 30, images(3, camera), depths(3, camera), poses(3))
    sequence = open_sequence(encoders.write_icl(tmp_path, expected))
    assert (sequence.format, sequence.camera) == ("icl", camera)
    np.testing.assert_allclose(sequence.times, expected.times)
    assert all((frame.image == image).all() for frame, image in zip(sequence, expected.images, strict=True))
    np.testing.assert_allclose(sequence.depth(2), expected.depths[2], atol=1e-4)
    assert sequence.ground_truth is not None
    assert sequence.ground_truth.valid.tolist() == [False, True, True]
    np.testing.assert_allclose(sequence.ground_truth.world_from_cam[1:], expected.poses[1:], atol=1e-9)


def test_icl_nuim_numbers_of_a_thinned_copy_are_frames_and_no_milliseconds(tmp_path: Path) -> None:
    camera = Camera(640, 480, 481.2, 480.0, 319.5, 239.5)
    expected = Scene(camera, np.arange(3) / 30, images(3, camera), depths(3, camera), poses(3))
    folder = encoders.write_icl(tmp_path, expected)
    for file, columns in ((next(folder.glob("*.gt.freiburg")), (0,)), (folder / "associations.txt", (0, 2))):
        rows = [line.split() for line in file.read_text().splitlines()]
        for row in rows:
            for column in columns:
                row[column] = str(10 * int(row[column]))
        file.write_text("\n".join(" ".join(row) for row in rows))
    sequence = open_sequence(folder)
    np.testing.assert_allclose(sequence.times, 10 * expected.times)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.world_from_cam[1:], expected.poses[1:], atol=1e-9)


@pytest.mark.parametrize(
    "first", ["1 0 0 -2.25 0 0 0 1", "0 0 0 -2.5 0 0 0 1", "1 0 0 2.25 0 0 0 1", "1.5 0 0 -2.25 0 0 0 1"]
)
def test_icl_nuim_is_known_where_its_trajectory_is_named_as_that_of_tum(tmp_path: Path, first: str) -> None:
    camera = Camera(640, 480, 481.2, 480.0, 319.5, 239.5)
    expected = Scene(camera, np.arange(3) / 30, images(3, camera), depths(3, camera), poses(3))
    folder = encoders.write_icl(tmp_path, expected)
    published = next(folder.glob("*.gt.freiburg"))
    rows = [first, *published.read_text().splitlines()[1:]]
    (folder / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows))
    published.unlink()
    of_icl = first in ("1 0 0 -2.25 0 0 0 1", "0 0 0 -2.5 0 0 0 1")
    recording = open_recording(folder)
    assert recording.format == ("icl" if of_icl else "tum")
    assert recording.ground_truth is not None
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    last = expected.poses[2] if of_icl else flip @ expected.poses[2] @ flip
    np.testing.assert_allclose(recording.ground_truth.world_from_cam[-1], last, atol=1e-9)


def test_scannet_info_layout(tmp_path: Path) -> None:
    expected = scene()
    encoders.write_seven_scenes(tmp_path / "s", expected, fps=10.0)
    (tmp_path / "s" / "camera.yaml").unlink()
    matrix = np.eye(4)
    matrix[:3, :3] = expected.camera.K
    numbers = " ".join(repr(float(value)) for value in matrix.ravel())
    identity = " ".join(str(value) for value in np.eye(4).ravel())
    (tmp_path / "s" / "_info.txt").write_text(
        f"m_versionNumber = 4\nm_sensorName = StructureSensor\nm_colorWidth = {CAMERA.width}\n"
        f"m_colorHeight = {CAMERA.height}\nm_depthWidth = {CAMERA.width}\nm_depthHeight = {CAMERA.height}\n"
        f"m_depthShift = 1000\nm_calibrationColorIntrinsic = {numbers}\nm_calibrationColorExtrinsic = {identity}\n"
        f"m_calibrationDepthIntrinsic = {numbers}\nm_calibrationDepthExtrinsic = {identity}\nm_frames.size = {COUNT}\n"
    )
    sequence = open_sequence(tmp_path / "s")
    assert (sequence.format, sequence.camera) == ("scannet", CAMERA)
    np.testing.assert_allclose(sequence.times, np.arange(COUNT) / 30)
    np.testing.assert_array_equal(sequence.depth(3), expected.depths[3])
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.world_from_cam, expected.poses, atol=1e-9)


def plane_depth(camera: Camera, normal: np.ndarray, distance: float) -> np.ndarray:
    """Depth (H, W) of the plane normal . X = distance seen by a camera."""
    x, y = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    rays = camera.unproject(np.stack([x, y], axis=-1))
    return distance / (rays @ normal)


@pytest.mark.parametrize("moved", [False, True])
def test_sens_depth_is_carried_to_the_colour_camera(tmp_path: Path, moved: bool) -> None:
    """A slanted wall, seen by a depth camera of another size, focal length and place."""
    depth_camera = Camera(64, 48, 50.0, 51.0, 31.0, 24.0)
    colour_from_depth = np.eye(4)
    if moved:
        colour_from_depth = rigid(so3_exp(np.array([0.01, -0.02, 0.005])), np.array([0.04, 0.003, -0.01]))
    normal, distance = np.array([0.2, -0.1, 1.0]), 2.0  # in the colour camera's frame
    normal_in_depth = colour_from_depth[:3, :3].T @ normal
    distance_in_depth = distance - normal @ colour_from_depth[:3, 3]
    values = np.rint(1000 * plane_depth(depth_camera, normal_in_depth, distance_in_depth)).astype(np.uint16)
    path = encoders.write_sens(
        tmp_path / "s.sens",
        scene(),
        depth_camera=depth_camera,
        colour_from_depth=colour_from_depth,
        depths=[values] * COUNT,
    )
    depth = open_sequence(path).depth(1)
    assert depth is not None
    expected = plane_depth(CAMERA, normal, distance)
    seen = np.isfinite(depth)
    assert seen[8:-8, 8:-8].mean() > 0.97
    # a depth pixel covers about two colour pixels, over which the wall recedes by a centimetre or two
    assert np.abs(depth - expected)[seen].max() < 0.03
    assert np.abs(depth - expected)[seen].mean() < 0.008


def test_euroc_camera_by_topic_and_by_folder(tmp_path: Path) -> None:
    first, second = scene(), replace(scene(), images=images(2 * COUNT)[COUNT:], camera=replace(CAMERA, cx=40.0))
    encoders.write_euroc(tmp_path / "s", first, BODY_FROM_CAM)
    encoders.write_euroc(tmp_path / "s", second, np.eye(4), "cam1")
    for path, topic, expected in (
        (tmp_path / "s", None, first),
        (tmp_path / "s", "cam1", second),
        (tmp_path / "s" / "mav0", "cam1", second),
        (tmp_path / "s" / "mav0" / "cam1", None, second),
    ):
        sequence = open_sequence(path, topic=topic)
        assert sequence.camera == expected.camera
        assert (sequence[2].image == expected.images[2]).all()


def test_euroc_distortion_is_undone(tmp_path: Path) -> None:
    raw = replace(CAMERA, distortion=(-0.28, 0.07, 0.0002, 0.00002))
    sequence = open_sequence(encoders.write_euroc(tmp_path, replace(scene(), camera=raw), BODY_FROM_CAM))
    assert sequence.raw_camera == raw
    assert sequence.camera.is_pinhole


def test_varying_intrinsics_use_the_median_and_say_so(tmp_path: Path) -> None:
    encoders.write_polycam(tmp_path, scene())
    assert not open_sequence(tmp_path).notes
    files = sorted((tmp_path / "keyframes" / "cameras").iterdir())
    for file, factor in zip(files, (0.97, 0.99, 1.0, 1.0, 1.0, 1.03), strict=True):
        entry = json.loads(file.read_text())
        file.write_text(json.dumps(entry | {"fx": entry["fx"] * factor}))
    sequence = open_sequence(tmp_path)
    assert sequence.camera.fx == CAMERA.fx
    assert any("vary by 3.0 %" in note for note in sequence.notes)


def test_ros_topic_is_chosen_and_named(tmp_path: Path) -> None:
    expected = scene()
    with ros_encoders.BagWriter(tmp_path / "two.bag", 1) as bag:
        for i, image in enumerate(expected.images):
            stamp = round(expected.times[i] * 1000) * 1_000_000
            bag.write("/left/image_raw", bag.image(stamp, image, "mono8"), stamp)
            bag.write("/left/camera_info", bag.camera_info(stamp, expected), stamp)
            bag.write("/right/image_raw", bag.image(stamp, image[:, ::-1], "mono8"), stamp)
            bag.write("/right/camera_info", bag.camera_info(stamp, expected), stamp)
    left = open_sequence(tmp_path / "two.bag")
    assert (left[1].image == expected.images[1]).all()
    assert any("/left/image_raw chosen" in note and "/right/image_raw" in note for note in left.notes)
    right = open_sequence(tmp_path / "two.bag", topic="/right/image_raw")
    assert (right[1].image == expected.images[1][:, ::-1]).all()


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_ros_bayer_patterns_have_their_colours_right(tmp_path: Path, pattern: str) -> None:
    """A red picture under each pattern is red again."""
    mosaic = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    at = pattern.index("r")
    mosaic[at // 2 :: 2, at % 2 :: 2] = 200
    with ros_encoders.BagWriter(tmp_path / "b.bag", 1) as bag:
        bag.write("/image_raw", bag.image(10**9, mosaic, f"bayer_{pattern}8"), 10**9)
    recording = open_sequence(tmp_path / "b.bag", fov=60.0).recording
    blue, green, red = recording.image(0)[10:-10, 10:-10].reshape(-1, 3).mean(axis=0)
    assert red > 190
    assert max(blue, green) < 10


def test_random_access_and_iteration_agree_in_long_bags(tmp_path: Path) -> None:
    long = scene(40)
    for version, path in ((1, tmp_path / "s.bag"), (2, tmp_path / "s")):
        sequence: Sequence = open_sequence(ros_encoders.write_bag(path, long, version))
        for i in np.random.default_rng(0).permutation(40).tolist():
            assert (sequence[i].image == long.images[i]).all()
        assert [frame.source_index for frame in open_sequence(path, stride=13)] == [0, 13, 26, 39]


def test_jpeg_in_sens_and_in_bags(tmp_path: Path) -> None:
    expected = scene()
    jpeg = [cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))[1].tobytes() for image in expected.images]
    decoded = [cv2.cvtColor(cv2.imdecode(np.frombuffer(d, np.uint8), 1), cv2.COLOR_BGR2GRAY) for d in jpeg]
    with ros_encoders.BagWriter(tmp_path / "b.bag", 1) as bag:
        for i, data in enumerate(jpeg):
            stamp = 10**9 + i * 10**8
            bag.write("/image_raw/compressed", bag.compressed(stamp, data, "bgr8; jpeg compressed bgr8"), stamp)
    for path in (tmp_path / "b.bag", encoders.write_sens(tmp_path / "s.sens", expected, "jpeg")):
        frames = list(open_sequence(path, camera="90,91,47,36.5"))
        assert all((frame.image == image).all() for frame, image in zip(frames, decoded, strict=True))


def test_bag_as_the_realsense_sdk_records_it(tmp_path: Path) -> None:
    made = scene()
    colour, depth = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"
    with ros_encoders.BagWriter(tmp_path / "s.bag", 1) as bag:
        for i, image in enumerate(made.images):
            stamp = round(made.times[i] * 1000) * 1_000_000
            if i == 0:
                for topic in (colour, depth):
                    info = bag.camera_info(stamp, made, "Inverse Brown Conrady")
                    bag.write(f"{topic}/info/camera_info", info, stamp)
            bag.write(f"{depth}/image/data", bag.image(stamp, made.millimetres(i), "mono16"), stamp)
            bag.write(f"{colour}/image/data", bag.image(stamp, cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), "rgb8"), stamp)
    sequence = open_sequence(tmp_path / "s.bag")
    assert sequence.camera == CAMERA
    assert all((frame.image == image).all() for frame, image in zip(sequence, made.images, strict=True))
    found = sequence.depth(2)
    assert found is not None
    np.testing.assert_allclose(found, made.depths[2], atol=1e-6)


def test_deep_pictures_in_bags_use_one_range(tmp_path: Path) -> None:
    made = scene()
    with ros_encoders.BagWriter(tmp_path / "s.bag", 1) as bag:
        for i, image in enumerate(made.images):
            stamp = round(made.times[i] * 1000) * 1_000_000
            bag.write("/thermal/image_raw", bag.image(stamp, 7000 + 4 * image.astype(np.uint16), "mono16"), stamp)
    sequence = open_sequence(tmp_path / "s.bag", fov=60.0)
    assert any("stretched to 8 bits" in note for note in sequence.notes)
    a, b = np.polyfit(made.images[1].ravel().astype(float), sequence[1].image.ravel().astype(float), 1)
    assert a > 0.95
    assert np.abs(a * made.images[1] + b - sequence[1].image).mean() < 2


def test_nerf_synthetic_scenes_say_their_angle_only(tmp_path: Path) -> None:
    folder = encoders.write_transforms(tmp_path / "s", scene())
    content = json.loads((folder / "transforms.json").read_text())
    frames = [{k: f[k] for k in ("file_path", "transform_matrix")} for f in content["frames"]]
    (folder / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 0.98, "frames": frames}))
    (folder / "transforms.json").unlink()
    camera = open_sequence(folder).camera
    assert camera.fx == pytest.approx(48 / np.tan(0.49))
    assert (camera.cx, camera.cy) == (47.5, 35.5)
