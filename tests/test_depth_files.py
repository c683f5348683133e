"""`depth.zip` and `dense.ply`: written, read back, damaged."""

from __future__ import annotations

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
    with DepthWriter(path, K, farthest=8.0) as writer:
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
        np.testing.assert_allclose(back, depth, atol=0.51 / reader.scale)


def test_other_tools_read_the_pictures(tmp_path: Path) -> None:
    maps = written(tmp_path / "depth.zip")
    with zipfile.ZipFile(tmp_path / "depth.zip") as file:
        file.extractall(tmp_path / "maps")
    values = cv2.imread(str(tmp_path / "maps" / "000003.png"), cv2.IMREAD_UNCHANGED)
    assert values.dtype == np.uint16
    np.testing.assert_allclose(values / DepthReader(tmp_path).scale, maps[3], atol=1e-3)


def test_the_same_maps_give_the_same_bytes(tmp_path: Path) -> None:
    written(tmp_path / "a.zip")
    written(tmp_path / "b.zip")
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()


def test_a_failure_leaves_no_file(tmp_path: Path) -> None:
    def fail() -> None:
        with DepthWriter(tmp_path / "depth.zip", K, 8.0) as writer:
            writer.write(0, np.ones((4, 4), np.float32))
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_depth_beyond_the_farthest_is_unknown_and_never_another_depth(tmp_path: Path) -> None:
    depth = np.array([[4.0, 8.0, 8.1, 100.0, 1e-6]], np.float32)
    with DepthWriter(tmp_path / "depth.zip", K, 8.0) as writer:
        writer.write(0, depth)
    np.testing.assert_allclose(DepthReader(tmp_path).depth(0), [[4.0, 8.0, 0, 0, 0]], atol=1e-4)


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
