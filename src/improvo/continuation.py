"""Unfinished work goes on only under the settings that it was begun with: one class for every folder of results."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from improvo import config
from improvo.errors import ConfigError, InputError
from improvo.files import write_json, write_text
from improvo.untrusted.paths import check_is_file, check_readable
from improvo.untrusted.text import load_json, load_yaml

_LONGEST_VALUE = 60  # characters of a value in a message


class DifferentSettingsError(ConfigError):
    """A folder of results was begun under other settings.

    Args:
        folder: of the results.
        name: of the first setting that differs, with dots.
        recorded: all settings that the folder was begun with, as nested dictionaries.
        given: all of them now.
        mend: what the user can do.
    """

    def __init__(self, folder: Path, name: str, recorded: Any, given: Any, mend: str) -> None:
        self.folder, self.name, self.recorded, self.given, self.mend = folder, name, recorded, given, mend
        super().__init__(self.message(self.list_words(name) or f"with {_values_words(name, recorded, given)}"))

    def list_words(self, called: str) -> str:
        """What a list of words lacks, or has more; empty where the setting is none. Two long ones look alike when cut.

        Args:
            called: what the message calls the list.
        """
        before, now = value_of(self.name, self.recorded), value_of(self.name, self.given)
        if not (
            isinstance(before, list) and isinstance(now, list) and all(isinstance(one, str) for one in before + now)
        ):
            return ""
        for words, one, other in (("with", before, now), ("without", now, before)):
            only = next((item for item in one if item not in other), None)
            if only is not None:
                return f"{words} {called} {only}"
        return f"with {called} in another order"

    def message(self, difference: str) -> str:
        """The whole message, with other words for what differs."""
        return f"{self.folder}: was begun {difference}; {self.mend}"


class SettingsRecord:
    """A file that says what the results beside it depend on.

    Settings under former names (`config.FORMER_NAMES`) count as the present ones.

    Args:
        path: of the file, YAML or `.json`.
        kind: class of the settings, if they have one. A setting that the file lacks, because it came with a later
            version, counts as having its default.
        free: dotted names of settings that may differ, because no result depends on them.
        contents: dotted names of settings that name files, each with the entry that says what is in these. Where the
            record has the entry, only that is compared; a record of an earlier version has none.
    """

    def __init__(
        self,
        path: Path,
        kind: type | None = None,
        free: Iterable[str] = (),
        contents: Mapping[str, str] | None = None,
    ) -> None:
        self.path = path
        self._defaults = config.to_dict(kind()) if kind else {}
        self._section = config.section_of(kind) if kind else ""
        self._free, self._contents = tuple(free), dict(contents or {})

    def read(self) -> Any:
        """The recorded settings under their present names; None where there is no record.

        Raises:
            InputError: the file is damaged, or may not be read.
        """
        if not self.path.exists():
            return None
        check_is_file(check_readable(self.path))
        try:
            text = self.path.read_text(encoding="utf-8")
            values = load_json(text) if self.path.suffix == ".json" else load_yaml(text)
        except (OSError, ValueError):
            values = None
        if values is None:
            raise InputError(f"{self.path}: is damaged; choose another output folder")
        return config.with_present_names(values, self._section)

    def difference(self, settings: Any) -> str:
        """The first setting that differs from the record, in words; empty where none does or nothing is recorded."""
        before, now, _, _ = self._compared(settings)
        return first_difference(before, now)

    def check(self, settings: Any, mend: str) -> None:
        """Refuse to go on under other settings.

        Args:
            settings: as plain dictionaries, see `config.to_dict`.
            mend: what the user can do, at the end of the message.

        Raises:
            DifferentSettingsError: a setting differs; the message names the first one.
            InputError: the record is damaged.
        """
        before, now, recorded, given = self._compared(settings)
        name = first_different(before, now)
        if name is not None:
            raise DifferentSettingsError(self.path.parent, name, recorded, given, mend)

    def write(self, settings: Any) -> None:
        """Record the settings."""
        import yaml

        if self.path.suffix == ".json":
            write_json(self.path, settings)
        else:
            write_text(self.path, yaml.safe_dump(settings, sort_keys=False))

    def _compared(self, settings: Any) -> tuple[Any, Any, Any, Any]:
        """What the record and the settings say of all that must not differ, then all that they say; alike if no record.

        Raises:
            InputError: the record is damaged.
        """
        before = self.read()
        if before is None:
            return settings, settings, settings, settings
        if isinstance(before, dict) and isinstance(settings, dict):
            before = config.over(self._defaults, before)
        known = before.keys() if isinstance(before, dict) else ()
        free = [name if entry in known else entry for name, entry in self._contents.items()]
        return self._fixed(before, free), self._fixed(settings, free), before, settings

    def _fixed(self, settings: Any, free: Iterable[str]) -> Any:
        """A copy without the settings that may differ."""
        fixed = copy.deepcopy(settings)
        for name in (*self._free, *free):
            *sections, leaf = name.split(".")
            section = fixed
            for part in sections:
                section = section.get(part) if isinstance(section, dict) else None
            if isinstance(section, dict):
                section.pop(leaf, None)
        return fixed


def first_difference(before: Any, now: Any) -> str:
    """The first setting that differs between two nested dictionaries, in words; empty where none does.

    Args:
        before: nested dictionaries, or a value.
        now: the same, later.
    """
    name = first_different(before, now)
    return "" if name is None else _values_words(name, before, now)


def first_different(before: Any, now: Any) -> str | None:
    """The name, with dots, of the first setting that differs between two nested dictionaries; None where none does."""
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return None if before == now else ""
    for key in [*before, *(key for key in now if key not in before)]:
        below = first_different(before.get(key), now.get(key))
        if below is not None:
            return f"{key}.{below}".rstrip(".")
    return None


def value_of(name: str, settings: Any) -> Any:
    """What nested dictionaries say of a setting; None where they do not have it."""
    for part in name.split(".") if name else ():
        settings = settings.get(part) if isinstance(settings, dict) else None
    return settings


def short(value: Any) -> str:
    """A value for a message, cut where it is long."""
    text = str(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 3]}..."


def _values_words(name: str, before: Any, now: Any) -> str:
    return f"{name}={short(value_of(name, before))}, now {short(value_of(name, now))}"
