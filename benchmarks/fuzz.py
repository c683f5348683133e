"""Damages small valid files of every kind that improvo reads, and looks whether each is read, or refused in one line.

    PYTHONPATH=tests python benchmarks/fuzz.py [--minutes 60] [--each 200000] [--only NAME] [--corpus FOLDER]

What counts as a fault: an error that is none of ours, one whose message has several lines, an execution that takes more
processor time than the limit (or waits for ever), a process that ends, or memory beyond the limit. Each fault is told
once for each place in the code, and its file is kept in the corpus folder as `TARGET--SEED`, to be looked at with
`--again FILE`. Executions are counted in `record.json` beside them: the next run goes on with seeds that none has had.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
import typing
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from copy import deepcopy
from functools import lru_cache, partialmethod
from multiprocessing.connection import Connection
from pathlib import Path
from types import ModuleType
from typing import Any

from fuzz_targets import EXPECTED, Target, targets  # of the tests: run with PYTHONPATH=tests
from mutations import mutated

SECONDS, MEGABYTES = 20.0, 4000  # of one execution (processor time), of a child process with its imports
WAITING_SECONDS = 900.0  # of an execution that does nothing
TURN_SECONDS = 30.0  # executions of one child; a new one costs a fork and a new example
PACKAGE = "improvo"
SCRATCH = Path("/dev/shm") if Path("/dev/shm").is_dir() else None  # the files are written and read in memory


class TooSlowError(BaseException):
    """An execution took more than the time limit; no parser may catch this."""


class Record:
    """How often each target was executed, over all runs, and the faults that were found."""

    def __init__(self, path: Path, first_seed: int) -> None:
        self._path, self._first_seed = path, first_seed
        self.targets: dict[str, dict[str, float]] = {}
        self.faults: dict[str, str] = {}  # target and place -> the first file that shows it
        if path.exists():
            content = json.loads(path.read_text())
            self.targets, self.faults = content["targets"], content["faults"]

    def of(self, name: str) -> dict[str, float]:
        """What is known of a target."""
        return self.targets.setdefault(name, {"executions": 0, "next_seed": self._first_seed, "processor_seconds": 0.0})

    def seconds_left(self, name: str, each: int) -> float:
        """The processor time that a target still needs for that many executions; none if it never ran."""
        one = self.of(name)
        return (each - one["executions"]) * one["processor_seconds"] / max(one["executions"], 1)

    def save(self) -> None:
        """Write it whole."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        temporary = self._path.with_suffix(".new")
        temporary.write_text(json.dumps({"targets": self.targets, "faults": self.faults}, indent=1))
        temporary.replace(self._path)

    def table(self, names: list[str]) -> str:
        """A line per target: executions, executions a second of processor time, faults."""
        lines = []
        for name in names:
            one = self.of(name)
            rate = one["executions"] / max(one["processor_seconds"], 1e-9)
            faults = sum(key.startswith(f"{name}: ") for key in self.faults)
            lines.append(f"  {name:28} {one['executions']:9.0f} {rate:8.0f}/s {faults:4}")
        return "\n".join(lines)


