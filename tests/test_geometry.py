"""Cameras, rigid motions and alignment hold the conventions of docs/conventions.md."""

from __future__ import annotations

import numpy as np
import pytest

from improvo.errors import InputError
from improvo.geometry import se3
from improvo.geometry.alignment import align_points
from improvo.geometry.camera import Camera

CAMERA = Camera(640, 480, 500.0, 510.0, 320.5, 239.0)


def some_poses(count: int = 5) -> np.ndarray:
    rng = np.random.default_rng(0)
    return se3.rigid(se3.so3_exp(rng.normal(size=(count, 3))), rng.normal(size=(count, 3)))


def test_inverse_undoes_and_transform_agrees_with_the_matrix() -> None:
    a_from_b = some_poses()
    np.testing.assert_allclose(se3.inverse(a_from_b) @ a_from_b, np.broadcast_to(np.eye(4), (5, 4, 4)), atol=1e-12)
    point = np.array([[0.3, -1.0, 2.0]])
    np.testing.assert_allclose(se3.transform(a_from_b[0], point)[0], (a_from_b[0] @ [0.3, -1.0, 2.0, 1.0])[:3])


@pytest.mark.parametrize("degrees", [0.0, 1e-6, 30.0, 179.9999, 180.0])
def test_rotation_angle_is_exact_at_both_ends(degrees: float) -> None:
    rotation = se3.so3_exp(np.radians(degrees) * np.array([0.6, 0.0, 0.8]))
    assert se3.rotation_angle_deg(rotation) == pytest.approx(degrees, abs=1e-9)


@pytest.mark.parametrize("degrees", [0.0, 1e-9, 1e-3, 0.05, 0.06, 30.0, 120.0, 179.9999])
def test_rotations_vectors_and_quaternions_undo_each_other(degrees: float) -> None:
    vectors = np.radians(degrees) * np.vstack([np.eye(3), -np.eye(3), np.full(3, 3**-0.5)])
    rotations = se3.so3_exp(vectors)
    np.testing.assert_allclose(se3.so3_log(rotations), vectors, atol=1e-11)
    np.testing.assert_allclose(
        rotations @ np.swapaxes(rotations, 1, 2), np.broadcast_to(np.eye(3), (7, 3, 3)), atol=1e-15
    )
    quats = se3.quat_xyzw_from_rotation(rotations)
    assert (quats[:, 3] >= 0).all()
    np.testing.assert_allclose(se3.rotation_from_quat_xyzw(-3 * quats), rotations, atol=1e-15)


def test_rotations_are_those_of_scipy() -> None:
    Rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    rng = np.random.default_rng(1)
    vectors = rng.normal(size=(500, 3)) * np.exp(rng.uniform(-14, 1, (500, 1)))
    theirs = Rotation.from_rotvec(vectors)
    np.testing.assert_allclose(se3.so3_exp(vectors), theirs.as_matrix(), atol=1e-15)
    np.testing.assert_allclose(se3.so3_log(theirs.as_matrix()), theirs.as_rotvec(), atol=1e-14)
    np.testing.assert_allclose(
        se3.quat_xyzw_from_rotation(theirs.as_matrix()), theirs.as_quat(canonical=True), atol=1e-15
    )


def test_a_half_turn_has_a_vector_of_length_pi_and_a_quaternion_without_length_is_refused() -> None:
    half = np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(np.abs(se3.so3_log(half)), [np.pi, 0, 0], atol=1e-12)
    with pytest.raises(ValueError, match="zero"):
        se3.rotation_from_quat_xyzw(np.zeros((2, 4)))


def test_nearest_rotation_mends_a_slightly_wrong_one() -> None:
    rotation = se3.so3_exp(np.array([0.2, -0.4, 0.1]))
    mended = se3.nearest_rotation(rotation + 1e-4 * np.arange(9).reshape(3, 3))
    np.testing.assert_allclose(mended @ mended.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(mended) == pytest.approx(1.0)
    assert se3.rotation_angle_deg(mended.T @ rotation) < 0.1


def test_quaternions_are_xyzw() -> None:
    quarter_turn_about_z = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    rotation = se3.rotation_from_quat_xyzw(quarter_turn_about_z)
    np.testing.assert_allclose(rotation @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(se3.quat_xyzw_from_rotation(rotation), quarter_turn_about_z, atol=1e-12)


def test_projection_is_the_papers_and_unproject_undoes_it() -> None:
    point = np.array([0.2, -0.1, 2.0])
    u, v, w = CAMERA.K @ point
    np.testing.assert_allclose(CAMERA.project(point), [u / w, v / w])
    np.testing.assert_allclose(CAMERA.unproject(CAMERA.project(point), 2.0), point)


def test_resizing_keeps_pixel_edges_on_pixel_edges() -> None:
    half = CAMERA.resized(320, 240)
    point = np.array([0.2, -0.1, 2.0])
    np.testing.assert_allclose(half.project(point) + 0.5, (CAMERA.project(point) + 0.5) / 2)


def test_an_impossible_camera_is_refused() -> None:
    with pytest.raises(InputError, match="focal"):
        Camera(640, 480, 0.0, 500.0, 320.0, 240.0)


def test_alignment_recovers_a_similarity_and_never_mirrors() -> None:
    rng = np.random.default_rng(1)
    source = rng.normal(size=(30, 3))
    rotation = se3.so3_exp(np.array([0.3, 1.2, -0.7]))
    target = 2.5 * source @ rotation.T + [1.0, 2.0, 3.0]
    found = align_points(target, source, with_scale=True)
    assert found.scale == pytest.approx(2.5)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-10)
    np.testing.assert_allclose(found.apply(source), target, atol=1e-10)
    mirrored = align_points(source * [1.0, 1.0, -1.0], source, with_scale=False)
    assert np.linalg.det(mirrored.rotation) == pytest.approx(1.0)


def test_alignment_without_extent_is_refused() -> None:
    with pytest.raises(InputError, match="3 common poses"):
        align_points(np.zeros((2, 3)), np.zeros((2, 3)), with_scale=True)
    with pytest.raises(InputError, match="coincide"):
        align_points(np.random.default_rng(0).normal(size=(5, 3)), np.ones((5, 3)), with_scale=True)
