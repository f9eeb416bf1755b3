"""How a command asks a person."""

from __future__ import annotations

import signal
import sys
from contextlib import suppress
from types import FrameType
from typing import TYPE_CHECKING

import typer

from robot.cli.interrupt import SIGNALS
from robot.cli.output import paused
from tacsim.models.text import escaped

if TYPE_CHECKING:
    from tacsim.models.rig import RigConfig


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
            return typer.confirm(escaped(question), default=default, err=True)
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
