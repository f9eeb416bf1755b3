"""A rigid indenter pressed, slid or twisted on one gel: no particles, no grid."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from tacsim.geometry.shapes import depth_below_centre, edge_points, edge_radius, farthest_point
from tacsim.interface import Pose
from tacsim.models.scene import GelSurface, Mesh, Scene
from tacsim.physics.contact.indenter import POINTS, SPLINE_SMOOTHING
from tacsim.physics.contact.tuning import FORCE_MEMORY_RATE, RIM_STIFFNESS, SURFACE_SMOOTHING
from tacsim.physics.exec.layout import (
    BACKING,
    FORCE,
    FRICTION,
    GEL_DAMPING,
    LIMIT_FOLLOWS,
    MEMORY,
    STEP,
    STIFFNESS,
)  # fmt: skip
from tacsim.physics.failure.health import Health, SimulationDiverged, check_launch
from tacsim.physics.gel.gel import GelParams
from tacsim.physics.motion.controller import ForceReading, Integration, Launch, PreparedLaunch, force_floor
from tacsim.physics.motion.inertia import Inertia, kernel_second
from tacsim.physics.motion.path import Path, path_along, path_length, plan
from tacsim.physics.motion.slide import Slide, growth, pace, slower_walls, turn
from tacsim.physics.motion.tuning import SHORT_SLIDE, SLOWED_WALL_LENGTH
from tacsim.physics.units import MM, MPA
from tacsim.physics.worlds.fem import FemWorld
from tacsim.physics.worlds.press_state import PressState
from tacsim.physics.worlds.tuning import (
    FLUTTER_FRICTION,
    INITIAL_GAP,
    MAX_BULGE,
    MAX_DIP,
    MAX_LIMIT_RATE,
    MESH_MARGIN,
    PRESS_COURANT,
    PRESS_ZETA,
    PRESS_ZETA_BY_SHEAR,
    SHORT_INDENTING_SLIDE,
    TURNING_ZETA_SHARE,
)
from tacsim.pose import inverse, relative_pose, rotate

TOO_MUCH = "cut off parts of mesh and gel that cannot touch; worlds of a smaller batch have more room each"


def contact_stiffness(gel: GelParams, step: float) -> float:
    """Of a contact point [MPa/mm]: that of a half-space to the shortest wave of pressure that the points can carry, but
    no more than the mass of the surface's nodes allows in a `step` [mm]."""
    mu, lam = gel.mu, gel.lam
    half_space = (2 * math.pi * POINTS / gel.spacing) * 2 * mu * (lam + mu) / (lam + 2 * mu)  # k E / (2 (1 - nu^2))
    return min(half_space, gel.density * gel.spacing / (2 * step**2))


def sharpened(nodes: np.ndarray, share: float) -> np.ndarray:
    """(nx, ny, 3) less `share` of their second differences along either axis; beyond the rim they repeat."""
    out = np.asarray(nodes, np.float64)
    for axis in (0, 1):
        padded = np.pad(out, [(int(d == axis),) * 2 for d in range(3)], mode="edge")
        out = out - share * np.diff(padded, 2, axis=axis)
    return out.astype(np.float32)


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


