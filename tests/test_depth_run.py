"""`improvo run --dense` as a user meets it."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rendered_walk import write_walk

import improvo
from improvo.cli.main import main
from improvo.depth.archive import DepthReader
from improvo.depth.dense import refuse_live, write_dense
from improvo.depth.settings import DepthSettings
from improvo.errors import InputError
from improvo.geometry import se3
from improvo.odometry.run.run_folder import RunFolder
from improvo.odometry.run.run_json import metres_per_unit
from improvo.sequences import Sequence, open_sequence
from improvo.types import Features, Mask, UInt8

FRAMES = 30
QUICK = ("--frontend", "orb", "--max-keypoints", "500")


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of a textured room."""
    return write_walk(tmp_path_factory.mktemp("walk") / "images", frames=FRAMES)


@pytest.fixture(scope="module")
def dense(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output of a run with depth."""
    out = tmp_path_factory.mktemp("run") / "out"
    assert main(["run", str(walk), "-o", str(out), *QUICK, "--dense"]) == 0
    return out


def test_a_run_leaves_maps_cloud_and_figures(dense: Path) -> None:
    entry = json.loads((dense / "run.json").read_text())["depth"]
    reader = DepthReader(dense)
    assert reader.frames == list(range(FRAMES))
    maps = [reader.depth(frame) for frame in reader.frames]
    assert maps[0].shape == (120, 160)
    assert entry["frames"] == FRAMES
    assert entry["pixels"] == sum(depth.size for depth in maps)
    assert entry["pixels_with_depth"] == sum(int((depth > 0).sum()) for depth in maps)
    assert entry["share"] > 0.4
    assert f"element vertex {entry['points']}".encode() in (dense / "dense.ply").read_bytes()[:500]
    assert entry["points"] > 5000
    assert not entry["interrupted"]


def test_depth_has_the_unit_of_the_run(dense: Path) -> None:
    """Dense depth where the map's points fall is the points' own depth."""
    run, reader = RunFolder(dense), DepthReader(dense)
    exact = (run.points.parallax_deg > 3) & (run.points.mean_error < 1)
    xyz = {int(track): point for track, point in zip(run.points.track[exact], run.points.xyz[exact], strict=True)}
    nowhere = np.full(3, np.nan)
    ratios = []
    for frame in range(5, 25, 5):
        seen = run.observations(frame)
        points = np.array([xyz.get(int(track), nowhere) for track in seen.track])
        z = se3.transform(se3.inverse(run.trajectory.world_from_cam[frame]), points)[:, 2]
        column, row = np.clip(np.rint((seen.keypoints - 0.5) / 2).astype(int), 0, (159, 119)).T
        depth = reader.depth(frame)[row, column]
        both = (depth > 0) & np.isfinite(z) & (z > 0)
        ratios.append(depth[both] / z[both])
    ratio = np.concatenate(ratios)
    assert len(ratio) > 200
    assert abs(np.median(ratio) - 1) < 0.01
    assert (np.abs(ratio - 1) > 0.05).mean() < 0.1


def test_without_the_flag_there_is_no_depth(walk: Path, tmp_path: Path) -> None:
    assert main(["run", str(walk), "-o", str(tmp_path / "out"), *QUICK, "--max-frames", "8"]) == 3
    assert not (tmp_path / "out" / "depth.zip").exists()
    assert "depth" not in json.loads((tmp_path / "out" / "run.json").read_text())


def test_the_setting_does_what_the_flag_does_and_twice_the_same(walk: Path, dense: Path, tmp_path: Path) -> None:
    assert main(["run", str(walk), "-o", str(tmp_path / "out"), *QUICK, "--set", "dense=true"]) == 0
    for name in ("depth.zip", "dense.ply"):
        assert (tmp_path / "out" / name).read_bytes() == (dense / name).read_bytes(), name


class Summary:
    """As much of a finished run as `write_dense` reads."""

    def __init__(self, folder: Path) -> None:
        run = RunFolder(folder)
        self.folder, self.trajectory, self.report = folder, run.trajectory, run.report
        self.unit = "up to scale"


def copied(run: Path, to: Path) -> Path:
    """A copy of the files of a run."""
    to.mkdir()
    for path in run.iterdir():
        (to / path.name).write_bytes(path.read_bytes())
    return to


@pytest.mark.parametrize("factor", [0.2, 22.0])
def test_a_run_in_metres_has_the_same_depth_and_cloud_in_metres(
    factor: float, walk: Path, dense: Path, tmp_path: Path
) -> None:
    """As after --scale: poses and points are `factor` times as long."""
    summary = Summary(copied(dense, tmp_path / "out"))
    poses = np.array(summary.trajectory.world_from_cam)
    poses[:, :3, 3] *= factor
    summary.trajectory = replace(summary.trajectory, world_from_cam=poses)
    table = pq.read_table(dense / "points.parquet")
    for axis in "xyz":
        column = table.schema.get_field_index(axis)
        table = table.set_column(column, axis, pa.array(factor * table[axis].to_numpy()))
    pq.write_table(table, summary.folder / "points.parquet")
    summary.unit = "metres, from a known distance"
    summary.report["metric"] = {"segments": [{"segment": 0, "metres_per_unit": factor}]}
    entry = write_dense(open_sequence(walk), summary, DepthSettings())  # type: ignore[arg-type]
    before = json.loads((dense / "run.json").read_text())["depth"]
    assert entry["points"] == pytest.approx(before["points"], rel=0.05)
    assert entry["share"] == pytest.approx(before["share"], abs=0.01)
    ours, theirs = DepthReader(summary.folder).depth(9), DepthReader(dense).depth(9)
    both = (ours > 0) & (theirs > 0)
    assert np.median(ours[both] / theirs[both]) == pytest.approx(factor, rel=1e-3)
    with zipfile.ZipFile(summary.folder / "depth.zip") as file:
        assert json.loads(file.read("depth.json"))["unit"] == summary.unit


def test_the_unit_of_each_segment_is_that_of_the_one_before_where_it_is_not_known() -> None:
    known = [{"segment": 1, "metres_per_unit": 2.0}, {"segment": 3, "metres_per_unit": 5.0}]
    report = {"metric": {"segments": known}}
    assert [metres_per_unit(report, segment) for segment in range(5)] == [2.0, 2.0, 2.0, 5.0, 5.0]
    assert metres_per_unit({}, 0) == 1.0


def test_an_interrupt_leaves_a_valid_part(walk: Path, dense: Path, tmp_path: Path) -> None:
    summary = Summary(copied(dense, tmp_path / "out"))
    done = []

    def interrupt() -> None:
        done.append(None)
        if len(done) == 7:
            raise KeyboardInterrupt

    entry = write_dense(open_sequence(walk), summary, DepthSettings(), interrupt)  # type: ignore[arg-type]
    assert entry["interrupted"]
    assert entry["frames"] == 7
    assert DepthReader(tmp_path / "out").frames == list(range(7))
    assert json.loads((tmp_path / "out" / "run.json").read_text())["depth"]["frames"] == 7


def test_a_run_of_python_that_is_interrupted_goes_on_to_no_depth(walk: Path, tmp_path: Path) -> None:
    orb = improvo.load_frontend("orb", 500)

    class Interrupted:
        name, frames = "orb", 0

        def __call__(self, image: UInt8, mask: Mask | None = None) -> Features:
            self.frames += 1
            if self.frames == 20:
                raise KeyboardInterrupt
            return orb(image, mask)

    run = improvo.run(walk, tmp_path / "out", improvo.DenseRunSettings(dense=True), Interrupted())
    assert run.report["interrupted"]
    assert 3 < run.tracked < 20
    assert not (tmp_path / "out" / "depth.zip").exists()


def test_frames_that_nothing_is_known_of_are_empty(walk: Path, dense: Path, tmp_path: Path) -> None:
    """A plain grey recording with the poses of another: no depth, no point, valid files."""
    grey = tmp_path / "grey"
    grey.mkdir()
    for path in walk.iterdir():
        if path.suffix == ".png":
            cv2.imwrite(str(grey / path.name), np.full((240, 320), 128, np.uint8))
        else:
            (grey / path.name).write_bytes(path.read_bytes())
    entry = write_dense(open_sequence(grey), Summary(copied(dense, tmp_path / "out")), DepthSettings())  # type: ignore[arg-type]
    assert entry["frames"] == FRAMES
    assert entry["pixels_with_depth"] == 0
    assert entry["points"] == 0


def test_a_live_source_is_refused_before_any_work() -> None:
    class Live(Sequence):
        path, length = Path("0"), None

        def __init__(self) -> None: ...

    with pytest.raises(InputError, match="is live"):
        refuse_live(Live())
