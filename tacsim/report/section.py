"""A drawing of the body between its gels, cut in the middle: particles as a smooth solid, gels with their dents."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from tacsim import pose as se3
from tacsim.interface import FloatArray, Pose
from tacsim.record.episode import Episode, Step

if TYPE_CHECKING:
    from tacsim.report.strips import Find

TILT = 0.22  # of the line of sight below the horizontal [rad]
LIGHT = np.array([-0.35, -0.65, -0.67])  # direction to the lamp: right, down, away from the eye
CUT_NORMAL = np.array([0.0, np.sin(TILT), -np.cos(TILT)])
LAYER = 2e-3  # thickness of a layer of colour in the body at the start [m]
CLAY = np.array([[206, 98, 56], [240, 184, 124]], np.float64)  # of the layers, in turn
FACE, EDGE, SURFACE, HOUSING = (172, 208, 226), (74, 122, 150), (206, 222, 230), (70, 78, 88)
HOUSING_DEPTH = 1.2e-3  # drawn behind a gel [m]
MARGIN = 0.05  # round the drawing, of its width


@dataclass(frozen=True, slots=True)
class GelShape:
    """What a drawing has to know of a gel."""

    size: tuple[float, float, float]  # x, y, thickness [m]
    pitch: float  # of the points of its height map [m]
    arm: str  # that carries it


@dataclass(frozen=True, slots=True, eq=False)
class GelState:
    """A gel at a moment."""

    shape: GelShape
    pose: Pose  # of the sensor in world
    height: NDArray[np.float32] | None  # (h, w) displacement into the gel [m]

    def surface_at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """(..., 3) points of the surface in world [m], at sensor coordinates x and y [m]."""
        return self.to_world(np.stack([x, y, -self.height_at(x, y)], axis=-1))

    def height_at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """(...) displacement into the gel [m]; 0 if it is unknown, outside the map that of the nearest point."""
        from scipy.ndimage import map_coordinates

        if self.height is None:
            return np.zeros(x.shape)
        rows, columns = self.height.shape
        at = [y / self.shape.pitch + (rows - 1) / 2, x / self.shape.pitch + (columns - 1) / 2]
        found: FloatArray = map_coordinates(self.height, at, order=1, mode="nearest").astype(np.float64)
        return found

    def to_world(self, points: FloatArray) -> FloatArray:
        return se3.transform(self.pose, points.reshape(-1, 3)).reshape(points.shape)


class Section:
    """Draws moments of an episode, all from the same place. The eye looks along world y, from above."""

    def __init__(self, size: tuple[int, int], first: FloatArray, gels: Sequence[Sequence[GelState]]) -> None:
        """size: width and height of the picture [px]; first: (n, 3) particles at the start [m]; gels: those of a few
        moments, all in view."""
        self.size = size
        lower, upper = first.min(axis=0), first.max(axis=0)
        self.cut = float((lower[1] + upper[1]) / 2)
        self._spacing = particle_spacing(first)
        self._layers = layer_numbers(first)
        corners = [first, *(_corners(gel) for moment in gels for gel in moment)]
        seen = np.concatenate([self._project(points, 1.0, np.zeros(2)) for points in corners])
        low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
        self._scale = (1 - 2 * MARGIN) * float((np.array(size) / np.maximum(high - low, 1e-6)).min())
        self._centre = np.array(size) / 2 - self._scale * (low + high) / 2

    def draw(self, body: NDArray[np.float32] | None, gels: Mapping[str, GelState]) -> Image.Image:
        """The body's particles (n, 3) [m], in the order of the first ones, between the gels."""
        image = Image.new("RGB", self.size, "white")
        pen = ImageDraw.Draw(image)
        for gel in gels.values():
            self._draw_far_half(pen, gel)
        if body is not None:
            image = self._draw_body(image, body.astype(np.float64))
            pen = ImageDraw.Draw(image)
        for gel in gels.values():
            self._draw_face(pen, gel)
        return image

    def project(self, points: FloatArray) -> FloatArray:
        """(n, 3) right, down [px] and away from the eye [px] of points (n, 3) in world [m]."""
        return self._project(points, self._scale, self._centre)

    def _project(self, points: FloatArray, scale: float, centre: FloatArray) -> FloatArray:
        x, y, z = points[:, 0], points[:, 1] - self.cut, points[:, 2]
        down, away = -np.cos(TILT) * z - np.sin(TILT) * y, np.cos(TILT) * y - np.sin(TILT) * z
        return np.stack([scale * x + centre[0], scale * down + centre[1], scale * away], axis=1)

    def _draw_far_half(self, canvas: ImageDraw.ImageDraw, gel: GelState) -> None:
        """The part of the gel behind the cut that is seen from above: its surface, or its housing."""
        faces_up = gel.to_world(np.array([[0.0, 0, 1], [0, 0, 0]]))
        half = np.array(gel.shape.size[:2]) / 2
        x, y = np.meshgrid(np.linspace(-half[0], half[0], 61), np.linspace(-half[1], half[1], 61))
        if faces_up[0, 2] < faces_up[1, 2]:
            back = np.full(x.shape, -gel.shape.size[2] - HOUSING_DEPTH)
            points = gel.to_world(np.stack([x, y, back], axis=-1))
            base = np.array(HOUSING) * 1.25
        else:
            points, base = gel.surface_at(x, y), np.array(SURFACE, np.float64)
        normals = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
        normals *= np.sign(normals[..., 2:]) / np.linalg.norm(normals, axis=-1, keepdims=True)
        light = np.clip(0.86 + 1.1 * (normals @ np.array([-0.35, -0.65, 0.67]) - 0.67), 0.35, 1.15)
        quads = [
            (float(points[i, j, 1]), i, j)
            for i in range(60)
            for j in range(60)
            if points[i : i + 2, j : j + 2, 1].max() >= self.cut
        ]
        flat = np.array(points)
        flat[..., 1] = np.maximum(flat[..., 1], self.cut)
        seen = self.project(flat.reshape(-1, 3)).reshape(points.shape)
        for _, i, j in sorted(quads, reverse=True):
            corners = [seen[i, j], seen[i, j + 1], seen[i + 1, j + 1], seen[i + 1, j]]
            colour = tuple(int(value) for value in np.clip(base * light[i, j], 0, 255))
            canvas.polygon([(float(u), float(v)) for u, v, _ in corners], fill=colour)

    def _draw_face(self, canvas: ImageDraw.ImageDraw, gel: GelState) -> None:
        """The cut through gel and housing."""
        turn = se3.rotation_matrix(gel.pose)
        along = 0 if abs(turn[1, 1]) >= abs(turn[1, 0]) else 1  # the sensor's axis that lies in the cut
        run = np.linspace(-gel.shape.size[along] / 2, gel.shape.size[along] / 2, 201)
        across = (self.cut - gel.pose.position[1] - turn[1, along] * run) / turn[1, 1 - along]
        x, y = (run, across) if along == 0 else (across, run)
        front = gel.surface_at(x, y)
        thick = gel.shape.size[2]
        backs = [
            gel.to_world(np.stack([x, y, np.full(x.shape, -depth)], axis=-1))
            for depth in (thick, thick + HOUSING_DEPTH)
        ]
        rows = [[(float(u), float(v)) for u, v, _ in self.project(points)] for points in (front, *backs)]
        canvas.polygon([*rows[1], *rows[2][::-1]], fill=HOUSING)
        canvas.polygon([*rows[0], *rows[1][::-1]], fill=FACE)
        canvas.line(rows[0], fill=EDGE, width=3)

    def _draw_body(self, image: Image.Image, body: FloatArray) -> Image.Image:
        """A depth map of spheres at the particles behind the cut, smoothed and lit."""
        import cv2

        kept = body[:, 1] >= self.cut - self._spacing / 2
        layers = self._layers if len(body) == len(self._layers) else layer_numbers(body)
        seen, colours = self.project(body[kept]), CLAY[layers[kept]]
        radius = self._scale * self._spacing * 0.95
        depth, owner = _draw_spheres(seen, radius, self.size)
        inside = owner >= 0
        rows = np.arange(self.size[1])[:, None]
        z = -(rows - self._centre[1]) / np.cos(TILT)  # of the point of the cut at this row
        plane = -np.sin(TILT) * np.broadcast_to(z, depth.shape)
        is_cut = inside & (depth <= plane)
        depth = np.where(inside, np.maximum(depth, plane), 0.0)
        colour = np.where(inside[..., None], colours[owner], 0.0)
        weight = inside.astype(np.float64)
        sigma = radius / 1.6
        share = cv2.GaussianBlur(weight, (0, 0), sigma)
        smooth = cv2.GaussianBlur(depth, (0, 0), sigma) / np.maximum(share, 1e-9)
        tint = cv2.GaussianBlur(colour, (0, 0), sigma / 2)
        tint = tint / np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma / 2), 1e-9)[..., None]
        slope_v, slope_u = np.gradient(np.where(inside, smooth, 0.0))
        normal = np.stack([slope_u, slope_v, -np.ones_like(slope_u)], axis=-1)
        normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        lamp = LIGHT / np.linalg.norm(LIGHT)
        light = 0.55 + 0.65 * np.clip(np.where(is_cut, CUT_NORMAL @ lamp, normal @ lamp), 0.0, 1.0)
        alpha = np.clip((cv2.GaussianBlur(weight, (0, 0), radius / 2) - 0.4) / 0.2, 0.0, 1.0) * inside
        lit = np.clip(tint * light[..., None], 0, 255)
        under = np.asarray(image, np.float64)
        return Image.fromarray((under + alpha[..., None] * (lit - under)).astype(np.uint8))


