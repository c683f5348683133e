"""What a command says of a folder that was begun under other settings: the flag to type, not the setting behind it."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from typing import Any

from improvo.continuation import DifferentSettingsError, short, value_of
from improvo.sequences.given_files import CONTENTS

Words = Callable[[Any], str]  # of all settings: the flag as it was typed for them; empty where none stands for them
_HASH = "sha256:"


def add_words(parser: argparse.ArgumentParser, words: Mapping[str, Words]) -> None:
    """Say for further settings what was typed, where that is more than a value; `in_flags` reads it back.

    Args:
        parser: of the command.
        words: by the name of the setting.
    """
    parser.set_defaults(words_of_settings={**(parser.get_default("words_of_settings") or {}), **words})


def in_flags(error: DifferentSettingsError, arguments: argparse.Namespace) -> str:
    """The message, with what the user types in place of settings.

    Args:
        error: of the folder.
        arguments: of the command.
    """
    flags = {setting: f"--{dest.replace('_', '-')}" for dest, setting in getattr(arguments, "flags", {}).items()}
    flags |= {entry: flags[setting] for setting, entry in CONTENTS.items() if setting in flags}
    flags |= {name: f"--{name}" for name in ("after", "evaluate") if hasattr(arguments, name)}
    of_list = error.list_words({**flags, "sequences": "the recording"}.get(error.name, error.name))
    special = getattr(arguments, "words_of_settings", {}).get(error.name)
    if of_list or (special is None and error.name not in flags):
        return error.message(of_list) if of_list else str(error)
    words = special or flag_words(error.name, flags[error.name])
    before, now = words(error.recorded), words(error.given)
    if before and now and before != now:
        return error.message(f"{before}, now {now}")
    return error.message(f"with another {flags[error.name]}") if special is None else str(error)


def flag_words(setting: str, flag: str) -> Words:
    """Words of a setting whose value is what is typed behind a flag."""
    named = {entry: setting for setting, entry in CONTENTS.items()}.get(setting, setting)

    def words(settings: Any) -> str:
        value = value_of(setting, settings)
        if isinstance(value, bool):
            return f"with {flag}" if value else f"without {flag}"
        if value in (None, "", []):
            return f"without {flag}"
        if str(value).startswith(_HASH):  # of a file, which has a name there, or none
            value = value_of(named, settings) if named != setting else None
        if isinstance(value, list):
            value = " ".join(map(str, value))
        return f"with {flag} {short(value)}" if value is not None else ""

    return words
