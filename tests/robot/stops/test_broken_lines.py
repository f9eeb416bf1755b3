"""An arm that stands after its line to the driver broke does not move again by itself, and no program is left running.

Each fault meets an arm at 0.1 m/s, whose driver is a user's program with a network between it and the controller; an
observer of its own process watches the arm for a while after its first standstill.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.promises import Record
from tests.robot.stops.watched import PORTS, Trial, judge

BREAKS: dict[str, Callable[[Trial, tuple[int, ...], float], float]] = {
    "reset": lambda trial, ports, back: trial.network(do="cut", ports=ports, reset=True, back=back),
    "closed (FIN)": lambda trial, ports, back: trial.network(do="cut", ports=ports, reset=False, back=back),
    "reset by the controller": lambda trial, ports, back: trial.cut(ports),
    "black hole": lambda trial, ports, back: trial.network(do="hold", ports=ports, ways=["pc", "robot"], back=back),
    "to the PC lost": lambda trial, ports, back: trial.network(do="hold", ports=ports, ways=["pc"], back=back),
    "to the robot lost": lambda trial, ports, back: trial.network(do="hold", ports=ports, ways=["robot"], back=back),
}
STANDARD = ("reset by the controller", "all")  # what every run of the tests sees
LINES = [
    pytest.param(kind, ports, marks=() if (kind, ports) == STANDARD else pytest.mark.deep, id=f"{kind}, {ports}")
    for kind in BREAKS
    for ports in PORTS
]


@pytest.mark.often
@pytest.mark.promise(7)
@pytest.mark.timeout(120)
@pytest.mark.parametrize(("kind", "ports"), LINES)
def test_after_a_broken_line_nothing_moves_again(
    trial: Trial, kind: str, ports: str, back: float, watch: float, figure: Record
) -> None:
    event = BREAKS[kind](trial, PORTS[ports], back)
    seen = trial.watch(event, watch)
    name = f"line {kind}, {'all ports' if ports == 'all' else ports + ' port'}"
    judge(name, seen, figure, goes_on=ports in ("script", "dashboard"))  # these carry nothing while it moves
