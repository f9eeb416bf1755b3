"""A procedure at the terminal: what a person is told and asked, where pictures and records are kept, how it ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from robot.cli.errors import complain
from robot.cli.output import notes, progress, writing
from robot.cli.terminal import Interrupt, ask, has_person, has_real_arm

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from robot.procedures.session import Session
    from tacsim.models.hardware import CameraSensorConfig
    from tacsim.models.rig import RigConfig


@contextmanager
def led(what: str, total: int, kept: Path, note: str) -> Iterator[Session[Any]]:
    """A session whose words and progress go to stderr. At the end, a failure included, `note` says where what was
    taken lies, if it was `kept`. A signal ends the command: its exit is raised at the end of the block."""
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
            if kept.exists():
                notes.print(note)
    if interrupt():
        complain(f"stopped by a signal; {len(session.measurements)} {what} are kept, nothing is calibrated")
        raise typer.Exit(interrupt.exit_code)


def confirm_motion(config: RigConfig, question: str) -> None:
    """Asks a person, where an arm is no mock. Raises CannotOpen."""
    from robot.open import CannotOpen

    if has_real_arm(config) and not ask(f"Rig '{config.name}': {question}"):
        raise CannotOpen("nobody confirmed (at a terminal); nothing was moved")


def confirm_free_gel() -> None:
    """Without a terminal nobody is asked: the gel counts as free once its picture rests."""
    if has_person():
        while not ask("Is nothing touching the gel?", default=True):
            notes.print("Take everything off the gel first.")


def named_camera(
    camera: str, overrides: list[str], size: tuple[int, int] = (640, 480)
) -> tuple[CameraSensorConfig, str]:
    """The sensor RIG/SENSOR, or the camera at a device or address, whose pictures are of `size` (width, height [px]);
    and its name. Raises CannotCalibrate where nobody can be before its camera."""
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


def picture_keeper(folder: Path) -> Callable[[tuple[str, NDArray[np.uint8]]], None]:
    """What writes named pictures into `folder`, which the first one makes."""
    from tacsim.record.images import encode_png

    def keep(picture: tuple[str, NDArray[np.uint8]]) -> None:
        with writing(folder):
            (folder / picture[0]).write_bytes(encode_png(picture[1]))

    return keep
