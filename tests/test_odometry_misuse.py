"""`VisualOdometry` in a process that lives for days: what it cannot use is said, and leaves no trace."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rendered_walk import write_walk

import improvo
from improvo.errors import InputError
from improvo.odometry.visual_odometry import VisualOdometry
from improvo.sequences import Sequence
from improvo.types import Features, Frame

SIZE = (96, 72)
GOOD = np.random.default_rng(0).integers(0, 255, (72, 96)).astype(np.uint8)
BAD: dict[str, tuple[Any, str]] = {
    "another size": (np.zeros((48, 64), np.uint8), "64x48"),
    "turned": (GOOD.T, "72x96"),
    "empty": (np.zeros((0, 0), np.uint8), "0x0"),
    "one pixel": (np.zeros((1, 1), np.uint8), "1x1"),
    "float": (GOOD / 255.0, "float64"),
    "nan": (np.full((72, 96), np.nan, np.float32), "float32"),
    "sixteen bits": (GOOD.astype(np.uint16), "uint16"),
    "bool": (GOOD > 9, "bool"),
    "four channels": (np.dstack([GOOD] * 4), "(72, 96, 4)"),
    "a row": (GOOD[0], "(96,)"),
    "no array": (GOOD.tolist(), "list"),
    "nothing": (None, "NoneType"),
}


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    return improvo.open_sequence(write_walk(tmp_path_factory.mktemp("walk") / "room", frames=30))


def odometry(frontend: str = "orb") -> VisualOdometry:
    camera = improvo.Camera(*SIZE, 90.0, 90.0, 47.5, 35.5)
    return VisualOdometry(improvo.load_frontend(frontend, 200), camera)


def frame(image: Any, time: float = 0.0) -> Frame:
    return Frame(0, time, image, "somewhere.png")


@pytest.mark.parametrize("name", BAD)
@pytest.mark.parametrize("frontend", ["orb", "superpoint-small"])
def test_a_picture_that_cannot_be_used(name: str, frontend: str) -> None:
    image, shown = BAD[name]
    running = odometry(frontend)
    with pytest.raises(InputError) as error:
        running.track(frame(image))
    message = str(error.value)
    assert shown in message
    assert "uint8 pictures of 96x72" in message
    assert "somewhere.png" in message
    assert running.track(frame(GOOD)).frame_index == 0


@pytest.mark.parametrize("name", ["orb", "sift", "akaze", "superpoint-small"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (3, 3), (8, 8), (33, 70)])
def test_a_frontend_finds_nothing_in_a_tiny_picture(name: str, shape: tuple[int, int]) -> None:
    features = improvo.load_frontend(name, 50)(np.zeros(shape, np.uint8))
    assert features.keypoints.shape[1] == 2


@pytest.mark.parametrize("image", [GOOD / 255.0, GOOD > 9, GOOD[:0], np.dstack([GOOD] * 2)])
def test_a_classical_frontend_says_what_it_reads(image: Any) -> None:
    with pytest.raises(InputError, match="image of"):
        improvo.load_frontend("orb")(image)


def test_a_refused_frame_changes_no_later_pose(walk: Sequence) -> None:
    frames = list(walk)
    plain, disturbed = (VisualOdometry(improvo.load_frontend("orb", 400), walk.camera) for _ in range(2))
    for number, one in enumerate(frames):
        plain.track(one)
        if number % 3 == 1:
            with pytest.raises(InputError):
                disturbed.track(frame(one.image[:-8]))
            for time in (float("nan"), float("-inf"), "1", None, 10**400):
                with pytest.raises(InputError, match="finite time in seconds"):
                    disturbed.track(frame(one.image, time=time))  # type: ignore[arg-type]
            for time in (frames[number - 1].time, frames[number - 1].time - 1):
                with pytest.raises(InputError, match=r"the frame before was at .*; times of frames increase"):
                    disturbed.track(frame(one.image, time=time))
        disturbed.track(one)
    for running in (plain, disturbed):
        running.finish()
    np.testing.assert_array_equal(plain.trajectory.world_from_cam, disturbed.trajectory.world_from_cam)
    assert plain.trajectory.valid.any()


def test_features_that_do_not_fit_are_refused_and_forgotten() -> None:
    points, descriptors = np.ones((3, 2), np.float32), np.eye(3, 8, dtype=np.float32)
    running = odometry()
    good = Features(points, descriptors, np.ones(3, np.float32))
    running.track_features(good, 0.0)
    for bad in (
        Features(points, descriptors[:2], np.ones(3, np.float32)),
        Features(points[:, :1], descriptors, np.ones(3, np.float32)),
        Features(points * np.float32("nan"), descriptors, np.ones(3, np.float32)),
        Features(points, descriptors[:, :4], np.ones(3, np.float32)),
    ):
        with pytest.raises(InputError, match="features: "):
            running.track_features(bad, 1.0)
    for time in (0.0, -1.0):
        with pytest.raises(InputError, match="times of frames increase"):
            running.track_features(good, time)
    assert running.track_features(good, 1.0).frame_index == 1
    matched = running.match(good)
    with pytest.raises(InputError, match="times of frames increase"):
        running.track_matched(matched, 1.0)
    assert running.track_matched(matched, 2.0).frame_index == 2


def test_after_the_end_every_way_in_is_closed() -> None:
    running = odometry()
    running.track(frame(GOOD))
    matched = running.match(Features(np.ones((1, 2), np.float32), np.ones((1, 32), np.uint8), np.ones(1, np.float32)))
    running.finish()
    for call in (lambda: running.track(frame(GOOD)), lambda: running.track_matched(matched, 1.0)):
        with pytest.raises(RuntimeError, match="has finished"):
            call()


def test_another_thread_is_told_so() -> None:
    within, leave = threading.Event(), threading.Event()

    class Slow:
        name = "slow"

        def __call__(self, image: Any) -> Features:
            within.set()
            leave.wait(10)
            return Features(np.zeros((0, 2), np.float32), np.zeros((0, 8), np.float32), np.zeros(0, np.float32))

    running = VisualOdometry(Slow(), improvo.Camera(*SIZE, 90.0, 90.0, 47.5, 35.5))
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(running.track, frame(GOOD))
        assert within.wait(10)
        with pytest.raises(RuntimeError, match="another thread"):
            running.track(frame(GOOD, 1.0))
        leave.set()
        assert first.result().frame_index == 0
    assert running.track(frame(GOOD, 1.0)).frame_index == 1


def test_several_threads_share_a_network() -> None:
    frontend = improvo.load_frontend("superpoint-small", 100)
    pictures = [np.roll(GOOD, 5 * shift, axis=1) for shift in range(4)]
    alone = [frontend(picture) for picture in pictures]
    with ThreadPoolExecutor(4) as pool:
        for row, found in enumerate(pool.map(frontend, pictures * 6)):
            np.testing.assert_array_equal(found.keypoints, alone[row % 4].keypoints)
            np.testing.assert_array_equal(found.descriptors, alone[row % 4].descriptors)


def test_pictures_of_many_sizes_do_not_pile_up() -> None:
    frontend: Any = improvo.load_frontend("superpoint-small", 50)
    for side in range(64, 128, 8):
        frontend(GOOD[:, :64].repeat(2, axis=1)[:64, :side])
    assert len(frontend.runtime._compiled) <= 4


def test_many_instances_leave_nothing_of_each_other(walk: Sequence) -> None:
    frontend = improvo.load_frontend("orb", 300)
    frames = list(walk)
    ends = []
    for _ in range(3):
        with VisualOdometry(frontend, walk.camera) as running:
            for one in frames:
                running.track(one)
        ends.append(running.trajectory.world_from_cam)
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_array_equal(ends[0], ends[2])


def test_no_thread_is_left_behind(walk: Sequence, tmp_path: Path) -> None:
    before = threading.active_count()
    improvo.run(walk.path, tmp_path / "out", improvo.RunSettings(frontend=improvo.FrontendSettings("orb", 200)))
    assert threading.active_count() <= before + 1  # tqdm keeps a monitor
