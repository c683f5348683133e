"""Runs in metres: each source against the true size of a rendered room, in every output; contradictions."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import cv2
import numpy as np
import pytest
import rendered_walk
from rendered_walk import _TEXTURE, CAMERA, _texture, render_with_depth
from simulated_features import hand_motion

from improvo.cli.main import main
from improvo.errors import ConfigError, InputError, OutputError
from improvo.geometry import se3
from improvo.geometry.alignment import align_points
from improvo.geometry.trajectory_files import read_trajectory, write_trajectory
from improvo.odometry.run.map_file import read_map
from improvo.odometry.run.run_folder import RunFolder
from improvo.odometry.run.run_odometry import RunSummary
from improvo.odometry.scale.apply import apply_scale, scaled_trajectory, segment_maps
from improvo.odometry.scale.estimate import ScaleEstimate, from_measurements
from improvo.odometry.scale.from_distance import scale_from_distance
from improvo.odometry.scale.from_height import ground_plane
from improvo.odometry.scale.settings import ScaleSettings, scale_settings
from improvo.odometry.scale.sources import scale_source
from improvo.odometry.scale.tracked import TrackedRun
from improvo.sequences import Sequence, open_sequence
from improvo.simulation.tum_writer import TumRgbdWriter
from improvo.stability.tables import POINTS_FILE, read_points
from improvo.types import Float64, Trajectory, UInt8

FRAMES = 36
MARKER = 0.8  # metres
SIZE = 1.7  # the room is this much larger than `rendered_walk` has it, so that nothing is right by chance
WALLS = (  # corner and edges of each: back, floor, right, left, a small panel with the marker
    ((-4.0, -2.0, 4.5), (8.0, 0.0, 0.0), (0.0, 3.0, 0.0)),
    ((-4.0, 0.9, 4.5), (8.0, 0.0, 0.0), (0.0, 0.0, -6.0)),
    ((4.0, -2.0, 4.5), (0.0, 0.0, -6.0), (0.0, 3.0, 0.0)),
    ((-4.0, -2.0, -1.5), (0.0, 0.0, 6.0), (0.0, 3.0, 0.0)),
    ((-0.9, -0.1, 2.0), (0.9, 0.0, 0.2), (0.0, 0.8, 0.0)),
)


def with_marker(texture: UInt8) -> UInt8:
    """The small panel in front, with a marker of the dictionary 5X5 on it."""
    _, along, down = WALLS[4]
    sides = [round(MARKER / SIZE / float(np.linalg.norm(edge)) * (_TEXTURE - 1)) for edge in (along, down)]
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    marker = cv2.resize(cv2.aruco.generateImageMarker(dictionary, 7, 350), sides, interpolation=cv2.INTER_AREA)
    result, (left, top) = texture.copy(), (120, 90)
    result[top - 25 : top + sides[1] + 25, left - 25 : left + sides[0] + 25] = 255
    result[top : top + sides[1], left : left + sides[0]] = marker
    return result


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with depth and true poses, in metres, with a marker in view."""
    folder = tmp_path_factory.mktemp("room") / "room"
    rng = np.random.default_rng(0)
    textures = [_texture(rng) for _ in WALLS]
    textures[4] = with_marker(textures[4])
    own, rendered_walk._WALLS = rendered_walk._WALLS, WALLS
    with TumRgbdWriter(folder, CAMERA, fps=30.0, depth_scale=1000.0) as writer:
        for number, pose in enumerate(hand_motion(FRAMES, step=0.025)):
            image, depth = render_with_depth(se3.inverse(pose), textures)
            metric = pose.copy()
            metric[:3, 3] *= SIZE
            measured = np.where(np.isfinite(depth), SIZE * depth, np.nan).astype(np.float32)
            writer.add(number / 30, image, measured, metric)
    rendered_walk._WALLS = own
    return folder


