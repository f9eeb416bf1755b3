"""A rigid indenter pressed on one gel, slid and twisted: picture, height map, force and contact radius."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim import pose as se3
from tacsim.geometry.pressing_side import describe_side, find_pressing_side
from tacsim.geometry.shapes import bounding_size, shape_distance
from tacsim.geometry.tiles import cached_tiled_distance
from tacsim.interface import FloatArray, Pose, short_repr
from tacsim.models.scene import Box, Cylinder, Gel, GelSurface, Indenter, Mesh, Scene
from tacsim.models.sensor import SensorModel
from tacsim.models.text import millimetres
from tacsim.optics.grid import image_grid
from tacsim.optics.render import Renderer
from tacsim.optics.surface import SurfaceSample, SurfaceTable, sample_surface
from tacsim.physics.failure.dump import dump_to_folder
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.move import MoveStats
from tacsim.physics.worlds.press import PressWorld
from tacsim.physics.worlds.tuning import INITIAL_GAP, MESH_GRID_SPACING, SAFE_PATH_SHARE
from tacsim.report.press_page import write_height_picture, write_side_picture

MAX_TWIST = math.radians(3600.0)
# Share of the depth that the gel's contact points may miss. Balls of 1 mm and more, cylinders, boxes and stars miss at
# most 11 %; wedges of 60 to 45 degrees miss 12 to 25 %, and their forces are 10 to 25 % too small.
MAX_MISSED_DEPTH_SHARE = 0.125


@dataclass(frozen=True, slots=True)
class PressMotion:
    """Motion of the indenter from its first contact with the undeformed gel."""

    __repr__ = short_repr
    depth: float = 0.5e-3  # of its lowest point below the undeformed surface [m]
    slide: tuple[float, float] = (0.0, 0.0)  # tangential displacement after the press, world x, y [m]
    twist: float = 0.0  # rotation about the vertical axis after the slide [rad]
    at: tuple[float, float] = (0.0, 0.0)  # position of its centre, world x, y [m]
    turn: FloatArray | None = None  # (4,) orientation instead of the scene's yaw: quaternion x, y, z, w


@dataclass(frozen=True, slots=True, eq=False)
class PressResult:
    """The gel under the indenter at the end."""

    __repr__ = short_repr
    image: NDArray[np.uint8]  # (H, W, 3) RGB
    height: NDArray[np.float32]  # (H, W) into the gel, at each pixel [m]
    contact: NDArray[np.bool_]  # (H, W) pixels where gel and indenter touch
    wrench: FloatArray  # (6,) of the indenter on the sensor, sensor axes [N, N m]
    contact_radius: float  # of the circle with the area of contact [m]
    missed_depth_share: float  # share of the depth of its lowest point that no contact point of the gel reaches
    moves: tuple[MoveStats, ...]
    unsettled_reason: str  # why a motion does not count as settled, and what to do; else ""
    surface: GelSurface
    folded: bool  # the surface folds over itself: picture and height show the sheet that the camera sees
    pose: Pose  # of the indenter in the sensor's frame: the centre of its bounding box


def press(scene: Scene, sensor: SensorModel, motion: PressMotion, render: Renderer | None = None) -> PressResult:
    """Presses the scene's indenter, then slides and twists it.

    render: of this sensor on this gel, to reuse it for many presses.

    Raises:
        ValueError: the scene has no indenter, the depth is not within the gel, or slide or twist exceeds its limit.
        SimulationDiverged: the motion did not reach a physical state.
    """
    if scene.indenter is None:
        raise ValueError(f"scene '{scene.name}' has no indenter; press needs one, and no body")
    require_reachable(scene.gel, motion)
    world = PressWorld(scene)
    start = world.pose("indenter")
    turn = start.quaternion if motion.turn is None else motion.turn
    below = world.lowest_point_depth(turn)
    if any(motion.at) or motion.turn is not None:
        world.place({"indenter": Pose(np.array([*motion.at, below + INITIAL_GAP]), turn)})
    targets = _targets(world.pose("indenter"), below - motion.depth, motion)
    moves, unsettled_reason = [], ""
    try:
        for target in targets:
            moves.append(world.move({"indenter": target}))
            unsettled_reason = world.unsettled_reason or unsettled_reason
    except SimulationDiverged as error:
        if error.poses:
            reached_depth = below - float(se3.relative_pose(error.poses["lower"], error.poses["indenter"]).position[2])
            error.advice += f"; it had reached {reached_depth * 1e3:.3g} mm of {motion.depth * 1e3:.3g} mm depth"
            if not moves:  # the depth is the cause; the possible share of the path from the start says less
                error.depth, error.possible = reached_depth, ""
        raise
    surface = world.surface("lower")
    sample = sample_surface(surface, image_grid(sensor.geometry))
    contact = _contact_mask(world, scene, sample, sensor)
    area = float(contact.sum()) * sensor.geometry.pixel_pitch**2
    return PressResult(
        image=(render or Renderer(sensor, scene.gel.size[:2]))(surface),
        height=sample.height,
        contact=contact,
        wrench=world.wrench("lower"),
        contact_radius=math.sqrt(area / math.pi),
        missed_depth_share=world.missed_depth_share,
        moves=tuple(moves),
        unsettled_reason=unsettled_reason,
        surface=surface,
        folded=SurfaceTable(surface).folded,
        pose=se3.relative_pose(world.pose("lower"), world.pose("indenter")),
    )


def deepest_possible(scene: Scene, motion: PressMotion, failure: SimulationDiverged) -> float | None:
    """A depth [m] that this press can reach, found by presses that are less deep than the failed one. None if the
    failure does not depend on depth, or if `max_trials` presses failed."""
    max_trials = 3
    if failure.depth is None or not failure.retry:
        return None
    depth = min(failure.depth, motion.depth)
    with dump_to_folder(None):
        for _ in range(max_trials):
            depth = _round_down(SAFE_PATH_SHARE * depth)
            world = PressWorld(scene)
            pose = world.pose("indenter")
            below = world.lowest_point_depth(pose.quaternion)
            try:
                world.move({"indenter": Pose(np.array([*pose.position[:2], below - depth]), pose.quaternion)})
            except SimulationDiverged:
                continue
            return depth
    return None


def _round_down(depth: float) -> float:
    """The depth rounded down to two digits [m], as it is printed."""
    unit = 10.0 ** (math.floor(math.log10(depth)) - 1)
    return math.floor(depth / unit) * unit


def require_reachable(gel: Gel, motion: PressMotion) -> None:
    """Raises ValueError for a depth that is not within the gel, or for a slide or twist beyond its limit."""
    max_slide = 3.0  # widths of the gel; farther, the indenter has left the gel
    thickness, farthest, slide = gel.size[2], max_slide * max(gel.size[:2]), math.hypot(*motion.slide)
    if not 0 < motion.depth < thickness:
        words = f"depth is {millimetres(motion.depth)}; it must be above 0 and below the gel's {millimetres(thickness)}"
        raise ValueError(f"{words}; a thicker gel: gel.size of the scene")
    if not slide <= farthest:
        raise ValueError(f"slide is {slide:.4g} m long; at most {max_slide:g} widths of the gel, {farthest:.4g} m")
    if not abs(motion.twist) <= MAX_TWIST:
        limit = math.degrees(MAX_TWIST)
        raise ValueError(f"twist is {math.degrees(motion.twist):.4g} deg; the limits are -{limit:g} and {limit:g} deg")


def _targets(start: Pose, height: float, motion: PressMotion) -> list[Pose]:
    """Poses of the indenter, in order. height: of its origin at full depth [m]."""
    # a twist is cut into pieces of at most this: each motion takes the shorter rotation [rad]
    quarter_turn = math.pi / 2
    down = np.array([start.position[0], start.position[1], height])
    targets = [Pose(down, start.quaternion)]
    if any(motion.slide):
        targets.append(Pose(down + np.append(motion.slide, 0.0), start.quaternion))
    pieces = math.ceil(abs(motion.twist) / quarter_turn)
    for piece in range(1, pieces + 1):
        turn = se3.from_rotation_vector(np.zeros(3), [0.0, 0.0, motion.twist * piece / pieces])
        targets.append(Pose(targets[-1].position, se3.compose(turn, start).quaternion))
    return targets


def _contact_mask(world: PressWorld, scene: Scene, sample: SurfaceSample, sensor: SensorModel) -> NDArray[np.bool_]:
    """(H, W) True where the indenter presses on the surface at a pixel."""
    contact_distance = 0.2  # in elements; a surface point farther from the indenter is not in contact
    assert scene.indenter is not None
    grid, margin = image_grid(sensor.geometry), contact_distance * scene.effective_element_size
    from_sensor = se3.relative_pose(world.pose("indenter"), world.pose("lower"))
    half = bounding_size(scene.indenter.geometry) / 2 + margin
    corners = se3.transform(se3.inverse(from_sensor), half * (2.0 * np.indices((2, 2, 2)).reshape(3, -1).T - 1.0))
    rows, columns = (
        slice(*np.searchsorted(places, (corners[:, axis].min(), corners[:, axis].max())))
        for places, axis in ((grid.y, 1), (grid.x, 0))
    )
    gel = np.concatenate(
        [grid.points()[rows, columns], -sample.height[rows, columns, None].astype(np.float64)], axis=-1
    )
    valid = sample.valid[rows, columns]
    at = se3.transform(from_sensor, gel.reshape(-1, 3))
    near = (np.abs(at) <= half).all(axis=1) & valid.ravel()
    gaps = np.full(sample.valid.shape, np.inf)
    if near.any():
        inner = np.full(len(at), np.inf)
        inner[near] = _indenter_distance(scene.indenter, at[near], scene.effective_element_size)
        gaps[rows, columns] = inner.reshape(valid.shape)
    table = SurfaceTable(world.surface("lower"))
    reach, _ = table.sample_on_grid(table.spline_values(world.reach().astype(np.float32)), grid)
    return _fill_gaps(gaps < reach.reshape(gaps.shape), int(scene.effective_element_size / sensor.geometry.pixel_pitch))


def _indenter_distance(indenter: Indenter, points: FloatArray, element: float) -> FloatArray:
    """(n,) distance of points (n, 3) from the indenter, in its frame [m]; for a mesh, that of the physics."""
    geometry = indenter.geometry
    if not isinstance(geometry, Mesh):
        return shape_distance(geometry, points, indenter.effective_edge_radius(element))
    return cached_tiled_distance(geometry, MESH_GRID_SPACING).sample_distance(points)[0]


def _fill_gaps(mask: NDArray[np.bool_], width: int) -> NDArray[np.bool_]:
    """(H, W) `mask` with gaps narrower than `width` pixels filled; a convex mask does not change.

    Behind a pressed edge the surface oscillates within an element, by 10 µm from a face with elements of 0.5 mm: the
    mesh cannot resolve a gap of that size.
    """
    if width < 2:
        return mask
    filled = np.pad(mask, 2 * width)
    for axis, of_window in ((0, np.any), (1, np.any), (0, np.all), (1, np.all)):
        filled = of_window(np.lib.stride_tricks.sliding_window_view(filled, width, axis=axis), axis=-1)
    height, wide = mask.shape
    return filled[width + 1 : width + 1 + height, width + 1 : width + 1 + wide]


def press_report(scene: Scene, motion: PressMotion, pressed: PressResult, sensor: SensorModel) -> dict[str, Any]:
    """The result as JSON, SI units. residual: None without a hold, because none was measured. unfollowed: reason why a
    motion does not count as settled, or None. edge_radius: None for a ball, and for a mesh, which has its own."""
    residual = max(move.residual for move in pressed.moves)
    return {
        "indenter": scene.indenter.model_dump(mode="json") if scene.indenter else None,
        "pressing_side": describe_side(scene.indenter) if scene.indenter else None,
        "edge_radius": _edge_radius(scene),
        "gel": scene.gel.model_dump(mode="json"),
        "preset": scene.preset,
        "element_size": scene.effective_element_size,
        "depth": motion.depth,
        "slide": list(motion.slide),
        "twist": motion.twist,
        "force": -float(pressed.wrench[2]),
        "wrench": [float(value) for value in pressed.wrench],
        "contact_radius": pressed.contact_radius,
        "deepest": float(pressed.height.max()),
        "pixel_pitch": sensor.geometry.pixel_pitch,
        "unfelt": pressed.missed_depth_share,
        "folded": pressed.folded,
        "unfollowed": pressed.unsettled_reason or None,
        "settled": all(move.settled for move in pressed.moves),
        "residual": residual if math.isfinite(residual) else None,
        "substeps": sum(move.substeps for move in pressed.moves),
    }


def _edge_radius(scene: Scene) -> float | None:
    """Radius of the indenter's edges [m]; None for a geometry without edges or with its own."""
    assert scene.indenter is not None
    return (
        scene.indenter.effective_edge_radius(scene.effective_element_size)
        if isinstance(scene.indenter.geometry, Box | Cylinder)
        else None
    )


