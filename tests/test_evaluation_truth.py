"""Reference poses in the place of a recording's own: every format, and what is wrong with a file."""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

import improvo
from improvo.cli.main import main
from improvo.errors import ConfigError, InputError
from improvo.evaluation.settings import TrajectorySettings
from improvo.evaluation.sources import Recorded
from improvo.evaluation.truth.reference import read_reference, write_reference
from improvo.evaluation.truth.referenced import open_with_truth
from improvo.geometry.camera import Camera
from improvo.geometry.se3 import inverse, quat_xyzw_from_rotation, rigid, so3_exp
from improvo.geometry.trajectory_files import write_trajectory
from improvo.sequences.base import SequenceSettings
from improvo.types import Float64, Trajectory

WIDTH, HEIGHT, FRAMES = 64, 48, 12
CAMERA = Camera(WIDTH, HEIGHT, 61.0, 60.0, 31.0, 24.0, (-0.02, 0.01, 0.001, -0.001))
KNOWN = np.array([0, 2, 4, 6, 8, 10])  # frames with a reference pose


def reference_poses() -> Float64:
    """(6, 4, 4) camera-to-world of the frames `KNOWN`."""
    step = KNOWN[:, None]
    return rigid(so3_exp(step * np.array([0.01, -0.03, 0.02])), step * np.array([0.02, 0.01, -0.03]))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """An image folder with a calibration of its own, and poses that are wrong."""
    folder = tmp_path / "walk"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for index in range(FRAMES):
        cv2.imwrite(str(folder / f"{index:06d}.png"), rng.integers(0, 255, (HEIGHT, WIDTH), np.uint8))
    (folder / "camera.yaml").write_text(
        f"width: {WIDTH}\nheight: {HEIGHT}\nfx: 50\nfy: 50\ncx: 31.5\ncy: 23.5\nfps: 30\n"
    )
    wrong = Trajectory(np.arange(FRAMES) / 30, np.tile(np.eye(4), (FRAMES, 1, 1)))
    write_trajectory(folder / "groundtruth.txt", wrong)
    return folder


