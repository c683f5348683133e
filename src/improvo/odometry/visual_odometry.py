"""The visual odometry loop: detect, match, extend tracks, optimise the window, slide."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from improvo.frontend import Frontend
from improvo.geometry.camera import Camera
from improvo.odometry.journal import Event, FinalView, Journal, Segment
from improvo.odometry.paper import PaperMapper
from improvo.odometry.robust import RobustMapper
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.view import View
from improvo.tracking.connect import TrackChain
from improvo.tracking.matching import distance_threshold, match_units, unit_descriptors, without_flow_outliers
from improvo.types import Features, Float32, Float64, Frame, Int64, SparseMap, Trajectory


@dataclass(frozen=True)
class MatchedFeatures:
    """Features of a frame, matched with the frame before."""

    features: Features
    descriptors: Float32  # (N, D) unit vectors
    matches: Int64 | None  # (K, 2) rows of the frame before and of this one; None for the first frame


class VisualOdometry:
    """Monocular visual odometry (the whole paper but its training), up to scale.

    Args:
        frontend: gives the features of an image.
        camera: pinhole camera of the frames.
        settings: all numbers.
        use_stability: weigh observations with the frontend's stability (w_ij), or with 1.
        on_final: called with each frame that nothing can change any more.
    """

    def __init__(
        self,
        frontend: Frontend,
        camera: Camera,
        settings: OdometrySettings | None = None,
        use_stability: bool = True,
        on_final: Callable[[FinalView], None] | None = None,
    ) -> None:
        self._frontend = frontend
        self._camera = camera
        self._settings = settings or OdometrySettings()
        self._use_stability = use_stability
        self._journal = Journal(camera, on_final)
        self._chain = TrackChain()
        self._previous: View | None = None
        self._matched_before: tuple[Float32, Float32] | None = None  # keypoints, unit descriptors of the last `match`
        self._mapper: RobustMapper | PaperMapper | None = None
        self._count = 0

    def track(self, frame: Frame) -> View:
        """Process the next frame; its view carries the pose found so far (`cam_from_world`, None while lost)."""
        return self.track_features(self._frontend(frame.image), frame.time)

    def track_features(self, features: Features, time: float) -> View:
        """As `track`, with the features of the frame at hand."""
        return self.track_matched(self.match(features), time)

    def match(self, features: Features) -> MatchedFeatures:
        """Match the next frame with the one before; frames in order, each once, and it may run ahead in a thread."""
        descriptors = unit_descriptors(features)
        matches = None
        if self._matched_before is not None:
            keypoints_before, descriptors_before = self._matched_before
            matches = match_units(descriptors_before, descriptors, self._max_distance(features))
            if self._settings.matching.flow_outlier_limit > 0:
                limit = self._settings.matching.flow_outlier_limit * self._camera.width
                matches = without_flow_outliers(matches, keypoints_before, features.keypoints, limit)
        self._matched_before = features.keypoints, descriptors
        return MatchedFeatures(features, descriptors, matches)

    def track_matched(self, matched: MatchedFeatures, time: float) -> View:
        """As `track`, with the features of the frame at hand and matched."""
        features = matched.features
        view = self._extend_tracks(matched, time)
        if self._mapper is None:
            mapper = RobustMapper if self._settings.mode == "robust" else PaperMapper
            self._mapper = mapper(self._camera, self._settings, self._max_distance(features), self._journal)
        self._mapper.track(view)
        self._previous = view
        self._count += 1
        return view

    def finish(self) -> None:
        """The sequence is over: all poses and points become final."""
        if self._mapper is not None:
            self._mapper.finish()

    @property
    def trajectory(self) -> Trajectory:
        """Poses that are final; all of them after `finish`."""
        return self._journal.trajectory

    @property
    def map(self) -> SparseMap:
        """Points of finished segments; all of them after `finish`."""
        return self._journal.map

    @property
    def running_points(self) -> Float64:
        """(P, 3) points of the running segment, in its own world as `View.cam_from_world` is."""
        local_map = None if self._mapper is None else self._mapper.local_map
        return np.zeros((0, 3)) if local_map is None else local_map.store.xyz

    @property
    def segments(self) -> Sequence[Segment]:
        """Finished segments."""
        return self._journal.segments

    @property
    def events(self) -> Sequence[Event]:
        """What went wrong where."""
        return self._journal.events

    def _extend_tracks(self, matched: MatchedFeatures, time: float) -> View:
        """Connect the dots with the previous frame."""
        features = matched.features
        if self._previous is None or matched.matches is None:
            tracks = self._chain.start(len(features))
        else:
            tracks = self._chain.extend(self._previous.tracks, matched.matches, len(features))
        weights = features.weights() if self._use_stability else np.ones(len(features))
        return View(
            frame_index=self._count,
            time=time,
            keypoints=features.keypoints.astype(np.float64),
            descriptors=matched.descriptors,
            weights=weights.astype(np.float64),
            tracks=tracks,
            points=np.full(len(features), -1, np.int64),
        )

    def _max_distance(self, features: Features) -> float:
        return distance_threshold(features, self._settings.matching.max_distance)
