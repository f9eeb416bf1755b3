"""`tacsim mock`: mock hardware on loopback, to test a driver without a robot."""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated

import typer

from robot.cli.options import complete_names
from robot.cli.output import results
from robot.cli.terminal import Interrupt
from tacsim.models.text import suggest_word

if TYPE_CHECKING:
    from robot.mock import FaultClient

Log = list[tuple[float, str]]  # time of the robot [s], and message


def mock(
    arms: Annotated[int, typer.Option("--arms", min=0, max=16, help="How many: 127.0.0.2, 127.0.0.3, ...")] = 1,
    host: Annotated[
        list[str] | None,
        typer.Option("--host", help="Address of an arm, instead of --arms; may be repeated.", show_default=False),
    ] = None,
    model: Annotated[
        str, typer.Option(help="ur3e, ur5e or ur10e.", autocompletion=complete_names(words=("ur3e", "ur5e", "ur10e")))
    ] = "ur5e",
    cameras: Annotated[
        int, typer.Option("--cameras", min=0, max=16, help="How many: at the arms' addresses, then the next ones.")
    ] = 0,
    camera_port: Annotated[int, typer.Option(min=1, max=65535, help="Port of every camera.")] = 8081,
    version: Annotated[
        str | None, typer.Option("--version", help="Of PolyScope, as reported by the arms.", show_default="5.11")
    ] = None,
    payload: Annotated[
        str | None,
        typer.Option(help="Load on each flange: kg, or kg,x,y,z with its centre \\[m].", show_default="nothing"),
    ] = None,
    allow_network: Annotated[
        bool, typer.Option("--allow-network", help="Allow addresses that other machines reach.")
    ] = False,
) -> None:
    """Run mock UR controllers and cameras until Ctrl-C: RTDE, script and dashboard ports, MJPEG over HTTP.

    Arms move, measure forces and stop like real arms, but without dynamics. Any UR client can connect. Cameras send
    images of 320 x 240 px, 30 times a second, with a strip below that contains number and clock of the frame; they have
    no gel. For arms and cameras with simulated gels, open the rig `mock`. The command prints the events of each arm.

    Example: tacsim mock --arms 2 --cameras 2
    """
    from robot.common.kinematics import MODELS
    from robot.mock import MockArms, MockCamera
    from robot.mock.ur.controller import PORTS
    from robot.mock.ur.fault_client import FAULT_PORT
    from robot.mock.ur.machine.forces import Mass
    from robot.mock.ur.machine.state import VERSION, parse_version

    if model not in MODELS:
        words = f"no model '{model}'; allowed: {', '.join(MODELS)}{suggest_word(model, MODELS)}"
        raise typer.BadParameter(words, param_hint="--model")
    try:
        claimed = VERSION if version is None else parse_version(version)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--version") from None
    try:
        numbers = [float(number) for number in (payload or "0").split(",")]
        tool = Mass.of(numbers + [0.0] * 3 if len(numbers) == 1 else numbers)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--payload") from None
    hosts = host or [f"127.0.0.{2 + index}" for index in range(arms)]
    if not hosts and not cameras:
        raise typer.BadParameter("nothing to run: give at least one arm or camera", param_hint="--arms, --cameras")
    camera_hosts = [hosts[index] if index < len(hosts) else f"127.0.0.{2 + index}" for index in range(cameras)]
    with Interrupt() as interrupt, ExitStack() as stack:
        devices: list[MockArms | MockCamera] = []
        if hosts:
            hanging = (tool.mass, *tool.centre)
            controllers = MockArms(
                hosts, model=model, payload=[hanging] * len(hosts), version=claimed, allow_network=allow_network
            )
            devices.append(stack.enter_context(controllers))
        ports = ", ".join(map(str, sorted(PORTS)))
        for each in hosts:
            results.print(f"{model} at {each}: ports {ports}; faults {FAULT_PORT}")
        for each in camera_hosts:
            camera = stack.enter_context(MockCamera(each, camera_port, noise=2, allow_network=allow_network))
            devices.append(camera)
            results.print(f"camera at {camera.url}")
        results.print("Ctrl-C ends them.")
        logs: dict[str, Log] = {}
        while not interrupt():
            for device in devices:
                device.check()
                if isinstance(device, MockArms):
                    for faults in device.fault_clients:
                        logs[faults.host] = _print_new_lines(faults, logs.get(faults.host, []))
            time.sleep(0.1)
        raise typer.Exit(interrupt.exit_code)


def _print_new_lines(faults: FaultClient, printed: Log) -> Log:
    """Prints the lines of an arm's log that are not in `printed`, its last state; returns the log."""
    from robot.mock import FaultError

    try:
        log = faults.log()
    except FaultError:  # its mock ends: the next check reports the reason
        return printed
    last = printed[-1] if printed else None
    for at, text in log[log.index(last) + 1 if last in log else 0 :]:
        if last is None or text != last[1]:
            results.print(f"{faults.host} {at:.3f} s: {text}")
        last = at, text
    return log
