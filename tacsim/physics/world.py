"""What a simulated world is, whatever scheme moves it, and how worlds are made from scenes."""

from __future__ import annotations

from collections.abc import Mapping
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

    def move(
        self, targets: Mapping[str, Pose], loads: Mapping[str, float] | None = None, duration: float | None = None,
        *, flow: bool = False,
    ) -> MoveStats:  # fmt: skip
        """Drives the named frames to their targets along a ramped straight path, then holds until settled. What turns
        takes the shorter way round: more than half a turn is several motions.

        loads: normal force [N, positive = pressed] of sensors that hold it by moving along their own z axis; across it,
        and in orientation, they follow their target (or stay). Afterwards `pose` says where they came to. Raises
        LoadNotReached (tacsim.physics.motion.load), with the world as it was, for a load out of reach.

        duration [s]: makes the motion dynamic (tacsim.physics.motion.inertia): it takes just so long, by the materials'
        true densities and undamped, and is not held at its end; what still moves then goes on in a next motion with a
        duration, and stops in one without. Raises ValueError together with loads, for one too short, and where the
        world has no true inertia (`seed`).

        flow: frames pass their targets at speed and nothing is held, so a next such motion goes on from there: for many
        small steps in a row, each in a third of the time and some percent of force from its state of rest
        (docs/physics.md). Frames without a target are told to stay. With nothing to do and nothing in motion it holds
        until settled, like every other motion, which first brings to rest what flows. Raises ValueError together with
        loads or a duration, and for `seed`.

        Raises SimulationDiverged (tacsim.physics.failure.health) when no step size gives a finite state; KeyError,
        TypeError or ValueError for an order that makes no sense, before anything moves; RuntimeError while another
        motion is on its way.
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
        """Raises TypeError or ValueError, with nothing changed, if `state` is no snapshot of such a world."""
        ...


def make_world(scene: Scene) -> World:
    """The world of a scene: `seed` (one shared MPM grid), a rigid press, or two gels round a body."""
    if scene.physics == "seed":
        from tacsim.physics.seed.world import SeedWorld

        return SeedWorld(scene)
    if scene.indenter is not None:
        from tacsim.physics.worlds.press import PressWorld

        return PressWorld(scene)
    from tacsim.physics.worlds.hybrid import HybridWorld

    return HybridWorld(scene)
