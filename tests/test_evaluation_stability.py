"""`improvo evaluate stability`: measures on known numbers, and the whole command on labels whose causes are known."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from improvo.cli.main import main
from improvo.errors import InputError
from improvo.evaluation.stability.causes import PRECEDENCE, TrueCauses, track_causes
from improvo.evaluation.stability.protocol import median_errors, paired_folders, roc_auc
from improvo.evaluation.stability.true_errors import true_track_errors
from improvo.evaluation.statistics import average_precision
from improvo.geometry.camera import Camera
from improvo.geometry.se3 import inverse, rigid, transform
from improvo.simulation import bundled_sequence
from improvo.simulation.tum_writer import TumRgbdWriter
from improvo.stability.rule import label_stability
from improvo.stability.tables import PointsWriter, TracksWriter
from improvo.types import Tracks

CODES = {"static": 0, "moving": 1, "highlight": 2, "shadow_edge": 3, "depth_discontinuity": 4, "repeated_texture": 5}
CAMERA = Camera(96, 64, 80.0, 80.0, 47.5, 31.5)
FRAMES = 14


def test_roc_auc_counts_pairs_and_half_of_ties() -> None:
    score = np.array([0.1, 0.4, 0.35, 0.8, 0.4])
    positive = np.array([False, False, True, True, True])
    wins = [s > n or (0.5 if s == n else 0) for s in score[positive] for n in score[~positive]]
    assert roc_auc(score, positive) == pytest.approx(sum(wins) / 6)
    assert roc_auc(score, np.zeros(5, bool)) is None


def test_average_precision_on_a_known_order() -> None:
    score = np.array([0.9, 0.8, 0.7, 0.6])
    assert average_precision(score, np.array([True, False, True, False])) == pytest.approx(0.5 + 0.5 * 2 / 3)
    assert average_precision(np.ones(4), np.array([True, False, False, False])) == pytest.approx(0.25)
    assert average_precision(score, np.zeros(4, bool)) is None


def test_median_errors_of_tracks() -> None:
    track = np.array([7, 7, 2, 2, 2, 2, 7, 9])
    error = np.array([5.0, 1.0, 4.0, np.nan, 1.0, 30.0, 2.0, 0.5], np.float32)
    assert median_errors(track, error, np.array([2, 7])).tolist() == [4.0, 2.0]
    error[track == 2] = [4.0, 2.0, 1.0, 30.0]
    assert median_errors(track, error, np.array([9, 2])).tolist() == [0.5, 3.0]
    with pytest.raises(InputError, match="no error"):
        median_errors(track, error, np.array([3]))


def _poses() -> np.ndarray:
    return rigid(np.eye(3)[None].repeat(FRAMES, 0), np.arange(FRAMES)[:, None] * [0.02, 0.005, 0.0])


@pytest.fixture
def simulation(tmp_path: Path) -> Path:
    """A wall two metres away; its left third moves, its right third has a repeated texture."""
    folder = tmp_path / "room"
    (folder / "labels").mkdir(parents=True)
    (folder / "simulation.json").write_text(json.dumps({"causes": CODES}))
    labels = np.zeros((64, 96), np.uint8)
    labels[:, :32] = CODES["moving"]
    labels[:, 64:] = CODES["repeated_texture"]
    with TumRgbdWriter(folder, CAMERA, 30.0) as writer:
        for number, pose in enumerate(_poses()):
            cv2.imwrite(str(folder / "labels" / f"{number:06d}.png"), labels)
            depth = np.full((64, 96), 2.0, np.float32) if number % 5 == 0 else None
            writer.add(number / 30, np.full((64, 96), 90, np.uint8), depth, pose)
    return folder


def _tracks() -> Tracks:
    """Twelve points of the wall: those that start left drift away downwards, one in the middle jumps."""
    points = np.stack(np.meshgrid([-0.8, -0.65, 0.0, 0.3, 0.95, 1.1], [-0.4, 0.3], [2.0]), axis=-1).reshape(-1, 3)
    seen = CAMERA.project(transform(inverse(_poses()), points[None]))
    start = seen[0, :, 0]
    seen[:, start < 30, 1] += 1.2 * np.arange(FRAMES)[:, None] * (-1) ** np.arange(FRAMES)[:, None]
    middle = int(np.flatnonzero((start > 45) & (start < 60))[0])
    seen[8:11, middle] += 9.0
    frame, track = np.meshgrid(np.arange(FRAMES), np.arange(len(points)))
    keypoints = seen.transpose(1, 0, 2).reshape(-1, 2).astype(np.float32)
    inside = (keypoints >= 0).all(1) & (keypoints[:, 0] < 96) & (keypoints[:, 1] < 64)
    rows = (frame.ravel()[inside], track.ravel()[inside], keypoints[inside])
    return Tracks(rows[0].astype(np.int64), rows[1].astype(np.int64), rows[2], np.ones(inside.sum(), np.float32))


@pytest.fixture
def labels(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    tracks = _tracks()
    found = label_stability(tracks, inverse(_poses()), np.zeros(FRAMES, np.int64), CAMERA.K)
    with PointsWriter(folder / "points.parquet") as points:
        points.write(found)
    with TracksWriter(folder / "tracks.parquet") as rows:
        rows.write(tracks.frame, tracks.track, tracks.keypoints, tracks.weight, found.errors)
    return folder


def test_the_command_finds_the_causes(simulation: Path, labels: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(["evaluate", "stability", str(labels), str(simulation), "-o", str(out)]) == 0
    subject = json.loads((out / "stability.json").read_text())["subjects"][0]
    rows = {row["cause"]: row for row in subject["causes"]}
    assert rows["moving"]["labelled"] >= 2
    assert rows["moving"]["recall"] == 1.0
    assert rows["moving"]["scores"]["label"]["roc_auc_followed"] == 1.0
    assert rows["moving"]["scores"]["median_error"]["roc_auc"] == 1.0
    assert 2 <= rows["moving_left_its_place"]["labelled"] <= rows["moving"]["labelled"]
    assert rows["wrong_links"]["labelled"] == 1
    assert subject["static"]["unstable"] == 1
    assert subject["static"]["followed"]["unstable"] == 0
    assert subject["static"]["followed"]["labelled"] >= 2
    assert rows["highlight"]["scores"]["label"]["roc_auc"] is None
    assert (out / "stability.png").stat().st_size > 5000
    assert "| moving |" in (out / "stability.md").read_text()


def test_labels_of_the_bundled_recording_find_what_moves(tmp_path: Path) -> None:
    """The whole way from pictures: odometry, labels, true causes."""
    out = tmp_path / "out"
    assert main(["label", str(bundled_sequence()), "-o", str(tmp_path / "labels")]) == 0
    assert main(["evaluate", "stability", str(tmp_path / "labels"), str(bundled_sequence()), "-o", str(out)]) == 0
    subject = json.loads((out / "stability.json").read_text())["subjects"][0]
    rows = {row["cause"]: row for row in subject["causes"]}
    assert rows["moving"]["labelled"] > 30
    assert subject["static"]["labelled"] > 300
    assert rows["moving_or_highlight"]["scores"]["median_error"]["roc_auc"] > 0.88  # measured: 0.918
    assert rows["moving_or_highlight"]["scores"]["label"]["roc_auc_followed"] > 0.94  # 0.978
    assert subject["static"]["followed"]["false_alarms"] < 0.03  # 0


def test_true_errors_tell_links_that_slid_from_wrong_poses() -> None:
    tracks = _tracks()
    depth = {0: np.full((64, 96), 2.0, np.float32)}
    wanted = np.unique(tracks.track)
    errors = true_track_errors(tracks.frame, tracks.track, tracks.keypoints, wanted, CAMERA, _poses(), depth)
    first = {int(t): tracks.keypoints[tracks.track == t][0, 0] for t in wanted}
    left = np.array([first[int(t)] < 30 for t in wanted])
    assert errors[left].min() > 5
    assert (errors[~left] > 5).sum() == 1
    assert np.nanmedian(errors[~left]) < 1e-3
    nothing = true_track_errors(tracks.frame, tracks.track, tracks.keypoints, wanted, CAMERA, _poses(), {})
    assert np.isnan(nothing).all()


def test_causes_are_looked_up_where_the_keypoint_is_at_any_width(simulation: Path) -> None:
    truth = TrueCauses(simulation)
    names = np.array(PRECEDENCE)
    places = np.array([[5.0, 10.0], [33.0, 10.0], [34.5, 10.0], [48.0, 60.0], [95.0, 63.0]], np.float32)
    assert list(names[truth.at(0, places, 96, reach=0)]) == ["moving", "static", "static", "static", "repeated_texture"]
    assert list(names[truth.at(0, np.array([[32.0, 10.0]], np.float32), 96)]) == ["moving"]  # a pixel beside it
    assert list(names[truth.at(0, places * 2 + 0.5, 192, reach=0)]) == list(names[truth.at(0, places, 96, reach=0)])


def test_a_track_has_the_cause_of_most_of_its_observations(simulation: Path) -> None:
    x = np.array([10.0, 20.0, 50.0, 50.0, 50.0, 70.0], np.float32)
    keypoints = np.column_stack([x, np.full(6, 30, np.float32)])
    frame, track = np.array([0, 1, 2, 0, 1, 2]), np.array([7, 7, 7, 9, 9, 9])
    ids, causes = track_causes(TrueCauses(simulation), frame, track, keypoints, np.arange(3), 96)
    assert list(ids) == [7, 9]
    assert [PRECEDENCE[cause] for cause in causes] == ["moving", "static"]


def test_what_does_not_belong_together_is_refused(
    simulation: Path, labels: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", "stability", str(labels), str(labels)]) == 2
    assert "improvo simulate" in capsys.readouterr().err
    assert main(["evaluate", "stability", str(tmp_path / "nothing"), str(simulation)]) == 2
    assert "points.parquet" in capsys.readouterr().err
    with pytest.raises(InputError):
        paired_folders(tmp_path / "nothing", simulation)
    assert main(["evaluate", "stability", str(labels), str(simulation), "--frontend", "sift"]) == 2
    assert "stability head" in capsys.readouterr().err
