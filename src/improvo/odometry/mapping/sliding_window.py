"""The window of mode `robust`: the last frames, the keyframes before them, and what moves along with those."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from improvo.geometry import se3
from improvo.odometry.gates import LARGE_PART
from improvo.odometry.settings import WindowSettings
from improvo.odometry.view import View, common_tracks
from improvo.types import Float64

_KEYFRAME_MOTION = 0.05  # median motion since the last keyframe, as a share of the picture's width


class SlidingWindow:
    """Views with poses, from the oldest whose observations still count to the newest.

    Args:
        settings: its lengths, and what makes a keyframe.
        image_width: pixels.
    """

    def __init__(self, settings: WindowSettings, image_width: int) -> None:
        self._settings = settings
        self._image_width = image_width
        self._last_keyframe: View | None = None
        self.recent: list[View] = []  # the last consecutive views; free
        self._keyframes: list[View] = []  # older keyframes: the last ones are free, those before them fixed

    @property
    def newest(self) -> View:
        """The last view with a pose."""
        return self.recent[-1]

    @property
    def keyframes(self) -> list[View]:
        """Older keyframes, in temporal order; their observations still count."""
        return list(self._keyframes)

    @property
    def free(self) -> list[View]:
        """Views whose poses are adjusted, in temporal order."""
        return [*self._keyframes[-self._settings.keyframes :], *self.recent]

    def free_and_fixed(self) -> tuple[list[View], list[View]]:
        """Views whose poses are adjusted, and views that only lend their observations; one at least, as the gauge."""
        free = self.free
        fixed = self._keyframes[: -self._settings.keyframes][-self._settings.fixed :]
        return (free, fixed) if fixed else (free[1:], free[:1])

    def insert(self, views: list[View]) -> None:
        """Views that were lost before and have a pose now; they come before the next `add`, and are no keyframes."""
        self.recent.extend(views)

    def add(self, view: View) -> None:
        """The next view with a pose."""
        self.recent.append(view)
        self.choose_keyframe(view)

    def choose_keyframe(self, view: View) -> None:
        """A keyframe where the picture moved enough since the last one, or where its points are running out."""
        settings, last = self._settings, self._last_keyframe
        if last is not None:
            rows, rows_last = common_tracks(view, last)
            shared_points = np.isin(last.points[last.observed], view.points[view.observed])
            world = ~view.attached[rows]
            moved = np.linalg.norm(view.keypoints[rows[world]] - last.keypoints[rows_last[world]], axis=1)
            few_shared = len(shared_points) == 0 or shared_points.mean() < 1.0 - LARGE_PART
            far = len(moved) == 0 or np.median(moved) > _KEYFRAME_MOTION * self._image_width
            long_ago = view.frame_index - last.frame_index >= settings.recent
            if not (few_shared or far or long_ago):
                return
        view.keyframe = True
        self._last_keyframe = view

    def slide(self) -> None:
        """Recent views over the length leave it: a keyframe stays, another one moves along with the last keyframe."""
        while len(self.recent) > self._settings.recent:
            view = self.recent.pop(0)
            if view.keyframe:
                self._keyframes.append(view)
                continue
            keyframe = self._keyframes[-1]
            assert view.cam_from_world is not None
            assert keyframe.cam_from_world is not None
            keyframe.non_keyframes.append((view, view.cam_from_world @ se3.inverse(keyframe.cam_from_world)))

    def take_final(self) -> list[tuple[View, Float64]]:
        """Views that no adjustment can move any more, with their poses (4, 4); each is given once."""
        final: list[tuple[View, Float64]] = []
        for keyframe in self._keyframes[: -self._settings.keyframes]:
            if not keyframe.final:
                final.extend(_with_non_keyframes(keyframe))
                keyframe.final, keyframe.non_keyframes = True, []
        del self._keyframes[: -(self._settings.keyframes + self._settings.fixed)]
        for view, _ in final:
            view.image = None
        return final

    def remaining(self) -> Iterator[tuple[View, Float64]]:
        """Views that `take_final` has not given yet, with their poses as they are now."""
        for keyframe in self._keyframes:
            if not keyframe.final:
                yield from _with_non_keyframes(keyframe)
        for view in self.recent:
            assert view.cam_from_world is not None
            yield view, view.cam_from_world


def _with_non_keyframes(keyframe: View) -> Iterator[tuple[View, Float64]]:
    """A keyframe, and the views that move along with it."""
    assert keyframe.cam_from_world is not None
    yield keyframe, keyframe.cam_from_world
    for view, view_from_keyframe in keyframe.non_keyframes:
        yield view, view_from_keyframe @ keyframe.cam_from_world