def write_colmap(folder: Path, names: list[str], binary: bool, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    """The reference as COLMAP writes it; its pixels count from the corner."""
    folder.mkdir(exist_ok=True)
    parameters = (CAMERA.fx, CAMERA.fy, CAMERA.cx + 0.5, CAMERA.cy + 0.5, *CAMERA.distortion)
    poses = inverse(reference_poses())
    rows = []
    for name, pose in zip(names, poses, strict=False):
        x, y, z, w = quat_xyzw_from_rotation(pose[:3, :3])
        rows.append((name, (w, x, y, z, *pose[:3, 3])))
    if binary:
        camera = struct.pack("<QiiQQ8d", 1, 7, 4, *size, *parameters)
        (folder / "cameras.bin").write_bytes(camera)
        images = struct.pack("<Q", len(rows))
        for number, (name, numbers) in enumerate(rows, start=1):
            images += struct.pack("<i7di", number, *numbers, 7) + name.encode() + b"\0"
            images += struct.pack("<QddQ", 1, 3.0, 4.0, 2**64 - 1)
        (folder / "images.bin").write_bytes(images)
    else:
        text = " ".join(repr(float(value)) for value in parameters)
        (folder / "cameras.txt").write_text(f"# cameras\n7 OPENCV {size[0]} {size[1]} {text}\n")
        lines = ["# images"]
        for number, (name, numbers) in enumerate(rows, start=1):
            lines += [f"{number} {' '.join(repr(float(value)) for value in numbers)} 7 {name}", "3.0 4.0 -1"]
        (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


def reference_file(tmp_path: Path, kind: str) -> Path:
    names = [f"{index:06d}.png" for index in KNOWN]
    if kind in ("text", "binary"):
        return write_colmap(tmp_path / "model", names, kind == "binary")
    if kind == "exported":
        return write_colmap(tmp_path / "model", [f"images/frame_{index:06d}.jpg" for index in KNOWN], binary=False)
    path = tmp_path / "truth.txt"
    if kind == "tum":
        write_trajectory(path, Trajectory(KNOWN / 30, reference_poses()))
    else:
        write_reference(path, CAMERA, KNOWN, reference_poses(), comments=("made by a test",))
    return path


@pytest.mark.parametrize("kind", ["numbers", "tum", "text", "binary", "exported"])
def test_every_format_gives_the_same_poses_and_its_camera(recording: Path, tmp_path: Path, kind: str) -> None:
    sequence = open_with_truth(recording, SequenceSettings(), reference_file(tmp_path, kind))
    truth = sequence.ground_truth
    assert truth is not None
    assert len(truth) == FRAMES
    assert np.allclose(truth.world_from_cam[KNOWN], reference_poses(), atol=1e-7)
    if kind == "tum":
        assert sequence.raw_camera.fx == 50.0  # has no camera: the recording's stays
        return
    assert np.flatnonzero(truth.valid).tolist() == KNOWN.tolist()  # nothing is made up in between
    raw = sequence.raw_camera
    assert np.allclose((raw.fx, raw.fy, raw.cx, raw.cy), (61.0, 60.0, 31.0, 24.0))
    assert np.allclose(raw.distortion, CAMERA.distortion)
    assert sequence.camera.is_pinhole
    assert sequence[0].image.shape == (HEIGHT, WIDTH)


def test_stride_start_and_width_carry_poses_and_camera(recording: Path, tmp_path: Path) -> None:
    truth_file = reference_file(tmp_path, "numbers")
    source = Recorded(str(recording), SequenceSettings(start=3, stride=3, width=32), str(truth_file))
    sequence = source.open()  # frames 3, 6, 9
    truth = sequence.ground_truth
    assert truth is not None
    assert truth.valid.tolist() == [False, True, False]
    assert np.allclose(truth.world_from_cam[1], reference_poses()[3])
    assert sequence.camera.width == 32
    assert source.open() is sequence


@pytest.mark.parametrize(
    ("settings", "kind", "message"),
    [
        (SequenceSettings(start=1, stride=2), "numbers", "none of them selected"),
        (SequenceSettings(fps=1000), "tum", "no selected frame of .* has one at its time"),
        (SequenceSettings(end=5), "missing", "cannot be read"),
    ],
)
def test_nothing_in_common_is_one_line(
    recording: Path, tmp_path: Path, settings: SequenceSettings, kind: str, message: str
) -> None:
    file = tmp_path / "no-such-file" if kind == "missing" else reference_file(tmp_path, kind)
    if kind == "tum":
        late = Trajectory(KNOWN + 100.0, reference_poses())
        write_trajectory(file, late)
    with pytest.raises(InputError, match=message) as error:
        open_with_truth(recording, settings, file)
    assert "\n" not in str(error.value)


def test_frames_that_do_not_exist_other_sizes_and_second_cameras_are_refused(recording: Path, tmp_path: Path) -> None:
    settings = SequenceSettings()
    far = tmp_path / "far.txt"
    write_reference(far, CAMERA, KNOWN + 3, reference_poses())
    with pytest.raises(InputError, match=r"has a pose of frame 13, but .* has 12 frames \(0 to 11\)"):
        open_with_truth(recording, settings, far)
    with pytest.raises(InputError, match="no frames of"):
        open_with_truth(recording, settings, write_colmap(tmp_path / "a", ["kitchen.png", "hall.png"], binary=True))
    with pytest.raises(InputError, match=r"1 of its 2 images \(hall.png"):
        open_with_truth(recording, settings, write_colmap(tmp_path / "b", ["000000.png", "hall.png"], binary=True))
    names = [f"{index:06d}.png" for index in KNOWN]
    other = write_colmap(tmp_path / "c", names, binary=False, size=(128, 96))
    with pytest.raises(InputError, match="calibrated for 128x96 but the images are 64x48"):
        open_with_truth(recording, settings, other)
    plain = tmp_path / "plain.txt"
    write_reference(plain, CAMERA.resized(640, 480), KNOWN, reference_poses())
    with pytest.raises(InputError, match="calibrated for 640x480"):
        open_with_truth(recording, settings, plain)
    without_size = [line for line in plain.read_text().splitlines() if "images" not in line]
    plain.write_text("\n".join(without_size))
    with pytest.raises(InputError, match="made for images of another size"):
        open_with_truth(recording, settings, plain)
    with pytest.raises(ConfigError, match="leave out --camera and --fov"):
        open_with_truth(recording, SequenceSettings(fov=60), reference_file(tmp_path, "numbers"))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("1.5 0 0 0 0 0 0 1", "different frame numbers"),
        ("-1 0 0 0 0 0 0 1", "different frame numbers"),
        ("0 0 0 0 0 0 0 1", "different frame numbers"),
        ("3 0 0 0 0 0 0 2", "frame 3 has no unit quaternion"),
        ("3 nan 0 0 0 0 0 1", "not finite"),
    ],
)
def test_damaged_rows_are_named(tmp_path: Path, row: str, message: str) -> None:
    file = reference_file(tmp_path, "numbers")
    file.write_text(file.read_text() + row + "\n")
    with pytest.raises(InputError, match=message):
        read_reference(file)


