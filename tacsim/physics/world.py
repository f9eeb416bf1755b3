"""The interface of a simulated world, the same for all schemes, and how worlds are made from scenes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Pose, Truth
from tacsim.models.scene import GelSurface, Scene
from tacsim.physics.move import MoveStats


class World(Protocol):
    """Gels and what they touch. Sensors are driven; everything else moves by the physics. SI units, world frame.

    At construction the gels are undeformed and touch nothing: `lower` at the identity pose, `upper` half-turned about x
    above the body with a clear gap, `indenter` (in a scene with one) clear of the gel.
    """

    @property
    def sensors(self) -> tuple[str, ...]: ...
    def pose(self, name: str) -> Pose:
        """world_from_sensor (or world_from_indenter for "indenter")."""
        ...

    def place(self, poses: Mapping[str, Pose]) -> None:
        """Puts the named frames at other poses at once, at rest. Nothing may touch before or after."""
        ...

    def move(
        self, targets: Mapping[str, Pose], loads: Mapping[str, float] | None = None, duration: float | None = None,
        *, flow: bool = False,
    ) -> MoveStats:  # fmt: skip
        """Drives the named frames to their targets along a ramped straight path, then holds until settled. Rotations
        take the shorter direction: more than half a turn needs several motions.

        loads: normal force [N, positive = pressed] of sensors that hold it by moving along their own z axis. Along x
        and y, and in orientation, these sensors follow their target (or stay). Afterwards `pose` returns where they
        are. Raises LoadNotReached (tacsim.physics.motion.load) for a load out of reach; the world is then unchanged.

        duration [s]: makes the motion dynamic (tacsim.physics.motion.inertia). It takes exactly this time, with the
        materials' true densities and without damping, and there is no hold at its end. Velocities at its end are kept
        by a next motion with a duration, and set to zero by one without. Raises ValueError for one that is too short.

        flow: frames pass their targets without stopping and without a hold; the next such motion continues from there.
        Use it for many small steps: each takes a third of the time, with forces within some percent of those at rest
        (docs/physics.md). Frames without a target stop. Without a target or a velocity the motion is a hold until
        settled. A motion without `flow` first stops frames that still flow.

        Raises SimulationDiverged (tacsim.physics.failure.health) when no step size gives a finite state; KeyError or
        ValueError, before anything moves, for a command that is not valid: loads, duration and flow exclude each
        other, and physics 'seed' supports neither duration nor flow; RuntimeError while another motion is running.
        """
        ...

    def wrench(self, name: str) -> NDArray[np.float64]:
        """(6,) force and moment of the object on the sensor, about the sensor's origin, sensor axes [N, N m]."""
        ...

    def surface(self, name: str) -> GelSurface: ...
    def truth(self) -> Truth | None:
        """None in a scene without a body."""
        ...

    def snapshot(self) -> Mapping[str, NDArray[Any]]:
        """A copy of the whole state, as named arrays."""
        ...

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Raises ValueError if `state` is no snapshot of such a world; the world is then unchanged."""
        ...


def make_world(scene: Scene) -> World:
    """The world of a scene, by the scheme named in `physics`. Raises ValueError for one with a rigid object."""
    if scene.object is not None:
        raise ValueError(
            f"scene '{scene.name}' has a rigid object, which only MuJoCo moves: open a rig with clock 'mujoco' "
            "(robot.open_rig('hand')), or press its shape as an `indenter`"
        )
    return SCHEMES[scene.physics](scene)


def _seed_world(scene: Scene) -> World:
    """One shared MPM grid."""
    from tacsim.physics.seed.world import SeedWorld

    return SeedWorld(scene)


def _hybrid_world(scene: Scene) -> World:
    """Elastic gels of finite elements: one under an indenter, or two around a body."""
    if scene.indenter is not None:
        from tacsim.physics.worlds.press import PressWorld

        return PressWorld(scene)
    from tacsim.physics.worlds.hybrid import HybridWorld

    return HybridWorld(scene)


SCHEMES: dict[str, Callable[[Scene], World]] = {"seed": _seed_world, "hybrid": _hybrid_world}  # by Scene.physics
