"""A clay cylinder between two gels, squeezed and cycled, compared with an independent solver."""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmarks.cases.oracles import FINE, RESOLUTIONS, comparison_row
from benchmarks.cases.squeeze import close_sensors, normal_forces
from benchmarks.harness.measure import Measurement, once
from benchmarks.harness.runner import Case
from benchmarks.truth import finite_elements as truth
from tacsim.physics.failure.diagnosis import particle_volumes
from tacsim.physics.world import World, make_world

HEIGHT = 10.0  # [mm]
LOW, HIGH = 2.0, 2.3  # compressions of a cycle [mm]
CYCLES = (1, 2, 5, 10)  # with a row for their force
FLOWING = (2, 200, 700)
STEPS = 3  # flowing motions from LOW to HIGH


def squeezed(resolution: str, repeat: int) -> list[Measurement]:
    """A clay cylinder of 10 x 10 mm between gels, closed by 1, 2 and 3 mm from first contact, each settled."""
    world, rows = _make_cylinder_world(resolution), []
    for by, (force, height) in truth.CYLINDER.items():
        timing, settled = once(partial(_close_to, world, by))
        body = world.truth()
        assert body is not None
        what, note = f"cylinder squeezed by {by:g} mm", _settling_note(settled)
        rows.append(comparison_row(timing, f"{what}: force", "n", _mean_force(world), force, note))
        rows.append(comparison_row(timing, f"{what}: height", "mm", body.height * 1e3, height, note))
    return rows


def cycled(resolution: str, repeat: int) -> list[Measurement]:
    """The same cylinder closed by 2.0 and 2.3 mm in turn, each settled: force at 2.3 mm."""
    world, rows = _make_cylinder_world(resolution), []
    for number in range(1, max(CYCLES) + 1):
        _close_to(world, LOW)
        timing, settled = once(partial(_close_to, world, HIGH))
        if number in CYCLES:
            what = f"cylinder led from 2.0 to 2.3 mm, time {number}: force"
            rows.append(
                comparison_row(
                    timing, what, "n", _mean_force(world), truth.CYCLED, _settling_note(settled), _volumes(world)
                )
            )
    return rows


def flowing_cycles(resolution: str, repeat: int) -> list[Measurement]:
    """The cylinder moved from 2.0 to 2.3 mm and back in flowing steps of 0.1 mm: the change of the force at 2.3 mm, and
    the largest difference of an elastic volume ratio from one."""
    world, rows, second = _make_cylinder_world(resolution), [], 0.0
    _close_to(world, HIGH)
    path = np.linspace(HIGH, LOW, STEPS + 1)[1:]

    def move_sensors(times: int) -> None:
        for by in [*path, *path[-2::-1], HIGH] * times:
            _close_to(world, by, flow=True)

    done = 0
    for number in FLOWING:
        timing, _ = once(partial(move_sensors, number - done))
        done, force, volumes = number, _mean_force(world), _volumes(world)
        second = second or force
        what, figures = f"{number} cycles", {"force_n": force, **volumes}
        rows.append(
            Measurement(timing, abs(force / second - 1) * 100, "% of the second's force", "shakedown", what,
                        figures=figures)
        )  # fmt: skip
    return rows


def _make_cylinder_world(resolution: str) -> World:
    from tacsim.config import load_scene

    fine = ["particle_spacing=0.125 mm", "element_size=0.25 mm"]
    shape = "body.geometry={shape: cylinder, radius: 5 mm, height: 10 mm}"
    return make_world(load_scene("squeeze", [shape, *(fine if resolution == FINE else [f"preset={resolution}"])]))


def _close_to(world: World, by: float, *, flow: bool = False) -> bool:
    """Moves the sensors until they are `by` [mm] closer than at first contact; True if that settled."""
    distance = float((world.pose("upper").position - world.pose("lower").position)[2])
    return close_sensors(world, distance - (HEIGHT - by) * 1e-3, flow=flow).settled


def _mean_force(world: World) -> float:
    return float(normal_forces(world).mean())


def _volumes(world: World) -> dict[str, float]:
    volumes = particle_volumes(world.snapshot())
    assert volumes is not None
    low, high = float(volumes.min()), float(volumes.max())
    return {"volume_low": low, "volume_high": high, "volume_off": max(1 - low, high - 1)}


def _settling_note(settled: bool) -> str:
    return "" if settled else "not settled"


CASES = (
    *(
        Case("oracles", "squeezed", "tacsim", each, partial(squeezed, each), long=each in ("standard", FINE))
        for each in RESOLUTIONS
    ),
    *(
        Case("oracles", "cycled", "tacsim", each, partial(cycled, each), long=each == "standard")
        for each in RESOLUTIONS
        if each != FINE
    ),
    Case("squeeze", "flowing_cycles", "tacsim", "draft", partial(flowing_cycles, "draft"), long=True),
)
