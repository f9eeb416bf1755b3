"""Repeats recorded motions in simulation with other materials, many at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.materials.estimate import CannotSimulate
from calibration.materials.fit import Parameter, Point, Press
from tacsim import pose as se3
from tacsim.geometry.shapes import depth_below_centre
from tacsim.interface import FloatArray, Pose
from tacsim.models.scene import Box, Scene, Shape, Sphere
from tacsim.models.sensor import CanonicalGrid, Markers
from tacsim.optics.surface import surface_map
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.worlds.batch import Batch

Job = tuple[tuple[float, ...], float, float, int]  # values of the parameters, place [m], size, index of the press


@dataclass(frozen=True, slots=True, eq=False)
class SensorView:
    """Grid and markers with which a sensor measured height and flow, to compute the simulated ones in the same way."""

    grid: CanonicalGrid
    markers: Markers | None
    valid: NDArray[np.bool_]  # (h, w)


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """The simulated presses, as a function that `estimate_materials` calls.

    Quasi-static forces are proportional to all moduli and stresses together, and the shape depends on their ratios
    alone. So a gel under a rigid indenter is simulated with the stiffness of the scene, and its forces are scaled,
    which is exact.
    """

    scene: Scene
    parameters: tuple[Parameter, ...]
    presses: tuple[Press, ...]
    sensor_views: Mapping[str, SensorView]
    on_run: Callable[[int, int], None] = lambda done, total: None

    def __call__(self, points: Sequence[Point]) -> list[FloatArray]:
        """(m,) signals at each point, in the order of `signals_of`. Raises CannotSimulate."""
        batch_size = 16  # presses in one batch
        keys = [[self._job_key(point, index) for index in range(len(self.presses))] for point in points]
        jobs = list(dict.fromkeys(key for each in keys for key in each))
        ran: dict[Job, FloatArray] = {}
        for begin in range(0, len(jobs), batch_size):
            part = jobs[begin : begin + batch_size]
            self.on_run(begin, len(jobs))
            ran |= zip(part, self._run_batch(part), strict=True)
        self.on_run(len(jobs), len(jobs))
        result = []
        for point, each in zip(points, keys, strict=True):
            stiffness = self._values(point).get("youngs_modulus", self._stiffness)
            scale = stiffness / self._stiffness if self._scaled else 1.0
            rows = []
            for press, key in zip(self.presses, each, strict=True):
                for row, (name, values) in enumerate(press.readings.items()):
                    force = name.rpartition(".")[2] in ("fx", "fy", "fz")
                    rows.append(ran[key][row, np.isfinite(values)] * (scale if force else 1.0))
            result.append(np.concatenate(rows))
        return result

    def by_size(self, point: Point) -> FloatArray:
        """(m,) derivative of the signals by the logarithm of the indenter's size. Raises CannotSimulate."""
        size_step = 0.1  # step of the logarithm of the indenter's size
        base, larger = self([point, replace(point, size=size_step)])
        found: FloatArray = (larger - base) / size_step
        return found

    @property
    def _scaled(self) -> bool:
        return self.scene.indenter is not None

    @property
    def _stiffness(self) -> float:
        return self.scene.gel.material.youngs_modulus

    def _values(self, point: Point) -> dict[str, float]:
        return {each.name: each.value(float(free)) for each, free in zip(self.parameters, point.free, strict=True)}

    def _job_key(self, point: Point, index: int) -> Job:
        values = self._values(point)
        if self._scaled:
            values["youngs_modulus"] = self._stiffness
        return tuple(values[each.name] for each in self.parameters), float(point.places[index]), point.size, index

    def _run_batch(self, jobs: Sequence[Job]) -> list[FloatArray]:
        """(channels, moments) of each job."""
        scenes = [self._job_scene(job) for job in jobs]
        batch = Batch([scene for scene, _ in scenes])
        paths = [
            _path(self.presses[index], place - raised)
            for (_, place, _, index), (_, raised) in zip(jobs, scenes, strict=True)
        ]
        for world, path in zip(batch.worlds, paths, strict=True):
            first = {part: poses[0] for part, poses in path.items()}
            clear = {part: world.pose(part) for part in first}
            world.place({
                part: Pose(np.array([*pose.position[:2], clear[part].position[2]]), clear[part].quaternion)
                for part, pose in first.items()
            })  # fmt: skip
        found: list[list[list[float]]] = [[] for _ in jobs]
        lengths = [len(self.presses[index].time) for *_, index in jobs]
        for moment in range(max(lengths)):
            targets = [
                {part: poses[moment] for part, poses in path.items()} if moment < length else None
                for path, length in zip(paths, lengths, strict=True)
            ]
            for member, ended in enumerate(batch.move(targets)):
                if isinstance(ended, SimulationDiverged):
                    values, *_, index = jobs[member]
                    parameters = ", ".join(
                        f"{each.name} {value:.4g}" for each, value in zip(self.parameters, values, strict=True)
                    )
                    raise CannotSimulate(
                        f"{self.presses[index].name}, moment {moment + 1}, with {parameters}: {ended}"
                    ) from ended
                if targets[member] is not None:
                    found[member].append(self._simulated_signals(batch, member, self.presses[jobs[member][-1]]))
        return [np.array(rows).T for rows in found]

    def _job_scene(self, job: Job) -> tuple[Scene, float]:
        """The scene of a job, and the height of its indenter's centre above the recorded one [m], at which the lowest
        point of an indenter of another size is in the same place."""
        values, _, size, index = job
        named = {each.name: value for each, value in zip(self.parameters, values, strict=True)}
        scene = scene_with(self.scene, named)
        if scene.indenter is None:
            return scene, 0.0
        ball = self.presses[index].ball
        stated = scene.indenter.geometry if ball is None else Sphere(radius=ball)
        shape = resized(stated, math.exp(size)) if size else stated
        indenter = scene.indenter.model_copy(update={"geometry": shape})
        higher = depth_below_centre(shape, indenter.turn) - depth_below_centre(stated, indenter.turn)
        return scene.model_copy(update={"indenter": indenter}), higher

    def _simulated_signals(self, batch: Batch, member: int, press: Press) -> list[float]:
        """One number for each channel of the press, in the present state of the world."""
        world = batch.worlds[member]
        readings: dict[str, float] = {}
        for sensor in world.sensors:
            wrench = world.wrench(sensor)
            readings |= {f"{sensor}.{name}": float(wrench[k]) for k, name in enumerate(("fx", "fy", "fz"))}
            if sensor in self.sensor_views:
                view = self.sensor_views[sensor]
                surface = surface_map(world.surface(sensor), view.grid, view.markers)
                readings |= shape_signals(sensor, surface.height, surface.flow, view.valid, view.grid.pitch)
        return [readings[name] for name in press.readings]


