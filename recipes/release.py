"""Builds the wheel and the source package of a release, twice, and compares the bytes.

    pip install build
    python recipes/release.py --url https://HOST/OWNER/REPOSITORY -o dist

Only committed files go in. The README's relative links and pictures are made to point into the repository at the tag of
this version, so that they work on an index page, and the project's addresses are added to the metadata. A version
that CHANGELOG.md does not describe is refused. Needs Python 3.11 or later.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?://|#|mailto:)([^)\s]+)\)")


def main() -> None:
    """Build into the folder; status 1 where two builds differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--url", required=True, help="of the repository, as a browser shows it")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        first, second = (built(Path(place, name), arguments.url.rstrip("/")) for name in ("first", "second"))
        for name in sorted({*first, *second}):
            if name not in first or name not in second or digest(first[name]) != digest(second[name]):
                sys.exit(f"{name}: two builds differ")
        arguments.output.mkdir(parents=True, exist_ok=True)
        for name, path in first.items():
            shutil.copy2(path, arguments.output / name)
            print(f"{digest(path)}  {name}")


def built(folder: Path, url: str) -> dict[str, Path]:
    """The packages by name, built from a copy of the last commit."""
    source = folder / "source"
    source.mkdir(parents=True)
    archive = folder / "source.tar"
    git("archive", "--format=tar", "-o", str(archive), "HEAD")
    with tarfile.open(archive) as tar:
        tar.extractall(source, filter="data")
    project = source / "pyproject.toml"
    version = re.search(r'^version = "(.+)"$', project.read_text(encoding="utf-8"), re.MULTILINE)
    if version is None or f"## {version[1]}" not in (source / "CHANGELOG.md").read_text(encoding="utf-8"):
        sys.exit("CHANGELOG.md: has no section of this version")
    readme = source / "README.md"
    readme.write_text(with_absolute_links(readme.read_text(encoding="utf-8"), url, f"v{version[1]}"), encoding="utf-8")
    project.write_text(with_urls(project.read_text(encoding="utf-8"), url), encoding="utf-8")
    environment = {**os.environ, "SOURCE_DATE_EPOCH": git("log", "-1", "--format=%ct"), "PYTHONHASHSEED": "0"}
    command = [sys.executable, "-m", "build", "--outdir", str(folder / "dist"), str(source)]
    subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)
    return {path.name: path for path in (folder / "dist").iterdir()}


def with_absolute_links(text: str, url: str, tag: str) -> str:
    """Markdown whose relative links lead to the repository at a tag; pictures to the file itself."""

    def absolute(match: re.Match[str]) -> str:
        picture, words, target = match.groups()
        return f"{picture}[{words}]({url}/{'raw' if picture else 'blob'}/{tag}/{target})"

    return LINK.sub(absolute, text)


def with_urls(project: str, url: str) -> str:
    """pyproject.toml with the project's addresses."""
    table = f'[project.urls]\nSource = "{url}"\nIssues = "{url}/issues"\nChangelog = "{url}/blob/main/CHANGELOG.md"\n\n'
    return project.replace("[project.scripts]", f"{table}[project.scripts]", 1)


def git(*words: str) -> str:
    """What git prints."""
    return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def digest(path: Path) -> str:
    """SHA-256."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


if __name__ == "__main__":
    main()
