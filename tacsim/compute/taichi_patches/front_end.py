"""A faster front end for Taichi: it turns the Python of a kernel into Taichi's statements in a third of the time.

Taichi runs its front end in every process, because a kernel's cache key is computed from its output. Most of the time
went to error messages (a drawing of the source line for each node of the syntax tree), to a search of all modules for
the file of each function's caller, and to reading and parsing a function wherever it is inlined. Most of the rest is
overhead per node: tables built for each sum, type tests of each constant, index and call.
The output is the same to the byte, so the cache keys are (tests/tacsim/compute/taichi_patches/test_front_end.py).
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

# All but the matrix product, which is Taichi's own
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
def import_without_optional_modules() -> Iterator[None]:
    """Context of the import of Taichi.

    Each decorator of Taichi's own functions searches all loaded modules for the caller's, and does not need it: the
    search is replaced. Modules that take a fifth of the time and are rarely used (to ask a server for a newer version,
    to read functions typed at a prompt) are imported at their first use.
    """
    search = inspect.getmodule
    inspect.getmodule = lambda *_: None
    later = [_LazyModule(name) for name in ("urllib.request", "dill") if name not in sys.modules]
    sys.modules.update({module.__name__: module for module in later})
    try:
        with _no_collection():
            yield
    finally:
        inspect.getmodule = search
        for module in later:
            module._remove()


class _LazyModule(ModuleType):
    """Placeholder of a module, which is imported at the first attribute access."""

    def __getattr__(self, name: str) -> Any:
        self._remove()
        return getattr(import_module(self.__name__), name)

    def _remove(self) -> None:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]


@contextmanager
def _no_collection() -> Iterator[None]:
    """No garbage collection while many lasting objects are made: repeated collections take a tenth of the time."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


def replace_front_end(lang: Any) -> None:
    """Replaces functions of package `lang` (taichi.lang) by faster ones; to be called before any kernel is defined.

    Raises AttributeError for a version of Taichi that lacks one of them.
    """
    for part in (_replace_reading, _replace_collection, _replace_values, _replace_name_lookup, _replace_nodes):
        part(lang)


def _replace(owner: Any, **makers: Callable[[Any], Any]) -> None:
    """Replaces attributes of `owner`; each maker gets the present value and returns the new one."""
    for name, make in makers.items():
        setattr(owner, name, make(getattr(owner, name)))


def _replace_reading(lang: Any) -> None:
    """Each function's source is read once."""
    _replace(
        lang.kernel_impl,
        _inside_class=lambda _: _inside_class,
        getsourcefile=cache,
        getsourcelines=lambda read: cache(lambda function: function_source(function) or read(function)),
        ast=lambda _: SimpleNamespace(**{**vars(ast), "parse": _parse_function}),
        textwrap=lambda _: SimpleNamespace(**{**vars(textwrap), "fill": _fill_line, "dedent": cache(textwrap.dedent)}),
    )


def _replace_collection(lang: Any) -> None:
    """No garbage collection while a kernel's syntax tree is processed."""
    _replace(lang.kernel_impl.Kernel, materialize=_no_collection())


