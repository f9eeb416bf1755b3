"""A person's own Python code as a policy."""

from __future__ import annotations

import inspect
from collections.abc import Callable

from robot.common.code import CodeNotFound, attribute
from tacsim.interface import Action, Needs, Observation, Policy


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
    try:
        found = attribute(name)
    except CodeNotFound as failure:
        raise PolicyNotFound(f"policy {failure}") from failure
    return _as_policy(found, name)


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
