"""What a rig simulates: the world of its present scene."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Pose, Truth
from tacsim.models.scene import GelSurface, Scene
from tacsim.physics.move import MoveStats
from tacsim.physics.world import World, make_world

State = Mapping[str, NDArray[Any]]


class SimulatedScene(Protocol):
    """What is simulated, to be exchanged between episodes."""

    scene: Scene

    def set_scene(self, scene: Scene) -> None:
        """From the next episode on. Raises ValueError for a scene that the rig cannot go to."""
        ...


class SceneWorld:
    """The world of the present scene, to be used as that world. It is made when it is first needed: until then nothing
    of a simulation runs, so a process may fork. `set_scene` exchanges the scene between episodes.

    Args:
        make: a new world of a scene.
    """

    def __init__(self, scene: Scene, make: Callable[[Scene], World] = make_world) -> None:
        self.scene, self._make = scene, make
        self._world: World | None = None
        self._begin: State = {}

    def set_scene(self, scene: Scene) -> None:
        """From the next `rewind` on. Raises ValueError for a scene whose gels are cut otherwise."""
        if scene != self.scene:
            require_same_gels(self.scene, scene)
            self.scene, self._world = scene, None

    def rewind(self) -> None:
        """The world as it was made: gels undeformed, nothing touches."""
        if self._world is None:
            self.world()
        else:
            self._world.restore(self._begin)

    def world(self) -> World:
        if self._world is None:
            self._world = self._make(self.scene)
            self._begin = self._world.snapshot()
        return self._world

    # ------------------------------------------------------------------ as a World

    @property
    def sensors(self) -> tuple[str, ...]:
        return self.scene.sensors

    def pose(self, name: str) -> Pose:
        return self.world().pose(name)

    def place(self, poses: Mapping[str, Pose]) -> None:
        self.world().place(poses)

    def move(
        self, targets: Mapping[str, Pose], loads: Mapping[str, float] | None = None, duration: float | None = None,
        *, flow: bool = False,
    ) -> MoveStats:  # fmt: skip
        return self.world().move(targets, loads, duration, flow=flow)

    def wrench(self, name: str) -> NDArray[np.float64]:
        return self.world().wrench(name)

    def surface(self, name: str) -> GelSurface:
        return self.world().surface(name)

    def truth(self) -> Truth | None:
        return self.world().truth()

    def snapshot(self) -> State:
        return self.world().snapshot()

    def restore(self, state: State) -> None:
        self.world().restore(state)


def require_same_gels(scene: Scene, other: Scene) -> None:
    """Raises ValueError where a rig cannot go from one scene to the other: sensors see one gel, and a batch has one
    lattice."""
    unchanging: dict[str, tuple[object, object]] = {
        "physics": (scene.physics, other.physics),
        "a body": (scene.body is not None, other.body is not None),
        "an object": (scene.object is not None, other.object is not None),
    }
    for name in scene.sensors:
        unchanging[f"gel.size of sensor '{name}' [m]"] = scene.gel_of(name).size, other.gel_of(name).size
        unchanging[f"the size of elements of the gel of '{name}' [m]"] = (
            scene.element_size_of(name),
            other.element_size_of(name),
        )
    for what, (now, new) in unchanging.items():
        if now != new:
            raise ValueError(f"a new scene must keep {what} of the rig's: {now}, got {new}; open another rig for it")


class StatePool:
    """States that motions from a known start ended in, so that the same motion need not be computed again. A state is a
    function of its key alone, so results do not depend on what is kept: the states used last, MAX_BYTES of them."""

    def __init__(self, max_bytes: int = 256_000_000) -> None:
        self._max_bytes, self._bytes = max_bytes, 0
        self._states: OrderedDict[object, tuple[State, MoveStats | None]] = OrderedDict()

    def find(self, key: object) -> tuple[State, MoveStats | None] | None:
        """The state and how its last motion went; None for a key that is not kept."""
        if key in self._states:
            self._states.move_to_end(key)
        return self._states.get(key)

    def store(self, key: object, state: State, stats: MoveStats | None) -> None:
        self._states[key] = state, stats
        self._bytes += _state_bytes(state)
        while self._bytes > self._max_bytes and len(self._states) > 1:
            _, (oldest, _) = self._states.popitem(last=False)
            self._bytes -= _state_bytes(oldest)


def _state_bytes(state: State) -> int:
    return sum(a.nbytes for a in state.values())