def test_damaged_models_are_one_line(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "model", [f"{index:06d}.png" for index in KNOWN], binary=True)
    whole = (folder / "images.bin").read_bytes()
    (folder / "images.bin").write_bytes(whole[:-20] + b"x")
    (folder / "images.bin").write_bytes(whole[:200])
    with pytest.raises(InputError, match="damaged COLMAP model"):
        read_reference(folder)
    (folder / "images.bin").write_bytes(struct.pack("<Q", 0))
    with pytest.raises(InputError, match="no registered image"):
        read_reference(folder)
    (folder / "cameras.bin").unlink()
    with pytest.raises(InputError, match="cannot be read"):
        read_reference(folder)
    with pytest.raises(InputError, match="is no COLMAP model"):
        read_reference(tmp_path)
    text = write_colmap(tmp_path / "text", [f"{index:06d}.png" for index in KNOWN], binary=False)
    lines = (text / "images.txt").read_text().splitlines()
    row = next(number for number, line in enumerate(lines) if line.endswith(".png"))
    fields = lines[row].split()
    lines[row] = " ".join([fields[0], "0", "0", "0", "0", *fields[5:]])
    (text / "images.txt").write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"damaged COLMAP model .a quaternion is zero"):
        read_reference(text)


@pytest.mark.parametrize(
    ("distortion", "model"),
    [((0.1, 0.2, 0.0, 0.0, 0.3), "brown"), ((0.1, 0.2, 0.3, 0.4), "fisheye"), ((), "fisheye"), ((0.9,), "fov")],
)
def test_a_camera_that_the_file_cannot_hold_is_refused(
    tmp_path: Path, distortion: tuple[float, ...], model: str
) -> None:
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, distortion, model)
    with pytest.raises(InputError, match=r"t.txt: holds k1 k2 p1 p2 of a lens"):
        write_reference(tmp_path / "t.txt", camera, np.zeros(1, np.int64), np.eye(4)[None])
    assert not list(tmp_path.iterdir())
    plain = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, (0.1, 0.2, 0.01, 0.02, 0.0), "brown")
    write_reference(tmp_path / "t.txt", plain, np.zeros(1, np.int64), np.eye(4)[None])
    calibration = read_reference(tmp_path / "t.txt").calibration
    assert calibration is not None
    assert calibration.distortion == (0.1, 0.2, 0.01, 0.02)


def test_a_trajectory_is_measured_against_the_reference(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth_file = reference_file(tmp_path, "numbers")
    estimate = tmp_path / "estimate.txt"
    write_trajectory(estimate, Trajectory(KNOWN / 30, reference_poses()))
    words = ["evaluate", "trajectory", str(estimate), str(recording), "--windows", "0.2"]
    assert main([*words, "--alignment", "se3", "--truth", str(truth_file)]) == 0
    assert "6 poses at a common time" in capsys.readouterr().out
    assert main(["evaluate", "trajectory", str(estimate), str(truth_file)]) == 2
    assert "give the sequence as TRUTH, and this with --truth" in capsys.readouterr().err


def test_python_measures_against_the_reference_as_the_command_does(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth_file = reference_file(tmp_path, "numbers")
    poses = reference_poses()
    poses[3, 0, 3] += 0.05
    estimate = tmp_path / "estimate.txt"
    write_trajectory(estimate, Trajectory(KNOWN / 30, poses))
    settings = TrajectorySettings(alignment="none", time_windows=())
    errors = improvo.evaluate_trajectory(estimate, recording, settings, reference=truth_file)
    assert errors.poses == len(KNOWN)
    assert errors.ate_m is not None
    assert errors.ate_m.rmse == pytest.approx(0.05 / np.sqrt(len(KNOWN)), rel=1e-3)
    words = ["evaluate", "trajectory", str(estimate), str(recording), "--alignment", "none", "--json"]
    assert main([*words, "--truth", str(truth_file)]) == 0
    assert json.loads(capsys.readouterr().out)["ate_m"]["rmse"] == errors.ate_m.rmse
    part = improvo.evaluate_trajectory(estimate, recording, settings, SequenceSettings(end=6), truth_file)
    assert part.poses == 3
    with pytest.raises(InputError, match="reference"):
        improvo.evaluate_trajectory(estimate, truth_file)
    with pytest.raises(TypeError, match="recording"):
        improvo.evaluate_trajectory(estimate, Trajectory(KNOWN / 30, poses), reference=truth_file)


def test_the_number_of_truths_is_that_of_the_sequences(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["evaluate", "pose", str(recording), str(recording), "--truth", "one.txt", "--workers", "1"]
    assert main(words) == 2
    assert "--truth: 1 given for 2 sequences" in capsys.readouterr().err


def test_the_reference_of_a_real_recording(shared_data: Path, tmp_path: Path) -> None:
    kitchen = shared_data / "redkitchen"
    if not (kitchen / "truth-sfm.txt").is_file():
        pytest.skip("needs truth-sfm.txt")
    sequence = open_with_truth(kitchen, SequenceSettings(), kitchen / "truth-sfm.txt")
    truth = sequence.ground_truth
    assert truth is not None
    assert (np.flatnonzero(truth.valid) % 2 == 0).all()
    assert truth.valid.sum() == 300
    assert sequence.raw_camera.fy == pytest.approx(528.97, abs=0.01)
    own = shutil.copy(kitchen / "truth-sfm.txt", tmp_path / "copy.txt")
    read = read_reference(Path(own))
    assert read.frames is not None
    assert read.frames[-1] == 598
