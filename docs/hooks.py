"""MkDocs hooks: pages that the navigation does not name, and the options of every command."""

from __future__ import annotations

import argparse
import contextlib
import io
from pathlib import Path
from typing import Any

_OPTIONS_HERE = "<!-- options of all commands -->"


def on_config(config: Any) -> Any:
    """Append the pages that `nav` does not name, so that none is lost."""
    named = set(_pages(config["nav"]))
    folder = Path(config["docs_dir"])
    others = [path.name for path in sorted(folder.glob("*.md")) if path.name not in named]
    if others:
        config["nav"].append({"In depth": others})
    return config


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Put what `sivo VERB --help` prints where a page asks for it."""
    return markdown.replace(_OPTIONS_HERE, "\n".join(_help_texts())) if _OPTIONS_HERE in markdown else markdown


def _pages(nav: Any) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    parts = nav.values() if isinstance(nav, dict) else nav
    return [page for part in parts for page in _pages(part)]


def _help_texts() -> list[str]:
    from sivo.cli.main import COMMANDS, main

    lines = []
    for verb in COMMANDS:
        for words in ([verb], *([verb, sub] for sub in _subcommands(verb))):
            text = io.StringIO()
            with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
                main([*words, "--help"])
            lines += [f"### `sivo {' '.join(words)}`", "", "```text", text.getvalue().strip(), "```", ""]
    return lines


def _subcommands(verb: str) -> list[str]:
    """The sub-commands of a verb, in their order."""
    import importlib

    from sivo.cli.main import COMMANDS

    parser = argparse.ArgumentParser()
    importlib.import_module(f"sivo.cli.{COMMANDS[verb][0]}").add_arguments(parser)
    actions = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    return [name for action in actions for name in action.choices]
