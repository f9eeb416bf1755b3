"""`tacsim calibrate touch`, `hand-eye`, `latency`: poses of sensors and cameras on an arm, latency of images."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from robot.cli.calibrate.session import confirm_motion, guided_session
from robot.cli.options import (
    HardwareRig,
    OptionGroup,
    Out,
    Overrides,
    angle_option,
    complete_names,
    length_option,
    with_option_groups,
)
from robot.cli.output import busy, new_directory, notes, print_files, print_json, results, show_table, writing
from robot.cli.terminal import Interrupt, ask_operator, print_error, require_operator

if TYPE_CHECKING:
    from calibration.poses.ball_touch import TouchNoise
    from calibration.poses.records import BoardPoseFile, TouchFile
    from robot.procedures.ball_touches import BallTouchPlan
    from robot.procedures.boards import BoardPosePlan
    from robot.procedures.session import Session
    from tacsim.interface import Pose

Rig = Annotated[
    str | None,
    typer.Option(
        "--rig",
        help="A rig of hardware, or the path of its file: measure now, with its arm.",
        autocompletion=complete_names("rig"),
    ),
]


class TouchMotion(OptionGroup):
    """Options of the motion from touch to touch."""

    number: Annotated[int, typer.Option("--touches", min=6, max=200, help="Number; more reduce the uncertainty.")] = 24
    tilt: Annotated[Any, angle_option("Largest tilt of the sensor.", 0.15, 0.8)] = "25 deg"
    spread: Annotated[Any, length_option("Distance of contacts from the middle of the gel.", 0.5e-3, 20e-3)] = "3 mm"
    depth: Annotated[Any, length_option("Depth of the ball in the gel.", 0.05e-3, 2e-3)] = "0.4 mm"
    lift: Annotated[Any, length_option("Retreat along the sensor's axis between touches.", 2e-3, 50e-3)] = "6 mm"


class TouchErrors(OptionGroup):
    """Standard deviations of the measurements."""

    noise_centre: Annotated[
        Any, length_option("Standard deviation of the contact's centre, each axis.", 1e-6, 1e-2)
    ] = "0.03 mm"
    noise_depth: Annotated[Any, length_option("Standard deviation of the depth.", 1e-6, 1e-2)] = "0.05 mm"
    noise_robot: Annotated[Any, length_option("Standard deviation of the arm's position, each axis.", 0.0, 1e-2)] = (
        "0.05 mm"
    )


@with_option_groups
def touch(
    touches: Annotated[Path | None, typer.Argument(help="File of recorded touches (YAML); or give --rig.")] = None,
    *,
    rig: Rig = None,
    arm: Annotated[str, typer.Option("--arm", help="The arm that touches; with --rig.")] = "",
    sensor: Annotated[str, typer.Option("--sensor", help="The sensor that it carries; with --rig.")] = "",
    ball_radius: Annotated[Any, length_option("Of the ball; with --rig.", 0.5e-3, 50e-3)] = None,
    motion: TouchMotion,
    errors: TouchErrors,
    set_: Overrides = None,
    out: Out = None,
) -> None:
    """Find the pose of a sensor on its arm (tool_from_sensor), from touches of one fixed ball with many tilts.

    With --rig the arm MOVES: to its start, which must be vertically above the ball, then repeatedly down to the ball,
    tilted about it. The ball must be fixed and free, so that the tilted sensor touches nothing else; the command asks
    for a confirmation first. tool_from_sensor of the rig file is the initial value; its error may be a few millimetres
    and degrees.

    Example: tacsim calibrate touch --rig ur5e --arm upper --sensor upper --ball-radius "4 mm"
    """
    from calibration.poses.ball_touch import TouchNoise
    from calibration.poses.records import read_touches

    noise = TouchNoise(errors.noise_centre, errors.noise_depth, errors.noise_robot)
    _require_one_source(touches, rig)
    folder = new_directory(out, "touch")
    if touches is not None:
        _report_touch(read_touches(touches), noise, folder, arm or "ARM")
        return
    from robot.procedures.ball_touches import BallTouchPlan

    assert rig is not None
    if not (arm and sensor and ball_radius):
        raise typer.BadParameter("with --rig, give --arm, --sensor and --ball-radius")
    plan = BallTouchPlan(ball_radius, motion.number, motion.tilt, motion.spread, motion.depth, motion.lift)
    _report_touch(_take_touches(rig, arm, sensor, plan, set_ or [], folder), noise, folder, arm)


def _take_touches(
    rig: str, arm: str, sensor: str, plan: BallTouchPlan, overrides: list[str], folder: Path
) -> TouchFile:
    """Touches the ball now; all recorded touches stay in `folder`, also after an error."""
    from calibration.poses.records import touch_file
    from robot.open import open_rig
    from robot.procedures.ball_touches import record_ball_touches, without_task
    from tacsim.config import load_rig

    config = load_rig(rig, overrides=overrides).config
    opened = without_task(config, arm, sensor)
    confirm_motion(config, f"Is the ball fixed and free below the start of arm '{arm}', and may the arm move?")
    with (
        _recorded_session(folder / "touches.yaml", "touch", "touches", plan.touches) as (session, write),
        open_rig(opened, confirm=lambda question: True) as running,
    ):
        session.store = lambda _: write(touch_file(session.measurements, plan.ball_radius))
        record_ball_touches(running, opened, arm, sensor, plan, session)
    return touch_file(session.measurements, plan.ball_radius)


@contextmanager
def _recorded_session(
    path: Path, command: str, what: str, total: int
) -> Iterator[tuple[Session[Any], Callable[[TouchFile | BoardPoseFile], None]]]:
    """A session, and a function that writes each state of its record to `path`."""
    from calibration.poses.records import write_record

    def write(record: TouchFile | BoardPoseFile) -> None:
        with writing(path.parent):
            write_record(path, record)

    again = f"tacsim calibrate {command} {shlex.quote(str(path))}"
    with guided_session(
        what, total, path, f"recorded: {path}; to calibrate from it again, without the arm: {again}"
    ) as session:
        yield session, write
    for why in session.left_out:
        notes.print(f"left out: {why}")


def _report_touch(record: TouchFile, noise: TouchNoise, folder: Path, arm: str) -> None:
    from calibration.poses.ball_touch import fit_touches
    from calibration.poses.records import pose_as_json

    with busy(f"fitting {len(record.touches)} touches"):
        fit = fit_touches(record.measurements(), record.ball_radius, noise)
    _show_fit(
        "Error of the ball's position by each touch, along the sensor's axes",
        ("touch", "x [mm]", "y [mm]", "z [mm]"),
        [(str(i + 1), *(f"{1e3 * v:.3f}" for v in miss)) for i, miss in enumerate(fit.residuals)],
        fit.used,
    )
    (place, turn), (best, best_turn) = fit.deviation, fit.best_deviation
    results.print(
        f"tool_from_sensor: ± {1e3 * place:.3f} mm, ± {math.degrees(turn):.3f} deg (at best, by Cramer and Rao, "
        f"{1e3 * best:.3f} mm, {math.degrees(best_turn):.3f} deg); scatter {fit.scatter:.2f} of what the noise allows"
    )
    results.print("Write into the rig file:")
    results.print(f"  arms:\n    {arm}:\n      tool_from_sensor: {_placement_text(fit.tool_from_sensor)}")
    report = {
        "tool_from_sensor": pose_as_json(fit.tool_from_sensor, fit.covariance),
        "bound": fit.bound.tolist(),
        "ball": fit.ball.tolist(),
        "ball_radius": record.ball_radius,
        "residuals": fit.residuals.tolist(),
        "used": list(fit.used),
        "scatter": fit.scatter,
        "units": "m, rad",
    }
    _write_report(folder, "touch.json", report)


class ViewMotion(OptionGroup):
    """Options of the motion from pose to pose."""

    number: Annotated[int, typer.Option("--poses", min=6, max=200, help="Number; more reduce the uncertainty.")] = 20
    tilt: Annotated[Any, angle_option("Largest tilt about each axis.", 0.1, 1.0)] = "30 deg"
    pivot: Annotated[Any, length_option("Distance from the sensor to the point about which it rotates.", 0.0, 2.0)] = (
        "0 mm"
    )


class BoardErrors(OptionGroup):
    """Standard deviations of the measurements."""

    noise_board: Annotated[Any, length_option("Standard deviation of the board's place, each axis.", 1e-6, 0.1)] = (
        "0.5 mm"
    )
    noise_turn: Annotated[Any, angle_option("The same of its direction.", 1e-6, math.radians(20.0))] = "0.15 deg"


@with_option_groups
def hand_eye(
    poses: Annotated[
        Path | None, typer.Argument(help="File of recorded poses of flange and board (YAML); or give --rig.")
    ] = None,
    *,
    rig: Rig = None,
    arm: Annotated[str, typer.Option("--arm", help="The arm that moves; with --rig.")] = "",
    camera: Annotated[str, typer.Option(help="Its source, as in a rig file; with --rig.")] = "",
    lens: Annotated[Path | None, typer.Option(help="lens.yaml of `tacsim calibrate lens`; with --rig.")] = None,
    board: Annotated[str, typer.Option(help="charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY]; with --rig.")] = "",
    fixed: Annotated[
        bool, typer.Option("--fixed", help="The camera is fixed, the board is on the arm; with --rig.")
    ] = False,
    motion: ViewMotion,
    errors: BoardErrors,
    set_: Overrides = None,
    out: Out = None,
) -> None:
    """Find the pose of a camera on an arm's flange, or of a fixed camera, from poses in which it saw one board.

    Each entry of POSES has the flange's pose in the base and the board's in the camera; `camera: fixed` means
    that the camera is fixed and the board is on the flange.

    With --rig the arm MOVES: from its present pose, with the board in view, it tilts its sensor in all directions about
    a point in front of it (--pivot: the board, for a camera on the arm), within its limits; the command asks for a
    confirmation first.

    Example: tacsim calibrate hand-eye poses.yaml
    """
    from calibration.errors import CalibrationError
    from calibration.poses.hand_eye import HandEyeNoise
    from calibration.poses.records import read_board_poses

    noise = HandEyeNoise(board=errors.noise_board, board_turn=errors.noise_turn)
    _require_one_source(poses, rig)
    folder = new_directory(out, "hand-eye")
    if poses is not None:
        _report_hand_eye(read_board_poses(poses), noise, folder)
        return
    from calibration.lens.board import parse_board
    from calibration.lens.view import Lens
    from robot.procedures.boards import BoardPosePlan
    from tacsim.config import load_model

    if not (rig and arm and camera and lens and board):
        raise typer.BadParameter("with --rig, give --arm, --camera, --lens and --board")
    described = parse_board(board)
    if described.kind == "dots":
        raise CalibrationError("a lattice of dots looks the same from two sides: use a ChArUco board for hand-eye")
    plan = BoardPosePlan(described, load_model(Lens, lens), motion.number, motion.tilt, motion.pivot)
    _report_hand_eye(_take_board_poses(rig, arm, camera, plan, set_ or [], folder, fixed=fixed), noise, folder)


def _take_board_poses(
    rig: str, arm: str, camera: str, plan: BoardPosePlan, overrides: list[str], folder: Path, *, fixed: bool
) -> BoardPoseFile:
    """Takes poses now; all recorded poses stay in `folder`, also after an error."""
    from calibration.poses.records import board_pose_file
    from robot.procedures.boards import open_arm, open_camera, record_board_poses
    from tacsim.config import load_rig

    config = load_rig(rig, overrides=overrides).config
    confirm_motion(
        config, f"Does the camera see the board, and may arm '{arm}' turn its sensor to all sides from here?"
    )
    with (
        _recorded_session(folder / "poses.yaml", "hand-eye", "poses", plan.poses) as (session, write),
        open_arm(config, arm) as mover,
        open_camera(camera, plan.lens) as source,
    ):
        session.store = lambda _: write(board_pose_file(session.measurements, fixed=fixed))
        record_board_poses(mover, source, plan, session)
    return board_pose_file(session.measurements, fixed=fixed)


def _report_hand_eye(record: BoardPoseFile, noise: Any, folder: Path) -> None:
    from calibration.poses.hand_eye import fit_hand_eye
    from calibration.poses.records import pose_as_json

    fixed = record.camera == "fixed"
    with busy(f"fitting {len(record.poses)} poses"):
        fit = fit_hand_eye(record.measurements(), fixed=fixed, noise=noise)
    _show_fit(
        "Error of each board's pose",
        ("pose", "position [mm]", "direction [deg]"),
        [(str(i + 1), f"{1e3 * m[0]:.3f}", f"{math.degrees(m[1]):.3f}") for i, m in enumerate(fit.residuals)],
        fit.used,
    )
    place, turn = fit.deviation
    name, board = ("base_from_camera", "flange_from_board") if fixed else ("flange_from_camera", "base_from_board")
    results.print(
        f"{name}: ± {1e3 * place:.3f} mm, ± {math.degrees(turn):.3f} deg; scatter {fit.scatter:.2f} of what the noise "
        f"allows; the flange's directions span {math.degrees(fit.spread):.0f} deg"
    )
    results.print(f"  {name}: {_placement_text(fit.camera)}")
    report = {
        name: pose_as_json(fit.camera, fit.covariance),
        board: pose_as_json(fit.board),
        "residuals": fit.residuals.tolist(),
        "used": list(fit.used),
        "scatter": fit.scatter,
        "units": "m, rad",
    }
    _write_report(folder, "hand-eye.json", report)


def _require_one_source(file: Path | None, rig: str | None) -> None:
    if (file is None) == (rig is None):
        raise typer.BadParameter("give either a file of recorded poses, or --rig to measure now")


def _show_fit(title: str, columns: tuple[str, ...], rows: list[tuple[str, ...]], used: tuple[bool, ...]) -> None:
    marked = ((*row, "" if good else "disagrees, left out") for row, good in zip(rows, used, strict=True))
    show_table(title, (*columns, ""), marked)


def _placement_text(pose: Pose) -> str:
    """A pose as in a rig file, rounded to 0.1 micrometres."""
    from calibration.poses.records import placement_of_pose

    placed = placement_of_pose(pose)
    position = ", ".join(f"{1e3 * each:.4f} mm" for each in placed.position)
    rotation = ", ".join(f"{math.degrees(each):.4f} deg" for each in placed.rotation)
    return f"{{ position: [{position}], rotation: [{rotation}] }}"


def _write_report(folder: Path, name: str, report: dict[str, Any]) -> None:
    path = folder / name
    with writing(folder):
        path.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    print_files(path)
    print_json(report, [path])


def latency(
    rig: HardwareRig,
    arm: Annotated[str, typer.Option("--arm", help="The arm that taps.")],
    sensor: Annotated[str, typer.Option("--sensor", help="The sensor that it carries.")],
    taps: Annotated[int, typer.Option(min=3, max=100, help="Number; more reduce the uncertainty.")] = 8,
    depth: Annotated[Any, length_option("Depth beyond the first touch.", 1e-6, 5e-3)] = "0.2 mm",
    lift: Annotated[Any, length_option("Retreat between taps.", 1e-6, 5e-3)] = "1 mm",
    set_: Overrides = None,
) -> None:
    """Measure the latency of a camera: its arm taps on a rigid object, and the two recordings are correlated.

    The arm MOVES: an episode's start (after your confirmation), then small taps along the sensor's z. Put a rigid
    object, fixed to the table or held by the other arm, in front of the gel.

    Example: tacsim calibrate latency ur5e --arm upper --sensor upper
    """
    from calibration.poses.latency import estimate_latency
    from robot.open import open_rig
    from robot.procedures.session import hardware_arm
    from robot.procedures.taps import TapPlan, latency_entries, record_taps, without_latency
    from tacsim.config import load_rig

    config = load_rig(rig, overrides=set_ or []).config
    opened = without_latency(config, arm, sensor)
    require_operator(config)
    with Interrupt() as interrupt:
        with busy("opening the rig") as say, open_rig(opened, confirm=ask_operator, report=say) as running:
            say("tapping")
            record = record_taps(running, opened, arm, sensor, TapPlan(taps, depth, lift), interrupt)
        if interrupt():
            print_error("stopped by a signal; nothing is measured")
            raise typer.Exit(interrupt.exit_code)
    measured = estimate_latency(record.arm_times, record.depth, record.frame_times, record.change)
    results.print(
        f"sensors.{sensor} is {1e3 * measured.seconds:.1f} ms later than arms.{arm}, "
        f"± {1e3 * measured.uncertainty:.1f} ms (correlation {measured.correlation:.3f}, {measured.samples} pictures)"
    )
    if record.clock != "arrival":
        notes.print("The images contain their time of exposure: the rest is the latency of the arm.")
        if measured.seconds > 3.0 * measured.uncertainty:
            notes.print("warning: they still seem later than the arm; is the arm's own latency in the file too large?")
    results.print("Write into the rig file:")
    entries = latency_entries(measured, record.clock, arm, hardware_arm(config, arm), sensor)
    for key, seconds in entries.items():
        results.print(f"  {key}: {1e3 * seconds:.1f} ms")
    print_json({**asdict(measured), "clock": record.clock, "entries": entries})
