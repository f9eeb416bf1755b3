"""A command on a pseudo-terminal, and its screen as a person sees it."""

from __future__ import annotations

import fcntl
import os
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

import pyte

from tests.robot.cli.invoked import environment

CONTROLLING = "import fcntl, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0)\n"  # Ctrl-C typed there reaches the process
COMMAND = "from robot.cli import main; main()"
PATIENCE = 90.0  # for an event [s]


class Terminal:
    """Runs `tacsim WORDS` in `folder`, or another program."""

    def __init__(self, *words: str, folder: Path, program: str = COMMAND, columns: int = 100, lines: int = 40) -> None:
        self._screen = pyte.Screen(columns, lines)
        self._stream, self._lock = pyte.ByteStream(self._screen), threading.Lock()
        self._own, inner = os.openpty()
        fcntl.ioctl(inner, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
        surroundings = {**environment(), "TERM": "xterm-256color"}
        surroundings = {
            key: value for key, value in surroundings.items() if key not in ("COLUMNS", "LINES", "NO_COLOR")
        }
        self.process = subprocess.Popen(
            [sys.executable, "-c", CONTROLLING + program, *words],
            stdin=inner, stdout=inner, stderr=inner, cwd=folder, env=surroundings, start_new_session=True,
        )  # fmt: skip
        os.close(inner)
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        while True:
            try:
                data = os.read(self._own, 65536)
            except OSError:  # the other end is closed
                return
            with self._lock:
                self._stream.feed(data)

    @property
    def text(self) -> str:
        """The screen, its lines joined as a person reads on at the next one."""
        with self._lock:
            return "".join(line.ljust(self._screen.columns) for line in self._screen.display)

    def shows(self, words: str) -> bool:
        """Whether these words can be read, broken over lines or not."""
        return words.replace(" ", "") in self.text.replace(" ", "")

    def wait_for(self, words: str) -> None:
        self.until(lambda: self.shows(words), f"'{words}' on the screen")

    def until(self, done: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + PATIENCE
        while not done():
            ended = self.process.poll()
            assert ended is None or done(), f"ended with {ended}, {what} never came:\n{self.picture}"
            assert time.monotonic() < deadline, f"{what}: not within {PATIENCE:g} s:\n{self.picture}"
            time.sleep(0.02)

    @property
    def picture(self) -> str:
        with self._lock:
            return "\n".join(line.rstrip() for line in self._screen.display).rstrip()

    def type(self, text: str) -> None:
        os.write(self._own, text.encode())

    def end(self) -> int:
        """Waits for the command's end; its exit code."""
        code = self.process.wait(PATIENCE)
        self._thread.join(PATIENCE)
        return code

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._thread.join()
        os.close(self._own)
