"""`tacsim calibrate lens`: a camera's lens, or the position of the gel in its image, from pictures of a board."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from robot.cli.calibrate.session import guided_session, image_writer, named_camera
from robot.cli.options import Out, Overrides, quantities_parser
from robot.cli.output import busy, new_directory, print_files, print_json, progress, results, show_table, writing

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from calibration.lens.board import Board, Points
    from calibration.lens.view import GelView, Lens

PICTURES = 200  # at most


def lens(
    frames: Annotated[
        Path | None,
        typer.Argument(help="A folder of pictures of a board: the lens. One picture of it on the gel: the view."),
    ] = None,
    board: Annotated[
        str | None,
        typer.Option(help="dots:COLUMNSxROWS:PITCH or charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY]."),
    ] = None,
    corners: Annotated[
        str | None,
        typer.Option(help="Instead of a board: u,v of the gel's corners, clockwise from the top left \\[px]."),
    ] = None,
    reference: Annotated[
        Path | None, typer.Option(help="The same picture without the board, where contrast is low.")
    ] = None,
    lens_file: Annotated[
        Path | None, typer.Option("--lens", help="lens.yaml of the same camera; without it distortion is fitted, too.")
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(metavar="RIG/SENSOR", help="Take the pictures now, with this camera of a rig; no arm moves."),
    ] = None,
    views: Annotated[
        int,
        typer.Option(
            min=1, max=PICTURES, help="Number, with --camera; 1: the board lies on the gel, which gives the view."
        ),
    ] = 12,
    centre: Annotated[str | None, typer.Option(help="u,v of the sensor's axis \\[px]; default: the middle.")] = None,
    size: Annotated[
        Any,
        typer.Option(parser=quantities_parser("length", 2), metavar="LENGTH,LENGTH", help="Width, height of the gel."),
    ] = None,
    set_: Overrides = None,
    out: Out = None,
) -> None:
    """Calibrate a camera's lens, or its view of a gel, from pictures of a board.

    A folder of pictures, with the board tilted to all sides, gives lens.yaml: focal lengths, centre, distortion. One
    picture of a board that lies on the gel gives view.yaml and rectified.png: where each point of the gel is seen, for
    `tacsim calibrate sensor --view`.

    With --camera the command guides you: it takes each picture once the board is found and does not move. The pictures
    are stored in frames/ next to the result; Ctrl-C keeps the pictures taken so far.

    Example: tacsim calibrate lens board.png --board "dots:9x7:2.5 mm" --reference empty.png
    """
    if (frames is None) == (camera is None):
        raise typer.BadParameter("give either pictures, or --camera to take them now")
    from calibration.lens.board import parse_board
    from calibration.lens.view import Lens
    from tacsim.config import load_model

    folder = new_directory(out, "lens")
    known = None if lens_file is None else load_model(Lens, lens_file)
    if (board is None) == (corners is None):
        raise typer.BadParameter("give either --board or --corners")
    if corners is not None:
        if frames is None:
            raise typer.BadParameter(
                "corners are positions in a picture: give the picture, or a --board", param_hint="--corners"
            )
        _view_from_corners(frames, _parse_numbers(corners, 8, "--corners"), size, folder)
        return
    assert board is not None
    described = parse_board(board)
    if camera is not None:
        frames = _take_views(camera, set_ or [], folder, described, views, reference)
    assert frames is not None
    if frames.is_dir():
        _fit_lens(frames, described, folder)
        return
    axis = None if centre is None else _parse_numbers(centre, 2, "--centre")
    _fit_view(frames, described, reference, known, None if axis is None else (axis[0], axis[1]), size, folder)


def _take_views(
    camera: str, overrides: list[str], folder: Path, board: Board, views: int, reference: Path | None
) -> Path:
    """Takes pictures now; returns their folder, or the path of a single one. A signal ends the command; pictures that
    were taken stay. Raises CannotCalibrate, DeviceError."""
    from calibration.lens.view import MIN_PICTURES
    from robot.camera.camera import Camera
    from robot.procedures.boards import BoardViewPlan, record_board_views
    from robot.procedures.session import CannotCalibrate

    if 1 < views < MIN_PICTURES:
        raise typer.BadParameter(
            f"{views}: a lens needs {MIN_PICTURES} views, 12 are good; the board on the gel needs 1",
            param_hint="--views",
        )
    config, sensor = named_camera(camera, overrides)
    empty = None if reference is None else _read_picture(reference)
    if empty is not None and empty.shape[:2] != (config.height, config.width):
        raise typer.BadParameter(
            f"it is {empty.shape[1]} x {empty.shape[0]} px, the camera's pictures are {config.width} x {config.height}",
            param_hint="--reference",
        )
    plan = BoardViewPlan(board, views, on_gel=views == 1, reference=empty)
    frames = folder / "frames"
    with (
        Camera(config, sensor) as source,
        guided_session("views", views, frames, f"pictures stored in {frames}") as session,
    ):
        session.store = image_writer(frames)
        record_board_views(source, plan, session)
    if len(session.measurements) < views:
        raise CannotCalibrate(f"the source ended after {len(session.measurements)} of {views} views")
    return frames / session.measurements[0][0] if plan.on_gel else frames


def _fit_lens(pictures: Path, board: Board, folder: Path) -> None:
    from calibration.lens.board import BadBoard, find_board
    from calibration.lens.view import BadView, fit_lens
    from tacsim.record.sources import PICTURES as ENDINGS
    from tacsim.record.sources import visible_files

    paths = visible_files(pictures, ENDINGS)
    if not 0 < len(paths) <= PICTURES:
        raise BadView(f"{pictures} holds {len(paths)} pictures ({', '.join(ENDINGS)}); 1 to {PICTURES} are read")
    found: dict[str, Points] = {}
    missing: list[str] = []
    sizes: dict[tuple[int, ...], str] = {}
    with progress() as bar:
        for path in bar.track(paths, description="searching for the board"):
            image = _read_picture(path)
            sizes.setdefault(image.shape[:2], path.name)
            try:
                found[path.name] = find_board(image, board)
            except BadBoard as error:
                missing.append(f"{path.name}: {error}")
    if len(sizes) > 1:
        described_sizes = ", ".join(f"{name} is {shape[1]} x {shape[0]} px" for shape, name in sizes.items())
        raise BadView(f"the pictures differ in size ({described_sizes}); take all at one setting of the camera")
    if not found:
        raise BadBoard("\n".join(missing[:5]))
    rows, columns = next(iter(sizes))
    with busy(f"fitting {len(found)} pictures"):
        lens_, each = fit_lens(found, (rows, columns))
    show_table("Each picture", ("picture", "residual [px]"), [(name, f"{value:.2f}") for name, value in each.items()])
    for line in missing:
        results.print(f"left out: {line}")
    results.print(
        f"focal length {lens_.focal[0]:.1f}, {lens_.focal[1]:.1f} px; centre {lens_.centre[0]:.1f}, "
        f"{lens_.centre[1]:.1f} px; residual {lens_.residual:.2f} px"
    )
    with writing(folder):
        path = _write_yaml(folder / "lens.yaml", lens_)
    print_files(path)
    print_json({**lens_.model_dump(mode="json"), "residuals": each, "left_out": missing}, [path])


def _fit_view(
    picture: Path,
    board: Board,
    reference: Path | None,
    known: Lens | None,
    centre: tuple[float, float] | None,
    size: tuple[float, float] | None,
    folder: Path,
) -> None:
    from calibration.lens.board import find_board
    from calibration.lens.view import fit_view

    image = _read_picture(picture)
    with busy("searching for the board"):
        points = find_board(image, board, None if reference is None else _read_picture(reference))
        view = fit_view(points, image.shape[:2], known, centre, size, str(board))
    _report_view(view, image, folder)


def _view_from_corners(picture: Path, numbers: list[float], size: tuple[float, float] | None, folder: Path) -> None:
    from calibration.lens.view import view_of_corners

    if size is None:
        raise typer.BadParameter("with --corners, give the gel's --size between them, such as '18.6 mm, 14.3 mm'")
    image = _read_picture(picture)
    pairs = [(numbers[i], numbers[i + 1]) for i in range(0, 8, 2)]
    view = view_of_corners((pairs[0], pairs[1], pairs[2], pairs[3]), size, image.shape[:2])
    _report_view(view, image, folder)


def _report_view(view: GelView, image: NDArray[np.uint8], folder: Path) -> None:
    import numpy as np

    from calibration.lens.rectification import metric_rectification
    from tacsim.record.images import encode_png

    geometry = view.geometry
    results.print(
        f"residual {view.residual:.2f} px, {1e3 * view.residual_length:.3f} mm; {1e3 * view.pixel_pitch:.4f} mm a "
        f"pixel on the sensor's axis; the gel, {1e3 * view.size[0]:.2f} x {1e3 * view.size[1]:.2f} mm, becomes "
        f"{geometry.width} x {geometry.height} px"
    )
    with writing(folder):
        (folder / "rectified.png").write_bytes(encode_png(np.rint(metric_rectification(view)(image)).astype(np.uint8)))
        written = [_write_yaml(folder / "view.yaml", view), folder / "rectified.png"]
    print_files(*written)
    print_json(view.model_dump(mode="json"), written)


def _read_picture(path: Path) -> NDArray[np.uint8]:
    """Raises CalibrationError."""
    from calibration.errors import CalibrationError
    from tacsim.record.episode import EpisodeError
    from tacsim.record.images import read_image

    try:
        return read_image(path)
    except EpisodeError as error:
        raise CalibrationError(str(error)) from None


def _write_yaml(path: Path, config: Lens | GelView) -> Path:
    import yaml

    text = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False, default_flow_style=None, width=120)
    path.write_text(text, encoding="utf-8")
    return path


def _parse_numbers(text: str, count: int, option: str) -> list[float]:
    try:
        values = [float(part) for part in text.replace(" ", ",").split(",") if part]
    except ValueError:
        values = []
    if len(values) != count:
        raise typer.BadParameter(f"'{text}'; {count} numbers are needed, separated by commas", param_hint=option)
    return values
