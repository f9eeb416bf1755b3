"""Makes ``gymnasium.make("tacsim/Squeeze-v0")`` work without an import of tacsim.

Gymnasium 1.0 dropped the entry points by which installed packages offered environments. In their place the distribution
carries ``tacsim_gymnasium.pth``: Python runs its one line at start, which waits for the first ``import gymnasium`` and
registers our environments then. Nothing heavy is loaded before. See docs/decisions/0006.
"""

from __future__ import annotations

import sys
import warnings
from importlib import import_module
from importlib.machinery import PathFinder

TYPE_CHECKING = False  # typing itself would cost milliseconds at every start of Python
if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import ModuleType
    from typing import Any


ENVIRONMENTS = {"tacsim/Squeeze-v0": "squeeze", "tacsim/Reposition-v0": "reposition", "tacsim/Knead-v0": "knead"}


def make_env(**options: Any) -> Any:
    """An environment by robot.open.make_env. Raises ImportError where Python finds another `robot` first."""
    return _opener().make_env(**options)


def make_vector_env(**options: Any) -> Any:
    """The same of robot.open.make_vector_env."""
    return _opener().make_vector_env(**options)


def _opener() -> ModuleType:
    name = "robot.open"  # not an import statement: tacsim stays below robot
    try:
        return import_module(name)
    except ModuleNotFoundError as failure:
        if failure.name != name:
            raise
        found = getattr(sys.modules.get("robot"), "__file__", None)
        raise ImportError(
            f"'robot' is {found}, not the package of tacsim: rename it, or run from another folder"
        ) from failure


def register_envs() -> None:
    """Registers the environments with Gymnasium, once a process."""
    import gymnasium

    for name, task in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point=f"{__name__}:make_env",
                vector_entry_point=f"{__name__}:make_vector_env",
                kwargs={"task": task},
            )


def install() -> None:
    """Registers our environments when Gymnasium is imported; at once, if it already is."""
    if "gymnasium" in sys.modules:
        _register()
    else:
        sys.meta_path.insert(0, _AfterGymnasium())


def _register() -> None:
    try:
        register_envs()
    except Exception as error:  # a broken tacsim must not take Gymnasium down with it
        warnings.warn(f"tacsim: environments are not registered: {error!r}", stacklevel=2)


class _AfterGymnasium:
    """A finder that steps aside once it has seen Gymnasium, and runs our registration after the module's own body."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = PathFinder.find_spec(name, path, target)
        if spec is None or spec.loader is None:
            return spec
        run = spec.loader.exec_module

        def run_and_register(module: ModuleType) -> None:
            run(module)
            _register()

        spec.loader.exec_module = run_and_register  # type: ignore[method-assign]
        return spec
