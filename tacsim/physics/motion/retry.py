"""A motion that fails is started again from the state before it, with a smaller time step.

A launch that ends unphysical is not repeated by itself: an instability grows for many launches before it shows, so the
state at the start of the bad launch is not to be trusted.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import replace
from typing import Any, Protocol, TypeVar

from numpy.typing import NDArray

from tacsim.interface import Pose
from tacsim.models.scene import Scene
from tacsim.physics.failure import diagnosis, dump
from tacsim.physics.failure.health import LaunchSpan, SimulationDiverged
from tacsim.physics.move import MoveCommand, MoveStats
from tacsim.physics.snapshot import State

RETRIES = 2  # each halves the time step
SMALLEST_CORNER = 0.0  # det F of a gel element at a corner: below, it is turned inside out
NEW_WORLD = "restore a snapshot, or make a new world"


class RestorableWorld(Protocol):
    """What `retried` needs of a world."""

    scene: Scene

    def pose(self, name: str) -> Pose: ...
    def arrays(self) -> State:
        """Views of all that changes in a motion, by name."""
        ...

    def snapshot(self) -> Mapping[str, NDArray[Any]]: ...
    def restore(self, state: Mapping[str, NDArray[Any]]) -> None: ...


Wanted = TypeVar("Wanted")
Seen = TypeVar("Seen")


def retried(
    world: RestorableWorld, command: MoveCommand, motion: Callable[[int], Generator[Wanted, Seen, MoveStats]]
) -> Generator[Wanted, Seen, MoveStats]:
    """`motion(refine)`, which carries out `command` with 1/refine of the time step; refine = 1, 2, 4 until it succeeds.

    Whoever runs it throws in the SimulationDiverged of a launch; it then restores the world and yields the first launch
    of the next attempt. After every failure, an interruption included, the world is as it was before. Raises
    SimulationDiverged when all attempts fail or the state was broken already, after writing a dump if one is asked for
    (tacsim.physics.failure.dump).
    """
    before = world.snapshot()
    broken = diagnosis.not_finite(before)
    if broken is not None:
        where = LaunchSpan("before the motion began")
        failure = SimulationDiverged(broken, where, NEW_WORLD, good=before, failed=before)
    else:
        for retry in range(RETRIES + 1):
            try:
                stats = yield from motion(2**retry)
                _require_upright(world, command)
                return replace(stats, retries=retry)
            except SimulationDiverged as diverged:
                failure, failure.refine = diverged, 2**retry
                world.restore(before)
                if not diverged.retry:
                    break
            except BaseException:
                world.restore(before)
                raise
    failure.place = diagnosis.place_of_worst(failure.quantity, failure.good, failure.failed, world.scene.gel.size)
    dump.write_if_asked(world.scene, _poses(world), command, before, failure)
    raise failure


def _require_upright(world: RestorableWorld, command: MoveCommand) -> None:
    """Raises SimulationDiverged if a motion ended with a gel element inside out."""
    state, thickness = world.arrays(), world.scene.gel.size[2] * 1e3
    if "gel_displacement" not in state or diagnosis.nearly_at_rest(state, thickness):
        return
    corners = diagnosis.corner_volumes(state, thickness)
    if corners is not None and not corners.min() > SMALLEST_CORNER:
        words = f"a gel element is turned inside out (volume ratio {corners.min():.3g} at a corner)"
        end = LaunchSpan("at the end of the motion and its hold", {**_poses(world), **command.targets})
        raise SimulationDiverged(words, end, quantity="corner", failed=state)


def _poses(world: RestorableWorld) -> dict[str, Pose]:
    """Of the driven frames."""
    frames = (*world.scene.sensors, *(() if world.scene.indenter is None else ("indenter",)))
    return {name: world.pose(name) for name in frames}
