"""The task `relief`: depths of dents, and the policies that press them by touch."""

from types import SimpleNamespace

import numpy as np
import pytest

from tacsim import ArmState, Pose, Truth
from tacsim.geometry.shapes import lattice_particles
from tacsim.models.scene import Body, Box, Scene
from tacsim.models.task import ReliefConfig
from tacsim.tasks import GoalOutOfReach, make_task
from tacsim.tasks.relief import Relief
from tacsim.tasks.tuning import ONLY_EXCESS

SLAB = Box(size=(18e-3, 10e-3, 7e-3))


def relief(goal: tuple[float, float] = (0.6e-3, 0.4e-3), **changes: object) -> Relief:
    scene = Scene(body=Body(geometry=SLAB))
    task = make_task(ReliefConfig(kind="relief", goal=goal, scene=scene, **changes))  # type: ignore[arg-type]
    assert isinstance(task, Relief)
    return task


def slab(*dents: tuple[float, float]) -> Truth:
    """Of particles 0.5 mm apart; each dent: place along x, and how far all above half of the height has sunk [m]."""
    points = lattice_particles(SLAB, 0.5e-3)
    for place, depth in dents:
        points[(np.abs(points[:, 0] - place) < 3e-3) & (points[:, 2] > 0), 2] -= depth
    return Truth(7e-3, points.mean(axis=0), points.astype(np.float32), {})


def test_depths_are_those_of_the_top_at_the_places() -> None:
    task = relief()
    now = slab((-4.5e-3, 0.5e-3), (4.5e-3, 0.3e-3), (0.0, 0.0))
    assert task.depths(now, slab()) == pytest.approx([0.5e-3, 0.3e-3], abs=1e-8)
    assert task.distance(now, slab()) == pytest.approx(0.1e-3, abs=1e-8)
    assert task.measures(now, slab()) == pytest.approx({"depth_1": 0.5e-3, "depth_2": 0.3e-3}, abs=1e-8)


def test_the_distance_at_the_start_is_that_of_the_goal() -> None:
    assert relief((0.6e-3, 0.8e-3)).distance(slab(), slab()) == pytest.approx(np.sqrt(0.5) * 1e-3)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"places": (-9.5e-3, 1e-3)}, "9.5 mm is off the body, which is 18 mm long along x"),
        ({"goal": (3.6e-3, 1e-3)}, "less than half of the body's height, 7 mm"),
    ],
)
def test_dents_that_cannot_be_made(changes: dict[str, object], words: str) -> None:
    with pytest.raises(GoalOutOfReach, match=words):
        relief(**changes).require_reachable(slab())  # type: ignore[arg-type]


class SpringyClay:
    """Under a stiff gel: the first 0.1 mm of a press springs back, and `share` of the rest. The dents are apart."""

    def __init__(self, share: float) -> None:
        self._share = share
        self.top, self.position = 7e-3, np.array([0.0, 0.0, 7e-3])
        self.dents = {-1.0: 0.0, 1.0: 0.0}  # what would remain, by the side

    def observation(self) -> SimpleNamespace:
        side = float(np.sign(self.position[0])) or 1.0
        pressed = self.top - float(self.position[2])
        plastic = (1.0 - self._share) * max(0.0, pressed - 0.1e-3)
        self.dents[side] = max(self.dents[side], plastic)
        force = max(0.0, 1.5e3 * (pressed - self.dents[side]))
        arm = ArmState(Pose(self.position.copy()), np.zeros(6), np.array([0, 0, -force, 0, 0, 0]), None, 0.0)
        return SimpleNamespace(arms={"upper": arm})


@pytest.mark.parametrize("share", [0.35, 0.5, 0.7])
def test_the_scripted_policy_presses_until_enough_remains(share: float) -> None:
    task, clay = relief(), SpringyClay(share)
    policy = task.scripted()
    policy.reset()
    for _ in range(300):
        target = policy(clay.observation()).tool["upper"]  # type: ignore[arg-type]
        assert target is not None and np.abs(target.position - clay.position).max() <= task.config.max_step + 1e-12
        clay.position = np.array(target.position)
    assert list(clay.dents.values()) == pytest.approx(task.goal, abs=0.12e-3)
    assert clay.position[2] > clay.top  # it has let go


def test_the_analytic_rule_presses_each_dent_once() -> None:
    ends = []
    for share in (0.2, 0.7):
        clay = SpringyClay(share)
        policy = relief().analytic()
        policy.reset()
        for _ in range(300):
            target = policy(clay.observation()).tool["upper"]  # type: ignore[arg-type]
            assert target is not None
            clay.position = np.array(target.position)
        assert clay.position[2] > clay.top
        ends.append(clay.dents[-1.0])
    pressed = 0.6e-3 + ONLY_EXCESS - 0.05e-3  # from a light touch; 0.1 mm of it is elastic
    assert ends == pytest.approx([0.8 * pressed, 0.3 * pressed], rel=0.02)


def test_beside_the_clay_it_does_not_descend_without_end() -> None:
    class HalfOfTheClay(SpringyClay):
        def observation(self) -> SimpleNamespace:
            seen = super().observation()
            if self.position[0] > 0.0:
                seen.arms["upper"] = ArmState(Pose(self.position.copy()), np.zeros(6), np.zeros(6), None, 0.0)
            return seen

    clay = HalfOfTheClay(0.5)
    policy = relief().scripted()
    policy.reset()
    heights = []
    for _ in range(600):
        target = policy(clay.observation()).tool["upper"]  # type: ignore[arg-type]
        assert target is not None
        clay.position = np.array(target.position)
        heights.append(clay.position[2])
    assert min(heights) == pytest.approx(clay.top - 3.5e-3, abs=0.06e-3)  # half of the body's height


def test_through_the_goal_it_presses_on() -> None:
    clay = SpringyClay(0.5)
    policy = relief().scripted(through=True)
    policy.reset()
    for _ in range(100):
        target = policy(clay.observation()).tool["upper"]  # type: ignore[arg-type]
        assert target is not None
        clay.position = np.array(target.position)
    assert clay.position[2] < clay.top - 2e-3 - max(relief().goal)
