"""Gel surface -> height and gradient under every image point, through the surface's own lattice.

The surface is the C1 quadratic B-spline whose control values are the displacement samples (no prefilter: an
interpolating spline rings round the rim of a contact); contact physics uses the same one. A camera at the point
x = (x, y) sees the material point X with ``X + u_xy(X) = x``; there

    height(x) = -u_z(X),    d height / d x = J^-T d(-u_z)/dX,    J = I + d u_xy / dX.

On a grid of image points both are looked up in a table over the gel whose points halve the lattice cells, where the
spline is evaluated exactly: the gradient is linear between such points, so linear interpolation keeps it. The material
points are found by fixed-point iteration in that table, as physics finds them in contact; where that does not converge
(stretch above 2), Newton's method on the spline itself takes over. Where the surface folds over itself (det J <= 0
somewhere) several X are seen at one x. The camera stands behind the gel and looks along +z through it: a line of sight
leaves the gel through a sheet with det J > 0, and of several it shows the first, which is pressed deepest. The surface
is then drawn as triangles between the points of its table, with a depth test (30 ms for 320 x 240 points).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Float32, FloatArray, SurfaceMap
from tacsim.models.scene import GelSurface
from tacsim.models.sensor import CanonicalGrid, Markers
from tacsim.optics.grid import PixelGrid, canonical_cells
from tacsim.optics.markers import marker_flow
from tacsim.optics.spline import SplineTable, displacement_and_jacobian, refine_spline, spline_table
from tacsim.optics.tuning import MAX_LAST_STEP, MAX_POINTS_PER_SPACING, SURFACE_TABLE_PITCH


class SurfaceFolded(ValueError):
    """The gel surface folds over itself: Newton's method finds no single material point of an image point."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceSample:
    """A gel surface seen on a grid of image points."""

    height: Float32  # (rows, columns) into the gel, positive where pressed; 0 outside the gel [m]
    gradient: Float32  # (rows, columns, 2) d height/dx, d height/dy; 0 outside the gel [-]
    valid: NDArray[np.bool_]  # (rows, columns) False outside the gel


def sample_surface(surface: GelSurface, grid: PixelGrid) -> SurfaceSample:
    """Height and gradient of the deformed surface at the points of `grid`.

    Where the surface folds over itself it is the sheet that the camera sees, and its slope is that of a sheet with
    det J of MIN_JACOBIAN where it turns away.

    Raises ValueError for an invalid surface (shape, NaN, more sideways motion than the gel is wide).
    """
    table = SurfaceTable(surface)
    seen, valid = table.sample_on_grid(table.fields, grid)
    return SurfaceSample(seen[..., 0], seen[..., 1:], valid)


