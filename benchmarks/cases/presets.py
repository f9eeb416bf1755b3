"""What each preset is worth: a squeezed cylinder at learn, draft and standard against one solver that is not ours."""

from __future__ import annotations

from functools import partial

from benchmarks.cases.squeeze import PRESETS, close, normal_forces
from benchmarks.harness.measure import Measurement, timed
from benchmarks.harness.runner import Case
from tacsim.physics.move import MoveStats
from tacsim.physics.world import World, make_world

# An axisymmetric elastoplastic cylinder between two neo-Hookean gels, by finite elements of our own making that share
# nothing with the product; from 0.5 to 0.25 mm its force changes by 0.3 %. Closed [m]: force [N], height [m].
HEIGHT = 10e-3
CYLINDER = {1e-3: (2.054, 9.548e-3), 2e-3: (2.799, 8.729e-3), 3e-3: (3.137, 7.789e-3)}


def cylinder(preset: str, repeat: int) -> list[Measurement]:
    """A clay cylinder of 10 x 10 mm squeezed by 1, 2 and 3 mm, each settled, against independent finite elements."""
    from tacsim.config import load_scene

    shape = "body.geometry={shape: cylinder, radius: 5 mm, height: 10 mm}"
    world = make_world(load_scene("squeeze", [f"preset={preset}", shape]))
    return [_closed(world, by, repeat) for by in CYLINDER]


def _closed(world: World, by: float, repeat: int) -> Measurement:
    """Closes the sensors of `world` until they are `by` [m] nearer to one another than at first touch."""
    before, (force, height) = world.snapshot(), CYLINDER[by]
    step = float((world.pose("upper").position - world.pose("lower").position)[2]) - (HEIGHT - by)

    def run() -> MoveStats:
        world.restore(before)
        return close(world, step)

    timing, stats = timed(run, repeat, warm=lambda: None)
    found, truth = float(normal_forces(world).mean()), world.truth()
    assert truth is not None
    figures = {"force_n": found, "truth_n": force, "height_error_percent": (truth.height / height - 1) * 100}
    return Measurement(
        timing, abs(found / force - 1) * 100, "% of force", "axisymmetric finite elements, 0.25 mm",
        f"closed by {by * 1e3:g} mm", stats.substeps, figures, "" if stats.settled else "not settled",
    )  # fmt: skip


CASES = tuple(
    Case("squeeze", "cylinder", "tacsim", words, partial(cylinder, preset), long=preset == "standard")
    for preset, words in PRESETS.items()
)