def shape_signals(
    sensor: str,
    height: NDArray[np.float32] | None,
    flow: NDArray[np.float32] | None,
    valid: NDArray[np.bool_],
    pitch: float,
) -> dict[str, float]:
    """The fitted signals of a sensor's height map (points `pitch` apart) and flow, all in metres: root mean square of
    the height; width of the dent, which is the radius of a circle of the area (sum h^2)^2 / sum h^4; mean flow.

    The width hardly depends on the material; it is proportional to the square root of a ball's radius.
    """
    contact_share = 0.25  # of the largest depth; deeper points belong to the dent
    found = {}
    if height is not None:
        square = height[valid].astype(np.float64) ** 2
        found[f"{sensor}.dent"] = float(np.sqrt(np.mean(square)))
        deep = square[square > contact_share**2 * square.max()]
        share = float(deep.sum() ** 2 / (deep**2).sum()) if len(deep) else 0.0
        found[f"{sensor}.width"] = pitch * math.sqrt(share / math.pi)
    if flow is not None:
        mean = flow.reshape(-1, 2).astype(np.float64).mean(axis=0)
        found |= {f"{sensor}.slip_x": float(mean[0]), f"{sensor}.slip_y": float(mean[1])}
    return found


def _path(press: Press, place: float) -> dict[str, list[Pose]]:
    """The poses of a press whose parts were nearer to each other by `place` [m] than recorded."""
    path = {part: list(poses) for part, poses in press.poses.items()}
    if "indenter" in path:
        path["indenter"] = [
            Pose(pose.position - np.array([0.0, 0.0, place]), pose.quaternion) for pose in path["indenter"]
        ]
    else:
        path["upper"] = [se3.translated_along_z(pose, place) for pose in path["upper"]]
    return path


def resized(shape: Shape, factor: float) -> Shape:
    """The shape with all its lengths times `factor`."""
    lengths = {name: getattr(shape, name) * factor for name in ("radius", "height", "scale") if hasattr(shape, name)}
    if isinstance(shape, Box):
        lengths["size"] = tuple(each * factor for each in shape.size)
    return shape.model_copy(update=lengths)


def scene_with(scene: Scene, values: Mapping[str, float]) -> Scene:
    """The scene with these materials and frictions, by the names of the parameters."""
    if scene.indenter is not None:
        gel = {name: values[name] for name in ("youngs_modulus", "poisson_ratio") if name in values}
        indenter = {"friction": values["friction"]} if "friction" in values else {}
        return scene.model_copy(
            update={
                "gel": scene.gel.model_copy(update={"material": scene.gel.material.model_copy(update=gel)}),
                "indenter": scene.indenter.model_copy(update=indenter),
            }
        )
    assert scene.body is not None
    material = {
        name: values[name] for name in ("youngs_modulus", "yield_stress", "hardening_modulus") if name in values
    }
    if "yield_stress" in material:
        material |= {"yield_norm": "uniaxial", "yield_strain": None}  # type: ignore[dict-item]
    friction = {name: values.get(f"friction_{name}", scene.friction[name]) for name in scene.friction}
    body = scene.body.model_copy(update={"material": scene.body.material.model_copy(update=material)})
    return scene.model_copy(update={"body": body, "friction": friction})


def coarser(scene: Scene) -> Scene:
    """The scene with a mesh twice as coarse, but at least two layers of elements in each gel."""
    layers = {name: scene.gel_of(name).size[2] / 2 for name in scene.sensors}
    gels = {
        name: gel
        if gel.element_size is None
        else gel.model_copy(update={"element_size": min(2 * gel.element_size, layers[name])})
        for name, gel in scene.gels.items()
    }
    own = {name for name, each in gels.items() if each.element_size is not None}
    element = min([2 * scene.effective_element_size, *(layers[name] for name in scene.sensors if name not in own)])
    update = {"element_size": element, "particle_spacing": 2 * scene.spacing, "gels": gels}
    return scene.model_copy(update=update)
