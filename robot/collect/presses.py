"""A set of presses: the random motion of each, the picture and labels that result, and the columns of its Parquet
files, which `datasets`, pandas, DuckDB and others read.

Each press depends only on the set's settings and on its number, so any process can make it at any time.
"""

from __future__ import annotations

import io
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from robot.collect.workers import Piece, Seconds
from robot.export.lerobot_mapping import LABEL, Column, Feature, arrow_table
from robot.studies.press import PressMotion, PressResult, press, require_reachable
from tacsim import pose as se3
from tacsim.geometry.shapes import rotated_bounding_size
from tacsim.interface import Pose
from tacsim.models.quantity import Config
from tacsim.models.scene import Mesh, Scene, Shape
from tacsim.models.sensor import Markers, SensorGeometry, SensorModel
from tacsim.optics.grid import image_grid
from tacsim.optics.markers import marker_flow
from tacsim.optics.noise import noise_source
from tacsim.optics.render import Renderer
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.record.images import encode_png

Row = dict[str, Any]

# description of each column in the data card
COLUMN_TEXTS = {
    "index": "number of the press; with the seed it determines all random numbers",
    "object": "the object that was pressed",
    "image": "the sensor's picture, RGB",
    "height": "[m] of the gel's surface under each pixel: into the gel is positive, bulges are negative",
    "contact": "255 where the object touches the gel, 0 elsewhere, for each pixel",
    "flow": "[m] along x and y (image columns and rows) that points on the gel have moved, on an even lattice",
    "normal_force": "[N] on the gel, pressing is positive",
    "shear_force": "[N] on the gel along x and y",
    "torque": "[N m] on the gel about the middle of its rest surface, axes x, y, z (z is out of the gel)",
    "depth": "[m] of the object's lowest point below the undeformed surface",
    "shear": "[m] tangential displacement of the object along x and y, after the press",
    "twist": "[rad] rotation of the object about z, after the shear",
    "position": "[m] of the middle of the object's bounding box in the sensor's frame, at the end",
    "quaternion": "(x, y, z, w) of the object in that frame, at the end",
    "contact_area": "[m^2] of `contact`",
    "unfelt": "share of the depth that no contact point of the gel reaches; above 0.125 a tip or edge is too narrow "
    "for the mesh, and the forces are too small",
    "folded": "whether the gel folds over itself; picture and height show the sheet that the camera sees",
    "settled": "whether all motions came to rest within the scene's tolerance",
}


def press_columns(objects: Sequence[str], geometry: SensorGeometry, lattice: Markers) -> dict[str, Feature]:
    """Type and shape of each column, by name. objects: their names. lattice: the points at which flow is given."""
    shape = (geometry.height, geometry.width)
    number, pair, triple = (Feature("float64", (n,), None) for n in (1, 2, 3))
    return {
        "index": Feature("int64", (1,), None),
        "object": Feature(LABEL, (1,), tuple(objects)),
        "image": Feature("image", (*shape, 3), None),
        "height": Feature("float32", shape, None),
        "contact": Feature("image", shape, None),
        "flow": Feature("float32", (lattice.rows, lattice.columns, 2), None),
        "normal_force": number,
        "shear_force": pair,
        "torque": triple,
        "depth": number,
        "shear": pair,
        "twist": number,
        "position": triple,
        "quaternion": Feature("float64", (4,), None),
        "contact_area": number,
        "unfelt": number,
        "folded": Feature("bool", (1,), None),
        "settled": Feature("bool", (1,), None),
    }


