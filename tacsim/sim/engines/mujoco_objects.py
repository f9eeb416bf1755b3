"""Objects and pads in a MuJoCo model: found by name, and described as the gels need them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim.geometry.mesh_file import load_mesh
from tacsim.interface import FloatArray
from tacsim.models.material import elastic_constants
from tacsim.models.scene import Box, Cylinder, Gel, Mesh, Shape, Sphere
from tacsim.models.text import millimetres
from tacsim.physics.pads.tuning import PATCH_NORMAL_SHARE
from tacsim.sim.engines.mujoco_module import load_mujoco

SIZE_TOLERANCE = 1e-6  # [m] by which sizes may differ
MESH_TOLERANCE = 1e-5  # [m] by which corners of a mesh may differ: MuJoCo keeps them in single precision
# Timestep times the frequency of a finger on its gel: at 6 all grips of docs/mujoco.md hold, at 9 boxes are thrown off
MAX_STEP_PHASE = 6.3
MIN_MASS = 1e-6  # [kg] of an object that can move


@dataclass(frozen=True, slots=True, eq=False)
class MujocoObject:
    """A rigid object that pads touch: one geom of a MuJoCo model."""

    name: str
    geom: int
    body: int
    geometry: Shape
    friction: float  # [-]
    place: FloatArray  # (3,) of the shape's frame in the geom's [m]
    turn: FloatArray  # (3, 3) its axes there

    def pose(self, data: Any) -> tuple[FloatArray, FloatArray]:
        """Position (3,) [m] and axes (3, 3) of the shape's frame in world."""
        axes = data.geom_xmat[self.geom].reshape(3, 3)
        return data.geom_xpos[self.geom] + axes @ self.place, axes @ self.turn


def find_site(model: Any, name: str) -> int:
    """The number of a pad's site. Raises ValueError with the sites that there are."""
    mujoco = load_mujoco()
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
    if site < 0:
        raise ValueError(
            f"pad '{name}': the model has no site of that name, only {_names(model, 'SITE', model.nsite)}; add <site "
            f'name="{name}"> at the middle of the gel\'s surface, its z axis out of the gel towards the object'
        )
    return int(site)


def find_object(model: Any, name: str, geometry: Shape | None, friction: float | None) -> MujocoObject:
    """The object of a geom, or of a body with one geom.

    geometry: as the gels have it; None: as in the model, for a sphere, box or cylinder. friction: against the
    gels; None: the geom's sliding friction. Raises ValueError where there is no such object, where both descriptions
    differ, and for a mass of 0.
    """
    geom = _find_geom(model, name)
    body = int(model.geom_bodyid[geom])
    _require_mass(model, name, body)
    place, turn = np.zeros(3), np.eye(3)
    if isinstance(geometry, Mesh):
        place, turn = _fit_mesh(model, name, geom, geometry)
    else:
        described = _shape_of(model, name, geom)
        geometry = described if geometry is None else geometry
        _require_same(name, described, geometry)
    friction = float(model.geom_friction[geom, 0]) if friction is None else friction
    return MujocoObject(name, geom, body, geometry, friction, place, turn)


def _names(model: Any, kind: str, count: int) -> str:
    mujoco = load_mujoco()
    code = getattr(mujoco.mjtObj, f"mjOBJ_{kind}")
    found = [name for i in range(count) if (name := mujoco.mj_id2name(model, code, i))]
    return ", ".join(f"'{name}'" for name in found[:20]) + (" ..." if len(found) > 20 else "") if found else "none"


def _find_geom(model: Any, name: str) -> int:
    mujoco = load_mujoco()
    geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body >= 0 and model.body_geomnum[body] == 1:
        return int(model.body_geomadr[body])
    if geom >= 0:
        return int(geom)
    if body >= 0:
        first, number = int(model.body_geomadr[body]), int(model.body_geomnum[body])
        named = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, first + i) for i in range(number)]
        which = ", ".join(f"'{each}'" for each in named if each) or "none with a name"
        raise ValueError(f"object '{name}': this body has {number} geoms; name the one that the pads touch: {which}")
    raise ValueError(
        f"object '{name}': the model has no geom or body of that name; bodies are "
        f"{_names(model, 'BODY', model.nbody)}, geoms {_names(model, 'GEOM', model.ngeom)}"
    )


