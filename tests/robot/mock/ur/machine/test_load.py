"""The measured force of a payload that is carried, configured, or zeroed: against statics by hand."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from robot.mock import MockError, MockUR
from robot.mock.ur.machine.forces import GRAVITY, Mass
from tacsim.interface import FloatArray
from tests.robot.mock.machine_bench import Bench
from tests.robot.mock.wire_client import ControlClient, wire_host

CENTRE = (0.03, -0.02, 0.08)
TURNS = ([0.0] * 6, [0.3, 0.2, -0.4, 0.6, -0.3, 0.8], [-0.5, -0.2, 0.3, -1.2, 1.1, -2.0])


def attitudes(bench: Bench) -> Iterator[FloatArray]:
    """Turns the flange about, and gives what is felt (6,)."""
    home = bench.arm.target_q.copy()
    for turn in TURNS:
        bench.call(1, [*(home + turn), 1.0, 2.0])
        bench.until(lambda: bench.arm.rests)
        bench.tick()
        yield bench.machine.load.zeroed_wrench


def weight(bench: Bench, mass: float) -> FloatArray:
    """Of a mass at CENTRE about the TCP, base axes, by hand."""
    force = np.array([0.0, 0.0, -mass * GRAVITY])
    flange = bench.arm.kinematics.forward(bench.arm.q)
    lever = (flange @ [*CENTRE, 1.0])[:3] - bench.arm.frame[:3, 3]
    return np.concatenate([force, np.cross(lever, force)])


@pytest.mark.slow
@pytest.mark.parametrize("command", [17, 65])
def test_configured_payload_is_compensated_and_other_is_not(bench: Bench, command: int) -> None:
    bench.call(29, [0.01, 0.02, 0.15, 0.4, 0, 0])  # a TCP far from the flange
    bench.machine.load.hidden = Mass(0.5, CENTRE)
    for felt in attitudes(bench):
        np.testing.assert_allclose(felt, weight(bench, 0.5), atol=1e-9)
        assert np.linalg.norm(felt[:3]) == pytest.approx(4.91)
    bench.call(command, [0.5, *CENTRE])
    for felt in attitudes(bench):
        np.testing.assert_allclose(felt, 0, atol=1e-9)
    bench.call(command, [0.7, *CENTRE])  # a payload that is too heavy: as if something pulled it up
    for felt in attitudes(bench):
        np.testing.assert_allclose(felt, -weight(bench, 0.2), atol=1e-9)


def test_payload_set_after_zeroing_shows_until_next_zeroing(bench: Bench) -> None:
    bench.machine.load.hidden = Mass(0.5, CENTRE)
    bench.tick()
    bench.call(8)
    np.testing.assert_allclose(bench.machine.load.zeroed_wrench, 0, atol=1e-9)
    bench.call(17, [0.5, *CENTRE])
    bench.tick()
    np.testing.assert_allclose(bench.machine.load.zeroed_wrench, -weight(bench, 0.5), atol=1e-9)
    bench.call(8)
    for felt in attitudes(bench):
        np.testing.assert_allclose(felt, 0, atol=1e-9)


def test_wrong_gravity_subtracts_weight_in_wrong_direction(bench: Bench) -> None:
    bench.machine.load.hidden = Mass(0.5)
    bench.call(17, [0.5, 0, 0, 0])
    tilt = 0.3
    bench.call(59, [0, GRAVITY * math.sin(tilt), GRAVITY * math.cos(tilt)])
    bench.tick()
    wanted = 0.5 * GRAVITY * np.array([0, math.sin(tilt), math.cos(tilt) - 1.0])
    np.testing.assert_allclose(bench.machine.load.zeroed_wrench[:3], wanted, atol=1e-9)


def test_raw_wrench_ignores_payload_and_zeroing(bench: Bench) -> None:
    bench.machine.load.hidden = Mass(0.5)
    bench.call(17, [0.5, *CENTRE])
    bench.call(8)
    bench.tick()
    down = bench.arm.frame[:3, :3].T @ [0, 0, -0.5 * GRAVITY]
    np.testing.assert_allclose(bench.machine.raw_wrench, [*down, 0, 0, 0], atol=1e-9)


def test_freedrive_drifts_only_with_wrong_payload(bench: Bench) -> None:
    bench.machine.load.hidden = Mass(0.5)
    bench.call(17, [0.5, 0, 0, 1e-9])
    bench.call(52, [0] * 6, [1, 1, 1, 0, 0, 0])
    z = float(bench.arm.frame[2, 3])
    bench.tick(250)
    assert bench.arm.frame[2, 3] == pytest.approx(z, abs=1e-6)
    bench.call(53)
    bench.call(17, [0.0, 0, 0, 0])
    bench.call(52, [0] * 6, [1, 1, 1, 0, 0, 0])
    bench.tick(250)
    assert bench.arm.frame[2, 3] < z - 0.005


@pytest.mark.parametrize("numbers", [(1, 2, 3), (1, 2, 3, math.nan), (1e300, 0, 0, 1e300), (math.inf, 0, 0, 0)])
def test_invalid_payload_is_refused(numbers: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="a payload is"):
        Mass.of(numbers)


def test_mock_measures_its_initial_payload() -> None:
    with MockUR(wire_host(30), payload=(0.4, *CENTRE)) as carrier:
        for _ in range(2):
            with ControlClient(carrier.host) as client:
                untold = client.wait(lambda state: True)
                assert untold["actual_TCP_force"][2] == pytest.approx(-0.4 * GRAVITY)
                client.call(17, [0.4, *CENTRE])
                state_without_force = client.wait(lambda state: abs(state["actual_TCP_force"][2]) < 1e-9)
                np.testing.assert_allclose(state_without_force["actual_TCP_force"], 0, atol=1e-9)
            carrier.faults.reset()
    with pytest.raises(MockError, match="payload"):
        MockUR(wire_host(30), payload=(0.4, math.nan, 0, 0))