@pytest.fixture(scope="module")
def up_to_scale(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of a run without a scale; not to be written to."""
    out = tmp_path_factory.mktemp("run") / "out"
    assert main(["run", str(room), "-o", str(out), "--frontend", "sift", "--max-keypoints", "800", "--quiet"]) == 0
    return out


@pytest.fixture
def finished(up_to_scale: Path, tmp_path: Path) -> tuple[Sequence, RunSummary]:
    folder = tmp_path / "out"
    shutil.copytree(up_to_scale, folder)
    run = RunFolder(folder)
    assert run.frames == len(run.trajectory)
    return run.sequence, RunSummary(folder, run.trajectory, run.report)


def error_of_size(trajectory: Trajectory, truth: Trajectory | None) -> float:
    """How much too large a trajectory is, as a share."""
    assert truth is not None
    return 1 / align_points(truth.camera_centers, trajectory.camera_centers, with_scale=True).scale - 1


def distance_between(sequence: Sequence, a: int, b: int) -> float:
    truth = sequence.ground_truth
    assert truth is not None
    return float(np.linalg.norm(truth.camera_centers[a] - truth.camera_centers[b]))


def heights(sequence: Sequence) -> Float64:
    truth = sequence.ground_truth
    assert truth is not None
    return WALLS[1][0][1] * SIZE - truth.camera_centers[:, 1]


SOURCES: dict[str, tuple[Callable[[Sequence], ScaleSettings], float]] = {
    "depth": (lambda sequence: ScaleSettings("depth"), 0.03),
    "truth": (lambda sequence: ScaleSettings("truth"), 1e-6),
    "distance": (
        lambda sequence: ScaleSettings("distance", distances=((3, 33, distance_between(sequence, 3, 33)),)),
        0.03,
    ),
    "height": (lambda sequence: ScaleSettings("height", float(np.median(heights(sequence)))), 0.06),
    "marker": (lambda sequence: ScaleSettings("marker", MARKER), 0.03),
}


@pytest.mark.parametrize("source", SOURCES)
def test_every_source_gives_the_true_size_in_every_output(source: str, finished: tuple[Sequence, RunSummary]) -> None:
    sequence, run = finished
    make, tolerance = SOURCES[source]
    settings = make(sequence)
    ask = scale_source(sequence, settings)
    assert ask is not None
    points_before, map_before = read_points(run.folder / POINTS_FILE), read_map(run.folder / "map.ply")
    scaled = apply_scale(sequence, run, ask, settings)
    assert abs(error_of_size(run.trajectory, sequence.ground_truth)) > 0.1
    assert abs(error_of_size(scaled.trajectory, sequence.ground_truth)) < tolerance
    entry = scaled.report["metric"]["segments"][0]
    factor = entry["metres_per_unit"]
    written = read_trajectory(run.folder / "trajectory.txt")
    np.testing.assert_allclose(written.world_from_cam, scaled.trajectory.world_from_cam, atol=1e-9)
    np.testing.assert_allclose(read_map(run.folder / "map.ply").xyz, factor * map_before.xyz, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(read_points(run.folder / POINTS_FILE).xyz, factor * points_before.xyz)
    assert "camera-to-world, metres" in (run.folder / "trajectory.txt").read_text().splitlines()[0]
    assert b"map, metres" in (run.folder / "map.ply").read_bytes()[:200]
    assert RunFolder(run.folder).unit.startswith("metres")
    assert scaled.unit == RunFolder(run.folder).unit
    assert entry["relative_error"] is None or 0 <= entry["relative_error"] < 0.05


def test_the_command_writes_metres_everywhere(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    given = ["run", str(room), "-o", str(out), "--frontend", "sift", "--max-keypoints", "800", "--max-frames", "24"]
    assert main([*given, "--scale", "marker", str(MARKER), "--dense", "--report"]) == 0
    text = capsys.readouterr().out
    assert "unit: metres, from markers of known size" in text
    truth = open_sequence(room, max_frames=24).ground_truth
    assert abs(error_of_size(read_trajectory(out / "trajectory.txt"), truth)) < 0.05
    report = json.loads((out / "run.json").read_text())
    assert report["configuration"]["scale"]["metres"] == MARKER
    assert b"dense points, metres" in (out / "dense.ply").read_bytes()[:200]
    page = (out / "report.html").read_text()
    assert "map are metres" in page
    assert "path of the camera" in page
    assert main(["export", "colmap", str(out), "-o", str(tmp_path / "colmap")]) == 0


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["depths"], "give depth | truth"),
        (["distance", "3", "9"], "give depth | truth"),
        (["distance", "3", "9", "far"], "not numbers"),
        (["distance", "3", "3", "1"], "improvo: --scale distance: frames 3 and 3 are no two places"),
        (["distance", "3", "99", "1"], "frame 99 is not among those that are read"),
        (["height", "-1.5"], "is no length"),
        (["height", "0"], "is no length"),
        (["truth", "nothing.txt"], "nothing.txt"),
    ],
)
def test_bad_words_are_one_line_before_any_work(
    room: Path, tmp_path: Path, words: list[str], what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(room), "-o", str(tmp_path / "out"), "--scale", *words]) == 2
    error = capsys.readouterr().err.strip()
    assert what in error
    assert "\n" not in error
    assert not (tmp_path / "out").exists()


def test_a_source_that_is_not_there_is_said_before_any_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from rendered_walk import write_walk

    walk = write_walk(tmp_path / "walk", frames=5)
    for words, what in (
        (["depth"], "has no depth images"),
        (["truth"], "has no true poses"),
        (["marker", "0.16"], "no marker was seen in at least 3 of 5 frames"),
    ):
        assert main(["run", str(walk), "-o", str(tmp_path / "out"), "--scale", *words, "--quiet"]) == 2
        assert what in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_contradictions_leave_the_run_as_it_is(
    finished: tuple[Sequence, RunSummary], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence, run = finished
    before = {file.name: file.read_bytes() for file in run.folder.iterdir() if file.is_file()}
    truth = sequence.ground_truth
    assert truth is not None
    rng = np.random.default_rng(0)
    other = np.array(truth.world_from_cam)
    other[:, :3, 3] = rng.normal(size=(len(other), 3))
    write_trajectory(tmp_path / "other.txt", replace(truth, world_from_cam=other))
    depth = type(sequence).depth

    def wrong(self: Sequence, i: int) -> object:
        found = depth(self, i)
        return None if found is None else found * (1 + 2 * (i % 3))

    monkeypatch.setattr(type(sequence), "depth", wrong)
    for settings, what in (
        (ScaleSettings("depth"), "contradicts itself.*holds the run, up to scale"),
        (ScaleSettings("truth", reference=str(tmp_path / "other.txt")), "does not fit the run.*holds the run, up to"),
    ):
        ask = scale_source(sequence, settings)
        assert ask is not None
        with pytest.raises(InputError, match=what):
            apply_scale(sequence, run, ask, settings)
    assert before == {file.name: file.read_bytes() for file in run.folder.iterdir() if file.is_file()}


def test_what_is_stopped_between_two_units_is_no_result(
    finished: tuple[Sequence, RunSummary], monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence, run = finished
    ask = scale_source(sequence, ScaleSettings("truth"))
    assert ask is not None

    def full(*_: object, **__: object) -> None:
        raise OutputError("the disk is full")

    monkeypatch.setattr("improvo.odometry.scale.apply.write_trajectory", full)
    with pytest.raises(OutputError):
        apply_scale(sequence, run, ask, ScaleSettings("truth"))
    with pytest.raises(InputError, match=r"has no run\.json"):  # the map is in metres, the trajectory is not
        RunFolder(run.folder)


def test_several_distances_are_averaged_and_contradictions_are_named(finished: tuple[Sequence, RunSummary]) -> None:
    sequence, run = finished
    tracked = TrackedRun(sequence, run)
    pairs = ((3, 33), (0, 20), (15, 35))
    true = [(a, b, distance_between(sequence, a, b)) for a, b in pairs]
    several = scale_from_distance(tracked, ScaleSettings("distance", distances=tuple(true)))[0]
    single = [scale_from_distance(tracked, ScaleSettings("distance", distances=(each,)))[0] for each in true]
    factors = [each.metres_per_unit for each in single]
    assert min(factors) <= several.metres_per_unit <= max(factors)
    assert several.measurements == 3
    assert several.relative_error is not None
    assert several.relative_error < 0.02
    wrong = (*true[:2], (15, 35, 1.5 * true[2][2]))
    with pytest.raises(InputError, match=r"frames \d+ and \d+ give .* m a unit, frames 15 and 35 give .* % apart"):
        scale_from_distance(tracked, ScaleSettings("distance", distances=wrong))
    far_off = (true[0], (15, 35, 30 * true[2][2]))
    with pytest.raises(InputError, match=r"frames 15 and 35 give .*, a factor of [23]\d\S* apart; measure again"):
        scale_from_distance(tracked, ScaleSettings("distance", distances=far_off))


def write_gps(path: Path, sequence: Sequence, every: int, began: float) -> None:
    """Places on the Earth of every so many frames' true poses, as GPX with dates."""
    truth = sequence.ground_truth
    assert truth is not None
    east, up, north = (truth.camera_centers * (1, -1, 1)).T
    rows = []
    for row in range(0, len(truth), every):
        when = datetime.fromtimestamp(began + float(sequence.times[row]), timezone.utc).isoformat()
        latitude, longitude = north[row] / 111132.0, east[row] / 111319.5  # near the equator a degree is about as long
        rows.append(
            f'<trkpt lat="{latitude:.10f}" lon="{longitude:.10f}"><ele>{up[row]}</ele><time>{when}</time></trkpt>'
        )
    path.write_text(f'<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1">{"".join(rows)}</gpx>')


def test_a_gps_track_on_its_own_clock_gives_the_size(finished: tuple[Sequence, RunSummary], tmp_path: Path) -> None:
    sequence, run = finished
    write_gps(tmp_path / "walk.gpx", sequence, every=4, began=1777629600.0)
    settings = ScaleSettings("truth", reference=str(tmp_path / "walk.gpx"), began="2026-05-01T10:00:00Z")
    ask = scale_source(sequence, settings)
    assert ask is not None
    scaled = apply_scale(sequence, run, ask, settings)
    assert (
        abs(error_of_size(scaled.trajectory, sequence.ground_truth)) < 0.01
    )  # degrees of the sphere and the ellipsoid
    assert scaled.report["metric"]["segments"][0]["measurements"] == 9
    for began, what in ((None, r"it lasts from 2026-05-01T10:00:00Z"), ("noon", "noon is no time")):
        with pytest.raises(InputError, match=what):
            scale_source(sequence, replace(settings, began=began))


def test_each_segment_is_scaled_about_where_it_began() -> None:
    poses = np.tile(np.eye(4), (7, 1, 1))
    poses[:, 0, 3] = [0, 1, 2, 2, 2.5, 3, np.nan]
    poses[6] = np.nan
    segment = np.array([0, 0, 0, 1, 1, 1, -1])
    trajectory = Trajectory(np.arange(7.0), poses, segment)
    maps = segment_maps(trajectory, {0: ScaleEstimate(10.0, None, 1), 1: ScaleEstimate(4.0, None, 1)})
    assert maps[0].apply(np.array([2.0, 0, 0])).tolist() == [20, 0, 0]
    assert maps[1].apply(np.array([2.0, 0, 0])).tolist() == [20, 0, 0]
    assert maps[1].apply(np.array([3.0, 0, 0])).tolist() == [24, 0, 0]
    assert segment_maps(trajectory, {0: ScaleEstimate(10.0, None, 1)})[1].factor == 10.0


def test_a_segment_begins_where_the_camera_was_also_where_an_earlier_one_goes_on_after_it() -> None:
    """Frames 0 to 9 and 20 to 29 are of segment 0, which was seen again; 10 to 19 of segment 1, 30 and on of 2."""
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, 0, 3] = np.arange(40)
    segment = np.repeat([0, 1, 0, 2], 10)
    segment[9] = -1
    poses[9] = np.nan
    trajectory = Trajectory(np.arange(40.0), poses, segment)
    maps = segment_maps(trajectory, {number: ScaleEstimate(2.0 + 2 * number, None, 1) for number in range(3)})
    x = scaled_trajectory(trajectory, maps).world_from_cam[:, 0, 3]
    np.testing.assert_allclose(x[:9], 2 * np.arange(9))
    np.testing.assert_allclose(x[10:20], 16 + 4 * (np.arange(10, 20) - 8))
    np.testing.assert_allclose(x[20:30], 2 * np.arange(20, 30))
    np.testing.assert_allclose(x[30:], 58 + 6 * (np.arange(30, 40) - 29))


