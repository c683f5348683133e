"""`improvo calibrate` without a board and `--camera auto`: files, what is said, what is refused, what is kept."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered_walk import CAMERA, write_walk

import improvo
from improvo.cli.main import main
from improvo.errors import InputError
from improvo.geometry.camera_files import load_calibration
from improvo.self_calibration import found_cameras
from improvo.self_calibration.found_cameras import find_cameras
from improvo.self_calibration.settings import SelfCalibrationSettings
from improvo.sequences import SequenceSettings

QUICK = ["--set", "rounds=2", "--set", "views=25", "--set", "pairs=6", "--set", "frontend.max_keypoints=400"]
QUICK += ["--set", "max_rate=30", "--set", "max_focal_deviation=0.03"]


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A walk through a textured room, without a calibration."""
    folder = write_walk(tmp_path_factory.mktemp("walks") / "walk", frames=45)
    (folder / "camera.yaml").unlink()
    return folder


@pytest.fixture(scope="module")
def found(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The calibration that the command line leaves."""
    path = tmp_path_factory.mktemp("found") / "camera.yaml"
    assert main(["calibrate", str(walk), "-o", str(path), *QUICK]) == 0
    return path


def test_a_camera_is_found_and_written_with_its_deviations(found: Path) -> None:
    camera = load_calibration(str(found)).camera(CAMERA.width, CAMERA.height)
    assert camera.fx == pytest.approx(CAMERA.fx, rel=0.015)
    assert camera.fy == pytest.approx(CAMERA.fy, rel=0.015)
    assert re.match(r"# from the motion of 4\d frames .*: RMS 0\.\d+ px; standard deviations fx \d", found.read_text())
    figures = json.loads(found.with_suffix(".json").read_text())["found"]
    assert abs(figures["values"]["fx"] - CAMERA.fx) < 4 * figures["deviations"]["fx"]
    assert figures["model"] == camera.distortion_model


def test_the_table_says_every_value_with_its_deviation(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def known(path: Path, settings: SelfCalibrationSettings, told: object) -> object:
        assert settings.model == "fisheye"
        return example()

    monkeypatch.setattr("improvo.self_calibration.from_motion.camera_from_motion", known)
    words = ["calibrate", str(walk), "--from", "motion", "--model", "fisheye", "-o", str(tmp_path / "c.yaml")]
    assert main(words) == 0
    shown = capsys.readouterr().out
    for name in ("fx", "fy", "cx", "cy", "k1", "k2"):
        assert re.search(rf"^  {name}\s+-?[\d.e-]+\s+\+- [\d.]+$", shown, re.MULTILINE), name
    assert "focal length +- 0.19 %" in shown
    assert "no rolling shutter" in shown
    assert shown.splitlines()[-1].startswith("next: ")
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["deviations"]["fx"] == 0.5


def example() -> object:
    """A camera as if it had been found."""
    from improvo.self_calibration.from_motion import CameraFromMotion
    from improvo.self_calibration.lens import NAMES

    deviations = dict.fromkeys(NAMES, 0.5)
    camera = improvo.Camera(CAMERA.width, CAMERA.height, 260.0, 260.0, 159.5, 119.5, (0.0, 0.0, 0.0, 0.0))
    return CameraFromMotion(camera, deviations, 0.4, 45, 45, 25, 300, 3000, 63.0, 0.0, 0.001)


def counted(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The recordings whose camera is looked for from here on; each is found at once."""
    asked: list[Path] = []

    def known(path: Path, settings: object, told: object) -> object:
        asked.append(Path(path))
        if "dull" in str(path):
            raise InputError(f"{path}: its motion does not tell its camera")
        return example()

    monkeypatch.setattr(found_cameras, "camera_from_motion", known)
    return asked


def test_run_finds_the_camera_once_and_says_so(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = counted(monkeypatch)
    out = tmp_path / "out"
    words = ["run", str(walk), "--camera", "auto", "-o", str(out), "--frontend", "orb", "--max-frames", "20"]
    assert main(words) == 0
    assert "camera from the motion: brown, fx 260.0, fy 260.0 (+- 0.19 %)" in capsys.readouterr().out
    report = json.loads((out / "run.json").read_text())
    assert report["camera_from_motion"]["deviations"]["fx"] == 0.5
    assert report["configuration"]["sequence"]["camera"] == str(out / "camera.yaml")
    assert improvo.RunFolder(out).image(0).shape == (240, 320)
    assert main(words) == 0
    assert len(asked) == 1  # the second run reads the file
    assert main([*words, "--max-frames", "22"]) == 0
    assert len(asked) == 2  # of other frames it would be another


def test_a_moved_run_still_opens_its_recording(walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    counted(monkeypatch)
    out = tmp_path / "out"
    words = ["run", str(walk), "--camera", "auto", "-o", str(out), "--frontend", "orb", "--max-frames", "20"]
    assert main(words) == 0
    out.rename(tmp_path / "moved")
    assert improvo.RunFolder(tmp_path / "moved").image(3).shape == (240, 320)


def test_many_recordings_get_a_camera_each(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = counted(monkeypatch)
    names = ["first", "second", "dull"]
    for name in names:
        shutil.copytree(walk, tmp_path / name)
    paths = [str(tmp_path / name) for name in names]
    labels = tmp_path / "labels"
    words = ["label", *paths, "-o", str(labels), "--camera", "auto", "--frontend", "orb", "--max-keypoints", "300"]
    assert main(words) == 0
    shown = capsys.readouterr()
    assert "2 of 3 sequences labelled" in shown.out
    assert "dull: its motion does not tell its camera" in shown.err
    assert {path.name for path in (labels / "cameras").glob("*.yaml")} == {"first.yaml", "second.yaml"}
    assert main(words) == 0  # continues with the same settings
    assert [path.name for path in asked] == [*names, "dull"]
    settings = SequenceSettings(camera=str(labels / "cameras"))
    assert improvo.open_sequence(tmp_path / "second", settings).camera.fx == 260.0
    with pytest.raises(InputError, match=r"a file with the name of the recording"):
        improvo.open_sequence(tmp_path / "dull", settings)


def test_a_plan_finds_the_camera_and_the_command_after_it_takes_that(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = counted(monkeypatch)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    shutil.copytree(walk, tmp_path / "other")
    words = ["label", str(walk), "--camera", "auto", "--frontend", "orb", "--max-keypoints", "300"]
    assert main([*words, "--plan"]) == 0
    assert "all: 1 recording, 45 frames" in capsys.readouterr().out
    assert main([*words, "-o", str(tmp_path / "labels")]) == 0
    assert len(asked) == 1
    assert load_calibration(str(tmp_path / "labels" / "camera.yaml")).camera(320, 240).fx == 260.0
    monkeypatch.setattr("improvo.improvement.plan_sample.installed", lambda name: False)  # a sample takes minutes
    words = ["improve", str(walk), "--evaluate", str(tmp_path / "other"), "--camera", "auto", "--plan"]
    assert main([*words, "--frontend", "superpoint-small", "--max-keypoints", "100"]) == 0
    assert "labelling: 90 frames" in capsys.readouterr().out
    assert [path.name for path in asked] == ["walk", "walk", "other"]


def test_features_are_exported_with_a_found_camera(walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("h5py")
    counted(monkeypatch)
    out = tmp_path / "scene"
    words = ["export", "features", str(walk), "--camera", "auto", "--layout", "hloc", "--max-frames", "4"]
    assert main([*words, "--frontend", "orb", "--no-images", "-o", str(out)]) == 0
    assert load_calibration(str(out / "camera.yaml")).camera(320, 240).fx == 260.0


def test_python_finds_and_keeps_it_too(walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    counted(monkeypatch)
    settings = improvo.RunSettings(
        SequenceSettings(camera="auto", max_frames=12), improvo.FrontendSettings("orb", max_keypoints=300)
    )
    run = improvo.run(walk, tmp_path / "out", settings)
    assert run.report["camera_from_motion"]["values"]["fx"] == 260.0
    assert (tmp_path / "out" / "camera.yaml").is_file()
    with pytest.raises(InputError, match=r"improvo\.find_camera"):
        improvo.open_sequence(walk, camera="auto")


def test_other_cameras_are_left_alone(walk: Path, tmp_path: Path) -> None:
    settings = SequenceSettings(fov=60.0)
    assert find_cameras([walk], settings, tmp_path) is settings
    assert list(tmp_path.iterdir()) == []


def still(folder: Path, frames: int = 30) -> Path:
    """A recording of a camera on a shelf."""
    folder.mkdir()
    picture = np.random.default_rng(0).integers(0, 255, (60, 80), np.uint8)
    picture = cv2.resize(picture, (320, 240), interpolation=cv2.INTER_CUBIC)
    for i in range(frames):
        cv2.imwrite(str(folder / f"{i:03d}.png"), picture)
    return folder


def test_what_cannot_be_found_is_one_line_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shelf, out = still(tmp_path / "shelf"), tmp_path / "camera.yaml"
    short = still(tmp_path / "short", 5)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for words, says in (
        (["calibrate", str(shelf), "-o", str(out), *QUICK], "walk sideways"),
        (["calibrate", str(short), "-o", str(out)], "5 frames"),
        (["calibrate", str(tmp_path / "none.mp4"), "-o", str(out)], "no such file"),
        (["calibrate", str(shelf), "--from", "motion", "--board", "9x6:25mm"], "leave out --board"),
        (["calibrate", str(shelf), "--model", "brown8", "-o", str(out)], "needs a board"),
        (["info", str(short), "--camera", "auto"], "5 frames"),
        (["run", str(short), "--camera", "auto", "-o", str(tmp_path / "auto")], "5 frames"),
        (["label", str(short), str(shelf), "--camera", "auto", "-o", str(tmp_path / "auto")], "5 frames"),
    ):
        assert main(words) == 2, words
        lines = capsys.readouterr().err.strip().splitlines()
        assert says in lines[-1], words
        assert lines[-1].startswith("improvo: ")
        assert not out.exists()
        assert not (tmp_path / "auto").exists()


def test_run_without_a_camera_offers_to_find_it(walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(walk), "-o", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "--fov DEGREES" in error
    assert "--camera auto" in error
    assert not (tmp_path / "out").exists()


def test_masked_pixels_take_no_part(walk: Path, tmp_path: Path) -> None:
    from improvo.frontend.registry import load_frontend
    from improvo.self_calibration.raw_features import detect_pieces, open_raw, sampled_pictures

    mask = np.full((240, 320), 255, np.uint8)
    mask[:, 160:] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    sequence = open_raw(walk, SequenceSettings(mask=str(tmp_path / "mask.png"), max_frames=4))
    (piece,) = detect_pieces(sequence, [range(4)], load_frontend("sift", 200))
    assert all(features.keypoints[:, 0].max() < 160 for features in piece.features)
    assert all(np.ptp(picture[:, 170:]) == 0 for _, picture in sampled_pictures(sequence, 3))


def test_real_recording(shared_data: Path, tmp_path: Path) -> None:
    """`checkerboard-desk` with its own calibration withheld: focal length to 1.5 % from 60 frames."""
    published = load_calibration(str(shared_data / "checkerboard-desk" / "camera.yaml")).camera(752, 480)
    settings = SelfCalibrationSettings(
        SequenceSettings(stride=2, max_frames=60), views=30, rounds=2, max_focal_deviation=0.02
    )
    found = improvo.find_camera(shared_data / "checkerboard-desk", settings)
    assert found.camera.fx == pytest.approx(published.fx, rel=0.015)
    assert found.camera.fy == pytest.approx(published.fy, rel=0.015)
    assert found.focal_deviation < 0.02


def test_a_stop_between_a_camera_and_its_figures_leaves_no_camera_of_another_recording(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = counted(monkeypatch)
    out, other = tmp_path / "out", tmp_path / "other"
    out.mkdir()
    shutil.copytree(walk, other)
    find_cameras([walk], SequenceSettings(camera="auto"), out)

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("improvo.self_calibration.from_motion.write_json", stop)
        with pytest.raises(KeyboardInterrupt):
            find_cameras([other], SequenceSettings(camera="auto"), out)
    assert (out / "camera.yaml").is_file()  # of the other recording
    find_cameras([walk], SequenceSettings(camera="auto"), out)
    assert asked == [walk, other, walk]


def test_a_folder_that_holds_another_recording_by_now_is_looked_at_anew(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = counted(monkeypatch)
    out, place = tmp_path / "out", tmp_path / "frames"
    out.mkdir()
    shutil.copytree(walk, place)
    for _ in range(2):
        find_cameras([place], SequenceSettings(camera="auto"), out)
    assert asked == [place]
    for picture in place.rglob("*.png"):
        assert cv2.imwrite(str(picture), cv2.imread(str(picture))[:, ::-1])
    find_cameras([place], SequenceSettings(camera="auto"), out)
    assert asked == [place, place]


def test_another_mask_under_the_same_name_is_another_search(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = counted(monkeypatch)
    out, mask = tmp_path / "out", tmp_path / "mask.png"
    out.mkdir()
    settings = SequenceSettings(camera="auto", mask=str(mask))
    for black in (0, 0, 40):
        picture = np.full((240, 320), 255, np.uint8)
        picture[:, :black] = 0
        assert cv2.imwrite(str(mask), picture)
        find_cameras([walk], settings, out)
    assert asked == [walk, walk]


@pytest.mark.parametrize("gone", [0, 22, 44])
def test_a_recording_with_a_damaged_frame_is_still_told_from_another(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gone: int
) -> None:
    asked = counted(monkeypatch)
    out, place = tmp_path / "out", tmp_path / "frames"
    out.mkdir()
    shutil.copytree(walk, place)
    sorted(place.rglob("*.png"))[gone].write_bytes(b"no picture")
    for _ in range(2):
        find_cameras([place], SequenceSettings(camera="auto"), out)
    assert asked == [place]
