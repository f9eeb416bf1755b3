"""What every world is besides its physics: one thing with numbers in place, which cannot be in two states at once."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from typing import Any, NoReturn, Self

from tacsim.interface import Pose
from tacsim.physics.motion.controller import Motion
from tacsim.physics.move import MoveCommand


class NotCopyable:
    """What kernels change in place, through arrays that look into one another: a copy of it would be torn apart."""

    _instead = "make_world(scene) and restore(world.snapshot())"  # what to do, in words

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        """Raises TypeError: both pickle and copy come here."""
        raise TypeError(f"a {type(self).__name__} cannot be copied or pickled: {self._instead}")


class BaseWorld(NotCopyable, ABC):
    """One environment with driven frames, some of which are sensors; its motions come one after the other."""

    sensors: tuple[str, ...]
    _poses: dict[str, Pose]  # of the driven frames
    _free: threading.Lock  # held while it moves

    def __new__(cls, *arguments: Any, **options: Any) -> Self:
        world = super().__new__(cls)
        world._free = threading.Lock()
        return world

    def pose(self, name: str) -> Pose:
        if name not in self._poses:
            raise KeyError(f"no driven frame {name}; this world drives {', '.join(self._poses)}")
        return self._poses[name]

    def _sensor(self, name: str) -> int:
        """The number of a sensor. Raises KeyError for what is none."""
        if name not in self.sensors:
            raise KeyError(f"no sensor '{name}'; this world has {', '.join(self.sensors)}")
        return self.sensors.index(name)

    def motion(self, order: MoveCommand) -> Motion:
        """`World.move`, a launch at a time. Raises RuntimeError, once begun, while another motion is not at its end."""
        if not self._free.acquire(blocking=False):
            raise RuntimeError("this world is already moving: wait for that motion, or give each thread its own world")
        try:
            return (yield from self._run_command(order))
        finally:
            self._free.release()

    @abstractmethod
    def _run_command(self, order: MoveCommand) -> Motion:
        """What `motion` does while no other does."""
