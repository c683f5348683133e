"""`improvo truth`: structure from motion of a rendered walk against its exact poses, the scale, and what is refused."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from rendered_walk import _WALLS, CAMERA, _texture, render_with_depth

from improvo.cli.main import main
from improvo.errors import ConfigError, InputError
from improvo.evaluation.truth.make import TruthQuality, make_truth
from improvo.evaluation.truth.metric_scale import scale_from_depth, scale_from_poses
from improvo.evaluation.truth.motion_check import check_motion
from improvo.evaluation.truth.reference import read_reference
from improvo.evaluation.truth.settings import TruthSettings
from improvo.evaluation.truth.structure_from_motion import ReconstructedImage, image_pairs
from improvo.files import make_output_folder
from improvo.geometry.alignment import align_points
from improvo.geometry.camera import Camera
from improvo.geometry.se3 import inverse, rigid, rotation_angle_deg, so3_exp, transform
from improvo.geometry.trajectory_files import write_trajectory
from improvo.sequences import open_sequence
from improvo.types import Float32, Float64, Trajectory

FRAMES = 16


def motion(frames: int = FRAMES) -> Float64:
    """Camera-to-world (N, 4, 4): round a thing in the room, with turns about all axes, from which a camera is known."""
    time = np.linspace(0, 1, frames)[:, None]
    centre = np.hstack([1.2 * np.sin(4 * time) - 0.3, 0.5 * np.cos(6 * time), -1.2 + 0.8 * np.cos(4 * time)])
    turn = np.hstack([0.15 * np.sin(6 * time), -0.35 * np.sin(4 * time), 0.5 * np.sin(5 * time)])
    return rigid(so3_exp(turn), centre)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered walk in the layout of 7-Scenes, with exact depth."""
    folder = tmp_path_factory.mktemp("truth") / "walk"
    folder.mkdir()
    rng = np.random.default_rng(0)
    textures = [_texture(rng) for _ in _WALLS]
    for index, pose in enumerate(motion()):
        image, depth = render_with_depth(inverse(pose), textures)
        cv2.imwrite(str(folder / f"frame-{index:06d}.color.png"), image)
        millimetres = np.where(np.isfinite(depth), 1000 * depth, 0).astype(np.uint16)
        cv2.imwrite(str(folder / f"frame-{index:06d}.depth.png"), millimetres)
    (folder / "camera.yaml").write_text(
        f"width: {CAMERA.width}\nheight: {CAMERA.height}\nfx: 250\nfy: 250\ncx: 159.5\ncy: 119.5\nfps: 30\n"
    )
    return folder