def test_the_error_of_a_median_and_its_change() -> None:
    rng = np.random.default_rng(0)
    medians, errors = [], []
    for _ in range(200):
        found = from_measurements(2 + 0.1 * rng.normal(size=400), np.arange(400.0))
        medians.append(found.metres_per_unit)
        errors.append(2 * found.relative_error)
    assert 0.5 < np.median(errors) / np.std(medians) < 2
    drifting = from_measurements(np.linspace(1.0, 1.3, 90), np.arange(90.0))
    assert drifting.change == pytest.approx(1.25 / 1.05 - 1, abs=0.01)
    assert from_measurements(np.array([2.0]), np.array([0.0])).relative_error is None


def test_the_ground_is_the_lowest_plane_and_not_the_table() -> None:
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-4, 4, 300), np.full(300, 1.5), rng.uniform(0, 8, 300)])
    table = np.column_stack([rng.uniform(-1, 1, 150), np.full(150, 0.7), rng.uniform(1, 3, 150)])
    wall = np.column_stack([rng.uniform(-4, 4, 400), rng.uniform(-2, 1.5, 400), np.full(400, 8.0)])
    points = np.concatenate([floor, table, wall]) + 0.01 * rng.normal(size=(850, 3))
    centres = np.column_stack([np.linspace(-1, 1, 10), np.zeros(10), np.zeros(10)])
    down = np.array([0.0, np.cos(0.3), -np.sin(0.3)])  # the camera looks down a little
    found = ground_plane(points, centres, down, rng)
    assert found is not None
    assert found[1] == pytest.approx(1.5, abs=0.02)
    assert ground_plane(wall, centres, down, rng) is None


