"""Runs the README's commands with the improvo that is installed, on the bundled recording; looks at what they leave.

    python recipes/try_installed.py [--frames 60]

Needs the base install alone. It refuses to try a checkout's `src`: the wheel must be installed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SNIPPET = """
from pathlib import Path

import improvo

demo = Path(improvo.__file__).parent / "simulation" / "bundled" / "demo"
sequence = improvo.open_sequence(demo, max_frames=30)
frontend = improvo.load_frontend("superpoint-vo")
with improvo.VisualOdometry(frontend, sequence.camera) as odometry:
    for frame in sequence:
        odometry.track(frame)
print(odometry.trajectory.camera_centers.shape, odometry.map.xyz.shape)
assert odometry.trajectory.valid.sum() > 20
"""


def main() -> None:
    """Stops at the first command that fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60)
    arguments = parser.parse_args()
    import improvo
    from improvo.errors import plots_installed

    if "site-packages" not in str(improvo.__file__):
        sys.exit(f"{improvo.__file__}: is the source, not an installed wheel")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        try_command(folder, "info", "demo")
        try_command(folder, "run", "demo", "-o", "out", "--max-frames", str(arguments.frames))
        report = json.loads((folder / "out" / "run.json").read_text(encoding="utf-8"))
        tracked = report["frames"]["tracked"]
        assert tracked > 0.8 * arguments.frames, f"{tracked} of {arguments.frames} frames have a pose"
        print(f"{tracked} of {arguments.frames} frames have a pose; versions: {report['versions']}", flush=True)
        try_command(folder, "show", "labels", "out")
        try_command(folder, "report", "out")
        assert list(folder.rglob("*.png")), "no picture of the labels"
        if plots_installed():
            try_command(folder, "show", "map", "out")
        else:
            refused_in_one_line(folder, "improvo[plots]", "show", "map", "out")
        assert list(folder.rglob("*.html")), "no report"
        try_command(folder, "run", "demo", "-o", "sift", "--frontend", "sift", "--max-frames", "20")
        (folder / "snippet.py").write_text(SNIPPET, encoding="utf-8")
        timed([sys.executable, "snippet.py"], folder)


def try_command(folder: Path, *words: str) -> None:
    """A command of improvo."""
    timed([sys.executable, "-m", "improvo", *words, "--quiet"], folder)


def refused_in_one_line(folder: Path, mend: str, *words: str) -> None:
    """A command that needs an extra says so in one line, and ends with 2."""
    command = [sys.executable, "-m", "improvo", *words]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert ended.returncode == 2, ended
    assert mend in ended.stderr, ended
    assert ended.stderr.count("\n") == 1, ended
    print(f"        {ended.stderr.strip()}", flush=True)


def timed(command: list[str], folder: Path) -> None:
    """Run it in the folder; an error ends everything."""
    start = time.monotonic()
    subprocess.run(command, cwd=folder, check=True)
    print(f"{time.monotonic() - start:6.1f} s  {' '.join(command[1:])}", flush=True)


if __name__ == "__main__":
    main()
