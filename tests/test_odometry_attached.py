"""What moves with the camera is found and left out of the map; what only happens to stand in the picture is not."""

from __future__ import annotations

import numpy as np
from simulated_features import CAMERA, World, error_percent, hand_motion, observe, room

from improvo.geometry import se3
from improvo.odometry.alarms.attached import AttachedDetector
from improvo.odometry.mapping.local_map import LocalMap
from improvo.odometry.mapping.start import start_map
from improvo.odometry.settings import AttachedSettings, OdometrySettings
from improvo.odometry.view import View
from improvo.odometry.visual_odometry import VisualOdometry
from improvo.tracking.connect import TrackChain
from improvo.tracking.matching import match_units, unit_descriptors
from improvo.types import Features, Float64, Frame, Mask, UInt8

LOGO = (200.0, 20.0, 310.0, 110.0)  # left, top, right, bottom: an eighth of the picture


def with_logo(features: Features, seed: int, count: int = 120, noise: float = 0.2) -> Features:
    """The features with a logo over a corner: the same keypoints in every picture."""
    left, top, right, bottom = LOGO
    logo = np.random.default_rng(99)
    keypoints = logo.uniform((left, top), (right, bottom), (count, 2))
    descriptors = logo.normal(size=(count, features.descriptors.shape[1]))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    keypoints = keypoints + np.random.default_rng(seed).normal(scale=noise, size=keypoints.shape)
    hidden = ((features.keypoints > (left, top)) & (features.keypoints < (right, bottom))).all(axis=1)
    kept = features.take(~hidden)
    return Features(
        np.concatenate([keypoints, kept.keypoints]).astype(np.float32),
        np.concatenate([descriptors, kept.descriptors]).astype(np.float32),
        np.ones(count + len(kept), np.float32),
    )


def with_logos(features: list[Features]) -> list[Features]:
    return [with_logo(each, number) for number, each in enumerate(features)]


def marked(features: list[Features]) -> list[tuple[View, np.ndarray]]:
    """Views of the features, with what the detector marks."""
    detector, chain, found = AttachedDetector(CAMERA, OdometrySettings(), 0.7), TrackChain(), []
    for number, each in enumerate(features):
        descriptors = unit_descriptors(each)
        if found:
            before = found[-1][0]
            tracks = chain.extend(before.tracks, match_units(before.descriptors, descriptors, 0.7), len(each))
        else:
            tracks = chain.start(len(each))
        nothing = np.full(len(each), -1, np.int64)
        view = View(number, number / 30, each.keypoints.astype(float), descriptors, np.ones(len(each)), tracks, nothing)
        detector.observe(view)
        found.append((view, view.attached.copy()))
    return found


def seen(world_from_cam: Float64, world: World | None = None) -> list[Features]:
    world = world or room()
    return [observe(world, pose, seed=number) for number, pose in enumerate(world_from_cam)]


def test_a_logo_is_marked_and_little_else_is() -> None:
    features = with_logos(seen(hand_motion(40, step=0.04)))
    logo, world = zip(*((mask[:120], mask[120:]) for _, mask in marked(features)[25:]), strict=True)
    assert np.mean(np.concatenate(logo)) > 0.95
    assert np.mean(np.concatenate(world)) < 0.05


def test_a_world_without_anything_attached_is_left_alone() -> None:
    for motion in (hand_motion(40, step=0.04), hand_motion(40, step=0.01), hand_motion(40, step=0.0, turn_deg=1.5)):
        assert not any(mask.any() for _, mask in marked(seen(motion)))


def test_a_drive_forward_marks_neither_the_focus_of_expansion_nor_far_points() -> None:
    rng = np.random.default_rng(4)
    street = World(rng.uniform((-4, -2, 1), (4, 2, 60), (6000, 3)), room(count=6000).descriptors)
    ahead = np.repeat(np.eye(4)[None], 40, axis=0)
    ahead[:, 2, 3] = 0.25 * np.arange(40)
    assert not any(mask.any() for _, mask in marked(seen(ahead, street)))


def test_a_turn_about_the_optical_axis_does_not_mark_its_centre() -> None:
    turn = se3.rigid(se3.so3_exp(np.arange(40)[:, None] * np.array([0.0, 0.0, 0.04])), np.zeros((40, 3)))
    assert not any(mask.any() for _, mask in marked(seen(turn)))


