"""Look-ahead: a second thread reads, detects and matches while the backend adjusts, where there is a core for it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from improvo.jobs.interrupts import interrupts_wait
from improvo.jobs.workers import has_one_core
from improvo.odometry.alarms.world_keypoints import AHEAD
from improvo.odometry.visual_odometry import MatchedFeatures
from improvo.types import Features, Frame


@dataclass(frozen=True)
class DetectedFrame:
    """A frame with its matched features, and the seconds that they took."""

    frame: Frame
    matched: MatchedFeatures
    reading: float  # seconds
    detecting: float  # seconds
    matching: float  # seconds


def detected_ahead(
    frames: Iterable[Frame], detect: Callable[[Frame], Features], match: Callable[[Features], MatchedFeatures]
) -> Iterator[DetectedFrame]:
    """The frames in order with their features and matches, computed ahead by one other thread.

    With one core they are computed when their turn comes, by the thread that asks: a second one would only make both
    wait. An error of a frame is raised when its turn comes, so that everything before it is processed.

    Args:
        frames: read where they are detected.
        detect: features of a frame.
        match: matches a frame's features with those of the frame before; called in order.
    """
    iterator = iter(frames)

    def next_frame() -> DetectedFrame | None:
        start = time.perf_counter()
        frame = next(iterator, None)
        if frame is None:
            return None
        read = time.perf_counter()
        features = detect(frame)
        detected = time.perf_counter()
        matched = match(features)
        return DetectedFrame(frame, matched, read - start, detected - read, time.perf_counter() - detected)

    if has_one_core():
        while True:
            with interrupts_wait():
                here = next_frame()
            if here is None:
                return
            yield here
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="detect") as worker:
        pending: list[Future[DetectedFrame | None]] = [worker.submit(next_frame) for _ in range(AHEAD)]
        try:
            while (detected := pending.pop(0).result()) is not None:
                pending.append(worker.submit(next_frame))
                yield detected
        finally:
            for future in pending:
                future.cancel()