def _replace_values(lang: Any) -> None:
    """Fewer type tests where values are wrapped: most are numbers or made by Taichi's core."""
    int32_limit = 2**31
    expr, impl = lang.expr, lang.impl
    core, wrapped = expr._ti_core, expr.Expr
    integer, real, debug_info = core.make_const_expr_int, core.make_const_expr_fp, core.DebugInfo
    inner, get_runtime = core.Expr, impl.get_runtime

    def constant(value: Any) -> Any:
        """Taichi's constant; None unless `value` is a plain number."""
        if type(value) is int and -int32_limit <= value < int32_limit:
            return integer(get_runtime().default_ip, value)
        return real(get_runtime().default_fp, value) if type(value) is float else None

    def wrap(original: Callable[..., None]) -> Callable[..., None]:
        def init(self: Any, *values: Any, dbg_info: Any = None, dtype: Any = None) -> None:
            value: Any = values[0] if len(values) == 1 else None
            if type(value) is wrapped and value.ptr_type_checked:
                self.ptr, self.dbg_info, self.ptr_type_checked = value.ptr, value.dbg_info, True
                return
            found = value if type(value) is inner else constant(value) if dtype is None else None
            if found is None:
                original(self, *values, dbg_info=dbg_info, dtype=dtype)
                return
            self.ptr, self.dbg_info = found, dbg_info
            if dbg_info:
                found.set_dbg_info(dbg_info)
            found.type_check(get_runtime().prog.config())
            self.ptr_type_checked = True

        return init

    def flatten(original: Callable[[Any], list[Any]]) -> Callable[[Any], list[Any]]:
        def get_flattened_ptrs(value: Any) -> list[Any]:
            if type(value) is wrapped and value.ptr_type_checked:
                return [value.ptr]
            return [wrapped(value).ptr] if type(value) is int else original(value)

        return get_flattened_ptrs

    def declare(original: Callable[[Any], Any]) -> Callable[[Any], Any]:
        def expr_init(value: Any) -> Any:
            if type(value) is not wrapped:
                return original(value)
            runtime = get_runtime()
            place = debug_info(runtime.get_current_src_info())
            return wrapped(runtime.compiling_callable.ast_builder().expr_var(value.ptr, place))

        return expr_init

    def validate(original: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
        def validate_subscript_index(value: Any, index: Any) -> None:
            each = index if type(index) is tuple else (index,)
            if not all(type(i) is wrapped or (type(i) is int and i >= 0) for i in each):
                original(value, index)

        return validate_subscript_index

    _replace(wrapped, __init__=wrap)
    _replace(expr, _get_flattened_ptrs=flatten)
    _replace(impl, expr_init=declare, validate_subscript_index=validate)


def _replace_name_lookup(lang: Any) -> None:
    """Faster lookup of names, and short source locations in error messages."""
    context, matrix, absent = lang.ast.ast_transformer_utils.ASTTransformerContext, lang.matrix.Matrix, object()

    def lookup(original: Callable[[Any, str], Any]) -> Callable[[Any, str], Any]:
        def get_var_by_name(self: Any, name: str) -> Any:
            for scope in reversed(self.local_scopes):
                if name in scope:
                    return scope[name]
            value = self.global_vars.get(name, absent)
            return original(self, name) if value is absent or isinstance(value, matrix) else value

        return get_var_by_name

    _replace(context, get_pos_info=lambda _: _describe_location, get_var_by_name=lookup)


def _replace_nodes(lang: Any) -> None:
    """Less overhead per node of the syntax tree."""
    module, transformer = lang.ast.ast_transformer, lang.ast.ast_transformer.ASTTransformer
    builtins = {id(known) for known in (print, min, max, int, bool, float, any, all, abs, pow, len, operator.matmul)}
    decorators = {id(getattr(module.impl, name)): name for name in ("static", "static_assert", "grouped")}
    decorators[id(module.ndrange)] = "ndrange"
    type_error = module.TaichiTypeError

    def name(_: Any) -> Any:
        def build_Name(context: Any, node: Any) -> Any:  # records no location: that of its statement is enough
            node.ptr = context.get_var_by_name(node.id)
            return node.ptr

        return staticmethod(build_Name)

    def operation(original: Callable[[Any, Any], Any]) -> Any:
        def build_BinOp(context: Any, node: Any) -> Any:
            act = OPERATORS.get(type(node.op))
            if act is None:
                return original(context, node)
            module.build_stmt(context, node.left)
            module.build_stmt(context, node.right)
            try:
                node.ptr = act(node.left.ptr, node.right.ptr)
            except TypeError as error:
                raise type_error(str(error)) from None
            return node.ptr

        return staticmethod(build_BinOp)

    def builtin(original: Callable[..., bool]) -> Any:
        def build_call_if_is_builtin(context: Any, node: Any, args: Any, keywords: Any) -> bool:
            return id(node.func.ptr) in builtins and original(context, node, args, keywords)

        return staticmethod(build_call_if_is_builtin)

    def decorator(original: Callable[[Any, Any], str]) -> Any:
        def get_decorator(context: Any, node: Any) -> str:
            called = node.func if isinstance(node, ast.Call) else None
            if isinstance(called, ast.Attribute) and isinstance(called.value, ast.Name):
                home = context.global_vars.get(called.value.id)
                if not isinstance(home, dict):
                    return decorators.get(id(getattr(home, called.attr, None)), "")
            return original(context, node)

        return staticmethod(get_decorator)

    _replace(module, ChainMap=lambda _: _merge_maps)  # of a call's keywords, which are rare
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
    _replace(transformer, __call__=lambda build: _locate_statement(build, methods))


def _locate_statement(
    build: Callable[[Any, Any, Any], Any], methods: dict[type, Callable[[Any, Any], Any]]
) -> Callable[[Any, Any, Any], Any]:
    """Builder.__call__, which records the location of a node, for statements only: a node inside has its statement's.

    methods: for all other kinds of nodes.
    """

    def build_node(self: Any, context: Any, node: ast.AST) -> Any:
        method = methods.get(type(node))
        return build(self, context, node) if method is None else method(context, node)

    return build_node


def _merge_maps(*maps: dict[str, Any]) -> dict[str, Any]:
    return {key: value for each in reversed(maps) for key, value in each.items()}


def function_source(function: Any) -> tuple[list[str], int] | None:
    """A function's lines and the number of the first, as `inspect.getsourcelines`, which tokenizes; None where that is
    needed.

    A function ends before the next line that is indented no more than it is. If such a line lies in a bracket or a
    string, the lines above it do not parse, and the search goes on.
    """
    code = function.__code__
    lines = linecache.getlines(code.co_filename)[code.co_firstlineno - 1 :]
    if not lines or not lines[0].lstrip().startswith(("def ", "@")) or hasattr(function, "__wrapped__"):
        return None
    end = 1  # behind the last line of code so far
    for number, line in enumerate([*lines[1:], "end of file"], 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        if _indentation(line) <= _indentation(lines[0]):
            with suppress(SyntaxError):
                _parse_cached(textwrap.dedent("\n".join(map(_fill_line, lines[:end]))))
                return lines[:end], code.co_firstlineno
        end = number + 1
    return None


def _indentation(line: str) -> int:
    return len(line) - len(line.lstrip())


def _fill_line(line: str, **_: int) -> str:
    """`textwrap.fill` of a line that is not too long."""
    return line.expandtabs(4).rstrip()


def _parse_function(text: str) -> ast.Module:
    """The syntax tree of a function, parsed once. Taichi removes the arguments of a kernel from it; they are put
    back."""
    tree, arguments = _parse_cached(text)
    tree.body[0].args.args = list(arguments)  # type: ignore[attr-defined]
    return tree


@cache
def _parse_cached(text: str) -> tuple[ast.Module, tuple[ast.arg, ...]]:
    tree = ast.parse(text)
    return tree, tuple(tree.body[0].args.args)  # type: ignore[attr-defined]


def _describe_location(context: Any, node: Any) -> str:
    """Location of a node of a kernel's syntax tree, for error messages."""
    line, source = node.lineno + context.lineno_offset, context.src[node.lineno - 1]
    return f'File "{context.file}", line {line}, in {context.func.func.__name__}:\n{source}\n'


def _inside_class(level_of_class_stackframe: int) -> bool:
    """Whether a decorated function is a method; level: of the frame of the class, counted from here."""
    return "__qualname__" in sys._getframe(level_of_class_stackframe - 1).f_locals
