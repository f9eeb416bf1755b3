"""`tacsim calibrate latency`: how much later a camera's pictures come than the states of the arm that carries it."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from robot.cli.errors import complain
from robot.cli.options import Overrides, length
from robot.cli.output import busy, notes, results
from robot.cli.terminal import Interrupt, ask, require_person


def latency(
    rig: Annotated[str, typer.Argument(help="A rig of hardware, or the path of its file.")],
    arm: Annotated[str, typer.Option("--arm", help="The arm that taps.")],
    sensor: Annotated[str, typer.Option("--sensor", help="The sensor that it carries.")],
    taps: Annotated[int, typer.Option(min=3, max=100, help="How many; more make it surer.")] = 8,
    depth: Annotated[Any, length("How deep, beyond the first touch.", 1e-6, 5e-3)] = "0.2 mm",
    lift: Annotated[Any, length("How far back between taps.", 1e-6, 5e-3)] = "1 mm",
    set_: Overrides = None,
) -> None:
    """Measure how late a camera is: its arm taps on something firm, and both records are laid over each other.

    The arm MOVES: an episode's start (a person is asked before it approaches), then small taps along the sensor's z.
    Put something firm, fixed to the table or held by the other arm, before the gel.

    Example: tacsim calibrate latency ur5e --arm upper --sensor upper
    """
    from calibration.poses.latency import estimate_latency
    from robot.open import open_rig
    from robot.procedures.session import hardware_arm
    from robot.procedures.taps import TapPlan, latency_entries, record_taps, without_latency
    from tacsim.config import load_rig

    config = load_rig(rig, overrides=set_ or []).config
    opened = without_latency(config, arm, sensor)
    require_person(config)
    with Interrupt() as interrupt:
        with busy("opening the rig") as say, open_rig(opened, confirm=ask, tell=say) as running:
            say("tapping")
            record = record_taps(running, opened, arm, sensor, TapPlan(taps, depth, lift), interrupt)
        if interrupt():
            complain("stopped by a signal; nothing is measured")
            raise typer.Exit(interrupt.exit_code)
    measured = estimate_latency(record.arm_times, record.depth, record.frame_times, record.change)
    results.print(
        f"sensors.{sensor} is {1e3 * measured.seconds:.1f} ms later than arms.{arm}, "
        f"± {1e3 * measured.uncertainty:.1f} ms (correlation {measured.correlation:.3f}, {measured.samples} pictures)"
    )
    if record.clock != "arrival":
        notes.print("The pictures bring their time of exposure along: what is left is the arm's.")
        if measured.seconds > 3.0 * measured.uncertainty:
            notes.print("warning: yet they seem later than the arm; is the arm's own latency in the file too large?")
    results.print("Write into the rig file:")
    for key, seconds in latency_entries(measured, record.clock, arm, hardware_arm(config, arm), sensor).items():
        results.print(f"  {key}: {1e3 * seconds:.1f} ms")
