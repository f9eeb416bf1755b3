"""`tacsim start`: the arms of a rig are led to where an episode begins."""

from __future__ import annotations

from typing import Annotated

import typer

from robot.cli.doctor import print_checks
from robot.cli.errors import complain
from robot.cli.interrupt import Interrupt
from robot.cli.options import Overrides
from robot.cli.output import busy, notes
from robot.cli.question import ask, has_person


def start(
    rig: Annotated[str, typer.Argument(help="A rig of hardware (ur5e, ur5e-one, mock), or the path of its file.")],
    set_: Overrides = None,
) -> None:
    """Lead the arms of a rig to where an episode begins, from wherever they stand.

    Shows where each arm stands, offers to zero its force sensor, and moves it, one after the other, slowly and straight
    in joint space. Nothing happens without a yes at the terminal; Ctrl-C brakes.

    Example: tacsim start my.yaml
    """
    with busy("looking at the rig"):
        from robot.doctor.rig import examine_arms
        from robot.open import CannotOpen
        from robot.procedures.to_start import Guide, Halted, lead_to_start
        from robot.rig.parts import companion_of
        from tacsim.config import load_rig
        from tacsim.models.hardware import UrArmConfig, parts_of

        config = load_rig(rig, overrides=set_ or []).config
    arms = parts_of(config.arms, UrArmConfig)
    if not arms:
        raise CannotOpen(f"rig '{config.name}' has no UR arm: there is nothing to lead to its start")
    if not has_person():
        raise CannotOpen(
            f"rig '{config.name}': no arm is led to its start without somebody who says yes; run this from a terminal"
        )
    with Interrupt() as interrupt, companion_of(config) as companion:
        of_mocks = {} if companion is None else companion.start_poses
        starts = {**of_mocks, **{name: arm.start.pose for name, arm in arms.items() if arm.start is not None}}
        with busy("looking at the arms"):
            checks = examine_arms(config, of_mocks, rig)
        print_checks(checks)
        try:
            with busy("connecting") as show:
                guide = Guide(
                    lambda question: ask(f"Rig '{config.name}': {question}"),
                    lambda words: notes.print(words, markup=False),
                    show,
                    interrupt,
                )
                away = lead_to_start(config, starts, guide)
        except Halted as halted:
            complain(str(halted))
            raise typer.Exit(interrupt.exit_code or 1) from None
    if any(distance > 5e-3 for distance in away.values()) or not away:
        complain("not every arm stands at its start")
        raise typer.Exit(1)
    notes.print(f"All arms stand at their starts. Next: tacsim run {rig} --dry-run", markup=False)