class PressWorld(FemWorld):
    """World of a scene with an indenter: the `lower` gel, and the `indenter` above it."""

    sensors = ("lower",)
    balanced = False
    yields = False
    unfelt = 0.0  # share of the indenter's depth in the untouched gel that no contact point feels, when last at rest

    def __init__(self, scene: Scene, state: PressState | None = None, index: int = 0) -> None:
        """The environment of scene number `index` in a `state` of several; or one alone in a state of its own."""
        assert scene.indenter is not None
        self.scene = scene
        self._state: PressState = PressState([scene]) if state is None else state
        self._index = index
        self._gel = self._state.gel[index]
        self._gels = (self._gel,)
        step = PRESS_COURANT * self._gel.spacing
        self._shear = math.sqrt(self._gel.mu / self._gel.density)  # speed of its shear wave, over that of pressure
        zeta = min(PRESS_ZETA, PRESS_ZETA_BY_SHEAR * self._shear)
        self._scaled = Inertia({GEL_DAMPING: zeta / self._gel.thickness, MEMORY: FORCE_MEMORY_RATE}, step)
        self._true = Inertia(
            {GEL_DAMPING: 0.0, MEMORY: 0.0}, step, kernel_second(self._gel, scene.gel.material.density)
        )
        self._floor = force_floor(scene.gel.material.youngs_modulus * MPA, self._gel.thickness)
        params = {
            **self._gel.params(), STIFFNESS: contact_stiffness(self._gel, step),
            FRICTION: scene.indenter.friction,
        }  # fmt: skip
        self._state.params[index, list(params)] = list(params.values())
        self._use_inertia(self._scaled)
        self._rates = np.zeros((2, 6))
        # where the indenter was over the gel when it last did not touch it, and how far it has been slid since [mm]
        self._touched = np.zeros(3)
        self._edges = edge_points(scene.indenter.geometry, scene.effective_element_size)
        turned = scene.indenter.turn
        above = self.below(turned) + INITIAL_GAP
        self._poses = {"lower": Pose(), "indenter": Pose(np.array([0.0, 0.0, above]), turned)}

    def _stop(self) -> None:
        self._state.gels.clear(self._index, velocity_only=True)

    def surface(self, name: str) -> GelSurface:
        """The surface that its contact points lie on, which smooths the nodes less than their spline does."""
        of_nodes = super().surface(name)
        return replace(of_nodes, displacement=sharpened(of_nodes.displacement, SPLINE_SMOOTHING - SURFACE_SMOOTHING))

    def reach(self) -> np.ndarray:
        """How far from the indenter the surface is still pressed [m], at its nodes (nx + 1, ny + 1)."""
        stiffness = float(self._state.params[self._index, STIFFNESS])
        return np.asarray(self._state.gels.alike.carried[self._index, 0] / (RIM_STIFFNESS * stiffness * MM))

    def arrays(self) -> dict[str, np.ndarray]:
        state, i = self._state, self._index
        return {
            **state.gels.arrays(i), "anchor": state.anchor[i],
            "pressure": state.pressure[i], "carried": state.gels.alike.carried[i, 0], "sums": state.partial[i],
        }  # fmt: skip

    def truth(self) -> None:
        return None

    def _scalars(self) -> dict[str, np.ndarray]:
        return {**super()._scalars(), "touched": self._touched}

    def plan(self, start: Sequence[Pose], end: Sequence[Pose]) -> Path:
        """The path between two poses of sensor and indenter, at the scene's speed; slower where the drag turns, or
        grows because the indenter is pressed in, and at its end where walls with much friction slide."""
        gel, lever, indenter, mach = self._gel, max(self._gel.half), self.scene.indenter, self.scene.peak_mach
        assert indenter is not None
        growing, turning, slower, walls, depth, self.unfollowed = 0.0, 0.0, 1.0, False, 0.0, ""
        at = relative_pose(*end)
        way = (at.position - relative_pose(*start).position) * MM
        longest = path_length(start, end, lever)
        faster = max(1.0, float(np.linalg.norm(way)) / longest) if longest > 0.0 else 1.0  # if they go opposite ways
        if indenter.friction > 0.0:
            force = self.wrench("lower")[:3]
            growing, turning = growth(way), turn(way, force, indenter.friction)
            depth = (self.below(at.quaternion) - float(at.position[2])) * MM
            walls = self._edges_touch(at, MAX_BULGE * depth)
            mach *= pace(way, force, indenter.friction)
            slower = slower_walls(way, indenter.friction, gel.spacing / gel.thickness) if walls else 1.0
        path = plan(
            start, end, mach / faster, self._scaled.step, lever, gel.thickness,
            remembered=path_along(start, end, lever),
            short=SHORT_SLIDE + (SHORT_INDENTING_SLIDE - SHORT_SLIDE) * growing,
            slower=slower, last=SLOWED_WALL_LENGTH * gel.spacing,
        )  # fmt: skip
        if indenter.friction > 0.0:
            slide = Slide(
                length=math.hypot(way[0], way[1]),
                before=float(self._touched[2]),
                away=float(np.linalg.norm(at.position[:2] * MM - self._touched[:2])),
                depth=depth,
                shear_mach=faster * path.peak_mach(lever) / self._shear,
                friction=indenter.friction,
                edge_radius=MM * edge_radius(indenter, self.scene.effective_element_size) if walls else math.inf,
            )
            self.unfollowed = slide.unfollowed(min(self.scene.effective_element_size * MM, gel.spacing), gel.thickness)
        return replace(path, growing=growing, turning=turning, unfollowed=self.unfollowed)

    def _edges_touch(self, at: Pose, bulge: float) -> bool:
        """Whether edges of the indenter, `at` this pose in the gel's frame, reach the gel; bulge: how far that rises
        round it [mm]. Those at the back of an indenter do not, nor those of one that is wider than the gel."""
        points = (rotate(at, self._edges) + at.position) * MM
        return bool((np.all(np.abs(points[:, :2]) <= self._gel.half, axis=1) & (points[:, 2] <= bulge)).any())

    def place(self, poses: Mapping[str, Pose]) -> None:
        """See World. Where the indenter is then, it has come to the gel."""
        super().place(poses)
        self._touched[:] = [*relative_pose(*self._poses.values()).position[:2] * MM, 0.0]

    def below(self, turn: np.ndarray) -> float:
        """How far the indenter's lowest point is below its origin, the centre of its bounding box, if that is turned by
        the quaternion `turn` (4,) [m]."""
        assert self.scene.indenter is not None
        mesh = self._state.meshes[self._index]
        if mesh is not None and turn[:2].any():
            return float((mesh.vertices @ rotate(inverse(Pose(quaternion=turn)), [0.0, 0.0, -1.0])).max())
        indenter = self.scene.indenter
        return depth_below_centre(
            indenter.geometry, turn, indenter.effective_edge_radius(self.scene.effective_element_size)
        )

    def prepare(self, launch: Launch) -> PreparedLaunch:
        """Sets this environment's parameters. Raises SimulationDiverged where too much of a mesh could be touched."""
        path, where = launch.path, partial(launch.span, tuple(self._poses))
        both = path.drive(launch.first, launch.last)
        drive = relative_drive(both[:, 0], both[:, 1])
        try:
            self._cover(drive)
        except ValueError as error:
            raise SimulationDiverged(str(error), where(), TOO_MUCH, retry=False) from None
        except MemoryError as error:
            cause = f"no memory for the distances from the indenter's mesh ({error})"
            raise SimulationDiverged(cause, where(), TOO_MUCH, retry=False) from None
        before = self._before_launch()
        self._state.params[self._index, STEP] = path.step
        self._state.params[self._index, LIMIT_FOLLOWS] = self._follows(launch) / self._gel.thickness
        damped = 1.0 if launch.held else 1.0 - path.turning * (1.0 - TURNING_ZETA_SHARE)
        self._state.params[self._index, GEL_DAMPING] = damped * self._inertia.params[GEL_DAMPING]
        Health.clear(self._state.partial[self._index])
        return PreparedLaunch(launch, where, drive, before)

    def _follows(self, launch: Launch) -> float:
        """In how many parts of the time of a wave through the gel the limit of friction follows the pressure."""
        indenter = self.scene.indenter
        assert indenter is not None
        steady = FLUTTER_FRICTION / min(max(indenter.friction, FLUTTER_FRICTION / MAX_LIMIT_RATE), FLUTTER_FRICTION)
        return steady if launch.held else steady + launch.path.growing * (MAX_LIMIT_RATE - steady)

    def _cover(self, drive: np.ndarray) -> None:
        """Fills in a mesh's distances wherever the gel's surface may touch it in this launch."""
        mesh = self._state.meshes[self._index]
        if mesh is None:
            return
        margin, half = MESH_MARGIN * self._gel.spacing, mesh.half * MM
        nodes = self._surface_nodes()
        at = np.concatenate([(nodes - rows[3]) @ rows[:3] for rows in drive[[0, -1], 0].astype(np.float64)])
        near = at[(np.abs(at) <= half + margin).all(axis=1)]
        if len(near):
            self._state.cover(self._index, near.min(axis=0) - margin, near.max(axis=0) + margin)

    def _surface_nodes(self) -> np.ndarray:
        """Where the nodes of the gel's surface are (n, 3) [mm], sensor frame."""
        top = self._state.tops(self._index)[0].astype(np.float64)
        axes = (self._gel.spacing * (np.arange(n) - (n - 1) / 2) for n in top.shape[:2])
        top[..., :2] += np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        return np.asarray(top.reshape(-1, 3))

    def outcome(self, prepared: PreparedLaunch) -> list[ForceReading]:
        """The forces after the launch. Raises SimulationDiverged if its state is unphysical."""
        partial = self._state.partial[self._index]
        seen = self._survey()
        health = Health.read(partial, self._courant(), sound=seen is not None and seen.sound)
        check_launch(self.arrays, prepared.before, health, prepared.where)
        sums = partial.astype(np.float64).sum(axis=0)
        force, moment = sums[None, FORCE : FORCE + 3], sums[None, FORCE + 3 : FORCE + 6]
        backing = sums[None, BACKING : BACKING + 3]
        # here, not in `plan`, which flowing motions do not ask
        if not force.any():
            self._touched[:] = [*prepared.drive[-1, 0, 3, :2], 0.0]
        else:
            self._touched[2] += np.linalg.norm(prepared.drive[:, 0, 4, :2], axis=1).sum() * prepared.launch.path.step
        if prepared.launch.held or (not force.any() and prepared.launch.last == prepared.launch.path.substeps):
            self._require_seen(prepared, health.overlap)
        reading = ForceReading(
            force, backing, self._floor, health.overlap, health.capped, moment / max(self._gel.half),
            integration=Integration(prepared.launch.path.step, self._damping(), health.courant),
        )  # fmt: skip
        return [reading]

    def _require_seen(self, prepared: PreparedLaunch, overlap: float) -> None:
        """Raises SimulationDiverged if the indenter's lowest point over the gel has come into it between its contact
        points, the deepest of which has an `overlap` with it [mm]."""
        assert self.scene.indenter is not None
        rows, spacing = prepared.drive[-1, 0].astype(np.float64), self._gel.spacing
        down = rows[:3].T @ [0.0, 0.0, -1.0]
        half, self.unfelt = np.array(self._gel.half) - spacing, 0.0  # not at the gel's rim
        mesh, geometry = self._state.meshes[self._index], self.scene.indenter.geometry
        if isinstance(geometry, Mesh):
            assert mesh is not None
            lowest = mesh.lowest(rows[:3], rows[3] / MM, half / MM)
            if lowest is None:
                return
            tip = lowest * MM
        else:
            tip = (
                rows[:3]
                @ (
                    farthest_point(
                        geometry, down, self.scene.indenter.effective_edge_radius(self.scene.effective_element_size)
                    )
                    * MM
                )
                + rows[3]
            )
            if (np.abs(tip[:2]) > half).any():
                return
        nodes = self._surface_nodes()
        near = np.abs(nodes[:, :2] - tip[:2]).max(axis=1) < 2 * spacing
        depth = float(nodes[near, 2].min(initial=np.inf) - tip[2])
        self.unfelt = max(depth - overlap, 0.0) / -float(tip[2]) if tip[2] < 0.0 else 0.0
        # where points do touch, deeper by no more than a quarter of its way into the untouched gel
        if depth - overlap > max(MAX_DIP * spacing / POINTS, 0.0 if overlap == 0.0 else -tip[2] / 4):
            cause = f"the indenter is {depth:.3g} mm deep in the gel and touches no contact point of it"
            if overlap > 0.0:
                cause = (
                    f"the indenter is {depth:.3g} mm deep in the gel, and no contact point more than {overlap:.3g} mm"
                )
            finer = self._gel.thickness / (2 * self._gel.elements[2])
            advice = (
                f"these lie {spacing / POINTS:.3g} mm apart (element_size / {POINTS}), and its tip or edge passes "
                f"between them: use a smaller element_size, such as {finer:.4g} mm"
            )
            before = prepared.before
            raise SimulationDiverged(cause, prepared.where(), advice, retry=False, good=before, failed=self.arrays())
