"""Asks a resolver whether wheels of every dependency exist for the platforms and Pythons that the README names.

    pip install uv
    python recipes/wheels.py                                # the base install, all platforms and Pythons
    python recipes/wheels.py --extra train --python 3.12    # with an extra
    python recipes/wheels.py --each                         # where it fails: which dependencies have no wheel

Nothing is installed and no wheel is downloaded whole. The index is the one that uv is set up with. Ends with status 1
if a claimed combination has no solution. Needs Python 3.11 or later itself.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import tomllib

ROOT = Path(__file__).parents[1]
PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
PLATFORMS = {  # what we call it: the resolver's name
    "Linux x86-64 (glibc 2.28 or later)": "x86_64-manylinux_2_28",
    "Linux ARM64 (glibc 2.31 or later)": "aarch64-manylinux_2_31",
    "macOS ARM64 (14 or later)": "aarch64-apple-darwin",
    "macOS Intel": "x86_64-apple-darwin",
    "Windows x86-64": "x86_64-pc-windows-msvc",
    "Windows ARM64": "aarch64-pc-windows-msvc",
}
CLAIMED = ("Linux x86-64", "Linux ARM64", "macOS ARM64", "Windows x86-64")  # beginnings of names, all of PYTHONS


def main() -> None:
    """Print a table with a row per platform; a cell is `yes`, or the dependencies without a wheel."""
    arguments = parse()
    requirements = dependencies(arguments.extra)
    bad = False
    print("| |" + "".join(f" {python} |" for python in arguments.python), flush=True)
    print("|---|" + "---|" * len(arguments.python), flush=True)
    for label, platform in PLATFORMS.items():
        cells = []
        for python in arguments.python:
            answer = resolved(requirements, platform, python)
            if answer and arguments.each:
                alone = ", ".join(each for each in requirements if resolved([each], platform, python))
                answer = alone or f"{answer} (together)"
            cells.append(answer or "yes")
            bad |= bool(answer) and label.startswith(CLAIMED)
        print(f"| {label} |" + "".join(f" {cell} |" for cell in cells), flush=True)
    sys.exit(int(bad))


def dependencies(extras: list[str]) -> list[str]:
    """Of the base install and the extras, as pyproject.toml has them."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [*project["dependencies"], *(each for extra in extras for each in project["optional-dependencies"][extra])]


def resolved(requirements: list[str], platform: str, python: str) -> str:
    """Empty where there is a set of wheels, else why there is none, in one line."""
    with tempfile.TemporaryDirectory() as place:
        listed = Path(place, "requirements.in")
        listed.write_text("\n".join(requirements), encoding="utf-8")
        options = ["--no-header", "--quiet", "--only-binary", ":all:", "--python-platform", platform]
        uv = shutil.which("uv") or str(Path(sys.executable).with_name("uv"))
        command = [uv, "pip", "compile", *options, "--python-version", python, str(listed)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return ""
    named = re.findall(r"(?:Because|because|and) (?:only )?([a-z][\w-]+)[<>=!{ ]", done.stderr)
    return "no: " + (", ".join(dict.fromkeys(named[:3])) or done.stderr.strip().splitlines()[-1][:80])


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--extra", nargs="*", default=[], metavar="NAME")
    parser.add_argument("--python", nargs="+", default=list(PYTHONS), metavar="VERSION")
    parser.add_argument("--each", action="store_true", help="name each dependency without a wheel")
    return parser.parse_args()


if __name__ == "__main__":
    main()
