"""Detection of boards with known points in pictures: dots in a rectangular lattice, and ChArUco.

Dots may be printed, or pressed into a gel, and blurred: a dot is a spot that is darker than its surroundings at one of
several scales.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calibration.errors import CalibrationError
from calibration.lens.tuning import MAX_OUTER_DOT_SHARE, MAX_SAME_POINT_DISTANCE, MIN_DOT_CONTRAST
from tacsim.interface import FloatArray, Image
from tacsim.models.quantity import parse_quantity


class BadBoard(CalibrationError):
    """The description of a board is wrong, or the board is not found."""


@dataclass(frozen=True, slots=True)
class Board:
    """The pattern: `columns` x `rows` dots, or squares of a ChArUco board."""

    kind: str  # "dots" or "charuco"
    columns: int
    rows: int
    pitch: float  # of dots, or of squares [m]
    marker: float = 0.0  # side of a ChArUco marker [m]
    dictionary: str = "DICT_4X4_50"  # of them

    def __str__(self) -> str:
        return f"{self.kind} {self.columns} x {self.rows}, {1e3 * self.pitch:.4g} mm apart"


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Points of a board, and their positions in a picture."""

    board: FloatArray  # (n, 2) x, y on the board, right-handed with z away from the camera [m]
    image: FloatArray  # (n, 2) u, v [px]
    spacing: float  # of neighbours in the picture, median [px]


def parse_board(text: str) -> Board:
    """`dots:COLUMNSxROWS:PITCH` or `charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY]`. Raises BadBoard."""
    max_points = 100  # along a board
    parts = [part.strip() for part in text.split(":")]
    size = re.fullmatch(r"(\d+)\s*x\s*(\d+)", parts[1]) if len(parts) > 1 else None
    lengths = parts[2:4] if parts[0] == "charuco" else parts[2:3]
    right = {"dots": (3,), "charuco": (4, 5)}.get(parts[0], ())
    if size is None or len(parts) not in right:
        raise BadBoard(
            f"'{text}' is no board; give dots:COLUMNSxROWS:PITCH, such as 'dots:9x7:2.5 mm', or "
            "charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY], such as 'charuco:8x6:3 mm:2.2 mm:DICT_4X4_50'"
        )
    columns, rows = int(size[1]), int(size[2])
    if not (3 <= columns <= max_points and 3 <= rows <= max_points):
        raise BadBoard(f"'{text}': {columns} x {rows}; allowed: 3 to {max_points} along each axis")
    try:
        metres = [parse_quantity(length, "length") for length in lengths]
    except ValueError as error:
        raise BadBoard(f"'{text}': {error}") from None
    if not all(1e-5 <= each <= 1.0 for each in metres) or (len(metres) == 2 and metres[1] >= metres[0]):
        raise BadBoard(f"'{text}': lengths must lie within 0.01 mm and 1 m, and a marker inside its square")
    board = Board(parts[0], columns, rows, metres[0])
    if board.kind == "charuco":
        board = replace(board, marker=metres[1], dictionary=parts[4] if len(parts) == 5 else board.dictionary)
        _charuco_board(board)  # refuses an unknown dictionary now
    return board


def find_board(image: Image, board: Board, reference: Image | None = None) -> Points:
    """The board's points in `image` (H, W, 3); `reference` (H, W, 3): the same without the board. Raises BadBoard."""
    if reference is not None and reference.shape != image.shape:
        raise BadBoard(
            f"the picture is {image.shape[1]} x {image.shape[0]} px, the one without the board {reference.shape[1]} x "
            f"{reference.shape[0]}; they must be of one camera"
        )
    return _find_charuco(image, board) if board.kind == "charuco" else _find_dots(image, board, reference)


