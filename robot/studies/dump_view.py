"""What a dump of a diverged motion shows: a table, a picture, and whether the motion diverges again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tacsim.geometry.shapes import distance
from tacsim.interface import Pose
from tacsim.models.scene import Indenter, Scene
from tacsim.physics.exec import layout
from tacsim.physics.failure import diagnosis
from tacsim.physics.failure.dump import MOMENTS, Dump, DumpError, no_dumps
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.world import MoveStats, World, make_world
from tacsim.report.figure import COLOURS, INK, canvas, plain, save

State = Mapping[str, NDArray[Any]]
TITLES = {"before": "before the motion", "good": "last good", "failed": "failed"}
BOOKKEEPING = ("poses", "rates", "speed", "true_inertia")  # no arrays of the kernels: kept of "before" alone
PICKED = 6000  # particles drawn at most


@dataclass(frozen=True, slots=True)
class Replay:
    """What came of running the motion again."""

    failure: SimulationDiverged | None
    stats: MoveStats | None
    identical: bool  # it failed with the same message, and every array in the same bytes


def open_world(dump: Dump) -> World:
    """A world of the dump's scene in the state before the motion.

    Raises DumpError for arrays that do not belong to the scene, and what making a world raises.
    """
    _check_sizes(dump)
    world = make_world(dump.info.scene)
    own = world.snapshot()
    for moment in MOMENTS:
        state = dump.states[moment]
        if moment != "before" and not state:
            continue
        unknown = sorted(set(state) - set(own))
        if unknown:
            raise DumpError(f"array '{moment}.{unknown[0]}' is none of this scene's: {', '.join(own)}")
        for name, a in own.items():
            if moment != "before" and name in BOOKKEEPING and name not in state:
                continue
            found = state.get(name)
            if found is None or found.shape != a.shape or found.dtype != a.dtype:
                shown = "nothing" if found is None else f"{found.dtype} {found.shape}"
                raise DumpError(f"array '{moment}.{name}' must be {a.dtype} {a.shape} for this scene, found {shown}")
    try:
        world.restore(dump.states["before"])
    except ValueError as error:  # poses that are none
        raise DumpError(f"the state before the motion is unsound: {error}") from None
    return world


def _check_sizes(dump: Dump) -> None:
    """Before anything is allocated for the scene: it must need as many gel nodes as the dump holds."""
    scene, before = dump.info.scene, dump.states["before"]
    if scene.physics == "seed":
        from tacsim.physics.seed.world import gel_lattice

        needed, name = int(np.prod([float(n) for n in gel_lattice(scene.gel, scene.spacing).count])), "position"
    else:
        from tacsim.physics.gel.gel import gel_params

        nodes = (float(n + 1) for n in gel_params(scene.gel, scene.element).elements)
        needed, name = int(np.prod([*nodes, len(scene.sensors)])), "gel_displacement"
    held = before[name].size // 3 if name in before else 0
    if held < needed:
        raise DumpError(f"the scene has {needed:,} gel nodes, but 'before.{name}' holds {held:,}")


def replay(dump: Dump, world: World) -> Replay:
    """Runs the motion again, with all its retries; leaves `world` in the state before it, or in the new one.

    Raises LoadNotReached (tacsim.physics.motion.load) if it gets further this time, and a load it holds is out of
    reach.
    """
    order = dump.order
    with no_dumps():
        try:
            return Replay(None, world.move(order.targets, order.loads, order.duration, flow=order.flow), False)
        except SimulationDiverged as failure:
            same = (failure.cause, failure.where) == (dump.info.cause, dump.info.where)
            for moment, state in (("good", failure.good), ("failed", failure.failed)):
                recorded = dump.states[moment]
                same = same and recorded.keys() == state.keys()
                same = same and all(recorded[name].tobytes() == a.tobytes() for name, a in state.items())
            return Replay(failure, None, same)


# ------------------------------------------------------------------ table


def table(dump: Dump) -> list[tuple[str, dict[str, str]]]:
    """Rows (what, value by moment) of the moments that the dump holds."""
    scene = dump.info.scene
    rows: dict[str, dict[str, str]] = {}
    for moment in MOMENTS:
        if dump.states[moment]:
            for what, value in _facts_of(dump.states[moment], scene):
                rows.setdefault(what, {})[moment] = value
    if dump.info.health:
        seen = dump.info.health
        said = {"overlap": "deepest overlap [mm]", "capped": "overlaps capped", "off_grid": "off the grid"}
        said["courant"] = "time step / the wave's, most squeezed element or cell"
        rows |= {words: {"failed": seen[key]} for key, words in said.items() if key in seen}
    return list(rows.items())


def _facts_of(state: State, scene: Scene) -> list[tuple[str, str]]:
    bad = sum(int((~np.isfinite(a)).sum()) for a in state.values())
    info = [("numbers not finite", f"{bad:,} of {sum(a.size for a in state.values()):,}")]
    elements = diagnosis.element_volumes(state, scene.gel.size[2] * 1e3)
    particles = diagnosis.particle_volumes(state)
    info += [("smallest volume ratio, gel elements", _least(elements))] if elements is not None else []
    corners = diagnosis.corner_volumes(state, scene.gel.size[2] * 1e3)
    info += [("smallest at a corner of one", _least(corners))] if corners is not None else []
    info += [("smallest volume ratio, particles", _least(particles))] if particles is not None else []
    for name, words in (("gel_velocity", "gel nodes"), ("velocity", "particles")):
        if name in state:
            info.append((f"fastest of {words} [wave speed]", _least(-np.abs(state[name]), -1.0)))
    for words, vectors in _forces_of(state, len(scene.sensors)):
        info.append((f"{words} [N]", "  ".join(diagnosis.millimetres(v) for v in vectors)))
    return info


def _forces_of(state: State, gels: int) -> list[tuple[str, NDArray[Any]]]:
    """What pressed on each gel and on its backing, (gels, 3)."""
    if "sums" in state:  # of the kernels' parts
        contact = state["sums"][:, layout.FORCE : layout.FORCE + 6 * gels].sum(axis=0).reshape(gels, 6)[:, :3]
        backing = state["sums"][:, layout.BACKING : layout.BACKING + 3].reshape(gels, -1, 3).sum(axis=1)
        return [("contact force", contact), ("force at backing", backing)]
    found = (("contact force", "wrench"), ("force at backing", "backing"))
    return [(words, state[name].reshape(gels, -1)[:, :3]) for words, name in found if name in state]


def _least(values: NDArray[Any], sign: float = 1.0) -> str:
    """The smallest of the finite values, and how many are not finite."""
    finite = values[np.isfinite(values)]
    bad = values.size - finite.size
    return (f"{sign * float(finite.min()):.4g}" if finite.size else "none") + (f"  ({bad:,} not finite)" if bad else "")


# ------------------------------------------------------------------ picture


def draw(dump: Dump, path: Path) -> None:
    """Writes a picture: a cut through body and gels in the world's x-z plane, at every moment that the dump holds."""
    moments = [moment for moment in MOMENTS if dump.states[moment]]
    figure = canvas(5.2 * len(moments), 4.6)
    figure.suptitle(_title(dump), fontsize=9, color=INK, x=0.01, ha="left")
    scene = dump.info.scene
    depth, width = scene.gel.size[2] * 1.1e3, scene.gel.size[0] * 0.6e3
    heights = [float(pose.position[2]) * 1e3 for pose in dump.poses("before").values()]
    for column, moment in enumerate(moments):
        poses = dump.poses(moment)
        axes = plain(figure.add_subplot(1, len(moments), column + 1), TITLES[moment], "x [mm]", "z [mm]")
        _draw_gels(axes, dump.states[moment], scene, poses)
        _draw_particles(axes, dump.states[moment], scene)
        if scene.indenter is not None:
            _draw_indenter(axes, scene.indenter, poses["indenter"])
        middle = float(poses["lower"].position[0]) * 1e3
        axes.set(xlim=(middle - width, middle + width), ylim=(min(heights) - depth, max(heights) + depth))
        axes.set_aspect("equal")
    figure.tight_layout(rect=(0.0, 0.02, 1.0, 0.94))
    save(figure, path)


