"""The house (docs/architecture.md): a room imports only from lower floors, and there are no circles."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "src" / "improvo"
FLOORS = (
    {
        "types",
        "config",
        "files",
        "folder_lock",
        "locations",
        "continuation",
        "terminal",
        "errors",
        "formats",
        "compiled",
        "untrusted",
        "geometry",
        "jobs",
    },
    {"sequences", "calibration", "frontend", "tracking", "simulation"},
    {"stability", "backend"},
    {"odometry"},
    {"labeling", "depth", "self_calibration"},
    {"training"},
    {"evaluation"},
    {"report", "export"},
    {"improvement"},
    {"verbs", "presets"},
    {"cli"},
)
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
ENTRANCES = {"__init__", "__main__"}  # of the package: the public names and the command


def imports(file: Path) -> Iterator[tuple[int, str]]:
    """Line and room of every import of this package in a file, also of those within functions."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "improvo":
            parts = node.module.split(".")
            rooms = [parts[1]] if len(parts) > 1 else [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            parts_of = (alias.name.split(".") for alias in node.names)
            rooms = [parts[1] for parts in parts_of if parts[0] == "improvo" and len(parts) > 1]
        else:
            continue
        for room in rooms:
            if room in FLOOR:
                yield node.lineno, room


def room_of(file: Path) -> str:
    """The room that a file of the package belongs to."""
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def test_a_room_imports_only_from_lower_floors() -> None:
    upward = []
    for file in sorted(PACKAGE.rglob("*.py")):
        room = room_of(file)
        if room in ENTRANCES:
            continue
        for line, other in imports(file):
            below = FLOOR[other] < FLOOR[room] or (FLOOR[other] == FLOOR[room] == 0)
            if other != room and not below:
                upward.append(f"{file.relative_to(PACKAGE)}:{line}: {room} imports {other}")
    assert not upward, "\n".join(upward)


ROOMS = {folder.name for folder in PACKAGE.iterdir() if (folder / "__init__.py").is_file()}


def said_imports(docstring: str) -> set[str] | None:
    """Rooms that the docstring of a room says that it imports; None where it says nothing."""
    sentence = re.search(r"\bIt imports (.*?)\.(?=\s|$)", docstring, re.DOTALL)
    if sentence is None:
        return None
    named = set(re.findall(r"`(\w+)`", sentence[1]))
    return ROOMS - named if sentence[1].startswith("every room but") else named


def test_a_room_says_which_other_rooms_it_imports() -> None:
    wrong = []
    for room in sorted(ROOMS):
        tree = ast.parse((PACKAGE / room / "__init__.py").read_text())
        said = said_imports(ast.get_docstring(tree) or "")
        true = {other for file in (PACKAGE / room).rglob("*.py") for _, other in imports(file)} & ROOMS
        if said is None or said - {room} != true - {room}:
            wrong.append(f"{room}: says {sorted(said or ())}, imports {sorted(true - {room})}")
    assert not wrong, "\n".join(wrong)


def check_no_circle(wants: dict[str, set[str]]) -> None:
    """Fail if places want each other in a circle; `wants` has those that each of them imports."""
    while wants:
        free = {place for place, others in wants.items() if not others & wants.keys()}
        assert free, f"these import each other: {sorted(wants)}"
        wants = {place: others for place, others in wants.items() if place not in free}


def test_the_lowest_floor_has_no_circle() -> None:
    wants = {room: set() for room in FLOORS[0]}
    for file in sorted(PACKAGE.rglob("*.py")):
        room = room_of(file)
        if room in wants:
            wants[room] |= {other for _, other in imports(file) if other in wants and other != room}
    check_no_circle(wants)


def test_the_folders_of_the_odometry_have_no_circle() -> None:
    wants = {}
    for file in sorted((PACKAGE / "odometry").rglob("*.py")):
        place = file.relative_to(PACKAGE / "odometry").parts[0].removesuffix(".py")
        modules = re.findall(r"from improvo\.odometry\.(\w+)", file.read_text())
        wants[place] = wants.get(place, set()) | {other for other in modules if other != place}
    assert {"modes", "mapping", "run"} <= wants.keys()
    check_no_circle(wants)


def test_every_room_has_a_floor() -> None:
    rooms = {room_of(file) for file in PACKAGE.rglob("*.py")} - ENTRANCES
    assert rooms <= FLOOR.keys(), f"no floor is known for {sorted(rooms - FLOOR.keys())}"
