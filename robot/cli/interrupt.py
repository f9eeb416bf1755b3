"""Ctrl-C, SIGTERM and a lost terminal (SIGHUP) as a wish to stop, so that arms come to rest and an episode is saved."""

from __future__ import annotations

import contextlib
import os
import signal
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self

import typer

from robot.cli.errors import complain

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
            with contextlib.suppress(OSError), Path(os.devnull).open("wb") as nowhere:
                os.dup2(nowhere.fileno(), stream)
