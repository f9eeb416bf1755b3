"""A rigid indenter pressed, slid or twisted on one gel: no particles, no grid."""

from collections.abc import Mapping, Sequence

import numpy as np

from tacsim.interface import Pose
from tacsim.physics.controller import Launch, Prepared, Reading, Scheme, force_floor
from tacsim.physics.device import Mirror, run_press
from tacsim.physics.driven import DrivenWorld
from tacsim.physics.gel import (
    MM,
    MPA,
    Corners,
    GelState,
    Lattice,
    Nodes,
    Skin,
    Touch,
    gel_advance,
    gel_facts,
    gel_forces,
    one_lattice,
)
from tacsim.physics.health import Health, copies, judged
from tacsim.physics.hybrid import ZETA_GEL_HELD, side_by_side
from tacsim.physics.hybrid_kernels import Drive
from tacsim.physics.indenter import (
    BOX,
    CYLINDER,
    GRID,
    POINTS,
    SPHERE,
    Pressure,
    Slip,
    Values,
    indent,
)
from tacsim.physics.inertia import Inertia, kernel_second
from tacsim.physics.lanes import ON_DEVICE, PARTS, Counts, Facts, Partial
from tacsim.physics.layout import (
    BACKING,
    COUNTS,
    ELEMENTS,
    FACTS,
    FORCE,
    FRICTION,
    GEL_DAMPING,
    KIND,
    NUMBERS,
    SHAPE,
    SHAPE_NODES,
    SHAPE_ORIGIN,
    SHAPE_SPACING,
    STEP,
    STEPS,
    STIFFNESS,
)  # fmt: skip
from tacsim.physics.team import CHUNK, WHO, Sync, first_in_chunk, meet, run_team, shares
from tacsim.runtime import start, ti
from tacsim.scene import Box, Cylinder, Scene, Sphere
from tacsim.shapes import distance_grid, extent

# dt / (spacing / wave speed). Edges of a rigid box tear the surface up at 0.6, without a NaN; and the penalty falls
# with the step's square, so 0.5 costs overlap.
COURANT = 0.4
CLEARANCE = 0.1e-3  # gap between gel and indenter at construction [m]
GRID_SPACING = 0.1e-3  # of a mesh's distance grid [m]
REACH = 3e-3  # of a mesh's distance grid, up from its tip [m]


@ti.kernel
def press_substeps(
    team: ti.i32, drive: Drive,
    nodes: Nodes, skin: Skin, touch: Touch, corners: Corners, lattice: Lattice,
    slip: Slip, pressure: Pressure, values: Values,
    facts: Facts, counts: Counts, partial: Partial, sync: Sync,
):  # fmt: skip
    """Explicit substeps in one launch by `team` threads; drive: pose and velocity of the indenter, sensor frame."""
    for task in range(sync.shape[0] * team * CHUNK):
        for _ in range(first_in_chunk(task)):
            turn, member = task // CHUNK // team, task // CHUNK % team
            env = sync[turn, WHO]
            nx, ny, layers = counts[env, ELEMENTS], counts[env, ELEMENTS + 1], counts[env, ELEMENTS + 2]
            for it in range(counts[env, STEPS]):
                for share in range(shares(member, team)):
                    part = member + share * team
                    indent(env, part, it, drive, skin, touch, slip, pressure, values, facts, counts, partial, nx, ny)
                    gel_forces(
                        env, part, 1, nodes, corners, lattice, facts, counts, partial,
                        layers, nx, ny,
                    )  # fmt: skip
                meet(sync, turn, team, 2 * it + 1)
                for share in range(shares(member, team)):
                    part = member + share * team
                    gel_advance(env, part, 1, nodes, skin, touch, lattice, facts, counts, partial, layers, nx, ny)
                meet(sync, turn, team, 2 * it + 2)


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


