"""Vector environments in several processes: each holds a part of the environments, whose worlds share launches.

Kernels of one process run on all cores, but its Python code runs on one. With a process for each core, both do.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import socket
import sys
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection
from typing import Any, TypeAlias

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from robot.common.process import PARENT, Child, end_with_parent
from robot.errors import DeviceNotConnectedError
from tacsim.compute.threads import thread_count
from tacsim.gym.vector import TacsimVectorEnv

Infos = dict[str, Any]
MakeEnvs = Callable[..., TacsimVectorEnv]
Environments: TypeAlias = "TacsimVectorEnv | ShardedVectorEnv"


class WorkerFailed(DeviceNotConnectedError):
    """A process of the environments has ended, or failed in a way that cannot be sent."""


class _Worker:
    """One process, and the connection to it."""

    def __init__(self, number: int, threads: int, reported: set[str]) -> None:
        """threads: of its kernels. reported: texts that this program's log has, of all processes."""
        self._reported = reported
        ours, theirs = socket.socketpair()
        with ours, theirs:
            self._child = Child(
                __name__,
                [str(theirs.fileno())],
                name=f"environment process {number}",
                error=WorkerFailed,
                advice="make the environments again; is there enough memory for all processes?",
                environment={"TACSIM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
                descriptors=[theirs.fileno()],
            )
            self._connection = Connection(ours.detach())

    @property
    def pid(self) -> int:
        return self._child.pid

    def send(self, name: str, *arguments: Any) -> None:
        """Requests a method of its vector environment."""
        try:
            self._connection.send((name, arguments))
        except OSError as failure:
            raise self._ended() from failure

    def receive(self) -> Any:
        """The result of the last request. Raises the method's error, or WorkerFailed."""
        try:
            error, result, records = self._connection.recv()
        except (EOFError, OSError) as failure:
            raise self._ended() from failure
        for record in records:
            if record.getMessage() not in self._reported:  # each process warns once
                self._reported.add(record.getMessage())
                logging.getLogger(record.name).handle(record)
        if error is not None:
            raise error
        return result

    def disconnect(self) -> None:
        """Asks the process to end."""
        self._connection.close()

    def close(self) -> None:
        write_timeout = 20.0  # for compiled kernels, which Taichi writes at its end [s]
        self.disconnect()
        self._child.close(write_timeout)

    def _ended(self) -> WorkerFailed:
        """The error of a process that does not answer any more."""
        try:
            self._child.wait(exit_timeout := 5.0)
            self._child.check()
        except WorkerFailed as failure:
            return failure
        return WorkerFailed(f"environment process {self.pid} ends its answers, but not itself within {exit_timeout} s")


class ShardedVectorEnv(VectorEnv[Any, Any, Any]):
    """Environments in several processes: `robot.make_sharded_env`, or `gymnasium.make_vec(..., processes=4)`.

    Each environment gives the results that it would give alone, bit for bit, whatever the number of processes.

    Args:
        make: makes the environments of a process, from `num_envs` and `options`: `robot.make_vector_env`. Both are
            pickled.
        num_envs: number of environments.
        processes: at most one for each environment. None: one for each core, at most TACSIM_THREADS.

    Raises the errors of `make`, WorkerFailed.
    """

    def __init__(self, make: MakeEnvs, options: Mapping[str, Any], num_envs: int, processes: int | None) -> None:
        if type(num_envs) is not int or num_envs < 1:
            raise ValueError(f"num_envs is a number from 1; got {num_envs!r}")
        if processes is None:
            processes = thread_count()
        elif type(processes) is not int or processes < 1:
            raise ValueError(f"processes is a number from 1, or None for one for each core; got {processes!r}")
        count = min(processes, num_envs)
        self._bounds = [num_envs * number // count for number in range(count + 1)]
        self._sizes = [int(size) for size in np.diff(self._bounds)]
        self._workers: list[_Worker] = []
        reported: set[str] = set()
        try:
            for number in range(count):
                self._workers.append(_Worker(number, max(1, thread_count() // count), reported))
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
                    results.append(worker.receive())
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


class _Log(logging.Handler):
    """Keeps the warnings of a worker for its parent."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._records: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        record.msg, record.args, record.exc_info = record.getMessage(), None, None  # what can be pickled
        self._records.append(record)

    def take(self) -> list[logging.LogRecord]:
        records, self._records = self._records, []
        return records


class _Methods:
    """The methods of a worker."""

    def __init__(self) -> None:
        self._envs: TacsimVectorEnv | None = None
        self._seen: Any = None  # the last observations

    def make(self, make: MakeEnvs, options: Mapping[str, Any]) -> tuple[Any, Any, dict[str, Any], str | None]:
        """Makes the environments; returns what all processes have in common."""
        self._envs = make(**options)
        return (
            self._envs.single_observation_space,
            self._envs.single_action_space,
            self._envs.metadata,
            self._envs.render_mode,
        )

    def reset(self, seeds: list[int | None], options: dict[str, Any]) -> tuple[Any, Infos]:
        mask = options.get("reset_mask")
        if mask is not None and not mask.any():
            return self._seen, {}
        self._seen, infos = self.envs.reset(seed=seeds, options=options)
        return self._seen, infos

    def end_step(self, actions: Any) -> tuple[Any, ...]:
        self._seen, *others = self.envs.end_step(actions)
        return self._seen, *others

    def call(
        self, indices: list[int], name: str, arguments: tuple[Any, ...], options: dict[str, Any]
    ) -> tuple[Any, ...]:
        return self.envs.call_selected(indices, name, *arguments, **options)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.envs, name)

    @property
    def envs(self) -> TacsimVectorEnv:
        assert self._envs is not None
        return self._envs


def _serve(connection: Connection) -> None:
    """Answers requests (method, arguments) by (error, result, records of the log) until the connection ends."""
    methods, log = _Methods(), _Log()
    logging.getLogger().addHandler(log)
    logging.captureWarnings(True)
    while True:
        try:
            name, arguments = connection.recv()
        except EOFError:
            return
        error = result = None
        try:
            result = getattr(methods, name)(*arguments)
        except Exception as failure:
            error = _sendable(failure)
        connection.send((error, result, log.take()))


def _sendable(failure: Exception) -> Exception:
    """The error, or its text where it cannot be pickled."""
    try:
        pickle.loads(pickle.dumps(failure))  # noqa: S301  # our own bytes
    except Exception:
        return RuntimeError(f"{type(failure).__name__}: {failure}")
    return failure


if __name__ == "__main__":
    os.dup2(2, 1)  # the parent does not read standard output
    end_with_parent(int(os.environ[PARENT]))
    with contextlib.closing(Connection(int(sys.argv[1]))) as opened:
        _serve(opened)