def _require_mass(model: Any, name: str, body: int) -> None:
    root = int(model.body_weldid[body])
    mass = float(model.body_subtreemass[root])
    if root and mass < MIN_MASS:
        raise ValueError(f"object '{name}' can move and has a mass of {mass:g} kg: give it one of {MIN_MASS:g} or more")


def _shape_of(model: Any, name: str, geom: int) -> Box | Sphere | Cylinder:
    kinds = load_mujoco().mjtGeom
    kind, (x, y, z) = int(model.geom_type[geom]), (float(side) for side in model.geom_size[geom])
    if kind == kinds.mjGEOM_BOX:
        return Box(size=(2 * x, 2 * y, 2 * z))
    if kind == kinds.mjGEOM_SPHERE:
        return Sphere(radius=x)
    if kind == kinds.mjGEOM_CYLINDER:
        return Cylinder(radius=x, height=2 * y)
    if kind == kinds.mjGEOM_MESH:
        raise ValueError(
            f"object '{name}' is a mesh: give its file to the gels too, as geometry={{'{name}': Mesh(path=...)}}"
        )
    raise ValueError(
        f"object '{name}' is a {kinds(kind).name.removeprefix('mjGEOM_').lower()}; gels know box, sphere, cylinder and "
        f"mesh: use one of these"
    )


def _require_same(name: str, in_mujoco: Shape, in_gel: Shape) -> None:
    sizes = [_sizes(shape) for shape in (in_mujoco, in_gel)]
    if in_mujoco.shape != in_gel.shape or np.abs(np.subtract(sizes[0], sizes[1])).max() > SIZE_TOLERANCE:
        words = [
            f"a {shape.shape} of {' x '.join(millimetres(side) for side in sides)}"
            for shape, sides in zip((in_mujoco, in_gel), sizes, strict=True)
        ]
        raise ValueError(
            f"object '{name}' is {words[0]} in MuJoCo and {words[1]} for the gels: give both the same, or leave out "
            f"its geometry, which is then taken from the model"
        )


def _sizes(shape: Shape) -> tuple[float, ...]:
    match shape:
        case Box():
            return shape.size
        case Sphere():
            return (shape.radius,)
        case Cylinder():
            return (shape.radius, shape.height)
    return ()


def _fit_mesh(model: Any, name: str, geom: int, geometry: Mesh) -> tuple[FloatArray, FloatArray]:
    """Place and axes of the file's centred frame in the frame of a mesh geom, which MuJoCo puts at the mesh's centre
    of mass, along its principal axes. Raises ValueError for another geom or mesh."""
    mujoco = load_mujoco()
    if int(model.geom_type[geom]) != int(mujoco.mjtGeom.mjGEOM_MESH):
        raise ValueError(
            f"object '{name}' is a mesh for the gels ({geometry.path}) but not in MuJoCo: give the geom the same mesh"
        )
    number = int(model.geom_dataid[geom])
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[number])
    axes, first = turn.reshape(3, 3), int(model.mesh_vertadr[number])
    stored = model.mesh_vert[first : first + int(model.mesh_vertnum[number])].astype(np.float64)
    in_file = stored @ axes.T + model.mesh_pos[number]
    mesh = load_mesh(geometry.path, geometry.scale, repair=geometry.repair)
    corners: NDArray[Any] = np.asarray(mesh.vertices, np.float64)
    ours, theirs = ((each.min(axis=0), each.max(axis=0)) for each in (corners, in_file))
    error = float(np.abs(np.subtract(ours, theirs)).max())
    if error > MESH_TOLERANCE:
        sides = [" x ".join(f"{side * 1e3:.4g}" for side in high - low) for low, high in (theirs, ours)]
        raise ValueError(
            f"object '{name}': its mesh is {sides[0]} mm in MuJoCo and {sides[1]} mm in {geometry.path}, and their "
            f"corners are up to {error * 1e3:.3g} mm apart: use the same file, and the same scale, in both"
        )
    centre = (ours[0] + ours[1]) / 2
    return axes.T @ (centre - model.mesh_pos[number]), axes.T


