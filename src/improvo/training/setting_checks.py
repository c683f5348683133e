"""Checks of training settings: each names the setting, its value and what it may be."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Any

from improvo.errors import ConfigError


class Checks:
    """Checks of one group of settings.

    Args:
        settings: the dataclass, in its `__post_init__`.
        section: its name within the settings of a stage, such as `optimiser`; empty for the stage itself.
    """

    def __init__(self, settings: Any, section: str = "") -> None:
        self._settings, self._prefix = settings, f"{section}." if section else ""

    def at_least(self, least: float, *names: str) -> None:
        """Finite numbers of this size or more."""
        for name in names:
            value = getattr(self._settings, name)
            self.that(name, math.isfinite(value) and value >= least, f"must be {least:g} or more")

    def positive(self, *names: str) -> None:
        """Finite numbers above 0."""
        for name in names:
            value = getattr(self._settings, name)
            self.that(name, math.isfinite(value) and value > 0, "must be above 0")

    def between(self, low: float, high: float, *names: str) -> None:
        """Numbers from `low` to `high`, both included."""
        for name in names:
            value = getattr(self._settings, name)
            self.that(name, low <= value <= high, f"must lie between {low:g} and {high:g}")

    def interval(self, name: str, above: float, most: float = math.inf) -> None:
        """A pair (low, high) of finite numbers, low no larger than high.

        Args:
            name: of the setting.
            above: both are larger than this.
            most: and no larger than this.
        """
        low, high = getattr(self._settings, name)
        upper = f", both at most {most:g}" if math.isfinite(most) else ""
        good = above < low <= high <= most and math.isfinite(high)
        self.that(name, good, f"must be two numbers above {above:g}, the second no smaller than the first{upper}")

    def choice(self, name: str, choices: Iterable[str], pattern: str = "") -> None:
        """One of some words.

        Args:
            name: of the setting.
            choices: the words, at least two.
            pattern: regular expression of words that are allowed too.
        """
        value = getattr(self._settings, name)
        known = list(choices)
        good = value in known or bool(pattern and re.fullmatch(pattern, value))
        self.that(name, good, f"is unknown; choose {', '.join(known[:-1])} or {known[-1]}")

    def that(self, name: str, holds: bool, must: str) -> None:
        """Anything else.

        Args:
            name: of the setting.
            holds: whether its value is good.
            must: what it must be, in words.

        Raises:
            ConfigError: it does not hold.
        """
        if not holds:
            value = getattr(self._settings, name)
            shown = f"`{value}`" if isinstance(value, str) else value
            raise ConfigError(f"setting `{self._prefix}{name}`: {shown} {must}")
