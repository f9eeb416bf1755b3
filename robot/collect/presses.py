"""A set of presses: what is drawn for each, and the picture and labels that come of it.

Each press is a function of the set's settings and its number alone, so it is of no matter who makes it, or when.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from robot.collect.job import Piece, Seconds
from robot.collect.table import Row, parquet_bytes, press_columns
from robot.export.lerobot_mapping import Feature
from robot.studies.press import PressMotion, PressResult, press, require_reachable
from tacsim import pose as se3
from tacsim.geometry.shapes import rotated_bounding_size
from tacsim.interface import Pose
from tacsim.models.quantity import Config
from tacsim.models.scene import Mesh, Scene, Shape
from tacsim.models.sensor import Markers, SensorModel
from tacsim.optics.grid import image_grid
from tacsim.optics.markers import marker_flow
from tacsim.optics.noise import noise_source
from tacsim.optics.render import Renderer
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.record.images import encode_png

Range = Annotated[tuple[float, float], Field(description="least and greatest, all between equally likely")]


class PressSet(Config):
    """All that presses are a function of, besides their numbers. SI units; paths are those in the set's folder."""

    kind: Literal["press"] = "press"
    seed: Annotated[int, Field(ge=0)] = 0
    objects: Annotated[dict[str, Shape], Field(min_length=1)]  # pressed in turn
    scene: Scene  # with an indenter, whose geometry each object takes
    sensor: SensorModel
    depth: Range
    pose: Literal["random", "centred"] = "random"
    tilt: Range = (0.0, 0.0)  # off the vertical, any way [rad]
    shear: Range = (0.0, 0.0)  # sideways once pressed, any way [m]
    twist: Range = (0.0, 0.0)  # about the vertical, last [rad]
    per_file: Annotated[int, Field(ge=1, le=10_000)] = 50

    @model_validator(mode="after")
    def _possible(self) -> Self:
        for name in ("depth", "tilt", "shear", "twist"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name} goes from {low:g} to {high:g}: say the smaller one first")
        for name in ("tilt", "shear"):
            if getattr(self, name)[0] < 0:
                raise ValueError(
                    f"{name} begins at {getattr(self, name)[0]:g}: it goes any way, so give its size alone"
                )
        if self.tilt[1] > math.radians(45.0):
            raise ValueError(f"tilt goes to {math.degrees(self.tilt[1]):g} deg; at most 45 deg")
        if self.scene.indenter is None:
            raise ValueError(f"scene '{self.scene.name}' has no indenter")
        for depth in self.depth:
            require_reachable(self.scene.gel, PressMotion(depth, (self.shear[1], 0.0), max(map(abs, self.twist))))
        return self

    @property
    def lattice(self) -> Markers:
        """The points whose flow is told: the sensor's dots, or every millimetre of its picture."""
        flow_pitch = 1e-3  # of the points whose flow is told of a sensor without dots [m]
        if self.sensor.markers is not None:
            return self.sensor.markers
        grid = image_grid(self.sensor.geometry)
        rows, columns = (int(side * grid.pitch / flow_pitch - 0.5) for side in grid.shape)
        return Markers(rows=max(1, min(rows, 100)), columns=max(1, min(columns, 100)), pitch=flow_pitch)

    @property
    def columns(self) -> dict[str, Feature]:
        """What each column of the set's files holds, by its name."""
        return press_columns(tuple(self.objects), self.sensor.geometry, self.lattice)

    def placed(self, index: int) -> tuple[str, Scene, PressMotion]:
        """The object of a press, its scene and its motion. More options draw no other numbers for the rest."""
        names = list(self.objects)
        name = names[index % len(names)]
        assert self.scene.indenter is not None
        indenter = self.scene.indenter.model_copy(update={"geometry": self.objects[name]})
        scene = self.scene.model_copy(update={"indenter": indenter})
        random = np.random.default_rng([self.seed, index])
        depth, x, y, yaw, tilt, tilted, shear, sheared, twist = random.random(9)
        slide = _within(self.shear, shear) * _direction(sheared)
        motion = PressMotion(_within(self.depth, depth), (float(slide[0]), float(slide[1])), _within(self.twist, twist))
        if self.pose == "centred":
            return name, scene, motion
        low, high = self._room(self.objects[name])
        at = low + (high - low) * [x, y]
        about = _within(self.tilt, tilt) * _direction(tilted)
        upright = se3.from_rotation_vector(np.zeros(3), [0.0, 0.0, 2 * np.pi * yaw])
        turned = se3.compose(se3.from_rotation_vector(np.zeros(3), [*about, 0.0]), upright)
        if indenter.roll or indenter.pitch:  # which side is down is the scene's, yaw and tilt are drawn
            turned = se3.compose(turned, Pose(quaternion=indenter.turn))
        turn = turned.quaternion
        return name, scene, replace(motion, at=(float(at[0]), float(at[1])), turn=turn)

    def _room(self, geometry: Shape) -> tuple[Any, Any]:
        """Where the middle of an object comes down, lowest and highest x, y [m]: half of its longer side away from the
        border of gel and picture, which the corners of what is turned may so leave; for a larger object, amidst."""
        grid, gel = image_grid(self.sensor.geometry), np.array(self.scene.gel.size[:2]) / 2
        low = np.maximum(-gel, [grid.x[0], grid.y[0]])
        high = np.minimum(gel, [grid.x[-1], grid.y[-1]])
        assert self.scene.indenter is not None
        half = float(rotated_bounding_size(geometry, self.scene.indenter.turn)[:2].max()) / 2
        middle = (low + high) / 2
        return np.minimum(low + half, middle), np.maximum(high - half, middle)

    def in_folder(self, folder: Path) -> PressSet:
        """The same with the paths of files in the set's folder."""
        objects = {
            name: each.model_copy(update={"path": str(folder / each.path)}) if isinstance(each, Mesh) else each
            for name, each in self.objects.items()
        }
        sensor, background = self.sensor, self.sensor.lighting.background
        if isinstance(background, str):
            lighting = sensor.lighting.model_copy(update={"background": str(folder / background)})
            sensor = sensor.model_copy(update={"lighting": lighting})
        return self.model_copy(update={"objects": objects, "sensor": sensor})


