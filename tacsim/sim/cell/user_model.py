"""An arm of the user's own: an MJCF file, put into the model of a cell."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tacsim.interface import FloatArray
from tacsim.sim.cell.description import ArmDescription
from tacsim.sim.engines.mujoco_module import load_mujoco


def read_spec(file: Path) -> Any:
    """The MjSpec of an MJCF file. Raises ValueError for one that MuJoCo cannot read."""
    mujoco = load_mujoco()
    if not file.is_file():
        raise ValueError(f"no such MJCF file: {file}")
    try:
        return mujoco.MjSpec.from_file(str(file))
    except (ValueError, RuntimeError, mujoco.FatalError) as failure:
        raise ValueError(f"{file.name}: MuJoCo cannot read it: {failure}") from None


def attach(spec: Any, arm: ArmDescription, prefix: str, names: Sequence[str]) -> None:
    """Adds the user's model at the arm's base, its names behind a `prefix`. The arm's driver moves its joints, so
    their actuators are left out, and the weights of the bodies that they move are balanced, as controllers do.

    names: all joints that are moved, those of a gripper included. Raises ValueError for one that is not there, and as
    `read_spec`.
    """
    assert arm.file is not None
    child = read_spec(arm.file)
    joints = {joint.name: joint for joint in child.joints}
    for name in names:
        if name not in joints:
            raise ValueError(f"{arm.file.name}: no joint '{name}'; there are {_listed(list(joints))}")
        for body in (joints[name].parent, *joints[name].parent.find_all("body")):
            body.gravcomp = 1.0
    for actuator in list(child.actuators):
        if actuator.target in names:
            child.delete(actuator)
    x, y, z, w = arm.base.quaternion
    frame = spec.worldbody.add_frame(pos=arm.base.position.tolist(), quat=[w, x, y, z])
    try:
        spec.attach(child, frame=frame, prefix=prefix)
    except (ValueError, RuntimeError) as failure:
        raise ValueError(f"{arm.file.name}: cannot be added to the scene: {failure}") from None


def find_flange(spec: Any, name: str, arm: ArmDescription) -> Any:
    """A body at the site that carries the gripper. Raises ValueError for a site that is not there."""
    assert arm.file is not None
    site = spec.site(f"{name}/{arm.site}")
    if site is None:
        known = _listed([each.name.partition("/")[2] for each in spec.sites])
        raise ValueError(f"{arm.file.name}: no site '{arm.site}', which carries the gripper; there are {known}")
    return site.parent.add_body(name=f"{name}/flange", pos=site.pos, quat=site.quat, gravcomp=1.0)


def first_joints(file: Path, joints: Sequence[str]) -> FloatArray:
    """(n,) of the file's first keyframe, or as it is drawn. Raises ValueError as `read_spec`, and for a joint that is
    not there."""
    mujoco = load_mujoco()
    try:
        model = read_spec(file).compile()
    except (ValueError, mujoco.FatalError) as failure:
        raise ValueError(f"{file.name}: MuJoCo cannot read it: {failure}") from None
    places = model.key_qpos[0] if model.nkey else model.qpos0
    found = []
    for name in joints:
        joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
        if joint < 0:
            known = _listed([model.joint(number).name for number in range(model.njnt)])
            raise ValueError(f"{file.name}: no joint '{name}'; there are {known}")
        found.append(float(places[model.jnt_qposadr[joint]]))
    return np.array(found)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names if name) or "none with a name"
