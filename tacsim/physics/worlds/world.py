"""What a simulated world is, whatever scheme moves it, and how one is made from a scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Pose, Truth
from tacsim.models.scene import GelSurface, Scene


@dataclass(frozen=True, slots=True)
class MoveStats:
    """How one motion went."""

    substeps: int  # explicit substeps of motion and hold together
    hold: int  # of which hold
    residual: float  # largest relative force imbalance or force change at the end [-]
    settled: bool  # residual <= the scene's tolerance
    overlap: float  # deepest overlap of body (or indenter) and gel surface in the last substep [m]
    guard_hits: int  # times a guard changed the physics (particles set aside, gaps capped) or met gels in one another
    retries: int = 0  # times the motion was begun anew with half the time step
    load_error: float = 0.0  # largest |force - load| of the sensors that hold a load [N]
    time_step: float = 0.0  # as the way of the gel's pressure wave in it; of the last substep [m]
    damping: float = 0.0  # of the gel in the last substep: its rate times the wave's time through the gel [-]
    gel_overlap: float = 0.0  # deepest overlap of the two gels with one another at the end, which they do not feel [m]
    courant: float = 0.0  # largest time step / time of the wave through the most squeezed element or grid cell [-]


@dataclass(frozen=True, slots=True)
class Order:
    """What one motion of a world is asked for; see `World.move`."""

    targets: Mapping[str, Pose]
    loads: Mapping[str, float] = field(default_factory=dict)
    duration: float | None = None
    flow: bool = False

    def __post_init__(self) -> None:
        """Raises ValueError for what excludes each other."""
        if self.loads and self.duration is not None:
            raise ValueError("loads are held in settled states, not in a motion with a duration: give one of the two")
        if self.flow and (self.loads or self.duration is not None):
            what = "loads are held in settled states" if self.loads else "a duration makes a motion dynamic"
            raise ValueError(f"{what}, and a motion that flows ends in neither: give one of the two")


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


def is_number(value: object) -> bool:
    """Whether it is one real number, of Python or NumPy."""
    return isinstance(value, Real)


def taken(arrays: Mapping[str, NDArray[Any]], poses: Mapping[str, Pose]) -> dict[str, NDArray[Any]]:
    """A snapshot: copies of a world's arrays, and the poses of its driven frames."""
    state = {name: a.copy(order="K") for name, a in arrays.items()}
    state["poses"] = np.array([[*p.position, *p.quaternion] for p in poses.values()])
    return state


def put_back(
    arrays: Mapping[str, NDArray[Any]], frames: Sequence[str], state: Mapping[str, NDArray[Any]],
    finite: Sequence[str] = (),
) -> dict[str, Pose]:  # fmt: skip
    """Copies a snapshot into a world's arrays; returns the poses.

    finite: those of the arrays that no motion can begin from unless they are. Raises TypeError for what is no snapshot,
    ValueError for one that does not fit; then nothing is changed.
    """
    if not isinstance(state, Mapping):
        raise TypeError(f"a snapshot holds arrays by their names, as World.snapshot gives them; found {state!r}")
    found = {name: np.asarray(state[name]) for name in (*arrays, "poses") if name in state}
    for name, wanted in {**arrays, "poses": np.empty((len(frames), 7))}.items():
        if name not in found or found[name].shape != wanted.shape:
            shape = found[name].shape if name in found else "nothing"
            raise ValueError(f"snapshot: '{name}' must have shape {wanted.shape}, found {shape}; is it of this scene?")
        if not np.can_cast(found[name].dtype, wanted.dtype, "same_kind"):
            raise ValueError(f"snapshot: '{name}' must hold {wanted.dtype}, found {found[name].dtype}")
        if name in finite and not np.isfinite(found[name]).all():
            raise ValueError(f"snapshot: '{name}' is not finite; restore another one")
    poses = {}
    for frame, numbers in zip(frames, found["poses"], strict=True):
        try:
            poses[frame] = Pose(numbers[:3], numbers[3:])
        except ValueError as error:
            raise ValueError(f"snapshot: 'poses' of '{frame}': {error}") from None
    for name, a in arrays.items():
        a[...] = found[name]
    return poses


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
