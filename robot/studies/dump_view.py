"""Analysis of a dump of a diverged motion: a table, a picture, and a repetition of the motion."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tacsim.geometry.shapes import shape_distance
from tacsim.interface import Pose
from tacsim.models.scene import Scene
from tacsim.physics.failure.diagnosis import corner_volumes, element_volumes, particle_volumes
from tacsim.physics.failure.dump import MOMENTS, Dump, DumpError, dump_to_folder
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.snapshot import State, gel_arrays
from tacsim.physics.world import World, make_world
from tacsim.report.figure import COLOURS, INK, new_figure, save_figure, style_axes

TITLES = {"before": "before the motion", "good": "last good", "failed": "failed"}


def open_world(dump: Dump) -> World:
    """A world of the dump's scene in the state before the motion.

    Raises DumpError for arrays that do not fit the scene, and the errors of making a world.
    """
    world = make_world(dump.info.scene)
    try:
        world.restore(dump.states["before"])
    except ValueError as error:
        raise DumpError(f"the state before the motion does not fit the dump's scene: {error}") from None
    return world


def replay(dump: Dump, world: World) -> tuple[SimulationDiverged | None, str]:
    """Repeats the motion with all its retries. Returns the failure, if it diverges again, and a description of the
    outcome. `world` ends in the state before the motion, or after it.

    Raises:
        DumpError: the command is not valid in this scene.
        LoadNotReached: the motion does not diverge, but cannot reach a load (tacsim.physics.motion.load).
    """
    try:
        command = dump.command
        with dump_to_folder(None):
            stats = world.move(command.targets, command.loads, command.duration, flow=command.flow)
    except SimulationDiverged as failure:
        same = str(failure) == dump.info.message
        for moment, state in (("good", failure.good), ("failed", failure.failed)):
            recorded = dump.states[moment]
            same = same and recorded.keys() == state.keys()
            same = same and all(recorded[name].tobytes() == a.tobytes() for name, a in state.items())
        how = "exactly as recorded, to the last bit" if same else f"differently from the recording: {failure}"
        return failure, f"diverges again, {how}"
    except (KeyError, ValueError) as error:
        raise DumpError(f"the motion cannot be repeated: {error.args[0]}") from None
    how = f"after {stats.retries} retries" if stats.retries else "at the first attempt"
    settled = "yes" if stats.settled else "no"
    return None, f"does not diverge: reached its targets {how}, settled: {settled}"


def table(dump: Dump) -> dict[str, dict[str, str]]:
    """Range of the volume ratios and of each array, by row and moment, for the moments in the dump."""
    rows: dict[str, dict[str, str]] = {}
    for moment in MOMENTS:
        for row, values in _quantities(dump.states[moment], dump.info.scene):
            rows.setdefault(row, {})[moment] = _range(values)
    return rows | {f"kernels: {key.replace('_', ' ')}": {"failed": value} for key, value in dump.info.health.items()}


def _quantities(state: State, scene: Scene) -> Iterator[tuple[str, NDArray[Any]]]:
    volumes = particle_volumes(state)
    if volumes is not None:
        yield "volume ratio, particles", volumes
    gels = [(u, scene.gel_of(scene.sensors[g]).size[2] * 1e3) for g, u in gel_arrays(state, "gel_displacement").items()]
    for row, ratios in (("gel elements", element_volumes), ("element corners", corner_volumes)):
        if gels:
            yield f"volume ratio, {row}", np.concatenate([ratios(u, thickness).ravel() for u, thickness in gels])
    yield from state.items()


def _range(values: NDArray[Any]) -> str:
    finite = values[np.isfinite(values)]
    bad = values.size - finite.size
    found = f"{float(finite.min()):.4g} to {float(finite.max()):.4g}" if finite.size else "none"
    return f"{found}  ({bad:,} not finite)" if bad else found


def draw(dump: Dump, path: Path) -> None:
    """Writes a picture: a section of body and gels in the world's x-z plane, for every moment in the dump."""
    moments = [moment for moment in MOMENTS if dump.states[moment]]
    figure, scene = new_figure(5.2 * len(moments), 4.6), dump.info.scene
    figure.suptitle(dump.info.message[:200].replace("$", r"\$"), fontsize=9, color=INK, x=0.01, ha="left")
    sizes = [scene.gel_of(name).size for name in scene.sensors]
    depth, width = max(size[2] for size in sizes) * 1.1e3, max(size[0] for size in sizes) * 0.6e3
    heights = [float(pose.position[2]) * 1e3 for pose in dump.poses("before").values()]
    for column, moment in enumerate(moments):
        poses = dump.poses(moment)
        axes = style_axes(figure.add_subplot(1, len(moments), column + 1), TITLES[moment], "x [mm]", "z [mm]")
        _draw_gels(axes, dump.states[moment], scene, poses)
        _draw_particles(axes, dump.states[moment], scene)
        _draw_indenter(axes, scene, poses)
        middle = float(poses["lower"].position[0]) * 1e3
        axes.set(xlim=(middle - width, middle + width), ylim=(min(heights) - depth, max(heights) + depth))
        axes.set_aspect("equal")
    figure.tight_layout(rect=(0.0, 0.02, 1.0, 0.94))
    save_figure(figure, path)