def require_no_contact(model: Any, data: Any, pad: str, site: int, item: MujocoObject, gel: Gel) -> None:
    """Raises ValueError if MuJoCo lets a geom of the pad's body touch the object where the gel is.

    The frames of `data` must be computed.
    """
    mujoco = load_mujoco()
    body, axes = int(model.site_bodyid[site]), data.site_xmat[site].reshape(3, 3)
    if body == item.body:
        raise ValueError(f"pad '{pad}' is on the body of its own object '{item.name}': put the site on a finger")
    out, middle = axes[:, 2].copy(), data.site_xpos[site]
    start = gel.size[2]
    for geom in range(int(model.body_geomadr[body]), int(model.body_geomadr[body] + model.body_geomnum[body])):
        kind = int(model.geom_type[geom])
        if kind == int(mujoco.mjtGeom.mjGEOM_MESH) or not _can_touch(model, geom, item.geom):
            continue
        place, turn, size = data.geom_xpos[geom].copy(), data.geom_xmat[geom].copy(), model.geom_size[geom].copy()
        depth = mujoco.mju_rayGeom(place, turn, size, middle + start * out, -out, kind) - start
        if -start <= depth < start:
            name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or f"number {geom}"
            side = "below" if depth > -1e-9 else "above"
            raise ValueError(
                f"pad '{pad}': geom '{name}' of its body lies {abs(depth) * 1e3:.2f} mm {side} the gel's surface, and "
                f'MuJoCo would push \'{item.name}\' with it as well: set contype="0" conaffinity="0" for it, or '
                f"<exclude> both bodies"
            )


def _can_touch(model: Any, geom: int, other: int) -> bool:
    first, second = (int(model.geom_bodyid[each]) for each in (geom, other))
    signature = (min(first, second) << 16) + max(first, second)
    if signature in set(np.asarray(model.exclude_signature).tolist()):
        return False
    types, affinities = model.geom_contype, model.geom_conaffinity
    return bool((types[geom] & affinities[other]) or (types[other] & affinities[geom]))


def require_stable_step(model: Any, data: Any, pad: str, site: int, item: MujocoObject, gel: Gel) -> None:
    """Raises ValueError for a step that is too long for the gel's stiffness and the mass of the pad, or of an object
    that meets a pad which cannot move. A first touch is not foreseen: within a step the gel then pushes as a spring of
    its whole face.

    The frames of `data` must be computed.
    """
    mujoco = load_mujoco()
    mu, lam = elastic_constants(gel.material)
    stiffness = PATCH_NORMAL_SHARE * (lam + 2 * mu) * gel.size[0] * gel.size[1] / gel.size[2]
    out, inverse = data.site_xmat[site].reshape(3, 3)[:, 2], 0.0
    for body in (int(model.site_bodyid[site]), item.body):
        if inverse == 0.0:
            along = np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, along, None, data.site_xpos[site].copy(), body)
            direction, solved = (out @ along)[None], np.zeros((1, model.nv))
            mujoco.mj_solveM(model, data, solved, np.ascontiguousarray(direction))
            inverse = float((direction @ solved.T)[0, 0])
    if inverse == 0.0:
        return
    longest, step = MAX_STEP_PHASE / math.sqrt(stiffness * inverse), float(model.opt.timestep)
    if step > longest:
        raise ValueError(
            f"a timestep of {step:g} s is too long for pad '{pad}', whose gel pushes with {stiffness / 1e3:.3g} N/mm "
            f"on a mass of {1 / inverse:.3g} kg; set a timestep of at most {float(f'{longest:.2g}'):g} s, or make the "
            f"finger heavier or the gel softer"
        )
