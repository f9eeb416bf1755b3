"""Projection of points in space and on the gel's plane to a camera's picture: lens, and view of the plane.

A lens is calibrated from several pictures of one board at many tilts. The view of a gel's plane needs one picture of a
board on it: a perspective through the lens, or for an unknown lens with the amount of radial distortion that predicts
left-out dots best.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calibration.errors import CalibrationError
from calibration.lens.board import Points
from calibration.lens.tuning import MAX_FOCAL_DEVIATION, MAX_PLANE_MISFIT, MAX_RESIDUAL, MIN_REDUCTION
from tacsim import pose as se3
from tacsim.interface import FloatArray, Pose
from tacsim.models.sensor import GelView as GelView
from tacsim.models.sensor import Lens as Lens
from tacsim.models.sensor import Pair, ray_slopes

MIN_PICTURES = 6  # for a lens
MIN_TILT = np.radians(8.0)  # of the board between pictures, root mean square [rad]


Corners = tuple[Pair, Pair, Pair, Pair]


class BadView(CalibrationError):
    """The pictures of a board do not determine a lens or a plane."""


class BadCorners(CalibrationError):
    """The four corners are not the picture of a rectangle."""


def pinhole_lens(image_shape: tuple[int, int], distortion: Sequence[float] = ()) -> Lens:
    """An unknown lens, with the picture's longer side as its focal length. distortion: k1, k2, and its centre from the
    picture's centre, over the longer side."""
    rows, columns = image_shape
    k1, k2, off_x, off_y = (*distortion, 0.0, 0.0, 0.0, 0.0)[:4]
    side = float(max(rows, columns))
    return Lens(
        width=columns,
        height=rows,
        focal=(side, side),
        centre=((columns - 1) / 2 + off_x * side, (rows - 1) / 2 + off_y * side),
        distortion=(k1, k2, 0.0, 0.0, 0.0),
    )


def fit_lens(pictures: Mapping[str, Points], image_shape: tuple[int, int]) -> tuple[Lens, dict[str, float]]:
    """The lens from several pictures of one board, and each picture's residual [px]. Raises BadView."""
    import cv2

    if len(pictures) < MIN_PICTURES:
        raise BadView(
            f"{len(pictures)} picture(s) of a board are too few for a lens; at least {MIN_PICTURES} are needed, 12 "
            "are good, with the board tilted by 20 to 40 degrees to all sides, and in all corners of the picture"
        )
    rows, columns = image_shape
    on_board = [np.pad(each.board, ((0, 0), (0, 1))).astype(np.float32) for each in pictures.values()]
    seen = [each.image.astype(np.float32).reshape(-1, 1, 2) for each in pictures.values()]
    # k3 is only needed for wider lenses
    answer: Any = cv2.calibrateCameraExtended(
        on_board, seen, (columns, rows), np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3
    )
    residual, matrix, distortion, turns, _, std_intrinsics, _, each = answer
    found = dict(zip(pictures, np.ravel(each).tolist(), strict=True))
    if not residual <= MAX_RESIDUAL:
        worst = max(found, key=found.__getitem__)
        raise BadView(
            f"the pictures do not fit one lens and one flat board: {residual:.2f} px root mean square, "
            f"{MAX_RESIDUAL:g} at most (worst: {worst}, {found[worst]:.2f} px). Is the board flat, its size right, "
            "and the focus fixed?"
        )
    from scipy.spatial.transform import Rotation

    normals = Rotation.from_rotvec(np.reshape(turns, (-1, 3))).as_matrix()[:, :, 2]
    mean = normals.mean(axis=0)
    mean /= np.linalg.norm(mean)
    tilt = float(np.sqrt((np.arccos(np.clip(normals @ mean, -1.0, 1.0)) ** 2).mean()))
    if not tilt >= MIN_TILT:
        raise BadView(
            f"the board is tilted by only {np.degrees(tilt):.1f} degrees between pictures (root mean square), "
            f"{np.degrees(MIN_TILT):.0f} are needed to tell its distance from the focal length: tilt the board more, "
            "by 20 to 40 degrees to all sides"
        )
    uncertainty = float(np.max(np.ravel(std_intrinsics)[:2] / np.diag(matrix)[:2]))
    if not uncertainty <= MAX_FOCAL_DEVIATION:
        raise BadView(
            f"the focal length is uncertain by {uncertainty:.0%} ({MAX_FOCAL_DEVIATION:.0%} at most): "
            "tilt the board more, by 20 to 40 degrees to all sides"
        )
    k = [float(value) for value in np.ravel(distortion)[:5]]
    lens = Lens(
        width=columns,
        height=rows,
        focal=(float(matrix[0, 0]), float(matrix[1, 1])),
        centre=(float(matrix[0, 2]), float(matrix[1, 2])),
        distortion=(k[0], k[1], k[2], k[3], k[4]),
        residual=float(residual),
    )
    return lens, found