def test_settings_are_checked() -> None:
    assert scale_settings([["truth", "a b.txt"]]) == ["scale.source=truth", "scale.reference=a b.txt"]
    distances = scale_settings([["distance", "1", "9", "2"], ["distance", "20", "30", "1.5"]])
    assert distances == ["scale.source=distance", "scale.distances=[[1, 9, 2.0], [20, 30, 1.5]]"]
    with pytest.raises(ConfigError, match="given twice"):
        scale_settings([["height", "1"], ["depth"]])
    for wrong in (
        {"source": "inches"},
        {"source": "height"},
        {"source": "distance", "metres": 1.0},
        {"source": "depth", "distances": ((1, 2, 3.0),)},
        {"source": "distance", "distances": ((1, 2, -3.0),)},
        {"source": "truth", "began": "12.5"},
        {"source": "marker", "metres": float("nan")},
        {"metres": 1.0},
        {"source": "depth", "metres": 1.0},
        {"source": "distance", "distances": ((1, 2, 3.0),), "metres": 1.0},
        {"source": "truth", "metres": 1.0},
        {"reference": "gps.gpx"},
        {"source": "height", "metres": 1.0, "reference": "gps.gpx"},
        {"source": "depth", "marker_dictionary": "DICT_4X4_50"},
    ):
        with pytest.raises(ConfigError):
            ScaleSettings(**wrong)  # type: ignore[arg-type]


def test_from_python_with_the_settings_of_a_run(room: Path, tmp_path: Path) -> None:
    import improvo
    from improvo.depth.run_settings import DenseRunSettings
    from improvo.frontend.settings import FrontendSettings

    settings = DenseRunSettings(frontend=FrontendSettings("sift", 800), scale=ScaleSettings("truth"))
    found = improvo.run(room, tmp_path / "out", settings)
    assert abs(error_of_size(found.trajectory, open_sequence(room).ground_truth)) < 1e-6
