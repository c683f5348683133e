"""Other tools open what is exported, and see the same geometry."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from improvo.cli.main import main
from improvo.export.model import segment_model
from improvo.export.trajectory import export_trajectory
from improvo.geometry.camera import Camera
from improvo.odometry.run.map_file import read_map, write_map
from improvo.odometry.run.run_folder import RunFolder
from improvo.odometry.view import View
from improvo.report import rerun_viewer
from improvo.sequences import open_sequence, read_trajectory
from improvo.stability.tables import read_tracks
from improvo.types import Frame, SparseMap, Trajectory


def test_map_is_read_back_as_it_was_written(finished_run: Path) -> None:
    run = RunFolder(finished_run)
    assert len(run.map) == run.report["points"] > 100
    assert (run.map.observations >= 2).all()
    assert np.isfinite(run.map.mean_error).all()
    depth = run.map.xyz[:, 2]
    assert 0.3 < np.median(depth) < 5, "the map is scaled to an initial median depth of 1"


def a_map(ids: list[int]) -> SparseMap:
    """One point for each id, whose colour tells its id."""
    count = len(ids)
    shades = np.repeat(np.array(ids, np.uint8)[:, None], 3, axis=1)
    ones, zeros = np.ones(count), np.zeros(count, np.int64)
    return SparseMap(np.array(ids, np.int64), np.ones((count, 3)), zeros + 2, ones, ones, zeros, shades)


def test_a_map_keeps_the_ids_of_its_points(tmp_path: Path) -> None:
    """Points that no final frame sees are left out, so the rows are not the ids."""
    write_map(tmp_path / "map.ply", a_map([2, 3, 7]))
    read = read_map(tmp_path / "map.ply")
    np.testing.assert_array_equal(read.ids, [2, 3, 7])
    np.testing.assert_array_equal(read.rows_of(np.array([7, 0, 3, -1, 8, 2])), [2, -1, 1, -1, -1, 0])
    np.testing.assert_array_equal(a_map([7, 2, 3]).rows_of(np.array([2, 3, 7, 4])), [1, 2, 0, -1])
    np.testing.assert_array_equal(a_map([]).rows_of(np.array([0, -1])), [-1, -1])


@pytest.mark.parametrize("with_ids", [True, False])
def test_exported_points_have_the_colours_of_their_own_map_points(
    with_ids: bool, finished_run: Path, tmp_path: Path
) -> None:
    """Whichever points the map holds. One from before ids were written leaves all of them grey."""
    folder = tmp_path / "run"
    shutil.copytree(finished_run, folder)
    points = RunFolder(folder).points
    kept = [int(point) for point in np.unique(points.point) if 0 <= point < 256 and point % 3 != 1]
    write_map(folder / "map.ply", a_map(kept))
    if not with_ids:
        content = (folder / "map.ply").read_bytes()
        (folder / "map.ply").write_bytes(content.replace(b"property int id\n", b"property int other\n"))
    rgb = segment_model(RunFolder(folder), 0, max_error=np.inf, min_observations=0).rgb
    usable = (points.segment == 0) & np.isfinite(points.xyz).all(axis=1)
    owner = points.point[usable]
    expected = np.where(np.isin(owner, kept if with_ids else []), owner, 128)
    np.testing.assert_array_equal(rgb, np.repeat(expected[:, None], 3, axis=1))
    assert (expected != 128).any() == with_ids


def test_a_damaged_map_is_named(finished_run: Path, tmp_path: Path) -> None:
    from improvo.errors import InputError

    content = (finished_run / "map.ply").read_bytes()
    for number, damaged in enumerate((b"", b"ply\n", content[:-7], content.replace(b"mean_error", b"other_name"))):
        path = tmp_path / f"{number}.ply"
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=rf"{number}\.ply"):
            read_map(path)


def test_model_errors_are_those_of_the_table(finished_run: Path) -> None:
    run = RunFolder(finished_run)
    model = segment_model(run, 0, max_error=np.inf, min_observations=2)
    assert len(model.error) > 1000
    known = np.isfinite(run.tracks.error)
    lengths = np.bincount(run.tracks.track[known], minlength=run.tracks.track.max() + 1)
    kept = known & (lengths[run.tracks.track] >= 2)
    assert len(model.error) <= kept.sum()
    table = np.sort(run.tracks.error[kept])
    # every observation in front of its camera is there, with the error that the run wrote
    np.testing.assert_allclose(np.sort(model.error)[:1000], table[:1000], rtol=1e-4, atol=1e-5)


def test_pycolmap_opens_the_model_and_agrees_on_the_errors(finished_run: Path, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'improvo[dev]'")
    assert main(["export", "colmap", str(finished_run), "-o", str(tmp_path / "colmap")]) == 0
    run = RunFolder(finished_run)
    model = segment_model(run, 0)
    opened = pycolmap.Reconstruction(str(tmp_path / "colmap" / "sparse" / "0"))
    assert opened.num_images() == 30 == len(list((tmp_path / "colmap" / "images").iterdir()))
    assert opened.num_points3D() == len(model.xyz) > 100
    assert opened.compute_num_observations() == len(model.error)
    assert opened.compute_mean_reprojection_error() == pytest.approx(model.mean_error, abs=1e-9)
    opened.update_point_3d_errors()  # its own projection of our points into our poses
    assert opened.compute_mean_reprojection_error() == pytest.approx(model.mean_error, abs=1e-6)


def test_nerfstudio_scene_is_read_back_with_the_same_camera_and_poses(finished_run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    assert main(["export", "nerfstudio", str(finished_run), "-o", str(folder)]) == 0
    run = RunFolder(finished_run)
    sequence = open_sequence(folder, format="nerfstudio")
    np.testing.assert_allclose(sequence.camera.K, run.camera.K, atol=1e-9)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.world_from_cam, run.trajectory.world_from_cam, atol=1e-9)
    np.testing.assert_array_equal(sequence[7].image, run.image(7))
    header = (folder / "sparse_pc.ply").read_bytes().split(b"end_header")[0].decode()
    assert "property uchar red" in header


def test_points_have_the_colours_of_the_map_also_without_images(finished_run: Path, tmp_path: Path) -> None:
    assert main(["export", "colmap", str(finished_run), "-o", str(tmp_path / "scene"), "--no-images", "--quiet"]) == 0
    lines = (tmp_path / "scene" / "sparse" / "0" / "points3D.txt").read_text().splitlines()[1:]
    shades = np.array([[int(word) for word in line.split()[4:7]] for line in lines])
    run = RunFolder(finished_run)
    model = segment_model(run, 0)
    assert run.map.rgb is not None
    np.testing.assert_array_equal(shades, model.rgb)
    known = (model.rgb != 128).any(axis=1)
    assert known.mean() > 0.5
    of_map = {tuple(row) for row in run.map.rgb.tolist()}
    assert all(tuple(row) in of_map for row in model.rgb[known].tolist())


def test_figures_of_a_colmap_model_as_json(
    finished_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = tmp_path / "scene"
    assert main(["export", "colmap", str(finished_run), "-o", str(scene), "--no-images", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    model = segment_model(RunFolder(finished_run), 0)
    assert shown["models"][0] == {
        "folder": str(scene / "sparse" / "0"),
        "images": len(model.frames),
        "points": len(model.xyz),
        "observations": len(model.error),
        "mean_error": pytest.approx(model.mean_error, abs=1e-6),
    }
    assert shown["map_points"] == len(RunFolder(finished_run).map)


def test_images_of_an_export_are_the_frames(finished_run: Path, tmp_path: Path) -> None:
    assert main(["export", "colmap", str(finished_run), "-o", str(tmp_path / "c")]) == 0
    picture = cv2.imread(str(tmp_path / "c" / "images" / "frame_000004.png"), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(picture, RunFolder(finished_run).image(4))


@pytest.mark.parametrize("format", ["tum", "kitti", "euroc"])
def test_trajectory_files_are_read_back(finished_run: Path, tmp_path: Path, format: str) -> None:
    path = tmp_path / {"tum": "t.txt", "kitti": "k.txt", "euroc": "data.csv"}[format]
    assert main(["export", "trajectory", str(finished_run), "-o", str(path), "--format", format]) == 0
    ours, read = RunFolder(finished_run).trajectory, read_trajectory(path)  # the format is told by its content
    np.testing.assert_allclose(read.world_from_cam, ours.world_from_cam, atol=1e-8)
    if format != "kitti":
        np.testing.assert_allclose(read.times, ours.times, atol=1e-8)


def test_an_exported_trajectory_says_its_unit_and_that_segments_have_no_marks(
    finished_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(finished_run, run)
    report = json.loads((run / "run.json").read_text())
    known = {"scale": "metres, from depth images", "metric": {"segments": []}}
    (run / "run.json").write_text(json.dumps({**report, **known}))
    assert main(["export", "trajectory", str(run), "-o", str(tmp_path / "t.txt")]) == 0
    assert (tmp_path / "t.txt").read_text().startswith("# camera-to-world, metres, from depth images: timestamp")
    whole = RunFolder(run).trajectory
    broken = replace(whole, segment=np.where(np.arange(len(whole)) < 3, 0, 1))
    monkeypatch.setattr(RunFolder, "trajectory", broken)
    capsys.readouterr()
    for format, noted in (("kitti", True), ("euroc", True), ("tum", False)):
        command = ["export", "trajectory", str(run), "-o", str(tmp_path / f"{format}.txt"), "--format", format]
        assert main(command) == 0
        assert ("note: 2 segments" in capsys.readouterr().out) == noted


def test_the_trajectory_of_a_run_is_not_replaced_by_its_export(
    finished_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Path(shutil.copytree(finished_run, tmp_path / "run"))
    before = (run / "trajectory.txt").read_bytes()
    for words in (["-o", str(run / "trajectory.txt"), "--format", "kitti"], ["-o", str(run)]):
        assert main(["export", "trajectory", str(run), *words]) == 2
        assert "trajectory.txt: is the run's own" in capsys.readouterr().err
    assert (run / "trajectory.txt").read_bytes() == before
    assert main(["export", "trajectory", str(run), "-o", str(run / "poses.txt"), "--format", "kitti"]) == 0


def test_kitti_refuses_a_trajectory_with_gaps(tmp_path: Path) -> None:
    from improvo.errors import InputError

    gappy = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    with pytest.raises(InputError, match="2 have no pose; use tum or euroc"):
        export_trajectory(gappy, 5, tmp_path / "k.txt", "kitti")
    assert not (tmp_path / "k.txt").exists()


def verified(path: Path) -> str:
    """The statistics of Rerun's own tool, which must find no error."""
    run = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "verify", str(path)], capture_output=True, text=True, timeout=120
    )
    assert run.returncode == 0, run.stderr
    statistics = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "stats", str(path)], capture_output=True, text=True, timeout=120
    )
    return statistics.stdout


