"""Taichi's front end, which turns the Python of a kernel into its own code anew in every process, in a third of the
time.

Compiled kernels are kept on disk, but Taichi looks them up by what its front end makes of them. Most of that time went
to what nobody reads: each node of the syntax tree had its place drawn for an error message, with a line of carets; each
function had the file of its caller looked for among all modules, and its own text read and parsed again wherever it is
inlined. Most of the rest goes to small things done ten thousand times: tables built for each sum, tests of each
constant, each index and each call for what they hardly ever are.
Nothing here changes what is compiled: cached kernels are found as before (tests/tacsim/compute/test_front_end.py).
"""

import ast
import gc
import inspect
import linecache
import operator
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib import import_module
from types import ModuleType, SimpleNamespace
from typing import Any

WHOLE = 2**31  # integers below are numbers of 32 bits and 64

# All but the product of matrices, which is Taichi's own
OPERATORS: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: operator.pow,
    ast.LShift: operator.lshift,
    ast.RShift: operator.rshift,
    ast.BitOr: operator.or_,
    ast.BitXor: operator.xor,
    ast.BitAnd: operator.and_,
}


@contextmanager
def light_import() -> Iterator[None]:
    """For the import of Taichi.

    Where each of its own functions is decorated, it has the caller's module looked for among all that are loaded, and
    finds the caller's file without it. And a fifth of the time is for modules that it hardly ever uses: to ask a server
    for news, and to find what is typed at a prompt.
    """
    search = inspect.getmodule
    inspect.getmodule = lambda *_: None
    later = [_Later(name) for name in ("urllib.request", "dill") if name not in sys.modules]
    sys.modules.update({module.__name__: module for module in later})
    try:
        with _no_collection():
            yield
    finally:
        inspect.getmodule = search
        for module in later:
            module._leave()


class _Later(ModuleType):
    """What stands for a module until something is asked of it; only those see it who imported it meanwhile."""

    def __getattr__(self, name: str) -> Any:
        self._leave()
        return getattr(import_module(self.__name__), name)

    def _leave(self) -> None:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]


@contextmanager
def _no_collection() -> Iterator[None]:
    """While much is made that stays: to look through it again and again takes a tenth of the time."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


def quicken(lang: Any) -> None:
    """Puts quicker functions in the place of Taichi's own; to be called before any of our kernels is defined.

    lang: package taichi.lang. What another version of Taichi does not have stays as it is: slower, not broken.
    """
    for part in (_quicken_reading, _quicken_kernels, _quicken_values, _quicken_names, _quicken_nodes):
        with suppress(AttributeError):
            part(lang)


def _replace(owner: Any, **makers: Callable[[Any], Any]) -> None:
    """Puts in the place of each function what is made of it. Raises AttributeError, before any is replaced, if one is
    not there."""
    quicker = {name: make(getattr(owner, name)) for name, make in makers.items()}
    for name, function in quicker.items():
        setattr(owner, name, function)


def _quicken_reading(lang: Any) -> None:
    """How a function's text is read: once."""
    _replace(
        lang.kernel_impl,
        _inside_class=lambda _: _inside_class,
        getsourcefile=cache,
        getsourcelines=lambda read: cache(lambda function: function_source(function) or read(function)),
        ast=lambda _: SimpleNamespace(**{**vars(ast), "parse": _parse}),
        textwrap=lambda _: SimpleNamespace(**{**vars(textwrap), "fill": _filled, "dedent": cache(textwrap.dedent)}),
    )


def _quicken_kernels(lang: Any) -> None:
    """How a kernel's tree is built: without a search for garbage."""
    _replace(lang.kernel_impl.Kernel, materialize=_no_collection())


