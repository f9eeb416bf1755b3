"""Give a gripper in a MuJoCo scene two tactile pads, lift a box with it, and read what the pads feel.

python examples/grasp_in_mujoco.py        (needs the extra: pip install 'tacsim[mujoco]')
"""

from __future__ import annotations

import sys

import mujoco
import numpy as np

from tacsim import TouchSensor, load_sensor

FORCE, MASS, LIFT = 3.0, 0.08, 0.02  # of the grip [N], of the box [kg], upwards [m]
FINGER = """<body name="{name}" pos="{x} 0 0"><joint name="{name}" type="slide" axis="{axis} 0 0" damping="5"/>
  <geom type="box" size=".004 .012 .012" pos="{back} 0 0" mass=".1" contype="0" conaffinity="0"/>
  <site name="{name}" quat=".7071068 0 {turn} 0"/></body>"""
FINGERS = FINGER.format(name="left", x=-0.0105, axis=1, back=-0.008, turn=0.7071068) + FINGER.format(
    name="right", x=0.0105, axis=-1, back=0.008, turn=-0.7071068
)
SCENE = f"""<mujoco><option timestep=".001" integrator="implicitfast"/><worldbody>
  <geom name="table" type="plane" size=".2 .2 .01"/>
  <body name="gripper" pos="0 0 .015"><joint name="lift" type="slide" axis="0 0 1"/>
    <geom type="box" size=".03 .012 .008" pos="0 0 .045" mass=".5" contype="0" conaffinity="0"/>{FINGERS}</body>
  <body name="box" pos="0 0 .015"><freejoint/><geom type="box" size=".01 .006 .015" mass="{MASS}" friction=".6"/></body>
  </worldbody><equality><joint joint1="left" joint2="right" polycoef="0 1 0 0 0"/></equality>
  <actuator><motor name="left" joint="left"/><motor name="right" joint="right"/>
    <position name="lift" joint="lift" kp="20000" kv="300"/></actuator></mujoco>"""


def main() -> None:
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    touch = TouchSensor(model, data, sites=("left", "right"), objects="box", sensor=load_sensor("gelsight-mini"))
    for step in range(600):
        seconds = step * model.opt.timestep
        data.ctrl[:2] = FORCE * min(1.0, seconds / 0.1)
        data.ctrl[2] = LIFT * np.clip((seconds - 0.2) / 0.2, 0.0, 1.0)
        touch.step()  # in place of mujoco.mj_step(model, data)

    touch.require_held()
    left, right = -touch.wrenches[:, 2]  # z of a site points out of its gel
    weight, drag = MASS * 9.81, -touch.world_forces[:, 2].sum()
    print(f"grip {left:.3f} and {right:.3f} N; shear of both pads {drag:.4f} N, weight {weight:.4f} N")
    print(f"friction in use {touch.slip_share('left'):.0%}; deepest {-touch.surface('left').displacement.min():.2g} m")
    print(f"picture of the left pad: {touch.picture('left').shape}")
    height = data.body("box").xpos[2]
    if abs(drag / weight - 1) > 0.001 or abs(height - 0.015 - LIFT) > 0.5e-3:
        sys.exit(f"the shear is {drag:.4f} N for a weight of {weight:.4f} N, and the box is at {height:.4f} m")


if __name__ == "__main__":
    main()
