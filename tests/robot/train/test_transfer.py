"""The same policies on both sides of the gap: how a twin differs, what a killed study keeps, what the table says."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot.deploy.python_policy import FunctionPolicy
from robot.fixtures import rig_addresses
from robot.mock.cell.cell import MockCell, _actual_frames
from robot.mock.cell.sim_server import SceneFrame
from robot.open import open_rig
from robot.train import transfer
from robot.train.transfer import (
    EpisodeResult,
    Side,
    Study,
    _load_rig,
    draw_figure,
    label_policies,
    play_study,
    summarise,
)
from tacsim.config import load_model, load_rig
from tacsim.interface import Action, Observation, Pose
from tacsim.models.hardware import UrArmConfig
from tacsim.models.mujoco import MujocoArmConfig, MujocoSensorConfig
from tacsim.models.randomisation import Randomisation
from tests.robot.cli.invoked import tacsim
from tests.robot.rig.test_hardware_rig_simulated import SMALL, TINY
from tests.tacsim.gym.small import SMALL as TINY_GELS

TWIN = {
    "task.goal": {"uniform": ["3.3 mm", "3.6 mm"]},
    "scene.body.geometry.size": {"uniform": [["3.8 mm", "3.8 mm", "4 mm"], ["4 mm", "4 mm", "4.2 mm"]]},
    "scene.body.material.yield_stress": {"log_uniform": ["6 kPa", "20 kPa"]},
    "arms.lower.mock.error.position": {"choice": [["0.2 mm", "-0.1 mm", "0"]]},
    "sensors.upper.mock.delay": {"choice": [1]},
}
TWINS = Randomisation.model_validate({"draws": 8, "values": TWIN})


def study(**changed: Any) -> Study:
    whole: dict[str, Any] = {
        "task": "squeeze", "policies": ("scripted", "grip"), "twins": TWINS, "episodes": 5,
        "episodes_per_hidden_rig": 2, "steps": 2, "overrides": (),
    }  # fmt: skip
    return Study(**{**whole, **changed})


def test_load_rig_simulation_has_visible_parameters_of_twin() -> None:
    twin, simulation = (_load_rig(study(), side, 1, 3).config for side in ("twin", "simulation"))
    assert twin.task is not None and simulation.task is not None and twin.scene is not None
    assert simulation.scene is not None and twin.scene.body is not None and simulation.scene.body is not None
    assert twin.task.goal == simulation.task.goal  # type: ignore[attr-defined]
    assert twin.scene.body.geometry == simulation.scene.body.geometry
    usual = load_rig("sim", task="squeeze").config.scene
    assert usual is not None and usual.body is not None
    assert simulation.scene.body.material == usual.body.material != twin.scene.body.material
    same, other = (_load_rig(study(), "twin", 1, number).config for number in (3, 2))
    assert same == twin and other.scene is not None
    assert other.scene.body == twin.scene.body and other.task.goal != twin.task.goal  # type: ignore[union-attr]


def test_load_rig_learned_policy_uses_training_simulation() -> None:
    twin, own = (_load_rig(study(), side, 1, 3, "learned").config for side in transfer.SIDES[::-1])
    assert own.scene is not None and own.scene.body is not None and own.task is not None and twin.scene is not None
    assert own.scene.preset == "learn" and own.motion == "flowing" and twin.scene.preset == "draft"
    assert own.scene.body.geometry == twin.scene.body.geometry  # type: ignore[union-attr]
    assert own.task.goal == twin.task.goal  # type: ignore[attr-defined, union-attr]
    other = _load_rig(study(), "simulation", 1, 2, "learned").config
    assert other.scene is not None and other.scene.body is not None
    assert other.scene.body.material != own.scene.body.material  # which its training draws


def test_load_rig_shipped_twin_fits_both_rigs() -> None:
    for side in transfer.SIDES:
        for number in range(3):
            config = _load_rig(study(twins=load_model(Randomisation, "squeeze-twin")), side, number, number).config
            assert config.scene is not None
            assert config.scene.preset == ("standard" if side == "twin" else "draft")


@pytest.mark.parametrize("task", ["hold", "turn", "drawer"])
def test_the_twin_of_a_hand_is_another_hand(task: str) -> None:
    held = study(task=task, policies=("learned",), twins=load_model(Randomisation, f"{task}-twin"))
    assert (held.rig("simulation"), held.rig("twin"), study().rig("twin")) == ("hand", "hand", "mock")
    hidden, own = (_load_rig(held, side, 1, 3, "learned").config for side in transfer.SIDES[::-1])
    assert own.motion == "flowing" and hidden.motion == "dynamic"  # that of its training, and the rig's
    assert hidden.scene is not None and own.scene is not None and hidden.scene.object is not None
    assert own.scene.object is not None
    own_grip = own.scene.object.grip[2]  # of hold and drawer drawn by their trainings, too
    assert 0.0 != hidden.scene.object.grip[2] != own_grip and (own_grip != 0.0) == (task != "turn")
    assert getattr(hidden.task, "goal", None) == getattr(own.task, "goal", None)
    for name in ("left", "right"):
        seen, usual = (each.sensors[name] for each in (hidden, own))
        assert isinstance(seen, MujocoSensorConfig) and isinstance(usual, MujocoSensorConfig)
        assert (seen.surface, usual.surface) == ("picture", "gel")
        assert seen.model.lighting != usual.model.lighting and usual.model.noise is None is not seen.model.noise
    arm = hidden.arms["hand"]
    assert isinstance(arm, MujocoArmConfig) and any(arm.error.position)


@pytest.mark.slow
def test_a_study_of_a_hand_plays_both_sides(tmp_path: Path) -> None:
    values = {"scene.object.mass": {"choice": [0.05]}, "sensors.left.delay": {"choice": [1]}}
    held = study(
        task="hold", policies=("learned", "scripted"), episodes=1, episodes_per_hidden_rig=1,
        overrides=("motion=flowing",),
        twins=Randomisation.model_validate({"draws": 1, "values": values}),
    )  # fmt: skip
    reported: list[str] = []
    rows = play_study(held, tmp_path, lambda words, done, of: reported.append(words))
    assert [(row.policy, row.side, row.error) for row in rows] == [
        (policy, side, "") for policy in held.policies for side in transfer.SIDES
    ]
    assert len(reported) == 4 and all("% from the goal, not reached" in words for words in reported)
    hidden = next(row for row in rows if (row.policy, row.side) == ("scripted", "twin"))
    assert hidden.distance == pytest.approx(0.92**2 * 8.0 * 2 * 0.6 / (0.05 * 9.81) - 1.25, rel=0.02)  # after two steps


def test_twin_sensor_pose_error_is_applied() -> None:
    arm = load_rig("mock").config.arms["lower"]
    assert isinstance(arm, UrArmConfig) and arm.mock is not None
    error = {"position": (1e-4, 0.0, 0.0)}
    shifted = UrArmConfig.model_validate(arm.model_dump() | {"mock": {"error": error}})
    one, other = _actual_frames(arm), _actual_frames(shifted)
    moved = other.tool_from_sensor[:3, 3] - one.tool_from_sensor[:3, 3]
    assert moved == pytest.approx(-one.tool_from_sensor[:3, 0] * 1e-4)  # it believes to be further along its own x


def test_twin_late_pictures_show_previous_motion() -> None:
    class Camera:
        def __init__(self) -> None:
            self.shown: list[int] = []

        def push(self, image: np.ndarray) -> int:
            self.shown.append(int(image[0, 0, 0]))
            return len(self.shown)

    cell = MockCell.__new__(MockCell)
    prompt, late = Camera(), Camera()
    cell.cameras = {"prompt": prompt, "late": late}  # type: ignore[dict-item]
    cell._delays, cell._late, cell._pushed, cell._sensor_on = {"prompt": 0, "late": 1}, {}, {}, {}
    for number in (5, 6, 7):
        image = np.full((2, 2, 3), number, np.uint8)
        cell._distribute(SceneFrame(0, 0.0, {"prompt": image, "late": image}, {}, {}, None, {}, 0.0))
    assert prompt.shown == [5, 6, 7]
    assert late.shown == [5, 6]  # the first one is shown until another has become old


def fake(study: Study, side: Side, twin: int, left: Sequence[tuple[str, int]]) -> Iterator[EpisodeResult]:
    for policy, number in left:
        yield EpisodeResult(policy, side, number, 1e-4 * (number + (side == "twin")), 1e-4 * number, number < 3, 1.0)


def test_play_study_killed_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transfer, "_play_on_hidden_rig", fake)
    reported: list[str] = []
    whole = play_study(study(), tmp_path, lambda words, done, of: reported.append(f"{done} of {of}, {words}"))
    assert reported[:2] == [
        "1 of 20, scripted, simulation: 0.000 mm from the goal",
        "2 of 20, scripted, simulation: 0.100 mm from the goal",
    ]
    assert reported[-1] == "20 of 20, grip, twin: 0.500 mm from the goal, not reached"
    assert [(each.policy, each.side, each.episode) for each in whole] == [
        (policy, side, n) for policy in ("scripted", "grip") for side in ("simulation", "twin") for n in range(5)
    ]
    path = tmp_path / transfer.ROWS_FILE
    lines = path.read_text().splitlines()
    assert len(lines) == 20
    path.write_text("\n".join(lines[:7]) + "\n" + lines[7][:30])  # killed while it wrote
    asked: list[tuple[str, int]] = []

    def rest(study: Study, side: Side, twin: int, left: Sequence[tuple[str, int]]) -> Iterator[EpisodeResult]:
        asked.extend(left)
        return fake(study, side, twin, left)

    monkeypatch.setattr(transfer, "_play_on_hidden_rig", rest)
    assert play_study(study(), tmp_path, lambda *_: None) == whole
    assert len(asked) == 13
    assert play_study(study(), tmp_path, lambda *_: None) == whole
    assert len(asked) == 13  # the repaired file is complete
    more = play_study(study(policies=("third", "grip")), tmp_path, lambda *_: None)
    assert [each for each in more if each.policy == "grip"] == whole[10:] and len(more) == 20
    assert len(asked) == 23 and all(policy == "third" for policy, _ in asked[13:])
    with pytest.raises(ValueError, match="has a study with other settings; give another folder"):
        play_study(study(steps=3), tmp_path, lambda *_: None)


def test_play_study_interrupted_episode_is_not_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(observation: Observation) -> Action:
        raise KeyboardInterrupt

    monkeypatch.setattr(transfer, "load_policy", lambda *_: FunctionPolicy(interrupted))
    monkeypatch.setattr(transfer, "_load_rig", lambda *_: load_rig("sim", overrides=TINY_GELS))
    with pytest.raises(KeyboardInterrupt):
        play_study(study(policies=("mine",)), tmp_path, lambda *_: None)
    assert (tmp_path / transfer.ROWS_FILE).read_text() == ""


def test_a_twin_that_cannot_begin_counts_as_not_reached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out_of_reach = [*TINY_GELS, "task.goal=9 mm"]  # the body is lower
    monkeypatch.setattr(transfer, "_load_rig", lambda *_: load_rig("sim", task="squeeze", overrides=out_of_reach))
    rows = play_study(study(policies=("scripted",), episodes=2), tmp_path, lambda *_: None)
    assert [(row.distance, row.success) for row in rows] == [(None, False)] * 4
    assert all(row.error.startswith("did not begin: task.goal:") for row in rows)
    assert [row.failures for row in summarise(rows)] == [2, 2]


def test_summarise_gives_success_distance_and_agreement(tmp_path: Path) -> None:
    rows = [row for side in transfer.SIDES for row in fake(study(), side, 0, [("p", n) for n in range(5)])]
    rows.append(EpisodeResult("q", "twin", 0, None, None, False, 0.0, "no touch"))
    one, other, nothing = summarise(rows)
    assert (one.side, one.success.value, other.side) == ("simulation", 0.6, "twin")
    assert one.distance is not None and one.distance.value == pytest.approx(2e-4)
    assert other.agreement == pytest.approx(1e-4)
    assert (nothing.distance, nothing.agreement, nothing.failures) == (None, None, 1)
    draw_figure([one, other, nothing], tmp_path / "transfer.png")
    assert (tmp_path / "transfer.png").stat().st_size > 5000


def test_policies_of_one_file_name_have_labels_with_their_folders() -> None:
    assert label_policies(["scripted", "runs/flow.onnx"]) == ["scripted", "flow"]
    assert label_policies(["scripted", "/r/flow/policy.onnx", "r/depth/policy.onnx"]) == [
        "scripted", "flow/policy", "depth/policy"
    ]  # fmt: skip


@pytest.mark.deep
def test_twin_draws_pose_error_and_latency() -> None:
    words = ["arms.lower.mock.error.position=[0.2 mm, -0.1 mm, 0]", "sensors.upper.mock.delay=1"]
    with open_rig(
        "mock", task="squeeze", overrides=[*SMALL, *TINY, *rig_addresses(), "scene.preset=learn", *words]
    ) as rig:
        observation, truth = rig.reset(), rig.truth()
        assert truth is not None
        believed = {name: arm.pose.position for name, arm in observation.arms.items()}
        away = [believed[name] - truth.poses[name].position for name in ("lower", "upper")]
        assert away[0] == pytest.approx([0.2e-3, -0.1e-3, 0.0], abs=20e-6)
        assert away[1] == pytest.approx(np.zeros(3), abs=20e-6)
        before = rig.frames["upper"].image
        arms = observation.arms
        step = {"lower": 0.1e-3, "upper": -0.1e-3}
        rig.step(Action({n: Pose(arms[n].pose.position + [0, 0, z], arms[n].pose.quaternion) for n, z in step.items()}))
        late = np.abs(rig.frames["upper"].image.astype(int) - before).mean()
        rig.step(Action({}))
        now = np.abs(rig.frames["upper"].image.astype(int) - before).mean()
        assert now > 2 * late


@pytest.mark.deep
def test_transfer_command_writes_table_figure_and_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "twin.yaml").write_text(json.dumps({"draws": 2, "values": TWIN}))
    sets = [part for word in (*TINY, "scene.preset=learn") for part in ("--set", word)]
    words = ("transfer", "squeeze", "--policy", "scripted", "--twin", "twin.yaml", "--episodes", "2", "--steps", "2")
    for workers in ("2", "1"):  # the second time it reads
        result = tacsim(*words, "--workers", workers, "--out", "t", *sets)
        assert result.exit_code == 0, result.output
    assert "scripted" in result.stdout and "twin" in result.stdout
    rows = json.loads((tmp_path / "t" / "transfer.json").read_text())
    assert [(row["side"], row["failures"]) for row in rows] == [("simulation", 0), ("twin", 0)]
    assert (tmp_path / "t" / "transfer.png").exists()
