"""The MuJoCo model of a cell, from primitives: table, object, pedestal, arms, grippers, cameras, lights."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from tacsim import pose as se3
from tacsim.geometry.mesh_file import load_mesh
from tacsim.geometry.shapes import rotated_bounding_size
from tacsim.interface import FloatArray, Pose
from tacsim.models.scene import Box, Cylinder, Mesh, Scene, Shape, Sphere
from tacsim.models.shape import Socket
from tacsim.sim.cell import tuning
from tacsim.sim.cell.description import ArmDescription, GripperDescription, ViewDescription
from tacsim.sim.cell.user_model import attach, find_flange
from tacsim.sim.engines.mujoco_module import load_mujoco

OBJECT, PEDESTAL, TABLE = "object", "pedestal", "table"
SIDES = {"left": -1.0, "right": 1.0}  # of the tool's x axis
# Axes of the pads' frames in the tool's, by side: z out of the gel, y towards the finger tips
PAD_AXES = {
    "left": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "right": np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]),
}
STOP_GAP = 1e-3  # of the stop of a finger behind its stroke [m]
DARK, LIGHT, GEL, OBJECT_COLOUR = (0.2, 0.2, 0.22, 1), (0.75, 0.77, 0.8, 1), (0.85, 0.9, 0.95, 1), (0.85, 0.45, 0.2, 1)


def make_spec(
    scene: Scene,
    arms: Mapping[str, ArmDescription],
    grippers: Mapping[str, GripperDescription],
    views: Mapping[str, ViewDescription],
) -> Any:
    """The MjSpec of a cell. Raises ValueError for a model of the user that lacks what is named of it, and what
    `load_mesh` raises."""
    mujoco = load_mujoco()
    spec = mujoco.MjSpec()
    spec.option.timestep = scene.timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.gravity = list(scene.gravity)
    spec.compiler.degree = False
    _add_table_and_lights(spec)
    for name, fixture in scene.fixtures.items():
        body = spec.worldbody.add_body(name=name, pos=list(fixture.position), quat=_quaternion(fixture.turn))
        if isinstance(fixture.geometry, Socket):
            for number, (centre, wall) in enumerate(fixture.geometry.walls()):
                _add_shape(spec, body, f"{name}/{number}", wall, friction=fixture.friction, colour=LIGHT, centre=centre)
        else:
            _add_shape(spec, body, name, fixture.geometry, friction=fixture.friction, colour=LIGHT)
    _add_object(spec, scene)
    for name, arm in arms.items():
        carried = {label: gripper for label, gripper in grippers.items() if gripper.arm == name}
        if arm.file is not None:
            attach(
                spec,
                arm,
                f"{name}/",
                [*arm.joints, *(joint for each in carried.values() for joint in each.joints or ())],
            )
            flange = None
        else:
            flange = _add_chain(spec, name, arm) if arm.links else _add_free_flange(spec, name)
        for label, gripper in carried.items():
            if gripper.joints is None:
                _add_gripper(spec, flange or find_flange(spec, name, arm), label, gripper, scene.gel.size)
                _add_gripper_link(spec, (f"{label}/left", f"{label}/right"))
            else:
                _add_gripper_link(spec, (f"{name}/{gripper.joints[0]}", f"{name}/{gripper.joints[1]}"))
    for name, view in views.items():
        _add_camera(spec, name, view)
        screen = spec.visual.global_  # large enough for all of them
        screen.offwidth, screen.offheight = max(screen.offwidth, view.size[0]), max(screen.offheight, view.size[1])
    return spec


def object_start(scene: Scene) -> Pose:
    """world_from_object at the start: on the table, or on its pedestal."""
    item = scene.object
    assert item is not None
    height = float(rotated_bounding_size(item.geometry, item.turn)[2])
    return Pose(np.array([*item.position, item.pedestal + height / 2]), item.turn)


def _add_table_and_lights(spec: Any) -> None:
    mujoco = load_mujoco()
    spec.worldbody.add_geom(
        name=TABLE, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1.0, 1.0, 0.05], rgba=[0.55, 0.5, 0.45, 1],
        friction=[0.0, 0.0, 0.0], **_stiff_contact(spec),
    )  # fmt: skip
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.85, 0.88, 0.92], rgb2=[0.55, 0.62, 0.7], width=64, height=64,
    )  # fmt: skip
    kind = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    for position, strength in (((0.6, -0.8, 1.5), 0.6), ((-0.8, 0.4, 1.2), 0.35)):
        spec.worldbody.add_light(
            type=kind, pos=list(position), dir=[-x for x in position], diffuse=[strength] * 3, castshadow=strength > 0.5
        )
    spec.visual.headlight.ambient = [0.35] * 3
    spec.visual.headlight.diffuse = [0.2] * 3


def _stiff_contact(spec: Any) -> dict[str, Any]:
    """Stiffness of a contact that is not a gel's: as hard as the step allows. With a time constant of 6 steps an object
    on four corners bounces for ever."""
    return {"solref": [max(8 * spec.option.timestep, 8e-3), 1.0], "solimp": [0.95, 0.99, 1e-4, 0.5, 2.0]}


def _add_object(spec: Any, scene: Scene) -> None:
    mujoco, item = load_mujoco(), scene.object
    assert item is not None
    start = object_start(scene)
    body = spec.worldbody.add_body(name=OBJECT, pos=start.position.tolist(), quat=_quaternion(start.quaternion))
    if item.guide is None:
        body.add_freejoint(name=OBJECT)
    else:
        along = np.eye(3)["xyz".index(item.guide.axis)]
        body.add_joint(
            name=OBJECT, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(se3.rotation_matrix(start).T @ along).tolist(),
            limited=True, range=[0.0, item.guide.travel], frictionloss=item.guide.friction,
            damping=item.guide.damping, solref_friction=[max(2 * spec.option.timestep, 4e-3), 1.0],
            solimp_friction=[0.99, 0.999, 1e-4, 0.5, 2.0],  # else what is light creeps below the friction
        )  # fmt: skip
    _add_shape(spec, body, OBJECT, item.geometry, mass=item.mass, friction=item.table_friction, colour=OBJECT_COLOUR)
    if item.pedestal > 0:
        foot = 0.4 * float(rotated_bounding_size(item.geometry, item.turn)[:2].min())
        spec.worldbody.add_geom(
            name=PEDESTAL, type=mujoco.mjtGeom.mjGEOM_BOX, size=[foot, foot, item.pedestal / 2],
            pos=[*item.position, item.pedestal / 2], rgba=LIGHT, friction=[0.0, 0.0, 0.0], **_stiff_contact(spec),
        )  # fmt: skip


def _add_shape(
    spec: Any, body: Any, name: str, geometry: Shape, *, friction: float, colour: tuple[float, ...], mass: float = 0.0,
    centre: FloatArray | None = None,
) -> None:  # fmt: skip
    kinds = load_mujoco().mjtGeom
    place = np.zeros(3) if centre is None else centre
    geom = body.add_geom(
        name=name, pos=place.tolist(), mass=mass, friction=[friction, 5e-3, 1e-4], rgba=colour, condim=4,
        **_stiff_contact(spec),
    )  # fmt: skip
    match geometry:
        case Box():
            geom.type, geom.size = kinds.mjGEOM_BOX, [side / 2 for side in geometry.size]
        case Sphere():
            geom.type, geom.size = kinds.mjGEOM_SPHERE, [geometry.radius, 0, 0]
        case Cylinder():
            geom.type, geom.size = kinds.mjGEOM_CYLINDER, [geometry.radius, geometry.height / 2, 0]
        case Mesh():
            mesh = load_mesh(geometry.path, geometry.scale, repair=geometry.repair)
            corners = np.asarray(mesh.vertices, np.float64)
            spec.add_mesh(
                name=name, uservert=corners.ravel().tolist(), userface=np.asarray(mesh.faces).ravel().tolist()
            )
            geom.type, geom.meshname = kinds.mjGEOM_MESH, name
            geom.pos = (-(corners.min(axis=0) + corners.max(axis=0)) / 2).tolist()


def _add_free_flange(spec: Any, name: str) -> Any:
    """A body so heavy that it goes exactly where its velocity is set to."""
    mujoco = load_mujoco()
    flange = spec.worldbody.add_body(
        name=f"{name}/flange", gravcomp=1.0, mass=tuning.HAND_MASS, inertia=[tuning.HAND_INERTIA] * 3,
        explicitinertial=True,
    )  # fmt: skip
    flange.add_freejoint(name=f"{name}/flange")
    _add_visual(flange, mujoco.mjtGeom.mjGEOM_CYLINDER, [0.03, 0.01, 0], [0, 0, 0.01], DARK)
    return flange


def _add_chain(spec: Any, name: str, arm: ArmDescription) -> Any:
    """The links of a serial arm, one in the other. Returns the flange."""
    mujoco = load_mujoco()
    base = arm.base
    body = spec.worldbody.add_body(
        name=f"{name}/base", pos=base.position.tolist(), quat=_quaternion(base.quaternion), gravcomp=1.0
    )
    _add_visual(body, mujoco.mjtGeom.mjGEOM_CYLINDER, [0.075, 0.02, 0], [0, 0, 0.02], DARK)
    position, turn = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
    for number, link in enumerate(arm.links):
        body = body.add_body(name=f"{name}/link{number + 1}", pos=position, quat=turn, gravcomp=1.0)
        body.add_joint(
            name=f"{name}/joint{number + 1}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], armature=arm.armature
        )
        length = max(max(math.dist(a, b) for a, b, _ in link.capsules), 0.05)
        radius = max(radius for _, _, radius in link.capsules)
        body.mass, body.ipos, body.explicitinertial = link.mass, list(link.centre), True
        lateral = link.mass * (length**2 / 12 + radius**2 / 4)  # a cylinder as long and thick as the link
        body.inertia = [lateral, lateral, lateral]
        for begin, end, thickness in link.capsules:
            geom = body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[*begin, *end], size=[thickness, 0, 0], mass=0,
                rgba=LIGHT, contype=0, conaffinity=0,
            )  # fmt: skip
            geom.group = 1
        position, turn = [link.a, 0.0, link.d], [math.cos(link.alpha / 2), math.sin(link.alpha / 2), 0.0, 0.0]
    return body.add_body(name=f"{name}/flange", pos=position, quat=turn, gravcomp=1.0)


def _add_gripper(
    spec: Any, flange: Any, name: str, gripper: GripperDescription, gel: tuple[float, float, float]
) -> None:
    mujoco = load_mujoco()
    box = mujoco.mjtGeom.mjGEOM_BOX
    width, height, thickness = gel[0] / 2, gel[1] / 2, gel[2] / 2
    palm = 0.5 * (gripper.length - 2 * height)
    body = flange.add_body(
        name=f"{name}/palm", gravcomp=1.0, mass=gripper.body_mass, ipos=[0, 0, palm / 2], explicitinertial=True,
        inertia=[gripper.body_mass * 0.04**2] * 3,
    )  # fmt: skip
    _add_visual(body, box, [gripper.stroke / 2 + 0.01, 0.025, palm / 2], [0, 0, palm / 2], DARK)
    body.add_site(name=f"{name}/tool", pos=[0, 0, gripper.length], size=[1e-3] * 3, rgba=[0, 0, 0, 0])
    for side, sign in SIDES.items():
        finger = body.add_body(
            name=f"{name}/{side}", pos=[0, 0, gripper.length], gravcomp=1.0, mass=gripper.finger_mass,
            ipos=[sign * 0.01, 0, 0], inertia=[gripper.finger_mass * 0.02**2] * 3, explicitinertial=True,
        )  # fmt: skip
        finger.add_joint(
            name=f"{name}/{side}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[sign, 0, 0], limited=True,
            range=[0.0, gripper.stroke / 2 + STOP_GAP], damping=gripper.finger_mass * tuning.FINGER_DAMPING_RATE,
        )  # fmt: skip
        finger.add_site(
            name=f"{name}/{side}_pad", quat=_quaternion(se3.from_matrix(_square(PAD_AXES[side])).quaternion),
            size=[1e-3] * 3, rgba=[0, 0, 0, 0],
        )  # fmt: skip
        _add_visual(finger, box, [thickness, width, height], [sign * thickness, 0, 0], GEL)
        back = 2 * thickness + 5e-3
        _add_visual(finger, box, [5e-3, width + 2e-3, height + 2e-3], [sign * back, 0, 0], DARK)
        rod = 0.5 * (gripper.length - palm - height)
        _add_visual(finger, box, [4e-3, width * 0.7, rod], [sign * back, 0, -height - rod], LIGHT)


def _add_gripper_link(spec: Any, joints: tuple[str, str]) -> None:
    """Fingers move alike. Else they slide with every turn of the arm, which its control does not expect."""
    mujoco = load_mujoco()
    link = spec.add_equality(
        type=mujoco.mjtEq.mjEQ_JOINT, name1=joints[0], name2=joints[1],
        objtype=mujoco.mjtObj.mjOBJ_JOINT, data=[0.0, 1.0] + [0.0] * 10,
    )  # fmt: skip
    link.solref = [max(2 * spec.option.timestep, 4e-3), 1.0]


def _add_visual(body: Any, kind: Any, size: list[float], position: list[float], colour: tuple[float, ...]) -> None:
    """A geom that is seen and touches nothing."""
    geom = body.add_geom(type=kind, size=size, pos=position, rgba=colour, mass=0, contype=0, conaffinity=0)
    geom.group = 1


def _add_camera(spec: Any, name: str, view: ViewDescription) -> None:
    position, target = np.array(view.position), np.array(view.target)
    back = (position - target) / np.linalg.norm(position - target)
    above = np.array([0.0, 0.0, 1.0]) if abs(back[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    right = np.cross(above, back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back], axis=1)
    spec.worldbody.add_camera(
        name=name, pos=position.tolist(), quat=_quaternion(se3.from_matrix(_square(axes)).quaternion),
        fovy=math.degrees(view.field_of_view),
    )  # fmt: skip


def _square(axes: FloatArray) -> FloatArray:
    """(4, 4) of a rotation (3, 3)."""
    frame = np.eye(4)
    frame[:3, :3] = axes
    return frame


def _quaternion(quaternion: FloatArray) -> list[float]:
    """As MuJoCo writes it: w, x, y, z."""
    x, y, z, w = (float(each) for each in quaternion)
    return [w, x, y, z]
