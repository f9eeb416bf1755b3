"""`tacsim mock`: mock hardware on loopback, to try a driver against without any robot."""

from __future__ import annotations

import time
from typing import Annotated

import typer

from robot.cli.interrupt import Interrupt
from robot.cli.output import results


def mock(
    arms: Annotated[int, typer.Option("--arms", min=1, max=16, help="How many: 127.0.0.2, 127.0.0.3, ...")] = 1,
    host: Annotated[
        list[str] | None,
        typer.Option("--host", help="Address of an arm, instead of --arms; may be repeated.", show_default=False),
    ] = None,
    model: Annotated[str, typer.Option(help="ur3e, ur5e or ur10e.")] = "ur5e",
    allow_network: Annotated[
        bool, typer.Option("--allow-network", help="Allow addresses that other machines reach.")
    ] = False,
) -> None:
    """Run mock UR controllers until Ctrl-C: RTDE, script and dashboard ports, as a robot has them.

    They move, feel and stop like an arm, but know no dynamics. Any UR client can connect.

    Example: tacsim mock --arms 2
    """
    from robot.kinematics import MODELS
    from robot.mock import MockArms
    from robot.mock.controller import PORTS
    from robot.mock.door import DOOR_PORT

    if model not in MODELS:
        raise typer.BadParameter(f"no model '{model}'; allowed: {', '.join(MODELS)}", param_hint="--model")
    hosts = host or [f"127.0.0.{2 + index}" for index in range(arms)]
    with Interrupt() as interrupt, MockArms(hosts, model=model, allow_network=allow_network) as running:
        ports = ", ".join(map(str, sorted(PORTS)))
        for each in hosts:
            results.print(f"{model} at {each}: ports {ports}; fault door {DOOR_PORT}")
        results.print("Ctrl-C ends them.")
        while not interrupt() and running.running:
            time.sleep(0.1)
        if interrupt():
            raise typer.Exit(interrupt.exit_code)
        raise RuntimeError("the process of the mock controllers has ended by itself; its reason stands above")
