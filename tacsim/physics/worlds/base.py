"""Base of all worlds: one motion at a time, which is started again with a smaller time step if it fails."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NoReturn, Self

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Pose
from tacsim.models.scene import Scene
from tacsim.physics.failure import diagnosis, dump
from tacsim.physics.failure.health import SEPARATION_ADVICE, LaunchSpan, SimulationDiverged
from tacsim.physics.motion.controller import ForceReading, Launch, Motion, run_motion
from tacsim.physics.move import MoveCommand, MoveStats
from tacsim.physics.snapshot import State, gel_arrays, snapshot_of
from tacsim.physics.worlds.tuning import MAX_RETRIES, SAFE_PATH_SHARE

if TYPE_CHECKING:  # a device's kernels
    from tacsim.physics.worlds.survey import Survey

NEW_WORLD = "restore a snapshot, or make a new world"


class NotCopyable:
    """Base of classes whose arrays are views of each other, which a copy would not keep."""

    _instead = "make_world(scene) and restore(world.snapshot())"  # what to do instead of copying

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        """Raises TypeError: both pickle and copy come here."""
        raise TypeError(f"a {type(self).__name__} cannot be copied or pickled: {self._instead}")


class BaseWorld(NotCopyable, ABC):
    """One environment with driven frames, some of which are sensors; it has one motion at a time."""

    scene: Scene
    sensors: tuple[str, ...]
    _poses: dict[str, Pose]  # of the driven frames
    _lock: threading.Lock  # held while it moves

    def __new__(cls, *arguments: Any, **options: Any) -> Self:
        world = super().__new__(cls)
        world._lock = threading.Lock()
        return world

    @abstractmethod
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Views of all arrays that a motion changes, by name."""

    def snapshot(self) -> dict[str, NDArray[Any]]:
        return snapshot_of(self.arrays(), self._poses)

    @abstractmethod
    def restore(self, state: State) -> None:
        """See World."""

    def _snapshot_before_motion(self) -> State:
        """A snapshot for `restore`, for a motion that fails."""
        return self.snapshot()

    def _survey(self) -> Survey | None:
        """Survey of the present state without access to its arrays; None unless a device has them."""
        return None

    def pose(self, name: str) -> Pose:
        if name not in self._poses:
            raise KeyError(f"no driven frame {name}; this world drives {', '.join(self._poses)}")
        return self._poses[name]

    def _sensor(self, name: str) -> int:
        """The index of a sensor. Raises KeyError for another name."""
        if name not in self.sensors:
            raise KeyError(f"no sensor '{name}'; this world has {', '.join(self.sensors)}")
        return self.sensors.index(name)

    def move(
        self, targets: Mapping[str, Pose], loads: Mapping[str, float] | None = None, duration: float | None = None,
        *, flow: bool = False,
    ) -> MoveStats:  # fmt: skip
        """See World."""
        return run_motion(self.motion(MoveCommand(targets, loads or {}, duration, flow)), self._advance)

    @abstractmethod
    def _advance(self, launch: Launch) -> list[ForceReading]:
        """Carries out one launch. Raises SimulationDiverged if its state is unphysical."""

    def motion(self, command: MoveCommand) -> Motion:
        """`move`, launch by launch. Raises RuntimeError at its start while another motion is running."""
        if not self._lock.acquire(blocking=False):
            raise RuntimeError("this world is already moving: wait for that motion, or give each thread its own world")
        try:
            return (yield from self._run_command(command))
        finally:
            self._lock.release()

    @abstractmethod
    def _run_command(self, command: MoveCommand) -> Motion:
        """The motion, called while the lock is held."""

    def _retry_smaller_steps(self, command: MoveCommand, attempt: Callable[[int], Motion]) -> Motion:
        """Runs `attempt(refine)`, which carries out `command` with 1/refine of the time step, for refine = 1, 2, 4
        until it succeeds.

        The whole motion starts again, from the state before it: an instability grows for many launches before it is
        detected, so the state at the start of the failed launch may be wrong already. After each failure, also after an
        interruption, the world is restored. Raises SimulationDiverged when all attempts fail or the state was not
        finite before, after writing a dump if one is requested (tacsim.physics.failure.dump).
        """
        before, survey = self._snapshot_before_motion(), self._survey()
        broken = None if survey is not None and survey.finite else diagnosis.describe_non_finite(before)
        if broken is not None:
            where = LaunchSpan("before the motion began")
            failure = SimulationDiverged(broken, where, NEW_WORLD, good=before, failed=before)
        else:
            for retry in range(MAX_RETRIES + 1):
                try:
                    stats = yield from attempt(2**retry)
                    self._require_unfolded(command)
                    return replace(stats, retries=retry)
                except SimulationDiverged as diverged:
                    failure, failure.refine = diverged, 2**retry
                    self.restore(before)
                    if not diverged.retry:
                        break
                except BaseException:
                    self.restore(before)
                    raise
        failure.possible = describe_possible_share(self._poses, command.targets, failure.poses)
        sizes = [self.scene.gel_of(name).size for name in self.sensors]
        failure.place = diagnosis.describe_worst_place(failure.quantity, failure.good, failure.failed, sizes)
        dump.write_dump(self.scene, self._poses, command, before, failure)
        raise failure

    def _require_unfolded(self, command: MoveCommand) -> None:
        """Raises SimulationDiverged if a gel element is inverted at a corner after a motion."""
        survey = self._survey()
        if survey is not None and survey.smallest_corner > 0.0:
            return
        state = self.arrays()
        for g, u in gel_arrays(state, "gel_displacement").items():
            thickness = self.scene.gel_of(self.sensors[g]).size[2] * 1e3
            if diagnosis.has_small_gradients(u, thickness):
                continue
            corners = diagnosis.corner_volumes(u, thickness)
            if not corners.min() > 0.0:
                words = f"a gel element is turned inside out (volume ratio {corners.min():.3g} at a corner)"
                end = LaunchSpan("at the end of the motion and its hold", {**self._poses, **command.targets})
                raise SimulationDiverged(words, end, SEPARATION_ADVICE, quantity="corner", failed=state)


def describe_possible_share(start: Mapping[str, Pose], targets: Mapping[str, Pose], failed: Mapping[str, Pose]) -> str:
    """Text with the distance that a failed motion reached, with its frames at `failed`, and the distance to request
    instead; empty where that is not known, or where no frame is translated."""
    shifts = {name: float(np.linalg.norm(end.position - start[name].position)) for name, end in targets.items()}
    name = max(shifts, key=shifts.__getitem__, default="")
    if name not in failed or shifts[name] == 0.0:
        return ""
    came = min(float(np.linalg.norm(failed[name].position - start[name].position)), shifts[name])
    return (
        f"'{name}' moved {came * 1e3:.3g} mm of the {shifts[name] * 1e3:.3g} mm of its path: request no more than "
        f"about {SAFE_PATH_SHARE * came * 1e3:.2g} mm from here"
    )
