"""Signals that end a command: at once where nothing asks about them, in order where something does."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import typer

from robot.cli.terminal import Interrupt
from tests.robot.cli.invoked import environment

NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in NUMBERS}
    yield
    assert {number: signal.getsignal(number) for number in NUMBERS} == before


def exit_of(act: Callable[[Interrupt], object]) -> int:
    """How a command ends in which `act` happens."""
    try:
        with Interrupt() as interrupt:
            act(interrupt)
    except typer.Exit as ended:
        return ended.exit_code
    return 0


@pytest.mark.parametrize("number", NUMBERS)
def test_signal_before_first_poll_ends_command_at_once(
    number: signal.Signals, capsys: pytest.CaptureFixture[str]
) -> None:
    """Opening a rig, the reset with its approach, a question to a person: nothing there looks at the flag."""
    gone_on: list[bool] = []
    assert exit_of(lambda _: (os.kill(os.getpid(), number), gone_on.append(True))) == 128 + number  # type: ignore[func-returns-value]
    assert not gone_on
    assert f"stopped by {number.name}" in capsys.readouterr().err


@pytest.mark.parametrize("number", NUMBERS)
def test_stored_signal_is_passed_on_once(number: signal.Signals) -> None:
    passed_on: list[bool] = []
    with Interrupt(lambda: passed_on.append(True)) as interrupt:
        assert not interrupt()
        os.kill(os.getpid(), number)
        assert passed_on == [True]
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
    assert passed_on == [True]


@pytest.mark.parametrize("number", NUMBERS)
def test_polled_signal_ends_in_order_and_second_at_once(number: signal.Signals) -> None:
    with Interrupt() as interrupt:
        assert not interrupt() and interrupt.exit_code == 0
        os.kill(os.getpid(), number)
        assert interrupt() and interrupt.exit_code == 128 + number

    def twice(interrupt: Interrupt) -> None:
        interrupt()
        os.kill(os.getpid(), number)
        os.kill(os.getpid(), signal.SIGTERM)

    assert exit_of(twice) == 128 + number


def test_aborted_question_counts_as_signal() -> None:
    def asked(_: Interrupt) -> None:
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt:
            raise typer.Abort from None  # as typer.confirm does

    assert exit_of(asked) == 130


def test_nohup_process_ignores_hangup() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interrupt() as interrupt:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not interrupt()
    finally:
        signal.signal(signal.SIGHUP, before)


LOST = """
import sys, time
from pathlib import Path
from robot.cli.terminal import print_error
from robot.cli.terminal import Interrupt
from robot.cli.output import progress, results
with Interrupt() as interrupt, progress() as bar:
    row = bar.add_task("at work", total=None)
    interrupt()
    print("ready", flush=True)
    while not interrupt():
        time.sleep(0.01)
    bar.update(row, completed=1)
Path(sys.argv[1]).write_text("saved")
results.print("the report")
print_error("stopped by a signal")
sys.exit(interrupt.exit_code)
"""


def test_lost_terminal_does_not_prevent_saving(tmp_path: Path) -> None:
    """Each print to such a terminal is an OSError."""
    master, slave = pty.openpty()
    words = [sys.executable, "-c", LOST, str(tmp_path / "report")]
    with subprocess.Popen(words, env=environment(), stdin=slave, stdout=slave, stderr=slave) as process:
        os.close(slave)
        said = b""
        while b"ready" not in said:
            said += os.read(master, 1000)
        os.close(master)
        process.send_signal(signal.SIGHUP)
        assert process.wait(60) == 129
    assert (tmp_path / "report").read_text() == "saved"
