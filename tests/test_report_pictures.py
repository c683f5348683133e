"""The pictures show what their captions say."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from improvo.cli.main import main
from improvo.geometry.se3 import rigid, so3_exp
from improvo.odometry.run.run_folder import RunFolder
from improvo.report.canvas import Canvas, captioned
from improvo.report.map_picture import map_png
from improvo.report.overhead import overhead_axes, robust_limits
from improvo.report.page_data import pixel_parts
from improvo.report.palettes import PALETTES
from improvo.report.sheets import write_video
from improvo.report.stability_picture import suppressed_regions
from improvo.report.track_pictures import TrackPictureSettings, paint_labels, paint_tracks
from improvo.stability.rule import STABLE
from improvo.types import Float64


def read(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path))
    assert picture is not None
    return picture[..., ::-1]


def looking_down(yaw_deg: Float64, pitch_deg: float) -> Float64:
    """(N, 4, 4) level cameras in a world whose z is up, turned by yaw and looking down by pitch."""
    upright = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # camera x = right, y = down, z = ahead (world y)
    yaw = so3_exp(np.radians(yaw_deg)[:, None] * np.array([0.0, 0, 1]))
    pitch = so3_exp(np.radians(-pitch_deg) * np.array([1.0, 0, 0]))
    return rigid(yaw @ upright @ pitch, np.zeros((len(yaw_deg), 3)))


@pytest.mark.parametrize("pitch_deg", [0.0, 40.0, 75.0])
def test_down_is_found_however_far_the_camera_looks_down(pitch_deg: float) -> None:
    axes = overhead_axes(looking_down(np.linspace(-60, 60, 20), pitch_deg))
    assert axes.down @ [0, 0, -1] > np.cos(np.radians(4.0))
    assert axes.forward @ axes.down == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(np.cross(axes.right, axes.forward), -axes.down, atol=1e-9)


def test_ahead_of_the_first_camera_is_up_in_the_picture_and_its_right_is_right() -> None:
    axes = overhead_axes(np.eye(4)[None])
    np.testing.assert_allclose(axes.project(np.array([[0.0, 0, 3], [2.0, 0, 0]])), [[0, 3], [2, 0]], atol=1e-9)


def test_a_few_far_points_do_not_shrink_the_map() -> None:
    rng = np.random.default_rng(0)
    path = np.linspace([0, 0], [4, 0], 50)
    points = np.concatenate([rng.uniform(-3, 6, (1000, 2)), [[1e4, 0], [0, -1e5]]])
    low, high = robust_limits(path, points)
    assert (low < path.min(axis=0)).all()
    assert (high > path.max(axis=0)).all()
    assert (high - low).max() < 15
    inside = ((points > low) & (points < high)).all(axis=1)
    assert inside.mean() > 0.85


def test_map_has_white_points_a_jet_trajectory_and_a_black_last_window(finished_run: Path, tmp_path: Path) -> None:
    assert main(["show", "map", str(finished_run), "-o", str(tmp_path / "map.png"), "--last", "8"]) == 0
    picture = read(tmp_path / "map.png").astype(int)
    drawn = picture[:, : int(0.85 * picture.shape[1])]  # without the legend's ramp
    red, green, blue = drawn[..., 0], drawn[..., 1], drawn[..., 2]
    assert ((blue > 180) & (red < 60) & (green < 120)).sum() > 50, "no blue beginning"
    assert ((green > 180) & (blue > 60) & (red < 200) & (abs(red - green) > 40)).sum() > 20, "no middle of the ramp"
    assert (drawn.max(axis=-1) < 40).sum() > 100, "no black last window"
    assert ((drawn.min(axis=-1) > 200)[100:-100]).sum() > 500, "no white points"


def test_the_axes_of_a_map_begin_at_the_first_camera(finished_run: Path) -> None:
    """Wherever its world does: after a start that needed some frames, or with the poses of another system."""
    usual, moved = RunFolder(finished_run), RunFolder(finished_run)
    offset = np.array([100.0, -20.0, 7.0])
    poses = usual.trajectory.world_from_cam.copy()
    poses[:, :3, 3] += offset
    vars(moved)["trajectory"] = replace(usual.trajectory, world_from_cam=poses)
    vars(moved)["map"] = replace(usual.map, xyz=usual.map.xyz + offset)
    pictures = [
        cv2.imdecode(np.frombuffer(map_png(run), np.uint8), cv2.IMREAD_COLOR).astype(int) for run in (usual, moved)
    ]
    assert pictures[0].shape == pictures[1].shape
    assert np.abs(pictures[0] - pictures[1]).mean() < 0.5


@pytest.mark.parametrize("size", [(320, 240), (5312, 2988), (3000, 8192), (16384, 16384)])
def test_points_of_wide_pictures_fit_into_two_bytes(size: tuple[int, int]) -> None:
    parts = pixel_parts(*size)
    assert 1 <= parts <= 16
    assert parts * (max(size) - 0.5) <= 65535.5
    assert parts == 16 or (parts + 1) * max(size) > 65536


@pytest.mark.parametrize("scale_to", [64, 256])
def test_dots_stand_on_the_centre_of_their_pixel(scale_to: int) -> None:
    canvas = Canvas(np.zeros((48, 64), np.uint8), width=scale_to)
    canvas.dots(np.array([[10.0, 20.0]]), np.array([[255, 0, 0]], np.uint8), radius=2.0)
    rows, columns = np.nonzero(canvas.rgb[..., 0] > 100)
    centre = np.array([columns.mean(), rows.mean()])
    np.testing.assert_allclose((centre + 0.5) / canvas.scale - 0.5, [10.0, 20.0], atol=0.15)


@pytest.mark.parametrize("name", ["paper", "colour-blind"])
def test_stable_points_have_their_colour(finished_run: Path, name: str) -> None:
    run, colours = RunFolder(finished_run), PALETTES[name]
    picture = paint_labels(run, 15, TrackPictureSettings(palette=colours, width=run.camera.width))
    seen = run.observations(15)
    stable = seen.keypoints[seen.stability == STABLE]
    assert len(stable) > 20
    u, v = np.rint(stable).astype(int).T
    distance = np.abs(picture[v, u].astype(int) - np.array(colours.stable)).max(axis=1)
    assert (distance < 60).mean() > 0.8


def test_old_tracks_have_another_colour_than_new_ones(finished_run: Path) -> None:
    run = RunFolder(finished_run)
    picture = paint_tracks(run, 25, TrackPictureSettings(old=10, width=run.camera.width)).astype(int)
    seen = run.observations(25)
    assert (seen.age >= 10).sum() > 10
    old = np.rint(seen.keypoints[seen.age >= 10]).astype(int)
    new = np.rint(seen.keypoints[seen.age == 0]).astype(int)
    redness = picture[..., 0] - picture[..., 2]
    assert np.median(redness[old[:, 1], old[:, 0]]) > 60
    assert np.median(redness[new[:, 1], new[:, 0]]) < 0


def test_sheet_files_and_video_have_the_frames_asked_for(finished_run: Path, tmp_path: Path) -> None:
    show = ["show", "residuals", str(finished_run)]
    assert main([*show, "-o", str(tmp_path / "two.png"), "--frames", "3,20"]) == 0
    assert main([*show, "-o", str(tmp_path / "one.png"), "--frames", "1"]) == 0
    one, two = read(tmp_path / "one.png"), read(tmp_path / "two.png")
    assert two.size > 1.9 * one.size
    assert main([*show, "-o", str(tmp_path), "--frames", "3,20", "--each"]) == 0
    assert {p.name for p in (tmp_path / "residuals").iterdir()} == {"residuals_000003.png", "residuals_000020.png"}
    assert main([*show, "-o", str(tmp_path / "all.mp4"), "--frames", "0,1,2,3,4", "--video"]) == 0
    video = cv2.VideoCapture(str(tmp_path / "all.mp4"))
    read_back = 0
    while video.read()[0]:
        read_back += 1
    assert read_back == 5
    assert main([*show, "-o", str(tmp_path / "some.webm"), "--frames", "0,1,2", "--video-width", "160"]) == 0
    assert cv2.VideoCapture(str(tmp_path / "some.webm")).get(cv2.CAP_PROP_FRAME_WIDTH) == 160
    for name in ("some.webp", "some.gif"):
        assert main([*show, "-o", str(tmp_path / name), "--frames", "0,1,2", "--video-width", "160"]) == 0
        with Image.open(tmp_path / name) as moving:
            assert (moving.n_frames, moving.size[0]) == (3, 160)


def test_video_keeps_its_colours(tmp_path: Path) -> None:
    red = np.zeros((64, 96, 3), np.uint8)
    red[..., 0] = 220
    write_video(tmp_path / "red.mp4", [red] * 4, fps=10)
    ok, frame = cv2.VideoCapture(str(tmp_path / "red.mp4")).read()
    assert ok
    np.testing.assert_allclose(frame.reshape(-1, 3).mean(axis=0), [0, 0, 220], atol=25)


def test_a_frame_that_cannot_be_read_is_left_out_unless_it_was_asked_for(
    finished_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    walk = Path(shutil.copytree(finished_run.parent / "walk", tmp_path / "walk"))
    (walk / "000007.png").write_bytes(b"\x89PNG broken")
    place, video = ["--sequence", str(walk)], tmp_path / "tracks.mp4"
    assert main(["show", "tracks", str(finished_run), *place, "-o", str(video)]) == 0
    assert "without 1 frame: " in capsys.readouterr().out
    assert cv2.VideoCapture(str(video)).get(cv2.CAP_PROP_FRAME_COUNT) == 29
    each = ["--each", "--frames", "all", "-o", str(tmp_path / "each")]
    assert main(["show", "labels", str(finished_run), *place, *each]) == 0
    names = {path.name for path in (tmp_path / "each" / "labels").iterdir()}
    assert names == {f"labels_{number:06d}.png" for number in range(30) if number != 7}
    capsys.readouterr()
    for frames in ("5,7", "7,"):
        words = ["--frames", frames, "-o", str(tmp_path / "some.png")]
        assert main(["show", "tracks", str(finished_run), *place, *words]) == 2
        assert "000007.png: " in capsys.readouterr().err
    assert not (tmp_path / "some.png").exists()


@pytest.mark.parametrize("fps", [0.5, 15.0, 24.0, 30.0, 60.0, 119.88])
@pytest.mark.parametrize("suffix", [".gif", ".webp", ".mp4", ".webm"])
def test_a_moving_picture_lasts_as_long_as_it_should(tmp_path: Path, suffix: str, fps: float, capfd: Any) -> None:
    """A GIF counts in hundredths of a second, and browsers refuse to show one faster than every second of them."""
    path = tmp_path / f"moving{suffix}"
    write_video(path, (np.full((20, 32, 3), 40 * (number % 6), np.uint8) for number in range(24)), fps)
    assert capfd.readouterr().err == ""
    if suffix in (".mp4", ".webm"):
        video = cv2.VideoCapture(str(path))
        assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(fps, rel=0.001)
        assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 24
        return
    with Image.open(path) as image:
        durations = []
        for number in range(image.n_frames):
            image.seek(number)
            image.load()
            durations.append(image.info["duration"])
    assert sum(durations) == pytest.approx(24000 / fps, abs=20)
    assert min(durations) >= (20 if suffix == ".gif" else 0)


def test_a_recording_that_moved_is_named_with_its_mend(
    finished_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "out"
    shutil.copytree(finished_run, run)
    report = run / "run.json"
    report.write_text(report.read_text().replace(str(finished_run.parent / "walk"), str(tmp_path / "gone")))
    assert main(["show", "tracks", str(run)]) == 2
    assert "--sequence" in capsys.readouterr().err
    moved = ["--sequence", str(finished_run.parent / "walk"), "--frames", "1"]
    assert main(["show", "tracks", str(run), *moved]) == 0
    assert (run / "pictures" / "tracks.png").is_file()
    matches = ["matches", str(run), "--frontends", "orb", "--pair", "0,5", *moved[:2], "-o", str(tmp_path / "m.png")]
    assert main(["show", *matches]) == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["map", "nowhere"], "no such folder"),
        (["labels", "RUN", "--frames", "3,99"], "there is no frame 99"),
        (["labels", "RUN", "--frames", "many"], "--frames many"),
        (["labels", "RUN", "--each", "-o", "new.png"], "name a folder, or a video"),
        (["labels", "RUN", "-o", "new.mp4", "--video-width", "3"], "at least 16 pixels"),
        (["labels", "RUN", "--video-fps", "0"], "--video-fps 0: must be positive"),
        (["labels", "RUN", "--video-fps", "nan"], "--video-fps nan: must be positive"),
        (["map", "RUN", "--last", "0"], "--last 0: must be at least 1"),
        (["stability", "RUN", "--width", "32"], "--width: "),
        (["matches", "RUN", "--fov", "70"], "is a run, whose recording is read as it was then"),
        (["matches", "demo", "--sequence", "x"], "belongs to the folder of a run"),
        (["map", "RUN", "-o", "no/such/place.png"], "no folder"),
        (["accuracy", "RUN"], "pose.json"),
        (["stability", "RUN"], "no stability head"),
    ],
)
def test_bad_requests_are_one_line_with_the_mend(
    finished_run: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    capsys.readouterr()
    assert main(["show", *(str(finished_run) if word == "RUN" else word for word in words)]) == 2
    message = capsys.readouterr().err.strip().splitlines()
    assert len(message) == 1
    assert said in message[0]


def test_a_pair_is_named_by_frames_or_by_the_time_between_them() -> None:
    from improvo.cli.show_recording import _pair
    from improvo.errors import ConfigError, InputError
    from improvo.sequences import open_sequence
    from improvo.simulation import bundled_sequence

    sequence = open_sequence(bundled_sequence())  # 30 a second
    assert _pair("3,40", sequence) == [3, 40]
    assert _pair("3,+5", sequence) == [3, 8]
    assert _pair("10,+1.5s", sequence) == [10, 55]
    for wrong in ("3", "3,", "a,4", "3,+s", "3,4,5", "3,+x", "3,+nans", "3,+infs", "3,+-1s", "3,+-5", "3,+0", "3,+0s"):
        with pytest.raises((InputError, ConfigError), match=re.escape(f"{wrong.split(',')[0]}")):
            _pair(wrong, sequence)
    with pytest.raises(ConfigError, match="no frame 163"):
        _pair("13,+5s", sequence)


def test_a_second_later_is_one_whatever_the_rate_is_there(tmp_path: Path) -> None:
    """Of a recording of 10 frames a second that lost two seconds after its frame 4."""
    from improvo.cli.show_recording import _pair
    from improvo.sequences import open_sequence

    folder = tmp_path / "rgb"
    folder.mkdir()
    times = np.concatenate([np.arange(5), np.arange(25, 45)]) / 10
    for number in range(len(times)):
        cv2.imwrite(str(folder / f"{number}.png"), np.full((24, 32), number, np.uint8))
    lines = [f"{time:.3f} rgb/{number}.png\n" for number, time in enumerate(times)]
    (tmp_path / "rgb.txt").write_text("".join(lines))
    sequence = open_sequence(tmp_path, camera="30,30,16,12")
    assert _pair("2,+1s", sequence) == [2, 4]  # 0.4 s is nearer to 1.2 than 2.5
    assert _pair("3,+1.5s", sequence) == [3, 5]
    assert _pair("5,+1s", sequence) == [5, 15]
    assert _pair("0,+0.01s", sequence) == [0, 1]


@pytest.mark.parametrize("width", [40, 160, 320, 640, 1280, 1920])
@pytest.mark.parametrize(
    "words", ["short", "frame 10, superpoint-vo: 357 stable keypoints (white), circled: 1", "w" * 400]
)
def test_a_caption_leaves_the_legend_alone(width: int, words: str) -> None:
    legend = (PALETTES["paper"].ramp_strip(), "stable", "unstable")
    picture = np.zeros((20, width, 3), np.uint8)
    bare, with_words = captioned(picture, "", legend), captioned(picture, words, legend)
    assert bare.shape == with_words.shape
    written = np.flatnonzero((bare != with_words).any(axis=(0, 2)))
    of_legend = np.flatnonzero((bare[20:] != 24).any(axis=(0, 2)))
    assert len(written) > 0 or width == 40
    assert (len(of_legend) > 0) == (width >= 320)
    if len(of_legend) and len(written):
        assert written.max() + 4 < of_legend.min()
    assert (with_words[:, -4:] == bare[:, -4:]).all()


def test_suppressed_regions_are_where_most_suppressed_points_are() -> None:
    rng = np.random.default_rng(0)
    cluster = rng.normal([50, 40], 5, (12, 2))
    alone = np.array([[150.0, 20.0], [20.0, 110.0]])
    centres, radii = suppressed_regions(np.concatenate([alone, cluster]).astype(np.float32), (120, 160))
    assert len(centres) == 1
    assert np.linalg.norm(centres[0] - [50, 40]) < 5
    assert (np.linalg.norm(cluster - centres[0], axis=1) < radii[0]).all()
