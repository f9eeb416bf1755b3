"""Handle of the simulated cell's process: it takes sensor poses and returns tactile images and contact forces.

Materials are rate independent, so results depend on the path of the poses, not on the duration of a simulated motion.
The process (`robot/mock/cell/__main__.py`) does not use arms and cameras; robot.mock.cell.cell connects them.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from robot.common.process import Arrays, Child
from robot.errors import DeviceError
from tacsim.interface import FloatArray, Pose, SurfaceMap, Truth

if TYPE_CHECKING:
    from tacsim.models.scene import Scene
    from tacsim.models.sensor import CanonicalGrid, SensorModel

ANSWER_TIMEOUT = 600.0  # of one request: a first motion compiles, a difficult one takes many substeps [s]


class SimServerError(DeviceError):
    """The simulation of the cell failed: its motion diverged, or its process ended."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneFrame:
    """The scene after a motion."""

    index: int  # counts the motions
    time: float  # when it was ready, monotonic [s]
    images: Mapping[str, NDArray[np.uint8]]  # (H, W, 3) RGB by sensor
    surfaces: Mapping[str, SurfaceMap]  # by sensor, on the canonical grid
    wrenches: Mapping[str, FloatArray]  # (6,) on each sensor, about its origin, its axes [N, N m]
    truth: Truth | None  # of the body
    stats: Mapping[str, float]  # how the simulated motion went (tacsim.physics.world.MoveStats)
    seconds: float  # duration of the simulated motion [s]


class SimServer(Child):
    """Starts the process for a scene and sends requests to it.

    Args:
        models: of the sensors that are rendered, by name.
        grid: canonical grid on which surfaces are sampled.
        contact: the scene's gels and body, or a ball before each gel in closed form (robot.mock.cell.hertz).
    """

    def __init__(
        self,
        scene: Scene,
        models: Mapping[str, SensorModel],
        grid: CanonicalGrid,
        contact: Literal["simulated", "hertz"] = "simulated",
    ) -> None:
        self._index = 0
        opened = {
            "scene": scene.model_dump(mode="json"),
            "models": {name: model.model_dump(mode="json") for name, model in models.items()},
            "grid": grid.model_dump(),
        }
        super().__init__(
            "robot.mock.cell",
            name="simulated cell",
            error=SimServerError,
            advice="open the rig again",
            environment={"TACSIM_THREADS": os.environ.get("TACSIM_THREADS", "1")},
            ready_timeout=ANSWER_TIMEOUT,
            first_request={"do": "open", "contact": contact, **opened},
        )
        poses = self.ready["poses"]
        self.initial = {name: pose_of(numbers) for name, numbers in poses.items()}  # of the sensors

    def place(self, poses: Mapping[str, Pose]) -> SceneFrame:
        """Puts a fresh body into the cell, with the sensors at `poses`, without contact. Raises SimServerError."""
        return self._move("place", poses)

    def move(self, poses: Mapping[str, Pose]) -> SceneFrame:
        """Moves the sensors to `poses`. Raises SimServerError if the motion diverges; the scene stays as before."""
        return self._move("move", poses)

    def _move(self, what: str, poses: Mapping[str, Pose]) -> SceneFrame:
        request = {"do": what, "poses": {name: numbers_of(pose) for name, pose in poses.items()}}
        answer, arrays = self.request(request, timeout=ANSWER_TIMEOUT)
        self._index += 1
        return SceneFrame(
            index=self._index,
            time=time.monotonic(),
            images={name.removeprefix("image."): a for name, a in arrays.items() if name.startswith("image.")},
            surfaces={
                name: SurfaceMap(arrays[f"height.{name}"], arrays[f"gradient.{name}"], arrays.get(f"flow.{name}"))
                for name in answer["wrenches"]
                if f"height.{name}" in arrays
            },
            wrenches={name: np.array(numbers) for name, numbers in answer["wrenches"].items()},
            truth=_truth(answer["truth"], arrays),
            stats=answer["stats"],
            seconds=answer["seconds"],
        )


def _truth(body: dict[str, Any] | None, arrays: Arrays) -> Truth | None:
    if body is None:
        return None
    poses = {name: pose_of(numbers) for name, numbers in body["poses"].items()}
    return Truth(body["height"], np.array(body["position"]), arrays["points"], poses)


def numbers_of(pose: Pose) -> list[float]:
    """A pose in a message: position [m] and quaternion."""
    return [*map(float, pose.position), *map(float, pose.quaternion)]


def pose_of(numbers: list[float]) -> Pose:
    """The pose of seven numbers in a message."""
    return Pose(np.array(numbers[:3]), np.array(numbers[3:]))