def main() -> None:
    """Round and round over the targets until the time is up or each has had its executions."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0, help="of the first execution of a target that has had none")
    parser.add_argument("--each", type=int, default=200_000, help="executions of a target, all runs together")
    parser.add_argument(
        "--finish", action="store_true", help="not in turns: always the target that lacks the least processor time"
    )
    parser.add_argument("--only", nargs="*", default=[], metavar="NAME", help="targets whose names begin so")
    parser.add_argument("--corpus", type=Path, default=Path("output/fuzz"), metavar="FOLDER")
    parser.add_argument("--again", type=Path, metavar="FILE", help="one file of the corpus, with the whole traceback")
    arguments = parser.parse_args()
    if arguments.again:
        again(arguments.again)
        return
    names = [name for name in targets() if not arguments.only or name.startswith(tuple(arguments.only))]
    record = Record(arguments.corpus / "record.json", arguments.seed)
    known = len(record.faults)
    end = time.monotonic() + 60 * arguments.minutes
    while time.monotonic() < end:
        waiting = [name for name in names if record.of(name)["executions"] < arguments.each]
        if not waiting:
            break
        if arguments.finish:
            waiting = [min(waiting, key=lambda name: record.seconds_left(name, arguments.each))]
        for name in waiting:
            one_turn(name, record, arguments.each, min(end, time.monotonic() + TURN_SECONDS), arguments.corpus)
            record.save()
            if time.monotonic() > end:
                break
    print(record.table(names))
    done = sum(record.of(name)["executions"] >= arguments.each for name in names)
    print(f"{done} of {len(names)} targets had {arguments.each} executions; {len(record.faults) - known} new faults")
    sys.exit(1 if len(record.faults) > known else 0)


def one_turn(name: str, record: Record, most: int, end: float, corpus: Path) -> None:
    """Executions of one target in a child; a child that dies or hangs is a fault of what it was doing."""
    one = record.of(name)
    first = int(one["next_seed"])
    count = int(most - one["executions"])
    shared = multiprocessing.RawArray("d", [first - 1, 0.0])  # the seed that is tried, processor seconds so far
    ours, theirs = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(target=turn, args=(name, first, count, shared, theirs, end))
    process.start()
    theirs.close()

    def fault(place: str, seed: int) -> None:
        if (key := f"{name}: {place}") not in record.faults:
            record.faults[key] = keep(name, seed, corpus)
            print(f"{key}\n    {record.faults[key]}", flush=True)

    seed, since, used = first - 1, time.monotonic(), 0.0
    while True:
        if ours.poll(1.0):
            with suppress(EOFError):
                fault(*ours.recv())
                continue
            process.join()
            if process.exitcode:
                fault(f"the process ends with {process.exitcode}", int(shared[0]))
            break
        if int(shared[0]) != seed:
            seed, since, used = int(shared[0]), time.monotonic(), processor_seconds(process.pid)
        elif seed < first:
            continue  # the example is being made
        elif processor_seconds(process.pid) - used > 2 * SECONDS or time.monotonic() - since > WAITING_SECONDS:
            process.kill()
            process.join()
            fault(f"hangs; {processor_seconds(process.pid) - used:.0f} s of processor time", seed)
            break
    one["executions"] += int(shared[0]) - first + 1
    one["next_seed"] = int(shared[0]) + 1
    one["processor_seconds"] += shared[1]


def turn(name: str, first: int, count: int, shared: Any, results: Connection, end: float) -> None:
    """In a child: executions by seed, from `first` on; none of them may leave it unusable for the next."""
    limit_memory()
    sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    os.dup2(sys.stdout.fileno(), 2)
    target = targets()[name]
    remember_yaml()
    remember_ros_code()
    remember_type_hints()
    read_tables_in_one_thread()
    remember_tables()
    with tempfile.TemporaryDirectory(prefix="improvo-fuzz-", dir=SCRATCH) as place:
        example = Example(target, Path(place) / "example")
        before = time.process_time()  # making the example does not count
        for seed in range(first, first + count):
            if time.monotonic() > end:
                break
            shared[0] = seed
            fault = example.try_seed(seed)
            shared[1] = time.process_time() - before
            if fault:
                results.send((fault, seed))


def remember_yaml() -> None:
    """Parse a YAML text once: the files beside the damaged one are the same every time, and take most of the time."""
    from ruamel.yaml import YAML  # what rosbags reads the metadata of a bag with

    from improvo.untrusted import text

    parse, ruamel_load = text.load_yaml, YAML.load
    parsed = lru_cache(maxsize=64)(parse)
    loaded = lru_cache(maxsize=64)(lambda kind, content: ruamel_load(YAML(typ=kind), content))

    def load_yaml(content: str) -> Any:
        return deepcopy(parsed(content))

    def load(self: YAML, stream: Any) -> Any:
        return (
            deepcopy(loaded("safe", stream))
            if isinstance(stream, str) and self.typ == ["safe"]
            else ruamel_load(self, stream)
        )

    YAML.load = load  # type: ignore[method-assign]
    for module in [one for name, one in sys.modules.items() if name.startswith(PACKAGE)]:
        if getattr(module, "load_yaml", None) is parse:
            module.load_yaml = load_yaml  # type: ignore[attr-defined]


def remember_ros_code() -> None:
    """Compile the code that rosbags writes for each kind of message once, and parse each definition once."""
    from rosbags.serde import cdr, ros1, utils
    from rosbags.typesys import msg

    parsed = lru_cache(maxsize=1024)(msg.get_types_from_msg)

    @lru_cache(maxsize=4096)
    def module_of(text: str) -> ModuleType:
        module = ModuleType("tmpmod")
        exec(compile(text, "<message>", "exec"), module.__dict__)
        return module

    def compile_lines(lines: list[str]) -> ModuleType:
        return module_of("\n".join(lines))

    for user in (cdr, ros1, utils):
        user.compile_lines = compile_lines  # type: ignore[attr-defined]
    for user in [one for one in sys.modules.values() if getattr(one, "get_types_from_msg", None)]:
        user.get_types_from_msg = lambda text, name: deepcopy(parsed(text, name))  # type: ignore[attr-defined]


def remember_type_hints() -> None:
    """Work out the types of the fields of each settings class once."""
    typing.get_type_hints = lru_cache(maxsize=1024)(typing.get_type_hints)


def read_tables_in_one_thread() -> None:
    """Waking the threads of a pool takes most of the time of a small table."""
    from pyarrow.parquet import ParquetFile

    ParquetFile.read = partialmethod(ParquetFile.read, use_threads=False)  # type: ignore[method-assign]


def remember_tables() -> None:
    """Read a table once: of a whole label store, all but one are the same every time."""
    from improvo.stability import table_reading

    parse = table_reading.read_table

    @lru_cache(maxsize=64)
    def read(content: bytes, path: Path, schema: Any) -> Any:
        return parse(path, schema)

    def read_table(path: Path, schema: Any) -> Any:
        return read(path.read_bytes(), path, schema) if path.is_file() else parse(path, schema)

    for module in [one for name, one in sys.modules.items() if name.startswith(PACKAGE)]:
        if getattr(module, "read_table", None) is parse:
            module.read_table = read_table  # type: ignore[attr-defined]


def processor_seconds(pid: int | None) -> float:
    """Used so far by a process that runs; 0 of one that has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Example:
    """A valid file, and damage to it."""

    def __init__(self, target: Target, folder: Path) -> None:
        self.target, self.folder = target, folder
        folder.mkdir()
        self.path = target.write(folder)
        self.content = self.path.read_bytes()
        self.pristine = folder.with_name("pristine")
        shutil.copytree(folder, self.pristine)

    def damaged(self, seed: int) -> bytes:
        """The file's bytes under a seed."""
        return mutated(self.content, random.Random(seed), self.target.text)

    def try_seed(self, seed: int) -> str:
        """What is wrong with how the damaged file is read; empty where nothing is."""
        if not self.path.parent.is_dir():  # a parser may not remove what it reads, but a fuzzer must go on
            shutil.copytree(self.pristine, self.folder, dirs_exist_ok=True)
        self.path.write_bytes(self.damaged(seed))
        return fault_of(self.target, self.path)


