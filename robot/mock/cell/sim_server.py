"""The simulated cell in a process of its own: sensor poses go in, tactile images and contact forces come out.

Materials are rate independent, so only the path of the poses counts, not how long a simulated motion takes. The process
knows nothing of arms and cameras; robot.mock.cell.cell joins them. It runs at low priority and on one thread, so that
the control loops on the same machine keep their time, and ends with its parent.

On the wire: a length, a line of JSON, and the arrays that the line announces.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import selectors
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from robot.errors import DeviceError
from tacsim.interface import FloatArray, Pose, SurfaceMap, Truth

if TYPE_CHECKING:
    from tacsim.models.scene import Scene
    from tacsim.models.sensor import CanonicalGrid, SensorModel
    from tacsim.physics.world import World

PATIENCE = 600.0  # for one answer: a first motion compiles, a hard one takes many substeps [s]
NICENESS = 19
SAME = 1e-7  # a sensor that moved less has not moved [m, and rad over 0.1]
_HEAD = struct.Struct(">II")  # length of the JSON, length of the arrays
LARGEST = 256 * 2**20  # bytes of a message


class SimServerError(DeviceError):
    """The simulated cell failed: its motion diverged, or its process ended."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneFrame:
    """What the cell looks like after a motion."""

    index: int  # counts the motions
    time: float  # when it was ready, monotonic [s]
    images: Mapping[str, NDArray[np.uint8]]  # (H, W, 3) RGB by sensor
    surfaces: Mapping[str, SurfaceMap]  # by sensor, on the canonical grid
    wrenches: Mapping[str, FloatArray]  # (6,) on each sensor, about its origin, its axes [N, N m]
    truth: Truth | None  # of the body
    stats: Mapping[str, float]  # how the simulated motion went (tacsim.physics.world.MoveStats)
    seconds: float  # that it took


class SimServer:
    """Starts the process for a scene and talks to it. One request at a time; not for several threads.

    Args:
        models: what is rendered of each sensor.
        grid: on which surfaces are sampled.
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
        root = str(Path(__file__).resolve().parents[3])
        path = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "robot.mock.cell.sim_server"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={"TACSIM_THREADS": "1", **os.environ, "PYTHONPATH": path},
        )
        self.pid = self._process.pid
        try:
            config = {name: model.model_dump(mode="json") for name, model in models.items()}
            scene_frame = {"scene": scene.model_dump(mode="json"), "models": config, "grid": grid.model_dump()}
            said, _ = self._ask({"do": "open", "contact": contact, **scene_frame})
        except BaseException:
            self.close()
            raise
        self.initial = {name: _pose(numbers) for name, numbers in said["poses"].items()}  # of the sensors

    def place(self, poses: Mapping[str, Pose]) -> SceneFrame:
        """Puts a fresh body on the cell, with the sensors at `poses`, clear of it. Raises SimServerError."""
        return self._move("place", poses)

    def move(self, poses: Mapping[str, Pose]) -> SceneFrame:
        """Drives the sensors to `poses`. Raises SimServerError when the motion diverges; the cell is as before then."""
        return self._move("move", poses)

    def _move(self, what: str, poses: Mapping[str, Pose]) -> SceneFrame:
        said, arrays = self._ask({"do": what, "poses": {name: _numbers(pose) for name, pose in poses.items()}})
        truth = None
        if said["truth"] is not None:
            body = said["truth"]
            there = {name: _pose(numbers) for name, numbers in body["poses"].items()}
            truth = Truth(body["height"], np.array(body["position"]), arrays["points"], there)
        self._index += 1
        return SceneFrame(
            index=self._index,
            time=time.monotonic(),
            images={name.removeprefix("image."): a for name, a in arrays.items() if name.startswith("image.")},
            surfaces={
                name: SurfaceMap(arrays[f"height.{name}"], arrays[f"gradient.{name}"], arrays.get(f"flow.{name}"))
                for name in said["wrenches"]
                if f"height.{name}" in arrays
            },
            wrenches={name: np.array(numbers) for name, numbers in said["wrenches"].items()},
            truth=truth,
            stats=said["stats"],
            seconds=said["seconds"],
        )

    def _ask(self, request: dict[str, Any]) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        pipe_in, pipe_out = self._process.stdin, self._process.stdout
        assert pipe_in is not None and pipe_out is not None
        if pipe_in.closed:
            raise SimServerError(f"the simulated cell (process {self.pid}) is closed; open the rig anew")
        try:
            write_message(pipe_in, request)
            with selectors.DefaultSelector() as ready:
                ready.register(pipe_out, selectors.EVENT_READ)
                if not ready.select(PATIENCE):
                    raise SimServerError(f"the simulated cell gave no answer within {PATIENCE:g} s and was ended")
            message = read_message(pipe_out)
            if message is None:
                raise OSError("it has ended")
        except BaseException as failure:  # also Ctrl-C: an answer left in the pipe would be taken for the next one
            self.close()
            if isinstance(failure, (OSError, ValueError)):
                raise SimServerError(
                    f"the simulated cell (process {self.pid}, ended with {self._process.returncode}) cannot be asked: "
                    f"{failure}; open the rig anew"
                ) from failure
            raise
        said, arrays = message
        if "error" in said:
            raise SimServerError(f"simulated cell: {said['error']}")
        return said, arrays

    def close(self) -> None:
        """Ends the process; again does nothing."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        try:
            self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