def force_curve(scene: Scene, motion: PressMotion) -> list[tuple[float, float]]:
    """Depth [m] and normal force [N] at points of a press of its own, in which the gel settles at each depth. Stops
    before a depth at which the simulation diverges."""
    count = 6
    world = PressWorld(scene)
    start = world.pose("indenter")
    below = world.lowest_point_depth(start.quaternion)
    found = []
    with dump_to_folder(None):
        for depth in np.linspace(0.0, motion.depth, count + 1)[1:].tolist():
            target = Pose(np.array([*start.position[:2], below - depth]), start.quaternion)
            try:
                world.move({"indenter": target})
            except SimulationDiverged:
                break
            found.append((depth, -float(world.wrench("lower")[2])))
    return found


def write(
    folder: Path,
    pressed: PressResult,
    config: dict[str, Any],
    scene: Scene,
    sensor: SensorModel,
    curve: Sequence[tuple[float, float]],
) -> None:
    """Writes rgb.png, height.npy (float32 [m], one value a pixel), height.png, side.png, press.json and press.html.

    curve: depth [m] and normal force [N] of points, see `force_curve`. Raises OSError.
    """
    from PIL import Image

    from tacsim.report.press_page import write_press_page

    assert scene.indenter is not None
    Image.fromarray(pressed.image).save(
        folder / "rgb.png", compress_level=4
    )  # as small as with level 6, in half the time
    np.save(folder / "height.npy", pressed.height.astype(np.float32), allow_pickle=False)
    write_height_picture(folder / "height.png", pressed.height, pressed.contact, config["pixel_pitch"])
    lowest = se3.transform(pressed.pose, find_pressing_side(scene.indenter).lowest_point)[:2]
    write_side_picture(
        folder / "side.png", scene.indenter.geometry, pressed.pose, lowest, pressed.height,
        image_grid(sensor.geometry), scene.gel, f"pressing side: {config['pressing_side']}",
    )  # fmt: skip
    config = {**config, "force_curve": [list(point) for point in curve]}
    (folder / "press.json").write_text(json.dumps(config, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    write_press_page(folder / "press.html", folder, pressed.height, config, curve)
