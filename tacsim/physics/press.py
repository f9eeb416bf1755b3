"""A rigid indenter pressed, slid or twisted on one gel: no particles, no grid."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from tacsim.interface import Pose
from tacsim.physics.controller import Motion, Path, Reading, force_floor, merged, move_and_settle, plan, run
from tacsim.physics.gel import MM, MPA, Nodes, gel_advance, gel_facts, gel_forces, gel_state, gel_surface
from tacsim.physics.health import Health, as_float32, attempt, retried
from tacsim.physics.hybrid import COURANT, GEL_DAMPING, Array1, Array3, row
from tacsim.physics.indenter import BOX, CYLINDER, GRID, POINTS, SPHERE, indent
from tacsim.physics.load import keep_loads, require_loads
from tacsim.physics.material import vec3
from tacsim.physics.world import MoveStats, put_back, taken
from tacsim.runtime import start, ti
from tacsim.scene import Box, Cylinder, GelSurface, Scene, Sphere
from tacsim.shapes import distance_grid, extent

CLEARANCE = 0.1e-3  # gap between gel and indenter at construction [m]
GRID_SPACING = 0.1e-3  # of a mesh's distance grid [m]
REACH = 3e-3  # of a mesh's distance grid, up from its tip [m]

Array2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
Array4 = ti.types.ndarray(dtype=ti.f32, ndim=4)
Slip = ti.types.ndarray(dtype=vec3, ndim=2)


@ti.kernel
def press_substeps(
    n: ti.i32, dt: ti.f32, drive: Array4,
    u: Nodes, gv: Nodes, gf: Nodes, h: ti.f32, mu: ti.f32, lam: ti.f32, damping: ti.f32,
    slip: Slip, pressure: Array2, kind: ti.i32, sx: ti.f32, sy: ti.f32, sz: ti.f32,
    values: Array3, ox: ti.f32, oy: ti.f32, oz: ti.f32, spacing: ti.f32, k_n: ti.f32, friction: ti.f32,
    wrench: Array3, backing: Array2, health: Array1,
):  # fmt: skip
    """n explicit substeps in one launch; drive: pose and velocity of the indenter in the sensor frame."""
    ti.loop_config(serialize=True)
    for it in range(n):
        health[5] = 0.0
        rotate = ti.Matrix.rows([row(drive, it, 0, 0), row(drive, it, 0, 1), row(drive, it, 0, 2)])
        force, moment = indent(
            u, gv, gf, h, slip, pressure, kind, vec3(sx, sy, sz), values, vec3(ox, oy, oz), spacing,
            rotate, row(drive, it, 0, 3), row(drive, it, 0, 4), row(drive, it, 0, 5), k_n, friction, dt, health,
        )  # fmt: skip
        gel_forces(0, u, gf, h, mu, lam, health)
        held = gel_advance(0, u, gv, gf, h, lam + 2.0 * mu, damping, dt)
        for d in ti.static(range(3)):
            wrench[0, 0, d] = force[d]
            wrench[0, 1, d] = moment[d]
            backing[0, d] = held[d]


def relative_drive(sensor: np.ndarray, indenter: np.ndarray) -> np.ndarray:
    """The indenter's motion in the frame of the moving sensor, (n, 1, 6, 3), from both motions in world (n, 6, 3)."""
    s, i = sensor.astype(np.float64), indenter.astype(np.float64)
    back = np.swapaxes(s[:, :3], 1, 2)
    arm = i[:, 3] - s[:, 3]
    out = np.empty((len(s), 1, 6, 3))
    out[:, 0, :3] = back @ i[:, :3]
    out[:, 0, 3] = np.einsum("nij,nj->ni", back, arm)
    out[:, 0, 4] = np.einsum("nij,nj->ni", back, i[:, 4] - s[:, 4] - np.cross(s[:, 5], arm))
    out[:, 0, 5] = np.einsum("nij,nj->ni", back, i[:, 5] - s[:, 5])
    return np.ascontiguousarray(out, np.float32)