def parquet_bytes(columns: Mapping[str, Feature], rows: Sequence[Row]) -> bytes:
    """A Parquet file with these rows. Numbers keep their precision and pictures are PNG, so the file is lossless."""
    rows_in_group = 25  # a reader of one row reads its whole group, about 10 MB
    from pyarrow import parquet

    values = {name: _column(feature, [row[name] for row in rows]) for name, feature in columns.items()}
    table = arrow_table(columns, values)
    maps = [f"{name}{'.list.element' * len(columns[name].shape)}" for name in ("height", "flow")]
    buffer = io.BytesIO()
    parquet.write_table(
        table,
        buffer,
        row_group_size=rows_in_group,
        compression="zstd",
        use_dictionary=False,  # measured numbers do not repeat
        column_encoding=dict.fromkeys(maps, "BYTE_STREAM_SPLIT"),  # groups bytes of equal significance: a third smaller
    )
    return buffer.getvalue()


def _column(feature: Feature, values: Sequence[Any]) -> Column:
    if feature.dtype == "image":
        return values
    dtype = "int64" if feature.dtype == LABEL else feature.dtype
    shape = () if feature.shape == (1,) else feature.shape
    return np.array(values, dtype).reshape(len(values), *shape)


Range = Annotated[tuple[float, float], Field(description="minimum and maximum of a uniform distribution")]