def board_pose(lens: Lens, points: Points) -> tuple[Pose, float]:
    """camera_from_board, and the residual [px]. Raises BadView."""
    import cv2

    on_board = np.pad(points.board, ((0, 0), (0, 1)))
    known = (lens.matrix, np.array(lens.distortion))
    done, turn, shift = cv2.solvePnP(on_board, points.image, *known, flags=cv2.SOLVEPNP_IPPE)
    if not done:
        raise BadView("the board's points determine no pose")
    turn, shift = cv2.solvePnPRefineLM(on_board, points.image, *known, turn, shift)
    again, _ = cv2.projectPoints(on_board, turn, shift, *known)
    missed = np.asarray(again).reshape(-1, 2) - points.image
    return se3.from_rotation_vector(np.ravel(shift), np.ravel(turn)), float(np.sqrt((missed**2).sum(axis=1).mean()))


def fit_view(
    points: Points,
    image_shape: tuple[int, int],
    lens: Lens | None = None,
    centre: Pair | None = None,
    size: Pair | None = None,
    board: str = "",
) -> GelView:
    """The view of the plane of a board.

    Args:
        lens: of the camera; None: radial distortion is also fitted if it improves the prediction.
        centre: pixel (u, v) of the sensor's axis; None: the picture's centre.
        size: x, y of the gel [m]; None: the extent of the board, plus half a pitch on each side.

    Raises BadView.
    """
    min_points = 6  # of a plane
    if len(points.board) < min_points:
        raise BadView(f"{len(points.board)} points determine no plane; at least {min_points} are needed")
    rows, columns = image_shape
    if lens is not None and (lens.height, lens.width) != image_shape:
        raise BadView(
            f"the picture is {columns} x {rows} px, the lens was calibrated at {lens.width} x {lens.height} px; use "
            "one setting of the camera"
        )
    middle = points.board.mean(axis=0)
    local: FloatArray = np.asarray(points.board - middle, dtype=np.float64)
    if lens is not None:
        perspective = _fit_homography(lens, local, points.image)
    else:
        lens, perspective = _fit_distortion(local, points.image, image_shape)
    missed = lens.project(ray_slopes(perspective, local)) - points.image
    residual = float(np.sqrt((missed**2).sum(axis=1).mean()))
    if not residual <= MAX_PLANE_MISFIT * points.spacing:
        raise BadView(
            f"the points lie on no plane that this camera could see: {residual:.2f} px root mean square, where "
            f"neighbours are {points.spacing:.0f} px apart ({MAX_PLANE_MISFIT:.0%} at most). Is the board flat on the "
            "gel, and its number of rows and columns right?"
        )
    back: FloatArray = np.asarray(np.linalg.inv(perspective), dtype=np.float64)
    axis = ((columns - 1) / 2, (rows - 1) / 2) if centre is None else centre
    near = lens.directions(np.array([axis, (axis[0] + 1.0, axis[1]), (axis[0], axis[1] + 1.0)]))
    origin, right, below = ray_slopes(back, near)
    along = right - origin
    pitch = float(np.sqrt(np.hypot(*along) * np.hypot(*(below - origin))))
    turn = np.arctan2(along[1], along[0])
    board_from_gel = np.array(
        [[np.cos(turn), -np.sin(turn), origin[0]], [np.sin(turn), np.cos(turn), origin[1]], [0, 0, 1.0]]
    )
    on_gel = ray_slopes(np.linalg.inv(board_from_gel), local)
    if size is None:
        step = 0.5 * points.spacing * pitch
        reach = np.minimum(on_gel.max(axis=0), -on_gel.min(axis=0)) + step
        if not (reach > 2 * step).all():
            raise BadView("the sensor's axis lies off the board; give --centre, or press the board round it")
        size = (2 * float(reach[0]), 2 * float(reach[1]))
    p = perspective @ board_from_gel
    p /= p[2, 2]
    return GelView(
        lens=lens,
        perspective=tuple(tuple(float(value) for value in row) for row in p),
        size=size,
        pixel_pitch=pitch,
        residual=residual,
        residual_length=residual * pitch,
        board=board,
    )


def check_corners(corners: Sequence[tuple[float, float]], image_shape: tuple[int, int]) -> None:
    """Raises BadCorners."""
    points = np.array(corners, dtype=np.float64)
    if points.shape != (4, 2) or not np.isfinite(points).all():
        raise BadCorners(f"corners must be 4 finite pixels (u, v), got {corners!r}")
    edge = np.roll(points, -1, axis=0) - points
    turn = edge[:, 0] * np.roll(edge[:, 1], -1) - edge[:, 1] * np.roll(edge[:, 0], -1)
    if not (turn > 1.0).all():  # v grows downwards: clockwise as seen is positive
        raise BadCorners(
            f"corners {corners!r} are no convex quadrangle; give top left, top right, bottom right, bottom left "
            "[px, u to the right, v down]"
        )
    rows, columns = image_shape
    if (np.abs(points - (columns / 2, rows / 2)) > (columns, rows)).any():
        raise BadCorners(f"corners {corners!r} lie far outside the image of {columns} x {rows} px")


