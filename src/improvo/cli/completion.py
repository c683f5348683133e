"""A completion script for your shell: commands, options and their choices, files where files are wanted.

Put its output where the shell looks, for bash `~/.local/share/bash-completion/completions/improvo`. The script stands
alone, so completing does not start improvo; print it again after an update.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from improvo.cli.options import folder_path, pictures_source, read_folder_path, recording_path
from improvo.errors import imported

_SHELLS = ("bash", "zsh", "fish")
_OF_FILES = (Path, recording_path, pictures_source, folder_path, read_folder_path)  # types of arguments that are paths


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The shell."""
    parser.add_argument("shell", choices=_SHELLS, help="whose script to print")


def run(arguments: argparse.Namespace) -> None:
    """Print the script.

    Raises:
        MissingExtraError: the package shtab is not installed.
    """
    from improvo.cli.main import whole_parser

    shtab = imported("shtab", "printing a completion script", "completion")
    parser = whole_parser()
    _mark_files(parser, shtab.FILE)
    print(shtab.complete(parser, arguments.shell))


def _mark_files(parser: argparse.ArgumentParser, mark: object) -> None:
    """Tell shtab which arguments are files; the parsers of sub-commands too."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for part in action.choices.values():
                _mark_files(part, mark)
        elif action.type in _OF_FILES:
            action.complete = mark  # type: ignore[attr-defined]