def _title(dump: Dump) -> str:
    text = f"{dump.info.cause} at {dump.info.place}".replace("$", r"\$")
    return text if len(text) < 200 else text[:197] + "..."


def _draw_gels(axes: Axes, state: State, scene: Scene, poses: Mapping[str, Pose]) -> None:
    """Lattice lines of each gel's middle plane."""
    if "gel_displacement" not in state:
        return
    size = np.array(scene.gel.size) * 1e3
    for index, name in enumerate(scene.sensors):
        u = state["gel_displacement"][index].astype(np.float64)
        nodes = (np.array(np.unravel_index(np.arange(u[..., 0].size), u.shape[:3])).T).reshape(*u.shape[:3], 3)
        rest = (nodes / (np.array(u.shape[:3]) - 1) - [0.5, 0.5, 1.0]) * size
        cut = (rest + u)[:, u.shape[1] // 2]
        x, z = _to_world(cut, poses[name])
        axes.plot(x, z, color=COLOURS[index], linewidth=0.5)
        axes.plot(x.T, z.T, color=COLOURS[index], linewidth=0.5)


def _to_world(points: NDArray[np.float64], pose: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x and z [mm] of points (..., 3) [mm] of a frame; those that are not finite or absurd are left out (NaN)."""
    flat = points.reshape(-1, 3)
    shown = np.where(np.abs(flat) < 1e6, flat, np.nan)  # NaN compares false
    world = shown @ Rotation.from_quat(pose.quaternion).as_matrix().T + pose.position * 1e3
    return world[:, 0].reshape(points.shape[:-1]), world[:, 2].reshape(points.shape[:-1])


def _draw_particles(axes: Axes, state: State, scene: Scene) -> None:
    """Particles within one spacing of the middle plane, coloured by their volume ratio."""
    if "position" not in state:
        return
    x = state["position"].astype(np.float64)
    finite = np.abs(x).max(axis=1) < 1e6
    middle = float(np.median(x[finite, 1])) if finite.any() else 0.0
    near = np.flatnonzero(finite & (np.abs(x[:, 1] - middle) <= scene.spacing * 1e3))
    near = near[:: -(-len(near) // PICKED)] if len(near) else near
    volumes = diagnosis.particle_volumes(state)
    colour = np.ones(len(x)) if volumes is None else np.nan_to_num(volumes, nan=0.0, posinf=2.0, neginf=0.0)
    dots = axes.scatter(x[near, 0], x[near, 2], c=colour[near], s=6, cmap="coolwarm_r", vmin=0.8, vmax=1.2)
    axes.figure.colorbar(dots, ax=axes, shrink=0.6, label="volume ratio")


def _draw_indenter(axes: Axes, indenter: Indenter, pose: Pose) -> None:
    """Outline of the indenter in the middle plane."""
    reach = 10e-3
    a = np.linspace(-reach, reach, 161)
    x, z = np.meshgrid(a, a, indexing="ij")
    points = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    local = Rotation.from_quat(pose.quaternion).inv().apply(points)
    value = distance(indenter.geometry, local).reshape(x.shape)
    at = pose.position * 1e3
    axes.contour(x * 1e3 + at[0], z * 1e3 + at[2], value, levels=[0.0], colors=INK, linewidths=1.2)
