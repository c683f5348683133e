"""Every command line of README and docs is one that the command line accepts: words, options, choices, counts."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
from pathlib import Path

import pytest

from improvo.cli.commands import leaves
from improvo.cli.main import parser_for

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
_PLACEHOLDER = re.compile(r"\.\.\.|…|\[|\bVERB\b|\bCOMMAND\b|\{|NAME=|LAYOUT|A,B --pair I,J")


def command_lines(text: str) -> list[str]:
    """Lines of code that begin with `improvo`, continued ones joined, comments and pipes left out; and inline code."""
    joined = re.sub(r"\s*\\\n\s*", " ", text)
    lines = [match[1] for match in re.finditer(r"^(?: {4}|\$ )?(improvo [a-z].*)$", joined, flags=re.MULTILINE)]
    prose = re.sub(r"```.*?```", "", joined, flags=re.DOTALL)
    lines += [" ".join(match[1].split()) for match in re.finditer(r"`(improvo [a-z][^`]*)`", prose)]
    return [re.split(r"\s+#|\s\||\s>|\s2>|;", line)[0].strip() for line in lines]


def complete_lines(text: str) -> list[str]:
    """Those that are whole: a name of a command alone, or with what it cannot do without left out, is none."""
    return [line for line in command_lines(text) if not _PLACEHOLDER.search(line)]


def problem(line: str) -> str:
    """What the command line says of it; empty if nothing."""
    words = shlex.split(re.sub(r"\b[a-z0-9]+://", "", line))[1:]  # a location would be looked up
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            parser_for(words).parse_args(words)
    except SystemExit as end:
        return said.getvalue() if end.code else ""
    return ""


def test_lines_are_found() -> None:
    text = (
        "a\n\n    improvo run a.mp4 \\\n        -o out   # why\n\nsee `improvo info\na.mp4`; `improvo show ... -o x`\n"
    )
    assert complete_lines(text) == ["improvo run a.mp4 -o out", "improvo info a.mp4"]
    assert "unrecognized" in problem("improvo run a.mp4 -o out --nobody")
    assert problem("improvo run a.mp4 -o out") == ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_of_the_page_are_accepted(page: Path) -> None:
    known = {" ".join(words) for words, _ in leaves()}
    wrong = {}
    for line in complete_lines(page.read_text(encoding="utf-8")):
        said = problem(line)
        named_only = re.search("required|expected", said) and any(line.startswith(f"improvo {name}") for name in known)
        if said and not named_only and line.removeprefix("improvo ") not in {*known, *(n.split()[0] for n in known)}:
            wrong[line] = said.strip()
    assert not wrong