def _draw_gels(axes: Axes, state: State, scene: Scene, poses: Mapping[str, Pose]) -> None:
    """Lattice lines of each gel's middle plane."""
    of_gels = [u for group in gel_arrays(state, "gel_displacement").values() for u in group]
    for index, (name, displacement) in enumerate(zip(scene.sensors, of_gels, strict=False)):
        u = displacement.astype(np.float64)
        shares = np.meshgrid(*(np.linspace(0.0, 1.0, n) for n in u.shape[:3]), indexing="ij")
        at = (np.stack(shares, axis=-1) - [0.5, 0.5, 1.0]) * np.array(scene.gel_of(name).size) * 1e3 + u
        cut = at[:, u.shape[1] // 2]
        cut = np.where(np.abs(cut) < 1e6, cut, np.nan)  # huge values and NaN are not drawn
        pose = poses[name]
        world = cut @ Rotation.from_quat(pose.quaternion).as_matrix().T + pose.position * 1e3
        for lines in (world, world.swapaxes(0, 1)):
            axes.plot(lines[..., 0], lines[..., 2], color=COLOURS[index], linewidth=0.5)


def _draw_particles(axes: Axes, state: State, scene: Scene) -> None:
    """Particles within one spacing of the middle plane, coloured by their volume ratio."""
    if "position" not in state:
        return
    x, volumes = state["position"].astype(np.float64), particle_volumes(state)
    finite = np.abs(x).max(axis=1) < 1e6
    middle = float(np.median(x[finite, 1])) if finite.any() else 0.0
    near = finite & (np.abs(x[:, 1] - middle) <= scene.spacing * 1e3)
    colour = np.ones(len(x)) if volumes is None else np.nan_to_num(volumes, nan=0.0, posinf=2.0, neginf=0.0)
    dots = axes.scatter(x[near, 0], x[near, 2], c=colour[near], s=6, cmap="coolwarm_r", vmin=0.8, vmax=1.2)
    axes.figure.colorbar(dots, ax=axes, shrink=0.6, label="volume ratio")


def _draw_indenter(axes: Axes, scene: Scene, poses: Mapping[str, Pose]) -> None:
    """Outline of the indenter in the middle plane, within 10 mm of its centre."""
    if scene.indenter is None:
        return
    pose, a = poses["indenter"], np.linspace(-10e-3, 10e-3, 161)
    x, z = np.meshgrid(a, a, indexing="ij")
    points = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    local = Rotation.from_quat(pose.quaternion).inv().apply(points)
    value = shape_distance(scene.indenter.geometry, local).reshape(x.shape)
    at = pose.position * 1e3
    axes.contour(x * 1e3 + at[0], z * 1e3 + at[2], value, levels=[0.0], colors=INK, linewidths=1.2)