def _find_dots(image: Image, board: Board, reference: Image | None) -> Points:
    blurs = (2.0, 3.0, 5.0, 8.0, 12.0)  # standard deviations of the blurs that are tried, for dots of any size [px]
    import cv2

    grey = image.mean(axis=2, dtype=np.float32)
    if reference is not None:
        grey -= reference.mean(axis=2, dtype=np.float32)
    most = 0
    for scale in blurs:
        around = cv2.GaussianBlur(grey, (0, 0), 3.0 * scale)
        contrast = np.asarray(around - cv2.GaussianBlur(grey, (0, 0), scale), dtype=np.float64)
        found = _find_dot_lattice(contrast, board)
        if isinstance(found, int):
            most = max(most, found)
            continue
        lattice, blobs = found
        _require_complete_lattice(lattice, blobs, board)
        refined = _refine_centres(contrast, lattice)
        rows, columns = np.mgrid[: lattice.shape[0], : lattice.shape[1]]
        on_board = np.stack([columns, rows], axis=-1) * board.pitch
        steps = np.linalg.norm(np.diff(refined, axis=1), axis=-1)
        return Points(on_board.reshape(-1, 2), refined.reshape(-1, 2), float(np.median(steps)))
    raise BadBoard(
        f"the board ({board}) is not found; {most} dots are seen, {board.columns * board.rows} should be, all of them "
        "inside the picture. Is it this board? A picture without it (--reference) helps where contrast is low"
    )


def _find_dot_lattice(contrast: FloatArray, board: Board) -> tuple[FloatArray, FloatArray] | int:
    """(rows, columns, 2) dots [px], row by row along u and right-handed, and (m, 2) all blobs; the blobs' number where
    they form no such lattice."""
    import cv2

    strongest = float(np.percentile(contrast, 99.0))
    if not strongest > 0.5:  # [grey levels]
        return 0
    shown = np.clip(255.0 * (1.0 - contrast / strongest), 0, 255).astype(np.uint8)
    options = cv2.SimpleBlobDetector.Params()
    options.filterByCircularity = options.filterByConvexity = options.filterByInertia = False
    options.minArea, options.maxArea, options.minDistBetweenBlobs = 9.0, contrast.size / 40.0, 5.0
    detector = cv2.SimpleBlobDetector.create(options)
    blobs = np.array([point.pt for point in detector.detect(shown)], dtype=np.float64).reshape(-1, 2)
    if len(blobs) < board.columns * board.rows:
        return len(blobs)
    for columns, rows in ((board.columns, board.rows), (board.rows, board.columns)):
        for flags in (cv2.CALIB_CB_SYMMETRIC_GRID, cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING):
            done, centres = cv2.findCirclesGrid(shown, (columns, rows), flags=flags, blobDetector=detector)
            if not done:
                continue
            lattice = np.asarray(centres, dtype=np.float64).reshape(rows, columns, 2)
            if not _is_even(lattice):
                continue
            if abs(_mean_step(lattice, 1)[0]) < abs(_mean_step(lattice, 0)[0]):
                lattice = lattice.swapaxes(0, 1)
            lattice = lattice if _mean_step(lattice, 1)[0] > 0 else lattice[:, ::-1]
            return (lattice if _mean_step(lattice, 0)[1] > 0 else lattice[::-1]), blobs
    return len(blobs)


def _is_even(lattice: FloatArray) -> bool:
    """True if each step from dot to dot is similar to the one before: OpenCV may use a dot of the next row."""
    for axis in (0, 1):
        steps = np.diff(lattice, axis=axis)
        change = np.linalg.norm(np.diff(steps, axis=axis), axis=-1)
        if (change > MAX_SAME_POINT_DISTANCE * np.linalg.norm(steps, axis=-1).mean()).any():
            return False
    return True


def _mean_step(lattice: FloatArray, axis: int) -> FloatArray:
    return np.asarray(np.diff(lattice, axis=axis).reshape(-1, 2).mean(axis=0), dtype=np.float64)