def test_finished_run_is_recorded_for_rerun_without_a_screen(finished_run: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs Rerun: pip install 'improvo[view]'")
    assert main(["show", "live", str(finished_run), "--save", str(tmp_path / "run.rrd")]) == 0
    text = verified(tmp_path / "run.rrd")
    for entity in ("/world/camera/image", "/world/labels", "/world/points", "/world/trajectory", "/plots/tracks"):
        assert entity in text


def test_run_is_recorded_while_it_goes_on(finished_run: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs Rerun: pip install 'improvo[view]'")
    walk, recording = finished_run.parent / "walk", tmp_path / "live.rrd"
    words = ["run", str(walk), "-o", str(tmp_path / "out"), "--frontend", "orb", "--max-frames", "20"]
    assert main([*words, "--save", str(recording)]) == 0
    text = verified(recording)
    rows = re.search(r"num_rows = (\d+)", text)
    assert rows is not None
    assert int(rows[1]) >= 20 * 5, "picture, keypoints and three curves for every frame"
    assert "/world/camera/image/keypoints" in text
    assert "/world/observed" in text
    assert "/world/trajectory" in text


def test_viewer_without_rerun_names_the_extra(
    finished_run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["show", "live", str(finished_run)]) == 2
    assert "pip install 'improvo[view]'" in capsys.readouterr().err


def in_two_segments(finished: Path, folder: Path) -> Path:
    """A copy of a run whose second half claims to be another segment."""
    shutil.copytree(finished, folder)
    lines = (folder / "trajectory.txt").read_text().splitlines(keepends=True)
    lines.insert(2 + 18, "# segment 1: has its own world frame and scale\n")
    (folder / "trajectory.txt").write_text("".join(lines))
    report = json.loads((folder / "run.json").read_text())
    report["segments"].append({**report["segments"][0], "number": 1, "first": 18})
    (folder / "run.json").write_text(json.dumps(report))
    points = pq.read_table(folder / "points.parquet")
    tracks = read_tracks(folder / "tracks.parquet")
    later = set(tracks.track[tracks.frame >= 18].tolist()) - set(tracks.track[tracks.frame < 18].tolist())
    segment = [int(track in later) for track in points["track"].to_pylist()]
    column = points.schema.get_field_index("segment")
    points = points.set_column(column, points.schema.field(column), pa.array(segment, pa.int32()))
    pq.write_table(points, folder / "points.parquet")
    return folder


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--min-observations", "0"], "--min-observations 0: must be at least 1"),
        (["--max-error", "nan"], "--max-error nan: must be positive"),
        (["--max-error", "-1"], "--max-error -1: must be positive"),
    ],
)
def test_an_export_of_nothing_is_refused(
    finished_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    for target in ("colmap", "nerfstudio"):
        assert main(["export", target, str(finished_run), "-o", str(tmp_path / "new"), *words]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_segments_are_models_of_their_own_the_longest_first(
    finished_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = in_two_segments(finished_run, tmp_path / "run")
    assert main(["export", "colmap", str(run), "-o", str(tmp_path / "c"), "--no-images"]) == 0
    images = [(tmp_path / "c" / "sparse" / name / "images.txt").read_text() for name in ("0", "1")]
    assert [text.count(".png") for text in images] == [18, 12]
    assert "frame_000017.png" in images[0]
    assert "frame_000018.png" in images[1]
    assert not (tmp_path / "c" / "images").exists()
    assert main(["export", "colmap", str(finished_run), "-o", str(tmp_path / "c"), "--no-images"]) == 0
    assert [path.name for path in (tmp_path / "c" / "sparse").iterdir()] == ["0"]  # nothing of the first export
    capsys.readouterr()
    assert main(["export", "nerfstudio", str(run), "-o", str(tmp_path / "n")]) == 0
    assert "only the longest of 2 segments: 12 frames" in capsys.readouterr().out
    assert main(["show", "map", str(run)]) == 0
    assert main(["report", str(run)]) == 0
    assert "2 segments (new ones start at frames 18)" in (run / "report.html").read_text()


def test_no_line_leads_from_one_segment_to_the_next(
    finished_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rerun", reason="needs Rerun: pip install 'improvo[view]'")
    run, drawn = RunFolder(in_two_segments(finished_run, tmp_path / "run")), []
    monkeypatch.setattr(rerun_viewer._Recording, "links", lambda self, centres, *others: drawn.append(centres))
    rerun_viewer.show_run(run, tmp_path / "run.rrd", images=False)
    assert [len(centres) for centres in drawn] == [18, 12]
    assert (np.concatenate(drawn) == run.trajectory.camera_centers).all()


@pytest.mark.parametrize("kept", [[5, 9, 20], [0, 29], [12], []])
def test_frames_without_a_pose_have_their_own_times(finished_run: Path, tmp_path: Path, kept: list[int]) -> None:
    """Seconds of the recording, also where it is not there any more, and never numbers of frames among them."""
    folder = Path(shutil.copytree(finished_run, tmp_path / "run"))
    lines = (folder / "trajectory.txt").read_text().splitlines(keepends=True)
    poses = [line for line in lines if not line.startswith("#")]
    (folder / "trajectory.txt").write_text("".join(poses[number] for number in kept))
    report = json.loads((folder / "run.json").read_text())
    report["frames"].update(tracked=len(kept), lost_frames=[number for number in range(30) if number not in kept])
    (folder / "run.json").write_text(json.dumps(report))
    run = RunFolder(folder)
    times = rerun_viewer._times(run)
    if len(kept) > 1:
        np.testing.assert_allclose(times, run.sequence.times, atol=1e-6)
    assert (np.diff(times) >= 0).all()


def test_a_live_recording_grows_with_its_frames_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rerun", reason="needs Rerun: pip install 'improvo[view]'")
    sent: Counter[str] = Counter()

    def links(self: object, centres: np.ndarray, colours: np.ndarray, path: str, static: bool = False) -> None:
        assert len(colours) == max(len(centres) - 1, 0)
        sent["links"] += len(colours)
        ends[path] = centres[-1, 0]

    def points(self: object, xyz: np.ndarray, colours: np.ndarray, path: str = "world/points") -> None:
        sent[path] += len(xyz)
        sent["last"] = len(xyz)

    ends: dict[str, float] = {}
    monkeypatch.setattr(rerun_viewer._Recording, "links", links)
    monkeypatch.setattr(rerun_viewer._Recording, "points", points)
    viewer = rerun_viewer.RerunViewer(tmp_path / "live.rrd")
    viewer.begin(Camera(32, 24, 30.0, 30.0, 15.5, 11.5))
    none = np.zeros(0, np.int64)
    for number in range(1000):
        pose = np.eye(4)
        pose[0, 3] = -number
        nothing = np.zeros((0, 2)), np.zeros((0, 8), np.float32), np.zeros(0), none, none
        view = View(number, number / 30, *nothing, cam_from_world=pose)
        viewer.show(Frame(number, number / 30, np.zeros((24, 32), np.uint8), ""), view, np.zeros((5 * number, 3)))
    viewer.end()
    assert sent["links"] <= 1000 * 100
    assert sent["world/points"] <= 12 * 5 * 1000
    assert sent["last"] == 5 * 999, "the whole map at the end"
    assert [ends[f"world/trajectory/{piece}"] for piece in range(10)] == [*range(100, 1000, 100), 999.0]


def test_an_export_does_not_touch_a_folder_of_others(
    finished_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    assert main(["export", "colmap", str(finished_run), "-o", str(tmp_path)]) == 2
    assert "choose an empty or new output folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
