"""Several kernels in one call: the overhead of a call in Python is larger than a GPU's time for a small kernel."""

import inspect
from collections.abc import Mapping
from typing import Any

from tacsim.compute.runtime import ti


class Graph:
    """A sequence of kernels that is run a number of times."""

    def __init__(self, *kernels: Any) -> None:
        """kernels: each as a kernel, or as a pair with a map of its parameters to other names."""
        self._kernels = [kernel if isinstance(kernel, tuple) else (kernel, {}) for kernel in kernels]
        self._names: set[str] = set()  # of all parameters
        self._compiled: dict[int, Any] = {}  # by the number of rounds in a call

    def run(self, arguments: Mapping[str, Any], rounds: int = 1) -> None:
        """arguments: arrays of the device and integers, by the names of the kernels' parameters."""
        per_call = 20  # substeps of most launches
        for each, times in ((per_call, rounds // per_call), (1, rounds % per_call)):
            for _ in range(times):
                if each not in self._compiled:
                    self._compiled[each] = self._compile(each)
                self._compiled[each].run({name: arguments[name] for name in self._names})

    def _compile(self, rounds: int) -> Any:
        builder = ti.graph.GraphBuilder()
        one_round = builder.create_sequential()
        for kernel, names in self._kernels:
            parameters = inspect.signature(kernel).parameters.values()
            given = {names.get(each.name, each.name): each.annotation for each in parameters}
            self._names |= given.keys()
            one_round.dispatch(kernel, *(_argument(name, declared) for name, declared in given.items()))
        for _ in range(rounds):
            builder.append(one_round)
        return builder.compile()


def _argument(name: str, declared: Any) -> Any:
    if declared is ti.i32:
        return ti.graph.Arg(ti.graph.ArgKind.SCALAR, name, ti.i32)
    return ti.graph.Arg(ti.graph.ArgKind.NDARRAY, name, declared.dtype, declared.ndim)
