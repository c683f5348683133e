"""`depth.zip` and `dense.ply`: written, read back, damaged."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from improvo.depth import DepthMap
from improvo.depth.archive import DepthReader, DepthWriter
from improvo.depth.cloud import DenseCloud, write_cloud
from improvo.depth.settings import CloudSettings
from improvo.errors import ConfigError, InputError

K = np.array([[100.0, 0, 31.5], [0, 100, 23.5], [0, 0, 1]])


def written(path: Path, seed: int = 0) -> dict[int, np.ndarray]:
    """A file of two maps, and what was written."""
    rng = np.random.default_rng(seed)
    maps = {frame: rng.uniform(0.3, 8, (48, 64)).astype(np.float32) for frame in (3, 12)}
    maps[12][10:20] = 0
    with DepthWriter(path, K) as writer:
        for frame, depth in maps.items():
            writer.write(frame, depth)
    return maps


def test_maps_come_back(tmp_path: Path) -> None:
    maps = written(tmp_path / "depth.zip")
    reader = DepthReader(tmp_path)
    assert reader.frames == [3, 12]
    np.testing.assert_array_equal(reader.K, K)
    for frame, depth in maps.items():
        back = reader.depth(frame)
        assert back.dtype == np.float32
        np.testing.assert_array_equal(back == 0, depth == 0)
        np.testing.assert_allclose(back, depth, atol=0.51 / reader.scales[frame])


def test_other_tools_read_the_pictures(tmp_path: Path) -> None:
    maps = written(tmp_path / "depth.zip")
    with zipfile.ZipFile(tmp_path / "depth.zip") as file:
        file.extractall(tmp_path / "maps")
    values = cv2.imread(str(tmp_path / "maps" / "000003.png"), cv2.IMREAD_UNCHANGED)
    assert values.dtype == np.uint16
    np.testing.assert_allclose(values / DepthReader(tmp_path).scales[3], maps[3], atol=1e-3)


def test_the_same_maps_give_the_same_bytes(tmp_path: Path) -> None:
    written(tmp_path / "a.zip")
    written(tmp_path / "b.zip")
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()


def test_a_failure_leaves_no_file(tmp_path: Path) -> None:
    def fail() -> None:
        with DepthWriter(tmp_path / "depth.zip", K) as writer:
            writer.write(0, np.ones((4, 4), np.float32))
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_one_far_frame_costs_the_others_nothing(tmp_path: Path) -> None:
    near = np.array([[0.1, 0.3, 1.0, 2.0]], np.float32)
    with DepthWriter(tmp_path / "depth.zip", K) as writer:
        writer.write(0, near)
        writer.write(1, near * np.float32(1e5))
        writer.write(2, np.zeros_like(near))
    reader = DepthReader(tmp_path)
    np.testing.assert_allclose(reader.depth(0), near, rtol=2e-4)
    np.testing.assert_allclose(reader.depth(1), near * 1e5, rtol=2e-4)
    np.testing.assert_array_equal(reader.depth(2), 0)


def test_far_pixels_beyond_16_bits_are_unknown_and_never_another_depth(tmp_path: Path) -> None:
    """What is near keeps its precision: a frame of a street shows the horizon too."""
    depth = np.full((40, 50), 1.0, np.float32)
    depth[0, :5] = 15000.0, 300.0, 320.0, 400.0, 1e-6
    with DepthWriter(tmp_path / "depth.zip", K) as writer:
        writer.write(0, depth)
    back = DepthReader(tmp_path).depth(0)
    np.testing.assert_allclose(back[0, :6], [0, 300, 320, 0, 0, 1], atol=2.6e-3)
    np.testing.assert_allclose(back[1:], 1.0, atol=2.6e-3)


def test_a_file_with_one_scale_for_all_maps_is_read(tmp_path: Path) -> None:
    """From before each map had its own."""
    values = cv2.imencode(".png", np.array([[0, 1000, 20000]], np.uint16))[1].tobytes()
    with zipfile.ZipFile(tmp_path / "depth.zip", "w") as file:
        file.writestr("000007.png", values)
        file.writestr("depth.json", json.dumps({"scale": 5000.0, "K": K.tolist(), "frames": [7]}))
    np.testing.assert_allclose(DepthReader(tmp_path).depth(7), [[0, 0.2, 4.0]])


def test_the_unit_stands_in_the_file(tmp_path: Path) -> None:
    with DepthWriter(tmp_path / "depth.zip", K, "metres, from a known distance") as writer:
        writer.write(0, np.ones((4, 4), np.float32))
    with zipfile.ZipFile(tmp_path / "depth.zip") as file:
        assert json.loads(file.read("depth.json"))["unit"] == "metres, from a known distance"


def test_missing_and_damaged_files_are_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file; `improvo run --dense` writes it"):
        DepthReader(tmp_path)
    (tmp_path / "depth.zip").write_bytes(b"no zip")
    with pytest.raises(InputError, match="is damaged or not written by improvo"):
        DepthReader(tmp_path)
    written(tmp_path / "depth.zip")
    with pytest.raises(InputError, match="has no depth of frame 4"):
        DepthReader(tmp_path).depth(4)
    content = (tmp_path / "depth.zip").read_bytes()
    (tmp_path / "depth.zip").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match="is damaged"):
        DepthReader(tmp_path)


def flat(depth: float, agreeing: int) -> DepthMap:
    """A wall."""
    return DepthMap(
        np.full((48, 64), depth, np.float32),
        np.ones((48, 64), np.float32),
        K,
        np.full((48, 64), agreeing, np.uint8),
    )


def test_a_surface_seen_often_gets_one_point_a_cell(tmp_path: Path) -> None:
    picture = np.full((48, 64, 3), (10, 20, 30), np.uint8)
    cloud = DenseCloud(CloudSettings(voxel=0.05))
    for _ in range(20):
        cloud.add(flat(2.01, 2), picture, np.eye(4))
    points, colours = cloud.points()
    assert len(np.unique(np.floor(points / 0.05), axis=0)) == len(points)
    assert 300 < len(points) < 1000  # 1.26 x 0.94 in cells of 0.05
    np.testing.assert_allclose(points[:, 2], 2.01, rtol=1e-6)
    np.testing.assert_array_equal(colours[0], (30, 20, 10))
    write_cloud(tmp_path / "dense.ply", points, colours)
    header, _, body = (tmp_path / "dense.ply").read_bytes().partition(b"end_header\n")
    assert f"element vertex {len(points)}".encode() in header
    assert len(body) == 15 * len(points)


@pytest.mark.parametrize("unit", [0.01, 1.0, 22.0])
def test_a_cloud_has_as_many_points_in_any_unit(unit: float) -> None:
    picture = np.zeros((48, 64), np.uint8)
    cloud = DenseCloud(CloudSettings(voxel=0.05), unit)
    cloud.add(flat(2.01 * unit, 2), picture, np.eye(4))
    same = DenseCloud(CloudSettings(voxel=0.05))
    same.add(flat(2.01, 2), picture, np.eye(4))
    np.testing.assert_allclose(cloud.points()[0], unit * same.points()[0], rtol=1e-5, atol=1e-5 * unit)


def test_points_that_too_few_frames_agree_on_are_left_out() -> None:
    picture = np.zeros((48, 64), np.uint8)
    cloud = DenseCloud(CloudSettings(voxel=0.05, least=2))
    cloud.add(flat(2.01, 1), picture, np.eye(4))
    assert len(cloud.points()[0]) == 0
    once = DenseCloud(CloudSettings(voxel=0.001, least_points=2))
    once.add(flat(2.01, 5), picture, np.eye(4))
    assert len(once.points()[0]) == 0, "cells with a single pixel"


def test_an_empty_cloud_is_a_valid_file(tmp_path: Path) -> None:
    points, colours = DenseCloud(CloudSettings()).points()
    write_cloud(tmp_path / "dense.ply", points, colours)
    assert b"element vertex 0" in (tmp_path / "dense.ply").read_bytes()


def test_impossible_cells_are_refused() -> None:
    with pytest.raises(ConfigError, match="voxel"):
        CloudSettings(voxel=0)