def fault_of(target: Target, path: Path) -> str:
    """Where and how reading a file fails as it must not; empty where it is read, or refused as it should be."""
    try:
        with time_limit():
            target.read(path)
    except EXPECTED as error:
        return "a message of several lines" if "\n" in str(error) else ""
    except (Exception, TooSlowError) as error:
        return described(error)
    return ""


def described(error: BaseException) -> str:
    """The kind of an error and the innermost line of ours that it came through."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if f"{os.sep}{PACKAGE}{os.sep}" in frame.filename]
    frame = (ours or frames)[-1]
    return f"{type(error).__name__} at {'/'.join(Path(frame.filename).parts[-2:])}:{frame.lineno} {str(error)[:80]!r}"


@contextmanager
def time_limit() -> Iterator[None]:
    """Raise in the main thread when the processor time is up; others on the machine do not count."""

    def stop(*_: Any) -> None:
        raise TooSlowError(f"more than {SECONDS:g} s")

    signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def limit_memory() -> None:
    """No more address space than this in all: of that, the imports take one part and the files the rest."""
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (MEGABYTES << 20, MEGABYTES << 20))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def keep(name: str, seed: int, corpus: Path) -> str:
    """Write the damaged file; returns where."""
    corpus.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        content = Example(targets()[name], Path(place) / "example").damaged(seed)
    file = corpus / f"{name.replace('/', '+')}--{seed}"
    file.write_bytes(content)
    return str(file)


def again(file: Path) -> None:
    """Read a file of the corpus, with its traceback."""
    name = file.name.rpartition("--")[0].replace("+", "/")
    limit_memory()
    with tempfile.TemporaryDirectory() as place:
        example = Example(targets()[name], Path(place) / "example")
        example.path.write_bytes(file.read_bytes())
        with time_limit():
            example.target.read(example.path)


if __name__ == "__main__":
    main()
