"""What a simulated world is, whatever scheme moves it, and how worlds are made from scenes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Pose, Truth
from tacsim.models.scene import GelSurface, Scene
from tacsim.physics.move import MoveStats


class World(Protocol):
    """Gels, and what they touch. Sensors are driven; everything else follows. SI units, world frame.

    At construction the gels are undeformed and touch nothing: `lower` at the identity pose, `upper` half-turned about x
    above the body with a clear gap, `indenter` (in a scene with one) clear of the gel.
    """

    @property
    def sensors(self) -> tuple[str, ...]: ...
    def pose(self, name: str) -> Pose:
        """world_from_sensor (or world_from_indenter for "indenter")."""
        ...

    def place(self, poses: Mapping[str, Pose]) -> None:
        """Puts the named frames elsewhere at once, at rest: for a world in which nothing touches, here or there."""
        ...

    def move(
        self, targets: Mapping[str, Pose], loads: Mapping[str, float] | None = None, duration: float | None = None,
        *, flow: bool = False,
    ) -> MoveStats:  # fmt: skip
        """Drives the named frames to their targets along a ramped straight path, then holds until settled. Rotations
        take the shorter direction: more than half a turn needs several motions.

        loads: normal force [N, positive = pressed] of sensors that hold it by moving along their own z axis; across it,
        and in orientation, they follow their target (or stay). Afterwards `pose` says where they are. Raises
        LoadNotReached (tacsim.physics.motion.load), with the world as it was, for a load out of reach.

        duration [s]: makes the motion dynamic (tacsim.physics.motion.inertia): it takes exactly this long, with the
        materials' true densities and undamped, and is not held at its end. What still moves then keeps its velocity in
        a next motion with a duration, and is stopped by one without. Raises ValueError for one that is too short.

        flow: frames pass their targets without stopping and nothing is held; the next such motion continues from there.
        For many small steps in a row, each in a third of the time and within some percent of the force at rest
        (docs/physics.md). Frames without a target come to a stop. With nothing to do and nothing moving it holds until
        settled, like every other motion, which first brings to rest what flows.

        Raises SimulationDiverged (tacsim.physics.failure.health) when no step size gives a finite state; KeyError or
        ValueError for a command that makes no sense, before anything moves: loads, duration and flow exclude one
        another, and physics 'seed' knows neither duration nor flow; RuntimeError while another motion is running.
        """
        ...

    def wrench(self, name: str) -> NDArray[np.float64]:
        """(6,) what the object does to the sensor, about the sensor origin, sensor axes [N, N m]."""
        ...

    def surface(self, name: str) -> GelSurface: ...
    def truth(self) -> Truth | None:
        """None in a scene without a body."""
        ...

    def snapshot(self) -> Mapping[str, NDArray[Any]]:
        """A copy of the whole state, as named arrays."""
        ...

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Raises ValueError, with nothing changed, if `state` is no snapshot of such a world."""
        ...


def make_world(scene: Scene) -> World:
    """The world of a scene, by the scheme that its `physics` names."""
    return SCHEMES[scene.physics](scene)


def _seed_world(scene: Scene) -> World:
    """One shared MPM grid."""
    from tacsim.physics.seed.world import SeedWorld

    return SeedWorld(scene)


def _hybrid_world(scene: Scene) -> World:
    """Elastic gels of finite elements: one that an indenter presses, or two round a body."""
    if scene.indenter is not None:
        from tacsim.physics.worlds.press import PressWorld

        return PressWorld(scene)
    from tacsim.physics.worlds.hybrid import HybridWorld

    return HybridWorld(scene)


SCHEMES: dict[str, Callable[[Scene], World]] = {"seed": _seed_world, "hybrid": _hybrid_world}  # by Scene.physics
