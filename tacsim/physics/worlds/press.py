"""A rigid indenter pressed, slid or twisted on one gel: no particles, no grid."""

import math
from collections.abc import Callable, Mapping, Sequence
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
    LIMIT_RELAXATION_RATE,
    MEMORY_SHARE,
    STEP,
    STIFFNESS,
)  # fmt: skip
from tacsim.physics.failure.health import Health, LaunchSpan, SimulationDiverged, check_launch
from tacsim.physics.gel.gel import GelParams
from tacsim.physics.motion.controller import ForceReading, Integration, Launch, PreparedLaunch, force_floor
from tacsim.physics.motion.inertia import Inertia, kernel_second
from tacsim.physics.motion.path import Path, path_length, plan_path, tangential_path_length
from tacsim.physics.motion.slide import Slide, growth_share, speed_share, turn_share, wall_slowdown
from tacsim.physics.motion.tuning import SHORT_SLIDE, SLOWED_WALL_LENGTH
from tacsim.physics.snapshot import State
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

MESH_ADVICE = "cut off parts of mesh and gel that cannot touch; in a smaller batch each world has more memory"


def contact_stiffness(gel: GelParams, step: float) -> float:
    """Stiffness of a contact point [MPa/mm]: that of a half-space for the shortest pressure wave on the points, limited
    by the mass of the surface's nodes for a time `step` [mm]."""
    mu, lam = gel.mu, gel.lam
    half_space = (2 * math.pi * POINTS / gel.spacing) * 2 * mu * (lam + mu) / (lam + 2 * mu)  # k E / (2 (1 - nu^2))
    return min(half_space, gel.density * gel.spacing / (2 * step**2))


