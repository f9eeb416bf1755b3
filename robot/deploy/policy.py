"""Policies by name: the scripted policy of a task, `grip`, a learned policy in an ONNX file, a motion in a CSV file, or
Python code of a user."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from robot.deploy.onnx_policy import OnnxPolicy, find_mismatches
from robot.deploy.python_policy import PolicyNotFound as PolicyNotFound
from robot.deploy.python_policy import TargetScript, policy_of_code
from robot.deploy.training_range import describe_scenes_outside
from tacsim.config import config_root
from tacsim.interface import IncompatibleRig, Policy, RigSpec
from tacsim.models.scene import Scene
from tacsim.models.sensor import CanonicalGrid
from tacsim.models.text import suggest_file, suggest_word
from tacsim.record.episode import TRAINING_DISTANCE, TRAINING_KNOWN
from tacsim.rig import require_needs
from tacsim.tasks import Task

NAMES = ("scripted", "grip", "learned")


def load_policy(
    name: str,
    task: Task | None,
    spec: RigSpec,
    canonical: CanonicalGrid | None = None,
    other_names: Sequence[str] = (),
) -> Policy:
    """Loads the policy called `name`, for a rig with `spec` and this canonical grid (None: the default grid).

    "scripted": the scripted policy of the task. "grip": closes until contact, on any rig. "path/to/file.onnx": a
    learned policy; "learned": the shipped learned policy of the task. "path/to/file.csv": a table of targets.
    "package.module:attribute": an object with needs, reset and __call__ like tacsim.Policy, a class of such objects
    (created without arguments), or a function from Observation to Action. This runs code of that module, so use only
    modules that you trust; of an ONNX file only its operators are run.

    other_names: more names that the caller knows, which an error may suggest.
    Raises PolicyNotFound, and IncompatibleRig for a learned policy with another grid.
    """
    require_policy_name(name, other_names)
    if name == "scripted":
        if task is None:
            raise PolicyNotFound(
                "policy 'scripted' belongs to a task, and this rig has none: give a task, or use 'grip'"
            )
        return task.scripted()
    if name == "grip":
        from tacsim.tasks.squeeze import Grip

        return Grip(spec)
    if name == "learned":
        return OnnxPolicy(_find_shipped_policy(task), canonical or CanonicalGrid(), None if task is None else task.goal)
    if name.endswith(".onnx"):
        return OnnxPolicy(Path(name), canonical or CanonicalGrid(), None if task is None else task.goal)
    if name.endswith(".csv"):
        return TargetScript(Path(name))
    return policy_of_code(name)


def reset_policy(policy: Policy, task: Task | None) -> None:
    """Resets a policy for an episode of a task. One with a method `set_goal` gets the goal [m] before, one number or a
    tuple."""
    actor = getattr(policy, "inner", policy)  # of one that an operator may pause (robot.serve)
    if task is not None and hasattr(actor, "set_goal"):
        actor.set_goal(task.goal)
    policy.reset()


def require_policy_name(name: str, other_names: Sequence[str] = ()) -> None:
    """Raises PolicyNotFound for a text that `load_policy` takes for no policy, and for a file that is not there. Reads
    no file and imports no code."""
    path = Path(name)
    if path.suffix in (".onnx", ".csv"):
        if not path.exists():
            hint = suggest_file(path, (path.suffix,)) or (
                "; `tacsim train` writes one" if path.suffix == ".onnx" else ""
            )
            raise PolicyNotFound(f"policy '{name}': no such file{hint}")
        return
    if name in (*NAMES, *other_names) or ":" in name:
        return
    files = ("path/to/file.onnx", "path/to/file.csv")
    allowed = ", ".join(f"'{each}'" for each in (*dict.fromkeys((*other_names, *NAMES)), *files))
    if name.endswith(".py"):
        hint = f"; name what the file defines: '{path.stem}:NAME'"
    else:
        hint = suggest_word(name, (*NAMES, *other_names))
    raise PolicyNotFound(f"no policy '{name}'; allowed: {allowed}, or 'package.module:attribute'{hint}")


def _find_shipped_policy(task: Task | None) -> Path:
    """Path of the shipped learned policy of a task. Raises PolicyNotFound."""
    folder = config_root() / "policies"
    path = folder / f"{'' if task is None else task.config.kind}.onnx"
    if not path.is_file():
        shipped = ", ".join(sorted(each.stem for each in folder.glob("*.onnx"))) or "(none)"
        reason = "this rig has no task" if task is None else f"none is shipped for task '{task.config.kind}'"
        raise PolicyNotFound(
            f"policy 'learned': {reason}; there are: {shipped}. Make one: tacsim train, or take 'scripted'"
        )
    return path


def training_info(policy: Policy) -> dict[str, float]:
    """Entries of `Step.info`: last observation of a learned policy against its training range; else empty."""
    policy = getattr(policy, "inner", policy)  # of one that an operator may pause (robot.serve)
    if not isinstance(policy, OnnxPolicy):
        return {}
    return (
        {TRAINING_KNOWN: 0.0}
        if policy.range_monitor.known is None
        else {TRAINING_DISTANCE: policy.range_monitor.latest}
    )


def describe_outside(policy: Policy | None) -> str:
    """Observations of a learned policy in this episode that are outside its training range; "" without any."""
    return (
        policy.range_monitor.describe_outside()
        if isinstance(policy, OnnxPolicy) and policy.range_monitor.is_outside
        else ""
    )


def has_training_range(policy: Policy | None) -> bool:
    """True for a learned policy whose file has the range of its training."""
    return isinstance(policy, OnnxPolicy) and policy.range_monitor.known is not None


def training_notes(policy: Policy | None, name: str, scenes: Sequence[Scene]) -> list[str]:
    """Notes before an episode on the training of the policy `name`: its range is unknown, or parameters of simulated
    `scenes` are outside the range. Empty for a policy that is not learned."""
    if not isinstance(policy, OnnxPolicy):
        return []
    known = policy.range_monitor.known
    if known is None:
        return [
            f"policy '{name}': unknown training range, so observations outside it are not reported; "
            "tacsim export policy-range measures it"
        ]
    outside = describe_scenes_outside(known, scenes)
    return [f"policy '{name}': the scene is outside its training: {'; '.join(outside)}"] if outside else []


def require_fit(rig: str, spec: RigSpec, policy: Policy, name: str, task: Task | None) -> None:
    """Raises IncompatibleRig, with advice, if a rig with `spec` lacks something that the task or the policy `name`
    needs."""
    if task is not None:
        who = f"task '{task.config.kind}'"
        advice = "Omit the task (task: null in the rig file, or --set task=null): then steps are not judged"
        require_needs(rig, spec, task.needs, who, advice)
        if not spec.truth:
            require_needs(
                rig, spec, task.touch_needs, f"{who} (judged by touch, because the truth is not known)", advice
            )
    advice = "" if name == "grip" else "Use --policy grip, which needs only pictures, or your own policy"
    require_needs(rig, spec, policy.needs, f"policy '{name}'", advice)
    if isinstance(policy, OnnxPolicy) and (found := find_mismatches(policy, spec, task)):
        raise IncompatibleRig(f"policy '{name}' cannot run on rig '{rig}': it was trained for {'; '.join(found)}")