def view_of_corners(corners: Sequence[Pair], size: Pair, image_shape: tuple[int, int]) -> GelView:
    """The view of a gel of `size` (x, y) [m] by its corners in the picture: top left, top right, bottom right, bottom
    left [px]. There is no residual to check them. Raises BadCorners."""
    check_corners(corners, image_shape)
    lens = pinhole_lens(image_shape)
    x, y = size[0] / 2, size[1] / 2
    perspective = _fit_homography(
        lens, np.array([(-x, -y), (x, -y), (x, y), (-x, y)]), np.array(corners, dtype=np.float64)
    )
    perspective /= perspective[2, 2]
    middle = lens.project(ray_slopes(perspective, 1e-6 * np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])))
    along = np.linalg.norm(middle[1:] - middle[0], axis=1)  # [px / um]
    return GelView(
        lens=lens,
        perspective=tuple(tuple(float(value) for value in row) for row in perspective),
        size=size,
        pixel_pitch=1e-6 / float(np.sqrt(along[0] * along[1])),
        board="four corners",
    )


def calibrated_view(view: GelView | None, pitch: float, image_shape: tuple[int, int]) -> tuple[GelView | None, float]:
    """The view for the calibration of pictures of `image_shape` (rows, columns), and its pixel pitch [m]: the given
    ones, or coarser ones for a camera with a finer resolution than the canonical grid. Then a metric picture (no view,
    `pitch` [m]) gets a view, which keeps the size of native pictures."""
    max_pixels = 160_000
    # A light is calibrated at no finer pixels than these: four a cell of the canonical grid, and this number in total
    # [m]
    finest_pitch = 0.25e-3 / 4
    rows, columns = image_shape
    size = (columns * pitch, rows * pitch) if view is None else view.size
    needed = max(finest_pitch, math.sqrt(size[0] * size[1] / max_pixels))
    if needed < MIN_REDUCTION * pitch:
        return view, pitch
    if view is None:
        left, top, right, bottom = -0.5, -0.5, columns - 0.5, rows - 0.5
        view = view_of_corners(((left, top), (right, top), (right, bottom), (left, bottom)), size, image_shape)
    coarse = size[0] / round(size[0] / needed)
    return view.model_copy(update={"pixel_pitch": coarse}), coarse


def _fit_homography(lens: Lens, on_board: FloatArray, pixels: FloatArray) -> FloatArray:
    """(3, 3) perspective from points (n, 2) [m] to lines of sight."""
    import cv2

    # in units of the board's own size, for the solver's sake
    unit = float(np.abs(on_board).max())
    found, _ = cv2.findHomography(on_board / unit, lens.directions(pixels), 0)
    if found is None:
        raise BadView("the points determine no plane; they lie on a line")
    perspective: FloatArray = np.asarray(found, dtype=np.float64) @ np.diag([1 / unit, 1 / unit, 1.0])
    return perspective


def _fit_distortion(on_board: FloatArray, pixels: FloatArray, image_shape: tuple[int, int]) -> tuple[Lens, FloatArray]:
    """Lens and perspective with as many terms of distortion (k1, k2, its centre) as predict left-out points best."""
    unit = float(np.abs(on_board).max())
    scale = np.diag([unit, unit, 1.0])
    best: tuple[float, Lens, FloatArray] | None = None
    first = _fit_homography(pinhole_lens(image_shape), on_board, pixels) @ scale
    start = np.append((first / first[2, 2]).ravel()[:8], (0.0, 0.0, 0.0, 0.0))
    for terms in (0, 1, 2, 4):
        if 8 + terms > len(pixels):
            break

        def lens_and_plane(p: FloatArray) -> tuple[Lens, FloatArray]:
            return pinhole_lens(image_shape, p[8:].tolist()), np.append(p[:8], 1.0).reshape(3, 3) @ np.linalg.inv(scale)

        def missed(p: FloatArray) -> FloatArray:
            lens, plane = lens_and_plane(p)
            off: FloatArray = (lens.project(ray_slopes(plane, on_board)) - pixels).ravel()
            return off

        from scipy.optimize import least_squares

        fit = least_squares(missed, start[: 8 + terms], x_scale="jac", method="lm")
        # left-out residuals of a linear fit (Allen's PRESS): r / (1 - leverage)
        leverage = (np.linalg.qr(np.asarray(fit.jac))[0] ** 2).sum(axis=1)
        left_out = float(np.sqrt(((fit.fun / np.maximum(1e-6, 1 - leverage)) ** 2).mean()))
        start[: 8 + terms] = fit.x
        if best is None or left_out < 0.97 * best[0]:
            best = (left_out, *lens_and_plane(fit.x))
    assert best is not None
    return best[1], best[2]
