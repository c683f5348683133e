"""A finished run that was moved, cut short or mixed with another: said with the file and what to do."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rendered_walk import write_walk

from improvo.cli.main import main
from improvo.errors import InputError
from improvo.odometry.run.run_folder import RunFolder
from improvo.odometry.run.run_json import why_no_pose
from improvo.stability.rule import IGNORE

FRAMES = 30


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walk") / "walk", frames=FRAMES, seed=3)


@pytest.fixture(scope="module")
def made(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "out"
    assert main(["run", str(walk), "-o", str(out), "--frontend", "orb", "--max-keypoints", "200", "--quiet"]) == 0
    return out


@pytest.fixture
def out(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "out"))


def change(out: Path, edit: Callable[[dict[str, Any]], object]) -> Path:
    """The run with another run.json."""
    report = json.loads((out / "run.json").read_text())
    edit(report)
    (out / "run.json").write_text(json.dumps(report))
    return out


def test_what_is_no_run(tmp_path: Path, walk: Path) -> None:
    with pytest.raises(InputError, match="no such folder; give the output folder of `improvo run`"):
        RunFolder(tmp_path / "missing")
    with pytest.raises(InputError, match=r"has no run\.json; give the output folder of `improvo run`"):
        RunFolder(walk)


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (lambda report: report["frames"].update(source_index=[3, 2, 1]), "its frames are out of order"),
        (lambda report: report["frames"].update(source_index=[1 << 50]), "its frames are out of order"),
        (lambda report: report["frames"].update(lost_frames=["x"]), "its frames are no numbers"),
        (lambda report: report["frames"].update(tracked=None), "its frames are no numbers"),
        (lambda report: report.update(camera=[]), "its camera or configuration has no names"),
        (lambda report: report.update(events=[{"kind": 3}]), "an event is of no kind"),
        (lambda report: report.pop("frames"), "has no `frames`"),
        (lambda report: report.update(input=3), r"run\.json: cannot be read"),
    ],
)
def test_a_report_that_somebody_changed(out: Path, edit: Callable[[dict[str, Any]], object], says: str) -> None:
    with pytest.raises(InputError, match=says) as error:
        RunFolder(change(out, edit))
    assert str(error.value).endswith("run `improvo run` again")
    assert "\n" not in str(error.value)


def test_a_camera_that_is_none(out: Path) -> None:
    with pytest.raises(InputError, match=r"run\.json: holds no camera .*; run `improvo run` again"):
        _ = RunFolder(change(out, lambda report: report["camera"].update(fx=-1.0))).camera
    with pytest.raises(InputError, match=r"run\.json: holds no camera"):
        _ = RunFolder(change(out, lambda report: report["camera"].update(colour="red"))).camera


def test_a_recording_that_is_gone_or_another_one(out: Path, walk: Path, tmp_path: Path) -> None:
    moved = change(out, lambda report: report["input"].update(path=str(tmp_path / "before")))
    with pytest.raises(InputError, match="the recording is not there any more; name it with --sequence PATH"):
        RunFolder(moved).image(0)
    picture = RunFolder(moved, walk).image(3)
    np.testing.assert_array_equal(picture, cv2.imread(str(walk / "000003.png"), cv2.IMREAD_GRAYSCALE))
    assert RunFolder(moved, walk).colour(3).shape == (*picture.shape, 3)
    other = tmp_path / "other"
    other.mkdir()
    for i in range(4):
        cv2.imwrite(str(other / f"{i}.png"), np.zeros((60, 80), np.uint8))
    (other / "camera.yaml").write_text("width: 80\nheight: 60\nfx: 65\nfy: 65\ncx: 39.5\ncy: 29.5\n")
    with pytest.raises(InputError, match="its frames have another size than those of the run; name the right one"):
        RunFolder(moved, other).image(0)
    short = write_walk(tmp_path / "short", frames=4, seed=3)
    with pytest.raises(InputError, match=r"has no frame 9; is it the recording?"):
        RunFolder(moved, short).image(9)
    for frame in (-1, FRAMES):
        with pytest.raises(InputError, match=f"has no frame {frame}; frames are 0 to {FRAMES - 1}"):
            RunFolder(moved, walk).image(frame)


def test_poses_that_do_not_belong_to_the_report(out: Path) -> None:
    path = out / "trajectory.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:-2]) + "\n")
    rows = sum(not line.startswith("#") for line in path.read_text().splitlines())
    with pytest.raises(InputError, match=rf"trajectory\.txt has {rows} poses and run\.json {rows + 2}; run again"):
        _ = RunFolder(out).frame_indices


@pytest.mark.parametrize("content", [b"", b"ply\n", b"ply\nformat ascii 1.0\nelement vertex 1\nend_header\n0 0 0\n"])
def test_a_map_that_is_none(out: Path, content: bytes) -> None:
    (out / "map.ply").write_bytes(content)
    with pytest.raises(InputError, match=r"map\.ply: is no map that improvo wrote; run `improvo run` again"):
        _ = RunFolder(out).map
    (out / "map.ply").unlink()
    with pytest.raises(InputError, match=r"map\.ply: cannot be read"):
        _ = RunFolder(out).map


def test_a_map_that_is_cut_short(out: Path) -> None:
    (out / "map.ply").write_bytes((out / "map.ply").read_bytes()[:-5])
    with pytest.raises(InputError, match=r"map\.ply: .*run `improvo run` again"):
        _ = RunFolder(out).map


def test_observations_of_frames_and_tracks(out: Path) -> None:
    """What pages draw: each track where it was seen, with its age and label."""
    folder = RunFolder(out)
    seen = folder.observations(9)
    assert len(seen) == len(folder.rows_at(9)) > 50
    born = folder.birth[folder.rows_at(9)]
    np.testing.assert_array_equal(seen.age, 9 - born)
    before = folder.rows_of(8, seen.track)
    np.testing.assert_array_equal(before >= 0, seen.age > 0)  # a track has no gaps
    known = before[before >= 0]
    np.testing.assert_array_equal(folder.tracks.track[known], seen.track[before >= 0])
    labels = dict(zip(folder.points.track.tolist(), folder.points.stability.tolist(), strict=True))
    assert seen.stability.tolist() == [labels.get(track, IGNORE) for track in seen.track.tolist()]


def test_a_run_without_poses_says_why_and_what_helps() -> None:
    frames = {"tracked": 0}
    turned = {"kind": "initialising", "detail": "too little parallax: a rotation explains the motion"}
    said = why_no_pose({"frames": frames, "events": [{"kind": "lost", "detail": "x"}, turned]})
    assert said is not None
    assert said.startswith("no frame has a pose: too little parallax")
    assert "move it sideways" in said
    far_apart = {"kind": "initialising", "detail": "too few tracks"}
    assert "give all frames of the video" in str(why_no_pose({"frames": frames, "events": [far_apart]}))
    empty = why_no_pose({"frames": frames, "events": []})
    assert empty is not None
    assert empty.startswith("no frame has a pose: the run ended before a map could start; ")
    assert why_no_pose({"frames": {"tracked": 3}, "events": []}) is None


# --- a second run into the same folder


def without_times(folder: Path) -> dict[str, bytes]:
    """All files but run.json, which tells how long things took."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name not in ("run.json", ".improvo.json")}


