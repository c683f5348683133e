"""Collects what speaks for and against a segment while it runs, and judges it at its end."""

from __future__ import annotations

from improvo.geometry.camera import Camera
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.verdict.evidence import EvidenceCheck
from improvo.odometry.verdict.verdict import Verdict, judge
from improvo.odometry.view import View
from improvo.types import Float64


class SegmentJudge:
    """The evidence of one segment: its keyframes, and the alarms that do not end it.

    Args:
        camera: pinhole camera of the views.
        settings: of the odometry; `verdict` is used.
        camera_is_guess: its focal length is a guess.
    """

    def __init__(self, camera: Camera, settings: OdometrySettings, camera_is_guess: bool = False) -> None:
        self._settings = settings
        self._evidence = EvidenceCheck(camera, camera_is_guess)
        self._alarms: list[str] = []
        self._suspicions: list[str] = []
        self._suspected = 0

    def final(self, view: View, cam_from_world: Float64, xyz: Float64) -> None:
        """A view is final; keyframes are evidence.

        Args:
            view: of the segment, in temporal order.
            cam_from_world: (4, 4) its pose.
            xyz: (P, 3) the map as it is now.
        """
        if view.keyframe:
            self._evidence.add(view, cam_from_world, xyz)

    def alarm(self, words: str) -> None:
        """Something that makes the segment doubtful, whatever its path looks like; the same words count once."""
        if words not in self._alarms:
            self._alarms.append(words)

    def suspicion(self, words: str, times: int = 1) -> None:
        """Something that right segments show now and then, too; the same words count once.

        Args:
            words: plain.
            times: how often it was so, each of which makes a smaller error enough; of several, the largest counts. Zero
                tells it only.
        """
        self._suspected = max(self._suspected, times)
        if words not in self._suspicions:
            self._suspicions.append(words)

    def verdict(self, xyz: Float64) -> Verdict:
        """The verdict, now that the segment is over.

        Args:
            xyz: (P, 3) its points.
        """
        spread, limits = self._evidence.finish(xyz), self._settings.verdict
        return judge(spread, limits, tuple(self._alarms), tuple(self._suspicions), self._suspected)
