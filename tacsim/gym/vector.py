"""Many environments whose worlds move together, in the same launches of kernels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import iterate

from tacsim.gym.env import STEP_ERRORS, TacsimEnv, copy_reset_options
from tacsim.models.scene import Scene
from tacsim.physics.move import MoveCommand
from tacsim.physics.world import World
from tacsim.physics.worlds.batch import Batch

if TYPE_CHECKING:
    from tacsim.sim.cell.motion import CellPeriod


class MemberBatch(Protocol):
    """The worlds of all members."""

    def move(self, commands: Sequence[Any]) -> list[Any]:
        """Carries out what the clocks' `begin` returned, None: nothing. Returns what their `finish` takes, or the error
        that ends the member's episode."""
        ...


class SharedBatch:
    """A batch that is made when the first of its worlds is needed."""

    def __init__(self, scenes: Sequence[Scene]) -> None:
        self._scenes = tuple(scenes)
        self._batch: Batch | None = None

    def world(self, index: int, scene: Scene) -> World:
        """Number `index` as a world of `scene`, as newly made."""
        if self._batch is None:
            self._batch = Batch(self._scenes)
            self._made = [False] * len(self._scenes)
        if self._made[index] or scene != self._scenes[index]:
            self._batch.replace(index, scene)
        self._made[index] = True
        return self._batch.worlds[index]

    def move(self, commands: Sequence[MoveCommand | None]) -> list[Any]:
        """`Batch.move`; the rigs of one file ask for motions of one kind."""
        requested = [command for command in commands if command is not None]
        if not requested or self._batch is None:
            return [None] * len(commands)
        targets = [None if command is None else command.targets for command in commands]
        return list(self._batch.move(targets, duration=requested[0].duration, flow=requested[0].flow))


class CellBatch:
    """Cells of MuJoCo of one rig file. Their gels share launches."""

    def move(self, commands: Sequence[CellPeriod | None]) -> list[Any]:
        """See MemberBatch."""
        requested = [command for command in commands if command is not None]
        if not requested:
            return [None] * len(commands)
        ends = iter(requested[0].motion.advance_together(requested))
        return [None if command is None else next(ends) for command in commands]


class MemberClock(Protocol):
    """The clock of a rig whose world moves together with others."""

    def begin(self) -> Any: ...
    def finish(self, outcome: Any) -> None: ...


@dataclass(frozen=True, slots=True)
class Member:
    """One environment, and the clock of its rig."""

    env: TacsimEnv
    clock: MemberClock


class TacsimVectorEnv(SyncVectorEnv):
    """Environments that share launches: `gymnasium.make_vec("tacsim.gym:tacsim/Squeeze-v0", n)`.

    It is gymnasium's SyncVectorEnv, and each environment gives the results that it would give alone, bit for bit. What
    ends one episode (a limit, a simulation that diverges) leaves the others alone.

    Args:
        batch: of the members' worlds, in their order.
        autoreset_mode: what happens to an environment whose episode has ended: it is reset in the next step
            (NEXT_STEP), in the same (SAME_STEP), or by the user (DISABLED), with options={"reset_mask": ...}.
    """

    def __init__(
        self,
        members: Sequence[Member],
        batch: MemberBatch,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    ) -> None:
        self._members, self._batch = tuple(members), batch
        self._stepping: Mapping[int, Member] = {}  # those that the present step moves
        super().__init__([partial(getattr, member, "env") for member in members], autoreset_mode=autoreset_mode)
        self.metadata["reset_mask"] = True  # reset(options={"reset_mask": ...}) is understood

    @property
    def members(self) -> tuple[TacsimEnv, ...]:
        """The environments, as what they are."""
        return tuple(member.env for member in self._members)

    def call_selected(self, indices: Sequence[int], name: str, *arguments: Any, **options: Any) -> tuple[Any, ...]:
        """`call` of some environments: the results of a method, or its attribute `name`."""
        found = (getattr(self._members[index].env, name) for index in indices)
        return tuple(each(*arguments, **options) if callable(each) else each for each in found)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """As SyncVectorEnv.reset; options: `reset_mask`, and those of `TacsimEnv.reset`. Raises ResetNeeded for a mask
        that leaves out an environment that has never been reset."""
        options = copy_reset_options(options)  # a copy: gymnasium takes the mask out of what it is given
        mask = options.get("reset_mask")
        if isinstance(mask, np.ndarray) and mask.shape == (self.num_envs,):
            new = [i for i, member in enumerate(self._members) if member.env.phase == "new" and not mask[i]]
            if new:
                raise ResetNeeded(f"environment {_list_indices(new)} has no episode yet: reset it, too")
        return super().reset(seed=seed, options=options)

    def step(self, actions: Any) -> tuple[Any, ...]:
        """One control period of all. Raises what `TacsimEnv.step` raises for one of the actions, before anything
        moves. Any other error (a picture that cannot be made, a reset that cannot begin) comes when some have moved and
        some may have been reset: reset all of them then."""
        self.begin_step(actions)
        return self.end_step(actions)

    def begin_step(self, actions: Any) -> None:
        """The first part of a step: commands the arms of all environments but those that are to be reset. Next is
        `end_step`, or `cancel_step`. Raises what `TacsimEnv.step` raises for an action."""
        each = list(iterate(self.action_space, actions))
        if len(each) != self.num_envs:
            raise ValueError(f"{len(each)} actions for {self.num_envs} environments; give one each")
        resets = self.autoreset_mode == AutoresetMode.NEXT_STEP
        phases = [member.env.phase for member in self._members]
        over = [i for i, phase in enumerate(phases) if phase == "new" or (phase == "over" and not resets)]
        if over:
            raise ResetNeeded(
                f"no episode runs in environment {_list_indices(over)}: call reset(), or with a reset_mask"
            )
        self._stepping = {i: m for i, m in enumerate(self._members) if phases[i] == "running"}
        with self._cancel_on_failure():
            for index, member in self._stepping.items():
                member.env.begin_step(each[index])

    def cancel_step(self) -> None:
        """Forgets what `begin_step` has commanded."""
        for member in self._stepping.values():
            member.env.rig.stop()
        self._stepping = {}

    def end_step(self, actions: Any) -> tuple[Any, ...]:
        """The rest of a step: moves, observes, judges and resets. Raises as `step`."""
        self._advance()
        return super().step(actions)  # takes what is done now, resets what is to be reset, and puts it together

    def _advance(self) -> None:
        """The step of all environments but those that are to be reset; their `step` then returns its result."""
        commands: list[Any] = [None] * self.num_envs
        with self._cancel_on_failure():
            for index, member in self._stepping.items():
                if member.env.commanded:
                    commands[index] = member.clock.begin()
            ends = self._batch.move(commands)
        for index, member in self._stepping.items():
            if isinstance(ends[index], STEP_ERRORS):
                member.env.fail(ends[index])
            elif member.env.commanded:
                member.clock.finish(ends[index])
        for (
            member
        ) in self._stepping.values():  # on threads they would wait for the interpreter more than they would win
            member.env.end_step()

    @contextmanager
    def _cancel_on_failure(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self.cancel_step()
            raise


def _list_indices(indices: Sequence[int]) -> str:
    return ", ".join(map(str, indices))
