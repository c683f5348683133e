"""No command opens a network socket, nor writes anything outside its output and our cache: in fresh processes."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
from rendered_walk import write_walk

SOURCE = Path(__file__).parents[1] / "src"
# An audit hook sees what Python and its libraries ask of the `socket` module, also in workers.
GUARD = """
import os, sys
def hook(event, args):
    if event in ("socket.getaddrinfo", "socket.gethostbyname", "socket.sendto"):
        told = args
    elif event in ("socket.connect", "socket.bind") and not isinstance(args[1], (str, bytes)):
        told = args[1:]
    else:
        return
    with open(os.environ["NETWORK_LOG"], "a") as log:
        log.write(f"{event} {told}\\n")
    raise OSError("no network in this test")
sys.addaudithook(hook)
"""
SMALL = (
    *("--max-keypoints", "250", "--set", "labels.min_observations=6", "--set", "validation.gaps=[4,8]"),
    *("--set", "validation.matches.pairs=4", "--set", "validation.min_pairs=2"),
    *("--set", "split.share=0.3", "--set", "validation.calibration_images=2"),
    *("--set", "odometry.start.min_points=20", "--steps", "1"),
)


class Guarded:
    """Runs commands in processes that may not reach a network, with a home folder of their own."""

    def __init__(self, folder: Path) -> None:
        self.home, self.log = folder / "home", folder / "network.txt"
        self.home.mkdir()
        (folder / "site").mkdir()
        (folder / "site" / "sitecustomize.py").write_text(GUARD)
        self._variables = {
            **{name: value for name, value in os.environ.items() if not name.startswith(("XDG_", "MPL", "CI"))},
            "PYTHONPATH": os.pathsep.join([str(folder / "site"), str(SOURCE)]),
            "NETWORK_LOG": str(self.log),
            "HOME": str(self.home),
            "USERPROFILE": str(self.home),
        }

    def python(self, *words: object) -> str:
        """Run Python; returns what it asked of the network."""
        done = subprocess.run(
            [sys.executable, *map(str, words)], env=self._variables, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr[-2000:]
        return self.log.read_text() if self.log.exists() else ""

    def improvo(self, *words: object) -> str:
        """Run a command; returns what it asked of the network."""
        return self.python("-m", "improvo", *words, "--quiet")

    def kept(self) -> list[str]:
        """Files in the home folder."""
        return sorted(str(path.relative_to(self.home)) for path in self.home.rglob("*") if path.is_file())


@pytest.fixture
def guarded(tmp_path: Path) -> Guarded:
    return Guarded(tmp_path)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walk") / "room", frames=24, seed=3)


def test_the_guard_sees_a_call(guarded: Guarded) -> None:
    program = "import socket\ntry: socket.create_connection(('127.0.0.1', 9))\nexcept OSError: pass"
    assert "socket.getaddrinfo" in guarded.python("-c", program)


def test_openvino_is_imported_without_its_telemetry(guarded: Guarded) -> None:
    program = (
        "import sys, improvo.frontend.runtime_openvino\n"
        "assert 'openvino' in sys.modules\n"
        "assert not any(name.split('.')[0] == 'openvino_telemetry' for name in sys.modules)"
    )
    assert guarded.python("-c", program) == ""
    assert guarded.kept() == []


def test_only_one_file_imports_openvino() -> None:
    package = SOURCE / "improvo"
    importing = [
        path.relative_to(package).as_posix()
        for path in package.rglob("*.py")
        if any(line.strip().startswith(("import openvino", "from openvino")) for line in path.read_text().splitlines())
    ]
    assert importing == ["frontend/openvino_library.py"]


def test_run_with_a_network_and_its_pictures(guarded: Guarded, walk: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert guarded.improvo("run", walk, "-o", out, "--frontend", "superpoint-small", "--max-keypoints", 250) == ""
    assert guarded.kept() == []
    assert guarded.improvo("show", "map", out) == ""
    assert all(name.startswith(os.path.join(".cache", "improvo", "")) for name in guarded.kept()), guarded.kept()


def test_label_with_workers(guarded: Guarded, walk: Path, tmp_path: Path) -> None:
    words = ("label", walk, "-o", tmp_path / "labels", "--frontend", "superpoint-small", "--max-keypoints", 250)
    assert guarded.improvo(*words, "--workers", 2) == ""
    assert guarded.kept() == []


@pytest.mark.skipif(importlib.util.find_spec("torch") is None, reason="needs the extra `train`")
def test_improve(guarded: Guarded, tmp_path: Path) -> None:
    room = write_walk(tmp_path / "room", frames=40, seed=3)
    assert guarded.improvo("improve", room, "-o", tmp_path / "out", "--frontend", "superpoint-small", *SMALL) == ""
    assert all(name.startswith(os.path.join(".cache", "improvo", "")) for name in guarded.kept()), guarded.kept()
