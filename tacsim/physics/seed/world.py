"""The seed paper's scheme: gels and plasticine as particles on one shared MLS-MPM grid.

The simulation follows the paper; the quasi-static controller is that of the hybrid world. Properties of the scheme:
bodies stick to each other (no friction coefficient), contact begins across an air gap of about 1.5 grid cells, and a
gel has no housing. Sensors may move along and rotate about world z; they may not tilt.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tacsim.compute.runtime import launching, start_taichi
from tacsim.geometry.sampling import body_points
from tacsim.interface import Pose, Truth
from tacsim.models.material import BodyMaterial, GelMaterial, elastic_constants
from tacsim.models.scene import Gel, GelSurface, Scene
from tacsim.models.tuning import MAX_MACH
from tacsim.physics.body.material import UNREACHABLE_LIMIT
from tacsim.physics.exec.layout import NUMBERS
from tacsim.physics.failure.health import Health, LaunchSpan, SimulationDiverged, check_launch, require_grid_memory
from tacsim.physics.motion.controller import ForceReading, Integration, Launch, Motion, move_and_settle
from tacsim.physics.motion.load import move_at_constant_load, require_loads
from tacsim.physics.motion.path import Path, plan_path, resolve_targets
from tacsim.physics.move import MoveCommand
from tacsim.physics.seed.kernels import PAD, Solid, Step, advance
from tacsim.physics.seed.tuning import (
    BODY_ZETA,
    BODY_ZETA_ACROSS,
    CONTACT_REACH,
    COURANT,
    GEL_ZETA,
    GRID_MARGIN,
    GRID_OVERHANG,
    MAX_TILT,
    MIN_CELL_HEIGHT,
    MIN_SUBSTEPS,
    PARTICLES_PER_CELL_EDGE,
    READING_INTERVAL,
)
from tacsim.physics.snapshot import copy_arrays, restore_arrays
from tacsim.physics.units import MM, MPA
from tacsim.physics.worlds.base import BaseWorld

Float32 = NDArray[np.float32]

HALF_TURN = np.array([1.0, 0.0, 0.0, 0.0])  # quaternion of the upper sensor at yaw 0


@dataclass(frozen=True)
class Lattice:
    """Rest positions of a gel's particles in its sensor's frame: (nx, ny, nz) particles, z downwards from the surface
    [mm]."""

    count: tuple[int, int, int]
    spacing: float
    layer: float  # spacing along z, so that the layers fill the thickness

    @property
    def points(self) -> NDArray[np.float64]:
        nx, ny, nz = self.count
        x, y = (np.arange(nx) - (nx - 1) / 2) * self.spacing, (np.arange(ny) - (ny - 1) / 2) * self.spacing
        z = -(np.arange(nz) + 0.5) * self.layer
        return np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)


def gel_lattice(gel: Gel, spacing: float) -> Lattice:
    """The lattice nearest to the gel's size: the lateral error is at most half a spacing, the thickness is exact."""
    nx, ny, nz = (max(round(length / spacing), 1) for length in gel.size)
    return Lattice((nx, ny, nz), spacing * MM, gel.size[2] * MM / nz)


def solid_of_material(material: GelMaterial | BodyMaterial, volume: float) -> Any:
    """Kernel constants of a material for particles of `volume` [mm^3]; the density lambda + 2 mu gives wave speed 1."""
    mu, lam = (modulus * MPA for modulus in elastic_constants(material))
    limit = min(material.elastic_limit, UNREACHABLE_LIMIT) if isinstance(material, BodyMaterial) else UNREACHABLE_LIMIT
    mass = (lam + 2 * mu) * volume
    return Solid(mass=mass, volume=volume, mu=mu, lam=lam, limit=limit)  # type: ignore[call-arg]  # a Taichi dataclass


