"""Launches a kernel again without Taichi's checks of every argument, which take 0.5 ms for fifteen arrays.

The first launch is Taichi's own; it fixes the types and numbers of dimensions of the arguments.
"""

import inspect
import weakref
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from tacsim.compute.runtime import ti
from tacsim.compute.taichi_patches import are_enabled

Argument = Any  # number, C-contiguous array, or a tuple of arrays for an argument pack of the kernel
INTEGER, FLOAT = -1, -2


class _Compiled(NamedTuple):
    """What a launch needs to know of a kernel."""

    kernel: Any
    program: Any
    slots: list[tuple[int, int]]  # of each number and array: index; INTEGER, FLOAT or the axes inside its elements
    context: Any  # of all launches: it keeps the arguments of the last one
    given: list[Callable[[], Any]]  # weak references to these: no launch keeps an array alive


_compiled: dict[Any, _Compiled] = {}  # by kernel
_packs: list[Any] = []  # argument packs of their contexts


def launch_kernel(kernel: Any, *arguments: Argument) -> None:
    """Does what `kernel(*arguments)` does; each argument has the same type in every launch."""
    if not are_enabled() or kernel not in _compiled:
        kernel(*_with_packs(kernel, arguments))
        if are_enabled():
            _compiled[kernel] = _describe_kernel(kernel)
        return
    compiled, program, slots, context, given = _compiled[kernel]
    flat = [each for argument in arguments for each in (argument if isinstance(argument, tuple) else (argument,))]
    for number, (argument, (index, role)) in enumerate(zip(flat, slots, strict=True)):
        if role == INTEGER:
            context.set_arg_int((index,), argument)
        elif role == FLOAT:
            context.set_arg_float((index,), argument)
        elif argument is not given[number]():
            shape = argument.shape[: argument.ndim - role]
            address: int = argument.__array_interface__["data"][0]
            context.set_arg_external_array_with_shape((index,), address, argument.nbytes, shape, 0)
            given[number] = weakref.ref(argument)
    program.launch_kernel(program.compile_kernel(program.config(), program.get_device_caps(), compiled), context)


def _with_packs(kernel: Any, arguments: Sequence[Argument]) -> Sequence[Argument]:
    """The arguments with an argument pack in the place of each tuple."""
    if not any(isinstance(argument, tuple) for argument in arguments):
        return arguments
    kinds = [parameter.annotation for parameter in inspect.signature(kernel).parameters.values()]
    return [
        kind(*argument) if isinstance(argument, tuple) else argument
        for kind, argument in zip(kinds, arguments, strict=True)
    ]


def _describe_kernel(kernel: Any) -> _Compiled:
    (compiled,) = kernel._primal.compiled_kernels.values()
    program = kernel._primal.runtime.prog
    slots: list[tuple[int, int]] = []
    context = compiled.make_launch_context()
    behind = len(kernel._primal.arguments)  # where Taichi puts the next array of an argument pack
    for index, argument in enumerate(kernel._primal.arguments):
        kind = argument.annotation
        if isinstance(kind, ti.lang.argpack.ArgPackType):
            pack = program.create_argpack(kind.dtype)
            _packs.append(pack)
            context.set_arg_argpack((index,), pack)
            slots += [(behind + n, _argument_role(member)) for n, member in enumerate(kind.members.values())]
            behind += len(kind.members)
        else:
            slots.append((index, _argument_role(kind)))
    return _Compiled(compiled, program, slots, context, [_nothing] * len(slots))


def _nothing() -> None:
    """Stands for a reference to an array of an earlier launch."""


def _argument_role(kind: Any) -> int:
    if hasattr(kind, "dtype"):  # an array
        return getattr(kind.dtype, "ndim", 0)
    return FLOAT if str(kind) in ("f32", "f64") else INTEGER
