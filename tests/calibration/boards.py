"""Made-up pictures of boards through a camera whose lens and place only the test knows."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from calibration.lens.board import Board, parse_board
from calibration.lens.view import Lens
from tacsim import pose as se3
from tacsim.interface import Pose

LENS = Lens(
    width=640, height=480, focal=(610.0, 604.0), centre=(331.0, 228.0), distortion=(-0.21, 0.06, 0.001, -0.0008, 0.0)
)
DOTS = parse_board("dots:9x7:2.5 mm")
CHARUCO = parse_board("charuco:9x7:3 mm:2.2 mm:DICT_4X4_50")
Paint = Callable[[np.ndarray], np.ndarray]


def painted(board: Board) -> Paint:
    """Brightness 0 to 1 at points (n, 2) of the board's plane [m]."""
    if board.kind == "dots":

        def dots(points: np.ndarray) -> np.ndarray:
            nearest = np.clip(np.rint(points / board.pitch), 0, (board.columns - 1, board.rows - 1))
            apart = np.linalg.norm(points - nearest * board.pitch, axis=1)
            return 0.75 - 0.5 / (1 + np.exp((apart - 0.2 * board.pitch) / (0.03 * board.pitch)))

        return dots
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    printed = cv2.aruco.CharucoBoard((board.columns, board.rows), board.pitch, board.marker, dictionary)
    fine = 60  # pixels of a square
    sheet = printed.generateImage((board.columns * fine, board.rows * fine)).astype(np.float32) / 255.0

    def squares(points: np.ndarray) -> np.ndarray:
        at = (points / board.pitch * fine - 0.5)[:, ::-1].T
        return 0.1 + 0.75 * map_coordinates(sheet, at, order=1, cval=0.9)

    return squares


@lru_cache(maxsize=4)
def _sights(lens: Lens) -> np.ndarray:
    """(4 H W, 2) four lines of sight in each pixel."""
    quarter = (np.arange(2) - 0.5) / 2
    u, v = (np.add.outer(np.arange(count), quarter).ravel() for count in (lens.width, lens.height))
    return lens.directions(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))


def photograph(
    board: Board, camera_from_board: Pose, lens: Lens = LENS, noise: float = 2.0, seed: int = 0
) -> np.ndarray:
    """(H, W, 3) picture; each pixel is the mean of 2 x 2 lines of sight."""
    paint, height, width = painted(board), lens.height, lens.width
    sight = _sights(lens)
    back = se3.inverse(camera_from_board)
    lines = se3.rotate(back, np.pad(sight, ((0, 0), (0, 1)), constant_values=1.0))
    on_plane = back.position[:2] - back.position[2] * lines[:, :2] / lines[:, 2:]
    bright = paint(on_plane).reshape(height, 2, width, 2).mean(axis=(1, 3))
    grey = 255.0 * bright + np.random.default_rng(seed).normal(0.0, noise, bright.shape)
    return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def facing(board: Board, turn: object, distance: float, aside: tuple[float, float] = (0.0, 0.0)) -> Pose:
    """camera_from_board of a board whose middle is at `aside`, `distance` [m], turned by a rotation vector."""
    rotation = Rotation.from_rotvec(np.array(turn, dtype=np.float64))
    reach = (board.columns - 1, board.rows - 1) if board.kind == "dots" else (board.columns, board.rows)
    middle = np.array([*(np.array(reach) * board.pitch / 2), 0.0])
    return Pose(np.array([*aside, distance]) - rotation.apply(middle), rotation.as_quat())


def tilted(board: Board, number: int = 10, tilt: float = 0.5) -> list[Pose]:
    """Poses that fill the picture, tilted to all sides."""
    found = []
    for i in range(number):
        angle = 2.4 * i
        turn = tilt * np.array([np.cos(angle), np.sin(angle), 0.0]) + (0.0, 0.0, 0.1 * np.cos(3 * angle))
        found.append(facing(board, turn, 0.036 + 0.001 * (i % 3), (2e-3 * np.cos(2 * angle), 1.5e-3 * np.sin(angle))))
    return found
