"""A person at the terminal: questions, and Ctrl-C, SIGTERM or a lost terminal (SIGHUP) as a request to stop."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any, Self

import typer

from robot.cli.errors import complain
from robot.cli.output import paused
from tacsim.models.text import escape_text

if TYPE_CHECKING:
    from tacsim.models.rig import RigConfig

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class Interrupt:
    """While open, a signal stops the command. Open it in the main thread.

    Before anybody has asked whether to stop, the first signal raises KeyboardInterrupt: nothing that takes long, or
    moves, goes on. From the first question on it is only noted, and who asks again ends in order what is under way. A
    second signal raises KeyboardInterrupt in any case. One that leaves this block becomes the command's exit.
    """

    def __init__(self) -> None:
        self._signal: int | None = None
        self._asked = False
        self._before: dict[int, Any] = {}

    def __call__(self) -> bool:
        """True once a signal has come: the stop flag of the control loop."""
        self._asked = True
        return self._signal is not None

    @property
    def exit_code(self) -> int:
        """128 + signal, as shells have it; 0 without a signal."""
        return 0 if self._signal is None else 128 + self._signal

    def _note(self, number: int, frame: FrameType | None) -> None:
        first = self._signal is None
        if first:
            self._signal = number
            _silence_lost_terminal()
        if not (first and self._asked):
            raise KeyboardInterrupt

    def __enter__(self) -> Self:
        for number in SIGNALS:
            before = signal.getsignal(number)
            if number in (signal.SIGINT, signal.SIGTERM) or before != signal.SIG_IGN:  # `nohup` means to go on
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if self._signal is not None and isinstance(error, KeyboardInterrupt | typer.Abort):
            complain(f"stopped by {signal.Signals(self._signal).name}")
            raise typer.Exit(self.exit_code) from None


def _silence_lost_terminal() -> None:
    """Where the terminal is gone, printing would fail each time, and with it what is still to be done: it goes nowhere
    from now on."""
    for stream in (1, 2):
        try:
            os.write(stream, b"")
        except OSError:
            with suppress(OSError), Path(os.devnull).open("wb") as nowhere:
                os.dup2(nowhere.fileno(), stream)


class NoAnswer(RuntimeError):
    """Somebody was asked, and the input ended."""


def has_person() -> bool:
    """Whether questions can be read and answered: both go by the terminal."""
    return all(stream is not None and stream.isatty() for stream in (sys.stdin, sys.stderr))  # None: it was closed


def ask(question: str, *, default: bool = False) -> bool:
    """A person's word, at a terminal; without one there is nobody to give it: False.

    Nothing is drawn over the question, and what was typed before it could be read is no answer to it. Raises
    KeyboardInterrupt at a signal, NoAnswer at the end of the input (Ctrl-D).
    """
    if not has_person():
        return False
    signals: list[int] = []

    def end(number: int, frame: FrameType | None) -> None:
        signals.append(number)
        before[number](number, frame)
        raise KeyboardInterrupt

    before = {number: handler for number in SIGNALS if callable(handler := signal.getsignal(number))}
    with paused():
        try:
            for number in before:
                signal.signal(number, end)
            _forget_typed()
            return typer.confirm(escape_text(question), default=default, err=True)
        except typer.Abort:
            if signals:
                raise KeyboardInterrupt from None
            raise NoAnswer(f"nobody answered: {question}") from None
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def require_person(config: RigConfig) -> None:
    """Raises CannotOpen, before anything moves, where a real arm would move and nobody could confirm it."""
    from robot.open import CannotOpen

    if has_real_arm(config) and not has_person():
        raise CannotOpen(
            f"rig '{config.name}': a real arm approaches nothing before somebody has confirmed it; run this from a "
            "terminal, with neither input nor error output led elsewhere"
        )


def has_real_arm(config: RigConfig) -> bool:
    """Whether an arm of the rig is no mock; a maker's simulator counts as real."""
    return any(arm.is_real for arm in config.arms.values())


def _forget_typed() -> None:
    with suppress(ImportError):  # Windows has no termios
        import termios

        termios.tcflush(sys.stdin, termios.TCIFLUSH)
