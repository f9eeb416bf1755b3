"""What every world is besides its physics: arrays that kernels change in place, and one motion at a time."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from typing import Any, NoReturn, Self

from tacsim.interface import Pose
from tacsim.physics.motion.controller import Motion
from tacsim.physics.move import MoveCommand


class NotCopyable:
    """Its arrays are views of one another, and a copy would tear them apart."""

    _instead = "make_world(scene) and restore(world.snapshot())"  # what to do instead of copying

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        """Raises TypeError: both pickle and copy come here."""
        raise TypeError(f"a {type(self).__name__} cannot be copied or pickled: {self._instead}")


class BaseWorld(NotCopyable, ABC):
    """One environment with driven frames, some of which are sensors; its motions come one after the other."""

    sensors: tuple[str, ...]
    _poses: dict[str, Pose]  # of the driven frames
    _lock: threading.Lock  # held while it moves

    def __new__(cls, *arguments: Any, **options: Any) -> Self:
        world = super().__new__(cls)
        world._lock = threading.Lock()
        return world

    def pose(self, name: str) -> Pose:
        if name not in self._poses:
            raise KeyError(f"no driven frame {name}; this world drives {', '.join(self._poses)}")
        return self._poses[name]

    def _sensor(self, name: str) -> int:
        """The index of a sensor. Raises KeyError for a name that is none."""
        if name not in self.sensors:
            raise KeyError(f"no sensor '{name}'; this world has {', '.join(self.sensors)}")
        return self.sensors.index(name)

    def motion(self, command: MoveCommand) -> Motion:
        """`World.move`, launch by launch. Raises RuntimeError, once begun, while another motion is on its way."""
        if not self._lock.acquire(blocking=False):
            raise RuntimeError("this world is already moving: wait for that motion, or give each thread its own world")
        try:
            return (yield from self._run_command(command))
        finally:
            self._lock.release()

    @abstractmethod
    def _run_command(self, command: MoveCommand) -> Motion:
        """What `motion` does while it holds the lock."""