class PressState:
    """Arrays of E environments that one launch of `press_substeps` advances; each environment is a PressWorld.

    Environments share the gel's lattice; indenters, materials, friction and settling are each one's own.
    """

    def __init__(self, scenes: Sequence[Scene]) -> None:
        """Raises ValueError for gels that are not cut alike."""
        start()
        self.gel = [gel_facts(scene.gel, scene.element) for scene in scenes]
        lattice = one_lattice(self.gel)
        self.gels = GelState(lattice, len(scenes), 1)
        nx, ny, _ = lattice.elements
        self.slip = np.zeros((len(scenes), nx * POINTS, ny * POINTS, 3), np.float32)
        self.pressure = np.zeros(self.slip.shape[:3], np.float32)  # multiplier of the normal contact [MPa]
        self.facts = np.zeros((len(scenes), FACTS), np.float32)
        self.counts = np.zeros((len(scenes), COUNTS), np.int32)
        self.counts[:, ELEMENTS : ELEMENTS + 3] = lattice.elements
        self.partial = np.zeros((len(scenes), PARTS, NUMBERS), np.float32)
        self._mirror = Mirror()
        self._values = _stacked([self._set_shape(index, scene) for index, scene in enumerate(scenes)])

    def _set_shape(self, index: int, scene: Scene) -> np.ndarray:
        """Writes one environment's indenter into facts and counts; returns its distance values [mm]."""
        kind, size, values, origin, spacing = _distance_facts(scene)
        self.counts[index, KIND], self.counts[index, SHAPE_NODES : SHAPE_NODES + 3] = kind, values.shape
        self.facts[index, SHAPE : SHAPE + 3], self.facts[index, SHAPE_ORIGIN : SHAPE_ORIGIN + 3] = size, origin
        self.facts[index, SHAPE_SPACING] = spacing
        return values

    def advance(self, drives: Mapping[int, np.ndarray]) -> None:
        """One launch; drives: (n, 1, 6, 3) of the environments that go on, n each one's own."""
        drive = side_by_side(drives, self.counts)
        self.gels.refresh()
        if ON_DEVICE:
            run_press(
                self._mirror, drive, self.gels, self.slip, self.pressure, self._values, self.facts, self.counts,
                self.partial,
            )  # fmt: skip
        else:
            run_team(
                press_substeps, drive, self.gels.arguments(), self.slip, self.pressure, self._values, self.facts,
                self.counts, self.partial, active=list(drives),
            )  # fmt: skip


def _stacked(grids: Sequence[np.ndarray]) -> np.ndarray:
    """Distance values of all environments in one array (E, most x, most y, most z); each has its own node counts."""
    most = np.max([grid.shape for grid in grids], axis=0)
    values = np.zeros((len(grids), *most), np.float32)
    for index, grid in enumerate(grids):
        values[index, : grid.shape[0], : grid.shape[1], : grid.shape[2]] = grid
    return values


class PressWorld(DrivenWorld):
    """World of a scene with an indenter: the `lower` gel, and the `indenter` above it."""

    sensors = ("lower",)
    balanced = False
    yields = False

    def __init__(self, scene: Scene, state: PressState | None = None, index: int = 0) -> None:
        """One environment of a `state` made of several scenes, that of scene number `index`; or of one of its own."""
        assert scene.indenter is not None
        self.scene = scene
        self._state: PressState = PressState([scene]) if state is None else state
        self._index = index
        self._gel = self._state.gel[index]
        step = COURANT * self._gel.spacing
        # An elastic gel forgets its way, so it is damped on it as in the hold.
        self._scaled = Inertia({GEL_DAMPING: ZETA_GEL_HELD / self._gel.thickness}, step)
        self._true = Inertia({GEL_DAMPING: 0.0}, step, kernel_second(self._gel, scene.gel.material.density))
        self._floor = force_floor(scene.gel.material.youngs_modulus * MPA, self._gel.thickness)
        facts = {
            **self._gel.facts(), STIFFNESS: self._gel.density * self._gel.spacing / (2 * step**2),
            FRICTION: scene.indenter.friction,
        }  # fmt: skip
        self._state.facts[index, list(facts)] = list(facts.values())
        self._take(self._scaled)
        height = float(extent(scene.indenter.geometry)[2])
        turned = np.array([0.0, 0.0, np.sin(scene.indenter.yaw / 2), np.cos(scene.indenter.yaw / 2)])
        self._rates = np.zeros((2, 6))
        self._poses = {"lower": Pose(), "indenter": Pose(np.array([0.0, 0.0, height / 2 + CLEARANCE]), turned)}

    def _stop(self) -> None:
        self._state.gels.v[self._index] = 0.0

    def arrays(self) -> dict[str, np.ndarray]:
        state, i = self._state, self._index
        return {
            "gel_displacement": state.gels.u[i], "gel_velocity": state.gels.v[i], "slip": state.slip[i],
            "pressure": state.pressure[i], "sums": state.partial[i],
        }  # fmt: skip

    def truth(self) -> None:
        return None

    def prepare(self, launch: Launch) -> Prepared:
        """Sets this environment's numbers for a launch."""
        path = launch.path
        where = path.place(self._poses, launch.first, launch.last)
        good = copies(self.arrays())
        both = path.drive(launch.first, launch.last)
        self._state.facts[self._index, STEP] = path.step
        Health.clear(self._state.partial[self._index])
        return Prepared(launch, relative_drive(both[:, 0], both[:, 1]), where, good)

    def outcome(self, prepared: Prepared) -> Reading:
        """What the launch came to. Raises SimulationDiverged if that is unphysical."""
        partial = self._state.partial[self._index]
        health = judged(self.arrays(), prepared.good, Health.read(partial, self._courant()), prepared.where)
        sums = partial.astype(np.float64).sum(axis=0)
        force, moment = sums[None, FORCE : FORCE + 3], sums[None, FORCE + 3 : FORCE + 6]
        backing = sums[None, BACKING : BACKING + 3]
        return Reading(
            force, backing, self._floor, health.overlap, health.capped, moment / max(self._gel.half),
            scheme=Scheme(prepared.launch.path.step, self._damping(), health.courant),
        )  # fmt: skip


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