def _require_complete_lattice(lattice: FloatArray, blobs: FloatArray, board: Board) -> None:
    """Raises BadBoard if the lattice continues beyond its border: the board is larger than described."""
    for grid in (lattice, lattice[::-1], lattice.swapaxes(0, 1), lattice[:, ::-1].swapaxes(0, 1)):
        beyond = 2.0 * grid[0] - grid[1]
        near = np.linalg.norm(beyond[:, None] - blobs[None], axis=-1).min(axis=1)
        there = near < MAX_SAME_POINT_DISTANCE * np.linalg.norm(grid[0] - grid[1], axis=-1)
        if there.mean() > MAX_OUTER_DOT_SHARE:
            raise BadBoard(
                f"the picture shows more dots than {board.columns} x {board.rows}: {int(there.sum())} lie beyond one "
                "border. Count again: all dots that are seen belong to the board"
            )


def _refine_centres(contrast: FloatArray, lattice: FloatArray) -> FloatArray:
    """The dots' centres of gravity, each within half the distance to its neighbours."""
    import cv2

    found = np.empty_like(lattice)
    for (i, j), (u, v) in zip(np.ndindex(lattice.shape[:2]), lattice.reshape(-1, 2), strict=True):
        around = [
            np.linalg.norm(lattice[a, b] - lattice[i, j])
            for a, b in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1))
            if 0 <= a < lattice.shape[0] and 0 <= b < lattice.shape[1]
        ]
        side = max(3, round(0.45 * float(min(around))))
        place = np.array([u, v])
        for _ in range(3):  # the window follows the dot
            patch = cv2.getRectSubPix(
                contrast.astype(np.float32), (2 * side + 1, 2 * side + 1), (float(place[0]), float(place[1]))
            )
            weight = np.maximum(np.asarray(patch, dtype=np.float64) - MIN_DOT_CONTRAST * float(patch.max()), 0.0)
            rows, columns = np.mgrid[-side : side + 1, -side : side + 1]
            move = np.array([(weight * columns).sum(), (weight * rows).sum()]) / max(float(weight.sum()), 1e-12)
            place = place + move
            if np.hypot(*move) < 0.01:
                break
        found[i, j] = place
    return found


def _charuco_board(board: Board) -> Any:
    import cv2

    code = getattr(cv2.aruco, board.dictionary, None)
    if not board.dictionary.startswith("DICT_") or not isinstance(code, int):
        known = ", ".join(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
        raise BadBoard(f"'{board.dictionary}' is no dictionary of markers; allowed: {known}")
    dictionary = cv2.aruco.getPredefinedDictionary(code)
    if board.columns * board.rows // 2 > len(dictionary.bytesList):
        raise BadBoard(f"{board.dictionary} has {len(dictionary.bytesList)} markers, this board needs more")
    return cv2.aruco.CharucoBoard((board.columns, board.rows), board.pitch, board.marker, dictionary)


def _find_charuco(image: Image, board: Board) -> Points:
    min_corners = 6  # of a ChArUco board
    import cv2

    printed = _charuco_board(board)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    found: Any = cv2.aruco.CharucoDetector(printed).detectBoard(grey)
    corners, names, _, markers = found  # each None where nothing is seen
    count = 0 if names is None else len(names)
    if count < min_corners:
        seen = 0 if markers is None else len(markers)
        raise BadBoard(
            f"the board ({board}, {board.dictionary}) is not found: {count} of its corners and {seen} markers are "
            f"seen, {min_corners} corners are needed. Is it this board, and in focus?"
        )
    every = np.asarray(printed.getChessboardCorners(), dtype=np.float64)[:, :2]
    order = np.ravel(names)
    on_board, seen_at = every[order], np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    apart = np.linalg.norm(on_board[:, None] - on_board[None], axis=-1)
    i, j = np.nonzero(np.triu(apart < 1.1 * board.pitch, 1))
    steps = np.linalg.norm(seen_at[i] - seen_at[j], axis=1)
    spacing = float(np.median(steps)) if len(steps) else float(np.ptp(seen_at))
    # OpenCV 4.13 finds the corners half a pixel off, 4.14 where they are; refined, both agree
    half = int(np.clip(round(spacing / 10), 2, 5))
    until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
    refined = cv2.cornerSubPix(grey, np.ascontiguousarray(seen_at, np.float32), (half, half), (-1, -1), until)
    return Points(on_board, refined.astype(np.float64), spacing)
