"""The process of mock controllers: `python -m robot.mock 127.0.0.2 127.0.0.3`.

One loop serves all hosts of a process, with absolute deadlines every 2 ms. With --with-parent it ends when its standard
input ends or its parent is gone, so no mock outlives the program that started it.
"""

from __future__ import annotations

import argparse
import os
import selectors
import signal
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

from robot.common import CONTROLLER_PRIORITY, MOCK_SERIAL, request_realtime
from robot.common.kinematics import MODELS
from robot.common.process import write_message
from robot.mock.ur.controller import Controller, ControllerConfig
from robot.mock.ur.fault_client import FAULT_PORT
from robot.mock.ur.fault_server import FaultServer
from robot.mock.ur.handle import check_hosts
from robot.mock.ur.machine.arm import HOME, PERIOD
from robot.mock.ur.machine.forces import Mass
from robot.mock.ur.machine.state import VERSION, parse_version, version_text

if TYPE_CHECKING:
    from tacsim.models.hardware import Model


def serve(configs: Sequence[ControllerConfig], fault_port: int, *, with_parent: bool) -> None:
    """Runs controllers until the input ends (`with_parent`) or SIGTERM or SIGINT comes. Raises OSError for ports."""
    ended: list[str] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: ended.append("signal"))
    with selectors.DefaultSelector() as selector:
        controllers: list[Controller] = []
        fault_servers: list[FaultServer] = []
        try:
            for config in configs:
                controllers.append(Controller(config, selector))
                fault_servers.append(FaultServer(controllers[-1], selector, fault_port))
            if with_parent:
                selector.register(sys.stdin, selectors.EVENT_READ, lambda: ended.append("input"))
            write_message(sys.stdout.buffer, {"ready": [config.host for config in configs]})
            _loop(selector, controllers, fault_servers, ended, os.getppid() if with_parent else None)
        finally:
            for server in fault_servers:
                server.close()
            for controller in controllers:
                controller.close()


def _loop(
    selector: selectors.BaseSelector,
    controllers: list[Controller],
    fault_servers: list[FaultServer],
    ended: list[str],
    parent: int | None,
) -> None:
    max_periods = 5  # late control periods that are run one after another; more are skipped and counted
    deadline = time.perf_counter() + PERIOD
    while not ended:
        # Messages that have arrived are served before the tick, also after a pause: new commands before the watchdog.
        for key, _ in selector.select(max(0.0, deadline - time.perf_counter())):
            if _is_registered(selector, key):
                key.data()
        late = time.perf_counter() - deadline
        if late < 0:
            continue
        behind = int(late / PERIOD)
        if behind > max_periods:
            for controller in controllers:
                controller.overruns += behind - max_periods
            deadline += (behind - max_periods) * PERIOD
        deadline += PERIOD
        for controller in controllers:
            controller.tick()
        for server in fault_servers:
            server.flush()
        if parent is not None and os.getppid() != parent:
            return


def _one_for_each_host(options: list[str], hosts: Sequence[str], what: str) -> list[str]:
    if len(options) not in (1, len(hosts)):
        raise ValueError(f"{len(options)} {what} for {len(hosts)} hosts; give one for all, or one each")
    return options if len(options) == len(hosts) else options * len(hosts)


def _is_registered(selector: selectors.BaseSelector, key: selectors.SelectorKey) -> bool:
    """False for a connection that an earlier message of the same round has closed."""
    try:
        return key.fileobj in selector.get_map()
    except ValueError:  # a closed socket has no descriptor
        return False


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the process. Its first line on standard output is JSON: the hosts that are ready, or an error."""
    parser = argparse.ArgumentParser(prog="python -m robot.mock", description=__doc__)
    parser.add_argument("hosts", nargs="+")
    each = "once for all, or once for each host in their order"
    parser.add_argument("--model", choices=list(MODELS), action="append", help=each)
    parser.add_argument("--joints", action="append", help=f"six angles [rad], with commas; {each}")
    parser.add_argument("--payload", action="append", help=f"kg and centre x,y,z [m] on the flange; {each}")
    parser.add_argument("--version", action="append", help=f"of PolyScope, such as 5.11; {each}")
    parser.add_argument("--fault-port", "--door-port", type=int, default=FAULT_PORT)
    parser.add_argument("--serial", default=MOCK_SERIAL)
    parser.add_argument("--allow-network", action="store_true")
    parser.add_argument("--with-parent", action="store_true", help="end when standard input ends")
    parser.add_argument("--realtime", action="store_true", help="request real-time priority, to measure timing")
    options = parser.parse_args(arguments)
    if options.realtime:
        request_realtime(CONTROLLER_PRIORITY)
    try:
        check_hosts(options.hosts, options.allow_network)
        models = _one_for_each_host(options.model or ["ur5e"], options.hosts, "models")
        postures = [
            tuple(float(angle) for angle in text.split(","))
            for text in _one_for_each_host(options.joints or [",".join(map(repr, HOME))], options.hosts, "postures")
        ]
        tools = [
            Mass.of([float(number) for number in text.split(",")])
            for text in _one_for_each_host(options.payload or ["0,0,0,0"], options.hosts, "payloads")
        ]
        versions = map(
            parse_version, _one_for_each_host(options.version or [version_text(VERSION)], options.hosts, "versions")
        )
        config = [
            ControllerConfig(host, cast("Model", model), joints, version, options.serial, tool)
            for host, model, joints, version, tool in zip(options.hosts, models, postures, versions, tools, strict=True)
        ]
        serve(config, options.fault_port, with_parent=options.with_parent)
    except (OSError, ValueError) as error:
        message = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        write_message(sys.stdout.buffer, {"error": message})
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
