"""The visual odometry loop: detect, match, extend tracks, optimise the window, slide."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType

import numpy as np

from improvo.frontend import Frontend
from improvo.frontend.registry import CLASSICAL
from improvo.geometry.camera import Camera
from improvo.odometry.alarms.world_keypoints import WorldKeypoints
from improvo.odometry.input_checks import OneThread, check_features, check_frame, check_parts, check_time
from improvo.odometry.modes.mapper import Mapper
from improvo.odometry.modes.paper import PaperMapper
from improvo.odometry.modes.robust import RobustMapper
from improvo.odometry.modes.states import TrackingState
from improvo.odometry.refinement.keypoint_refinement import prepared
from improvo.odometry.result.events import Event, EventLog
from improvo.odometry.result.final_view import FinalView
from improvo.odometry.result.odometry_result import OdometryResult
from improvo.odometry.result.segments import Segment
from improvo.odometry.settings import OdometrySettings, RefinementSettings
from improvo.odometry.view import View
from improvo.tracking.connect import TrackChain
from improvo.tracking.matching import distance_threshold, match_units, unit_descriptors, without_flow_outliers
from improvo.types import Features, Float32, Float64, Frame, Int64, SparseMap, Trajectory, UInt8


@dataclass(frozen=True)
class TrackedFrame:
    """What is known of a frame when it has been processed; it does not change afterwards."""

    frame_index: int  # in the order of processing, from 0
    time: float  # seconds
    cam_from_world: Float64 | None  # (4, 4), read-only; None without a pose; later frames may still refine it
    state: TrackingState
    segment: int  # the world and scale that the pose belongs to; -1 without a pose
    inliers: int  # keypoints that observe a point of the map
    keyframe: bool


@dataclass(frozen=True)
class MatchedFeatures:
    """Features of a frame, matched with the frame before."""

    features: Features
    descriptors: Float32  # (N, D) unit vectors
    matches: Int64 | None  # (K, 2) rows of the frame before and of this one; None for the first frame


class VisualOdometry:
    """Monocular visual odometry (the whole paper but its training), up to scale.

    Use it as a context manager: when the block ends, all poses and points are final::

        with VisualOdometry(frontend, sequence.camera) as odometry:
            for frame in sequence:
                odometry.track(frame)
        print(odometry.trajectory.camera_centers, odometry.map.xyz)

    Args:
        frontend: gives the features of an image.
        camera: pinhole camera of the frames, which are undistorted already.
        settings: all numbers.
        use_stability: weigh observations with the frontend's stability (w_ij), or with 1.
        on_final: called with each frame that nothing can change any more.
        camera_is_guess: the focal length is a guess. What a camera that only turns explains as well, with another
            focal length, is doubtful then.

    Raises:
        InputError: the camera has distortion.
        TypeError: a name or file in place of the frontend, or something else in place of the camera.
    """

    def __init__(
        self,
        frontend: Frontend,
        camera: Camera,
        settings: OdometrySettings | None = None,
        use_stability: bool = True,
        on_final: Callable[[FinalView], None] | None = None,
        camera_is_guess: bool = False,
    ) -> None:
        check_parts(frontend, camera)
        self._detect = WorldKeypoints(frontend)
        self._camera = camera
        self._settings = settings or OdometrySettings()
        self._use_stability = use_stability
        self._camera_is_guess = camera_is_guess
        self._refines = self._settings.mode == "robust" and _is_refined(frontend, self._settings.refinement)
        self._result = OdometryResult(camera, on_final)
        self._events = EventLog()
        self._chain = TrackChain()
        self._newest: View | None = None
        self._matched_before: tuple[Float32, Float32] | None = None  # keypoints, unit descriptors of the last `match`
        self._descriptor_width = 0
        self._mapper: Mapper | None = None
        self._finished = False
        self._thread = OneThread()

    def __enter__(self) -> VisualOdometry:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.finish()

    def track(self, frame: Frame) -> TrackedFrame:
        """Process the next frame, of a sequence or made by hand: `Frame(number, seconds, image, "my camera")`.

        Raises:
            TypeError: it is no `Frame`, but a bare picture for example.
            RuntimeError: the odometry has finished, or another thread is tracking with it.
            InputError: the picture has another size or type than the camera's, or its time is not after that of the
                frame before; nothing has changed then.
        """
        with self._thread.alone():
            self._refuse_if_finished()
            check_frame(frame, self._camera, self._time_before)
            return self.track_features(self.detect(frame), frame.time, frame.image)

    def detect(self, frame: Frame) -> Features:
        """Features of the next frame; frames in order, each once, and it may run up to two frames ahead in a thread."""
        return self._detect(frame)

    def track_features(self, features: Features, time: float, image: UInt8 | None = None) -> TrackedFrame:
        """As `track`, with the features of the frame and its time in seconds at hand.

        Without the frame's image (H, W) or (H, W, 3) its keypoints are not refined (`odometry.refinement`).
        """
        with self._thread.alone():
            self._refuse_if_finished()
            check_time(time, self._time_before)
            return self.track_matched(self.match(features), time, image)

    def match(self, features: Features) -> MatchedFeatures:
        """Match the next frame with the one before; frames in order, each once, and it may run ahead in a thread."""
        before = self._matched_before
        check_features(features, self._descriptor_width if before is not None else None)
        descriptors = unit_descriptors(features)
        matches = None
        if self._matched_before is not None:
            keypoints_before, descriptors_before = self._matched_before
            matches = match_units(descriptors_before, descriptors, self._max_distance(features))
            if self._settings.matching.flow_outlier_limit > 0:
                limit = self._settings.matching.flow_outlier_limit * self._camera.width
                matches = without_flow_outliers(matches, keypoints_before, features.keypoints, limit)
        self._matched_before = features.keypoints, descriptors
        self._descriptor_width = features.descriptors.shape[1]
        return MatchedFeatures(features, descriptors, matches)

    def track_matched(self, matched: MatchedFeatures, time: float, image: UInt8 | None = None) -> TrackedFrame:
        """As `track_features`, with what `match` gave for the frame at hand."""
        with self._thread.alone():
            self._refuse_if_finished()
            check_time(time, self._time_before)
            return self._track(matched, time, image)

    def _track(self, matched: MatchedFeatures, time: float, image: UInt8 | None) -> TrackedFrame:
        view = self._extend_tracks(matched, time)
        if image is not None and self._refines:
            view.image = prepared(image)
        if self._mapper is None:
            about = self._camera, self._settings, self._max_distance(matched.features), self._result, self._events
            robust = self._settings.mode == "robust"
            self._mapper = RobustMapper(*about, self._camera_is_guess) if robust else PaperMapper(*about)
        self._mapper.track(view)
        self._newest = view
        self._detect.know(view.frame_index, self._mapper.dispensable_pixels(view))
        return TrackedFrame(
            view.frame_index,
            view.time,
            _read_only(view.cam_from_world),
            self._mapper.state,
            view.segment,
            len(view.observed),
            view.keyframe,
        )

    def finish(self) -> None:
        """The sequence is over: all poses and points become final. A second call does nothing."""
        with self._thread.alone():
            if self._mapper is not None and not self._finished:
                self._mapper.finish()
            self._finished = True

    @property
    def pose(self) -> Float64 | None:
        """The newest frame's cam_from_world (4, 4) as it is known now, in its segment's own world; None without one."""
        return None if self._newest is None else _read_only(self._newest.cam_from_world)

    @property
    def state(self) -> TrackingState:
        """What the odometry is doing."""
        return TrackingState.INITIALISING if self._mapper is None else self._mapper.state

    @property
    def trajectory(self) -> Trajectory:
        """Poses of all frames so far; those of the window may still change before `finish`."""
        return self._so_far().trajectory

    @property
    def map(self) -> SparseMap:
        """Map points of all segments so far; those of the running segment may still change before `finish`."""
        return self._so_far().map

    @property
    def segments(self) -> Sequence[Segment]:
        """The segments that have ended; all of them after `finish`."""
        return tuple(self._result.segments)

    @property
    def events(self) -> Sequence[Event]:
        """What went wrong where, in order."""
        return tuple(self._events.events)

    @property
    def newest_view(self) -> View | None:
        """The newest frame as the odometry itself holds it, for a visualizer; it must not be changed."""
        return self._newest

    @property
    def running_points(self) -> Float64:
        """(P, 3) points of the running segment, in its own world as `pose` is."""
        local_map = None if self._mapper is None else self._mapper.local_map
        return np.zeros((0, 3)) if local_map is None else local_map.store.xyz

    @property
    def _time_before(self) -> float | None:
        return None if self._newest is None else self._newest.time

    def _so_far(self) -> OdometryResult:
        return self._result if self._mapper is None or self._finished else self._mapper.so_far()

    def _refuse_if_finished(self) -> None:
        if self._finished:
            raise RuntimeError("this odometry has finished; make a new VisualOdometry for more frames")

    def _extend_tracks(self, matched: MatchedFeatures, time: float) -> View:
        """Connect the dots with the previous frame."""
        features, previous = matched.features, self._newest
        if previous is None or matched.matches is None:
            tracks = self._chain.start(len(features))
        else:
            tracks = self._chain.extend(previous.tracks, matched.matches, len(features))
        weights = features.weights() if self._use_stability else np.ones(len(features))
        return View(
            frame_index=0 if previous is None else previous.frame_index + 1,
            time=time,
            keypoints=features.keypoints.astype(np.float64),
            descriptors=matched.descriptors,
            weights=weights.astype(np.float64),
            tracks=tracks,
            points=np.full(len(features), -1, np.int64),
        )

    def _max_distance(self, features: Features) -> float:
        return distance_threshold(features, self._settings.matching.max_distance)


def _is_refined(frontend: Frontend, settings: RefinementSettings) -> bool:
    """Whether keypoints of a frontend are to be refined; one without a name counts as a network."""
    classical = getattr(frontend, "name", "") in CLASSICAL
    return settings.frontends == "all" or (settings.frontends == "networks" and not classical)


def _read_only(pose: Float64 | None) -> Float64 | None:
    """A copy that cannot be written to."""
    if pose is None:
        return None
    copy = pose.copy()
    copy.flags.writeable = False
    return copy
