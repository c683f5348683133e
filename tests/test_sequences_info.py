"""`improvo info`: what a recording is, what is wrong with it, and what to do."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from improvo.cli.main import main
from improvo.geometry.camera_files import calibration_yaml
from improvo.sequences import SequenceSettings
from improvo.sequences.survey import Survey, survey
from improvo.types import UInt8
from sequence_builders import CAMERA, images, texture, write_images, write_tum, write_video


def look(folder: Path, pictures: list[UInt8], times: list[float] | None = None) -> Survey:
    write_images(folder, pictures)
    (folder / "camera.yaml").write_text(calibration_yaml(CAMERA, fps=30.0))
    if times is not None:
        (folder / "times.txt").write_text("".join(f"{time}\n" for time in times))
    return survey(folder, SequenceSettings())


def said(findings: Survey) -> str:
    return "\n".join(f"{problem.what} -> {problem.advice}" for problem in findings.problems)


def test_a_good_recording_has_no_problems(tmp_path: Path) -> None:
    write_tum(tmp_path, 12)
    findings = survey(tmp_path, SequenceSettings())
    facts = findings.facts
    assert not findings.problems
    assert (facts["format"], facts["frames"], facts["size"]) == ("tum", 12, [96, 72])
    assert facts["frames_per_second"] == pytest.approx(30, rel=1e-3)
    assert facts["seconds"] == pytest.approx(11 / 30, rel=1e-3)
    assert facts["camera"]["fx"] == CAMERA.fx
    assert facts["depth"]["share_of_frames"] == 1.0
    assert facts["depth"]["median"] == pytest.approx(1.2, abs=0.1)
    assert facts["ground_truth"]["poses"] == 12
    assert facts["duplicates"] == 0.0


def test_duplicates_are_counted(tmp_path: Path) -> None:
    pictures = images(10)
    for i in (2, 5, 8):
        pictures[i] = pictures[i - 1]
    findings = look(tmp_path, pictures)
    assert findings.facts["duplicates"] == pytest.approx(3 / 9, abs=1e-3)
    assert "--stride 2" in said(findings)


def test_gaps_are_found(tmp_path: Path) -> None:
    findings = look(tmp_path, images(10), [i / 10 if i < 6 else i / 10 + 2.0 for i in range(10)])
    assert findings.facts["gaps"] == [{"after_frame": 5, "seconds": pytest.approx(2.1)}]
    assert "1 gap in" in said(findings)


def test_blur_darkness_and_missing_texture(tmp_path: Path) -> None:
    pictures = images(12)
    blurred = [cv2.GaussianBlur(p, (0, 0), 4) if i % 3 == 1 else p for i, p in enumerate(pictures)]
    assert "are blurred" in said(look(tmp_path / "blur", blurred))
    assert "very dark" in said(look(tmp_path / "dark", [(p // 16).astype(np.uint8) for p in pictures]))
    flat = [np.full((72, 96), 120, np.uint8) for _ in range(4)]
    assert "little texture" in said(look(tmp_path / "flat", flat))
    clipped = [np.where(texture(i, 100)[:72, :96] > 128, 255, 0).astype(np.uint8) for i in range(4)]
    assert "black or white" in said(look(tmp_path / "clipped", clipped))


def test_the_black_around_a_round_picture_is_no_darkness(tmp_path: Path) -> None:
    circle = np.zeros((72, 96), np.uint8)
    cv2.circle(circle, (48, 36), 30, 1, -1)
    findings = look(tmp_path, [np.clip(picture, 40, 240) * circle for picture in images(12)])
    assert findings.facts["clipped"] == 0
    assert findings.facts["brightness"] == pytest.approx(np.median(np.clip(images(1)[0], 40, 240)), abs=10)
    assert "dark" not in said(findings)


def test_without_or_with_a_wrong_calibration_it_still_looks(tmp_path: Path) -> None:
    write_video(tmp_path / "v.avi", images(6))
    findings = survey(tmp_path / "v.avi", SequenceSettings())
    assert findings.facts["camera"] is None
    assert "improvo calibrate" in said(findings)
    (tmp_path / "v.yaml").write_text(calibration_yaml(CAMERA.resized(192, 144)))
    assert "calibrated for 192x144 but the images are 96x72" in said(survey(tmp_path / "v.avi", SequenceSettings()))


def test_unreadable_frames_are_named(tmp_path: Path) -> None:
    write_tum(tmp_path, 6)
    (tmp_path / "rgb" / "000003.png").write_bytes(b"")
    findings = survey(tmp_path, SequenceSettings())
    assert findings.facts["unreadable"] == [str(tmp_path / "rgb" / "000003.png")]
    assert "cannot be read" in said(findings)


@pytest.mark.parametrize("calibrated", [True, False])
def test_pictures_that_a_list_names_and_that_are_not_there_are_counted(tmp_path: Path, calibrated: bool) -> None:
    write_tum(tmp_path, 12)
    assert not any("listed" in note for note in survey(tmp_path, SequenceSettings()).facts["notes"])
    if not calibrated:
        (tmp_path / "camera.yaml").unlink()
    for picture in sorted((tmp_path / "rgb").iterdir())[4:]:
        picture.unlink()
    facts = survey(tmp_path, SequenceSettings()).facts
    assert facts["notes"] == [f"{tmp_path}: 4 of 12 listed pictures are there"]
    assert (facts["camera"] is not None) == calibrated
    some = survey(tmp_path, SequenceSettings(end=4)).facts
    assert not some["notes"], "of the frames that are asked for"


def test_pictures_of_another_size_are_not_taken_for_damaged_ones(tmp_path: Path) -> None:
    pictures = images(6)
    findings = look(tmp_path, [*pictures[:5], pictures[5][:40]])
    assert findings.facts["unreadable_because"] == "is 96x40 in a recording of 96x72"
    problem = next(problem for problem in findings.problems if "cannot be read" in problem.what)
    assert problem.what.endswith("is 96x40 in a recording of 96x72")
    assert "all pictures in one size" in problem.advice


@pytest.mark.parametrize(
    ("copies", "advice"), [(2, "--stride 2 leaves most of them out"), (6, "a --stride leaves most of them out, larger")]
)
def test_a_stride_of_two_is_advised_only_where_it_helps(tmp_path: Path, copies: int, advice: str) -> None:
    pictures = [picture for picture in images(12 // copies) for _ in range(copies)]
    problem = next(p for p in look(tmp_path, pictures).problems if "show the same picture" in p.what)
    assert advice in problem.advice


def test_command_prints_text_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_tum(tmp_path, 6)
    assert main(["info", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "recognised as  tum" in text
    assert "6 of 6 frames" in text
    assert "nothing wrong" in text
    assert main(["info", str(tmp_path), "--json", "--stride", "2"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["frames"] == 3
    assert facts["problems"] == []
    assert main(["info", str(tmp_path / "none")]) == 2
    assert "no such file" in capsys.readouterr().err


def test_real_recordings(shared_data: Path) -> None:
    kitchen = survey(shared_data / "redkitchen", SequenceSettings())
    assert "show the same picture" in said(kitchen)  # about a tenth, as its README says
    assert "little texture" in said(survey(shared_data / "fr3-notexture", SequenceSettings(), samples=20))


def test_time_stamps_and_clocks_that_cannot_be(tmp_path: Path) -> None:
    slow = look(tmp_path / "slow", images(6), [150.5 * i for i in range(6)])
    assert "0.00664 frames per second over 752.5 s is not plausible" in slow.problems[0].what
    write_tum(tmp_path / "tum", 6)
    truth = tmp_path / "tum" / "groundtruth.txt"
    lines = [line.split() for line in truth.read_text().splitlines() if not line.startswith("#")]
    truth.write_text("".join(" ".join([f"{float(line[0]) + 3600:.6f}", *line[1:]]) + "\n" for line in lines))
    assert "no frame has ground truth: frames are from 1341836537.5" in said(
        survey(tmp_path / "tum", SequenceSettings())
    )


def test_the_real_fault_of_black_frames_comes_first(tmp_path: Path) -> None:
    findings = look(tmp_path, [np.full((72, 96), 1, np.uint8) for _ in range(10)])
    assert "very dark" in findings.problems[0].what
    assert "same picture" not in said(findings)
    assert "blurred" not in said(findings)


def test_what_never_moves_is_noticed(tmp_path: Path) -> None:
    pictures = [np.ascontiguousarray(p) for p in images(14)]
    for picture in pictures:
        picture[60:, :] = texture(9)[:12, :96]  # a bonnet
    findings = look(tmp_path / "overlay", pictures)
    assert findings.facts["still"] == pytest.approx(12 / 72, abs=0.05)
    assert "never changes while the rest does" in said(findings)
    assert look(tmp_path / "plain", images(14)).facts["still"] == 0.0


@pytest.mark.parametrize(
    ("numbers", "what"),
    [("90,91,20,36.5", "principal point"), ("90,130,47,36.5", "not square"), ("9,9,47,36.5", "few lenses")],
)
def test_implausible_cameras_are_noticed(tmp_path: Path, numbers: str, what: str) -> None:
    write_tum(tmp_path, 3)
    assert what in said(survey(tmp_path, SequenceSettings(camera=numbers)))


@pytest.mark.parametrize("kind", ["tum", "images"])
def test_a_bad_camera_argument_is_an_error_for_every_format(
    tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write_tum(tmp_path, 3) if kind == "tum" else write_images(tmp_path, images(3))
    (tmp_path / "own.yaml").write_text("fx: 1\n")
    assert main(["info", str(tmp_path), "--camera", str(tmp_path / "own.yaml")]) == 2
    assert "own.yaml: has no fy" in capsys.readouterr().err
    assert main(["info", str(tmp_path), "--camera", "90,91,47,36.5,-0.123456789,0,0,0"]) == 0
    assert "-0.123456789" in capsys.readouterr().out
