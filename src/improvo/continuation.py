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
        before = self.read()
        if before is None:
            return ""
        if isinstance(before, dict) and isinstance(settings, dict):
            before = config.over(self._defaults, before)
        known = before.keys() if isinstance(before, dict) else ()
        free = [name if entry in known else entry for name, entry in self._contents.items()]
        return first_difference(self._fixed(before, free), self._fixed(settings, free))

    def check(self, settings: Any, mend: str) -> None:
        """Refuse to go on under other settings.

        Args:
            settings: as plain dictionaries, see `config.to_dict`.
            mend: what the user can do, at the end of the message.

        Raises:
            ConfigError: a setting differs; the message names the first one.
            InputError: the record is damaged.
        """
        difference = self.difference(settings)
        if difference:
            raise ConfigError(f"{self.path.parent}: was begun with {difference}; {mend}")

    def write(self, settings: Any) -> None:
        """Record the settings."""
        import yaml

        if self.path.suffix == ".json":
            write_json(self.path, settings)
        else:
            write_text(self.path, yaml.safe_dump(settings, sort_keys=False))

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


def first_difference(before: Any, now: Any, prefix: str = "") -> str:
    """The first setting that differs between two nested dictionaries, in words; empty where none does.

    Args:
        before: nested dictionaries, or a value.
        now: the same, later.
        prefix: of the names of settings, with a dot at its end.
    """
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return "" if before == now else f"{prefix.rstrip('.')}={_short(before)}, now {_short(now)}"
    for key in [*before, *(key for key in now if key not in before)]:
        difference = first_difference(before.get(key), now.get(key), f"{prefix}{key}.")
        if difference:
            return difference
    return ""


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 3]}..."
