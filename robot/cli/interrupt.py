"""Ctrl-C and SIGTERM as a wish to stop, so that an episode ends cleanly and is saved."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Any, Self

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupt:
    """While open, the first signal is noted, a second one raises KeyboardInterrupt. Open it in the main thread."""

    def __init__(self) -> None:
        self._signal: int | None = None
        self._before: dict[int, Any] = {}

    def __call__(self) -> bool:
        """True once a signal has come: the stop flag of the control loop."""
        return self._signal is not None

    @property
    def exit_code(self) -> int:
        """128 + signal, as shells have it; 0 without a signal."""
        return 0 if self._signal is None else 128 + self._signal

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self._signal is not None:
            raise KeyboardInterrupt
        self._signal = number

    def __enter__(self) -> Self:
        self._before = {number: signal.signal(number, self._note) for number in SIGNALS}
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
