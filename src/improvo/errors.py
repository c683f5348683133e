"""The exceptions of improvo: one base, caught once by the command line. And whether an optional package is there."""

from importlib import import_module
from importlib.util import find_spec
from typing import Any


class ImprovoError(Exception):
    """Something a user can correct.

    The message is one line that names the file or setting, says what is wrong with it, and how to correct it.
    The command line prints it and exits with status 2.
    """

    def __str__(self) -> str:
        """The message; a name out of a damaged file may have line breaks, which are written as `\\n`."""
        return super().__str__().replace("\n", "\\n")


class InputError(ImprovoError):
    """An input (recording, calibration, trajectory, weights, ...) is missing, unreadable or inconsistent."""


class OutputError(ImprovoError):
    """An output folder or file cannot be used or written."""


class ConfigError(ImprovoError):
    """A setting has an unknown name or an impossible value."""


class MissingExtraError(ImprovoError):
    """A command needs an optional dependency.

    Args:
        feature: what was asked for, in the user's words ("training").
        extra: the name of the extra that provides it ("train").
    """

    def __init__(self, feature: str, extra: str) -> None:
        super().__init__(f"{feature} needs an optional dependency: pip install 'improvo[{extra}]'")


PLOTS_MISSING = "pip install 'improvo[plots]'"


def plots_installed() -> bool:
    """Whether curves and maps can be drawn."""
    return installed("matplotlib")


def require_plots(feature: str) -> None:
    """Refuse what is drawn with matplotlib before any work is done.

    Raises:
        MissingExtraError: it is not installed.
    """
    if not plots_installed():
        raise MissingExtraError(feature, "plots")


def installed(package: str) -> bool:
    """Whether a package can be imported; nothing is loaded."""
    try:
        return find_spec(package) is not None
    except ValueError:  # made unavailable by hand: None in sys.modules
        return False


def imported(package: str, feature: str, extra: str) -> Any:
    """An optional package.

    Args:
        package: its name.
        feature: what needs it, as `MissingExtraError` says it.
        extra: that brings it.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        return import_module(package)
    except ImportError:
        raise MissingExtraError(feature, extra) from None


def first_line(error: BaseException) -> str:
    """Of a foreign error whose further lines are a stack or advice; its kind, where it says nothing."""
    return next((words for line in str(error).splitlines() if (words := line.strip())), type(error).__name__)
