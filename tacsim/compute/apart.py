"""Functions that Taichi compiles apart from the kernel that calls them: its real functions, mended.

Taichi compiles a kernel for as long as it is large, squared, and its functions are part of it: the squeeze took 20
seconds. Apart from each other its pieces take 6, and LLVM, which compiles them last, puts small ones together again, to
code a little quicker than before (docs/decisions/0017).
"""

import ctypes
from collections.abc import Callable, Iterator
from typing import Any

from tacsim.compute.runtime import ti

FUNCTIONS = 64  # made at once; the squeeze has 11


def apart(function: Callable[..., Any]) -> Any:
    """Decorates a function of kernels that returns nothing, and all of whose arguments have types or are templates.

    Its arrays are handed over one by one. Two faults of Taichi 1.7 are mended. What such a function calls was built
    into the kernel in its place, which ended the process. And a kernel with several was hardly ever found among those
    kept on disk, since Taichi writes its functions down in the order of their addresses (see `_make_functions`). A
    Taichi that does not have these private parts compiles the function as part of its kernel.
    """
    try:
        lang = ti.lang
        taichi_function = ti.real_func(function)
        inner, build, read = taichi_function.func, lang.kernel_impl.transform_tree, lang.kernel_impl._get_tree_and_ctx
        get_runtime = lang.impl.get_runtime
    except AttributeError:
        return ti.func(function)

    def do_compile(key: Any, args: Any, arg_features: Any) -> None:
        tree, context = read(inner, is_kernel=False, args=args, arg_features=arg_features, is_real_function=True)
        runtime = get_runtime()
        made = next(_functions)

        def body() -> None:
            kernel, around = runtime.current_kernel, runtime.compiling_callable
            runtime.current_kernel, runtime.compiling_callable = _Within(kernel, made), made
            try:
                context.ast_builder = made.ast_builder()
                build(tree, context)
            finally:
                runtime.current_kernel, runtime.compiling_callable = kernel, around

        inner.taichi_functions[key.instance_id] = made
        inner.compiled[key.instance_id] = body
        made.set_function_body(body)

    inner.do_compile = do_compile
    return taichi_function


class _Within:
    """The kernel that is being built, while a function of it is: what that calls is built into the function."""

    def __init__(self, kernel: Any, function: Any) -> None:
        self._kernel = kernel
        self.ast_builder = function.ast_builder

    def __getattr__(self, name: str) -> Any:
        return getattr(self._kernel, name)


def _make_functions() -> Iterator[Any]:
    """Empty functions of Taichi's, each at a higher address than the one before: a kernel's key lists them in the order
    in which the kernel needs them. (But for the one kernel of a process, if any, whose functions are of two lots.)"""
    core = ti.lang.kernel_impl._ti_core
    program = ti.lang.impl.get_runtime().prog
    number = 0
    while True:
        made = [program.create_function(core.FunctionKey("apart", number + n, 0)) for n in range(FUNCTIONS)]
        number += FUNCTIONS
        yield from sorted(made, key=_address)


def _address(bound: Any) -> int:
    """Of the C++ object behind one of pybind11's, which comes after the head that all objects of Python have."""
    return ctypes.c_void_p.from_address(id(bound) + object.__basicsize__).value or 0


_functions = _make_functions()
