"""A gel surface that folds over itself: which of its sheets each image point shows.

The camera stands behind the gel and looks along +z through it. A line of sight leaves the gel through a sheet that
faces the camera (det J > 0, see tacsim.optics.surface); of several it shows the first, which is the one pressed
deepest. The rest is behind: sheets pressed less, and between two of them one that faces away.

The surface is taken as triangles between the points of its table, and drawn over the image points with a depth test.
That takes 30 ms for 320 x 240 points; a surface without a fold needs none of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

EDGE_MARGIN = 1e-9  # share of a triangle by which a point may lie outside: no gap between neighbours
MIN_JACOBIAN = 0.1  # det J of a sheet that is seen edge-on; its slope is as that of one this narrow in the picture
OUTSIDE_GEL = -1e3  # column and row of what lies beside the gel


def visible_table_points(places: Float64, height: Float32, shape: tuple[int, int]) -> tuple[Float32, NDArray[np.bool_]]:
    """The points of a surface's table that an image shows.

    places: (rows, columns, 2) where the table's points are seen, column and row in the image; height: (rows, columns)
    into the gel, any unit; shape: (H, W) of the image.

    Returns (H, W, 2) column and row in the table, and (H, W) False where no sheet faces the camera.
    """
    found = np.full((shape[0] * shape[1], 2), OUTSIDE_GEL, dtype=np.float32)
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
    places: Float64, height: Float32, shape: tuple[int, int]
) -> tuple[NDArray[np.intp], Float64, Float64]:
    """Image points (n,) under triangles between two rows of a table (2, columns, ...) that face the camera, one entry a
    triangle: their table points (n, 2) from the first row on, and heights (n,)."""
    corners = np.indices(height.shape, dtype=np.float64)[::-1].transpose(1, 2, 0)  # column, row
    each = np.dstack([places, corners, height])  # place, table point, height: (2, columns, 5)
    a, b, c, d = each[0, :-1], each[0, 1:], each[1, :-1], each[1, 1:]
    triangles = np.stack([np.concatenate([a, d]), np.concatenate([b, c]), np.concatenate([c, b])], axis=1)
    start, sides = triangles[:, 0, :2], triangles[:, 1:, :2] - triangles[:, :1, :2]
    area = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
    first = np.maximum(np.ceil(triangles[:, :, :2].min(axis=1) - EDGE_MARGIN), 0).astype(np.intp)
    last = np.minimum(np.floor(triangles[:, :, :2].max(axis=1) + EDGE_MARGIN), (shape[1] - 1, shape[0] - 1)).astype(
        np.intp
    )
    wide, high = np.maximum(last - first + 1, 0).T
    number = np.where(area > 0, wide * high, 0)  # of the image points in each box

    owner = np.repeat(np.arange(len(number)), number)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(number) - number, number)
    u, v = first[owner, 0] + within % wide[owner], first[owner, 1] + within // wide[owner]
    by_u, by_v = u - start[owner, 0], v - start[owner, 1]
    (one, two), area = sides[owner].transpose(1, 2, 0), area[owner]
    share = np.stack([by_u * two[1] - by_v * two[0], by_v * one[0] - by_u * one[1]], axis=1) / area[:, None]
    inside = (share >= -EDGE_MARGIN).all(axis=1) & (share.sum(axis=1) <= 1.0 + EDGE_MARGIN)
    owner, share = owner[inside], share[inside]
    values = triangles[:, 0, 2:][owner]
    for corner in (1, 2):
        values = values + share[:, corner - 1, None] * (triangles[:, corner, 2:] - triangles[:, 0, 2:])[owner]
    return v[inside] * shape[1] + u[inside], values[:, :2], values[:, 2]
