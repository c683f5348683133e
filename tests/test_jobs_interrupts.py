"""Ctrl-C, SIGTERM and SIGHUP are the same to a command, and none comes in the middle of a frame."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from improvo.__main__ import main as command
from improvo.cli.main import main
from improvo.jobs.interrupts import interrupts_wait, termination_interrupts

TERMINATIONS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")


@pytest.fixture(autouse=True)
def usual_handlers():
    before = {one: signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    for one, handler in before.items():
        signal.signal(one, handler)


@pytest.mark.parametrize("number", TERMINATIONS)
def test_termination_is_an_interrupt_within_the_block(number: int) -> None:
    with pytest.raises(KeyboardInterrupt), termination_interrupts():
        os.kill(os.getpid(), number)
    assert signal.getsignal(number) is signal.SIG_DFL


def test_what_is_to_go_on_without_a_terminal_does() -> None:
    """`nohup improvo ...`"""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with termination_interrupts(), interrupts_wait():
        os.kill(os.getpid(), signal.SIGHUP)
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


def test_termination_is_an_interrupt_after_colmap_was_loaded_too() -> None:
    pytest.importorskip("pycolmap")
    program = """
import os, signal
from improvo.evaluation.truth.structure_from_motion import load_pycolmap
from improvo.__main__ import main as command
from improvo.cli.main import main
from improvo.jobs.interrupts import termination_interrupts
try:
    with termination_interrupts():
        load_pycolmap()
        os.kill(os.getpid(), signal.SIGTERM)
except KeyboardInterrupt:
    print("interrupted")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted\n", "")


def test_a_handler_of_the_program_is_left_alone() -> None:
    came: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: came.append(number))
    with termination_interrupts():
        os.kill(os.getpid(), signal.SIGTERM)
    assert came == [signal.SIGTERM]


@pytest.mark.parametrize("number", [signal.SIGINT, *TERMINATIONS])
def test_an_interrupt_waits_for_the_end_of_the_block(number: int) -> None:
    done: list[str] = []

    def work() -> None:
        with interrupts_wait():
            os.kill(os.getpid(), number)
            done.append("the block")
        done.append("more")

    with termination_interrupts():
        with pytest.raises(KeyboardInterrupt):
            work()
        assert done == ["the block"]
        assert signal.getsignal(signal.SIGTERM) is signal.default_int_handler


def test_without_an_interrupt_nothing_happens() -> None:
    with termination_interrupts(), interrupts_wait():
        pass
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_where_interrupts_are_ignored_they_stay_so() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with interrupts_wait():
        os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_an_interrupt_within_compiled_code_ends_a_command_as_any_other(capsys, monkeypatch, tmp_path) -> None:
    """Numba makes a SystemError of it."""

    def compiled(*_: object) -> None:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        except KeyboardInterrupt as interrupt:
            raise SystemError("CPUDispatcher(...) returned a result with an exception set") from interrupt

    monkeypatch.setattr("improvo.cli.info.run", compiled)
    assert main(["info", str(tmp_path)]) == 130
    assert capsys.readouterr().err == "improvo: interrupted\n"


def test_another_error_of_compiled_code_stays_one(monkeypatch, tmp_path) -> None:
    def compiled(*_: object) -> None:
        raise SystemError("something else")

    monkeypatch.setattr("improvo.cli.info.run", compiled)
    with pytest.raises(SystemError):
        main(["info", str(tmp_path)])


def test_an_interrupt_while_the_command_line_is_loaded_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Interrupted:
        def find_spec(self, name: str, *_: object) -> None:
            if name == "improvo.cli.main":
                raise KeyboardInterrupt

    monkeypatch.setattr(sys, "meta_path", [Interrupted(), *sys.meta_path])
    monkeypatch.delitem(sys.modules, "improvo.cli.main", raising=False)
    assert command() == 130
    assert capsys.readouterr().err == "improvo: interrupted\n"
