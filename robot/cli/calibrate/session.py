"""A calibration procedure at the terminal: messages, questions, stored images and records, and its end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from robot.cli.output import notes, progress, writing
from robot.cli.terminal import Interrupt, ask_operator, has_operator, has_real_arm, print_error

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from robot.procedures.session import Session
    from tacsim.models.hardware import CameraSensorConfig
    from tacsim.models.rig import RigConfig


@contextmanager
def guided_session(what: str, total: int, stored: Path, note: str) -> Iterator[Session[Any]]:
    """A session whose messages and progress go to stderr. At the end, also after an error, `note` is printed if the
    path `stored` exists. A signal ends the command: its exit is raised at the end of the block."""
    from robot.procedures.session import Session

    with Interrupt() as interrupt, progress() as bar:
        row = bar.add_task(what, total=total)
        session: Session[Any] = Session(
            report=lambda words: notes.print(words),
            progress=lambda done: bar.update(row, completed=done),
            stop=interrupt,
        )
        try:
            yield session
        finally:
            if stored.exists():
                notes.print(note)
    if interrupt():
        print_error(f"stopped by a signal; {len(session.measurements)} {what} are kept, nothing is calibrated")
        raise typer.Exit(interrupt.exit_code)


def confirm_motion(config: RigConfig, question: str) -> None:
    """Asks the operator if an arm is not a mock. Raises CannotOpen without a confirmation."""
    from robot.open import CannotOpen

    if has_real_arm(config) and not ask_operator(f"Rig '{config.name}': {question}"):
        raise CannotOpen("the operator did not confirm (at a terminal); nothing was moved")


def confirm_free_gel() -> None:
    """Asks until the operator confirms that the gel is free. Without a terminal, the gel counts as free once its image
    does not change."""
    if has_operator():
        while not ask_operator("Is nothing touching the gel?", default=True):
            notes.print("Take everything off the gel first.")


def named_camera(
    camera: str, overrides: list[str], size: tuple[int, int] = (640, 480)
) -> tuple[CameraSensorConfig, str]:
    """The sensor RIG/SENSOR, or the camera at a device or address with images of `size` (width, height [px]); and its
    name. Raises CannotCalibrate if its gel cannot be reached by hand."""
    if camera.startswith(("/dev/", "http://", "https://")):
        from tacsim.models.hardware import CameraSensorConfig

        return CameraSensorConfig(driver="camera", source=camera, width=size[0], height=size[1]), "sensor"
    from robot.procedures.session import handheld_camera
    from tacsim.config import load_rig

    rig, _, sensor = camera.rpartition("/")
    if not rig:
        raise typer.BadParameter(
            f"'{camera}': give rig and sensor, such as my.yaml/upper, or a camera at /dev/v4l/by-id/... or http://...",
            param_hint="--camera",
        )
    return handheld_camera(load_rig(rig, overrides=overrides).config, sensor), sensor


def image_writer(folder: Path) -> Callable[[tuple[str, NDArray[np.uint8]]], None]:
    """A function that writes named images into `folder`, and makes the folder for the first one."""
    from tacsim.record.images import encode_png

    def write_image(picture: tuple[str, NDArray[np.uint8]]) -> None:
        with writing(folder):
            (folder / picture[0]).write_bytes(encode_png(picture[1]))

    return write_image
