"""An arm that stands after its line to the driver broke does not move again by itself, and no program is left running.

Each fault meets an arm at 0.1 m/s, whose driver is a user's program with a network between it and the controller; an
observer of its own process watches the arm for a while after its first standstill.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.promises import Record
from tests.stops.watched import PORTS, Trial, judge

Break = Callable[[Trial, tuple[int, ...], float], float]


def cut(*, reset: bool) -> Break:
    return lambda trial, ports, back: trial.network(do="cut", ports=ports, reset=reset, back=back)


def hold(*ways: str) -> Break:
    return lambda trial, ports, back: trial.network(do="hold", ports=ports, ways=ways, back=back or None)


BREAKS: dict[str, Break] = {
    "reset": cut(reset=True),
    "closed (FIN)": cut(reset=False),
    "reset by the controller": lambda trial, ports, back: trial.cut(ports),
    "black hole": hold("pc", "robot"),
    "to the PC lost": hold("pc"),
    "to the robot lost": hold("robot"),
}
STANDARD = ("reset by the controller", "all")  # what every run of the tests sees
CASES = [
    pytest.param(kind, ports, marks=() if (kind, ports) == STANDARD else pytest.mark.deep, id=f"{kind}, {ports}")
    for kind in BREAKS
    for ports in ("all", "RTDE")
]


@pytest.mark.slow
@pytest.mark.often
@pytest.mark.promise(7)
@pytest.mark.parametrize(("kind", "ports"), CASES)
def test_after_a_broken_line_nothing_moves_again(
    trial: Trial, kind: str, ports: str, back: float, watch: float, figure: Record
) -> None:
    event = BREAKS[kind](trial, PORTS[ports], back)
    judge(f"line {kind}, {ports}", trial.watch(event, watch), figure)


@pytest.mark.deep
@pytest.mark.promise(7)
@pytest.mark.parametrize("ports", ["script", "dashboard"])
@pytest.mark.parametrize("kind", BREAKS)
def test_a_line_that_carries_nothing_may_break(
    trial: Trial, kind: str, ports: str, back: float, watch: float, figure: Record
) -> None:
    """While an arm moves, that is: programs and questions of the pendant were sent before."""
    event = BREAKS[kind](trial, PORTS[ports], back)
    judge(f"line {kind}, {ports}", trial.watch(event, watch), figure, goes_on=True)
