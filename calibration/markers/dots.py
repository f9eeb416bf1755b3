"""Detection of dark dots in a picture, with centres to a fraction of a pixel; and their lattice: row and column of each
point, and positions of missing ones."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calibration.markers.tuning import DARKNESS_LEVELS, MAX_PITCH_ERROR, MAX_STEP_ERROR, MIN_ROW_SHARE
from tacsim.interface import Float32, FloatArray, Image, Mask
from tacsim.optics.ink import DotEraser as DotEraser
from tacsim.optics.ink import dot_filters, local_darkness

if TYPE_CHECKING:
    from scipy.spatial import KDTree


@dataclass(frozen=True, slots=True, eq=False)
class Dots:
    """The dots of one picture."""

    centres: FloatArray  # (n, 2) u, v [px]
    areas: FloatArray  # (n,) [px^2]

    @property
    def radius(self) -> float:
        """Radius of a disc with the median area [px]."""
        return float(np.sqrt(np.median(self.areas) / np.pi)) if len(self.areas) else 0.0


class DotFinder:
    """Finds dots of about one radius [px].

    Darkness is the difference of a picture from its closing (the brightness around each place), as a share of the
    closing. Unlike a difference of Gaussians it finds no dot on the dark side of a step of brightness, which every rim
    of a contact has. A centre is the mean of the dot's pixels, weighted with their darkness above the threshold.
    """

    def __init__(self, radius: float) -> None:
        """Raises ValueError for dots too small to be found."""
        self._side, self._blur = dot_filters(radius)
        self._area = np.pi * radius**2

    def __call__(self, image: Image) -> Dots:
        """The dots of a picture (H, W, 3) or of one channel of it (H, W)."""
        dark = local_darkness(image, self._side, self._blur)
        found = []
        for level in DARKNESS_LEVELS:
            dots, rest = self._find_blobs(dark, level)
            found.append(dots)
            if rest is None:
                break
            dark = rest
        return Dots(np.concatenate([d.centres for d in found]), np.concatenate([d.areas for d in found]))

    def _find_blobs(self, dark: Float32, level: float) -> tuple[Dots, Float32 | None]:
        """The dots among the blobs above `level`, and the rest in blobs that are too large or long to be one."""
        max_elongation = 2.0  # length over breadth
        min_area, max_area = 0.2, 7.0  # of a dot, half hidden or painted over [areas of a disc]
        min_filled = 0.4  # share of its bounding box that a dot fills
        import cv2

        mask = (dark > level).astype(np.uint8)
        kind = cv2.CV_16U if mask.size < 1 << 16 else cv2.CV_32S  # room for as many labels as pixels; 16 is faster
        count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4, ltype=kind)
        area = stats[:, cv2.CC_STAT_AREA]
        width, height = stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]
        large = area > min_area * self._area
        compact = (area < max_area * self._area) & (
            np.maximum(width, height) < max_elongation * np.minimum(width, height)
        )
        compact &= area > min_filled * width * height
        large[0] = False  # what is no blob
        good = large & compact
        where = np.flatnonzero(mask)
        label = labels.ravel()[where].astype(np.intp)
        weight = dark.ravel()[where].astype(np.float64) - level
        rows, columns = np.divmod(where, mask.shape[1])
        total = np.maximum(np.bincount(label, weight, count), 1e-12)
        centres = np.stack([np.bincount(label, weight * at, count) / total for at in (columns, rows)], axis=1)
        dots = Dots(centres[good], area[good].astype(np.float64))
        clumps = large & ~compact
        return dots, np.where(clumps[labels], dark, np.float32(0.0)) if clumps.any() else None


class NoLattice(ValueError):
    """The points are not the requested lattice. The message describes the points."""


@dataclass(frozen=True, slots=True, eq=False)
class Lattice:
    """A lattice with rows approximately along y and columns along x."""

    positions: FloatArray  # (rows, columns, 2); where no point is, the lattice's smooth continuation
    present: Mask  # (rows, columns) a point is there
    extra_points: int  # points that belong to the same lattice, but beyond its rows and columns

    @property
    def pitch(self) -> float:
        """Typical distance of neighbours."""
        along = np.linalg.norm(np.diff(self.positions, axis=1), axis=2).ravel()
        down = np.linalg.norm(np.diff(self.positions, axis=0), axis=2).ravel()
        return float(np.median(np.concatenate([along, down])))


def median_pitch(points: FloatArray) -> float:
    """Median distance to the nearest neighbour, of points (n >= 2, 2)."""
    from scipy.spatial import KDTree

    away, _ = KDTree(points).query(points, k=2)
    return float(np.median(np.asarray(away)[:, 1]))


def find_lattice(points: FloatArray, shape: tuple[int, int] | None = None, pitch: float | None = None) -> Lattice:
    """The square lattice in `points` (n, 2), turned by less than 45 degrees; outliers and gaps may be among them.

    Args:
        points: x, y; the requested lattice is as near to (0, 0) as its points allow.
        shape: rows, columns; None: all.
        pitch: distance of neighbours; None: the typical one of these points.

    Raises NoLattice if fewer than 2 x 2 points form a lattice.
    """
    if len(points) < 4:
        raise NoLattice(f"{len(points)} dots found, a lattice has at least 4")
    found = median_pitch(points) if pitch is None else pitch
    labels = _label_points(points, found)
    if len(labels) < 4 or min(np.ptp(list(labels.values()), axis=0)) < 1:
        raise NoLattice(f"{len(points)} dots found, but no rows and columns of them about {found:.3g} apart")
    which, at = np.array(list(labels)), np.array(list(labels.values()))  # at: row, column
    low, size = _lattice_window(points[which], at, shape)
    inside = ((at >= low) & (at < low + size)).all(axis=1)
    which, at = which[inside], at[inside] - low
    present = np.zeros(size, dtype=np.bool_)
    present[at[:, 0], at[:, 1]] = True
    positions = np.zeros((*size, 2))
    positions[at[:, 0], at[:, 1]] = points[which]
    return Lattice(_complete_lattice(positions, present), present, len(labels) - len(which))


def _label_points(points: FloatArray, pitch: float) -> dict[int, tuple[int, int]]:
    """Row and column (with any origin) of all connected points, by the index of the point: grown from the most regular
    place, with each step predicted from the steps of its neighbour."""
    from scipy.spatial import KDTree

    tree = KDTree(points)
    away, near = (np.asarray(found) for found in tree.query(points, k=min(5, len(points))))
    steps = points[near[:, 1:]] - points[:, None, :]
    regular = np.abs(away[:, 1:] - pitch) < MAX_PITCH_ERROR * pitch
    if not regular.any():
        return {}
    angle = np.angle(np.exp(4j * np.arctan2(steps[regular][:, 1], steps[regular][:, 0])).mean()) / 4
    along = pitch * np.array([np.cos(angle), np.sin(angle)])  # one column further
    down = np.array([-along[1], along[0]])  # one row further
    aside = np.linalg.norm(points - np.median(points, axis=0), axis=1) / pitch
    start = int(np.argmax(regular.sum(axis=1) - 1e-3 * aside))
    labels = {start: (0, 0)}
    taken = {(0, 0)}
    queue: deque[tuple[int, FloatArray, FloatArray]] = deque([(start, along, down)])
    reached: list[tuple[int, FloatArray, FloatArray]] = []
    while queue:
        one, along, down = queue.popleft()
        reached.append((one, along, down))
        found = _find_neighbours(tree, points, labels, taken, (one, along, down), pitch, 1)
        if not (found or queue):  # a whole row may be missing: from there on by two steps
            for from_there in reached:
                found += _find_neighbours(tree, points, labels, taken, from_there, pitch, 2)
        queue.extend(found)
    return labels


def _find_neighbours(
    tree: KDTree,
    points: FloatArray,
    labels: dict[int, tuple[int, int]],
    taken: set[tuple[int, int]],
    place: tuple[int, FloatArray, FloatArray],
    pitch: float,
    far: int,
) -> list[tuple[int, FloatArray, FloatArray]]:
    """The points `far` steps from one to all sides, each with the steps there; they are labelled here."""
    one, along, down = place
    row, column = labels[one]
    new = []
    for side, step in (((0, 1), along), ((0, -1), -along), ((1, 0), down), ((-1, 0), -down)):
        there = (row + far * side[0], column + far * side[1])
        distance, other = tree.query(points[one] + far * step)
        if distance > MAX_STEP_ERROR * pitch or other in labels or there in taken:
            continue
        labels[int(other)] = there
        taken.add(there)
        seen = (points[other] - points[one]) * (side[0] + side[1]) / far
        bent = (0.5 * (along + seen), down) if side[0] == 0 else (along, 0.5 * (down + seen))
        new.append((int(other), *bent))
    return new


def describe_missing_line(present: Mask, visible: Mask | None = None) -> str | None:
    """Description of the first row or column of a lattice (rows, columns) without any dot, or None. visible: dots that
    are in view; a line with fewer than 3 of them is skipped."""
    shown = np.ones_like(present) if visible is None else visible
    for axis, name in ((1, "row"), (0, "column")):
        empty = np.flatnonzero(~present.any(axis=axis) & (shown.sum(axis=axis) >= 3))
        if len(empty):
            return f"{name} {empty[0] + 1} of {present.shape[1 - axis]} shows no dot"
    return None


def _lattice_window(
    points: FloatArray, at: NDArray[np.intp], shape: tuple[int, int] | None
) -> tuple[NDArray[np.intp], tuple[int, int]]:
    """First row and column, and how many, of the lattice among points (n, 2) labelled `at` (n, 2)."""
    first = at.min(axis=0)
    filled = np.zeros(at.max(axis=0) - first + 1, dtype=np.intp)
    filled[tuple((at - first).T)] = 1
    if shape is None:
        rows, columns = (np.flatnonzero(n >= MIN_ROW_SHARE * n.max()) for n in (filled.sum(axis=1), filled.sum(axis=0)))
        low = np.array([rows[0], columns[0]])
        return first + low, (int(rows[-1] - rows[0] + 1), int(columns[-1] - columns[0] + 1))
    best, chosen = (-1, 0.0), first
    for row in range(min(0, filled.shape[0] - shape[0]), max(0, filled.shape[0] - shape[0]) + 1):
        for column in range(min(0, filled.shape[1] - shape[1]), max(0, filled.shape[1] - shape[1]) + 1):
            part = filled[max(row, 0) : row + shape[0], max(column, 0) : column + shape[1]]
            low = first + (row, column)
            middle = _fit_affine(points, at) @ np.array([1.0, *(low + (np.array(shape) - 1) / 2)])
            score = (int(part.sum()), -float(np.hypot(*middle)))
            if score > best or best[0] < 0:
                best, chosen = score, low
    return chosen, shape


def _fit_affine(points: FloatArray, at: NDArray[np.intp]) -> FloatArray:
    """(2, 3) from (1, row, column) to the place."""
    terms = np.column_stack([np.ones(len(at)), at])
    return np.asarray(np.linalg.lstsq(terms, points, rcond=None)[0].T, dtype=np.float64)


def _complete_lattice(positions: FloatArray, present: Mask) -> FloatArray:
    """`positions` (rows, columns, 2) with missing ones added: the affine lattice plus deviations of the neighbours."""
    if present.all():
        return positions
    at = np.argwhere(np.ones_like(present))
    terms = np.column_stack([np.ones(len(at)), at])
    affine = (terms @ _fit_affine(positions[present], np.argwhere(present)).T).reshape(positions.shape)
    bent = fill_from_neighbours(np.where(present[..., None], positions - affine, 0.0), present)
    return np.asarray(affine + bent, dtype=np.float64)


def fill_from_neighbours(values: FloatArray, known: Mask) -> FloatArray:
    """`values` (rows, columns, n); where not `known`, the mean of the nearest known neighbours, ring by ring."""
    if known.all() or not known.any():
        return values
    found, done = np.where(known[..., None], values, 0.0), known.copy()
    rows, columns = known.shape
    while not done.all():
        padded = np.pad(np.where(done[..., None], found, 0.0), ((1, 1), (1, 1), (0, 0)))
        weight = np.pad(done.astype(np.float64), 1)
        shifts = [(slice(r, r + rows), slice(c, c + columns)) for r in range(3) for c in range(3)]
        total, count = np.sum([padded[s] for s in shifts], axis=0), np.sum([weight[s] for s in shifts], axis=0)
        new = ~done & (count > 0)
        found[new] = total[new] / count[new][:, None]
        done |= new
    return found
