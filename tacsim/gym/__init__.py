"""Gymnasium environments. An import of this package registers them; so does its name in an id, also in a process that
imports nothing else: ``gymnasium.make("tacsim.gym:tacsim/Squeeze-v0")``."""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any

import gymnasium

ENVIRONMENTS = {
    "tacsim/Squeeze-v0": "squeeze",
    "tacsim/Reposition-v0": "reposition",
    "tacsim/Knead-v0": "knead",
    "tacsim/Lengthen-v0": "lengthen",
    "tacsim/Relief-v0": "relief",
}


def make_env(**options: Any) -> Any:
    """An environment by robot.open.make_env. Raises ImportError where Python finds another `robot` first."""
    return _opener().make_env(**options)


def make_vector_env(**options: Any) -> Any:
    """The same of robot.open.make_vector_env; with `processes`, of make_sharded_env."""
    opener = _opener()
    return opener.make_sharded_env(**options) if "processes" in options else opener.make_vector_env(**options)


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
    for name, task in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point=f"{__name__}:make_env",
                vector_entry_point=f"{__name__}:make_vector_env",
                kwargs={"task": task},
            )


register_envs()
