"""Commands that are killed just before one of their files appears: what is there is whole, the next start goes on."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rendered_walk import write_walk

from improvo.cli.main import main
from improvo.errors import installed

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs fork and kill -9")

# Starts a command again and again in children of one process. Each is killed (kill -9) when one more of its files than
# in the start before is complete and about to get its name; prints how each start ended.
PROGRAM = """
import os, signal, sys
from importlib import import_module
for name in sys.argv[1].split(","):
    import_module(name)
from improvo.cli.main import main
left = -1
def hook(event, arguments):
    global left
    if event == "os.rename" and ".partial" in os.fspath(arguments[0]):
        left -= 1
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
sys.addaudithook(hook)
for count in range(int(sys.argv[2]), 1000, int(sys.argv[3])):
    child = os.fork()
    if child == 0:
        left = count
        os._exit(main(sys.argv[4:]))
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    print("ended:", status, flush=True)
    if status != -signal.SIGKILL:
        break
"""


def killed_at_each_file(words: list[str], modules: str, first: int = 1, step: int = 1) -> list[int]:
    """How the starts of a command end; all but the last are kills."""
    command = [sys.executable, "-c", PROGRAM, modules, str(first), str(step), *words, "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr, done.stderr
    statuses = [int(line.split()[1]) for line in done.stdout.splitlines() if line.startswith("ended:")]
    assert set(statuses[:-1]) == {-signal.SIGKILL}, done.stdout + done.stderr
    return statuses


def contents(folder: Path) -> dict[str, bytes]:
    """All files but those whose content is the time that things took."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name not in ("run.json", ".improvo.json")]
    assert not [path for path in folder.rglob(".*") if ".partial" in path.name]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walk") / "walk", frames=24, seed=3)


ORB = ["--frontend", "orb", "--max-keypoints", "200"]


def test_run(walk: Path, tmp_path: Path) -> None:
    """Without its run.json the folder is no result, and says so; with it all files are there."""
    calm, killed = tmp_path / "calm", tmp_path / "killed"
    words = ["run", str(walk), *ORB, "-o"]
    assert main([*words, str(calm), "--quiet"]) == 0
    modules = "improvo.cli.run,improvo.odometry.run.run_odometry,improvo.odometry.run.compile"
    statuses = killed_at_each_file([*words, str(killed)], modules, step=2)
    assert statuses[-1] == 0
    assert len(statuses) > 3
    assert contents(killed) == contents(calm)
    assert json.loads((killed / "run.json").read_text())["frames"]["tracked"] > 15


@pytest.mark.parametrize(("layout", "needs"), [("colmap", "pycolmap"), ("hloc", "h5py")])
def test_export_features(walk: Path, tmp_path: Path, layout: str, needs: str) -> None:
    if not installed(needs):
        pytest.skip(f"needs {needs}")
    calm, killed = tmp_path / "calm", tmp_path / "killed"
    words = ["export", "features", str(walk), "--layout", layout, *ORB[:4], "--max-frames", "5", "-o"]
    assert main([*words, str(calm), "--quiet"]) == 0
    statuses = killed_at_each_file([*words, str(killed)], "improvo.cli.export_features", first=1, step=2)
    assert statuses[-1] == 0
    assert len(statuses) > 3
    databases = [{name: data for name, data in contents(one).items() if name[-3:] != ".db"} for one in (calm, killed)]
    assert databases[0] == databases[1]
    assert [path.name for path in killed.rglob("*.db")] == (["database.db"] if layout == "colmap" else [])


def test_weights_export(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A folder is completed; a file that is there is not replaced, and the message says what to do."""
    words = ["weights", "export", "superpoint-small", "--layout", "transformers", "-o"]
    assert main([*words, str(tmp_path / "calm"), "--quiet"]) == 0
    statuses = killed_at_each_file([*words, str(tmp_path / "killed")], "improvo.cli.weights")
    assert statuses == [-signal.SIGKILL] * 5 + [0]
    assert contents(tmp_path / "killed") == contents(tmp_path / "calm")
    target = tmp_path / "file" / "weights.safetensors"
    target.parent.mkdir()
    words = ["weights", "export", "superpoint-small", "--layout", "original", "-o", str(target)]
    assert killed_at_each_file(words, "improvo.cli.weights") == [-signal.SIGKILL, -signal.SIGKILL, 2]
    capsys.readouterr()
    assert main(words) == 2
    assert "it or its .json exists already; choose another file with -o" in capsys.readouterr().err
    assert sorted(path.name for path in target.parent.iterdir()) == ["weights.safetensors"]  # it is whole
    again = target.with_name("again.safetensors")
    assert main([*words[:-1], str(again), "--quiet"]) == 0
    assert again.read_bytes() == target.read_bytes()


def test_a_torch_file_does_not_depend_on_the_process(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="needs torch: pip install 'improvo[train]'")
    for name in ("a.pth", "b.pth"):
        words = ["weights", "export", "superpoint-small", "--layout", "original", "-o", str(tmp_path / name)]
        assert main([*words, "--quiet"]) == 0
    assert (tmp_path / "a.pth").read_bytes() == (tmp_path / "b.pth").read_bytes()


def test_truth(walk: Path, tmp_path: Path) -> None:
    """Pictures that are there are used again; poses appear when all is done."""
    pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'improvo[truth]'")
    poses = tmp_path / "poses.txt"
    poses.write_text("\n".join(f"{i / 30} {i / 100} {np.sin(i)} 0 0 0 0 1" for i in range(24)))
    limits = [f"truth.{name}=100" for name in ("max_scale_spread", "max_disagreement", "max_aspect_change")]
    words = ["truth", str(walk), "--scale-from", str(poses), "--max-features", "500", "--max-frames", "18"]
    words += [word for limit in limits for word in ("--set", limit)]
    statuses = killed_at_each_file([*words, "-o", str(tmp_path / "truth.txt")], "improvo.cli.truth", first=2, step=16)
    assert statuses[-1] == 0
    assert len(statuses) > 1
    assert len((tmp_path / "truth.txt").read_text().splitlines()) > 10
    assert not [path for path in tmp_path.rglob("*") if ".partial" in path.name]


def test_demo_that_is_interrupted_in_one_of_its_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It says so once, with the status of an interrupt, and the same command again begins with what is there."""

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("improvo.sequences.open_sequence", interrupt)
        assert main(["demo", "-o", str(tmp_path / "demo"), "--quiet"]) == 130
    assert capsys.readouterr().err == "improvo: interrupted\n"
    with monkeypatch.context() as patch:
        patch.setattr("improvo.cli.demo._do", interrupt)
        assert main(["demo", "-o", str(tmp_path / "demo"), "--quiet"]) == 130
    assert capsys.readouterr().err == "improvo: interrupted\n"
