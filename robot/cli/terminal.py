"""The operator at the terminal: questions, and Ctrl-C, SIGTERM or a lost terminal (SIGHUP) as a request to stop."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any, Self

import typer

from robot.cli.errors import print_error
from robot.cli.output import pause_displays
from tacsim.models.text import escape_text

if TYPE_CHECKING:
    from tacsim.models.rig import RigConfig

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class Interrupt:
    """In its block, a signal stops the command. Open it in the main thread.

    Before the first call of this object, the first signal raises KeyboardInterrupt, which ends slow work and motions at
    once. After the first call, the signal is only stored: the next call returns True, and the caller ends its work in
    order. A second signal always raises KeyboardInterrupt. A KeyboardInterrupt that leaves the block becomes the exit
    of the command.

    on_signal: called in the signal handler when a signal is stored, for work that does not ask this object.
    """

    def __init__(self, on_signal: Callable[[], None] = lambda: None) -> None:
        self._on_signal = on_signal
        self._signal: int | None = None
        self._was_called = False
        self._before: dict[int, Any] = {}

    def __call__(self) -> bool:
        """True once a signal has come: the stop flag of the control loop."""
        self._was_called = True
        return self._signal is not None

    @property
    def exit_code(self) -> int:
        """128 + signal, as in shells; 0 without a signal."""
        return 0 if self._signal is None else 128 + self._signal

    def _handle_signal(self, number: int, frame: FrameType | None) -> None:
        first = self._signal is None
        if first:
            self._signal = number
            _redirect_lost_terminal()
        if not (first and self._was_called):
            raise KeyboardInterrupt
        self._on_signal()

    def __enter__(self) -> Self:
        for number in SIGNALS:
            before = signal.getsignal(number)
            if number in (signal.SIGINT, signal.SIGTERM) or before != signal.SIG_IGN:  # `nohup` ignores SIGHUP
                self._before[number] = signal.signal(number, self._handle_signal)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if self._signal is not None and isinstance(error, KeyboardInterrupt | typer.Abort):
            print_error(f"stopped by {signal.Signals(self._signal).name}")
            raise typer.Exit(self.exit_code) from None


def _redirect_lost_terminal() -> None:
    """Redirects output to os.devnull if the terminal is gone: otherwise printing would fail, and end the remaining
    work."""
    for stream in (1, 2):
        try:
            os.write(stream, b"")
        except OSError:
            with suppress(OSError), Path(os.devnull).open("wb") as nowhere:
                os.dup2(nowhere.fileno(), stream)


class NoAnswer(RuntimeError):
    """The input ended before the operator answered a question."""


def has_operator() -> bool:
    """True if the operator can read and answer questions: input and error output are a terminal."""
    return all(
        stream is not None and stream.isatty() for stream in (sys.stdin, sys.stderr)
    )  # None: the stream is closed


def ask_operator(question: str, *, default: bool = False) -> bool:
    """Asks the operator at the terminal; returns False without a terminal.

    Progress displays are paused, and text that was typed before the question is discarded. Raises KeyboardInterrupt at
    a signal, NoAnswer at the end of the input (Ctrl-D).
    """
    if not has_operator():
        return False
    signals: list[int] = []

    def end(number: int, frame: FrameType | None) -> None:
        signals.append(number)
        before[number](number, frame)
        raise KeyboardInterrupt

    before = {number: handler for number in SIGNALS if callable(handler := signal.getsignal(number))}
    with pause_displays():
        try:
            for number in before:
                signal.signal(number, end)
            _discard_typed_input()
            return typer.confirm(escape_text(question), default=default, err=True)
        except typer.Abort:
            if signals:
                raise KeyboardInterrupt from None
            raise NoAnswer(f"no answer to the question: {question}") from None
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def require_operator(config: RigConfig) -> None:
    """Raises CannotOpen, before any motion, if a real arm would move and there is no terminal to confirm it."""
    from robot.open import CannotOpen

    if has_real_arm(config) and not has_operator():
        raise CannotOpen(
            f"rig '{config.name}': a real arm approaches only after the operator has confirmed; run this from a "
            "terminal, without redirecting input or error output"
        )


def has_real_arm(config: RigConfig) -> bool:
    """True if an arm of the rig is not a mock; a manufacturer's simulator counts as real."""
    return any(arm.is_real for arm in config.arms.values())


def _discard_typed_input() -> None:
    with suppress(ImportError):  # Windows has no termios
        import termios

        termios.tcflush(sys.stdin, termios.TCIFLUSH)
