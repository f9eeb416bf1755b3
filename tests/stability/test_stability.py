"""Hard cases: each ends in a sound state or in our own exception, and no case ends the process.

Where physics has a known weakness, the test says so and asserts what comes out today.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

# The worker process is handed sys.path and finds these modules by name.
sys.path.insert(0, str(Path(__file__).parent))
from case_run import Outcome
from case_worker import CaseDied, Worker
from hard_cases import CASES

Config = dict[str, float]
LONG = {"loaded rest, long": 600, "unstressed rest, long": 400, "unstressed rest, long, press": 100}  # [s]
SECONDS = 60.0
# One for each way to fail, in `make test`; all others are deep.
USUAL = {
    ("elastic, nu 0.499, to half", "hybrid"),  # nearly incompressible, large strain
    ("plasticine, k 0.05, to a fifth", "hybrid"),  # large plastic strain
    ("hardly any yield stress", "hybrid"),  # a liquid
    ("one layer of particles", "hybrid"),  # refused
    ("gel to a tenth, plate", "press"),  # elements crushed
    ("impact, press", "press"),  # fast, in real time
    ("flow, back and forth, fast", "hybrid"),  # accelerations between motions
    ("sensor through the body", "hybrid"),  # gels in one another
    ("indenter through the gel", "press"),  # speed limit
    ("step limit violated, press", "press"),  # time step too long: retries
    ("a NaN on the way", "hybrid"),  # rollback, then success
    ("NaNs all the way, press", "press"),  # rollback after all retries
    ("infinite velocity", "seed"),  # the other scheme
    ("a particle far away", "hybrid"),  # no grid is large enough
}

pytestmark = pytest.mark.timeout(420)  # the first case of a process has 300 s on top, for kernels to be compiled


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    with Worker() as opened:
        yield opened


def even(f: Config) -> bool:
    return abs(f["force"] - f["upper force"]) <= 0.02 * abs(f["force"])


def balanced(f: Config) -> bool:
    return f["settled"] == 1 and even(f)


def held(f: Config) -> bool:
    """Comes to rest; as fast as these are driven, friction, or what yields, could not follow, and that is not called
    settled."""
    return f["residual"] <= 1e-2


def keeps(least: float, most: float) -> Callable[[Config], bool]:
    """Forces balance, and particles keep their volume within these ratios."""
    return lambda f: balanced(f) and least < f["least particle"] and f["most particle"] < most


def still(f: Config) -> bool:
    return f["drift"] == 0.0 and f["force"] == 0.0 and f["residual"] == 0.0


def released(f: Config, force: float, dent: float) -> bool:
    """After the third move sensors are free of force, up to `force` [N], and gels flat, up to `dent` [m]."""
    return f["force 3"] <= force and f["dent 3"] <= dent


def sliding_torque(force: float, friction: float, side: float) -> float:
    """mu F times the mean distance of a square's points from its middle, (sqrt 2 + asinh 1) / 6 of its side: what an
    even pressure bears when all of a face slides [N m]."""
    return friction * force * side * (math.sqrt(2) + math.asinh(1)) / 6


# Force of a ball 1.5 mm deep, 3 % beyond that without friction (1.73 N) and that of one that sticks (1.97 N): what
# slips on the way down depends on the speed, and an elastic gel forgets all else.
PRESSED = 1.68, 2.03
# Force of a cube of clay squeezed by 1 mm at Mach 0.001, to a tolerance of 1e-3 [N]
SLOWLY = 0.587

# What must come out, by case and physics: a judgement of the facts of a finite end, or a text of the error.
EXPECTED: dict[str, dict[str, Callable[[Config], bool] | str]] = {
    "elastic, nu 0.45, to half": {"hybrid": keeps(0.7, 1.1), "seed": keeps(0.4, 1.1)},
    "elastic, nu 0.49, to half": {"hybrid": keeps(0.85, 1.1), "seed": keeps(0.6, 1.2)},
    "elastic, nu 0.499, to half": {"hybrid": keeps(0.95, 1.05), "seed": keeps(0.8, 1.1)},
    # Two gels on one another with a film between: whether it rests within the budget hangs on a hair. Particles have
    # strains that no node feels, which is told.
    "plasticine, k 0.01, to a tenth": {
        "hybrid": lambda f: f["least particle"] > 0.3 and f["most particle"] < 1.5 and f["guard_hits"] > 0,
        "seed": keeps(0.2, 1.2),
    },
    "plasticine, k 0.05, to a fifth": {"hybrid": keeps(0.5, 1.3), "seed": keeps(0.3, 1.2)},
    # A liquid: it flows away from the gels, and bears next to nothing.
    "hardly any yield stress": {"hybrid": lambda f: f["force"] < 1e-3, "seed": lambda f: f["force"] < 0.2},
    "body 10,000 times stiffer": {
        "hybrid": lambda f: balanced(f) and f["height"] == pytest.approx(4e-3, rel=2e-3),
        "seed": lambda f: balanced(f) and f["height"] == pytest.approx(4e-3, rel=1e-3),
    },
    "gel 10,000 times stiffer": {
        "hybrid": lambda f: balanced(f) and f["least element"] > 0.9999,
        "seed": balanced,
    },
    # Half of the gel is borne, nine tenths are not.
    # Which limit is met first, an element crushed or a node thrown, hangs on a hair; so it does 3 mm deep in a punch.
    "gel to a tenth, plate": {"press": "of the lower gel"},
    "gel to a tenth, punch": {"press": "of the lower gel"},
    "one layer of particles": dict.fromkeys(("hybrid", "seed"), "a body needs 3"),
    "scene of 10 mm": {"hybrid": balanced, "seed": balanced},
    # Forces scale with length^2: against 0.521 N, that of the scene of 10 mm driven at Mach 0.003.
    "scene of 0.1 mm": {
        "hybrid": lambda f: f["force"] == pytest.approx(0.521e-4, rel=0.1),
        "seed": lambda f: balanced(f) and f["force"] == pytest.approx(0.528e-4, rel=0.02),
    },
    "scene of 1 m": {
        "hybrid": lambda f: balanced(f) and f["retries"] == 0 and f["force"] == pytest.approx(0.521e4, rel=0.1),
        "seed": lambda f: balanced(f) and f["retries"] == 0 and f["force"] == pytest.approx(0.528e4, rel=0.02),
    },
    # A tip and an edge go as deep into the surface as a half-space gives way between two nodes, 1 mm apart here.
    # Its tip lies between contact points 0.33 mm apart: seen from 1 mm deep on.
    "sharp cone": {"press": "no contact point more than"},
    "sharp cone, deep": {"press": lambda f: f["least element"] > 0.5},
    "Mach 0.3": {"hybrid": lambda f: held(f) and even(f) and f["settled"] == 0, "seed": balanced},
    "Mach 0.3, press": {"press": lambda f: held(f) and PRESSED[0] < f["force"] < PRESSED[1]},
    # The gels give half of the 3 mm; a body without yield springs back.
    "impact, elastic": {"hybrid": lambda f: keeps(0.9, 1.05)(f) and f["height"] > 3.4e-3},
    "impact, plastic": {"hybrid": lambda f: keeps(0.9, 1.05)(f) and f["height"] < 3.0e-3},
    # As deep as at Mach 0.3 above.
    "impact, press": {"press": lambda f: f["settled"] == 1 and PRESSED[0] < f["force"] < PRESSED[1]},
    # However fast it came there: an elastic gel forgets its way, and the body remembers little of it.
    "flow, back and forth": {"hybrid": lambda f: keeps(0.9, 1.05)(f) and f["force"] == pytest.approx(0.46, rel=0.05)},
    "flow, back and forth, fast": {
        "hybrid": lambda f: keeps(0.9, 1.05)(f) and f["force"] == pytest.approx(0.46, rel=0.05)
    },
    "flow, back and forth, press": {
        "press": lambda f: f["settled"] == 1 and f["force"] == pytest.approx(0.293, rel=0.01)
    },
    "flow, back and forth, fast, press": {
        "press": lambda f: f["settled"] == 1 and f["force"] == pytest.approx(0.293, rel=0.01)
    },
    # By symmetry the body goes half of the upper sensor's 3 mm.
    "yield and slide": {
        "hybrid": lambda f: held(f) and even(f) and f["x"] == pytest.approx(1.5e-3, rel=0.2),
        "seed": lambda f: balanced(f) and f["x"] == pytest.approx(1.5e-3, rel=0.2),
    },
    # There is no contact between gels in hybrid.
    "sensor through the body": {"hybrid": "mm; there is no contact between gels", "seed": balanced},
    "indenter through the gel": {"press": "is inverted or crushed"},
    "body over the rim": {
        "hybrid": lambda f: balanced(f) and f["force"] == pytest.approx(0.635, rel=0.05),
        "seed": balanced,
    },
    # the slow limit (Mach 0.004) is 0.405
    "body over the rim, no housing": {"hybrid": lambda f: balanced(f) and f["force"] == pytest.approx(0.405, rel=0.03)},
    # In between, nothing is left of the first grasp but what has flown; then it is met again.
    "release and grasp again": {
        "hybrid": lambda f: (
            balanced(f) and released(f, 0.0, 1e-6) and f["force"] == pytest.approx(f["force 2"], rel=0.015)
        ),
        # Known weakness: a third more, after the grid has got other layers while the sensors parted.
        "seed": lambda f: balanced(f) and released(f, 1e-3, 20e-6) and 1.0 < f["force"] / f["force 2"] < 1.5,
    },
    # 60 degrees: it slides, and bears what friction can.
    "twist": {
        "hybrid": lambda f: (
            balanced(f)
            and f["torque"] == pytest.approx(sliding_torque(f["force"], 0.6, 4e-3), rel=0.1)
            and f["upper torque"] == pytest.approx(f["torque"], rel=0.02)  # opposite in world, and so are the z axes
        ),
        "seed": lambda f: balanced(f) and f["torque"] > 1e-4,  # it knows no friction: the gels stick
    },
    # More than a flat face bears: edges and corners plough.
    "twist, press": {
        "press": lambda f: (
            held(f) and f["overlap"] < 150e-6 and 1 < f["torque"] / sliding_torque(f["force"], 0.6, 4e-3) < 2
        )
    },
    "unstressed rest": {"hybrid": still},
    "unstressed rest, short": {"seed": still},
    "unstressed rest, press": {"press": still},
    "unstressed rest, long": {"hybrid": still, "seed": still},
    "unstressed rest, long, press": {"press": still},
    "loaded rest": {"hybrid": lambda f: balanced(f) and f["drift"] < 3e-6},
    "loaded rest, short": {"seed": lambda f: balanced(f) and f["drift"] < 10e-6},
    "loaded rest, long": {"hybrid": lambda f: balanced(f) and f["drift"] < 10e-6},
    # With friction a rigid indenter creeps sideways in the gel, some 3 um in 400 substeps (without: 0.1 um).
    "loaded rest, press": {"press": lambda f: f["settled"] == 1 and f["drift"] < 30e-6},
    "step limit kept": {
        "hybrid": lambda f: balanced(f) and f["force"] == pytest.approx(SLOWLY, rel=0.02),
        "seed": balanced,
    },
    "step limit kept, press": {"press": lambda f: f["retries"] == 0},
    # forces as with the usual step
    "short steps": {
        "hybrid": lambda f: balanced(f) and f["force"] == pytest.approx(SLOWLY, rel=0.02),
        "seed": lambda f: balanced(f) and f["force"] == pytest.approx(0.581, rel=0.05),
    },
    "short steps, press": {"press": lambda f: f["retries"] == 0 and f["force"] == pytest.approx(0.611, rel=0.02)},
    "step limit violated": dict.fromkeys(("hybrid", "seed"), lambda f: balanced(f) and f["retries"] > 0),
    "step limit violated, press": {"press": lambda f: held(f) and f["retries"] > 0},
    "NaN in position": dict.fromkeys(("hybrid", "seed"), "position[0, 0] is nan"),
    "NaN in velocity": dict.fromkeys(("hybrid", "seed"), "velocity[0, 0] is nan"),
    "NaN in strain": {"hybrid": "strain[0, 0] is nan"},
    "NaN in gel_displacement": {"hybrid": "node [0, 0, 0] of the lower gel, (-5.000, -5.000, -4.000) mm"},
    "NaN in deformation_gradient": {"seed": "deformation_gradient[0, 0, 0] is nan at particle 0"},
    "NaN in stress": {"seed": "stress[0, 0, 0] is nan at particle 0"},
    "NaN in gel_velocity": {"press": "node [0, 0, 0] of the lower gel"},
    "infinite velocity": dict.fromkeys(("hybrid", "seed"), "velocity[0, 0] is inf"),
    "a NaN on the way": dict.fromkeys(("hybrid", "seed"), lambda f: held(f) and even(f) and f["retries"] == 1),
    "a NaN on the way, press": {"press": lambda f: held(f) and f["retries"] == 1},
    "NaNs all the way": dict.fromkeys(("hybrid", "seed"), "1/4 of the time step"),
    "NaNs all the way, press": {"press": "1/4 of the time step"},
    "a particle far away": {"hybrid": "spread over 1e+05", "seed": lambda f: f["guard_hits"] == 1},
}

PAIRS = [
    pytest.param(
        name,
        physics,
        marks=[] if (name, physics) in USUAL else [pytest.mark.deep, pytest.mark.timeout(LONG.get(name, 420))],
        id=f"{name}-{physics}",
    )
    for name, case in CASES.items()
    for physics in case.physics
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "physics"), PAIRS)
def test_hard_case(worker: Worker, name: str, physics: str) -> None:
    outcome = worker.run(name, physics, LONG.get(name, SECONDS))
    expected = EXPECTED[name][physics]
    if callable(expected):
        assert outcome.kind == "finite", outcome
        assert expected(outcome.figures), outcome.figures
    else:
        assert outcome.kind in ("diverged", "refused"), outcome
        assert expected in outcome.words
        assert "wave speed" in outcome.words or "mm" in outcome.words  # says where


@pytest.fixture(scope="module")
def outcomes(worker: Worker) -> Callable[[str, str], Outcome]:
    return lambda name, physics: worker.run(name, physics, SECONDS)


@pytest.mark.parametrize(
    ("name", "physics", "tolerance"),
    [
        ("step limit {}, press", "press", 0.06),
        pytest.param("step limit {}", "hybrid", 0.01, marks=pytest.mark.deep),
        pytest.param("step limit {}", "seed", 0.04, marks=pytest.mark.deep),
    ],
)
def test_a_step_beyond_the_limit_changes_no_result(
    outcomes: Callable[[str, str], Outcome], name: str, physics: str, tolerance: float
) -> None:
    """A press: its springs are as soft as the constant, patched here, says; a shorter step alone leaves them so."""
    kept, violated = (outcomes(name.format(how), physics).figures for how in ("kept", "violated"))
    assert violated["force"] == pytest.approx(kept["force"], rel=tolerance)


@pytest.mark.deep
def test_a_case_that_kills_the_process_fails_alone() -> None:
    with Worker(start=0.0) as worker:
        with pytest.raises(CaseDied, match=r"'death' with physics 'press' ended the process \(exit code"):
            worker.run("death", "press", SECONDS)
        assert worker.deaths == 1
        with pytest.raises(CaseDied, match="took more than 2 s"):
            worker.run("endless", "press", 2.0)
        with pytest.raises(AssertionError, match="KeyError: 'no such case'"):
            worker.run("no such case", "press", SECONDS)
        assert worker.deaths == 2


def test_no_case_ended_the_process(worker: Worker) -> None:
    """Runs last, after all cases of `make test`."""
    assert worker.deaths == 0
