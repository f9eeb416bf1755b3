"""A motion that fails is started again from the state before it, with a smaller time step.

A launch that ends unphysical is not repeated by itself: an instability grows for many launches before it shows, so the
state at the start of the bad launch is not to be trusted.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

from numpy.typing import NDArray

from tacsim.interface import Pose
from tacsim.models.scene import Scene
from tacsim.physics.failure import diagnosis, dump
from tacsim.physics.failure.health import Place, SimulationDiverged
from tacsim.physics.move import MoveCommand, MoveStats
from tacsim.physics.snapshot import State, copies

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
    world: RestorableWorld, order: MoveCommand, motion: Callable[[int], Generator[Wanted, Seen, MoveStats]]
) -> Generator[Wanted, Seen, MoveStats]:
    """The motion `motion(refine)`, which does with `world` what is asked for, with 1/refine of its step; refine = 1, 2,
    4.

    Whoever runs it throws in the SimulationDiverged of a launch; the world then rolls back by itself and yields the
    first launch of the next try. After every failure, an interruption included, the world is as it was before. Raises
    SimulationDiverged when no step does, or when the state was broken already; writes a dump then if one is asked for
    (tacsim.physics.failure.dump).
    """
    before = world.snapshot()
    broken = diagnosis.not_finite(before)
    if broken is not None:
        failure = SimulationDiverged(broken, "before the motion began", NEW_WORLD)
        failure.good = failure.failed = before
    else:
        for retry in range(RETRIES + 1):
            try:
                stats = yield from motion(2**retry)
                _require_upright(world, order.targets)
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
    _dump(world, order, before, failure)
    raise failure


def _require_upright(world: RestorableWorld, targets: Mapping[str, Pose]) -> None:
    """Raises SimulationDiverged if a motion ended with a gel element inside out."""
    state, thickness = world.arrays(), world.scene.gel.size[2] * 1e3
    if "gel_displacement" not in state or diagnosis.nearly_at_rest(state, thickness):
        return
    corners = diagnosis.corner_volumes(state, thickness)
    if corners is not None and not corners.min() > SMALLEST_CORNER:
        words = f"a gel element is turned inside out (volume ratio {corners.min():.3g} at a corner)"
        end = Place("at the end of the motion and its hold", {**_poses(world), **targets})
        failure = SimulationDiverged(words, str(end))
        failure.quantity, failure.failed, failure.poses = "corner", copies(state), end.poses
        raise failure


def _poses(world: RestorableWorld) -> dict[str, Pose]:
    scene = world.scene
    frames = (*scene.sensors, *(() if scene.indenter is None else ("indenter",)))
    return {name: world.pose(name) for name in frames}


def _dump(world: RestorableWorld, order: MoveCommand, before: State, failure: SimulationDiverged) -> None:
    """Writes the dump if the environment names a folder for it; an error here must not hide the one reported."""
    folder = os.environ.get(dump.FOLDER)
    if folder is None:
        failure.no_dump = "set TACSIM_DUMPS to a folder to keep a replayable state"
    if not folder:
        return
    try:
        failure.dump = dump.write(Path(folder), world.scene, _poses(world), order, before, failure)
    except (OSError, ValueError) as error:
        failure.no_dump = f"no dump could be written to {folder}: {error}"
