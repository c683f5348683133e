"""Live sources: the latest frame, counted drops, and errors when they are not there."""

from __future__ import annotations

import functools
import http.server
import threading
import time
from collections.abc import Iterator
from pathlib import Path, PurePath, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
import pytest

from improvo.errors import InputError
from improvo.sequences import live, open_sequence
from sequence_builders import images, write_images, write_video


class FakeCamera:
    """A webcam of `count` frames at a fixed rate, whose pixels are the frame's number."""

    def __init__(self, count: int, period: float) -> None:
        self.count, self.period, self.read_so_far = count, period, 0
        self.released = False

    def read(self) -> tuple[bool, np.ndarray | None]:
        time.sleep(self.period)
        if self.read_so_far == self.count:
            return False, None
        self.read_so_far += 1
        return True, np.full((48, 64, 3), self.read_so_far - 1, np.uint8)

    def release(self) -> None:
        self.released = True


@pytest.fixture
def camera(monkeypatch: pytest.MonkeyPatch) -> FakeCamera:
    fake = FakeCamera(40, 0.01)
    monkeypatch.setattr(live, "_open", lambda name: fake)
    return fake


def test_slow_reader_gets_the_latest_frames_and_the_drops_are_counted(camera: FakeCamera) -> None:
    sequence = open_sequence("0", fov=60.0)
    assert sequence.format == "live"
    with pytest.raises(TypeError, match="live"):
        len(sequence)
    seen = []
    for frame in sequence:
        seen.append(frame.source_index)
        assert (frame.image == frame.source_index).all()  # the frame's own pixels tell that the count is right
        time.sleep(0.035)
    assert (np.diff(seen) > 0).all()
    assert len(seen) < 30
    assert sequence.recording.dropped >= 40 - len(seen) - 1  # type: ignore[attr-defined]
    assert "frames were dropped" in sequence.notes[0]
    assert (np.diff(sequence.times) > 0).all()
    assert camera.released


def test_max_frames_and_stopping_early_let_go_of_the_camera(camera: FakeCamera) -> None:
    assert len(list(open_sequence("0", fov=60.0, max_frames=3))) == 3
    assert camera.released


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"start": 3}, "0: is live, so `start` cannot be used"),
        ({"end": 5}, "0: is live, so `end` cannot be used.*or after `max_frames`"),
        ({"end": 0}, "0: is live, so `end` cannot be used"),
        ({"stride": 0}, "0: stride 0 must be at least 1"),
        ({"max_frames": 0}, "0: max_frames 0 must be at least 1"),
        ({"mask": "masks"}, "masks: is a folder, and 0 is live; give one mask for all frames"),
        ({"fov": None}, "0: has no calibration"),
    ],
)
def test_what_needs_a_recording_is_refused_and_the_camera_let_go(
    settings: dict[str, Any], said: str, camera: FakeCamera, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_images(tmp_path / "masks", [np.full((48, 64), 255, np.uint8)])
    with pytest.raises(InputError, match=said):
        open_sequence("0", **{"fov": 60.0, **settings})
    assert camera.released


def test_one_mask_and_a_stride_serve_a_live_stream(camera: FakeCamera, tmp_path: Path) -> None:
    white = np.full((48, 64), 255, np.uint8)
    white[:, :32] = 0
    write_images(tmp_path, [white], "mask{}.png")
    frames = list(open_sequence("0", fov=60.0, mask=str(tmp_path / "mask0.png"), stride=2, max_frames=3))
    assert len(frames) == 3
    assert all(frame.source_index % 2 == 0 for frame in frames)
    assert frames[0].mask is not None
    assert not frames[0].mask[:, :32].any()
    assert frames[0].mask[:, 40:].all()


def test_a_camera_that_is_unplugged_ends_the_sequence(camera: FakeCamera) -> None:
    camera.count = 5
    frames = list(open_sequence("0", fov=60.0))
    assert 1 <= len(frames) <= 5


def test_a_camera_that_sends_nothing_is_an_error(camera: FakeCamera) -> None:
    camera.count = 0
    with pytest.raises(InputError, match="no frame came"):
        open_sequence("0", fov=60.0)


def test_no_webcam_and_no_server_are_one_line_errors() -> None:
    with pytest.raises(InputError, match=r"99: the webcam cannot be opened; is it plugged in"):
        open_sequence("99", fov=60.0)
    start = time.monotonic()
    with pytest.raises(InputError, match=r"http://127.0.0.1:9/x: the stream cannot be opened; is the address right"):
        open_sequence("http://127.0.0.1:9/x", fov=60.0)
    with pytest.raises(InputError, match=r"rtsp://127.0.0.1:9/x"):
        open_sequence(Path("rtsp://127.0.0.1:9/x"), fov=60.0)
    assert time.monotonic() - start < 30


@pytest.fixture
def server(tmp_path: Path) -> Iterator[str]:
    write_video(tmp_path / "stream.mkv", images(10), codec="MJPG")

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    handler = functools.partial(Quiet, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as httpd:
        threading.Thread(target=httpd.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{httpd.server_address[1]}/stream.mkv"
        httpd.shutdown()


def test_http_stream(server: str) -> None:
    sequence = open_sequence(server, fov=60.0)
    frames = list(sequence)
    assert frames
    assert frames[0].image.shape == (72, 96)
    assert frames[-1].source.startswith(server)
    assert len(frames) + sequence.recording.dropped == 10  # type: ignore[attr-defined]


def test_a_folder_named_by_a_number_is_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_images(tmp_path / "07", images(3))
    monkeypatch.chdir(tmp_path)
    assert open_sequence("07", fov=60.0).format == "images"


def test_the_first_frame_keeps_its_number_however_late_it_is_taken(camera: FakeCamera) -> None:
    sequence = open_sequence("0", fov=60.0, stride=2)
    time.sleep(0.15)  # loading a frontend takes longer
    frames = [(frame.source_index, int(frame.image[0, 0])) for frame in sequence]
    assert frames[0] == (0, 0)
    assert all(number == pixel for number, pixel in frames)


@pytest.mark.parametrize("kind", [PurePosixPath, PureWindowsPath])
def test_an_address_that_went_through_a_path_is_still_one(kind: type[PurePath]) -> None:
    for address in ("rtsp://cam:554/stream/1", "HTTP://10.0.0.1:8080/video?fps=5"):
        path = str(kind(address))
        assert live.is_live(path)
        assert live._address(path) == address
    assert not live.is_live("C:\\videos\\walk.mp4")