def test_a_person_before_a_still_camera_does_not_make_the_world_attached() -> None:
    still = seen(np.repeat(hand_motion(1), 40, axis=0))
    rng = np.random.default_rng(8)
    body, names = rng.uniform(-1, 1, (80, 2)) * (30, 60), rng.normal(size=(80, 32))
    names /= np.linalg.norm(names, axis=1, keepdims=True)
    features = []
    for number, each in enumerate(still):
        person = body + np.array([40 + 5 * number, 120]) + rng.normal(scale=0.3, size=body.shape)
        both = np.concatenate([each.keypoints, person]).astype(np.float32)
        descriptors = np.concatenate([each.descriptors, names]).astype(np.float32)
        features.append(Features(both, descriptors, np.ones(len(both), np.float32)))
    assert not any(mask.any() for _, mask in marked(features))


def test_a_logo_that_goes_away_is_forgotten() -> None:
    plain = seen(hand_motion(75, step=0.04))
    features = [with_logo(each, number) if number < 30 else each for number, each in enumerate(plain)]
    found = marked(features)
    assert found[29][1].any()
    assert found[-1][1].mean() < 0.01


def test_odometry_with_a_logo_is_right_and_says_so() -> None:
    truth = hand_motion(60, step=0.03)
    features = [with_logo(each, number, count=300) for number, each in enumerate(seen(truth))]
    errors = {}
    for enabled in (True, False):
        settings = OdometrySettings(attached=AttachedSettings(enabled=enabled))
        odometry = VisualOdometry(None, CAMERA, settings)  # type: ignore[arg-type]
        for number, each in enumerate(features):
            odometry.track_features(each, number / 30)
        odometry.finish()
        path = odometry.trajectory
        usable = path.valid
        errors[enabled] = error_percent(path.camera_centers[usable], truth[usable, :3, 3]) if usable.sum() > 30 else 99
        said = [event for event in odometry.events if event.kind == "attached"]
        assert bool(said) is enabled
    assert errors[True] < 2.0 < errors[False], errors


class FewKeypoints:
    """A frontend that keeps its strongest keypoints, and a logo has the strongest; the picture's number is in it."""

    name = "few"

    def __init__(self, seen: list[Features], budget: int) -> None:
        self._seen, self._budget = seen, budget

    def __call__(self, image: UInt8, mask: Mask | None = None) -> Features:
        features = self._seen[int(image[0, 0])]
        if mask is not None:
            x, y = np.rint(features.keypoints).astype(int).T
            features = features.take(mask[np.clip(y, 0, CAMERA.height - 1), np.clip(x, 0, CAMERA.width - 1)])
        return features.take(np.argsort(-features.scores, kind="stable")[: self._budget])


class FewKeypointsEverywhere(FewKeypoints):
    def __call__(self, image: UInt8) -> Features:  # type: ignore[override]  # of a user who knows no masks
        return super().__call__(image)


def test_a_frontend_whose_keypoints_a_logo_takes_is_asked_for_more_of_the_world() -> None:
    truth = hand_motion(60, step=0.03)
    features = [with_logo(each, number, count=300) for number, each in enumerate(seen(truth))]
    strong = [
        Features(each.keypoints, each.descriptors, np.linspace(1, 0, len(each), dtype=np.float32)) for each in features
    ]
    found = {}
    for frontend in (FewKeypoints(strong, 345), FewKeypointsEverywhere(strong, 345)):
        with VisualOdometry(frontend, CAMERA) as odometry:  # type: ignore[arg-type]
            for number in range(60):
                image = np.full((CAMERA.height, CAMERA.width), number, np.uint8)
                odometry.track(Frame(number, number / 30, image, str(number)))
        path = odometry.trajectory
        right = path.valid.sum() > 50 and error_percent(path.camera_centers[path.valid], truth[path.valid, :3, 3]) < 3.0
        found[type(frontend)] = bool(right)
    assert found == {FewKeypoints: True, FewKeypointsEverywhere: False}


def test_tracks_of_a_logo_are_no_overlap_for_a_start() -> None:
    """The camera turns away from what it saw at first, and only the logo is still there."""
    views = [view for view, _ in marked(with_logos(seen(hand_motion(14, step=0.06, turn_deg=4.0))))]
    for view in views:
        view.attached = np.arange(len(view)) < 120
    started = start_map(views, CAMERA, OdometrySettings(), 0.7)
    assert isinstance(started, LocalMap), started
    assert views[-1].cam_from_world is not None
