"""Damages small valid files of every kind that improvo reads, and looks whether each is read, or refused in one line.

    PYTHONPATH=tests python benchmarks/fuzz.py [--minutes 60] [--seed 0] [--only NAME] [--corpus FOLDER]

What counts as a fault: an error that is none of ours, one whose message has several lines or does not name the file, an
execution of more than the time limit, a process that ends, or memory beyond the limit. Each fault is told once for each
place in the code, and its file is kept in the corpus folder as `TARGET--SEED`, to be looked at with `--again FILE`.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from fuzz_targets import EXPECTED, Target, targets  # of the tests: run with PYTHONPATH=tests
from mutations import mutated

SECONDS, MEGABYTES = 20.0, 4000  # of one execution, of a child process
EXAMPLE_SECONDS = 600.0  # of making the example that is damaged
BATCH, TURN_SECONDS = 500, 8.0  # executions of one child, at most, and how long a target's turn lasts
PACKAGE = "improvo"


class TooSlowError(BaseException):
    """An execution took more than the time limit; no parser may catch this."""


def main() -> None:
    """Round and round over the targets until the time is up."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[], metavar="NAME", help="targets whose names begin so")
    parser.add_argument("--corpus", type=Path, default=Path("output/fuzz"), metavar="FOLDER")
    parser.add_argument("--again", type=Path, metavar="FILE", help="one file of the corpus, with the whole traceback")
    arguments = parser.parse_args()
    if arguments.again:
        again(arguments.again)
        return
    names = [name for name in targets() if not arguments.only or name.startswith(tuple(arguments.only))]
    end = time.monotonic() + 60 * arguments.minutes
    executions: Counter[str] = Counter()
    faults: dict[str, str] = {}  # where -> the first file that shows it
    seed = arguments.seed
    while time.monotonic() < end:
        for name in names:
            for kind, place, number in child_results(name, seed, min(end, time.monotonic() + TURN_SECONDS)):
                executions[name] += kind != "fault"
                if kind == "fault" and f"{name}: {place}" not in faults:
                    faults[f"{name}: {place}"] = keep(name, number, arguments.corpus)
                    print(f"{name}: {place}\n    {faults[f'{name}: {place}']}", flush=True)
            if time.monotonic() > end:
                break
        seed += BATCH
    print(f"\n{sum(executions.values())} executions of {len(executions)} targets, {len(faults)} faults")
    for name, count in sorted(executions.items()):
        print(f"  {name:28} {count:8} {sum(key.startswith(f'{name}: ') for key in faults):4}")
    sys.exit(1 if faults else 0)


def child_results(name: str, seed: int, end: float) -> Iterator[tuple[str, str, int]]:
    """(`done` or `fault`, place, seed) of a batch; a child that dies or hangs is a fault of what it was doing."""
    done = 0
    while done < BATCH and time.monotonic() < end:
        ours, theirs = multiprocessing.Pipe(duplex=False)
        process = multiprocessing.get_context("fork").Process(target=batch, args=(name, seed, done, theirs, end))
        process.start()
        patience = EXAMPLE_SECONDS
        theirs.close()
        while True:
            try:
                if not ours.poll(patience):
                    process.kill()
                    yield "fault", f"hangs for {patience:g} s", seed + done
                    break
                kind, place = ours.recv()
                patience = 2 * SECONDS
            except EOFError:
                process.join()
                if process.exitcode:
                    yield "fault", f"the process ends with {process.exitcode}", seed + done
                break
            if kind == "end":
                process.join()
                return
            if kind != "begin":
                yield kind, place, seed + done
            done += kind == "done"
        process.join()
        done += 1


def batch(name: str, seed: int, first: int, results: Connection, end: float) -> None:
    """In a child: executions by seed, from `first` on; none of them may leave it unusable for the next."""
    limit_memory()
    sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    os.dup2(sys.stdout.fileno(), 2)
    target = targets()[name]
    with tempfile.TemporaryDirectory(prefix="improvo-fuzz-") as place:
        example = Example(target, Path(place) / "example")
        results.send(("begin", ""))  # making the example does not count
        for number in range(first, BATCH):
            if time.monotonic() > end:
                break
            fault = example.try_seed(seed + number)
            if fault:
                results.send(("fault", fault))
            results.send(("done", ""))
    with suppress(OSError):
        results.send(("end", ""))


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
    """Raise in the main thread when the time is up."""

    def stop(*_: Any) -> None:
        raise TooSlowError(f"more than {SECONDS:g} s")

    signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def limit_memory() -> None:
    """No more address space than this beyond what the imports take."""
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
