"""The look-ahead: frames in order, computed by one other thread where there is a core for it, errors in their turn."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from improvo.jobs import workers
from improvo.odometry.run.look_ahead import detected_ahead
from improvo.odometry.visual_odometry import MatchedFeatures
from improvo.types import Features, Frame


@pytest.fixture(params=["one core", "two cores"])
def cores(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    given(monkeypatch, 1 if request.param == "one core" else 2)


@pytest.fixture
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    given(monkeypatch, 2)


def given(monkeypatch: pytest.MonkeyPatch, cores: int, limit: str = "") -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", limit)
    monkeypatch.setattr(workers, "available_cores", lambda: cores)


def frames(count: int, read: list[int] | None = None, fails_at: int | None = None) -> Iterator[Frame]:
    for i in range(count):
        if i == fails_at:
            raise ValueError(f"frame {i} is damaged")
        if read is not None:
            read.append(i)
        yield Frame(i, i / 30.0, np.full((2, 2), i, np.uint8), f"{i}.png")


def detect(frame: Frame) -> Features:
    return Features(
        np.full((1, 2), frame.image[0, 0], np.float32), np.zeros((1, 4), np.float32), np.ones(1, np.float32)
    )


def match(features: Features) -> MatchedFeatures:
    return MatchedFeatures(features, np.zeros((1, 4), np.float32), None)


@pytest.mark.usefixtures("cores")
def test_frames_come_in_order_each_with_its_own_features() -> None:
    seen = list(detected_ahead(frames(20), detect, match))
    assert [each.frame.source_index for each in seen] == list(range(20))
    assert [each.matched.features.keypoints[0, 0] for each in seen] == list(range(20))
    assert all(min(each.reading, each.detecting, each.matching) >= 0.0 for each in seen)


@pytest.mark.usefixtures("cores")
def test_no_frames_at_all() -> None:
    assert list(detected_ahead([], detect, match)) == []


@pytest.mark.parametrize(
    ("cores", "limit", "elsewhere"), [(2, "", True), (2, "2", True), (8, "4,2", True), (2, "1", False), (1, "", False)]
)
def test_all_work_is_done_in_one_other_thread_unless_there_is_no_core_for_it(
    cores: int, limit: str, elsewhere: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    given(monkeypatch, cores, limit)
    threads = set()

    def noted(features: Features) -> MatchedFeatures:
        threads.add(threading.get_ident())
        return match(features)

    list(detected_ahead(frames(10), detect, noted))
    assert len(threads) == 1
    assert (threading.get_ident() not in threads) == elsewhere


@pytest.mark.usefixtures("two_cores")
def test_it_reads_no_more_than_a_few_frames_ahead() -> None:
    read: list[int] = []
    ahead = detected_ahead(frames(100, read), detect, match)
    next(ahead)
    time.sleep(0.1)
    assert len(read) <= 4
    ahead.close()


@pytest.mark.usefixtures("cores")
@pytest.mark.parametrize("fails_at", [0, 1, 5])
def test_an_error_comes_after_everything_before_it(fails_at: int) -> None:
    ahead = detected_ahead(frames(10, fails_at=fails_at), detect, match)
    assert [next(ahead).frame.source_index for _ in range(fails_at)] == list(range(fails_at))
    with pytest.raises(ValueError, match=f"frame {fails_at} is damaged"):
        next(ahead)


@pytest.mark.usefixtures("two_cores")
def test_leaving_early_leaves_no_thread() -> None:
    before = threading.active_count()
    for each in detected_ahead(frames(100), detect, match):
        if each.frame.source_index == 3:
            break
    deadline = time.monotonic() + 5.0
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert threading.active_count() == before
