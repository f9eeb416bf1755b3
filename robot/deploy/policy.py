"""Policies by name: the scripted one of a task, `grip`, or a person's own Python code."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable

from tacsim.interface import Action, Needs, Observation, Policy, RigSpec
from tacsim.tasks import Task


class PolicyNotFound(ValueError):
    """The name of a policy leads to nothing that acts."""


class FunctionPolicy:
    """A plain function from Observation to Action as a policy that needs nothing and remembers nothing."""

    def __init__(self, act: Callable[[Observation], Action]) -> None:
        self._act = act

    @property
    def needs(self) -> Needs:
        return Needs()

    def reset(self) -> None:
        """A function has no state."""

    def __call__(self, observation: Observation) -> Action:
        return self._act(observation)


def load_policy(name: str, task: Task | None, spec: RigSpec) -> Policy:
    """The policy called `name`, for a rig that delivers `spec`.

    "scripted": the task's own. "grip": closes until it feels contact, on any rig. "package.module:attribute": an object
    with needs, reset and __call__ as tacsim.interface.Policy has them, a class of such objects (made without
    arguments), or a function from Observation to Action. Runs code of that module, so name only modules you trust.

    Raises PolicyNotFound.
    """
    if name == "scripted":
        if task is None:
            raise PolicyNotFound(
                "policy 'scripted' belongs to a task and this rig has none: give a task, or take 'grip'"
            )
        return task.scripted()
    if name == "grip":
        from tacsim.tasks.grip import Grip

        return Grip(spec)
    if ":" not in name:
        raise PolicyNotFound(f"no policy '{name}'; allowed: 'scripted', 'grip', or 'package.module:attribute'")
    return _as_policy(_attribute(name), name)


def _attribute(name: str) -> object:
    module_name, _, path = name.partition(":")
    if not path or not all(part.isidentifier() for part in [*module_name.split("."), *path.split(".")]):
        raise PolicyNotFound(f"policy '{name}' must have the form 'package.module:attribute'")
    try:
        found: object = importlib.import_module(module_name)
    except ModuleNotFoundError as failure:
        if failure.name is None or not (module_name + ".").startswith(failure.name + "."):
            raise PolicyNotFound(
                f"policy '{name}': module '{module_name}' itself imports '{failure.name}', which is missing"
            ) from failure
        raise PolicyNotFound(f"policy '{name}': no module '{failure.name}'; is its folder on PYTHONPATH?") from failure
    except (Exception, SystemExit) as failure:  # a script may end Python when it is imported
        raise PolicyNotFound(f"policy '{name}': importing '{module_name}' failed: {failure!r}") from failure
    for part in path.split("."):
        if not hasattr(found, part):
            raise PolicyNotFound(f"policy '{name}': '{module_name}' has no '{path}'")
        found = getattr(found, part)
    return found


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
            raise PolicyNotFound(
                f"policy '{name}': its needs must be a tacsim.interface.Needs, got {type(found.needs).__name__}"
            )
        return found
    if callable(found):
        return FunctionPolicy(found)
    raise PolicyNotFound(
        f"policy '{name}' is a {type(found).__name__}: neither a policy nor a function of an Observation"
    )
