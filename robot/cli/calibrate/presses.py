"""The live part of `tacsim calibrate sensor`: a person presses a ball before the camera and is led through it."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from robot.cli.errors import complain
from robot.cli.interrupt import Interrupt
from robot.cli.output import made, notes, progress, writing

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from calibration.frame_set import FrameSet
    from calibration.lens.view import GelView
    from tacsim.models.hardware import CameraSensorConfig


def pressed(
    camera: str,
    overrides: list[str],
    folder: Path,
    ball: float,
    presses: int,
    view: GelView | None,
    serial: str,
    *,
    markers: bool,
) -> FrameSet:
    """Frames taken now, native, and kept in `folder`/frames. camera: RIG/SENSOR; ball: its radius [px].

    A signal ends the command; what was taken is kept then, too. Raises CannotPress, BadFrames, DeviceError.
    """
    from calibration.errors import BadFrames
    from calibration.frame_set import Frame, FrameSet, metric_picture, require_view_size
    from robot.camera.camera import Camera
    from robot.procedures.presses import PressPlan, record_presses

    config, sensor = named_camera(camera, overrides)
    if view is not None:
        require_view_size((config.height, config.width), view)
    frames = folder / "frames"
    with Camera(config, sensor) as eye:
        _await_person()
        with Interrupt() as interrupt, progress() as bar:
            row = bar.add_task("presses", total=presses)
            plan = PressPlan(ball, presses, rectify=None if view is None else metric_picture(view), markers=markers)
            try:
                taken = record_presses(
                    eye,
                    plan,
                    keeping(frames),
                    say=lambda words: notes.print(words, markup=False),
                    tell=lambda done: bar.update(row, completed=done),
                    stop=interrupt,
                )
            finally:
                if frames.exists():
                    again = f"tacsim calibrate sensor {shlex.quote(str(frames))} --serial {shlex.quote(serial)} ..."
                    notes.print(f"frames kept in {frames}; to calibrate from them again: {again}", markup=False)
    if interrupt():
        complain(f"stopped by a signal; {len(taken.presses)} presses are kept, nothing is calibrated")
        raise typer.Exit(interrupt.exit_code)
    if taken.reference is None or not taken.presses:
        raise BadFrames("the source was over before a press was taken")
    presses_taken = tuple(Frame(name, image) for name, image in taken.presses)
    more = tuple(Frame(f"background_{k}.png", image) for k, image in enumerate(taken.untouched[:-1], start=1))
    return FrameSet(camera, taken.reference, "background.png", presses_taken, more)


def named_camera(camera: str, overrides: list[str]) -> tuple[CameraSensorConfig, str]:
    """The sensor RIG/SENSOR, and its name. Raises CannotPress where nobody can be before its camera."""
    from robot.procedures.presses import camera_facts
    from tacsim.config import load_rig

    rig, _, sensor = camera.rpartition("/")
    if not rig:
        raise typer.BadParameter(
            f"'{camera}': give rig and sensor, such as ur5e/upper or my.yaml/upper", param_hint="--camera"
        )
    return camera_facts(load_rig(rig, overrides=overrides).config, sensor), sensor


def keeping(folder: Path) -> Callable[[str, NDArray[np.uint8]], None]:
    """What writes pictures into `folder`, which the first one makes."""
    from tacsim.record.images import encode_png

    def keep(name: str, image: NDArray[np.uint8]) -> None:
        with writing(made(folder)):
            (folder / name).write_bytes(encode_png(image))

    return keep


def _await_person() -> None:
    """Without a terminal nobody is asked: the gel counts as free once its picture rests."""
    if sys.stdin.isatty():
        while not typer.confirm("Is nothing touching the gel?", default=True, err=True):
            notes.print("Take everything off the gel first.")
