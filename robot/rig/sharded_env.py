"""Vector environments in several processes: each holds a part of the environments, whose worlds share launches.

Kernels of one process run on all cores, but its Python code runs on one. With a process for each core, both do. The
processes are on this machine, or on the nodes of a Ray cluster.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import Any, TypeAlias

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from robot.common.cluster import connected_to_cluster
from robot.rig.env_server import Infos, MakeEnvs
from robot.rig.env_workers import Worker, result_of, start_processes, start_ray_workers
from robot.rig.env_workers import WorkerFailed as WorkerFailed
from tacsim.compute.threads import thread_count
from tacsim.gym.vector import TacsimVectorEnv

Environments: TypeAlias = "TacsimVectorEnv | ShardedVectorEnv"


class ShardedVectorEnv(VectorEnv[Any, Any, Any]):
    """Environments in several processes: `robot.make_sharded_env`, or `gymnasium.make_vec(..., processes=4)`.

    Each environment gives the results that it would give alone, bit for bit, whatever the number of processes.

    Args:
        make: makes the environments of a process, from `num_envs` and `options`: `robot.make_vector_env`. Both are
            pickled.
        num_envs: number of environments.
        processes: at most one for each environment. None: one for each core, at most TACSIM_THREADS; with `cluster` one
            for each CPU of the cluster.
        cluster: address of a Ray cluster on whose nodes the processes run (`connected_to_cluster`); None: this machine.

    Raises the errors of `make`, WorkerFailed, ClusterError.
    """

    def __init__(
        self,
        make: MakeEnvs,
        options: Mapping[str, Any],
        num_envs: int,
        processes: int | None,
        cluster: str | None = None,
    ) -> None:
        if type(num_envs) is not int or num_envs < 1:
            raise ValueError(f"num_envs is a number from 1; got {num_envs!r}")
        if processes is not None and (type(processes) is not int or processes < 1):
            raise ValueError(f"processes is a number from 1, or None for one for each core; got {processes!r}")
        self._workers: list[Worker] = []
        self._reported: set[str] = set()  # texts of warnings, of all processes
        self._connection = ExitStack()
        try:
            if cluster is None:
                self._assign_environments(num_envs, processes or thread_count())
                start_processes(self._workers, len(self._sizes))
            else:
                ray = self._connection.enter_context(connected_to_cluster(cluster))
                self._assign_environments(num_envs, processes or int(ray.cluster_resources().get("CPU", 1)))
                start_ray_workers(self._workers, len(self._sizes), ray)
            made = self._request_parts("make", [(make, {**options, "num_envs": size}) for size in self._sizes])
        except BaseException:
            self._close_workers()
            raise
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space, self.metadata, self.render_mode = made[0]
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.autoreset_mode: AutoresetMode = self.metadata["autoreset_mode"]
        self._has_episode = np.zeros(num_envs, np.bool_)  # those that were ever reset

    @property
    def pids(self) -> tuple[int, ...]:
        """Process ids of the workers."""
        return tuple(worker.pid for worker in self._workers)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, Infos]:
        """See `TacsimVectorEnv.reset`; the mask leaves out whole processes, too."""
        seeds: Sequence[int | None]
        if seed is None or isinstance(seed, int):
            seeds = [None if seed is None else seed + index for index in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds for {self.num_envs} environments; give one each, or one number")
        each: list[Any] = [dict(options or {}) for _ in self._workers]
        mask = (options or {}).get("reset_mask")
        if mask is not None:
            self._require_mask(mask)
            for part, of in zip(each, self._split(mask), strict=True):
                part["reset_mask"] = of
        answers = self._request_parts("reset", list(zip(self._split(seeds), each, strict=True)))
        self._has_episode[:] = True
        return _join([seen for seen, _ in answers]), merge_infos([infos for _, infos in answers], self._sizes)

    def step(self, actions: Any) -> tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Infos]:
        """See `TacsimVectorEnv.step`. Nothing moves if one of the processes refuses an action."""
        if len(actions) != self.num_envs:
            raise ValueError(f"{len(actions)} actions for {self.num_envs} environments; give one each")
        parts = [(part,) for part in self._split(actions)]
        try:
            self._request_parts("begin_step", parts)
        except WorkerFailed:
            raise
        except Exception:
            self._request_parts("cancel_step", [()] * len(parts))
            raise
        seen, rewards, terminated, truncated, infos = zip(*self._request_parts("end_step", parts), strict=True)
        return (
            _join(seen), np.concatenate(rewards), np.concatenate(terminated), np.concatenate(truncated),
            merge_infos(infos, self._sizes),
        )  # fmt: skip

    def call(self, name: str, *arguments: Any, **options: Any) -> tuple[Any, ...]:
        """The results of a method of each environment, or of its attribute `name`."""
        return self.call_selected(range(self.num_envs), name, *arguments, **options)

    def call_selected(self, indices: Sequence[int], name: str, *arguments: Any, **options: Any) -> tuple[Any, ...]:
        """The same of some environments."""
        chosen = [
            [index - first for index in indices if first <= index < last]
            for first, last in zip(self._bounds, self._bounds[1:], strict=False)
        ]
        parts = self._request_parts("call", [(each, name, arguments, options) for each in chosen])
        found = {
            first + index: result
            for first, each, results in zip(self._bounds, chosen, parts, strict=False)
            for index, result in zip(each, results, strict=True)
        }
        return tuple(found[index] for index in indices)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """A list or tuple has a value for each environment; any other value is for all."""
        each = list(values) if isinstance(values, list | tuple) else [values] * self.num_envs
        if len(each) != self.num_envs:
            raise ValueError(f"{len(each)} values for {self.num_envs} environments; give one each, or one for all")
        self._request_parts("set_attr", [(name, part) for part in self._split(each)])

    def render(self) -> tuple[Any, ...]:
        return self.call("render")

    def close_extras(self, **_: Any) -> None:
        self._close_workers()

    def _assign_environments(self, num_envs: int, processes: int) -> None:
        """Gives each process a part of the environments."""
        count = min(processes, num_envs)
        self._bounds = [num_envs * number // count for number in range(count + 1)]
        self._sizes = [int(size) for size in np.diff(self._bounds)]

    def _require_mask(self, mask: Any) -> None:
        """Raises TypeError, ValueError, ResetNeeded as `TacsimVectorEnv.reset` does."""
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f"options['reset_mask'] is a NumPy array of bool, got {mask!r}")
        if mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"options['reset_mask'] has shape ({self.num_envs},) and selects at least one, got {mask}")
        new = np.flatnonzero(~(mask | self._has_episode)).tolist()
        if new:
            raise ResetNeeded(f"environment {', '.join(map(str, new))} has no episode yet: reset it, too")

    def _split(self, values: Any) -> list[Any]:
        """The values (num_envs, ...) of each process."""
        return [values[first:last] for first, last in zip(self._bounds, self._bounds[1:], strict=False)]

    def _request_parts(self, name: str, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Requests a method of all processes, which run it at the same time. When all have answered, raises the first
        error. An interruption ends the processes: they would answer the wrong request later."""
        failures: list[Exception] = []
        results: list[Any] = []
        try:
            for worker, given in zip(self._workers, arguments, strict=True):
                worker.send(name, *given)
            for worker in self._workers:
                try:
                    results.append(result_of(worker.receive(), self._reported))
                except WorkerFailed:
                    raise
                except Exception as failure:
                    first, last = self._bounds[len(results) + len(failures) :][:2]
                    failure.add_note(f"in the process of environments {first} to {last - 1}, which it counts from 0")
                    failures.append(failure)
        except BaseException:
            self._close_workers()
            raise
        if failures:
            raise failures[0]
        return results

    def _close_workers(self) -> None:
        for worker in self._workers:
            worker.disconnect()
        for worker in self._workers:
            worker.close()
        self._connection.close()


def merge_infos(parts: Sequence[Infos], sizes: Sequence[int]) -> Infos:
    """The infos of all environments from those of parts with `sizes` environments each. An entry that a part does not
    have is 0, False or None there, as in gymnasium."""
    merged: Infos = {}
    for key in dict.fromkeys(key for part in parts for key in part):
        values = [part.get(key) for part in parts]
        first = next(value for value in values if value is not None)
        if isinstance(first, dict):
            merged[key] = merge_infos([value or {} for value in values], sizes)
        else:
            merged[key] = np.concatenate(
                [
                    np.full((size, *first.shape[1:]), None if first.dtype == object else 0, first.dtype)
                    if value is None else value
                    for size, value in zip(sizes, values, strict=True)
                ]
            )  # fmt: skip
    return merged


def _join(parts: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """The observations of all environments."""
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
