"""What the package calls itself: one name everywhere, and hints that install it and not a stranger's package."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FORMER = "si" + "vo"  # in two parts, so that this file does not name it
MAY_NAME_IT = {"src/improvo/files.py"}  # FORMER_NAME: what was written under it stays readable
TEXT = {".py", ".md", ".toml", ".yml", ".yaml", ".json", ".js", ".css", ".txt", ".cfg", ".cff", ""}


def tracked_files() -> list[Path]:
    """Every text file of the repository."""
    try:
        names = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("needs the repository's git directory")
    return [ROOT / name for name in names.splitlines() if Path(name).suffix in TEXT and (ROOT / name).is_file()]


def distribution() -> tuple[str, set[str]]:
    """Name and extras of the distribution, from pyproject.toml."""
    text = (ROOT / "pyproject.toml").read_text()
    name = re.search(r'^name = "(.+)"', text, flags=re.MULTILINE)
    section = re.search(r"^\[project\.optional-dependencies\]\n(.*?)^\[", text, flags=re.MULTILINE | re.DOTALL)
    assert name is not None
    assert section is not None
    return name[1], set(re.findall(r"^(\w+) = \[", section[1], flags=re.MULTILINE))


def test_nothing_names_the_former_package() -> None:
    named = [
        str(path.relative_to(ROOT))
        for path in tracked_files()
        if re.search(rf"\b{FORMER}\b|{FORMER}[_.]", path.read_text(errors="replace"), flags=re.IGNORECASE)
    ]
    assert set(named) <= MAY_NAME_IT
    text = (ROOT / "src" / "improvo" / "files.py").read_text()
    assert text.count(FORMER) == 1


def test_hints_install_this_distribution_and_extras_that_exist() -> None:
    name, extras = distribution()
    assert name == "improvo"
    found = 0
    for path in tracked_files():
        if path.is_relative_to(ROOT / "tests"):
            continue  # they make up extras
        text = path.read_text(errors="replace")
        for hint in re.findall(r"pip install[^\n`]*?['\"]([\w.-]+)\[([\w, {}.]+)\]", text):
            found += 1
            assert hint[0] in (name, "."), f"{path}: {hint}"
            if "{" not in hint[1]:
                assert set(hint[1].replace(" ", "").split(",")) <= extras, f"{path}: {hint}"
    assert found > 10
    for path in (ROOT / "src").rglob("*.py"):
        for extra in re.findall(r"MissingExtraError\([^)]*?\"(\w+)\"\)", path.read_text(), flags=re.DOTALL):
            assert extra in extras, f"{path}: no extra {extra}"


def test_the_command_is_the_distribution() -> None:
    text = (ROOT / "pyproject.toml").read_text()
    assert 'improvo = "improvo.__main__:main"' in text
    shown = subprocess.run([sys.executable, "-m", "improvo", "--version"], capture_output=True, text=True, check=True)
    assert shown.stdout.startswith("improvo ")
