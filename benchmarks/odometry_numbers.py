"""All numbers that the robust mode depends on: settings with defaults, and named constants in the code.

python benchmarks/odometry_numbers.py           # counts
python benchmarks/odometry_numbers.py --list    # each with its value and the comment beside it
"""

from __future__ import annotations

import argparse
import ast
from pathlib import Path

import improvo.odometry

ROOM = Path(improvo.odometry.__file__).parent
NOT_OF_TRACKING = ("scale", "run.py", "recorder.py", "point_colours.py", "events.py")  # metres, files, words
PAPER = ("paper_poses", "paper_objective", "paper_solver")  # of the mode `paper`


def settings(path: Path) -> list[tuple[str, str, str]]:
    """Section and name, default, and comment of each field of the sections."""
    source = path.read_text().splitlines()
    found = []
    for node in ast.parse("\n".join(source)).body:
        if not isinstance(node, ast.ClassDef) or node.name == "OdometrySettings":
            continue
        for field in node.body:
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and field.value is not None:
                name = f"{node.name.removesuffix('Settings')}.{field.target.id}"
                if field.target.id not in PAPER:
                    found.append((name, ast.unparse(field.value), _comment(source, field.lineno)))
    return found


def constants(path: Path) -> list[tuple[str, str, str]]:
    """File and name, value, and comment of each number that a file names."""
    source = path.read_text().splitlines()
    found = []
    for node in ast.parse("\n".join(source)).body:
        if isinstance(node, ast.Assign) and _is_number(node.value):
            name = f"{path.relative_to(ROOM)} {ast.unparse(node.targets[0])}"
            found.append((name, ast.unparse(node.value), _comment(source, node.lineno)))
    return found


def _is_number(value: ast.expr) -> bool:
    """Whether an expression is a number, or the logarithm of one."""
    if isinstance(value, ast.UnaryOp):
        value = value.operand
    if isinstance(value, ast.Call):
        return ast.unparse(value.func).endswith("log")
    return isinstance(value, ast.Constant) and isinstance(value.value, int | float)


def _comment(source: list[str], line: int) -> str:
    """The comment at the end of a line (counted from 1)."""
    return source[line - 1].partition("  # ")[2]


def main() -> None:
    """Print the counts, or everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="each number with its value and comment")
    arguments = parser.parse_args()
    files = [
        file
        for file in sorted(ROOM.rglob("*.py"))
        if file.relative_to(ROOM).parts[0] not in NOT_OF_TRACKING
        and file.name not in ("settings.py", "run_settings.py")
    ]
    rows = {"settings": settings(ROOM / "settings.py"), "constants": [row for file in files for row in constants(file)]}
    for kind, numbers in rows.items():
        print(f"{len(numbers)} {kind}")
        for name, value, comment in numbers if arguments.list else ():
            print(f"  {name} = {value}  {comment}")


if __name__ == "__main__":
    main()
