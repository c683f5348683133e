"""`improvo VERB ...`: finds the command in the table, runs it, and turns errors into one line and exit status 2."""

from __future__ import annotations

import argparse
import errno
import io
import logging
import os
import sys
import tempfile
import warnings
from collections.abc import Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from itertools import chain
from pathlib import Path
from typing import NoReturn

from improvo import __version__, locations
from improvo.cli import output
from improvo.cli.commands import COMMANDS, Command
from improvo.errors import ImprovoError, OutputError
from improvo.jobs.interrupts import termination_interrupts
from improvo.terminal import one_line

_EPILOG = """\
`improvo VERB --help` shows a command's options with their defaults.
Exit status: 0 done, 2 an error that you can correct (one line says how), 3 done, but no frame has a pose,
130 interrupted, 1 a bug of improvo."""
_OPENCV_PACKAGES = (
    *("opencv-python", "opencv-python-headless"),
    *("opencv-contrib-python", "opencv-contrib-python-headless"),
)
_OUTPUTS = {"output", "save", "write_mask", "print_board"}  # arguments that name a file or folder to write
_NO_MEMORY = "out of memory; give it more, or smaller pictures (--width), fewer keypoints or fewer --workers"
_NO_FOLDER = "the folder that it runs in was removed; change to another one (cd) and run it again"
_NO_SPACE = "no space is left on the disk; free some, or choose another folder"
_NO_PERMISSION = "permission denied; choose another path, or change its permissions"
_ERRORS_OF_NO_SPACE = {getattr(errno, name) for name in ("ENOSPC", "EDQUOT", "EFBIG") if hasattr(errno, name)}
_WORDS_OF_NO_MEMORY = ("insufficient memory", "can't allocate memory", "out of memory", "bad_alloc", "start new thread")


class HelpFormatter(argparse.ArgumentDefaultsHelpFormatter):
    """Shows a default where there is one to show and the text does not have it already."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.default in (None, False, []) or "(default" in (action.help or ""):
            return action.help
        return super()._get_help_string(action)


class _Parser(argparse.ArgumentParser):
    """Errors are one line, without the usage, which is long for commands with many options."""

    def error(self, message: str) -> NoReturn:
        """Print the error and exit with status 2."""
        self.exit(2, f"{self.prog}: {one_line(message)}; `{self.prog} --help` shows the options\n")


class _Text(HelpFormatter, argparse.RawDescriptionHelpFormatter):
    """Keeps the line breaks of descriptions."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point. Returns the exit status: 0 done, 2 an error that the user can correct, 130 interrupted."""
    words = list(sys.argv[1:] if argv is None else argv)
    _make_streams_usable()
    # Descriptors are matched in small products of matrices: threads of OpenBLAS make that slower.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Threads of torch that wait for each other give the processor back: beside other programs a step of training takes
    # a third of the processor's time, and the results are the same.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("MPLCONFIGDIR", str(cache_folder() / "matplotlib"))  # made by matplotlib, if it is used
    warnings.filterwarnings("ignore", "Glyph .* missing from", UserWarning)  # of a name in a title
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # warns where it cannot make that, and works
    arguments = argparse.Namespace()
    try:
        arguments = _parsed(words)
        _check_paths(arguments)
        with output.configured(arguments.quiet, getattr(arguments, "json", False)), termination_interrupts():
            _say_if_opencv_is_there_twice()
            status = int(arguments.run_command(arguments) or 0)
            locations.close()
            return status
    except ImprovoError as error:
        print(f"improvo: {one_line(locations.with_urls(_message(error, arguments)))}", file=sys.stderr)
        locations.close(success=False)
        return 2
    except KeyboardInterrupt:
        return _interrupted()
    except BrokenPipeError:  # of a command whose result is what it prints
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        if _came_of_an_interrupt(error):
            return _interrupted()
        said = _limit_of_the_machine(error)
        if not said:
            raise
        print(f"improvo: {said}", file=sys.stderr)
        return 2


def _message(error: ImprovoError, arguments: argparse.Namespace) -> str:
    """What to say of it, in the words that the user types."""
    from improvo.cli.begun_with import in_flags
    from improvo.continuation import DifferentSettingsError

    return in_flags(error, arguments) if isinstance(error, DifferentSettingsError) else str(error)


def _interrupted() -> int:
    """Say so; returns the exit status."""
    locations.close(success=False)
    print("improvo: interrupted", file=sys.stderr)
    return 130


def _came_of_an_interrupt(error: BaseException | None) -> bool:
    """Whether an interrupt came in the middle of compiled code, which makes an error of another kind of it."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__ if isinstance(error, SystemError) else None
    return error is not None


def _make_streams_usable() -> None:
    """A stream that was closed before the start swallows what is printed; a character it lacks is written `\\xfc`."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - as long as the process
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _parsed(words: list[str]) -> argparse.Namespace:
    """The arguments; what no option takes is told by the command, not by `improvo`."""
    parser = parser_for(words)
    arguments, unknown = parser.parse_known_args(words)
    if unknown:
        parser.prog = " ".join(
            [parser.prog, *(vars(arguments)[name] for name in ("verb", "part") if name in arguments)]
        )
        parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    return arguments