class SeedWorld(BaseWorld):
    """World of a scene for physics 'seed' (limits: see Scene). Raises RuntimeError on a device."""

    sensors = ("lower", "upper")

    def __init__(self, scene: Scene) -> None:
        assert scene.body is not None
        start_taichi(cpu_only="physics 'seed'")
        self.scene = scene
        self._mach = scene.peak_mach
        h = scene.spacing * MM
        self._dx, self._dt = PARTICLES_PER_CELL_EDGE * h, COURANT * PARTICLES_PER_CELL_EDGE * h
        self._lattice = gel_lattice(scene.gel, scene.spacing)
        self._gel = solid_of_material(scene.gel.material, h * h * self._lattice.layer)
        self._body = solid_of_material(scene.body.material, h**3)
        # force by rounding errors of F: one particle's area times the gel's modulus
        self._floor = scene.gel.material.youngs_modulus * MPA * h * h
        self._initialise(body_points(scene.body, scene.spacing) * MM)

    def _initialise(self, body: NDArray[np.float64]) -> None:
        """Stage 1 of the scheme: undeformed particles at rest, a clear gap between body and gels."""
        h, gap = self._lattice.spacing, CONTACT_REACH * self._dx
        body = body + [0.0, 0.0, gap + h / 2 - body[:, 2].min()]
        self._poses = {
            "lower": Pose(),
            "upper": Pose(np.array([0.0, 0.0, (body[:, 2].max() + h / 2 + gap) / MM]), HALF_TURN),
        }
        rest = self._lattice.points
        gels = [_rotation(p).apply(rest) + p.position * MM for p in self._poses.values()]
        self._gels = len(rest)
        self._x = np.concatenate([*gels, body])  # float64, see kernels
        n = len(self._x)
        self._v = np.zeros((n, 3), np.float32)
        self._c = np.zeros((n, 3, 3), np.float32)
        self._f = np.tile(np.eye(3, dtype=np.float32), (n, 1, 1))
        self._stress = np.zeros((n, 3, 3), np.float32)
        self._aside = np.zeros(n, np.int32)  # 1: has left the grid, and is left out
        self._motion = np.array([0, 0, 0, body[:, 2].min(), body[:, 2].max()], np.float32)  # see kernels
        self._momentum, self._gain = np.zeros((2, 3), np.float32), np.zeros((2, 3), np.float32)
        self._backing = np.zeros((2, 6), np.float32)
        room = (self._poses["upper"].position[2] + 2 * self.scene.gel.size[2]) * MM / self._dx
        # cells of the grid between the backings; their smallest height / dx since the last change of their number
        self._layers = np.array([round(room), room / round(room)], np.float32)
        self._grid = np.zeros((1, 1, 1, 4), np.float32)

    # ------------------------------------------------------------------ state

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {
            "position": self._x, "velocity": self._v, "velocity_gradient": self._c, "deformation_gradient": self._f,
            "stress": self._stress, "aside": self._aside, "body_motion": self._motion,
            "gel_momentum": self._momentum, "gel_gain": self._gain, "backing": self._backing, "layers": self._layers,
        }  # fmt: skip

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See World."""
        self._poses = restore_arrays(self.arrays(), self.sensors, state)

    def wrench(self, name: str) -> NDArray[np.float64]:
        """(6,) force and moment of the gel on its backing: that of the object on the gel, when the gel is at rest."""
        reaction = self._backing[self._sensor(name)].astype(np.float64)
        to_sensor = _rotation(self._poses[name]).inv()
        return np.concatenate([to_sensor.apply(reaction[:3]), to_sensor.apply(reaction[3:]) / MM])

    def place(self, poses: Mapping[str, Pose]) -> None:
        """See World. The gels' particles have positions in the world, so this is a motion."""
        self.move(poses)

    def surface(self, name: str) -> GelSurface:
        """Displacement of the top layer of particles, half a layer below the rest surface."""
        nx, ny, _ = self._lattice.count
        moved = (self._in_sensor(name) - self._lattice.points).reshape(nx, ny, -1, 3)[:, :, 0] / MM
        h = self.scene.spacing
        return GelSurface(moved.astype(np.float32), h, (-(nx - 1) / 2 * h, -(ny - 1) / 2 * h))

    def _in_sensor(self, name: str) -> NDArray[np.float64]:
        """Particles of a gel in its sensor's frame [mm]."""
        first, pose = self._sensor(name) * self._gels, self._poses[name]
        x: NDArray[np.float64] = self._x[first : first + self._gels] - pose.position * MM
        return x @ _rotation(pose).as_matrix()

    def truth(self) -> Truth:
        """See World. Particles that have left the grid are left out."""
        x = self._body_points()
        height = (float(np.ptp(x[:, 2])) + self._lattice.spacing) / MM
        return Truth(height, x.mean(axis=0) / MM, (x / MM).astype(np.float32), dict(self._poses))

    def _body_points(self) -> NDArray[np.float64]:
        body = slice(2 * self._gels, None)
        points: NDArray[np.float64] = self._x[body][self._aside[body] == 0]
        return points

    # ----------------------------------------------------------------- motion

    def _run_command(self, command: MoveCommand) -> Motion:
        """Raises ValueError for a tilted target, one that would crush the gels, a duration, and flow."""
        if command.duration is not None or command.flow:
            raise ValueError("physics 'seed' settles every motion: leave out duration and flow, or use 'hybrid'")
        end = resolve_targets(self._poses, command.targets)
        end.update((name, self._remove_tilt(name, end[name])) for name in command.targets)
        self._check_room(end)
        require_loads(command.loads, self.sensors)
        begin, goals = dict(self._poses), dict(end)

        def attempt(refine: int) -> Motion:
            if command.loads:
                end.update(goals)
                return move_at_constant_load(self, begin, end, command.loads, refine, balanced=True)
            path = replace(self.plan(list(begin.values()), list(end.values())), refine=refine)
            return move_and_settle(path, self.scene.settling, balanced=True)

        stats = yield from self._retry_smaller_steps(command, attempt)
        self._poses = end
        return stats

    def plan(self, start: Sequence[Pose], end: Sequence[Pose]) -> Path:
        """The path between two poses of all driven frames, at the scene's speed."""
        lever = self._lattice.spacing * max(self._lattice.count[:2]) / np.sqrt(2)
        path = plan_path(start, end, self._mach, self._dt, lever, self.scene.gel.size[2] * MM)
        substeps = max(path.substeps, MIN_SUBSTEPS) if path.substeps else 0
        return replace(path, substeps=substeps, interval=READING_INTERVAL)

    def _remove_tilt(self, name: str, pose: Pose) -> Pose:
        """`pose` without its tilt, of at most MAX_TILT: the scheme does not support tilt."""
        flip = Rotation.identity() if name == "lower" else Rotation.from_quat(HALF_TURN)
        turn = (Rotation.from_quat(pose.quaternion) * flip.inv()).as_matrix()
        tilt = float(np.arctan2(np.hypot(turn[0, 2], turn[1, 2]), turn[2, 2]))
        if tilt > MAX_TILT:
            raise ValueError(
                f"physics 'seed' cannot tilt a sensor: the target of '{name}' is tilted by {np.degrees(tilt):.3g} deg "
                f"(limit {np.degrees(MAX_TILT):.2g} deg); keep its z axis along world z, or use physics 'hybrid'"
            )
        yaw = Rotation.from_euler("z", np.arctan2(turn[1, 0], turn[0, 0]))
        return Pose(pose.position, (yaw * flip).as_quat())

    def _check_room(self, poses: Mapping[str, Pose]) -> None:
        thickness = self.scene.gel.size[2]
        room = float(poses["upper"].position[2] - poses["lower"].position[2])
        if room < -thickness:
            raise ValueError(
                f"the gels' rest surfaces would overlap by {-room * MM:.3g} mm, which leaves each gel less than half "
                f"of its {thickness * MM:.3g} mm; keep the upper at least {-thickness * MM:.3g} mm above the lower"
            )

    def _advance(self, launch: Launch) -> list[ForceReading]:
        path, first, last = launch.path, launch.first, launch.last
        aside = int(self._aside.sum())
        where = partial(launch.span, self.sensors)
        x0, y0 = self._fit_grid(path, first, last, where)

        numbers = np.zeros((1, NUMBERS), np.float32)
        Health.clear(numbers)
        drive, good = path.drive(first, last), copy_arrays(self.arrays())
        self._launch(drive, path.step, x0, y0, numbers[0])
        health = Health.read(numbers, path.step / self._smallest_cell(drive))
        check_launch(self.arrays, good, health, where)
        backing = self._backing[:, :3].astype(np.float64)
        left = int(self._aside.sum()) - aside
        if not len(self._body_points()):
            cause = "every particle of the body left the grid"
            raise SimulationDiverged(cause, where(), quantity="particle speed", good=good, failed=self.arrays())
        integration = Integration(path.step, GEL_ZETA, health.courant)
        overlap = self._overlap(path, last)
        return [ForceReading(backing + self._gain, backing, self._floor, overlap, left, integration=integration)]

    @launching()
    def _launch(self, drive: Float32, dt: float, x0: float, y0: float, health: Float32) -> None:
        thickness = self.scene.gel.size[2] * MM
        step = Step(  # type: ignore[call-arg]  # a Taichi dataclass
            dt=dt, dx=self._dx, x0=x0, y0=y0, thickness=thickness, reach=CONTACT_REACH * self._dx,
            cells=int(self._layers[0]), gel_damping=GEL_ZETA / thickness, body_damping=BODY_ZETA / thickness,
            lateral_damping=BODY_ZETA_ACROSS / thickness, gels=self._gels,
        )  # fmt: skip
        advance(
            self._x, self._v, self._c, self._f, self._stress, self._aside, self._grid, drive, self._motion,
            self._momentum, self._gain, self._backing, health, self._gel, self._body, step,
        )  # fmt: skip

    def _fit_grid(self, path: Path, first: int, last: int, where: Callable[[], LaunchSpan]) -> tuple[float, float]:
        """Fits the grid to all positions that particles can reach; returns x, y of node (0, 0), multiples of dx."""
        faces = path.drive(first, last)[:, :, 3, 2]
        gels, body = self._x[: 2 * self._gels, :2], self._body_points()[:, :2]
        low, high = gels.min(axis=0), gels.max(axis=0)
        side = GRID_OVERHANG * float((high - low).max())
        if len(body):
            low = np.minimum(low, np.maximum(body.min(axis=0), low - side))
            high = np.maximum(high, np.minimum(body.max(axis=0), high + side))
        margin = GRID_MARGIN * self._dx + 2 * max(self._mach, MAX_MACH) * (last - first) * self._dt
        room = [*(low - margin), faces.min()], [*(high + margin), faces.max()]
        require_grid_memory(np.array(room[0]), np.array(room[1]), self._dx, where)
        layers = self._fit_layers(faces)
        corner = np.floor((low - margin) / self._dx)
        nodes = np.ceil((high + margin) / self._dx) - corner + 1
        shape = (int(nodes[0]), int(nodes[1]), layers + 2 * PAD + 1)
        if self._grid.shape[:3] != shape:
            self._grid = np.zeros((*shape, 4), np.float32)
        return float(corner[0] * self._dx), float(corner[1] * self._dx)

    def _fit_layers(self, faces: Float32) -> int:
        """Cells of the grid between the backings, for a launch with sensor origins at heights `faces` (n, 2) [mm].

        While the sensors approach, the number of layers is kept and their height decreases (a change of the number
        moves nodes relative to the contact surfaces: a small jump of force). While they separate, layers are added: in
        a grid that stretches with the motion the body would stick to the gels, with nearly the force of the squeeze.
        """
        room = (faces[:, 1] - faces[:, 0] + 2 * self.scene.gel.size[2] * MM) / self._dx
        if room[-1] > room[0]:
            self._layers[0] = max(self._layers[0], round(float(room[-1] / self._layers[1])))
        elif room[-1] < room[0]:
            if room[-1] < MIN_CELL_HEIGHT * self._layers[0]:
                self._layers[:] = max(round(float(room[-1])), 1), 1.0
            self._layers[1] = min(self._layers[1], room[-1] / self._layers[0])
        return int(self._layers[0])

    def _smallest_cell(self, drive: Float32) -> float:
        """Shortest edge of a grid cell in a launch along `drive` [mm]: the grid is compressed with its contents."""
        room = float((drive[:, 1, 3, 2] - drive[:, 0, 3, 2]).min()) + 2 * self.scene.gel.size[2] * MM
        return min(self._dx, room / float(self._layers[0]))

    def _overlap(self, path: Path, last: int) -> float:
        """Largest depth of a body particle below the nearest column of a gel [mm]; surfaces are half a spacing outside
        of the particles."""
        nx, ny, nz = self._lattice.count
        frames = path.drive(last - 1, last)[0].astype(np.float64)
        body = self._body_points()
        deepest = 0.0
        for index, (rotation, origin) in enumerate((f[:3], f[3]) for f in frames):
            x = (body - origin) @ rotation
            gel = (self._x[index * self._gels : (index + 1) * self._gels : nz] - origin) @ rotation
            column = np.rint(x[:, :2] / self._lattice.spacing + (np.array([nx, ny]) - 1) / 2).astype(int)
            over = ((column >= 0) & (column < [nx, ny])).all(axis=1)
            top = gel[column[over, 0] * ny + column[over, 1], 2] + self._lattice.layer / 2
            gap = x[over, 2] - self._lattice.spacing / 2 - top
            deepest = max(deepest, -float(gap.min(initial=0.0)))
        return deepest


def _rotation(pose: Pose) -> Rotation:
    return Rotation.from_quat(pose.quaternion)