def words(walk: Path, out: Path, *more: str) -> list[str]:
    return ["run", str(walk), "-o", str(out), "--frontend", "orb", "--max-keypoints", "200", "--quiet", *more]


def test_a_second_run_that_fails_before_its_first_file_leaves_the_first_one(
    out: Path, walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, report = without_times(out), (out / "run.json").read_bytes()

    def bug(*_: object) -> None:
        raise RuntimeError("in the middle")

    with monkeypatch.context() as patch:
        patch.setattr("improvo.odometry.visual_odometry.VisualOdometry.finish", bug)
        with pytest.raises(RuntimeError, match="in the middle"):
            main(words(walk, out, "--end", "26"))
    assert without_times(out) == before
    assert (out / "run.json").read_bytes() == report


@pytest.mark.parametrize(
    "stopped_at", ["improvo.odometry.run.run_odometry.write_map", "improvo.labeling.labeler.write_json"]
)
def test_a_second_run_that_is_stopped_between_its_files_is_no_result(
    out: Path, walk: Path, monkeypatch: pytest.MonkeyPatch, stopped_at: str
) -> None:
    """Its tables with the run.json of the first, or labels that nobody has doubted yet, would be taken for one."""

    def stop(*_: object, **__: object) -> None:
        raise SystemExit("stopped")

    with monkeypatch.context() as patch:
        patch.setattr(stopped_at, stop)
        with pytest.raises(SystemExit):
            main(words(walk, out, "--end", "26"))
    with pytest.raises(InputError, match=r"has no run\.json; give the output folder of `improvo run`"):
        RunFolder(out)
    assert main(words(walk, out, "--end", "26")) == 0
    assert RunFolder(out).frames == 26


def test_a_second_run_takes_away_what_it_does_not_write_again(out: Path, walk: Path, tmp_path: Path) -> None:
    """Depth, a page, pictures and a found camera of the first run are not those of the second."""
    shown, own = ("map.png", "tracks.gif", "labels/labels_000004.png"), ("notes.txt", "mine.png")
    for name in (*shown, *own):
        (out / "pictures" / name).parent.mkdir(parents=True, exist_ok=True)
        (out / "pictures" / name).write_text("of the first run")
    for name in ("depth.zip", "dense.ply", "report.html", "camera.yaml", "camera.json"):
        (out / name).write_text("of the first run")
    assert main(words(walk, out)) == 0
    left = {path.name for path in out.iterdir()}
    assert not {"depth.zip", "dense.ply", "report.html", "camera.yaml", "camera.json"} & left
    assert sorted(path.name for path in (out / "pictures").rglob("*") if path.is_file()) == ["mine.png", "notes.txt"]
    shutil.rmtree(out / "pictures")
    (out / "camera.yaml").write_text((walk / "camera.yaml").read_text())  # the user's own
    assert main(words(walk, out)) == 0
    assert (out / "camera.yaml").is_file()
    (out / "camera.json").write_text("{}")
    assert main(words(walk, out, "--camera", str(out / "camera.yaml"))) == 0
    assert (out / "camera.json").is_file()


def test_a_file_for_rerun_that_does_not_fit_costs_no_results(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rerun = pytest.importorskip("rerun", reason="needs rerun: pip install 'improvo[view]'")

    def full(*_: object, **__: object) -> None:
        raise RuntimeError("File-writer thread shut down prematurely")

    monkeypatch.setattr(rerun.RecordingStream, "flush", full)
    path = tmp_path / "watch.rrd"
    assert main(words(walk, tmp_path / "out", "--save", str(path))) == 2
    assert capsys.readouterr().err == f"improvo: {path}: cannot be written (is the disk full?); choose another\n"
    assert RunFolder(tmp_path / "out").frames == FRAMES
    assert [entry.name for entry in tmp_path.iterdir()] == ["out"]


def test_a_run_with_relative_paths_is_found_from_any_folder(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Recording, camera and mask as they are typed in the folder where they lie; the pictures are made elsewhere."""
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    shutil.copytree(walk, "walk")
    Path("walk/camera.yaml").rename("own.yaml")
    cv2.imwrite("mask.png", np.full((240, 320), 255, np.uint8))
    few = ["--max-frames", "12", "--frontend", "orb", "--max-keypoints", "200", "--quiet"]
    assert main(["run", "walk", "-o", "out", "--camera", "own.yaml", "--mask", "mask.png", *few]) in (0, 3)
    monkeypatch.chdir(tmp_path / "elsewhere")
    run = RunFolder(tmp_path / "here" / "out")
    assert run.image(3).shape == (240, 320)
    assert run.sequence.camera.fx == 260.0