def _say_if_opencv_is_there_twice() -> None:
    """The packages of OpenCV overwrite each other's files, and a user's windows may be gone."""
    found = []
    for name in _OPENCV_PACKAGES:
        with suppress(PackageNotFoundError):
            found.append(f"{name} {version(name)}")
    if len(found) > 1:
        output.notice(
            f"note: {' and '.join(found)} are both installed and overwrite each other's files, so windows "
            "(cv2.imshow) may be gone; docs/install.md says how to keep one"
        )


def _limit_of_the_machine(error: Exception) -> str:
    """What to say of an error that is none of ours, nor a fault of the program; empty for others."""
    if _out_of_memory(error):
        return _NO_MEMORY
    if isinstance(error, OSError) and error.errno in _ERRORS_OF_NO_SPACE:
        return _NO_SPACE
    if isinstance(error, PermissionError) and error.filename is not None:
        return one_line(f"{os.fsdecode(error.filename)}: {_NO_PERMISSION}")
    return _NO_FOLDER if _folder_is_gone(error) else ""


def _out_of_memory(error: Exception) -> bool:
    """Whether this is how Python, NumPy, OpenCV, torch or OpenVINO say so."""
    return isinstance(error, MemoryError) or any(words in str(error).lower() for words in _WORDS_OF_NO_MEMORY)


def _folder_is_gone(error: Exception) -> bool:
    """Whether the folder that the command runs in was removed; every path that is relative to it fails then."""
    if not isinstance(error, FileNotFoundError):
        return False
    try:
        os.getcwd()
    except FileNotFoundError:
        return True
    return False


def _check_paths(arguments: argparse.Namespace) -> None:
    """Refuse a path that cannot or may not be looked up, and an output that is also the input, before any command does.

    Raises:
        InputError: there is such a path.
        OutputError: there is such an output.
    """
    from improvo.files import is_same_file
    from improvo.untrusted.paths import check_path

    paths = {name: _paths(value) for name, value in vars(arguments).items()}
    for path in chain.from_iterable(paths.values()):
        check_path(path, reachable=True)
    for output_name in _OUTPUTS & paths.keys():
        others = chain.from_iterable(read for name, read in paths.items() if name not in _OUTPUTS)
        read = [path for path in others if path.is_file()]
        for path in paths[output_name]:
            if any(is_same_file(path, other) for other in read):
                raise OutputError(
                    f"{path}: is what shall be read, and the output would replace it; choose another name"
                )


def _paths(value: object) -> list[Path]:
    """The paths in the value of an argument."""
    return [item for item in (value if isinstance(value, list | tuple) else [value]) if isinstance(item, Path)]


def cache_folder() -> Path:
    """Where the command line may keep what makes a second run faster; made when something is kept."""
    given = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    try:
        return Path(given or Path.home() / ".cache") / "improvo"
    except RuntimeError:  # a user without a home
        return Path(tempfile.gettempdir()) / "improvo"


def parser_for(words: Sequence[str]) -> argparse.ArgumentParser:
    """The parser of all commands; only the module of the one that `words` name is imported."""
    return _parser([word for word in words if not word.startswith("-")][:2])


def whole_parser() -> argparse.ArgumentParser:
    """The parser with the options of all commands, which imports the modules of all."""
    return _parser(None)


def _parser(named: list[str] | None) -> argparse.ArgumentParser:
    parser = _Parser(
        prog="improvo",
        description="Self-improving visual odometry: video in; a trajectory, a map and a better frontend out.",
        epilog=_EPILOG,
        formatter_class=_Text,
    )
    parser.add_argument("--version", action="version", version=f"improvo {__version__}")
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    _add_commands(verbs, COMMANDS, named)
    return parser


def _add_commands(
    parsers: argparse._SubParsersAction[_Parser], commands: dict[str, Command], named: list[str] | None
) -> None:
    """Add the commands, with the options of the one that is named, or of all where that is None."""
    for name, command in commands.items():
        chosen = named is None or named[:1] == [name]
        leaf = chosen and not command.parts
        description = command.description() if leaf else command.help
        parser = parsers.add_parser(name, help=command.help, description=description, formatter_class=_Text)
        if command.parts:
            parts = parser.add_subparsers(dest="part", metavar=command.part_name, required=True)
            below = None if named is None else named[1:] if chosen else []
            _add_commands(parts, dict(command.parts), below)
        elif leaf:
            from improvo.cli.options import add_preset_argument

            add_arguments, run = command.functions()
            add_arguments(parser)
            add_preset_argument(parser, command.settings.partition(":")[2])
            if command.figures:
                parser.add_argument("--json", action="store_true", help="print the figures as JSON, and nothing else")
            parser.add_argument("--quiet", action="store_true", help="print results and errors only")
            parser.set_defaults(run_command=run)


if __name__ == "__main__":
    sys.exit(main())
