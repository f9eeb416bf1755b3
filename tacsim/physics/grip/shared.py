"""Grips of many simulations in one world, so that one launch advances them."""

from __future__ import annotations

from dataclasses import dataclass

from tacsim.models.scene import Scene
from tacsim.physics.grip.model import HeldObject
from tacsim.physics.grip.world import GripWorld


class SharedGrips:
    """A world of `count` grips that is made when the first of them is needed: until then a process may fork."""

    def __init__(self, count: int = 1) -> None:
        self._count = count
        self._world: GripWorld | None = None

    def place(self, index: int, item: HeldObject, scene: Scene) -> GripWorld:
        """The world, its grip number `index` newly made, with an object between gels of a scene. Raises what
        `GripWorld` raises, and ValueError for gels of another lattice than those of the first scene."""
        if self._world is None:
            self._world = GripWorld([item] * self._count, scene.gel, preset=scene.preset, gravity=scene.gravity)
        self._world.replace(index, item, scene.gel, scene.gravity)
        return self._world


@dataclass(frozen=True, slots=True)
class GripPlace:
    """One grip of shared ones."""

    shared: SharedGrips
    index: int

    def fill(self, item: HeldObject, scene: Scene) -> GripWorld:
        """See `SharedGrips.place`."""
        return self.shared.place(self.index, item, scene)