# ------------------------------------------------------------------ messages


def write_message(pipe: IO[bytes], said: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]] | None = None) -> None:
    arrays = arrays or {}
    listed = [[name, a.dtype.str, list(a.shape)] for name, a in arrays.items()]
    text = json.dumps({**said, "arrays": listed}).encode()
    body = b"".join(np.ascontiguousarray(a).tobytes() for a in arrays.values())
    pipe.write(_HEAD.pack(len(text), len(body)) + text + body)
    pipe.flush()


def read_message(pipe: IO[bytes]) -> tuple[dict[str, Any], dict[str, NDArray[Any]]] | None:
    """The next message; None at the end of the pipe. Raises ValueError for one that is no message."""
    head = pipe.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    text_length, body_length = _HEAD.unpack(head)
    if text_length + body_length > LARGEST:
        raise ValueError(f"a message of {text_length + body_length} bytes; the limit is {LARGEST}")
    text, body = pipe.read(text_length), pipe.read(body_length)
    if len(text) < text_length or len(body) < body_length:
        return None
    try:
        said: dict[str, Any] = json.loads(text)
        arrays: dict[str, NDArray[Any]] = {}
        start = 0
        for name, kind, shape in said.pop("arrays"):
            size = int(np.prod(shape)) * np.dtype(kind).itemsize
            arrays[name] = np.frombuffer(body[start : start + size], np.dtype(kind)).reshape(shape)
            start += size
    except (KeyError, TypeError, AttributeError) as failure:
        raise ValueError(f"no message: {type(failure).__name__}: {failure}") from failure
    return said, arrays


def _numbers(pose: Pose) -> list[float]:
    return [*map(float, pose.position), *map(float, pose.quaternion)]


def _pose(numbers: list[float]) -> Pose:
    return Pose(np.array(numbers[:3]), np.array(numbers[3:]))


# ------------------------------------------------------------------- process


class CellModel(Protocol):
    """What the process holds: simulated (:class:`WorldCell`), or in closed form (robot.mock.cell.hertz)."""

    @property
    def stats(self) -> Mapping[str, float]: ...
    def poses(self) -> Mapping[str, Pose]: ...
    def place(self, poses: Mapping[str, Pose]) -> None: ...
    def move(self, poses: Mapping[str, Pose]) -> None: ...
    def wrench(self, name: str) -> FloatArray: ...
    def look(self, name: str) -> tuple[NDArray[np.uint8], SurfaceMap]: ...
    def truth(self) -> Truth | None: ...


