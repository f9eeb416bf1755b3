"""The workers of `ShardedVectorEnv`, for this program: processes of this machine, or actors of a Ray cluster."""

from __future__ import annotations

import logging
import socket
from multiprocessing.connection import Connection
from typing import Any, Protocol

from robot.common.cluster import ClusterError, describe_ray_error, tacsim_version
from robot.common.process import Child
from robot.errors import DeviceNotConnectedError
from robot.rig.env_server import Answer, EnvironmentServer
from tacsim.compute.threads import thread_count

ADVICE = "make the environments again; is there enough memory for all processes?"


class WorkerFailed(DeviceNotConnectedError):
    """A process of the environments has ended, or failed in a way that cannot be sent."""


class Worker(Protocol):
    """A process with a vector environment. It answers requests in their order."""

    @property
    def pid(self) -> int:
        """Process id on its machine."""
        ...

    def send(self, name: str, *arguments: Any) -> None:
        """Requests a method of its vector environment. Raises WorkerFailed."""
        ...

    def receive(self) -> Answer:
        """The answer to the last request. Raises WorkerFailed."""
        ...

    def disconnect(self) -> None:
        """Asks the process to end."""
        ...

    def close(self) -> None:
        """Waits for its end."""
        ...


def result_of(answer: Answer, reported: set[str]) -> Any:
    """The result in an answer; logs its warnings, except those in `reported`. Raises the error in it."""
    error, result, records = answer
    for record in records:
        if record.getMessage() not in reported:  # each process warns once
            reported.add(record.getMessage())
            logging.getLogger(record.name).handle(record)
    if error is not None:
        raise error
    return result


class ProcessWorker:
    """A process of this machine, and the connection to it. threads: of its kernels."""

    def __init__(self, number: int, threads: int) -> None:
        ours, theirs = socket.socketpair()
        with ours, theirs:
            self._child = Child(
                "robot.rig.env_server",
                [str(theirs.fileno())],
                name=f"environment process {number}",
                error=WorkerFailed,
                advice=ADVICE,
                environment={"TACSIM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
                descriptors=[theirs.fileno()],
            )
            self._connection = Connection(ours.detach())

    @property
    def pid(self) -> int:
        return self._child.pid

    def send(self, name: str, *arguments: Any) -> None:
        try:
            self._connection.send((name, arguments))
        except OSError as failure:
            raise self._ended() from failure

    def receive(self) -> Answer:
        try:
            answer: Answer = self._connection.recv()
        except (EOFError, OSError) as failure:
            raise self._ended() from failure
        return answer

    def disconnect(self) -> None:
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


class RayWorker:
    """An actor of a Ray cluster, which takes one CPU. It ends with this program. ray: the connected module."""

    def __init__(self, number: int, ray: Any) -> None:
        self._ray, self._name = ray, f"environment worker {number} on the Ray cluster"
        self._actor: Any = ray.remote(num_cpus=1)(_RayServer).remote()
        self._asked = self._actor.describe.remote()
        self.pid = 0

    def wait_for_start(self) -> None:
        """Waits until the cluster has started the process. Raises ClusterError, WorkerFailed."""
        start_timeout = 120.0  # for a busy cluster [s]
        try:
            self.pid, node, version = self._get(start_timeout)
        except self._ray.exceptions.GetTimeoutError:
            free = self._ray.available_resources().get("CPU", 0)
            raise ClusterError(
                f"{self._name} did not start within {start_timeout:g} s; {free:g} CPUs of the cluster are free: wait "
                "for other programs, or use fewer workers"
            ) from None
        self._name += f" (process {self.pid}, node {node})"
        if version != (here := tacsim_version()):
            raise ClusterError(f"a node has tacsim {version or 'unknown'}, this program runs {here or 'unknown'}")

    def send(self, name: str, *arguments: Any) -> None:
        if self._actor is None:
            raise WorkerFailed(f"{self._name} is closed; {ADVICE}")
        self._asked = self._actor.answer.remote(name, arguments)

    def receive(self) -> Answer:
        answer: Answer = self._get()
        return answer

    def disconnect(self) -> None:
        if self._actor is not None:
            self._ray.kill(self._actor)
            self._actor = None

    def close(self) -> None:
        self.disconnect()

    def _get(self, timeout: float | None = None) -> Any:
        try:
            return self._ray.get(self._asked, timeout=timeout)
        except self._ray.exceptions.GetTimeoutError:
            raise
        except self._ray.exceptions.RayError as failure:
            raise WorkerFailed(f"{self._name} has ended: {describe_ray_error(failure)}; {ADVICE}") from None


def start_processes(workers: list[Worker], count: int) -> None:
    """Adds processes of this machine to `workers`, which share its threads."""
    for number in range(count):
        workers.append(ProcessWorker(number, max(1, thread_count() // count)))


def start_ray_workers(workers: list[Worker], count: int, ray: Any) -> None:
    """Adds workers on a cluster to `workers`. ray: the connected module. Raises ClusterError, WorkerFailed."""
    cpus = int(ray.cluster_resources().get("CPU", 0))
    if count > cpus:
        raise ClusterError(f"{count} workers need as many CPUs, and the Ray cluster has {cpus}: use fewer workers")
    started = [RayWorker(number, ray) for number in range(count)]
    workers += started
    for worker in started:
        worker.wait_for_start()


class _RayServer:
    """What runs in the process of a node."""

    def __init__(self) -> None:
        import os

        os.environ["TACSIM_THREADS"] = "1"  # it takes one CPU
        self._server = EnvironmentServer()

    def describe(self) -> tuple[int, str, str]:
        """Process, node, version of tacsim."""
        import os

        import ray

        return os.getpid(), ray.get_runtime_context().get_node_id()[:8], tacsim_version()

    def answer(self, name: str, arguments: tuple[Any, ...]) -> Answer:
        return self._server.answer(name, arguments)
