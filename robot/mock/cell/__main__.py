"""The process of a simulated cell (`python -m robot.mock.cell`, started by robot.mock.cell.sim_server).

It runs at low priority on one thread, so that the control loops on the same machine keep their periods.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from itertools import count
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robot.common.process import Arrays, Message, Parent
from robot.mock.cell.hertz import HertzCell
from robot.mock.cell.sim_server import numbers_of, pose_of
from tacsim.interface import FloatArray, Pose, SurfaceMap, Truth
from tacsim.models.scene import Scene
from tacsim.models.sensor import CanonicalGrid, SensorModel
from tacsim.optics.noise import noise_source
from tacsim.optics.render import Renderer
from tacsim.optics.surface import surface_map
from tacsim.pose import pose_distance

if TYPE_CHECKING:
    from tacsim.physics.world import World


class CellModel(Protocol):
    """The contents of the cell: simulated (WorldCell), or in closed form (HertzCell)."""

    @property
    def stats(self) -> Mapping[str, float]: ...
    def poses(self) -> Mapping[str, Pose]: ...
    def place(self, poses: Mapping[str, Pose]) -> None: ...
    def move(self, poses: Mapping[str, Pose]) -> None: ...
    def wrench(self, name: str) -> FloatArray: ...
    def render(self, name: str) -> tuple[NDArray[np.uint8], SurfaceMap]: ...
    def truth(self) -> Truth | None: ...


class WorldCell:
    """The simulated world and its renderers."""

    def __init__(self, scene: Scene, models: Mapping[str, SensorModel], grid: CanonicalGrid) -> None:
        from tacsim.physics.world import make_world

        self.world: World = make_world(scene)
        self._initial = self.world.snapshot()
        self._models, self._grid = models, grid
        self._renderers = {name: Renderer(model, scene.gel_of(name).size[:2]) for name, model in models.items()}
        self._noise = {name: noise_source(model, name) for name, model in models.items()}
        self._pictures = count()
        self.stats: dict[str, float] = {}

    def poses(self) -> dict[str, Pose]:
        return {name: self.world.pose(name) for name in self.world.sensors}

    def place(self, poses: Mapping[str, Pose]) -> None:
        self.world.restore(self._initial)
        self.move(poses)

    def move(self, poses: Mapping[str, Pose]) -> None:
        same_place = 1e-7  # a smaller motion of a sensor is not simulated [m, and rad over 0.1]
        targets = {}
        for name, pose in poses.items():
            metres, radians = pose_distance(self.world.pose(name), pose)
            if max(metres, 0.1 * radians) > same_place:
                targets[name] = pose
        if targets:
            self.stats = {key: float(value) for key, value in asdict(self.world.move(targets)).items()}

    def wrench(self, name: str) -> FloatArray:
        return self.world.wrench(name)

    def render(self, name: str) -> tuple[NDArray[np.uint8], SurfaceMap]:
        surface = self.world.surface(name)
        image, noise = self._renderers[name](surface), self._noise[name]
        if noise is not None:
            image = noise(image, next(self._pictures))
        return image, surface_map(surface, self._grid, self._models[name].markers)

    def truth(self) -> Truth | None:
        return self.world.truth()


class Server:
    """Opens the cell that the first request describes, and moves its sensors by later requests."""

    def __init__(self) -> None:
        self._cell: CellModel | None = None
        self._rendered: list[str] = []

    def answer(self, request: dict[str, Any], _: Arrays) -> Message:
        began = time.perf_counter()
        if request["do"] == "open":
            self._open(request)
        cell = self._cell
        assert cell is not None
        if request["do"] == "open":
            return {"poses": {name: numbers_of(pose) for name, pose in cell.poses().items()}}, {}
        poses = {name: pose_of(numbers) for name, numbers in request["poses"].items()}
        (cell.place if request["do"] == "place" else cell.move)(poses)
        return self._scene_frame(cell, time.perf_counter() - began)

    def _open(self, request: Mapping[str, Any]) -> None:
        niceness = 19
        scene = Scene.model_validate_json(json.dumps(request["scene"]))
        models = {name: SensorModel.model_validate_json(json.dumps(model)) for name, model in request["models"].items()}
        kind: Callable[..., CellModel] = HertzCell if request["contact"] == "hertz" else WorldCell
        if kind is WorldCell:
            os.nice(niceness)
        self._cell = kind(scene, models, CanonicalGrid.model_validate(request["grid"]))
        self._rendered = list(models)

    def _scene_frame(self, cell: CellModel, seconds: float) -> Message:
        arrays: dict[str, NDArray[Any]] = {}
        for name in self._rendered:
            arrays[f"image.{name}"], surface = cell.render(name)
            arrays |= {f"height.{name}": surface.height, f"gradient.{name}": surface.gradient}
            if surface.flow is not None:
                arrays[f"flow.{name}"] = surface.flow
        answer: dict[str, Any] = {
            "wrenches": {name: cell.wrench(name).tolist() for name in cell.poses()},
            "stats": dict(cell.stats),
            "seconds": seconds,
            "truth": None,
        }
        truth = cell.truth()
        if truth is not None:
            poses = {name: numbers_of(pose) for name, pose in truth.poses.items()}
            answer["truth"] = {"height": truth.height, "position": truth.position.tolist(), "poses": poses}
            arrays["points"] = truth.points
        return answer, arrays


if __name__ == "__main__":
    Parent().serve(Server().answer)
