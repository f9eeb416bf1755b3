"""Policies by name: the scripted one of a task, `grip`, a learned one in an ONNX file, a motion in a CSV
file, or a person's Python code."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from robot.deploy.onnx_policy import OnnxPolicy, misfits
from robot.deploy.python_policy import PolicyNotFound as PolicyNotFound
from robot.deploy.python_policy import TargetScript, policy_of_code
from robot.deploy.training_range import outside_of_scenes
from tacsim.config import config_root
from tacsim.interface import IncompatibleRig, Policy, RigSpec
from tacsim.models.scene import Scene
from tacsim.models.sensor import CanonicalGrid
from tacsim.record.step_info import TRAINING_DISTANCE, TRAINING_KNOWN
from tacsim.rig import require_needs
from tacsim.tasks import Task


def load_policy(name: str, task: Task | None, spec: RigSpec, canonical: CanonicalGrid | None = None) -> Policy:
    """The policy called `name`, for a rig that delivers `spec` on this canonical grid (None: the usual one).

    "scripted": the task's own. "grip": closes until it feels contact, on any rig. "path/to/file.onnx": a learned one;
    "learned": the shipped one of the task. "path/to/file.csv": a table of targets (robot.deploy.python_policy).
    "package.module:attribute": an object with needs, reset and __call__ as tacsim.Policy has them, a class of such
    objects (made without arguments), or a function from Observation to Action. Runs code of that module, so name only
    modules you trust; of an ONNX file nothing is run but its operators.

    Raises PolicyNotFound, and IncompatibleRig for a learned policy that sees another grid.
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
    if name == "learned":
        return OnnxPolicy(_shipped(task), canonical or CanonicalGrid(), None if task is None else task.goal)
    if name.endswith(".onnx"):
        return OnnxPolicy(Path(name), canonical or CanonicalGrid(), None if task is None else task.goal)
    if name.endswith(".csv"):
        return TargetScript(Path(name))
    if ":" not in name:
        allowed = (
            "'scripted', 'grip', 'learned', 'path/to/file.onnx', 'path/to/file.csv', or 'package.module:attribute'"
        )
        raise PolicyNotFound(f"no policy '{name}'; allowed: {allowed}")
    return policy_of_code(name)


def _shipped(task: Task | None) -> Path:
    """The learned policy of a task that comes with tacsim."""
    folder = config_root() / "policies"
    path = folder / f"{'' if task is None else task.config.kind}.onnx"
    if not path.is_file():
        there = ", ".join(sorted(each.stem for each in folder.glob("*.onnx"))) or "(none)"
        asked = "this rig has no task" if task is None else f"none is shipped for task '{task.config.kind}'"
        raise PolicyNotFound(
            f"policy 'learned': {asked}; there are: {there}. Make one: tacsim train, or take 'scripted'"
        )
    return path


def training_info(policy: Policy) -> dict[str, float]:
    """What a record says of the last observation of a learned policy, beside the range of its training; else empty."""
    if not isinstance(policy, OnnxPolicy):
        return {}
    return {TRAINING_KNOWN: 0.0} if policy.watch.known is None else {TRAINING_DISTANCE: policy.watch.now}


def outside_in_words(policy: Policy | None) -> str:
    """What a learned policy has observed in this episode that it did not observe in training; "" if nothing."""
    return policy.watch.words() if isinstance(policy, OnnxPolicy) and policy.watch.is_outside else ""


def has_training_range(policy: Policy | None) -> bool:
    """Whether it is a learned policy that says what it observed in training."""
    return isinstance(policy, OnnxPolicy) and policy.watch.known is not None


def training_notes(policy: Policy | None, name: str, scenes: Sequence[Scene]) -> list[str]:
    """What a person should know, before an episode begins, of the training of the policy called `name`: that its range
    is unknown, or which parameters of simulated `scenes` it did not have. Empty for a policy that is not learned."""
    if not isinstance(policy, OnnxPolicy):
        return []
    known = policy.watch.known
    if known is None:
        return [
            f"policy '{name}': unknown training range, so nothing says whether it meets what it has learned; "
            "tacsim export policy-range measures it"
        ]
    outside = outside_of_scenes(known, scenes)
    return [f"policy '{name}': the scene is outside its training: {'; '.join(outside)}"] if outside else []


def require_fit(rig: str, spec: RigSpec, policy: Policy, name: str, task: Task | None) -> None:
    """Raises IncompatibleRig, which says what to choose instead, where a rig that delivers `spec` lacks what the task
    or the policy called `name` needs."""
    if task is not None:
        who = f"task '{task.config.kind}'"
        advice = "Leave the task out (task: null in the rig file, or --set task=null): then nothing is judged"
        require_needs(rig, spec, task.needs, who, advice)
        if not spec.truth:
            require_needs(rig, spec, task.touch_needs, f"{who} (judged by touch, as nobody knows the truth)", advice)
    advice = "" if name == "grip" else "Take --policy grip, which needs pictures alone, or one of your own"
    require_needs(rig, spec, policy.needs, f"policy '{name}'", advice)
    if isinstance(policy, OnnxPolicy) and (found := misfits(policy, spec, task)):
        raise IncompatibleRig(f"policy '{name}' cannot run on rig '{rig}': it was trained for {'; '.join(found)}")
