"""All numbers that the odometry depends on: settings with defaults, and named constants in the code.

python benchmarks/odometry_numbers.py           # counts
python benchmarks/odometry_numbers.py --list    # each with its value and the comment beside it

A setting is a leaf of `OdometrySettings` (`improvo config run`, section `odometry`), that of both modes and of each
alone. A constant is a number, or each number of a tuple, that a module of tracking gives a name.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import inspect
import sys
from pathlib import Path
from typing import Any

import improvo.odometry
from improvo.odometry.settings import OdometrySettings

ROOM = Path(improvo.odometry.__file__).parent
NOT_OF_TRACKING = ("scale", "run.py", "recorder.py", "point_colours.py", "events.py")  # metres, files, words
COUNTED_ELSEWHERE = ("settings.py", "run_settings.py")


def settings(section: Any, prefix: str = "") -> list[tuple[str, str, str]]:
    """Dotted name, default, and comment of each leaf of a section."""
    file = Path(str(sys.modules[type(section).__module__].__file__))
    lines = file.read_text().splitlines()
    start = inspect.getsourcelines(type(section))[1]
    found = []
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        if dataclasses.is_dataclass(value):
            found += settings(value, f"{prefix}{field.name}.")
            continue
        line = next(number for number in range(start, len(lines)) if lines[number].startswith(f"    {field.name}:"))
        found.append((f"{prefix}{field.name}", repr(value), _comment(lines, line + 1)))
    return found


def constants(path: Path) -> list[tuple[str, str, str]]:
    """File and name, value, and comment of each number that a file names."""
    source = path.read_text().splitlines()
    found = []
    for node in ast.parse("\n".join(source)).body:
        if not isinstance(node, ast.Assign):
            continue
        values = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
        if all(_is_number(value) for value in values):
            name = f"{path.relative_to(ROOM)} {ast.unparse(node.targets[0])}"
            found += [(name, ast.unparse(value), _comment(source, node.lineno)) for value in values]
    return found


def _is_number(value: ast.expr) -> bool:
    """Whether an expression is a number, a product of numbers and names, or the logarithm of a number."""
    if isinstance(value, ast.UnaryOp):
        value = value.operand
    if isinstance(value, ast.BinOp):
        return _is_number(value.left) or _is_number(value.right)
    if isinstance(value, ast.Call):
        return ast.unparse(value.func).endswith("log")
    return isinstance(value, ast.Constant) and isinstance(value.value, int | float) and value.value is not False


def _comment(source: list[str], line: int) -> str:
    """The comment at the end of a line (counted from 1), or in the lines above it."""
    beside = source[line - 1].partition("  # ")[2]
    above: list[str] = []
    while not beside and source[line - 2 - len(above)].strip().startswith("# "):
        above.insert(0, source[line - 2 - len(above)].strip().removeprefix("# "))
    return beside or " ".join(above)


def main() -> None:
    """Print the counts, or everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="each number with its value and comment")
    arguments = parser.parse_args()
    files = [
        file
        for file in sorted(ROOM.rglob("*.py"))
        if file.relative_to(ROOM).parts[0] not in NOT_OF_TRACKING and file.name not in COUNTED_ELSEWHERE
    ]
    rows = {"settings": settings(OdometrySettings()), "constants": [row for file in files for row in constants(file)]}
    for kind, numbers in rows.items():
        print(f"{len(numbers)} {kind}")
        for name, value, comment in numbers if arguments.list else ():
            print(f"  {name} = {value}  {comment}")


if __name__ == "__main__":
    main()