def particle_spacing(points: FloatArray) -> float:
    """Mean distance [m] of particles (n, 3) that fill their bounding box."""
    sides = np.maximum(np.ptp(points, axis=0), 1e-6)
    return float((np.prod(sides) / len(points)) ** (1 / 3))


def layer_numbers(points: FloatArray) -> NDArray[np.int64]:
    """0 or 1 in turn, by the height of each particle (n, 3) within the body."""
    numbers: NDArray[np.int64] = (np.floor((points[:, 2] - points[:, 2].min()) / LAYER) % 2).astype(np.int64)
    return numbers


def _corners(gel: GelState) -> FloatArray:
    """(8, 3) of gel and housing, the half behind a cut through the middle of the sensor."""
    x, y, thick = gel.shape.size
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (0, 1)], np.float64)
    points = gel.to_world(signs * [x / 2, y / 2, -(thick + HOUSING_DEPTH)])
    points[:, 1] = np.maximum(points[:, 1], gel.pose.position[1])
    return points


def _draw_spheres(projected: FloatArray, radius: float, size: tuple[int, int]) -> tuple[FloatArray, NDArray[np.int64]]:
    """Distance from the eye [px] of the nearest sphere at each pixel, and its number (-1: none); points (n, 3) [px]."""
    reach = int(np.ceil(radius))
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    depth = np.full((size[1], size[0]), np.inf)
    owner = np.full(depth.shape, -1, np.int64)
    near = np.sqrt(np.maximum(radius**2 - u**2 - v**2, 0.0))
    disc = u**2 + v**2 <= radius**2
    for k in np.argsort(-projected[:, 2]):  # far ones first; a few thousand
        left, top = round(projected[k, 0]) - reach, round(projected[k, 1]) - reach
        if left < 0 or top < 0 or left + u.shape[1] > size[0] or top + u.shape[0] > size[1]:
            continue
        place = (slice(top, top + u.shape[0]), slice(left, left + u.shape[1]))
        front = projected[k, 2] - near
        nearer = disc & (front < depth[place])
        depth[place][nearer] = front[nearer]
        owner[place][nearer] = k
    return depth, owner


def gel_states(step: Step, gels: Mapping[str, GelShape], find: Find) -> dict[str, GelState]:
    """The gels at a step, of sensors with a known shape on an arm with a known pose."""
    found = {}
    for name, shape in gels.items():
        arm = step.arms.get(shape.arm)
        if arm is None:
            continue
        surface = find(name, step.frames[name]) if name in step.frames else None
        found[name] = GelState(shape, arm.pose, None if surface is None else surface.height)
    return found


def section_of(episode: Episode, gels: Mapping[str, GelShape], size: tuple[int, int]) -> Section | None:
    """A drawing with room for the first, middle and last moment; None for an episode without a recorded body."""
    count = len(episode.steps)
    few = [episode.steps[at] for at in sorted({0, count // 2, count - 1})]
    first = few[0].body
    if first is None:
        return None
    known = [list(gel_states(step, gels, lambda sensor, frame: None).values()) for step in few]
    return Section(size, np.asarray(first, np.float64), known)
