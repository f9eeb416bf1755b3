"""A person's own Python code as a policy."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Callable
from pathlib import Path

from tacsim.interface import Action, Needs, Observation, Policy

PACKAGES = ("tacsim", "calibration", "robot")


class PolicyNotFound(ValueError):
    """The name of a policy leads to nothing that acts."""


class FunctionPolicy:
    """A plain function from Observation to Action as a policy that needs nothing and remembers nothing."""

    needs = Needs()

    def __init__(self, act: Callable[[Observation], Action]) -> None:
        self._act = act

    def reset(self) -> None:
        """A function has no state."""

    def __call__(self, observation: Observation) -> Action:
        return self._act(observation)


def policy_of_code(name: str) -> Policy:
    """The policy at "package.module:attribute": an object with needs, reset and __call__ as tacsim.Policy has them, a
    class of such objects (made without arguments), or a function from Observation to Action.

    Runs code of that module. Raises PolicyNotFound.
    """
    return _as_policy(_attribute(name), name)


def _attribute(name: str) -> object:
    module_name, _, path = name.partition(":")
    if not path or not all(part.isidentifier() for part in [*module_name.split("."), *path.split(".")]):
        raise PolicyNotFound(f"policy '{name}' must have the form 'package.module:attribute'")
    try:
        found: object = importlib.import_module(module_name)
    except ModuleNotFoundError as failure:
        missing = failure.name or ""
        if not missing or not (module_name + ".").startswith(missing + "."):
            why = f"module '{module_name}' itself imports '{missing}', which is missing{_namesake(missing)}"
        else:
            why = f"no module '{missing}'; is its folder on PYTHONPATH?{_namesake(missing)}"
        raise PolicyNotFound(f"policy '{name}': {why}") from failure
    except (Exception, SystemExit) as failure:  # a script may end Python when it is imported
        why = f"importing '{module_name}' failed: {failure!r}{_namesake(str(failure))}"
        raise PolicyNotFound(f"policy '{name}': {why}") from failure
    for part in path.split("."):
        if not hasattr(found, part):
            raise PolicyNotFound(f"policy '{name}': '{module_name}' has no '{path}'{_namesake(module_name)}")
        found = getattr(found, part)
    return found


def _namesake(words: str) -> str:
    """What to add to an error that speaks of one of our packages: a file in the working folder has the same name."""
    ours = Path(__file__).resolve().parents[2]
    for package in PACKAGES:
        for path in (Path(package).absolute(), Path(f"{package}.py").absolute()):
            if re.search(rf"\b{package}\b", words) and path.exists() and path.resolve() != ours / package:
                return f". '{package}' is a package of tacsim, {path} is not imported: rename it"
    return ""


def _as_policy(found: object, name: str) -> Policy:
    if inspect.isclass(found):
        try:
            found = found()
        except Exception as failure:
            raise PolicyNotFound(
                f"policy '{name}': the class cannot be made without arguments: {failure!r}"
            ) from failure
    if isinstance(found, Policy):
        if not isinstance(found.needs, Needs):
            raise PolicyNotFound(f"policy '{name}': its needs must be a tacsim.Needs, got {type(found.needs).__name__}")
        return found
    if callable(found):
        return FunctionPolicy(found)
    raise PolicyNotFound(
        f"policy '{name}' is a {type(found).__name__}: neither a policy nor a function of an Observation"
    )