class PressWorld:
    """World of a scene with an indenter: the `lower` gel, and the `indenter` above it."""

    sensors: tuple[str, ...] = ("lower",)

    def __init__(self, scene: Scene) -> None:
        assert scene.indenter is not None
        start()
        self.scene = scene
        self._gel = gel_facts(scene.gel, scene.element)
        self._gels = gel_state(self._gel, 1)
        nx, ny, _ = self._gel.elements
        self._slip = np.zeros((nx * POINTS, ny * POINTS, 3), np.float32)
        self._pressure = np.zeros((nx * POINTS, ny * POINTS), np.float32)  # multiplier of the normal contact [MPa]
        self._wrench = np.zeros((1, 2, 3), np.float32)
        self._backing = np.zeros((1, 3), np.float32)
        self._dt = COURANT * self._gel.spacing
        self._floor = force_floor(scene.gel.material.youngs_modulus * MPA, self._gel.thickness)
        self._stiffness = self._gel.density * self._gel.spacing / (2 * self._dt**2)
        self._kind, self._size, self._values, self._origin, self._spacing = _distance_facts(scene)
        height = float(extent(scene.indenter.geometry)[2])
        turned = np.array([0.0, 0.0, np.sin(scene.indenter.yaw / 2), np.cos(scene.indenter.yaw / 2)])
        self._poses = {"lower": Pose(), "indenter": Pose(np.array([0.0, 0.0, height / 2 + CLEARANCE]), turned)}
        as_float32(list(self._arrays().values()))

    def _arrays(self) -> dict[str, np.ndarray]:
        return {
            "gel_displacement": self._gels.u, "gel_velocity": self._gels.v, "gel_force": self._gels.f,
            "slip": self._slip, "pressure": self._pressure, "wrench": self._wrench, "backing": self._backing,
        }  # fmt: skip

    def snapshot(self) -> dict[str, np.ndarray]:
        return taken(self._arrays(), self._poses)

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        self._poses = put_back(self._arrays(), list(self._poses), state)

    def pose(self, name: str) -> Pose:
        return self._poses[name]

    def wrench(self, name: str) -> np.ndarray:
        force, moment = self._wrench[self.sensors.index(name)].astype(np.float64)
        return np.concatenate([force, moment / MM])

    def surface(self, name: str) -> GelSurface:
        return gel_surface(self._gel, self._gels, self.sensors.index(name))

    def truth(self) -> None:
        return None

    def move(self, targets: Mapping[str, Pose], loads: Mapping[str, float] | None = None) -> MoveStats:
        return run(self.motion(targets, loads), self._advance)

    def motion(self, targets: Mapping[str, Pose], loads: Mapping[str, float] | None = None) -> Motion:
        """`move`, a launch at a time."""
        end = merged(self._poses, targets)
        require_loads(loads or {}, self.sensors)
        begin, goals = dict(self._poses), dict(end)

        def tried(refine: int) -> Motion:
            if loads:
                end.update(goals)
                return keep_loads(self, begin, end, loads, refine, balanced=False)
            path = replace(self.plan(list(begin.values()), list(end.values())), refine=refine)
            return move_and_settle(path, self.scene.settling, balanced=False)

        stats = yield from retried(self, targets, tried)
        self._poses = end
        return stats

    def plan(self, start: Sequence[Pose], end: Sequence[Pose]) -> Path:
        """The path between two poses of all driven frames, at the scene's speed."""
        return plan(start, end, self.scene.settling.mach, self._dt, max(self._gel.half), self._gel.thickness)

    def _advance(self, path: Path, first: int, last: int) -> Reading:
        assert self.scene.indenter is not None
        friction = self.scene.indenter.friction

        def launch() -> Health:
            both = path.drive(first, last)
            drive = relative_drive(both[:, 0], both[:, 1])
            g, gel, health = self._gels, self._gel, Health.array()
            press_substeps(
                len(drive), path.step, drive,
                g.u, g.v, g.f, gel.spacing, gel.mu, gel.lam, GEL_DAMPING / gel.thickness,
                self._slip, self._pressure, self._kind, *self._size,
                self._values, *self._origin, self._spacing, self._stiffness, friction,
                self._wrench, self._backing, health,
            )  # fmt: skip
            return Health.read(health)

        health = attempt(self._arrays(), launch, path.place(self._poses, first, last))
        return Reading(
            self._wrench[:, 0].astype(np.float64),
            self._backing.astype(np.float64),
            self._floor,
            health.overlap,
            health.capped,
            self._wrench[:, 1].astype(np.float64) / max(self._gel.half),
        )


def _distance_facts(scene: Scene) -> tuple[int, tuple[float, ...], np.ndarray, tuple[float, ...], float]:
    """Kind, size [mm], distance values [mm], and their origin and spacing [mm]; a mesh is sampled near its tip."""
    assert scene.indenter is not None
    geometry = scene.indenter.geometry
    empty = np.zeros((2, 2, 2), np.float32)
    match geometry:
        case Sphere():
            return SPHERE, (geometry.radius * MM, 0.0, 0.0), empty, (0.0, 0.0, 0.0), 1.0
        case Cylinder():
            return CYLINDER, (geometry.radius * MM, 0.0, geometry.height / 2 * MM), empty, (0.0, 0.0, 0.0), 1.0
        case Box():
            return BOX, tuple(side / 2 * MM for side in geometry.size), empty, (0.0, 0.0, 0.0), 1.0
    half = extent(geometry) / 2
    reach = 2 * GRID_SPACING + np.minimum(half, np.array(scene.gel.size) / 2)
    top = min(half[2] + 2 * GRID_SPACING, -half[2] + REACH + scene.gel.size[2] / 2)
    grid = distance_grid(
        geometry, GRID_SPACING, ([-reach[0], -reach[1], -half[2] - 2 * GRID_SPACING], [reach[0], reach[1], top])
    )
    values = np.ascontiguousarray(grid.values * np.float32(MM))
    return GRID, (0.0, 0.0, 0.0), values, tuple(float(o) * MM for o in grid.origin), grid.spacing * MM