class PressSet(Config):
    """The settings that determine the presses, together with their numbers. SI units; paths in the set's folder."""

    kind: Literal["press"] = "press"
    seed: Annotated[int, Field(ge=0)] = 0
    objects: Annotated[dict[str, Shape], Field(min_length=1)]  # pressed in turn
    scene: Scene  # with an indenter, whose geometry each object takes
    sensor: SensorModel
    depth: Range
    pose: Literal["random", "centred"] = "random"
    tilt: Range = (0.0, 0.0)  # from the vertical, in a random direction [rad]
    shear: Range = (0.0, 0.0)  # tangential displacement after the press, in a random direction [m]
    twist: Range = (0.0, 0.0)  # rotation about the vertical after the shear [rad]
    per_file: Annotated[int, Field(ge=1, le=10_000)] = 50

    @model_validator(mode="after")
    def _possible(self) -> Self:
        for name in ("depth", "tilt", "shear", "twist"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name} ranges from {low:g} to {high:g}: give the smaller number first")
        for name in ("tilt", "shear"):
            if getattr(self, name)[0] < 0:
                raise ValueError(
                    f"{name} starts at {getattr(self, name)[0]:g}: its direction is random, so give a positive size"
                )
        if self.tilt[1] > math.radians(45.0):
            raise ValueError(f"tilt ranges to {math.degrees(self.tilt[1]):g} deg; at most 45 deg")
        if self.scene.indenter is None:
            raise ValueError(f"scene '{self.scene.name}' has no indenter")
        for depth in self.depth:
            require_reachable(self.scene.gel, PressMotion(depth, (self.shear[1], 0.0), max(map(abs, self.twist))))
        return self

    @property
    def lattice(self) -> Markers:
        """The points at which flow is given: the sensor's dots, or every millimetre of its picture."""
        flow_pitch = 1e-3  # of these points for a sensor without dots [m]
        if self.sensor.markers is not None:
            return self.sensor.markers
        grid = image_grid(self.sensor.geometry)
        rows, columns = (int(side * grid.pitch / flow_pitch - 0.5) for side in grid.shape)
        return Markers(rows=max(1, min(rows, 100)), columns=max(1, min(columns, 100)), pitch=flow_pitch)

    @property
    def columns(self) -> dict[str, Feature]:
        """What each column of the set's files holds, by its name."""
        return press_columns(tuple(self.objects), self.sensor.geometry, self.lattice)

    def draw_press(self, index: int) -> tuple[str, Scene, PressMotion]:
        """The object of a press, its scene and its motion. An additional option leaves the other random numbers as they
        are."""
        names = list(self.objects)
        name = names[index % len(names)]
        assert self.scene.indenter is not None
        indenter = self.scene.indenter.model_copy(update={"geometry": self.objects[name]})
        scene = self.scene.model_copy(update={"indenter": indenter})
        random = np.random.default_rng([self.seed, index])
        depth, x, y, yaw, tilt, tilted, shear, sheared, twist = random.random(9)
        slide = _interpolate_range(self.shear, shear) * _unit_vector(sheared)
        motion = PressMotion(
            _interpolate_range(self.depth, depth),
            (float(slide[0]), float(slide[1])),
            _interpolate_range(self.twist, twist),
        )
        if self.pose == "centred":
            return name, scene, motion
        low, high = self._placement_area(self.objects[name])
        at = low + (high - low) * [x, y]
        about = _interpolate_range(self.tilt, tilt) * _unit_vector(tilted)
        upright = se3.from_rotation_vector(np.zeros(3), [0.0, 0.0, 2 * np.pi * yaw])
        turned = se3.compose(se3.from_rotation_vector(np.zeros(3), [*about, 0.0]), upright)
        if indenter.roll or indenter.pitch:  # the scene gives the side that presses; yaw and tilt are random
            turned = se3.compose(turned, Pose(quaternion=indenter.turn))
        turn = turned.quaternion
        return name, scene, replace(motion, at=(float(at[0]), float(at[1])), turn=turn)

    def _placement_area(self, geometry: Shape) -> tuple[Any, Any]:
        """Minimum and maximum x, y [m] of the centre of an object: half of its longer side away from the border of gel
        and picture. The corners of a rotated object may pass that border. A larger object is placed in the centre."""
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
    """Makes files one after the other with one renderer."""

    def __init__(self, job: PressJob, folder: Path) -> None:
        self._job, self._set = job, job.settings.in_folder(folder)
        sensor = self._set.sensor
        self._render = Renderer(sensor, self._set.scene.gel.size[:2])
        self._noise = noise_source(sensor, "lower")
        self._lattice = self._set.lattice

    def piece(self, number: int) -> Piece:
        """The file with this number, without the presses that failed.

        Files start with different objects, so that workers that start together do not all compute the distances of
        the same mesh.
        """
        # the fractions of its multiples are evenly distributed in 0 to 1, whatever their number
        golden_ratio = 0.618034
        rows: dict[int, Row] = {}
        failures: dict[int, str] = {}
        seconds = Seconds()
        numbers = self._job.numbers(number)
        object_count = len(self._set.objects)
        first = (int(golden_ratio * number % 1 * object_count) - numbers[0]) % object_count % len(numbers)
        for index in (*numbers[first:], *numbers[:first]):
            try:
                rows[index] = self._make_row(index, seconds)
            except (SimulationDiverged, ValueError, MemoryError) as failure:
                failures[index] = f"{type(failure).__name__}: {failure}"
        began = time.perf_counter()
        data = parquet_bytes(self._set.columns, [rows[index] for index in sorted(rows)]) if rows else None
        seconds.add("file", time.perf_counter() - began)
        return Piece(number, data, dict(sorted(failures.items())), len(rows), seconds.by_part)

    def _make_row(self, index: int, seconds: Seconds) -> Row:
        name, scene, motion = self._set.draw_press(index)
        began = time.perf_counter()
        pressed = press(scene, self._set.sensor, motion, self._render)
        seconds.add("press", time.perf_counter() - began)
        began = time.perf_counter()
        row = self._label_press(index, name, motion, pressed)
        seconds.add("labels", time.perf_counter() - began)
        return row

    def _label_press(self, index: int, name: str, motion: PressMotion, pressed: PressResult) -> Row:
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
            "unfelt": pressed.missed_depth_share,
            "folded": pressed.folded,
            "settled": all(move.settled for move in pressed.moves),
        }


def render_reference(settings: PressSet, folder: Path) -> bytes:
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


def _interpolate_range(between: tuple[float, float], share: float) -> float:
    return float(between[0] + (between[1] - between[0]) * share)


def _unit_vector(share: float) -> Any:
    return np.array([math.cos(2 * math.pi * share), math.sin(2 * math.pi * share)])
