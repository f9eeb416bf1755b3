"""Public names of a package that are imported when they are first asked for, so that `import tacsim` stays light."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path


def public_names(package: str) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` (PEP 562) of `package`, `__all__` included.

    The names are those that its `__init__` imports under `if TYPE_CHECKING`, in the form that editors and mypy take
    for public (`from tacsim.rig import Rig as Rig`), so that each is written in one place.
    """
    module = sys.modules[package]
    homes: dict[str, str] = {}  # by name: the module that has it

    def public() -> dict[str, str]:
        if not homes:
            import ast  # here, because `import tacsim` is light

            for node in ast.walk(ast.parse(Path(module.__file__ or "").read_text(encoding="utf-8"))):
                if isinstance(node, ast.ImportFrom) and node.module is not None:
                    homes.update({alias.name: node.module for alias in node.names if alias.asname is not None})
        return homes

    def get(name: str) -> object:
        if name == "__all__":
            return list(public())
        if name.startswith("_") or name not in public():
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        home = homes[name]
        value = import_module(f"{package}.{name}") if home == package else getattr(import_module(home), name)
        setattr(module, name, value)
        return value

    return get, lambda: sorted({*vars(module), *public()})
