"""What a mock camera sees of a mock arm, drawn by a thread while a test leads the arm through a procedure."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from contextlib import closing
from typing import Self

from robot.mock import FaultClient, MockCamera, MockState


class SeenArm(ABC):
    """While open, `draw` is given the state of the controller at `host` again and again."""

    def __init__(self, host: str, camera: MockCamera) -> None:
        self._host, self._camera = host, camera
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)

    @abstractmethod
    def draw(self, state: MockState) -> None:
        """Pushes to the camera what it sees now."""

    def _run(self) -> None:
        with closing(FaultClient(self._host)) as faults:
            while not self._over.is_set():
                try:
                    state = faults.state()
                except RuntimeError:  # the controller comes and goes with the rig
                    self._over.wait(0.02)
                    continue
                self.draw(state)
                self._over.wait(3e-3)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._over.set()
        self._thread.join()
