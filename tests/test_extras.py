"""What the base install does without SciPy, matplotlib and torch, and what says that it needs one of them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "src" / "improvo"
WITHOUT = """
import sys
sys.modules["scipy"] = sys.modules["matplotlib"] = sys.modules["torch"] = None
from improvo.cli.main import main
sys.exit(main(sys.argv[1:]))
"""


def improvo(*words: str) -> subprocess.CompletedProcess[str]:
    """A command in a process where none of them can be imported."""
    return subprocess.run([sys.executable, "-c", WITHOUT, *words], capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a network, which also aligns patches, with its report."""
    folder = tmp_path_factory.mktemp("base") / "out"
    ended = improvo("run", "demo", "-o", str(folder), "--max-frames", "20", "--report")
    assert ended.returncode == 0, ended.stderr
    return folder


def test_a_run_and_its_report(out: Path) -> None:
    page = (out / "report.html").read_text(encoding="utf-8")
    assert 'id="scene"' in page
    assert "pip install &#x27;improvo[plots]&#x27;" in page or "pip install 'improvo[plots]'" in page


def test_pictures_of_labels(out: Path) -> None:
    ended = improvo("show", "labels", str(out))
    assert ended.returncode == 0, ended.stderr
    assert list((out / "pictures").glob("labels*.png"))


def test_the_demo_does_all_but_the_training(tmp_path: Path) -> None:
    ended = improvo("demo", "-o", str(tmp_path / "demo"), "--frontend", "orb")
    assert ended.returncode == 0, ended.stderr
    assert "pip install 'improvo[plots]'" in ended.stdout
    assert "pip install 'improvo[train]'" in ended.stdout
    assert (tmp_path / "demo" / "run" / "report.html").exists()
    assert sorted(file.name for file in (tmp_path / "demo" / "run" / "pictures").iterdir()) == [
        "labels.png",
        "tracks.png",
    ]


@pytest.mark.parametrize(
    ("words", "mend"),
    [
        (("show", "map", "OUT"), "improvo[plots]"),
        (("calibrate", "--print-board", "OUT/board.pdf"), "improvo[plots]"),
        (("simulate", "-o", "OUT/room", "--frames", "2"), "improvo[simulate]"),
        (("train", "shapes", "-o", "OUT/shapes"), "improvo[train]"),
    ],
    ids=lambda words: words[0] if isinstance(words, tuple) else words,
)
def test_what_needs_an_extra_says_so_in_one_line(out: Path, words: tuple[str, ...], mend: str) -> None:
    ended = improvo(*(word.replace("OUT", str(out)) for word in words))
    assert ended.returncode == 2
    assert mend in ended.stderr
    assert ended.stderr.count("\n") == 1


def test_scipy_and_matplotlib_stay_where_extras_bring_them() -> None:
    at_home = {"scipy": {"simulation", "training"}, "matplotlib": {"evaluation", "report", "calibration"}}
    for package, rooms in at_home.items():
        users = {
            file.relative_to(PACKAGE).parts[0]
            for file in PACKAGE.rglob("*.py")
            if any(line.split()[:1] in (["from"], ["import"]) and line.split()[1].split(".")[0] == package
                   for line in file.read_text(encoding="utf-8").splitlines())
        }  # fmt: skip
        assert users <= rooms, package
