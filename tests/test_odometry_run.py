"""A run from frames to files: what a visualizer is shown, and what run.json says where nothing was measured."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered_walk import write_walk

from improvo.errors import InputError
from improvo.frontend.registry import frontend_from
from improvo.geometry.camera import Camera
from improvo.odometry.run.run_folder import RunFolder
from improvo.odometry.run.run_odometry import run_odometry
from improvo.odometry.run_settings import FrontendSettings, RunSettings
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.view import View
from improvo.odometry.visual_odometry import TrackedFrame
from improvo.sequences import open_sequence
from improvo.types import Features, Float64, Frame, UInt8

ORB = FrontendSettings(name="orb", max_keypoints=400)


class Watcher:
    """A visualizer that remembers."""

    def __init__(self) -> None:
        self.told: list[str] = []
        self.shown: list[tuple[int, int, int]] = []  # frame_index, segment, world
        self.points = 0

    def begin(self, camera: Camera) -> None:
        self.told.append("begin")

    def show(self, frame: Frame, view: View, points: Float64) -> None:
        self.told.append("show")
        self.shown.append((view.frame_index, view.segment, view.world))
        if view.cam_from_world is not None:
            assert view.points[view.observed].max(initial=-1) < len(points)

    def end(self) -> None:
        self.told.append("end")


@pytest.fixture
def with_a_dark_frame(tmp_path: Path) -> Path:
    """A walk of 24 images, of which number 12 is black."""
    walk = write_walk(tmp_path / "walk", frames=24)
    dark = sorted(walk.glob("*.png"))[12]
    cv2.imwrite(str(dark), np.zeros_like(cv2.imread(str(dark), cv2.IMREAD_GRAYSCALE)))
    return walk


def test_a_visualizer_sees_every_frame_with_its_segment_and_world(with_a_dark_frame: Path, tmp_path: Path) -> None:
    watcher, tracked = Watcher(), list[TrackedFrame]()
    settings = RunSettings(frontend=ORB, odometry=OdometrySettings(mode="paper"))
    run_odometry(
        open_sequence(with_a_dark_frame), tmp_path / "out", settings, visualizer=watcher, progress=tracked.append
    )
    assert watcher.told == ["begin", *["show"] * 24, "end"]
    assert [frame_index for frame_index, _, _ in watcher.shown] == list(range(24))
    segments = [segment for _, segment, _ in watcher.shown]
    assert segments == [frame.segment for frame in tracked]
    assert segments == RunFolder(tmp_path / "out").trajectory.segment.tolist()
    worlds = [world for _, _, world in watcher.shown]
    assert [a != b for a, b in itertools.pairwise(segments)] == [a != b for a, b in itertools.pairwise(worlds)]


def test_a_visualizer_is_told_of_the_end_also_after_an_error(with_a_dark_frame: Path, tmp_path: Path) -> None:
    """A recording of Rerun is whole only then."""

    class Broken:
        name = "broken"

        def __init__(self) -> None:
            self.frames = 0

        def __call__(self, image: UInt8) -> Features:
            self.frames += 1
            if self.frames > 5:
                raise InputError("the frontend is broken")
            return frontend_from(ORB)(image)

    watcher = Watcher()
    with pytest.raises(InputError, match="is broken"):
        run_odometry(
            open_sequence(with_a_dark_frame),
            tmp_path / "out",
            RunSettings(),
            frontend=Broken(),
            visualizer=watcher,
        )
    assert watcher.told[0] == "begin"
    assert watcher.told[-1] == "end"
    assert watcher.told.count("end") == 1


def test_pictures_of_other_sizes_are_named_where_too_few_are_left(tmp_path: Path) -> None:
    walk = write_walk(tmp_path / "walk", frames=4)
    for number in range(1, 4):
        file = walk / f"{number:06d}.png"
        assert cv2.imwrite(str(file), cv2.imread(str(file))[:-number])
    with pytest.raises(InputError, match=r"only 1 of its .*000001\.png is \d+x\d+ in a recording of .*of one size"):
        run_odometry(open_sequence(walk), tmp_path / "out", RunSettings(frontend=FrontendSettings(name="orb")))


def test_a_segment_in_which_nothing_was_measured_has_no_error(with_a_dark_frame: Path, tmp_path: Path) -> None:
    settings = RunSettings(frontend=ORB, odometry=OdometrySettings(mode="paper"))
    run_odometry(open_sequence(with_a_dark_frame), tmp_path / "out", settings)
    segments = json.loads((tmp_path / "out" / "run.json").read_text())["segments"]
    dark = next(segment for segment in segments if segment["first"] == 12)
    assert dark["frames"] == 1
    assert dark["mean_error"] is None
    assert all(segment["mean_error"] is not None for segment in segments if segment["frames"] > 1)


def test_a_run_written_under_former_names_is_read(tmp_path: Path) -> None:
    report = {
        "input": {"path": "walk"},
        "frames": {"source_index": [0, 1], "tracked": 0, "lost_frames": [0, 1]},
        "configuration": {"odometry": {"initialisation": "paper", "matching": {"max_stray": 0.1}}},
        "events": [{"position": 1, "kind": "waiting", "detail": "too few matches"}],
    }
    (tmp_path / "run.json").write_text(json.dumps(report))
    run = RunFolder(tmp_path)
    assert run.report["events"] == [{"frame_index": 1, "kind": "initialising", "detail": "too few matches"}]
    assert run.report["configuration"] == {"odometry": {"mode": "paper", "matching": {"flow_outlier_limit": 0.1}}}
