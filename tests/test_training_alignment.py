"""Correspondences by depth, moved to where the pictures agree."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs the extra `train`")

from posed_room import posed_room  # noqa: E402

from improvo.errors import ConfigError  # noqa: E402
from improvo.geometry import se3  # noqa: E402
from improvo.training.batches.alignment import Aligned, aligned  # noqa: E402
from improvo.training.batches.picture_store import PictureStore  # noqa: E402
from improvo.training.batches.posed_frames import PosedFrames  # noqa: E402
from improvo.training.data.posed_sequence import PosedSequence  # noqa: E402
from improvo.training.held_settings import AlignmentSettings  # noqa: E402

CPU = torch.device("cpu")
ROWS = np.array([[0, 3], [2, 1]])
X, Y = np.meshgrid(np.arange(20.0, 140.0, 6.0), np.arange(15.0, 105.0, 6.0))
PLACES = torch.from_numpy(np.stack([X.ravel(), Y.ravel()], axis=1).astype(np.float32)).expand(2, -1, -1)


def room_seen_wrongly(turn: float = 0.01, shift: float = 0.03) -> tuple[PosedSequence, PosedSequence]:
    """A room, and the same with poses that are off, as an odometry's are after some seconds."""
    room = posed_room()
    poses = room.world_from_cam.copy()
    for frame, sign in ((1, 1.0), (3, -1.0)):
        poses[frame] = poses[frame] @ se3.rigid(se3.so3_exp(np.array([0.0, sign * turn, 0.0])), np.array([0, shift, 0]))
    return room, replace(room, world_from_cam=poses)


def carried(room: PosedSequence) -> tuple[Any, Any, Any]:
    frames = PosedFrames([room], CPU)
    inverse = frames.depths.sample(ROWS[:, 0], PLACES)
    found = frames.carry(ROWS, PLACES, inverse)
    return found.places, inverse, frames.shown(ROWS, found, 0.03)


def align(room: PosedSequence, settings: AlignmentSettings | None = None, pictures: Any = None) -> Aligned:
    _, inverse, _ = carried(room)
    store = PictureStore(pictures or list(room.pictures), CPU)
    return aligned(store, PosedFrames([room], CPU), ROWS, PLACES, inverse, settings or AlignmentSettings())


def test_places_that_wrong_poses_put_elsewhere_are_found_again() -> None:
    room, wrong = room_seen_wrongly()
    true, _, seen = carried(room)
    before, _, _ = carried(wrong)
    found = align(wrong)
    off = (before - true).norm(dim=-1)
    assert off[seen].median() > 2
    certain = found.certain & seen
    assert certain.sum() > 0.5 * seen.sum()
    assert (found.places - true).norm(dim=-1)[certain].median() < 0.1
    assert ((found.places - true).norm(dim=-1)[certain] > 1).float().mean() < 0.02
    others = seen & ~found.certain & ~found.contradicted
    assert (found.places - true).norm(dim=-1)[others].median() < 0.5  # moved with the motion of the pair


def test_right_places_stay() -> None:
    room = posed_room()
    true, _, seen = carried(room)
    found = align(room)
    certain = found.certain & seen
    assert certain.sum() > 0.5 * seen.sum()
    assert (found.places - true).norm(dim=-1)[certain].max() < 1


def test_what_is_no_longer_there_is_not_certain() -> None:
    room = posed_room()
    true, _, seen = carried(room)
    pictures = list(room.pictures)
    pictures[3], pictures[1] = (p.copy() for p in (pictures[3], pictures[1]))
    for picture, other in ((pictures[3], 5), (pictures[1], 0)):
        picture[:, :80] = np.roll(room.pictures[other], 37, axis=0)[:, :80][::-1]
    found = align(room, pictures=pictures)
    gone = seen & (true[..., 0] < 60)
    kept = seen & (true[..., 0] > 95)
    assert found.certain[gone].float().mean() < 0.05
    assert found.certain[kept].float().mean() > 0.4


def test_pictures_that_tell_nothing_leave_the_places() -> None:
    room, wrong = room_seen_wrongly()
    before, _, _ = carried(wrong)
    plain = [np.full_like(picture, 90) for picture in room.pictures]
    found = align(wrong, pictures=plain)
    assert not found.certain.any()
    assert not found.contradicted.any()
    assert torch.equal(found.places, before)


def test_settings_that_cannot_be_are_refused() -> None:
    for wrong in ({"radius": 0}, {"least_score": 1.5}, {"most_moved": 0.0}, {"least_together": 2}):
        with pytest.raises(ConfigError, match=r"pairs\.align"):
            AlignmentSettings(**wrong)  # type: ignore[arg-type]