def subtract_second_differences(nodes: np.ndarray, share: float) -> np.ndarray:
    """(nx, ny, 3) minus `share` of their second differences along both axes; values at the rim are repeated outside."""
    out = np.asarray(nodes, np.float64)
    for axis in (0, 1):
        ends = (out[:1], out[-1:]) if axis == 0 else (out[:, :1], out[:, -1:])
        padded = np.concatenate([ends[0], out, ends[1]], axis=axis)  # np.pad takes ten times as long
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
    missed_depth_share = 0.0  # share of the indenter's depth that no contact point reaches, in the last state at rest

    def __init__(self, scene: Scene, state: PressState | None = None, index: int = 0) -> None:
        """The environment of scene number `index` in a `state` of several; without `state`, a single environment."""
        assert scene.indenter is not None
        self.scene = scene
        self.state: PressState = PressState([scene]) if state is None else state
        self._index = index
        self._gel = self.state.gel[index]
        self._gels = (self._gel,)
        step = PRESS_COURANT * self._gel.spacing
        self._shear = math.sqrt(self._gel.mu / self._gel.density)  # speed of its shear wave, over its pressure wave's
        zeta = min(PRESS_ZETA, PRESS_ZETA_BY_SHEAR * self._shear)
        self._scaled = Inertia({GEL_DAMPING: zeta / self._gel.thickness, MEMORY_SHARE: FORCE_MEMORY_RATE}, step)
        self._true = Inertia(
            {GEL_DAMPING: 0.0, MEMORY_SHARE: 0.0}, step, kernel_second(self._gel, scene.gel.material.density)
        )
        self._floor = force_floor(scene.gel.material.youngs_modulus * MPA, self._gel.thickness)
        params = {
            **self._gel.params(), STIFFNESS: contact_stiffness(self._gel, step),
            FRICTION: scene.indenter.friction,
        }  # fmt: skip
        self.state.params[index, list(params)] = list(params.values())
        self._use_inertia(self._scaled)
        self._rates = np.zeros((2, 6))
        # x, y of the indenter at the last state without contact, and length of all slides since then [mm]
        self._touched = np.zeros(3)
        self._edges = edge_points(scene.indenter.geometry, scene.effective_element_size)
        turned = scene.indenter.turn
        above = self.lowest_point_depth(turned) + INITIAL_GAP
        self._poses = {"lower": Pose(), "indenter": Pose(np.array([0.0, 0.0, above]), turned)}

    def _stop(self) -> None:
        self.state.gels.clear(self._index, velocity_only=True)

    def surface(self, name: str) -> GelSurface:
        """The surface of the contact points, which is smoothed less than the spline of the nodes."""
        of_nodes = super().surface(name)
        return replace(
            of_nodes,
            displacement=subtract_second_differences(of_nodes.displacement, SPLINE_SMOOTHING - SURFACE_SMOOTHING),
        )

    def reach(self) -> np.ndarray:
        """Distance from the indenter up to which contact pressure acts [m], at the surface's nodes (nx + 1, ny + 1)."""
        stiffness = float(self.state.params[self._index, STIFFNESS])
        return np.asarray(
            self.state.gels.common_group.surface_pressure[self._index, 0] / (RIM_STIFFNESS * stiffness * MM)
        )

    def arrays(self) -> dict[str, np.ndarray]:
        state, i = self.state, self._index
        return {
            **state.gels.arrays(i), "anchor": state.anchor[i],
            "pressure": state.pressure[i], "carried": state.gels.common_group.surface_pressure[i, 0],
            "sums": state.partial[i],
        }  # fmt: skip

    def truth(self) -> None:
        return None

    def _scalars(self) -> dict[str, np.ndarray]:
        return {**super()._scalars(), "touched": self._touched}

    def plan(self, start: Sequence[Pose], end: Sequence[Pose]) -> Path:
        """The path between two poses of sensor and indenter, at the scene's speed. It is slower where the drag changes
        its direction, or increases by indentation, and at its end where steep sides slide with high friction."""
        gel, lever, indenter, mach = self._gel, max(self._gel.half), self.scene.indenter, self.scene.peak_mach
        assert indenter is not None
        growing, turning, slower, walls, depth, self.unsettled_reason = 0.0, 0.0, 1.0, False, 0.0, ""
        at = relative_pose(*end)
        displacement = (at.position - relative_pose(*start).position) * MM
        longest = path_length(start, end, lever)
        # above 1 for opposite directions
        faster = max(1.0, float(np.linalg.norm(displacement)) / longest) if longest > 0.0 else 1.0
        if indenter.friction > 0.0:
            force = self.wrench("lower")[:3]
            growing, turning = growth_share(displacement), turn_share(displacement, force, indenter.friction)
            depth = (self.lowest_point_depth(at.quaternion) - float(at.position[2])) * MM
            walls = self._edges_touch(at, MAX_BULGE * depth)
            mach *= speed_share(displacement, force, indenter.friction)
            slower = wall_slowdown(displacement, indenter.friction, gel.spacing / gel.thickness) if walls else 1.0
        path = plan_path(
            start, end, mach / faster, self._scaled.step, lever, gel.thickness,
            memory_length=tangential_path_length(start, end, lever),
            short_length=SHORT_SLIDE + (SHORT_INDENTING_SLIDE - SHORT_SLIDE) * growing,
            end_slowdown=slower, end_length=SLOWED_WALL_LENGTH * gel.spacing,
        )  # fmt: skip
        if indenter.friction > 0.0:
            slide = Slide(
                length=math.hypot(displacement[0], displacement[1]),
                earlier_length=float(self._touched[2]),
                end_distance=float(np.linalg.norm(at.position[:2] * MM - self._touched[:2])),
                depth=depth,
                shear_mach=faster * path.peak_mach(lever) / self._shear,
                friction=indenter.friction,
                edge_radius=MM * edge_radius(indenter, self.scene.effective_element_size) if walls else math.inf,
            )
            self.unsettled_reason = slide.unsettled_reason(
                min(self.scene.effective_element_size * MM, gel.spacing), gel.thickness
            )
        return replace(path, growth_share=growing, turn_share=turning, unsettled_reason=self.unsettled_reason)

    def _edges_touch(self, at: Pose, bulge: float) -> bool:
        """Whether edges of the indenter, `at` this pose in the gel's frame, reach the gel; bulge: height of the gel
        around it [mm]. Edges at the back of an indenter and outside of the gel do not."""
        points = (rotate(at, self._edges) + at.position) * MM
        return bool((np.all(np.abs(points[:, :2]) <= self._gel.half, axis=1) & (points[:, 2] <= bulge)).any())

    def place(self, poses: Mapping[str, Pose]) -> None:
        """See World. The new position of the indenter counts as the point of first contact."""
        super().place(poses)
        self._touched[:] = [*relative_pose(*self._poses.values()).position[:2] * MM, 0.0]

    def lowest_point_depth(self, turn: np.ndarray) -> float:
        """Depth of the indenter's lowest point below its origin, the centre of its bounding box, with the orientation
        `turn` (4,), a quaternion [m]."""
        assert self.scene.indenter is not None
        mesh = self.state.meshes[self._index]
        if mesh is not None and turn[:2].any():
            return float((mesh.vertices @ rotate(inverse(Pose(quaternion=turn)), [0.0, 0.0, -1.0])).max())
        indenter = self.scene.indenter
        return depth_below_centre(
            indenter.geometry, turn, indenter.effective_edge_radius(self.scene.effective_element_size)
        )

    def prepare(self, launch: Launch) -> PreparedLaunch:
        """Sets this environment's parameters. Raises SimulationDiverged where the gel could touch too much of a
        mesh."""
        path, where = launch.path, partial(launch.span, tuple(self._poses))
        both = path.drive(launch.first, launch.last)
        drive = relative_drive(both[:, 0], both[:, 1])
        try:
            self.cover(drive)
        except ValueError as error:
            raise SimulationDiverged(str(error), where(), MESH_ADVICE, retry=False) from None
        except MemoryError as error:
            cause = f"no memory for the distances from the indenter's mesh ({error})"
            raise SimulationDiverged(cause, where(), MESH_ADVICE, retry=False) from None
        before = self._before_launch()
        self.state.params[self._index, STEP] = path.step
        self.state.params[self._index, LIMIT_RELAXATION_RATE] = self._limit_relaxation(launch) / self._gel.thickness
        damped = 1.0 if launch.is_held else 1.0 - path.turn_share * (1.0 - TURNING_ZETA_SHARE)
        self.state.params[self._index, GEL_DAMPING] = damped * self._inertia.params[GEL_DAMPING]
        Health.clear(self.state.partial[self._index])
        return PreparedLaunch(launch, where, drive, before)

    def _limit_relaxation(self, launch: Launch) -> float:
        """Rate at which the friction limit follows the pressure, times the time of a wave through the gel."""
        steady = self.steady_limit_relaxation
        return steady if launch.is_held else steady + launch.path.growth_share * (MAX_LIMIT_RATE - steady)

    @property
    def steady_limit_relaxation(self) -> float:
        """Rate at which the friction limit follows a steady pressure, times the time of a wave through the gel."""
        assert self.scene.indenter is not None
        friction = max(self.scene.indenter.friction, FLUTTER_FRICTION / MAX_LIMIT_RATE)
        return FLUTTER_FRICTION / min(friction, FLUTTER_FRICTION)

    def cover(self, drive: np.ndarray, elements: float = MESH_MARGIN) -> None:
        """Computes a mesh's distances where the gel's surface may touch it in this launch, up to a number of `elements`
        from it. Raises ValueError for too many, MemoryError where there is no memory for them."""
        mesh = self.state.meshes[self._index]
        if mesh is None:
            return
        margin, half = elements * self._gel.spacing, mesh.half * MM
        nodes = self._surface_nodes()
        at = np.concatenate([(nodes - rows[3]) @ rows[:3] for rows in drive[[0, -1], 0].astype(np.float64)])
        near = at[(np.abs(at) <= half + margin).all(axis=1)]
        if len(near):
            self.state.cover(self._index, near.min(axis=0) - margin, near.max(axis=0) + margin)

    def _surface_nodes(self) -> np.ndarray:
        """Positions of the nodes of the gel's surface (n, 3) [mm], sensor frame."""
        top = self.state.surface_displacements(self._index)[0].astype(np.float64)
        axes = (self._gel.spacing * (np.arange(n) - (n - 1) / 2) for n in top.shape[:2])
        top[..., :2] += np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        return np.asarray(top.reshape(-1, 3))

    def outcome(self, prepared: PreparedLaunch) -> list[ForceReading]:
        """The forces after the launch. Raises SimulationDiverged if its state is unphysical."""
        partial, health = self.state.partial[self._index], self.read_health()
        check_launch(self.arrays, prepared.before, health, prepared.where)
        sums = partial.astype(np.float64).sum(axis=0)
        force, moment = sums[None, FORCE : FORCE + 3], sums[None, FORCE + 3 : FORCE + 6]
        backing = sums[None, BACKING : BACKING + 3]
        # here, not in `plan`, which flowing motions do not call
        if not force.any():
            self._touched[:] = [*prepared.drive[-1, 0, 3, :2], 0.0]
        else:
            self._touched[2] += np.linalg.norm(prepared.drive[:, 0, 4, :2], axis=1).sum() * prepared.launch.path.step
        if prepared.launch.is_held or (not force.any() and prepared.launch.last == prepared.launch.path.substeps):
            self.require_contact_resolution(prepared.drive[-1, 0], health.overlap, prepared.where, prepared.before)
        reading = ForceReading(
            force, backing, self._floor, health.overlap, health.capped, moment / max(self._gel.half),
            integration=Integration(prepared.launch.path.step, self._damping(), health.courant),
        )  # fmt: skip
        return [reading]

    def read_health(self) -> Health:
        """Results of the kernels in the last launch."""
        survey = self._survey()
        return Health.read(
            self.state.partial[self._index], self._courant(), is_healthy=survey is not None and survey.is_healthy
        )

    def require_contact_resolution(
        self, motion: np.ndarray, overlap: float, where: Callable[[], LaunchSpan], before: State
    ) -> None:
        """Raises SimulationDiverged if the indenter's lowest point is in the gel between the contact points, the
        deepest of which has this `overlap` [mm].

        motion: of the indenter (6, 3), as in a drive; where, before: of the launch, for the error.
        """
        assert self.scene.indenter is not None
        rows, spacing = motion.astype(np.float64), self._gel.spacing
        down = rows[:3].T @ [0.0, 0.0, -1.0]
        half, self.missed_depth_share = np.array(self._gel.half) - spacing, 0.0  # not at the gel's rim
        mesh, geometry = self.state.meshes[self._index], self.scene.indenter.geometry
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
        self.missed_depth_share = max(depth - overlap, 0.0) / -float(tip[2]) if tip[2] < 0.0 else 0.0
        # where points touch, the difference may be a quarter of the depth in the undeformed gel
        if depth - overlap > max(MAX_DIP * spacing / POINTS, 0.0 if overlap == 0.0 else -tip[2] / 4):
            cause = f"the indenter is {depth:.3g} mm deep in the gel and touches no contact point of it"
            if overlap > 0.0:
                cause = (
                    f"the indenter is {depth:.3g} mm deep in the gel, and no contact point more than {overlap:.3g} mm"
                )
            finer = self._gel.thickness / (2 * self._gel.elements[2])
            advice = (
                f"these lie {spacing / POINTS:.3g} mm apart (element_size / {POINTS}), and its tip or edge is between "
                f"them: use a smaller element_size, such as {finer:.4g} mm"
            )
            raise SimulationDiverged(cause, where(), advice, retry=False, good=before, failed=self.arrays())