class SurfaceTable:
    """A gel surface at material points that halve the cells of its lattice; rows along y, columns along x."""

    def __init__(self, surface: GelSurface) -> None:
        """Raises what :func:`sample_surface` raises."""
        check_surface(surface)
        self._surface, self._splines = surface, _tabulate(surface)
        self._lateral = self._splines.lateral
        self.pitch = surface.spacing / _points_per_spacing(surface)  # [m]

    @property
    def folded(self) -> bool:
        """True if the surface folds over itself at one of the points."""
        return self._splines.folded

    @property
    def height(self) -> Float32:
        """(rows, columns) [m]"""
        return self._splines.height

    @property
    def fields(self) -> Float32:
        """(rows, columns, 3) height [m], its derivatives by x and y in the image [-]"""
        return self._splines.fields

    def spline_values(self, values: Float32) -> Float32:
        """(rows, columns, 1) at the table's points of the spline whose control values are `values` (nx, ny)."""
        points = _points_per_spacing(self._surface)
        along_x = refine_spline(values, points)
        return refine_spline(np.ascontiguousarray(along_x.T), points)[..., None]

    def visible_part(self, grid: PixelGrid) -> tuple[slice, slice]:
        """Rows and columns of the table in which all lies that is seen at the points of `grid`; at least one."""
        # sideways motion, a neighbour to be linear to, and one to spare, as points are found to a part of one
        reach = 2.0 + max(float(self._lateral.max()), -float(self._lateral.min()))

        def along(first: float, number: int, points: int) -> slice:
            start, stop = first / self.pitch - reach, (first + (number - 1) * grid.pitch) / self.pitch + reach
            start, stop = (min(max(0, int(end)), points - 1) for end in (start, stop))
            return slice(start, stop + 1)

        (rows, columns), (origin_x, origin_y) = self.height.shape[:2], self._surface.origin
        return along(grid.y0 - origin_y, grid.rows, rows), along(grid.x0 - origin_x, grid.columns, columns)

    def deformed_coordinates(self) -> tuple[Float32, Float32]:
        """x and y (rows, columns) where each point is seen [m]."""
        (rows, columns), pitch = self.height.shape[:2], np.float32(self.pitch)
        origin_x, origin_y = (np.float32(each) for each in self._surface.origin)
        x = origin_x + pitch * (np.arange(columns, dtype=np.float32) + self._lateral[..., 0])
        y = origin_y + pitch * (np.arange(rows, dtype=np.float32)[:, None] + self._lateral[..., 1])
        return x, y

    def interpolate_at_rest(self, values: Float32, x: Float32, y: Float32) -> Float32:
        """`values` (rows, columns) of the table's points at places x, y (...,) on the untouched gel [m], linear between
        them; beyond the gel as on its border."""
        origin_x, origin_y = (np.float32(each) for each in self._surface.origin)
        pitch = np.float32(self.pitch)
        return bilinear_lookup(values, np.stack([(x - origin_x) / pitch, (y - origin_y) / pitch], axis=-1))

    def sample_on_grid(
        self, values: Float32, grid: PixelGrid, *, fine: bool = True
    ) -> tuple[Float32, NDArray[np.bool_]]:
        """`values` (rows, columns, n <= 4) of the table's points, linear between them, as seen at the points of `grid`:
        (H, W, n), 0 outside the gel; and (H, W) False there. Not `fine` will do for colours.
        """
        points, inside = self.table_points(grid, fine=fine)
        return self.interpolate_at(values, points, inside), inside

    @staticmethod
    def interpolate_at(values: Float32, points: Float32, inside: NDArray[np.bool_]) -> Float32:
        """The same where `points` and `inside` are known already."""
        seen = bilinear_lookup(values, points)
        if not inside.all():
            seen[~inside] = 0.0
        return seen

    def table_points(self, grid: PixelGrid, *, fine: bool = True) -> tuple[Float32, NDArray[np.bool_]]:
        """(H, W, 2) column, row in the table for each point of `grid`; (H, W) False outside the gel."""
        if not self.folded:
            try:
                return self._unfolded_points(grid, fine)
            except SurfaceFolded:  # between the points of the table
                pass
        seen = _table_coordinates(self._surface.origin, self.pitch, grid)[0, 0].astype(np.float64)
        at = np.indices(self.height.shape[:2], dtype=np.float64)[::-1].transpose(1, 2, 0) + self._lateral
        return visible_table_points((at - seen) * (self.pitch / grid.pitch), self.height, grid.shape)

    def _unfolded_points(self, grid: PixelGrid, fine: bool) -> tuple[Float32, NDArray[np.bool_]]:
        """:meth:`table_points` of a surface that does not fold over. Raises SurfaceFolded where it does."""
        # Where the grid is finer than the table, points are found on a coarser one, twice as fine as the table or, not
        # `fine`, just as fine, and are linear between those: the surface's sideways motion is smooth. The first errs
        # less than the look-up rounds; the second about as much, but by half a pixel where a slide shears the surface.
        block = max(1, self.points_per_cell(grid) // (2 if fine else 1))  # points a coarse one, along a side
        points = interpolate_blocks(self._material_points(block_centres(grid, block)), block, grid.shape)
        # where no sheet folds over, what lies within a border that is on the gel is on it, too
        border = np.concatenate([points[0], points[-1], points[:, 0], points[:, -1]])
        on_gel = self._is_on_table(border[None]).all()
        return points, np.ones(grid.shape, dtype=np.bool_) if on_gel else self._is_on_table(points)

    def points_per_cell(self, grid: PixelGrid) -> int:
        """Whole points of `grid` that lie along a side of one cell of the table; at least 1."""
        return max(1, int(self.pitch / grid.pitch * (1 + 1e-6)))

    def rest_coordinates(self, points: Float32, grid: PixelGrid) -> Float32:
        """(H, W, 2) column, row in `grid` of where `points` of :meth:`table_points` lie on the untouched gel."""
        import cv2

        scale = self.pitch / grid.pitch
        start_x, start_y = (np.array(self._surface.origin) - (grid.x0, grid.y0)) / grid.pitch
        placing = np.array([[scale, 0.0, start_x], [0.0, scale, start_y]], dtype=np.float32)
        return np.asarray(cv2.transform(points, placing), dtype=np.float32)  # a twentieth of the time of NumPy

    def _material_points(self, grid: PixelGrid) -> Float32:
        """(rows, columns, 2) material points [table points] under the image points of `grid`: X <- x - u(X)."""
        max_steps = 20
        import cv2

        seen = _table_coordinates(self._surface.origin, self.pitch, grid)
        last, points = seen, seen - bilinear_lookup(self._lateral, seen)
        for _ in range(max_steps - 1):
            # not cv2.norm of both: a signal that raises in it, such as Ctrl-C, ends the process (OpenCV 4.13)
            if cv2.norm(cv2.absdiff(points, last), cv2.NORM_INF) <= MAX_LAST_STEP:
                return points
            last, points = points, seen - bilinear_lookup(self._lateral, points)
        restless = np.abs(points - last).max(axis=2) > MAX_LAST_STEP
        exact = material_points(self._surface, self._surface.origin + self.pitch * seen[restless].astype(np.float64))
        points[restless] = (exact - self._surface.origin) / self.pitch
        return points

    def _is_on_table(self, points: Float32) -> NDArray[np.bool_]:
        """(rows, columns) where material points [table points] lie on the table."""
        import cv2

        rows, columns = self.height.shape[:2]
        first: Any = (-MAX_LAST_STEP, -MAX_LAST_STEP)  # OpenCV 4.13 declares arrays only, and takes these too
        last: Any = (columns - 1 + MAX_LAST_STEP, rows - 1 + MAX_LAST_STEP)
        inside = cv2.inRange(points, first, last)
        return np.asarray(inside, dtype=np.bool_)


def surface_map(surface: GelSurface, grid: CanonicalGrid, markers: Markers | None) -> SurfaceMap:
    """What a simulated sensor knows of its own surface, on the canonical grid; flow only if it has `markers`.

    Raises what :func:`sample_surface` raises.
    """
    table, cells = SurfaceTable(surface), canonical_cells(grid)
    points, inside = table.table_points(cells)
    flow = None if markers is None else marker_flow(surface, markers)

    def gradient() -> Float32:
        return np.ascontiguousarray(table.interpolate_at(table.fields, points, inside)[..., 1:])

    return SurfaceMap(table.interpolate_at(table.height, points, inside), gradient, flow)


def material_points(surface: GelSurface, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 2) material points X with X + u(X) = x for image points x (n, 2) [m], by Newton on the spline itself.

    Exact to 1 nm and slow; :func:`sample_surface` is fast on a grid. Raises SurfaceFolded where there is none, or
    several: of those :class:`SurfaceTable` finds the one that is seen.
    """
    max_steps = 40
    found = np.array(points, dtype=np.float64)
    displacement, _ = displacement_and_jacobian(surface, found)
    found = points - displacement[:, :2]
    for _ in range(max_steps):
        displacement, jacobian = displacement_and_jacobian(surface, found)
        residual = found + displacement[:, :2] - points
        if float(np.abs(residual).max(initial=0.0)) < 1e-9:
            return found
        deformation = np.eye(2) + jacobian[:, :2, :]
        folded = np.linalg.det(deformation) <= 0.0
        if folded.any():
            raise _is_folded(found[folded])
        move = np.linalg.solve(deformation, residual[..., None])[..., 0]
        length = np.linalg.norm(move, axis=1, keepdims=True)
        found -= move * np.minimum(1.0, surface.spacing / np.maximum(length, 1e-300))  # at most one lattice cell a step
    raise _is_folded(found[np.abs(residual).max(axis=1) >= 1e-9])


def check_surface(surface: GelSurface) -> None:
    """Raises ValueError naming what is wrong with a surface that is none."""
    displacement = surface.displacement
    if displacement.ndim != 3 or displacement.shape[2] != 3 or min(displacement.shape[:2]) < 3:
        raise ValueError(f"GelSurface.displacement must be (nx >= 3, ny >= 3, 3), got {displacement.shape}")
    if not (math.isfinite(surface.spacing) and surface.spacing > 0):
        raise ValueError(f"GelSurface.spacing must be positive [m], got {surface.spacing}")
    finite = np.isfinite(displacement)
    if not finite.all():
        bad = np.argwhere(~finite.all(axis=2))
        raise ValueError(
            f"GelSurface.displacement is not finite at {len(bad)} of {finite[..., 0].size} nodes, first at "
            f"{tuple(int(i) for i in bad[0])}: the simulation has diverged; restore a snapshot"
        )
    lateral = float(np.abs(displacement[..., :2]).max())
    width = surface.spacing * (max(displacement.shape[:2]) - 1)
    if lateral > width:
        raise ValueError(f"gel surface moved {lateral:.3g} m sideways, more than the gel is wide ({width:.3g} m)")


def _tabulate(surface: GelSurface) -> SplineTable:
    displacement = np.asarray(surface.displacement, dtype=np.float32)
    points = _points_per_spacing(surface)
    return spline_table(displacement.tobytes(), displacement.shape, surface.spacing, points)


def _points_per_spacing(surface: GelSurface) -> int:
    """Table points for each lattice spacing: even, so that every kink of the gradient lies on one."""
    return max(
        4,
        2
        * math.ceil(surface.spacing / (2 * max(SURFACE_TABLE_PITCH, surface.spacing / MAX_POINTS_PER_SPACING)) - 1e-9),
    )


@lru_cache(maxsize=16)
def _table_coordinates(origin: tuple[float, float], pitch: float, grid: PixelGrid) -> Float32:
    """(rows, columns, 2) where the points of `grid` lie in a table that starts at `origin` [table points]."""
    coordinates = ((grid.points() - origin) / pitch).astype(np.float32)
    coordinates.flags.writeable = False
    return coordinates


def block_centres(grid: PixelGrid, block: int) -> PixelGrid:
    """The middles of blocks of `block` x `block` points, and one more block on each side; of 1, the grid itself."""
    if block == 1:
        return grid
    rows, columns = (-(-n // block) + 2 for n in grid.shape)
    shift = grid.pitch * (-(block + 1) / 2)  # from the first point to the middle of the block before it
    return PixelGrid(rows, columns, grid.pitch * block, grid.x0 + shift, grid.y0 + shift)


def interpolate_blocks(values: Float32, block: int, shape: tuple[int, int]) -> Float32:
    """(rows, columns, n <= 4) at the points of the grid of `shape`, linear between `values` at those that
    :func:`block_centres` left of it."""
    import cv2

    if block == 1:
        return values
    rows, columns = values.shape[:2]
    fine = cv2.resize(values, (columns * block, rows * block), interpolation=cv2.INTER_LINEAR)
    return np.asarray(fine[block : block + shape[0], block : block + shape[1]], dtype=np.float32)


def bilinear_lookup(field: Float32, points: Float32) -> Float32:
    """`field` (rows, columns, n <= 4) at fractional columns and rows `points` (H, W, 2), linear between entries; beyond
    the border as on it. OpenCV rounds `points` to 1/32."""
    import cv2

    nothing = np.empty(0, dtype=np.float32)
    found = cv2.remap(np.ascontiguousarray(field), points, nothing, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, dtype=np.float32)


def _is_folded(points: NDArray[np.float64]) -> SurfaceFolded:
    x, y = points[0] * 1e3
    return SurfaceFolded(
        f"the gel surface folds over at {len(points)} points, first at x = {x:.3f} mm, y = {y:.3f} mm: it is no height "
        "field there"
    )


def visible_table_points(
    places: FloatArray, height: Float32, shape: tuple[int, int]
) -> tuple[Float32, NDArray[np.bool_]]:
    """The points of a surface's table that an image shows.

    places: (rows, columns, 2) where the table's points are seen, column and row in the image; height: (rows, columns)
    into the gel, any unit; shape: (H, W) of the image.

    Returns (H, W, 2) column and row in the table, and (H, W) False where no sheet faces the camera.
    """
    outside = -1e3  # column and row of points outside the gel
    found = np.full((shape[0] * shape[1], 2), outside, dtype=np.float32)
    deepest = np.full(len(found), -np.inf)
    for row in range(len(places) - 1):
        pixels, points, depth = _covered_points(places[row : row + 2], height[row : row + 2], shape)
        order = np.argsort(depth)  # of one pixel the last is kept
        order = order[depth[order] > deepest[pixels[order]]]
        pixels, points, depth = pixels[order], points[order], depth[order]
        deepest[pixels] = depth
        points[:, 1] += row
        found[pixels] = points
    return found.reshape(*shape, 2), np.isfinite(deepest).reshape(shape)


def _covered_points(
    places: FloatArray, height: Float32, shape: tuple[int, int]
) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Image points (n,) under triangles between two rows of a table (2, columns, ...) that face the camera, one entry a
    triangle: their table points (n, 2) from the first row on, and heights (n,)."""
    margin = 1e-9  # share of a triangle by which a point may lie outside: no gap between neighbours
    corners = np.indices(height.shape, dtype=np.float64)[::-1].transpose(1, 2, 0)  # column, row
    each = np.dstack([places, corners, height])  # place, table point, height: (2, columns, 5)
    a, b, c, d = each[0, :-1], each[0, 1:], each[1, :-1], each[1, 1:]
    triangles = np.stack([np.concatenate([a, d]), np.concatenate([b, c]), np.concatenate([c, b])], axis=1)
    start, sides = triangles[:, 0, :2], triangles[:, 1:, :2] - triangles[:, :1, :2]
    area = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
    first = np.maximum(np.ceil(triangles[:, :, :2].min(axis=1) - margin), 0).astype(np.intp)
    last = np.minimum(np.floor(triangles[:, :, :2].max(axis=1) + margin), (shape[1] - 1, shape[0] - 1)).astype(np.intp)
    wide, high = np.maximum(last - first + 1, 0).T
    number = np.where(area > 0, wide * high, 0)  # of the image points in each box

    owner = np.repeat(np.arange(len(number)), number)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(number) - number, number)
    u, v = first[owner, 0] + within % wide[owner], first[owner, 1] + within // wide[owner]
    by_u, by_v = u - start[owner, 0], v - start[owner, 1]
    (one, two), area = sides[owner].transpose(1, 2, 0), area[owner]
    share = np.stack([by_u * two[1] - by_v * two[0], by_v * one[0] - by_u * one[1]], axis=1) / area[:, None]
    inside = (share >= -margin).all(axis=1) & (share.sum(axis=1) <= 1.0 + margin)
    owner, share = owner[inside], share[inside]
    values = triangles[:, 0, 2:][owner]
    for corner in (1, 2):
        values = values + share[:, corner - 1, None] * (triangles[:, corner, 2:] - triangles[:, 0, 2:])[owner]
    return v[inside] * shape[1] + u[inside], values[:, :2], values[:, 2]
