"""The environments of one process of `ShardedVectorEnv`: answers its requests, over a connection or as a Ray actor."""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import sys
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from typing import Any

from robot.common.process import PARENT, end_with_parent
from tacsim.gym.vector import TacsimVectorEnv

Infos = dict[str, Any]
MakeEnvs = Callable[..., TacsimVectorEnv]
Answer = tuple[Exception | None, Any, list[logging.LogRecord]]  # error, result, new records of the log


class EnvironmentServer:
    """Makes the environments at the first request, and runs their methods."""

    def __init__(self) -> None:
        self._methods, self._log = _Methods(), _Log()
        logging.getLogger().addHandler(self._log)
        logging.captureWarnings(True)

    def answer(self, name: str, arguments: tuple[Any, ...]) -> Answer:
        """Runs a method; its error is a part of the answer."""
        error = result = None
        try:
            result = getattr(self._methods, name)(*arguments)
        except Exception as failure:
            error = _sendable(failure)
        return error, result, self._log.take()


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


def _sendable(failure: Exception) -> Exception:
    """The error, or its text where it cannot be pickled."""
    try:
        pickle.loads(pickle.dumps(failure))  # noqa: S301  # our own bytes
    except Exception:
        return RuntimeError(f"{type(failure).__name__}: {failure}")
    return failure


def _serve(connection: Connection) -> None:
    """Answers requests (method, arguments) until the connection ends."""
    server = EnvironmentServer()
    while True:
        try:
            name, arguments = connection.recv()
        except EOFError:
            return
        connection.send(server.answer(name, arguments))


if __name__ == "__main__":
    os.dup2(2, 1)  # the parent does not read standard output
    end_with_parent(int(os.environ[PARENT]))
    with contextlib.closing(Connection(int(sys.argv[1]))) as opened:
        _serve(opened)
