"""Taichi's front end, which turns the Python of a kernel into its own code anew in every process, in half the time.

Compiled kernels are kept on disk, but Taichi looks them up by what its front end makes of them. Most of that time went
to what nobody reads: each node of the syntax tree had its place drawn for an error message, with a line of carets; each
function had the file of its caller looked for among all modules, and its own text read and parsed again wherever it is
inlined.
Nothing here changes what is compiled: cached kernels are found as before (tests/tacsim/compute/test_front_end.py).
"""

import ast
import inspect
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from types import SimpleNamespace
from typing import Any


@contextmanager
def without_module_search() -> Iterator[None]:
    """For the import of Taichi: where each of its own functions is decorated, it has the caller's module looked for
    among all that are loaded, and finds the caller's file without it."""
    search = inspect.getmodule
    inspect.getmodule = lambda *_: None
    try:
        yield
    finally:
        inspect.getmodule = search


def quicken(kernel_impl: Any, context: Any, builder: Any) -> None:
    """Puts quicker functions in the place of Taichi's own; to be called before any of our kernels is defined.

    kernel_impl: module taichi.lang.kernel_impl; context, builder: classes ASTTransformerContext and Builder. What
    another version of Taichi does not have stays as it is: slower, not broken.
    """
    if hasattr(kernel_impl, "_inside_class"):
        kernel_impl._inside_class = _inside_class
    if hasattr(kernel_impl, "getsourcelines"):
        kernel_impl.getsourcelines = cache(kernel_impl.getsourcelines)
    if hasattr(kernel_impl, "getsourcefile"):
        kernel_impl.getsourcefile = cache(kernel_impl.getsourcefile)
    if hasattr(kernel_impl, "ast") and hasattr(kernel_impl, "textwrap"):
        kernel_impl.ast = SimpleNamespace(**{**vars(ast), "parse": _parse})
        kept = {"fill": cache(textwrap.fill), "dedent": cache(textwrap.dedent)}
        kernel_impl.textwrap = SimpleNamespace(**{**vars(textwrap), **kept})
    if hasattr(context, "get_pos_info"):
        context.get_pos_info = _place
    if "__call__" in vars(builder):
        builder.__call__ = _by_statement(builder.__call__)


def _by_statement(build: Callable[[Any, Any, Any], Any]) -> Callable[[Any, Any, Any], Any]:
    """Builder.__call__, which notes where a node stands, for statements alone: what is in one stands where it does."""

    def build_node(self: Any, context: Any, node: ast.AST) -> Any:
        method = None if isinstance(node, ast.stmt) else getattr(self, f"build_{type(node).__name__}", None)
        return build(self, context, node) if method is None else method(context, node)

    return build_node


def _parse(text: str) -> ast.Module:
    """The tree of a function, parsed once. Taichi reads it again and again, as it does the bodies of static loops; all
    that it takes out of it are a kernel's arguments, which are put back."""
    tree, arguments = _parsed(text)
    tree.body[0].args.args = list(arguments)  # type: ignore[attr-defined]
    return tree


@cache
def _parsed(text: str) -> tuple[ast.Module, tuple[ast.arg, ...]]:
    tree = ast.parse(text)
    return tree, tuple(tree.body[0].args.args)  # type: ignore[attr-defined]


def _place(context: Any, node: Any) -> str:
    """Where a node of a kernel's syntax tree stands, for error messages."""
    line, source = node.lineno + context.lineno_offset, context.src[node.lineno - 1]
    return f'File "{context.file}", line {line}, in {context.func.func.__name__}:\n{source}\n'


def _inside_class(level_of_class_stackframe: int) -> bool:
    """Whether a decorated function stands in a class. Level: of the frame in which the class is, from here."""
    return "__qualname__" in sys._getframe(level_of_class_stackframe - 1).f_locals
