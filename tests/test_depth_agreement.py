"""What several frames agree on, and the depth maps of a whole sequence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from depth_scene import CAMERA, halved, render, sideways, textured, wall
from improvo.depth import DepthMap, DepthSettings
from improvo.depth.agreement import agreed_depth
from improvo.depth.depth_map import half_intrinsics
from improvo.depth.depth_maps import depth_maps
from improvo.depth.settings import AgreementSettings, RefineSettings
from improvo.geometry import se3
from improvo.types import UInt8

FRAMES = 9
MIDDLE = FRAMES // 2
RANGE = (1.0, 2.0, 6.0)
POSES = sideways(FRAMES, 0.06)
SCENE = [wall(2.5, textured(0)), wall(1.5, textured(1), half_width=0.3)]


def exact(frame: int) -> DepthMap:
    """The true depth map of a frame."""
    depth = halved(render(SCENE, POSES[frame])[1])
    return DepthMap(depth, np.ones_like(depth), half_intrinsics(CAMERA.K))


def agreed(depth_map: DepthMap, others: list[int], settings: AgreementSettings | None = None) -> DepthMap:
    """The middle frame's map compared with the true ones of others."""
    other_from_frame = POSES[others] @ se3.inverse(POSES[MIDDLE])
    return agreed_depth(
        depth_map, [exact(other) for other in others], other_from_frame, settings or AgreementSettings()
    )


def test_true_maps_agree() -> None:
    found = agreed(exact(MIDDLE), [0, 2, 6, 8])
    assert found.known > 0.95
    np.testing.assert_allclose(found.depth[found.depth > 0], exact(MIDDLE).depth[found.depth > 0], rtol=0.01)
    assert found.agreeing is not None
    assert found.agreeing.max() == 4
    assert ((found.agreeing >= 2) == (found.depth > 0)).all()


def test_a_map_that_needs_no_other_stays_as_it_is_where_there_is_none() -> None:
    found = agreed(exact(MIDDLE), [], AgreementSettings(least=0))
    np.testing.assert_array_equal(found.depth, exact(MIDDLE).depth)
    np.testing.assert_array_equal(found.confidence, exact(MIDDLE).confidence)
    assert agreed(exact(MIDDLE), [], AgreementSettings(least=1)).known == 0


def test_what_only_one_frame_says_is_dropped() -> None:
    true = exact(MIDDLE)
    depth = true.depth.copy()
    depth[40:60, 100:120] *= 1.2
    depth[80:100, 20:40] *= 0.7  # the others see through it
    found = agreed(replace(true, depth=depth), [0, 2, 6, 8])
    assert found.known > 0.9
    assert (found.depth[42:58, 102:118] == 0).all()
    assert (found.depth[82:98, 22:38] == 0).all()


def test_too_few_other_frames_keep_nothing() -> None:
    assert agreed(exact(MIDDLE), [2]).known == 0
    assert agreed(exact(MIDDLE), [2], AgreementSettings(least=1)).known > 0.9
    alone = agreed_depth(exact(MIDDLE), [], np.zeros((0, 4, 4)), AgreementSettings())
    assert alone.known == 0


def test_the_mean_over_frames_is_nearer_to_the_truth() -> None:
    true = exact(MIDDLE)
    noise = np.random.default_rng(0).normal(1, 0.01, true.depth.shape)
    found = agreed(replace(true, depth=(true.depth * noise).astype(np.float32)), [0, 2, 6, 8])
    known = found.depth > 0
    after = np.abs(found.depth[known] / true.depth[known] - 1)
    assert np.median(after) < 0.5 * np.median(np.abs(noise - 1))


def test_refinement_makes_a_slanted_surface_exact() -> None:
    slanted = replace(SCENE[0], corner=(-4.0, -6.0, 1.2), along=(8.0, 0.0, 2.5))
    pictures = [render([slanted], pose) for pose in POSES]
    images, truth = [image for image, _ in pictures], halved(pictures[MIDDLE][1])
    medians = []
    for steps in (0, 3):
        settings = DepthSettings(refine=RefineSettings(steps=steps))
        maps = dict(
            depth_maps(images.__getitem__, POSES, np.zeros(FRAMES, np.int64), CAMERA.K, lambda _: RANGE, settings)
        )
        found = maps[MIDDLE].depth
        known = found > 0
        assert known.mean() > 0.8
        medians.append(np.median(np.abs(found[known] / truth[known] - 1)))
    assert medians[1] < 0.5 * medians[0]
    assert medians[1] < 0.001


def test_a_sequence_keeps_only_a_window_of_frames() -> None:
    frames, reach = 40, 5
    poses = sideways(frames, 0.06)
    asked: list[int] = []

    def image(frame: int) -> UInt8:
        asked.append(frame)
        return render(SCENE, poses[frame])[0]

    poses[7] = np.nan
    segment = np.where(np.arange(frames) < 20, 0, 1)
    settings = DepthSettings(reach=reach)
    found = []
    for frame, depth_map in depth_maps(image, poses, segment, CAMERA.K, lambda _: RANGE, settings):
        found.append(frame)
        assert max(asked) <= frame + 2 * reach + 1
        assert depth_map.known > 0.3, "the window of frames beside it is gone"
    assert found == [frame for frame in range(frames) if frame != 7]
    assert asked == found, "each frame is read once, in order"


def test_frames_of_different_segments_are_not_compared() -> None:
    images = [render(SCENE, pose)[0] for pose in POSES]
    alone = np.arange(FRAMES)  # every frame is its own segment
    for _, depth_map in depth_maps(images.__getitem__, POSES, alone, CAMERA.K, lambda _: RANGE):
        assert depth_map.known == 0


def test_the_same_maps_again() -> None:
    images = [render(SCENE, pose)[0] for pose in POSES]
    first, second = (
        [
            depth_map.depth.tobytes()
            for _, depth_map in depth_maps(
                images.__getitem__, POSES, np.zeros(FRAMES, np.int64), CAMERA.K, lambda _: RANGE
            )
        ]
        for _ in range(2)
    )
    assert first == second
