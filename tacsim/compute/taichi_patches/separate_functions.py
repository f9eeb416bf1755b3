"""Functions that Taichi compiles separately from the kernel that calls them: its real functions, with two faults fixed.

Taichi's time to compile a kernel grows with the square of the kernel's size, and `ti.func` functions are part of it.
Compiled separately, the squeeze takes a third of the time, and LLVM inlines the functions again afterwards.
"""

import ctypes
from collections.abc import Callable, Iterator
from typing import Any

from tacsim.compute.runtime import ti
from tacsim.compute.taichi_patches import are_enabled


def compiled_separately(function: Callable[..., Any]) -> Any:
    """Decorator of a function of kernels. Without patches it is `ti.func`.

    The function returns nothing, and each parameter has a type or is a template. Arrays are passed one by one: Taichi
    takes no argument pack here.

    Fixed faults of Taichi 1.7.4: calls inside such a function were built into the kernel, which ended the process; and
    the cache key of a kernel depended on the addresses of its functions, so that it was compiled in nearly every
    process (see `_create_functions`).
    """
    if not are_enabled():
        return ti.func(function)
    lang = ti.lang
    taichi_function = ti.real_func(function)
    inner, build, read = taichi_function.func, lang.kernel_impl.transform_tree, lang.kernel_impl._get_tree_and_ctx
    get_runtime = lang.impl.get_runtime

    def do_compile(key: Any, args: Any, arg_features: Any) -> None:
        tree, context = read(inner, is_kernel=False, args=args, arg_features=arg_features, is_real_function=True)
        runtime = get_runtime()
        created = next(_functions)

        def body() -> None:
            kernel, caller = runtime.current_kernel, runtime.compiling_callable
            runtime.current_kernel, runtime.compiling_callable = _KernelProxy(kernel, created), created
            try:
                context.ast_builder = created.ast_builder()
                build(tree, context)
            finally:
                runtime.current_kernel, runtime.compiling_callable = kernel, caller

        inner.taichi_functions[key.instance_id] = created
        inner.compiled[key.instance_id] = body
        created.set_function_body(body)

    inner.do_compile = do_compile
    return taichi_function


class _KernelProxy:
    """Stands for the kernel while one of its functions is built: nested calls are built into the function."""

    def __init__(self, kernel: Any, function: Any) -> None:
        self._kernel = kernel
        self.ast_builder = function.ast_builder

    def __getattr__(self, name: str) -> Any:
        return getattr(self._kernel, name)


def _create_functions() -> Iterator[Any]:
    """Yields empty functions of Taichi in increasing order of their addresses.

    A kernel's cache key lists its functions by address; so it lists them in the order in which the kernel calls them,
    in every process. One kernel of a process may be an exception: the one whose functions are of two batches.
    """
    functions_per_batch = 64  # created at once; the squeeze has 11
    core = ti.lang.kernel_impl._ti_core
    program = ti.lang.impl.get_runtime().prog
    number = 0
    while True:
        keys = [core.FunctionKey("compiled_separately", number + n, 0) for n in range(functions_per_batch)]
        number += functions_per_batch
        yield from sorted(map(program.create_function, keys), key=_address)


def _address(bound: Any) -> int:
    """Address of the C++ object that a pybind11 object holds right behind its Python object head."""
    return ctypes.c_void_p.from_address(id(bound) + object.__basicsize__).value or 0


_functions = _create_functions()
