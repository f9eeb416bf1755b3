"""Many worlds in one launch of kernels, each in another phase of its motion.

Threads of one world synchronise twice a substep; in a batch each environment has its own thread. Each environment ends
with the same bits as a single world.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

from tacsim.compute.runtime import launching
from tacsim.interface import Pose
from tacsim.models.scene import Scene
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.motion.controller import ForceReading, Launch, Motion
from tacsim.physics.motion.load import LoadNotReached
from tacsim.physics.move import MoveCommand, MoveStats
from tacsim.physics.worlds.base import NotCopyable
from tacsim.physics.worlds.hybrid import HybridWorld
from tacsim.physics.worlds.hybrid_state import HybridState
from tacsim.physics.worlds.press import PressWorld
from tacsim.physics.worlds.press_state import PressState

Result = MoveStats | SimulationDiverged | LoadNotReached | None


class Batch(NotCopyable):
    """Worlds of several scenes, all with bodies or all with indenters, whose gels share one lattice.

    All else may differ: materials, friction, body or indenter, number of particles, settling. Each of `worlds` can also
    be moved, read and restored like a single world, without effect on the others.
    """

    _instead = "Batch(scenes) and restore each world's snapshot()"

    def __init__(self, scenes: Sequence[Scene]) -> None:
        """Raises ValueError for scenes that cannot share a launch; the message names them."""
        _require_one_kind(scenes)
        self.state: HybridState | PressState
        self.worlds: tuple[HybridWorld | PressWorld, ...]
        if scenes[0].indenter is None:
            self.state = hybrid = HybridState(scenes)
            self.worlds = tuple(HybridWorld(scene, hybrid, index) for index, scene in enumerate(scenes))
        else:
            self.state = press = PressState(scenes)
            self.worlds = tuple(PressWorld(scene, press, index) for index, scene in enumerate(scenes))

    def replace(self, index: int, scene: Scene) -> None:
        """Makes one environment a new world of another scene; its old world must not be used after that.

        Raises ValueError for a scene that cannot share a launch with the others, or has an indenter.
        """
        if not isinstance(self.state, HybridState) or scene.indenter is not None:
            raise ValueError("only worlds with a body can be replaced in a batch; make a new Batch for indenters")
        _require_one_kind([scene])
        self.state.place(index, scene)
        world = HybridWorld(scene, self.state, index)
        self.worlds = (*self.worlds[:index], world, *self.worlds[index + 1 :])

    def move(
        self,
        targets: Sequence[Mapping[str, Pose] | None],
        loads: Sequence[Mapping[str, float] | None] | None = None,
        duration: float | None = None,
        *,
        flow: bool = False,
    ) -> list[Result]:
        """`World.move` of all environments together; None in `targets`: this environment rests and does not change.
        `duration` and `flow` apply to all motions.

        Returns the result of each. The error of a motion that fails is returned, not raised, and its world is restored.
        Retries of one environment do not delay the others.

        Raises ValueError for a wrong number of targets or loads, or a load of an environment that rests; the errors of
        `World.move` for a command that is not valid, before anything moves. On an interruption, worlds that are still
        moving are restored.
        """
        if loads is None:
            loads = [None] * len(self.worlds)
        for what, given in (("targets", targets), ("loads", loads)):
            if len(given) != len(self.worlds):
                raise ValueError(f"{len(given)} {what} for {len(self.worlds)} environments; give one each, or None")
        motions: dict[int, Motion] = {}
        for index, (world, target, load) in enumerate(zip(self.worlds, targets, loads, strict=True)):
            if target is not None:
                motions[index] = world.motion(MoveCommand(target, load or {}, duration, flow))
            elif load:
                raise ValueError(f"environment {index} rests, so it cannot hold a load; give it targets, {{}} to stay")
        return self._run(motions)

    def _run(self, motions: Mapping[int, Motion]) -> list[Result]:
        ends: list[Result] = [None] * len(self.worlds)
        wanted: dict[int, Launch] = {}

        def resume(index: int, step: Callable[[], Launch]) -> None:
            """Runs one motion to its next launch, or to its end."""
            wanted.pop(index, None)
            try:
                wanted[index] = step()
            except StopIteration as end:
                ends[index] = end.value
            except (SimulationDiverged, LoadNotReached) as failure:
                ends[index] = failure

        try:
            for index, motion in motions.items():
                try:
                    resume(index, motion.__next__)
                except Exception as error:
                    error.add_note(f"in the motion of environment {index}")
                    raise
            while wanted:
                for index, result in self._advance(wanted).items():
                    motion = motions[index]
                    if isinstance(result, SimulationDiverged):
                        resume(index, partial(motion.throw, result))
                    else:
                        resume(index, partial(motion.send, result))
        finally:
            for motion in motions.values():
                motion.close()
        return ends

    @launching()
    def _advance(self, wanted: Mapping[int, Launch]) -> dict[int, list[ForceReading] | SimulationDiverged]:
        """One launch for all environments with a request; an environment that fails has no effect on the others."""
        results: dict[int, list[ForceReading] | SimulationDiverged] = {}
        ready = {}
        for index, launch in wanted.items():
            try:
                ready[index] = self.worlds[index].prepare(launch)
            except SimulationDiverged as failure:
                results[index] = failure
        if ready:
            self.state.advance({index: prepared.drive for index, prepared in ready.items()})
        for index, prepared in ready.items():
            try:
                results[index] = self.worlds[index].outcome(prepared)
            except SimulationDiverged as failure:
                results[index] = failure
        return results


def _require_one_kind(scenes: Sequence[Scene]) -> None:
    if not scenes:
        raise ValueError("a batch needs at least one scene")
    seeds = [index for index, scene in enumerate(scenes) if scene.physics == "seed"]
    if seeds:
        raise ValueError(
            f"{_list_environments(seeds)}: physics 'seed' does not run in a batch; use physics 'hybrid', or single "
            "worlds"
        )
    pressed = [index for index, scene in enumerate(scenes) if scene.indenter is not None]
    if pressed and len(pressed) < len(scenes):
        others = [index for index in range(len(scenes)) if index not in pressed]
        raise ValueError(
            f"a batch holds bodies or indenters, not both: {_list_environments(pressed)} with an indenter, "
            f"{_list_environments(others)} with a body; make a batch of each"
        )


def _list_environments(indices: Sequence[int]) -> str:
    return f"environment{'s' if len(indices) > 1 else ''} {', '.join(map(str, indices))}"