@dataclass(frozen=True, slots=True)
class PressJob:
    """Makes the files of a press set. `folder` holds its objects, and the picture of its sensor's background."""

    settings: PressSet
    count: int

    @property
    def pieces(self) -> int:
        return -(-self.count // self.settings.per_file)

    def name(self, piece: int) -> str:
        return f"data/train-{piece:05d}.parquet"

    def numbers(self, piece: int) -> range:
        first = piece * self.settings.per_file
        return range(first, min(first + self.settings.per_file, self.count))

    def worker(self, folder: Path) -> PressWorker:
        return PressWorker(self, folder)


class PressWorker:
    """Makes files one after the other, and keeps what they share."""

    def __init__(self, job: PressJob, folder: Path) -> None:
        self._job, self._set = job, job.settings.in_folder(folder)
        sensor = self._set.sensor
        self._render = Renderer(sensor, self._set.scene.gel.size[:2])
        self._noise = noise_source(sensor, "lower")
        self._lattice = self._set.lattice

    def piece(self, number: int) -> Piece:
        """The file of this number. A press that fails is none of its rows.

        Files begin with different objects, so that workers who begin together do not all compute the distances of one.
        """
        golden_ratio = 0.618034  # its multiples, without their whole parts, lie evenly in 0 to 1 however many there are
        rows: dict[int, Row] = {}
        failures: dict[int, str] = {}
        seconds = Seconds()
        numbers = self._job.numbers(number)
        among = len(self._set.objects)
        first = (int(golden_ratio * number % 1 * among) - numbers[0]) % among % len(numbers)
        for index in (*numbers[first:], *numbers[:first]):
            try:
                rows[index] = self._row(index, seconds)
            except (SimulationDiverged, ValueError, MemoryError) as failure:
                failures[index] = f"{type(failure).__name__}: {failure}"
        began = time.perf_counter()
        data = parquet_bytes(self._set.columns, [rows[index] for index in sorted(rows)]) if rows else None
        seconds.add("file", time.perf_counter() - began)
        return Piece(number, data, dict(sorted(failures.items())), len(rows), seconds.by_part)

    def _row(self, index: int, seconds: Seconds) -> Row:
        name, scene, motion = self._set.placed(index)
        began = time.perf_counter()
        pressed = press(scene, self._set.sensor, motion, self._render)
        seconds.add("press", time.perf_counter() - began)
        began = time.perf_counter()
        row = self._labelled(index, name, motion, pressed)
        seconds.add("labels", time.perf_counter() - began)
        return row

    def _labelled(self, index: int, name: str, motion: PressMotion, pressed: PressResult) -> Row:
        import cv2

        image = pressed.image
        if self._noise is not None:
            image = self._noise(image, index, self._set.seed)
        written, contact = cv2.imencode(".png", 255 * pressed.contact.astype(np.uint8))
        assert written
        pixel = self._set.sensor.geometry.pixel_pitch**2
        wrench, pose = pressed.wrench, pressed.pose
        return {
            "index": index,
            "object": list(self._set.objects).index(name),
            "image": encode_png(image),
            "height": pressed.height,
            "contact": contact.tobytes(),
            "flow": marker_flow(pressed.surface, self._lattice),
            "normal_force": -wrench[2],
            "shear_force": wrench[:2],
            "torque": wrench[3:],
            "depth": motion.depth,
            "shear": motion.slide,
            "twist": motion.twist,
            "position": pose.position,
            "quaternion": pose.quaternion,
            "contact_area": float(pressed.contact.sum()) * pixel,
            "unfelt": pressed.unfelt,
            "folded": pressed.folded,
            "settled": all(move.settled for move in pressed.moves),
        }


def reference(settings: PressSet, folder: Path) -> bytes:
    """The picture of the untouched gel, without noise (PNG)."""
    from tacsim.models.scene import GelSurface

    inside = settings.in_folder(folder)
    x, y = inside.scene.gel.size[:2]
    spacing = max(x, y) / 8
    shape = (math.ceil(x / spacing) + 1, math.ceil(y / spacing) + 1)
    flat = GelSurface(
        np.zeros((*shape, 3), np.float32), spacing, (-(shape[0] - 1) * spacing / 2, -(shape[1] - 1) * spacing / 2)
    )
    return encode_png(Renderer(inside.sensor, (x, y))(flat))


def _within(between: tuple[float, float], share: float) -> float:
    return float(between[0] + (between[1] - between[0]) * share)


def _direction(share: float) -> Any:
    return np.array([math.cos(2 * math.pi * share), math.sin(2 * math.pi * share)])
