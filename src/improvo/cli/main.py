"""`improvo VERB ...`: finds the command's module, runs it, and turns errors into one line and exit status 2."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from types import ModuleType

from improvo import __version__
from improvo.errors import ImprovoError
from improvo.jobs.interrupts import termination_interrupts

# verb -> (module under improvo.cli, help line). A module has `add_arguments(parser)` and `run(arguments)`, which
# returns int or None; a verb with its own sub-commands adds them with `parser.add_subparsers`. Heavy imports belong
# inside `run`.
COMMANDS: dict[str, tuple[str, str]] = {
    "label": ("label", "stability labels for many sequences: odometry, then the paper's rule"),
    "improve": ("improve", "the main job: label video, train the frontend with the labels, keep it if it got better"),
    "run": ("run", "visual odometry on one sequence: trajectory, map, tracks"),
    "evaluate": ("evaluate", "how good a frontend or a trajectory is: the paper's protocols"),
    "train": ("train", "teach the network: drawn shapes, homographies"),
    "show": ("show", "the pictures of the paper, from a run, a recording or an evaluation"),
    "report": ("report", "one HTML page about a run, labels or an evaluation"),
    "weights": ("weights", "import public weights, prepare weights for int8, print a model card"),
    "export": ("export", "what other tools read: COLMAP, Nerfstudio, trajectories, ONNX"),
    "simulate": ("simulate", "render rooms with exact depth, poses and causes of instability"),
    "info": ("info", "what a recording was recognised as, and what is wrong with it"),
    "calibrate": ("calibrate", "a camera from a recording of a board, and the board to print"),
    "demo": ("demo", "the main job on a small bundled recording, in minutes"),
    "config": ("config", "print all settings of a command as YAML"),
}


class HelpFormatter(argparse.ArgumentDefaultsHelpFormatter):
    """Shows a default where there is one to show and the text does not have it already."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.default in (None, False, []) or "(default" in (action.help or ""):
            return action.help
        return super()._get_help_string(action)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point. Returns the exit status: 0 done, 2 an error that the user can mend, 130 interrupted."""
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        verb = next((word for word in words if not word.startswith("-")), None)
        arguments = _parser(verb).parse_args(words)
        with termination_interrupts():
            return int(arguments.module.run(arguments) or 0)
    except ImprovoError as error:
        print(f"improvo: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("improvo: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _parser(verb: str | None) -> argparse.ArgumentParser:
    """The parser of all verbs; only the chosen one's module is imported."""
    parser = argparse.ArgumentParser(
        prog="improvo",
        description="Self-improving visual odometry: video in; a trajectory, a map and a better frontend out.",
        epilog="`improvo VERB --help` shows a command's options with their defaults.",
    )
    parser.add_argument("--version", action="version", version=f"improvo {__version__}")
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    for name, (module_name, help_line) in COMMANDS.items():
        verb_parser = verbs.add_parser(name, help=help_line, description=help_line, formatter_class=HelpFormatter)
        if name == verb:
            module: ModuleType = importlib.import_module(f"improvo.cli.{module_name}")
            module.add_arguments(verb_parser)
            verb_parser.set_defaults(module=module)
    return parser


if __name__ == "__main__":
    sys.exit(main())