def _quicken_values(lang: Any) -> None:
    """How the values of a kernel are wrapped: most are made by Taichi's core, or numbers."""
    expr, impl = lang.expr, lang.impl
    core, wrapped = expr._ti_core, expr.Expr
    integer, real, debug_info = core.make_const_expr_int, core.make_const_expr_fp, core.DebugInfo
    inner, get_runtime = core.Expr, impl.get_runtime

    def constant(value: Any) -> Any:
        """None if it is no plain number."""
        if type(value) is int and -WHOLE <= value < WHOLE:
            return integer(get_runtime().default_ip, value)
        return real(get_runtime().default_fp, value) if type(value) is float else None

    def wrap(slowly: Callable[..., None]) -> Callable[..., None]:
        def init(self: Any, *values: Any, dbg_info: Any = None, dtype: Any = None) -> None:
            value: Any = values[0] if len(values) == 1 else None
            if type(value) is wrapped and value.ptr_type_checked:
                self.ptr, self.dbg_info, self.ptr_type_checked = value.ptr, value.dbg_info, True
                return
            found = value if type(value) is inner else constant(value) if dtype is None else None
            if found is None:
                slowly(self, *values, dbg_info=dbg_info, dtype=dtype)
                return
            self.ptr, self.dbg_info = found, dbg_info
            if dbg_info:
                found.set_dbg_info(dbg_info)
            found.type_check(get_runtime().prog.config())
            self.ptr_type_checked = True

        return init

    def flatten(slowly: Callable[[Any], list[Any]]) -> Callable[[Any], list[Any]]:
        def get_flattened_ptrs(value: Any) -> list[Any]:
            if type(value) is wrapped and value.ptr_type_checked:
                return [value.ptr]
            return [wrapped(value).ptr] if type(value) is int else slowly(value)

        return get_flattened_ptrs

    def declare(slowly: Callable[[Any], Any]) -> Callable[[Any], Any]:
        def expr_init(value: Any) -> Any:
            if type(value) is not wrapped:
                return slowly(value)
            runtime = get_runtime()
            place = debug_info(runtime.get_current_src_info())
            return wrapped(runtime.compiling_callable.ast_builder().expr_var(value.ptr, place))

        return expr_init

    def validate(slowly: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
        def validate_subscript_index(value: Any, index: Any) -> None:
            each = index if type(index) is tuple else (index,)
            if not all(type(i) is wrapped or (type(i) is int and i >= 0) for i in each):
                slowly(value, index)

        return validate_subscript_index

    _replace(wrapped, __init__=wrap)
    _replace(expr, _get_flattened_ptrs=flatten)
    _replace(impl, expr_init=declare, validate_subscript_index=validate)


def _quicken_names(lang: Any) -> None:
    """How names are looked up, and places told."""
    context, matrix, absent = lang.ast.ast_transformer_utils.ASTTransformerContext, lang.matrix.Matrix, object()

    def look_up(slowly: Callable[[Any, str], Any]) -> Callable[[Any, str], Any]:
        def get_var_by_name(self: Any, name: str) -> Any:
            for scope in reversed(self.local_scopes):
                if name in scope:
                    return scope[name]
            value = self.global_vars.get(name, absent)
            return slowly(self, name) if value is absent or isinstance(value, matrix) else value

        return get_var_by_name

    _replace(context, get_pos_info=lambda _: _place, get_var_by_name=look_up)


def _quicken_nodes(lang: Any) -> None:
    """How the nodes of the syntax tree are built."""
    module, transformer = lang.ast.ast_transformer, lang.ast.ast_transformer.ASTTransformer
    builtins = {id(known) for known in (print, min, max, int, bool, float, any, all, abs, pow, len, operator.matmul)}
    decorators = {id(getattr(module.impl, name)): name for name in ("static", "static_assert", "grouped")}
    decorators[id(module.ndrange)] = "ndrange"
    type_error = module.TaichiTypeError

    def name(_: Any) -> Any:
        def build_Name(context: Any, node: Any) -> Any:  # notes no place: that of its statement is enough
            node.ptr = context.get_var_by_name(node.id)
            return node.ptr

        return staticmethod(build_Name)

    def operation(slowly: Callable[[Any, Any], Any]) -> Any:
        def build_BinOp(context: Any, node: Any) -> Any:
            act = OPERATORS.get(type(node.op))
            if act is None:
                return slowly(context, node)
            module.build_stmt(context, node.left)
            module.build_stmt(context, node.right)
            try:
                node.ptr = act(node.left.ptr, node.right.ptr)
            except TypeError as error:
                raise type_error(str(error)) from None
            return node.ptr

        return staticmethod(build_BinOp)

    def builtin(slowly: Callable[..., bool]) -> Any:
        def build_call_if_is_builtin(context: Any, node: Any, args: Any, keywords: Any) -> bool:
            return id(node.func.ptr) in builtins and slowly(context, node, args, keywords)

        return staticmethod(build_call_if_is_builtin)

    def decorator(slowly: Callable[[Any, Any], str]) -> Any:
        def get_decorator(context: Any, node: Any) -> str:
            called = node.func if isinstance(node, ast.Call) else None
            if isinstance(called, ast.Attribute) and isinstance(called.value, ast.Name):
                home = context.global_vars.get(called.value.id)
                if not isinstance(home, dict):
                    return decorators.get(id(getattr(home, called.attr, None)), "")
            return slowly(context, node)

        return staticmethod(get_decorator)

    _replace(module, ChainMap=lambda _: _merged)  # of a call's keywords, of which there are hardly ever any
    _replace(
        transformer,
        build_Name=name,
        build_BinOp=operation,
        build_call_if_is_builtin=builtin,
        get_decorator=decorator,
    )
    methods = {
        kind: getattr(transformer, f"build_{kind.__name__}")
        for kind in vars(ast).values()
        if isinstance(kind, type) and not issubclass(kind, ast.stmt) and hasattr(transformer, f"build_{kind.__name__}")
    }
    _replace(transformer, __call__=lambda build: _by_statement(build, methods))


def _by_statement(
    build: Callable[[Any, Any, Any], Any], methods: dict[type, Callable[[Any, Any], Any]]
) -> Callable[[Any, Any, Any], Any]:
    """Builder.__call__, which notes where a node stands, for statements alone: what is in one stands where it does.
    methods: of all other nodes."""

    def build_node(self: Any, context: Any, node: ast.AST) -> Any:
        method = methods.get(type(node))
        return build(self, context, node) if method is None else method(context, node)

    return build_node


def _merged(*maps: dict[str, Any]) -> dict[str, Any]:
    return {key: value for each in reversed(maps) for key, value in each.items()}


def function_source(function: Any) -> tuple[list[str], int] | None:
    """A function's lines, and the number of the first, as inspect finds them by reading word for word; None where it
    must.

    A function ends before a line that is indented no more than it is; unless that is in a bracket or a text, but then
    what is above it is no whole function.
    """
    code = function.__code__
    lines = linecache.getlines(code.co_filename)[code.co_firstlineno - 1 :]
    if not lines or not lines[0].lstrip().startswith(("def ", "@")) or hasattr(function, "__wrapped__"):
        return None
    end = 1  # of what has been seen of it
    for number, line in enumerate([*lines[1:], "end of file"], 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        if _indentation(line) <= _indentation(lines[0]):
            with suppress(SyntaxError):
                _parsed(textwrap.dedent("\n".join(map(_filled, lines[:end]))))
                return lines[:end], code.co_firstlineno
        end = number + 1
    return None


def _indentation(line: str) -> int:
    return len(line) - len(line.lstrip())


def _filled(line: str, **_: int) -> str:
    """What textwrap makes of a line that is not too long."""
    return line.expandtabs(4).rstrip()


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
