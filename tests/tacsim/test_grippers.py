"""Grippers of a rig: commanded and stopped with the arms, seen in observations, encoded, recorded, replayed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from robot.rig.replay_rig import open_replay
from tacsim import (
    Action,
    ActionError,
    EpisodeMeta,
    GripperState,
    GripperTarget,
    IncompatibleRig,
    Needs,
    Recorder,
    RigConfig,
    RigSpec,
    SensorSpec,
)
from tacsim.gym.encode import flatten_observation
from tacsim.gym.features import FeatureEncoder
from tacsim.interface import Observation
from tacsim.limits import limit_gripper_target
from tacsim.models.policy import Features
from tacsim.models.sensor import CanonicalGrid
from tacsim.rig import Rig
from tests.tacsim.record.conftest import random_step
from tests.tacsim.test_rig import Parts, make_rig

GRIP = GripperTarget(0.0, 5.0)


class Hand:
    """A gripper that notes what it is asked."""

    width_range, force_range = (0.0, 0.085), (2.0, 40.0)

    def __init__(self, log: list[str]) -> None:
        self.log, self.width = log, 0.085

    def state(self) -> GripperState:
        return GripperState(self.width, 0.0, 0.5)

    def command(self, target: GripperTarget | None) -> GripperTarget | None:
        self.log.append(f"grip {target}")
        return None if target is None else limit_gripper_target(target, self.width_range, self.force_range)

    def stop(self) -> None:
        self.log.append("hand stops")

    def recover(self) -> None: ...

    def close(self) -> None:
        self.log.append("hand closes")


def rig_with_hand() -> tuple[Rig, list[str]]:
    parts = Parts()
    return make_rig(parts, grippers={"hand": Hand(parts.log)}), parts.log


def test_a_step_commands_the_gripper_and_reports_what_was_sent() -> None:
    rig, log = rig_with_hand()
    observation, _ = rig.step(Action({}, {"hand": GripperTarget(0.2, 1.0)}))
    assert rig.sent_grippers == {"hand": GripperTarget(0.085, 2.0)}  # brought within its ranges
    assert observation.grippers == {"hand": GripperState(0.085, 0.0, 0.5)}
    assert log.index("grip GripperTarget(width=0.2, force=1.0)") < log.index("tick")
    rig.step(Action())
    assert "grip None" in log and "hand stops" not in log and rig.sent_grippers == {"hand": None}
    rig.close()
    assert log.index("hand stops") < log.index("hand closes")


@pytest.mark.parametrize(
    ("grippers", "message"),
    [
        ({"foot": GRIP}, "gripper 'foot', but rig 'bench' has only the grippers: hand"),
        ({"hand": 5.0}, "must be a tacsim.GripperTarget"),
        ({"hand": GripperTarget(0.0, float("nan"))}, "finite and not negative"),
        ({"hand": GripperTarget(-1e-3, 1.0)}, "finite and not negative"),
        ({"hand": GripperTarget("0", 1.0)}, "finite and not negative"),  # type: ignore[arg-type]
        ([GRIP], "must map names of grippers"),
    ],
)
def test_an_action_that_a_gripper_cannot_take_moves_nothing(grippers: Any, message: str) -> None:
    rig, log = rig_with_hand()
    with pytest.raises(ActionError, match=message):
        rig.step(Action({}, grippers))
    assert "tick" not in log and not any(each.startswith("grip") for each in log)


def test_needs_name_the_gripper_that_is_missing() -> None:
    rig, _ = rig_with_hand()
    rig.require(Needs(grippers=frozenset({"hand"})), "a task")
    with pytest.raises(IncompatibleRig, match=r"lacks gripper 'left'\. It has .*grippers hand"):
        rig.require(Needs(grippers=frozenset({"left"})), "a task")


def test_learning_code_sees_width_and_force() -> None:
    def seen(force: float | None) -> Observation:
        return Observation({}, {}, 0.0, {"hand": GripperState(0.04, force, 0.0)})

    assert flatten_observation(seen(5.0), {})["grip_hand"] == pytest.approx([0.04, 5.0])
    assert flatten_observation(seen(None), {})["grip_hand"] == pytest.approx([0.04])
    encoder = FeatureEncoder(
        Features(sensors=(), arms=(), grippers=("hand",), maps=(), touch=("grip",), goal=False), CanonicalGrid()
    )
    assert encoder.needs == Needs(grippers=frozenset({"hand"}))
    assert encoder.inputs["touch"].names == ("width_hand", "grip_force_hand")
    assert encoder.begin(seen(5.0))["touch"] == pytest.approx([2.0, 0.5])
    with pytest.raises(IncompatibleRig, match="does not measure"):
        encoder(seen(None))
    with pytest.raises(ValueError, match="name some"):
        Features(touch=("grip",))


def test_a_recorded_gripper_is_replayed(tmp_path: Path) -> None:
    path, steps = tmp_path / "grips.mcap", [random_step(index, grid=(64, 64)) for index in range(3)]
    sensors = {
        name: SensorSpec((24, 32), height=name != "side", flow=name == "lower", arm=None) for name in steps[0].frames
    }
    spec = RigSpec(sensors, ("lower", "upper"), truth=False, period=0.1, grippers=("hand", "foot"))
    with Recorder(path, EpisodeMeta("sim", None, "random", 0, spec, {})) as recorder:
        for step in steps:
            recorder.write(step)
    rig_file = RigConfig.model_validate(
        {
            "name": "recorded",
            "clock": "replay",
            "arms": {},
            "grippers": {"hand": {"driver": "replay", "source": str(path)}, "none": {"driver": "replay"}},
            "sensors": {"lower": {"driver": "replay", "source": str(path), "gripper": "hand"}},
        }
    )
    with open_replay(rig_file) as rig:
        assert rig.spec.grippers == ("hand",) and rig.spec.sensors["lower"].gripper == "hand"
        rig.reset()
        for before in steps[:2]:
            state = rig.observe().grippers["hand"]
            assert (state.width, state.force) == (before.grippers["hand"].width, before.grippers["hand"].force)
            rig.step(Action({}, {"hand": GRIP}))
            assert rig.sent_grippers == {"hand": None}


@pytest.mark.parametrize(
    ("sensor", "message"),
    [({"gripper": "foot"}, "no gripper 'foot'; allowed: hand"), ({"gripper": "hand", "arm": "a"}, "leave out `arm`")],
)
def test_a_sensor_names_one_carrier_that_is_there(sensor: dict[str, str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RigConfig.model_validate(
            {
                "name": "wrong",
                "clock": "replay",
                "arms": {"a": {"driver": "replay"}},
                "grippers": {"hand": {"driver": "replay", "arm": "a"}},
                "sensors": {"left": {"driver": "replay", **sensor}},
            }
        )


def test_a_gripper_names_an_arm_that_is_there() -> None:
    with pytest.raises(ValueError, match="no arm 'b'"):
        RigConfig.model_validate(
            {
                "name": "wrong",
                "clock": "replay",
                "grippers": {"hand": {"driver": "replay", "arm": "b"}},
                "sensors": {"left": {"driver": "replay"}},
            }
        )
