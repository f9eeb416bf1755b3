"""Policies that go wrong over mock arms, in the middle of an episode: the arms hold, and the error says why."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from robot.arm.status import ArmStatus
from robot.deploy.control_loop import EpisodeFailed, EpisodeSetup, run_episode
from robot.deploy.onnx_policy import OnnxPolicy
from tacsim.gym.features import FeatureEncoder
from tacsim.interface import Action, Needs, Observation, Pose
from tacsim.models.policy import ActionAxis, Features, PolicySpec
from tacsim.models.sensor import CanonicalGrid
from tests.robot.rig.bare_rig import Opened, bare_file, opened
from tests.robot.waiting import until

pytestmark = pytest.mark.usefixtures("no_pause")
STEP = 0.2e-3  # of one arm along the world's z, away from the other [m]


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Opened]:
    with opened(bare_file(tmp_path_factory.mktemp("bare"))) as found:
        yield found


class GoingWrong:
    """Moves an arm for three steps, then does what it should not."""

    needs = Needs()

    def __init__(self, wrong: Callable[[Observation], Any], arm: str = "right") -> None:
        self._wrong, self._arm, self.calls = wrong, arm, 0

    def reset(self) -> None: ...

    def __call__(self, observation: Observation) -> Any:
        self.calls += 1
        if self.calls > 3:
            return self._wrong(observation)
        now = observation.arms[self._arm].pose
        return Action({self._arm: Pose(now.position + [0.0, 0.0, STEP], now.quaternion)})


def no_number(observation: Observation) -> Action:
    now = observation.arms["right"].pose
    return Action({"right": Pose(now.position * np.nan, now.quaternion)})


def bug(observation: Observation) -> Action:
    raise KeyError("finger")


def leaves(observation: Observation) -> Action:
    raise SystemExit(3)


def rests(rig: Opened) -> None:
    """The arms stand, and go on standing."""
    arms = rig.rig.arms

    def slow() -> bool:
        return all(np.abs(arm.state().twist[:3]).max() < 1e-4 for arm in arms.values())

    until(slow, "arms at rest")
    before = {name: arm.state().pose.position for name, arm in arms.items()}
    time.sleep(0.1)
    for name, arm in arms.items():
        assert arm.state().pose.position == pytest.approx(before[name], abs=20e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (no_number, r"policy 'mine' raised ValueError: Pose.position must be 3 finite numbers"),
        (bug, r"policy 'mine' raised KeyError: 'finger'"),
        (leaves, r"policy 'mine' raised SystemExit: 3"),
        (lambda seen: np.zeros(2), r"ActionError: rig 'bare' takes a tacsim.Action, got ndarray"),
        (lambda seen: Action({"finger": None}), r"ActionError: action for 'finger', but rig 'bare' moves only"),
        (lambda seen: Action({"right": np.zeros(7)}), r"ActionError: .* must be a tacsim.Pose or None"),  # type: ignore[dict-item]
    ],
)
def test_bad_policy_holds_arms_and_names_error(shared: Opened, wrong: Callable[[Observation], Any], words: str) -> None:
    with pytest.raises(EpisodeFailed, match=words) as failed:
        run_episode(shared.rig, GoingWrong(wrong), None, 9, setup=EpisodeSetup("mine"))
    assert "ended after 3 of 9 steps" in str(failed.value)
    if "policy 'mine'" in words:
        assert "the arms hold" in str(failed.value) and "test it in simulation" in str(failed.value)
    assert len(failed.value.episode.steps) == 4
    rests(shared)
    shared.rig.reset()  # nothing else is in the way of the next episode


@pytest.mark.slow
def test_policy_with_nan_output_moves_no_arm(shared: Opened, tmp_path: Path) -> None:
    """It gives 0 / 0 from the first step on."""
    features = Features(sensors=(), arms=("left", "right"), maps=(), touch=("wrench",), goal=False)
    spec = PolicySpec(
        task="squeeze",
        period=0.05,
        features=features,
        inputs=FeatureEncoder(features, CanonicalGrid()).inputs,
        axes=(ActionAxis(arm="right", direction=(0, 0, 1)),),
        max_step=STEP,
    )
    nodes = [
        helper.make_node("Gemm", ["touch", "weights"], ["nothing"]),
        helper.make_node("Div", ["nothing", "nothing"], ["action"]),
    ]
    made = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("touch", TensorProto.FLOAT, (1, 12))],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, (1, 1))],
        [numpy_helper.from_array(np.zeros((12, 1), np.float32), "weights")],
    )
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    helper.set_model_props(model, {"tacsim.spec": spec.model_dump_json()})
    onnx.save(model, tmp_path / "nothing.onnx")
    policy = OnnxPolicy(tmp_path / "nothing.onnx", CanonicalGrid(), None)
    with pytest.raises(EpisodeFailed, match=r"an action has 1 finite numbers .* train or export it again") as failed:
        run_episode(shared.rig, policy, None, 9, setup=EpisodeSetup("nothing.onnx"))
    assert len(failed.value.episode.steps) == 1
    rests(shared)


@pytest.mark.slow
def test_slow_policy_holds_arm_then_continues(tmp_path: Path) -> None:
    with opened(bare_file(tmp_path, first=43), action_timeout=0.3) as rig:
        arm = rig.rig.arms["east"]
        explanations: list[str] = []

        def think(observation: Observation) -> Action:
            if not explanations:
                until(lambda: arm.driver.status() == ArmStatus.HOLD, "the arm holds")  # type: ignore[attr-defined]
                explanations.append(arm.driver.explain())  # type: ignore[attr-defined]
                rests(rig)
            now = arm.state().pose
            return Action({"east": Pose(now.position + [0.0, 0.0, STEP], now.quaternion)})

        episode = run_episode(rig.rig, GoingWrong(think, "east"), None, 6, setup=EpisodeSetup("slow"))
        assert len(episode.steps) == 7
        assert "no fresh action" in explanations[0]
        heights = [step.arms["east"].pose.position[2] for step in episode.steps]
        assert 0 < heights[-1] - heights[0] < 6.5 * STEP
