"""Launches a kernel again without Taichi's checks of every argument, which take 0.5 ms for fifteen arrays.

The first launch is Taichi's own; it fixes the types and numbers of dimensions of the arguments.
"""

import inspect
from collections.abc import Sequence
from typing import Any, NamedTuple

from tacsim.compute.runtime import ti
from tacsim.compute.taichi_patches import are_enabled

Argument = Any  # number, C-contiguous array, or a tuple of arrays for an argument pack of the kernel
INTEGER, FLOAT = -1, -2


class _Compiled(NamedTuple):
    """What a launch needs to know of a kernel."""

    kernel: Any
    program: Any
    packs: list[tuple[int, Any]]  # index of the parameter, an argument pack of its type
    slots: list[tuple[int, int]]  # of each number and array: index; INTEGER, FLOAT or the axes inside its elements


_compiled: dict[Any, _Compiled] = {}  # by kernel


def launch_kernel(kernel: Any, *arguments: Argument) -> None:
    """Does what `kernel(*arguments)` does; each argument has the same type in every launch."""
    if not are_enabled() or kernel not in _compiled:
        kernel(*_with_packs(kernel, arguments))
        if are_enabled():
            _compiled[kernel] = _describe_kernel(kernel)
        return
    compiled, program, packs, slots = _compiled[kernel]
    context = compiled.make_launch_context()
    for index, pack in packs:
        context.set_arg_argpack((index,), pack)
    flat = [each for argument in arguments for each in (argument if isinstance(argument, tuple) else (argument,))]
    for argument, (index, role) in zip(flat, slots, strict=True):
        if role == INTEGER:
            context.set_arg_int((index,), argument)
        elif role == FLOAT:
            context.set_arg_float((index,), argument)
        else:
            shape = argument.shape[: argument.ndim - role]
            address: int = argument.__array_interface__["data"][0]
            context.set_arg_external_array_with_shape((index,), address, argument.nbytes, shape, 0)
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
    packs, slots = [], []
    behind = len(kernel._primal.arguments)  # where Taichi puts the next array of an argument pack
    for index, argument in enumerate(kernel._primal.arguments):
        kind = argument.annotation
        if isinstance(kind, ti.lang.argpack.ArgPackType):
            packs.append((index, program.create_argpack(kind.dtype)))
            slots += [(behind + n, _argument_role(member)) for n, member in enumerate(kind.members.values())]
            behind += len(kind.members)
        else:
            slots.append((index, _argument_role(kind)))
    return _Compiled(compiled, program, packs, slots)


def _argument_role(kind: Any) -> int:
    if hasattr(kind, "dtype"):  # an array
        return getattr(kind.dtype, "ndim", 0)
    return FLOAT if str(kind) in ("f32", "f64") else INTEGER
