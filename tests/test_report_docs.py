"""The documentation names things that exist, and builds without a warning."""

from __future__ import annotations

import ast
import contextlib
import importlib.util
import io
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from improvo.cli.commands import COMMANDS
from improvo.cli.main import main

ROOT = Path(__file__).parents[1]
PAGES = (
    "index",
    "tutorial",
    "architecture",
    "commands",
    "pictures",
    "export",
    "conventions",
    "paper-to-code",
    "reference",
)


def text_of(page: str) -> str:
    return (ROOT / "docs" / f"{page}.md").read_text()


def exists(name: str) -> bool:
    """Whether `improvo.a.b.C.d` is a module, or a name that a module defines; nothing is imported."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        base = ROOT / "src" / Path(*parts[:length])
        module = base.with_suffix(".py")
        file = module if module.is_file() else base / "__init__.py"
        if file.is_file():
            return defines(ast.parse(file.read_text()).body, parts[length:]) or (
                length == 1 and f'"{parts[1]}"' in file.read_text()  # the short names of the package itself
            )
    return False


def defines(body: list[ast.stmt], names: list[str]) -> bool:
    if not names:
        return True
    for statement in body:
        if isinstance(statement, ast.ClassDef | ast.FunctionDef) and statement.name == names[0]:
            return defines(statement.body, names[1:])
    return False


@pytest.mark.parametrize("page", PAGES)
def test_names_of_modules_and_functions_exist(page: str) -> None:
    names = set(re.findall(r"(?<![\w/])improvo(?:\.\w+)+", text_of(page)))
    missing = {name for name in names if not exists(name) and not name.endswith((".yml", ".md"))}
    assert not missing
    if page in ("paper-to-code", "reference"):
        assert len(names) > 20


@pytest.mark.parametrize("page", ["README.md", "docs/architecture.md"])
def test_places_in_the_code_exist(page: str) -> None:
    text = (ROOT / page).read_text()
    places = re.findall(r"`([a-z_]+/(?:[\w/]+\.py)?)`", text)
    assert len(places) > 7
    for place in places:
        assert (ROOT / "src" / "improvo" / place).exists() or (ROOT / place).exists(), place


@cache
def help_of(words: tuple[str, ...]) -> str:
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text), contextlib.suppress(SystemExit):
        main([*words, "--help"])
    return text.getvalue()


@pytest.mark.parametrize("page", ["index", "tutorial", "commands", "pictures", "export", "paper-to-code"])
def test_commands_and_their_options_exist(page: str) -> None:
    commands = re.findall(r"(?:^|`)(improvo [a-z][^`\n#]*)", text_of(page), flags=re.MULTILINE)
    assert len(commands) >= 4 or page == "index"
    for command in commands:
        words = command.split()
        assert words[1] in COMMANDS, command
        verb = (words[1], words[2]) if COMMANDS[words[1]].parts and len(words) > 2 else (words[1],)
        text = help_of(verb)
        assert "usage:" in text, command
        assert "invalid choice" not in text, command
        for option in re.findall(r"--[a-z][a-z-]*", command):
            assert option in text, f"{command}: no option {option}"


@pytest.mark.skipif(
    importlib.util.find_spec("mkdocs") is None or importlib.util.find_spec("mkdocstrings") is None,
    reason="needs MkDocs: pip install 'improvo[docs]'",
)
def test_site_builds_without_a_warning(tmp_path: Path) -> None:
    pages = sorted((ROOT / "docs").glob("*.md"))
    build = subprocess.run(
        # not quiet: that hides warnings from the count of --strict, too
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(tmp_path / "site")],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert build.returncode == 0, build.stderr
    commands = (tmp_path / "site" / "commands" / "index.html").read_text()
    assert "usage: improvo run" in commands
    assert "usage: improvo export colmap" in commands
    models = (tmp_path / "site" / "models" / "index.html").read_text()
    for card in (ROOT / "src" / "improvo" / "frontend" / "weights").glob("*.json"):
        assert f"<code>{card.stem}</code>" in models
    for page in pages:
        name = "" if page.stem == "index" else page.stem
        assert (tmp_path / "site" / name / "index.html").is_file(), page
