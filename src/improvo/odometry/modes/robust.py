"""Mode `robust`: a gated start, PnP, search by projection, and a window of recent frames and keyframes."""

from __future__ import annotations

from improvo.geometry.camera import Camera
from improvo.odometry.alarms.attached import AttachedDetector
from improvo.odometry.alarms.focal_change import LensWatch
from improvo.odometry.alarms.second_opinion import SecondOpinion
from improvo.odometry.alarms.two_view_check import TwoViewCheck
from improvo.odometry.gates import MEMORY_FRAMES, gate
from improvo.odometry.mapping.bridging import Bridging
from improvo.odometry.mapping.bundle_adjustment import OBJECTIVE, SOLVER, WindowReport, adjust
from improvo.odometry.mapping.former_map import FormerMap
from improvo.odometry.mapping.initial_pair import InitFailure
from improvo.odometry.mapping.local_map import LocalMap
from improvo.odometry.mapping.sliding_window import SlidingWindow
from improvo.odometry.mapping.start import start_map
from improvo.odometry.modes.mapper import Mapper
from improvo.odometry.modes.states import StateMachine, TrackingState
from improvo.odometry.result.events import EventLog
from improvo.odometry.result.odometry_result import OdometryResult
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.verdict.judging import SegmentJudge
from improvo.odometry.view import View
from improvo.types import Float64, Mask

_MOST_ATTACHED = 0.2  # share of a map's observations that turn out to move with the camera; with more it is wrong
_MAX_BUFFERED = 300  # frames in the initialisation buffer; the oldest leaves it without a pose
_LOST = "lost"  # why a segment ended
_TWO_VIEWS, _ATTACHED = "two-view geometry", "what moves with the camera"  # what contradicted it
_ANOTHER_MOTION = "two motions are in the picture, and one of them is not the camera's"


