"""A rigid indenter pressed on one gel, slid and twisted: picture, height map, force and contact radius."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim import pose as se3
from tacsim.geometry.shapes import distance, extent
from tacsim.interface import FloatArray, Pose
from tacsim.models.scene import Box, Cylinder, Gel, Scene, Shape
from tacsim.models.sensor import SensorModel
from tacsim.optics.grid import image_grid
from tacsim.optics.render import Renderer
from tacsim.optics.surface import SurfaceSample, SurfaceTable, sample_surface
from tacsim.physics.move import MoveStats
from tacsim.physics.worlds.press import PressWorld
from tacsim.report.height_picture import write_height_picture

QUARTER_TURN = math.pi / 2  # a twist is cut into pieces of at most this: each motion takes the shorter rotation [rad]
MAX_TWIST = math.radians(3600.0)
MAX_SLIDE = 3.0  # widths of the gel: beyond, it has left the gel
NEAR = 0.2  # elements: a surface point farther from the indenter is not pressed


@dataclass(frozen=True, slots=True)
class PressMotion:
    """How the indenter moves, once it touches the undeformed gel."""

    depth: float = 0.5e-3  # of its lowest point below the undeformed surface [m]
    slide: tuple[float, float] = (0.0, 0.0)  # then sideways, world x, y [m]
    twist: float = 0.0  # then about the vertical axis [rad]


@dataclass(frozen=True, slots=True, eq=False)
class PressResult:
    """The gel under the indenter at the end."""

    image: NDArray[np.uint8]  # (H, W, 3) RGB
    height: NDArray[np.float32]  # (H, W) into the gel, under each pixel [m]
    contact: NDArray[np.bool_]  # (H, W) pixels where gel and indenter touch
    wrench: FloatArray  # (6,) what the indenter does to the sensor, sensor axes [N, N m]
    contact_radius: float  # of the circle with the area of contact [m]
    moves: tuple[MoveStats, ...]


def press(scene: Scene, sensor: SensorModel, motion: PressMotion) -> PressResult:
    """Presses the scene's indenter, then slides and twists it.

    Raises ValueError for a scene without indenter, a depth that is not within the gel, or a slide or twist beyond its
    limit; SimulationDiverged.
    """
    if scene.indenter is None:
        raise ValueError(f"scene '{scene.name}' has no indenter; press needs one, and no body")
    _require_reachable(scene.gel, motion)
    world = PressWorld(scene)
    targets = _targets(world.pose("indenter"), scene.indenter.geometry, motion)
    moves = tuple(world.move({"indenter": target}) for target in targets)
    surface = world.surface("lower")
    seen = sample_surface(surface, image_grid(sensor.geometry))
    contact = _contact(world, scene, seen, sensor)
    area = float(contact.sum()) * sensor.geometry.pixel_pitch**2
    return PressResult(
        image=Renderer(sensor, scene.gel.size[:2])(surface),
        height=seen.height,
        contact=contact,
        wrench=world.wrench("lower"),
        contact_radius=math.sqrt(area / math.pi),
        moves=moves,
    )


def _require_reachable(gel: Gel, motion: PressMotion) -> None:
    thickness, farthest, slide = gel.size[2], MAX_SLIDE * max(gel.size[:2]), math.hypot(*motion.slide)
    if not 0 < motion.depth < thickness:
        raise ValueError(f"depth is {motion.depth:.4g} m; it must be above 0 and below the gel's {thickness:.4g} m")
    if not slide <= farthest:
        raise ValueError(f"slide is {slide:.4g} m long; at most {MAX_SLIDE:g} widths of the gel, {farthest:.4g} m")
    if not abs(motion.twist) <= MAX_TWIST:
        most = math.degrees(MAX_TWIST)
        raise ValueError(f"twist is {math.degrees(motion.twist):.4g} deg; at most {most:g} deg either way")


def _targets(start: Pose, geometry: Shape, motion: PressMotion) -> list[Pose]:
    """Poses of the indenter, in order. The origin of its frame is the centre of its bounding box."""
    down = np.array([start.position[0], start.position[1], float(extent(geometry)[2]) / 2 - motion.depth])
    targets = [Pose(down, start.quaternion)]
    if any(motion.slide):
        targets.append(Pose(down + np.append(motion.slide, 0.0), start.quaternion))
    pieces = math.ceil(abs(motion.twist) / QUARTER_TURN)
    for piece in range(1, pieces + 1):
        turn = se3.from_rotation_vector(np.zeros(3), [0.0, 0.0, motion.twist * piece / pieces])
        targets.append(Pose(targets[-1].position, se3.compose(turn, start).quaternion))
    return targets


def _contact(world: PressWorld, scene: Scene, seen: SurfaceSample, sensor: SensorModel) -> NDArray[np.bool_]:
    """(H, W) True where the indenter presses on the surface seen by a pixel."""
    assert scene.indenter is not None
    geometry = scene.indenter.geometry
    grid = image_grid(sensor.geometry)
    gel = np.concatenate([grid.points(), -seen.height[..., None].astype(np.float64)], axis=-1).reshape(-1, 3)
    sensor_pose, indenter = world.pose("lower"), world.pose("indenter")
    at = se3.transform(se3.relative(indenter, sensor_pose), gel)
    near = (np.abs(at) <= extent(geometry) / 2 + NEAR * scene.element).all(axis=1) & seen.valid.ravel()
    gaps = np.full(len(at), np.inf)
    if near.any():
        gaps[near] = distance(geometry, at[near], scene.indenter.rounding(scene.element))
    table = SurfaceTable(world.surface("lower"))
    reach, _ = table.seen(table.of_nodes(world.reach().astype(np.float32)), grid)
    pressed: NDArray[np.bool_] = gaps.reshape(seen.valid.shape) < reach.reshape(seen.valid.shape)
    return _filled(pressed, int(scene.element / sensor.geometry.pixel_pitch))


def _filled(mask: NDArray[np.bool_], width: int) -> NDArray[np.bool_]:
    """(H, W) `mask` with the gaps that are narrower than `width` pixels filled; what is convex stays as it is.

    Behind a pressed edge the surface swings back within an element, by 10 µm from a face at elements of 0.5 mm: no
    mesh can tell a gap from that.
    """
    if width < 2:
        return mask
    filled = np.pad(mask, 2 * width)
    for axis, of_window in ((0, np.any), (1, np.any), (0, np.all), (1, np.all)):
        filled = of_window(np.lib.stride_tricks.sliding_window_view(filled, width, axis=axis), axis=-1)
    height, wide = mask.shape
    return filled[width + 1 : width + 1 + height, width + 1 : width + 1 + wide]


def press_report(scene: Scene, motion: PressMotion, pressed: PressResult, sensor: SensorModel) -> dict[str, Any]:
    """The result as JSON, SI units. residual: None where nothing was held, so that none was measured; edge_radius: None
    of a ball, which has no edges, and of a mesh, whose edges are as drawn."""
    residual = max(move.residual for move in pressed.moves)
    return {
        "indenter": scene.indenter.model_dump(mode="json") if scene.indenter else None,
        "edge_radius": _edge_radius(scene),
        "gel": scene.gel.model_dump(mode="json"),
        "preset": scene.preset,
        "element_size": scene.element,
        "depth": motion.depth,
        "slide": list(motion.slide),
        "twist": motion.twist,
        "force": -float(pressed.wrench[2]),
        "wrench": [float(value) for value in pressed.wrench],
        "contact_radius": pressed.contact_radius,
        "deepest": float(pressed.height.max()),
        "pixel_pitch": sensor.geometry.pixel_pitch,
        "settled": all(move.settled for move in pressed.moves),
        "residual": residual if math.isfinite(residual) else None,
        "substeps": sum(move.substeps for move in pressed.moves),
    }


def _edge_radius(scene: Scene) -> float | None:
    """Of the indenter's edges [m]; None where its geometry has none or says it."""
    assert scene.indenter is not None
    return scene.indenter.rounding(scene.element) if isinstance(scene.indenter.geometry, Box | Cylinder) else None


def write(folder: Path, pressed: PressResult, config: dict[str, Any]) -> None:
    """Writes rgb.png, height.npy (float32 [m], one value a pixel), height.png and press.json. Raises OSError."""
    from PIL import Image

    Image.fromarray(pressed.image).save(folder / "rgb.png")
    np.save(folder / "height.npy", pressed.height.astype(np.float32), allow_pickle=False)
    write_height_picture(folder / "height.png", pressed.height, pressed.contact, config["pixel_pitch"])
    (folder / "press.json").write_text(json.dumps(config, indent=1, allow_nan=False) + "\n", encoding="utf-8")
