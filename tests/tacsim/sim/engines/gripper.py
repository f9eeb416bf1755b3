"""A gripper of two fingers in MuJoCo, closed by a force, around a free object between two gel pads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from tacsim.sim.engines.mujoco_module import load_mujoco
from tacsim.sim.engines.touch import TouchSensor

BOX = "type='box' size='.01 .006 .008'"
BALL = "type='sphere' size='.01'"
ROD = "type='cylinder' size='.008 .009'"  # its axis is world z, along the pads


def scene(
    geom: str = BOX, mass: float = 0.05, width: float = 0.01, timestep: float = 1e-3, finger: float = 0.1,
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81), extra: str = "", asset: str = "", table: bool = False,
) -> str:  # fmt: skip
    """width: half the object's along x, where the pads stand 0.5 mm away from it [m]; finger: mass of one [kg]."""
    fingers = "".join(
        f"""<body name="{side}" pos="{sign * (width + 0.5e-3)} 0 0">
        <joint name="{side}" type="slide" axis="{-sign} 0 0" damping="2"/>
        <inertial pos="0 0 0" mass="{finger}" diaginertia="1e-4 1e-4 1e-4"/>
        <site name="{side}" quat=".70710678 0 {-sign * 0.70710678} 0"/></body>"""
        for side, sign in (("left", -1), ("right", 1))
    )
    plane = '<geom name="table" type="plane" size=".3 .3 .01" pos="0 0 -.008"/>' if table else ""
    return f"""<mujoco><option timestep="{timestep}" integrator="implicitfast" gravity="{" ".join(map(str, gravity))}"/>
    <asset>{asset}</asset>
    <worldbody>{plane}
      <body name="base"><joint name="lift" type="slide" axis="0 0 1"/>
        <inertial pos="0 0 0" mass="1" diaginertia="1e-3 1e-3 1e-3"/>{fingers}</body>
      <body name="object"><freejoint/><geom name="thing" mass="{mass}" {geom}/></body></worldbody>
    <equality><joint joint1="left" joint2="right" polycoef="0 1 0 0 0"/></equality>
    <actuator><motor name="left" joint="left"/><motor name="right" joint="right"/>
      <position name="lift" joint="lift" kp="20000" kv="300"/></actuator>{extra}</mujoco>"""


def load(xml: str) -> tuple[Any, Any]:
    """Model and data."""
    mujoco = load_mujoco()
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def object_dofs(model: Any) -> slice:
    first = int(model.body_dofadr[model.body("object").id])
    return slice(first, first + 6)


def grip(touch: TouchSensor, force: float, seconds: float = 0.15, close: float = 0.1) -> None:
    """Closes with a ramp; the object's weight is taken, and its motion damped, until `close` [s]."""
    hold(touch, seconds, lambda time: force * min(1.0, time / (0.6 * close)), close)


def hold(
    touch: TouchSensor, seconds: float, force: Callable[[float], float], free: float = 0.0,
    watch: Callable[[float], None] = lambda time: None,
) -> None:  # fmt: skip
    """Lets time pass with a grip force by time; the object's weight is taken until `free` [s]. watch: before a step."""
    model, data = touch.model, touch.data
    dofs, mass = object_dofs(model), float(model.body("object").mass[0])
    for number in range(round(seconds / model.opt.timestep)):
        time = number * model.opt.timestep
        data.ctrl[:2] = force(time)
        data.qfrc_applied[:] = 0.0
        if time < free:
            data.qfrc_applied[dofs.start : dofs.start + 3] = -mass * model.opt.gravity
            drag = 2 * np.sqrt(500 * mass) * np.array([1, 1, 1, 1e-5, 1e-5, 1e-5])
            data.qfrc_applied[dofs] -= drag * data.qvel[dofs]
        watch(time)
        touch.step()