class RobustMapper(Mapper):
    """Starts a map from two views, keeps it right, and starts another where it is lost (see `states.py`)."""

    def __init__(
        self,
        camera: Camera,
        settings: OdometrySettings,
        descriptor_distance: float,
        result: OdometryResult,
        events: EventLog,
        camera_is_guess: bool = False,
    ) -> None:
        super().__init__(camera, settings, descriptor_distance, result, events)
        self._camera_is_guess = camera_is_guess
        self._states = StateMachine()
        self._buffer: list[View] = []  # while INITIALISING: the initialisation buffer; while LOST: the lost frames
        self._cooldown = 0  # frames to wait before the next try to start
        self._costly_failures = 0  # since the last map
        self._worlds = 0  # maps started
        self._lens = LensWatch(camera, settings.tolerance, settings.seed)
        self._contradicted = 0  # maps in a row by two-view geometry, each over frames of the one before
        self._map_is_attached = False  # a large part of it has turned out to move with the camera
        self._second_opinion = SecondOpinion(camera, settings, descriptor_distance, events)
        self._window = SlidingWindow(settings.window, camera.width)
        self._two_view_check = TwoViewCheck(camera, settings, descriptor_distance)
        self._judge = SegmentJudge(camera, settings, camera_is_guess)
        self._bridging = Bridging(settings)
        self._provisional: list[View] = []  # all views of a provisional map with a pose, in order; none is final
        self._attached = AttachedDetector(camera, settings, descriptor_distance)

    @property
    def state(self) -> TrackingState:
        """What the mapper is doing."""
        return self._states.state

    def dispensable_pixels(self, view: View) -> Mask | None:
        """(H, W) what need have no keypoints, since it moves with the camera; None where few of a view's are there."""
        return self._attached.dispensable(view)

    def track(self, view: View) -> None:
        """One frame: localise, triangulate, adjust the window, check, slide."""
        newly_attached = self._attached.observe(view)
        if self._map is None:
            if newly_attached:
                self._leave_out_attached(view, self._buffer)
            self._initialise(view)
            return
        if newly_attached and self._leave_out_attached(view, [*self._map.history, *self._buffer]) > _MOST_ATTACHED:
            self._map_is_attached = True
        if self._lens.changed(self._window.newest, view, self._map.store.xyz):
            self._events.focal_length(view.frame_index, self._lens.factor, "the segment ends")
            self._end_segment("the focal length changed")
            self._initialise(view)
            return
        inliers, _ = self._map.localise(view, self._window.newest)
        if view.cam_from_world is None:
            self._lose(view, inliers, self._map.refused)
            return
        self._recover_lost_frames(self._map, view)
        self._add(view)
        self._map.triangulate(view, [other for other in self._window.free if other is not view])
        report = self._adjust_window(self._map)
        self._map.remember(view)
        self._result.add_window(report)
        if self._map_is_attached:
            self._start_anew(view, _ATTACHED)
            return
        history = {earlier.frame_index: earlier for earlier in self._map.history}
        if self._two_view_check.contradicts(view, history) and not self._stands(list(history.values())):
            self._start_anew(view, _TWO_VIEWS)
            return
        if self._two_view_check.ambiguous:
            self._events.two_motions(view.frame_index)
            self._judge.suspicion(_ANOTHER_MOTION)
        self._bridge(self._map, [view])
        self._confirm()
        self._slide()

    def finish(self) -> None:
        """The sequence is over: everything is final."""
        self._second_opinion.on_dropped([])
        if self._map is not None:
            self._end_segment("end of the sequence")
        self._result.give_up(self._buffer)
        self._buffer = []

    def so_far(self) -> OdometryResult:
        """The result as it would be if the sequence ended here."""
        if self._map is None:
            return self._result.with_running([], self._buffer)
        return self._result.with_running(self._window.remaining(), self._buffer, self._map.store.xyz)

    # INITIALISING

    def _initialise(self, view: View) -> None:
        self._buffer.append(view)
        self._cooldown -= 1
        if len(self._buffer) > _MAX_BUFFERED:
            self._result.give_up([self._buffer.pop(0)])
        if len(self._buffer) >= 2 and self._cooldown <= 0:
            self._try_to_start(view)

    def _try_to_start(self, view: View) -> None:
        """Start a map from the buffered views, or wait for a better one."""
        started = start_map(self._buffer, self._camera, self._settings, self._descriptor_distance)
        if isinstance(started, InitFailure):
            self._events.initialisation_failed(view.frame_index, started.reason)
            if started.costly:
                self._cooldown = min(2**self._costly_failures, self._settings.window.recent)
                self._costly_failures += 1
            return
        self._map = started
        self._worlds += 1
        self._states.map_started()
        self._events.segment_started(self._buffer[0].frame_index, self._result.running_segment)
        if self._lens.factor != 1.0:
            self._events.focal_length(self._buffer[0].frame_index, self._lens.factor, "the segment is doubtful")
            self._judge.alarm(f"the focal length is about {self._lens.factor:.2f} times that of the camera as given")
        if self._second_opinion.on_dropped(self._buffer) and self._contradicted:
            self._contradicted -= 1
        if self._contradicted:
            maps = "a former map" if self._contradicted == 1 else f"each of {self._contradicted} former maps"
            words = f"{maps} of these frames was contradicted by {_TWO_VIEWS}"
            # one was worse than the map that followed; several in a row tell that these frames mislead
            self._judge.suspicion(words, self._contradicted if self._contradicted > 1 else 0)
        self._result.begin_segment()
        self._result.give_up(each for each in self._buffer if each.cam_from_world is None)
        self._two_view_check = TwoViewCheck(self._camera, self._settings, self._descriptor_distance)
        self._bridging.new_map()
        for each in self._buffer:
            if each.cam_from_world is not None:
                self._add(each)
        self._bridge(self._map, self._buffer)
        self._buffer = []
        self._slide()

    # PROVISIONAL and TRACKING

    def _add(self, view: View) -> None:
        """The view has a pose in the running segment."""
        self._mark(view)
        self._window.add(view)

    def _mark(self, view: View) -> None:
        view.segment, view.world = self._result.running_segment, self._worlds
        if self._states.is_provisional:
            self._provisional.append(view)

    def _adjust_window(self, local_map: LocalMap) -> WindowReport:
        free, fixed = self._window.free_and_fixed()
        max_error = gate(self._settings.tolerance)
        return adjust(free, fixed, local_map.store, self._camera.K, OBJECTIVE, SOLVER, max_error)

    def _confirm(self) -> None:
        """A map that was checked and not contradicted for long enough is trusted, and its old frames become final."""
        if self._states.is_provisional and self._two_view_check.has_judged and len(self._provisional) > MEMORY_FRAMES:
            self._states.map_confirmed()
            self._provisional = []

    def _bridge(self, local_map: LocalMap, views: list[View]) -> None:
        """Join a provisional map with a former one that its keyframes see; nothing of it is final yet."""
        if not self._states.is_provisional:
            return
        for view in views:
            join = self._bridging.look(view, local_map.store.xyz, self._provisional) if view.keyframe else None
            if join is None:
                continue
            if self._result.running_segment != join.number:
                self._events.bridged(view.frame_index, join)
            self._result.join(join.number, join.shared_from_new, join.scale_error)
            for each in self._provisional:
                each.segment = join.number

    def _slide(self) -> None:
        self._window.slide()
        if self._map is not None and not self._states.is_provisional:
            for view, cam_from_world in self._window.take_final():
                self._finalise(self._map, view, cam_from_world)

    def _leave_out_attached(self, view: View, views: list[View]) -> float:
        """Mark earlier views anew, and drop what they observe there; returns its share of all that they observed."""
        self._events.attached(view.frame_index, float(view.attached.mean()) if len(view) else 0.0)
        return self._attached.drop(views)

    def _stands(self, history: list[View]) -> bool:
        """Whether a map that two views contradict stays, since a second one explains the tracks no better."""
        views = self._provisional if self._states.is_provisional else history[-2 * self._settings.window.recent :]
        if not self._second_opinion.stands(views, _TWO_VIEWS):
            return False
        if self._second_opinion.undecided:
            self._judge.suspicion(_ANOTHER_MOTION)
        else:
            self._judge.suspicion(
                f"{_TWO_VIEWS} spoke against the map, and a second map did not", 0
            )  # which settles it
        self._two_view_check.start_over()
        return True

    def _start_anew(self, view: View, by: str) -> None:
        """The map is wrong: a provisional one starts anew over all its frames, another one over its last frames."""
        contradicted = self._contradicted + (by == _TWO_VIEWS)
        if self._states.is_provisional:
            self._second_opinion.drop(self._provisional, by, poses_contradicted=by == _TWO_VIEWS)
            self._buffer = self._provisional
            self._clear()
            self._states.map_ended()
        else:
            self._events.contradicted(view.frame_index, "the segment ends", by)
            doubtful, self._window.recent = self._window.recent, []
            self._end_segment(f"contradicted by {by}")
            self._buffer = doubtful
        self._contradicted = contradicted
        for each in self._buffer:
            each.forget_pose()
        self._try_to_start(view)

    # LOST

    def _lose(self, view: View, inliers: int, refused: int) -> None:
        """A frame without a pose; too many of them end the segment, and they begin the next."""
        self._states.frame_lost()
        self._buffer.append(view)
        self._events.lost(view.frame_index, inliers, refused)
        if len(self._buffer) > self._settings.loss.max_lost_frames:
            self._end_segment(_LOST)

    def _recover_lost_frames(self, local_map: LocalMap, view: View) -> None:
        """Frames lost just before `view` get their pose backwards from it, where they can."""
        self._states.pose_found()
        neighbour, recovered = view, []
        for lost in reversed(self._buffer):
            local_map.localise(lost, neighbour)
            if lost.cam_from_world is not None:
                neighbour = lost
                recovered.append(lost)
            else:
                self._result.give_up([lost])
        recovered.reverse()
        for each in recovered:
            self._mark(each)
        self._window.insert(recovered)
        self._buffer = []

    # every state with a map

    def _end_segment(self, reason: str) -> None:
        """Everything of the running segment is final."""
        assert self._map is not None
        for view, cam_from_world in self._window.remaining():
            self._finalise(self._map, view, cam_from_world)
        xyz = self._map.store.xyz
        self._remember_former_map(self._map, reason)
        segment = self._result.end_segment(xyz, reason, self._judge.verdict(xyz))
        if segment is not None:
            self._events.judged(segment)
        self._contradicted = 0
        self._clear()
        self._states.map_ended()

    def _remember_former_map(self, local_map: LocalMap, reason: str) -> None:
        """What a later map may be joined with; a map that was contradicted is none."""
        if reason != _LOST:
            return
        former = FormerMap(
            self._result.running_segment,
            self._result.placement,
            sorted({*self._window.keyframes, *local_map.history}, key=lambda view: view.frame_index),
            local_map.store.xyz,
            self._camera,
            self._descriptor_distance,
            gate(self._settings.tolerance),
            self._settings.seed,
        )
        self._bridging.remember(former)

    def _finalise(self, local_map: LocalMap, view: View, cam_from_world: Float64) -> None:
        view.cam_from_world = cam_from_world
        self._judge.final(view, cam_from_world, local_map.store.xyz)
        self._result.finalise(view, cam_from_world, local_map.store.xyz)

    def _clear(self) -> None:
        """No map."""
        self._map = None
        self._judge = SegmentJudge(self._camera, self._settings, self._camera_is_guess)
        self._window = SlidingWindow(self._settings.window, self._camera.width)
        self._provisional = []
        self._cooldown, self._costly_failures = 0, 0
        self._map_is_attached = False