@pytest.fixture(scope="module")
def made(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A truth with the scale of the depth images, from a focal length that is 4 % off."""
    pytest.importorskip("pycolmap")
    output = tmp_path_factory.mktemp("made") / "truth.txt"
    assert main(["truth", str(walk), "-o", str(output), "--workers", "1", "--max-features", "700"]) == 0
    return output


def test_two_on_one_output_do_not_meet(walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pycolmap")
    make_output_folder(tmp_path / "truth.work", "truth")
    holder = "import sys, time; from improvo.folder_lock import locked; from pathlib import Path\n"
    holder += "with locked(Path(sys.argv[1])): print('held', flush=True); time.sleep(600)"
    words = [sys.executable, "-c", holder, str(tmp_path / "truth.work")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            assert main(["truth", str(walk), "-o", str(tmp_path / "truth.txt")]) == 2
        finally:
            process.kill()
    assert f"truth.work: process {process.pid} " in capsys.readouterr().err


def test_what_does_not_fit_on_the_disk_is_refused_before_any_work(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pycolmap")
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=1_000_000))
    words = ["truth", str(walk), "-o", str(tmp_path / "truth.txt")]
    assert main([*words, "--max-features", "10000"]) == 2
    message = capsys.readouterr().err.splitlines()
    assert len(message) == 1
    assert "truth.work: needs about 57 MB, and 1 MB are free" in message[0]
    assert not (tmp_path / "truth.work" / "images").exists()


def test_json_is_all_that_is_printed(walk: Path, made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["truth", str(walk), "-o", str(made), "--workers", "1", "--max-features", "700", "--json"]
    assert main(words) == 0  # from what the first call left
    figures = json.loads(capsys.readouterr().out)
    assert figures["registered"] == figures["frames"] == FRAMES


def test_poses_and_camera_are_those_that_were_rendered(made: Path) -> None:
    found = read_reference(made)
    exact = motion()
    assert found.frames is not None
    assert found.frames.tolist() == list(range(FRAMES))
    assert found.calibration is not None
    fx, fy, _, _ = found.calibration.intrinsics
    assert (fx, fy) == pytest.approx((CAMERA.fx, CAMERA.fy), rel=0.01)
    fitted = align_points(exact[:, :3, 3], found.world_from_cam[:, :3, 3], with_scale=True)
    assert fitted.scale == pytest.approx(1.0, abs=0.01)  # metric by depth
    aligned = fitted.apply_to_poses(found.world_from_cam)
    assert np.linalg.norm(aligned[:, :3, 3] - exact[:, :3, 3], axis=1).max() < 0.01
    offset = np.swapaxes(exact[:, :3, :3], 1, 2) @ aligned[:, :3, :3]
    assert rotation_angle_deg(offset).max() < 0.6  # a pixel of the principal point is a quarter of a degree,
    assert rotation_angle_deg(offset[0].T @ offset).max() < 0.15  # the same in all frames


def test_quality_is_stored_and_an_evaluation_reads_the_file(
    made: Path, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    quality = json.loads(made.with_suffix(".json").read_text())["quality"]
    assert quality["registered"] == quality["frames"] == FRAMES
    assert quality["mean_reprojection_px"] < 1.0
    assert quality["scale_by"] == "depth"
    assert quality["scale_spread"] < 0.02
    assert quality["motion"]["length_ratio"] == pytest.approx(1.0, abs=0.01)
    assert quality["motion"]["rotation_deg"] < 0.2
    words = ["evaluate", "pose", str(walk), "--truth", str(made), "--gaps", "1", "--frontend", "sift"]
    assert main([*words, "--workers", "1"]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("| sift"))
    assert "1.000" in row


def test_a_finished_work_is_used_again_and_a_bad_truth_is_not_written(
    made: Path, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = made.read_text()
    (made.parent / "truth.work" / "database.db").unlink()  # nothing left to compute from
    words = ["truth", str(walk), "-o", str(made), "--workers", "1", "--max-features", "700"]
    assert main(words) == 0
    assert made.read_text() == before
    assert main([*words, "--set", "truth.max_reprojection_px=0.001"]) == 2
    assert "not written, since the poses are not good enough" in capsys.readouterr().err
    assert main(["truth", str(walk), "-o", str(made), "--max-features", "900"]) == 2
    assert "was begun with other frames or settings" in capsys.readouterr().err
    model, output = made.parent / "truth.work" / "model", tmp_path / "again.txt"
    half = motion()
    half[:, :3, 3] *= 0.5
    write_trajectory(tmp_path / "half.txt", Trajectory(np.arange(FRAMES) / 30, half))
    words = ["truth", str(walk), "-o", str(output), "--model", str(model), "--scale-from", str(tmp_path / "half.txt")]
    assert main(words) == 0
    whole, smaller = read_reference(made).world_from_cam, read_reference(output).world_from_cam
    step = [np.linalg.norm(poses[-1, :3, 3] - poses[0, :3, 3]) for poses in (whole, smaller)]
    assert step[1] / step[0] == pytest.approx(0.5, abs=0.01)


def test_masked_pixels_have_no_features(walk: Path, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    mask = np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
    mask[:, : CAMERA.width // 3] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    out = tmp_path / "truth.txt"
    given = ["truth", str(walk), "-o", str(out), "--end", "6", "--quiet", "--calibrate", "none"]
    main([*given, "--mask", str(tmp_path / "mask.png")])  # whether six frames are enough for a truth is no matter
    database = pycolmap.Database.open(tmp_path / "truth.work" / "database.db")
    x = np.concatenate([database.read_keypoints(image.image_id)[:, 0] for image in database.read_all_images()])
    database.close()
    assert len(x) > 300
    assert x.min() > CAMERA.width // 3 + 5  # the border counts as masked
    assert main(given) == 2  # the same working folder with other pixels


def test_a_camera_that_stays_must_have_a_place_in_the_file(walk: Path, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    sequence = open_sequence(walk, camera="250,250,159.5,119.5,0.1,-0.02,0,0,0.01")
    with pytest.raises(InputError, match=r"more distortion than k1 k2 p1 p2.*leave out --calibrate none"):
        make_truth(sequence, tmp_path / "truth.txt", TruthSettings(calibrate="none"))


def test_pairs_are_the_next_images_and_powers_of_two() -> None:
    pairs = image_pairs(40, overlap=3, farthest=16)
    assert sorted({int(b - a) for a, b in pairs}) == [1, 2, 3, 4, 8, 16]
    assert pairs.max() == 39
    assert len(image_pairs(1, 3, 16)) == 0


def test_scale_by_depth_is_the_median_and_knows_its_spread() -> None:
    rng = np.random.default_rng(0)
    pixels = rng.uniform(5, 50, (40, 2))
    image = ReconstructedImage("a", np.eye(4), pixels, np.full(40, 0.5), np.arange(40))
    few = ReconstructedImage("b", np.eye(4), pixels[:5], np.full(5, 0.5), np.arange(5))
    maps: list[Float32 | None] = [np.full((60, 60), depth, np.float32) for depth in (1.0, 1.01, 0.99, 1.0)]
    scale = scale_from_depth((image, image, image, few), lambda row: maps[row], min_depths=20)
    assert scale is not None
    assert (scale.scale, scale.images) == (pytest.approx(2.0), 3)
    assert scale.spread == pytest.approx(1.4826 * 0.01, rel=1e-3)
    assert scale.disagreement == pytest.approx(0.01, rel=1e-3)
    assert scale_from_depth((few,), lambda row: maps[row], min_depths=20) is None
    assert scale_from_depth((image,), lambda row: None, min_depths=20) is None


def test_scale_by_poses_survives_a_turned_world_and_missing_poses() -> None:
    poses = motion(50)
    world = rigid(so3_exp(np.array([0.3, 1.0, -0.2])), np.array([3.0, 1.0, 2.0]))
    metric = world @ poses
    metric[:, :3, 3] = 3.0 * metric[:, :3, 3]
    metric[7] = np.nan
    scale = scale_from_poses(poses, metric)
    assert scale.scale == pytest.approx(3.0)
    assert scale.images == 49
    assert max(scale.spread, scale.disagreement) < 1e-9
    with pytest.raises(InputError):
        scale_from_poses(poses[:2], metric[:2])


def seen_from(pose: Float64, points: Float64, camera: Camera) -> ReconstructedImage:
    """What a perfect reconstruction knows of an image, with the depth of its points."""
    local = transform(inverse(pose), points)
    rays = camera.distort(local[:, :2] / local[:, 2:])
    pixels = rays * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    return ReconstructedImage("", inverse(pose), pixels, local[:, 2], np.arange(len(points)))


@pytest.mark.parametrize("distortion", [(), (-0.1, 0.02, 0.001, -0.002)])
def test_motions_by_depth_tell_poses_that_are_too_long_sideways(distortion: tuple[float, ...]) -> None:
    camera = Camera(200, 200, 220.0, 220.0, 100.0, 95.0, distortion)
    xy = np.random.default_rng(0).uniform(-0.5, 0.5, (300, 2))
    points = np.column_stack([xy, np.full(300, 2.0)])  # a wall, and a camera that moves along it
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, 0, 3] = np.linspace(-0.3, 0.3, 20)
    depth = np.full((200, 200), 2.0, np.float32)
    exact = tuple(seen_from(pose, points, camera) for pose in poses)
    check = check_motion(exact, camera, lambda row: depth, 1.0)
    assert check is not None
    assert check.length_ratio == pytest.approx(1.0, abs=1e-3)
    longer = poses.copy()
    longer[:, 0, 3] *= 1.1
    wrong = tuple(replace(image, cam_from_world=inverse(pose)) for image, pose in zip(exact, longer, strict=True))
    check = check_motion(wrong, camera, lambda row: depth, 1.0)
    assert check is not None
    assert check.length_ratio == pytest.approx(1 / 1.1, abs=1e-3)
    quality = TruthQuality(20, 20, 300, 8.0, 0.5, "depth", 20, 0.0, 0.0, motion=check)
    assert "motions by depth are 0.909 times as long" in quality.faults(TruthSettings())[0]
    assert check_motion(exact, camera, lambda row: None, 1.0) is None


def test_limits_name_what_is_wrong() -> None:
    good = TruthQuality(100, 95, 5000, 8.0, 0.6, "depth", 90, 0.01, 0.01)
    assert good.faults(TruthSettings()) == []
    assert "95 of 100 frames registered" in good.text()
    bad = TruthQuality(100, 50, 5000, 8.0, float("nan"), "depth", 90, 0.2, 0.2, aspect_change=-0.03)
    assert len(bad.faults(TruthSettings())) == 5
    assert "fy / fx differs by -3.0 %" in bad.faults(TruthSettings())[-1]
    with pytest.raises(ConfigError):
        TruthSettings(min_registered=0)