class WorldCell:
    """The simulated world and its renderers."""

    def __init__(self, scene: Scene, models: Mapping[str, SensorModel], grid: CanonicalGrid) -> None:
        from tacsim.optics.noise import noise_source
        from tacsim.optics.render import Renderer
        from tacsim.physics.world import make_world

        self.world: World = make_world(scene)
        self._initial = self.world.snapshot()
        self._models, self._grid = models, grid
        self._renderers = {name: Renderer(model, scene.gel.size[:2]) for name, model in models.items()}
        self._noise = {name: noise_source(model, name) for name, model in models.items()}
        self._looks = count()
        self.stats: dict[str, float] = {}

    def poses(self) -> dict[str, Pose]:
        return {name: self.world.pose(name) for name in self.world.sensors}

    def place(self, poses: Mapping[str, Pose]) -> None:
        self.world.restore(self._initial)
        self.move(poses)

    def move(self, poses: Mapping[str, Pose]) -> None:
        from tacsim.pose import distance

        targets = {}
        for name, pose in poses.items():
            metres, radians = distance(self.world.pose(name), pose)
            if max(metres, 0.1 * radians) > SAME:
                targets[name] = pose
        if targets:
            self.stats = {key: float(value) for key, value in asdict(self.world.move(targets)).items()}

    def wrench(self, name: str) -> FloatArray:
        return self.world.wrench(name)

    def look(self, name: str) -> tuple[NDArray[np.uint8], SurfaceMap]:
        from tacsim.optics.surface import surface_map

        surface = self.world.surface(name)
        image, noise = self._renderers[name](surface), self._noise[name]
        if noise is not None:
            image = noise(image, next(self._looks))
        return image, surface_map(surface, self._grid, self._models[name].markers)

    def truth(self) -> Truth | None:
        return self.world.truth()


def _open(request: Mapping[str, Any]) -> tuple[CellModel, list[str]]:
    """The cell that is asked for, and the sensors that are looked at."""
    from robot.mock.cell.hertz import HertzCell
    from tacsim.models.scene import Scene
    from tacsim.models.sensor import CanonicalGrid, SensorModel

    scene = Scene.model_validate_json(json.dumps(request["scene"]))
    models = {name: SensorModel.model_validate_json(json.dumps(model)) for name, model in request["models"].items()}
    kind: Callable[..., CellModel] = HertzCell if request["contact"] == "hertz" else WorldCell
    if kind is WorldCell:
        os.nice(NICENESS)
    return kind(scene, models, CanonicalGrid.model_validate(request["grid"])), list(models)


def _scene_frame(cell: CellModel, seen: list[str], seconds: float) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    arrays: dict[str, NDArray[Any]] = {}
    for name in seen:
        arrays[f"image.{name}"], surface = cell.look(name)
        arrays |= {f"height.{name}": surface.height, f"gradient.{name}": surface.gradient}
        if surface.flow is not None:
            arrays[f"flow.{name}"] = surface.flow
    said: dict[str, Any] = {
        "wrenches": {name: cell.wrench(name).tolist() for name in cell.poses()},
        "stats": dict(cell.stats),
        "seconds": seconds,
        "truth": None,
    }
    truth = cell.truth()
    if truth is not None:
        poses = {name: _numbers(pose) for name, pose in truth.poses.items()}
        said["truth"] = {"height": truth.height, "position": truth.position.tolist(), "poses": poses}
        arrays["points"] = truth.points
    return said, arrays


def main() -> None:
    """Answers requests on standard input until it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C means the parent, which ends this process in order
    answers = io.BufferedWriter(io.FileIO(os.dup(1), "wb"))
    os.dup2(2, 1)  # whoever prints shall not break a message
    requests = sys.stdin.buffer
    cell: CellModel | None = None
    seen: list[str] = []
    while (message := read_message(requests)) is not None:
        request, _ = message
        try:
            began = time.perf_counter()
            if request["do"] == "open":
                cell, seen = _open(request)
                write_message(answers, {"poses": {name: _numbers(pose) for name, pose in cell.poses().items()}})
                continue
            assert cell is not None
            poses = {name: _pose(numbers) for name, numbers in request["poses"].items()}
            (cell.place if request["do"] == "place" else cell.move)(poses)
            write_message(answers, *_scene_frame(cell, seen, time.perf_counter() - began))
        except Exception as failure:  # whatever it is, the other side says it
            write_message(answers, {"error": f"{type(failure).__name__}: {failure}"})


if __name__ == "__main__":
    main()
