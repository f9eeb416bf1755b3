"""Boards in pictures, lenses and views of a gel from them, against hidden truth."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.lens.board import BadBoard, Board, find_board, parse_board
from calibration.lens.rectification import metric_rectification, rectification_of_corners, rectification_of_view
from calibration.lens.view import BadCorners, BadView, Lens, board_pose, fit_lens, fit_view, view_of_corners
from tacsim import pose as se3
from tacsim.models.sensor import CanonicalGrid
from tacsim.optics.grid import canonical_image
from tests.calibration.boards import CHARUCO, DOTS, LENS, facing, photograph, tilted

SHAPE = (LENS.height, LENS.width)
BOTH = pytest.mark.parametrize("board", [DOTS, CHARUCO], ids=["dots", "charuco"])


def true_pixels(board: Board, pose: object, points: np.ndarray, lens: Lens = LENS) -> np.ndarray:
    seen = se3.transform(pose, np.pad(points, ((0, 0), (0, 1))))  # type: ignore[arg-type]
    return lens.project(seen[:, :2] / seen[:, 2:])


@BOTH
def test_points_are_found_to_a_tenth_of_a_pixel(board: Board) -> None:
    pose = facing(board, [0.15, -0.1, 0.05], 0.034)
    found = find_board(photograph(board, pose), board)
    assert len(found.board) == (63 if board.kind == "dots" else 48)
    true = true_pixels(board, pose, found.board)
    off = np.linalg.norm(found.image - true, axis=1)
    assert off.mean() < 0.15 and off.max() < 0.5


def test_low_contrast_is_helped_by_a_picture_without_the_board() -> None:
    pose = facing(DOTS, [0.0, 0.0, 0.0], 0.034)
    shade = np.random.default_rng(0).normal(0.0, 40.0, (6, 8))
    rows, columns = np.linspace(0, 5, SHAPE[0]), np.linspace(0, 7, SHAPE[1])
    smooth = np.stack([np.interp(columns, np.arange(8), row) for row in shade])
    smooth = np.stack([np.interp(rows, np.arange(6), column) for column in smooth.T], axis=1)
    without = np.clip(120 + smooth, 0, 255)[..., None].repeat(3, axis=2)
    faint = without + 0.08 * (photograph(DOTS, pose).astype(float) - 191.0)
    picture, reference = (np.clip(np.rint(each), 0, 255).astype(np.uint8) for each in (faint, without))
    found = find_board(picture, DOTS, reference)
    assert np.linalg.norm(found.image - true_pixels(DOTS, pose, found.board), axis=1).mean() < 0.5
    with pytest.raises(BadBoard, match="they must be of one camera"):
        find_board(picture, DOTS, reference[:240])


@pytest.mark.slow
@BOTH
def test_a_lens_is_found_from_tilted_pictures(board: Board) -> None:
    points = {f"{i}.png": find_board(photograph(board, pose, seed=i), board) for i, pose in enumerate(tilted(board))}
    lens, each = fit_lens(points, SHAPE)
    assert lens.residual < 0.3 and set(each) == set(points)
    np.testing.assert_allclose(lens.focal, LENS.focal, rtol=0.01)
    np.testing.assert_allclose(lens.centre, LENS.centre, atol=5.0)
    grid = np.stack(np.meshgrid(np.linspace(60, 580, 9), np.linspace(50, 430, 7)), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(lens.project(lens.directions(grid)), grid, atol=1e-6)
    off = lens.project(LENS.directions(grid)) - grid  # focal length and board's distance may trade a little
    assert np.linalg.norm(off, axis=1).max() < 5.0
    # a pose through the lens that was found
    pose = facing(board, [0.3, -0.2, 0.1], 0.036)
    found, residual = board_pose(lens, find_board(photograph(board, pose, seed=99), board))
    metres, radians = se3.pose_distance(found, pose)
    assert residual < 0.4 and metres < 0.6e-3 and np.degrees(radians) < 0.6


@pytest.mark.slow
def test_pictures_that_tell_no_lens_are_refused() -> None:
    points = {f"{i}": find_board(photograph(DOTS, pose, seed=i), DOTS) for i, pose in enumerate(tilted(DOTS, 6))}
    with pytest.raises(BadView, match=r"1 picture\(s\) of a board are too few"):
        fit_lens({"one": points["0"]}, SHAPE)
    flat = {f"{i}": find_board(photograph(DOTS, facing(DOTS, [0, 0, 0.1 * i], 0.036), seed=i), DOTS) for i in range(6)}
    with pytest.raises(BadView, match="tilt the board more"):
        fit_lens(flat, SHAPE)
    wrong = {name: type(each)(each.board**1.3, each.image, each.spacing) for name, each in points.items()}
    with pytest.raises(BadView, match="do not fit one lens and one flat board"):
        fit_lens(wrong, SHAPE)


@BOTH
@pytest.mark.parametrize("known", [True, False])
def test_the_view_of_the_plane_is_metric(board: Board, known: bool) -> None:
    pose = facing(board, [0.2, -0.12, 0.1], 0.032)
    view = fit_view(find_board(photograph(board, pose), board), SHAPE, LENS if known else None, board=str(board))
    assert view.residual < 0.5 and view.residual_length < 0.03e-3
    assert view.pixel_pitch == pytest.approx(0.032 / 610, rel=0.1)
    # a metric step on the gel is one on the board: compare distances of pixels that the truth gives
    grid = np.stack(np.meshgrid(np.linspace(-6e-3, 6e-3, 7), np.linspace(-5e-3, 5e-3, 5)), axis=-1).reshape(-1, 2)
    pixels = view.project(grid)
    back = se3.inverse(pose)
    lines = se3.rotate(back, np.pad(LENS.directions(pixels), ((0, 0), (0, 1)), constant_values=1.0))
    on_board = back.position[:2] - back.position[2] * lines[:, :2] / lines[:, 2:]
    moved = on_board - on_board.mean(axis=0)
    turn = np.arctan2(moved[6, 1] - moved[0, 1], moved[6, 0] - moved[0, 0])
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    off = moved @ rotation - (grid - grid.mean(axis=0))
    assert np.linalg.norm(off, axis=1).max() < 0.06e-3
    # the axis goes through the middle of the picture, x along its columns
    np.testing.assert_allclose(view.project(np.zeros((1, 2)))[0], [319.5, 239.5], atol=0.01)
    step = view.project(np.array([[1e-5, 0.0]]))[0] - (319.5, 239.5)
    assert step[0] > 0 and abs(step[1] / step[0]) < 1e-3


@pytest.mark.slow
def test_the_rectified_picture_shows_even_dots() -> None:
    pose = facing(DOTS, [0.2, -0.12, 0.1], 0.032)
    picture = photograph(DOTS, pose)
    view = fit_view(find_board(picture, DOTS), SHAPE, size=(25e-3, 20e-3))  # all dots
    rectify = metric_rectification(view)
    assert rectify.valid.shape == (view.geometry.height, view.geometry.width)
    even = np.rint(rectify(picture)).astype(np.uint8)
    found = find_board(even, DOTS).image.reshape(7, 9, 2) * view.pixel_pitch
    for axis in (0, 1):
        np.testing.assert_allclose(np.linalg.norm(np.diff(found, axis=axis), axis=-1), 2.5e-3, rtol=0.015)
    canonical = rectification_of_view(view, canonical_image(CanonicalGrid()))
    assert canonical(picture).shape == (128, 128, 3) and canonical.valid[40:88, 20:108].all()


@pytest.mark.slow
def test_distortion_is_fitted_only_where_it_pays() -> None:
    plain = Lens(width=640, height=480, focal=(600.0, 600.0), centre=(319.5, 239.5))
    pose = facing(DOTS, [0.2, -0.12, 0.1], 0.032)
    straight = fit_view(find_board(photograph(DOTS, pose, plain), DOTS), SHAPE)
    assert abs(straight.lens.distortion[0]) < 0.02
    bent = fit_view(find_board(photograph(DOTS, pose), DOTS), SHAPE)
    assert bent.lens.distortion[0] < -0.1


@pytest.mark.slow
def test_a_wrong_board_is_refused() -> None:
    picture = photograph(DOTS, facing(DOTS, [0.1, 0.0, 0.0], 0.032))
    for board, words in (
        ("dots:8x7:2.5 mm", "more dots than 8 x 7"),
        ("dots:9x6:2.5 mm", "more dots than 9 x 6"),
        ("dots:10x7:2.5 mm", "is not found; 63 dots are seen, 70 should be"),
        ("charuco:9x7:3 mm:2.2 mm", "0 of its corners and 0 markers are seen"),
    ):
        with pytest.raises(BadBoard, match=words):
            find_board(picture, parse_board(board))
    with pytest.raises(BadBoard, match="is not found; 0 dots"):
        find_board(np.full((480, 640, 3), 128, np.uint8), DOTS)
    charuco = photograph(CHARUCO, facing(CHARUCO, [0.0, 0.1, 0.0], 0.034))
    with pytest.raises(BadBoard, match="is not found"):
        find_board(charuco, parse_board("charuco:9x7:3 mm:2.2 mm:DICT_6X6_250"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("dots", "is no board"),
        ("dots:9x7", "is no board"),
        ("dots:9x7:2.5 mm:1 mm", "is no board"),
        ("stars:9x7:2.5 mm", "is no board"),
        ("dots:2x7:2.5 mm", "allowed: 3 to 100"),
        ("dots:9x7:fast", "fast"),
        ("dots:9x7:2.5 km", "2.5 km"),
        ("charuco:9x7:2 mm:3 mm", "a marker inside its square"),
        ("charuco:9x7:3 mm:2 mm:DICT_NONE", "is no dictionary of markers; allowed: .*DICT_4X4_50"),
        ("charuco:20x20:3 mm:2 mm:DICT_4X4_50", "has 50 markers"),
    ],
)
def test_a_board_that_makes_no_sense_is_refused(text: str, words: str) -> None:
    with pytest.raises(BadBoard, match=words):
        parse_board(text)


def test_points_on_no_plane_and_another_camera_are_refused() -> None:
    points = find_board(photograph(DOTS, facing(DOTS, [0.2, 0.0, 0.0], 0.032)), DOTS)
    shuffled = type(points)(points.board[np.random.default_rng(0).permutation(63)], points.image, points.spacing)
    with pytest.raises(BadView, match="lie on no plane"):
        fit_view(shuffled, SHAPE)
    with pytest.raises(BadView, match="the picture is 320 x 240 px, the lens was calibrated at 640 x 480 px"):
        fit_view(points, (240, 320), LENS)
    with pytest.raises(BadView, match="axis lies off the board"):
        fit_view(points, SHAPE, centre=(5.0, 5.0))


def test_corners_and_their_view_agree() -> None:
    corners = ((67.0, 68.0), (465.0, 113.0), (475.0, 383.0), (73.0, 437.0))
    grid = canonical_image(CanonicalGrid())
    view = view_of_corners(corners, (16e-3, 16e-3), SHAPE)
    by_corners, by_view = (
        rectification_of_corners(corners, (16e-3, 16e-3), SHAPE, grid),
        rectification_of_view(view, grid),
    )
    np.testing.assert_allclose(by_view.pixels, by_corners.pixels, atol=0.01)
    with pytest.raises(BadCorners, match="no convex quadrangle"):
        view_of_corners(corners[::-1], (16e-3, 16e-3), SHAPE)
