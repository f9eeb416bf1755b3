"""Rigs in MuJoCo from files: they grip, lift, drop, replay their bits, and say what is wrong."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from robot.deploy.control_loop import EpisodeFailed, run_episode
from robot.deploy.python_policy import FunctionPolicy
from robot.doctor import examine_rig
from robot.open import CannotOpen, make_env, make_vector_env, open_rig, rig_spec
from tacsim.config import ConfigError, load_rig
from tacsim.control import NoTouch, ObjectDropped
from tacsim.interface import Action, GripperTarget, Observation, Pose
from tacsim.limits import ActionError
from tacsim.rig import Rig
from tacsim.tasks.squeeze import Grip
from tests.robot.rig.lift import LiftConfig
from tests.tacsim.sim.cell.cells import write_clamp

SMALL = (
    "canonical.rows=16", "canonical.columns=16", "canonical.pitch=1 mm", "canonical.image_scale=1",
    *(f"sensors.{name}.model.geometry.{what}" for name in ("left", "right") for what in ("width=20", "height=16")),
    *(f"sensors.{name}.model.geometry.pixel_pitch=1 mm" for name in ("left", "right")),
)  # fmt: skip
SIDES = ("left", "right")
HOLD = 0.71  # of a LiftConfig: about 3 N
BARE = (*SMALL, "task=null", "scene=hold")  # no grip at the reset


def lifted(rig: Rig, pose: Pose, height: float) -> Action:
    return Action({"hand": Pose(pose.position + [0.0, 0.0, height], pose.quaternion)})


def test_a_reset_without_a_task_leaves_the_hand_open_around_the_object() -> None:
    with open_rig("hand", overrides=BARE) as rig:
        observation = rig.reset()
        assert rig.spec.grippers == ("hand",)
        assert {name: spec.gripper for name, spec in rig.spec.sensors.items()} == {"left": "hand", "right": "hand"}
        assert observation.grippers["hand"].width == pytest.approx(0.024)
        assert not observation.arms["hand"].wrench.any()
        for touch in observation.tactile.values():
            assert touch.height is not None
            assert float(np.abs(touch.height).max()) == 0.0
        truth = rig.truth()
        assert truth is not None
        assert set(truth.poses) == {"left", "right"}
        assert truth.objects["object"].position == pytest.approx([0, 0, 0.038])


def test_a_task_begins_with_a_grip_that_carries_the_object() -> None:
    with open_rig("hand", task=LiftConfig(), overrides=SMALL) as rig:
        observation = rig.reset(1)
        begin = observation.arms["hand"].pose
        assert observation.grippers["hand"].force == pytest.approx(3.0)
        assert observation.time == 0.0
        for number in range(1, 5):
            observation, sent = rig.step(lifted(rig, begin, 2e-3 * number))
            target = sent["hand"]
            assert target is not None
            assert observation.arms["hand"].pose.position == pytest.approx(target.position, abs=1e-8)
        assert observation.time == pytest.approx(0.2)
        assert observation.arms["hand"].twist[2] == pytest.approx(0.04)
        assert observation.arms["hand"].wrench[2] == pytest.approx(0.981, abs=0.01)  # its z points down
        left, right = (observation.tactile[side] for side in ("left", "right"))
        assert left.height is not None
        assert left.flow is not None
        assert right.flow is not None
        assert left.height.max() > 50e-6
        # the object hangs: it drags the gels down, along their rows, towards the finger tips
        assert left.flow[..., 1].mean() > 1e-6
        assert left.flow[..., 1].mean() == pytest.approx(right.flow[..., 1].mean(), rel=0.05)
        found = rig.diagnostics()
        assert found["max_force_left"] == pytest.approx(3.0, rel=0.05)
        assert found["slip_share_left"] == pytest.approx(0.981 / 2 / 1.8, rel=0.05)


@pytest.mark.slow
def test_height_and_flow_can_be_found_in_the_picture_as_on_a_robot() -> None:
    """In the same state: within some per cent of what the gel itself has."""
    seen = []
    for surface in ("gel", "picture"):
        with open_rig(
            "hand", task="hold", overrides=("motion=flowing", *(f"sensors.{s}.surface={surface}" for s in SIDES))
        ) as rig:
            seen.append(rig.reset(1).tactile["left"])
            assert rig.spec.sensors["left"].height and rig.spec.sensors["left"].flow
    gel, picture = seen
    assert gel.height is not None and picture.height is not None and gel.flow is not None and picture.flow is not None
    assert picture.height.max() == pytest.approx(gel.height.max(), rel=0.15)
    assert float(np.abs(picture.height - gel.height).max()) > 0.0
    assert picture.flow[..., 1].mean() == pytest.approx(gel.flow[..., 1].mean(), rel=0.15)
    assert float(np.sqrt(np.square(picture.flow - gel.flow).mean())) < 0.15 * float(np.abs(gel.flow).max())


def test_a_picture_without_visible_dots_gives_no_flow() -> None:
    with pytest.raises(CannotOpen, match=r"sensors\.left\.surface is picture: markers of radius"):
        open_rig("hand", overrides=(*BARE, "sensors.left.surface=picture"))


def test_the_same_seed_has_the_same_bits() -> None:
    with open_rig("hand", task=LiftConfig(placement=1e-3), overrides=SMALL) as rig:
        runs = []
        for seed in (3, 4, 3):
            begin = rig.reset(seed).arms["hand"].pose
            observation, _ = rig.step(lifted(rig, begin, 1e-3))
            runs.append((begin.position, observation.tactile["left"].height, observation.arms["hand"].wrench))
        assert all(np.array_equal(a, b) for a, b in zip(runs[0], runs[2], strict=True))
        assert not np.array_equal(runs[0][0], runs[1][0])


def test_targets_of_a_gripper_are_brought_into_its_ranges() -> None:
    with open_rig("hand", overrides=(*BARE, "grippers.hand.force=[1 N, 10 N]")) as rig:
        rig.reset()
        rig.command(Action({}, {"hand": GripperTarget(0.1, 0.5)}))
        assert rig.sent_grippers == {"hand": GripperTarget(0.06, 1.0)}
        assert rig.grippers["hand"].force_range == (1.0, 10.0)
        with pytest.raises(ActionError, match="has only the grippers: hand"):
            rig.command(Action({}, {"foot": GripperTarget(0.0, 1.0)}))


def test_a_long_way_is_shortened_to_the_speed_of_the_arm() -> None:
    with open_rig("hand", overrides=BARE) as rig:
        begin = rig.reset().arms["hand"].pose
        observation, sent = rig.step(lifted(rig, begin, 0.1))
        target = sent["hand"]
        assert target is not None
        assert target.position[2] - begin.position[2] == pytest.approx(2.5e-3)
        assert observation.arms["hand"].pose.position == pytest.approx(target.position, abs=1e-8)
        assert rig.diagnostics()["shortened"] == 1.0


@pytest.mark.parametrize("motion", ["dynamic", "flowing"])
def test_an_environment_lifts_and_ends_when_its_object_is_dropped(motion: str) -> None:
    env = make_env(LiftConfig(steps=30), "hand", overrides=(*SMALL, f"motion={motion}"), features=None)
    flat, _ = env.reset(seed=0)
    assert env.observation_space.contains(flat)
    assert flat["grip_hand"] == pytest.approx([0.0198, 3.0], abs=1e-3)
    for _ in range(3):
        _, reward, ended, _, info = env.step(np.array([1.0, HOLD], np.float32))
        assert not ended
    assert info["distance"] == pytest.approx(0.01 - 3e-3, abs=0.3e-3)
    ended, before = False, reward
    for _ in range(20):
        _, reward, ended, truncated, info = env.step(np.array([0.0, -1.0], np.float32))  # without force
        if ended:
            break
    assert ended
    assert not truncated
    assert "was dropped" in info["dropped"]
    assert info["is_success"] is False
    assert reward < before * 10  # it stands for all steps that are left
    env.reset(seed=1)
    assert "dropped" not in env.step(np.array([0.0, HOLD], np.float32))[4]


def test_an_episode_ends_and_says_so_when_its_object_is_dropped() -> None:
    def release(observation: Observation) -> Action:
        return Action({}, {"hand": GripperTarget(0.05, 1.0)})

    with open_rig("hand", task=LiftConfig(), overrides=SMALL) as rig:
        with pytest.raises(EpisodeFailed, match="of 20 steps: ObjectDropped: object 'object' was dropped") as caught:
            run_episode(rig, FunctionPolicy(release), None, 20)
        assert 1 <= len(caught.value.episode.steps) <= 10
        assert isinstance(caught.value.__cause__, ObjectDropped)


def test_an_object_wider_than_the_gel_finds_no_grip() -> None:
    wide = "scene.object.geometry.size=[20 mm, 30 mm, 30 mm]"
    with (
        open_rig("hand", task=LiftConfig(touch_force=40.0), overrides=(*SMALL, wide)) as rig,
        pytest.raises(NoTouch, match=r"no grip with touch_force 40 N: the object of pad .* is wider than the gel"),
    ):
        rig.reset()


def test_a_gripper_begins_where_the_object_says() -> None:
    with open_rig("hand", overrides=(*BARE, "scene.object.grip=[0, 3 mm, 5 mm]")) as rig:
        assert rig.reset().arms["hand"].pose.position == pytest.approx([0, 3e-3, 0.043])


def test_a_start_of_its_own_leaves_the_hand_open_there() -> None:
    start = "arms.hand.start={position: [0, 0, 0.12], rotation: [180 deg, 0, 0]}"
    with open_rig("hand", task=LiftConfig(), overrides=(*SMALL, start)) as rig:
        observation = rig.reset()
        assert observation.arms["hand"].pose.position == pytest.approx([0, 0, 0.12])
        assert observation.grippers["hand"].width == pytest.approx(0.06)


@pytest.mark.slow
@pytest.mark.parametrize("timestep", ["1 ms", "2 ms"])
def test_a_light_bar_pressed_on_the_edge_of_its_hole_stays_in_the_grip(timestep: str) -> None:
    """It touches a strip 20 mm below the grip: with a wrong prediction of this contact it turns and slips."""
    with open_rig("hand", task="peg", overrides=(*SMALL, f"scene.timestep={timestep}")) as rig:
        begin = rig.reset().arms["hand"].pose
        pressed = [(1.6, -depth) for depth in (1, 2, 3, 4, 5, 5)]
        for x, z in [(0.8, 0), (1.6, 0), *pressed, *3 * [(1.6, 0)]]:  # [mm]
            pose = Pose(begin.position + 1e-3 * np.array([x, 0, z]), begin.quaternion)
            observation, _ = rig.step(Action({"hand": pose}, {"hand": GripperTarget(0.0, 12.0)}))
            if z == -5:  # the gels give way by 1 mm
                assert observation.arms["hand"].wrench[2] == pytest.approx(-5.2, abs=0.4)
        truth = rig.truth()
        assert truth is not None
        assert begin.position[2] - truth.objects["object"].position[2] == pytest.approx(2e-3, abs=0.1e-3)


def test_the_doctor_looks_for_mujoco() -> None:
    checks = examine_rig(load_rig("hand").config)
    assert [(check.name, check.state) for check in checks] == [("MuJoCo", "ok")]


def test_an_environment_takes_variants_of_its_object() -> None:
    variants = [["scene.object.mass=0.05"], ["scene.object.friction=0.9", "arms.hand.noise.force=0.1 N"]]
    env = make_env(LiftConfig(), "hand", overrides=SMALL, variants=variants, features=None)
    weights = []
    for number in (0, 1):
        flat, _ = env.reset(seed=0, options={"variant": number})
        weights.append(float(flat["wrench_hand"][2]))
    assert weights[0] == pytest.approx(0.05 * 9.81, abs=0.01)
    assert weights[1] == pytest.approx(0.981, abs=0.5)
    assert abs(weights[1] - 0.981) > 1e-3


def test_the_policy_grip_closes_the_hand_until_it_feels_the_object() -> None:
    with open_rig("hand", overrides=BARE) as rig:
        episode = run_episode(rig, Grip(rig.spec, step=0.3e-3), None, 12)
        last = episode.steps[-1]
        assert last.grippers["hand"].width == pytest.approx(0.0197, abs=0.2e-3)
        assert last.info["contact_signal_left"] > 0.01
        assert last.info["max_force_left"] > 0.5


# --------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("scene=squeeze",), "the scene 'squeeze', which has no object; give scene: hold"),
        (("period=50.5 ms",), "0.0505 s is no whole number of timesteps of 0.002 s"),
        (("sensors.right.side=left",), "sensors left and right are both on the left finger of 'hand'"),
        (("grippers.hand.model=null",), "model: null.*needs it"),
        (("grippers.hand.width=[20 mm, 10 mm]",), "width: the least, 0.02, must be below the greatest, 0.01"),
        (("arms.hand.model=ur6",), "model is 'ur6'; allowed: free, ur5e, or the path of an MJCF file"),
        (("arms.hand.joints=[a]",), "only those of an MJCF file have names"),
        (("scene.object.mass=0",), "mass"),
        (("scene.object.geometry={shape: box, size: [70 mm, 10 mm, 10 mm]}",), "70 mm wide where gripper 'hand'"),
        (
            ("scene.timestep=5 ms", "scene.gel.material.youngs_modulus=20 MPa"),
            "timestep of 0.005 s is too long for pad",
        ),
        (("arms.hand.model=ur5e", "arms.hand.world_from_base.position=[2, 0, 0]"), "does not reach its start"),
        (("clock=sim",), "which does not support clock 'sim'"),
        (
            ("sensors.left.model=gelsight-mini", "sensors.right.model=digit"),
            "one gel, and their sensors differ: 25.25 x",
        ),
    ],
)
def test_a_rig_that_cannot_be_simulated_is_refused(overrides: tuple[str, ...], message: str) -> None:
    with (
        pytest.raises((CannotOpen, ConfigError, ValueError), match=message),
        open_rig("hand", overrides=overrides) as rig,
    ):
        rig.reset()


@pytest.mark.parametrize("rig", ["hand", "ur5e-mujoco"])
@pytest.mark.parametrize("more", [(), ("--task",)], ids=["as shipped", "with a task"])
def test_the_shipped_rigs_describe_themselves(rig: str, more: tuple[str, ...]) -> None:
    task, force = ("hold", ("grippers.hand.force=[1 N, 235 N]",)) if more else (None, ())
    spec = rig_spec(load_rig(rig, task=task, overrides=force).config)
    assert spec.grippers == spec.arms == ("hand",)
    assert spec.views == (("front",) if rig == "ur5e-mujoco" else ())


def test_a_grip_weaker_than_the_gripper_can_is_refused_before_anything_is_made() -> None:
    config = load_rig("hand", task=LiftConfig(), overrides=("grippers.hand.model=2f85",)).config
    with pytest.raises(CannotOpen, match=r"task.touch_force, 3 N, and grippers.hand has forces of 20 to 235 N"):
        rig_spec(config)


def test_the_rig_sim_moves_no_object() -> None:
    with pytest.raises(CannotOpen, match="'hold' has a rigid object, which only MuJoCo moves"):
        open_rig("sim", overrides=("scene=hold",))


@pytest.mark.slow
def test_two_hands_of_a_vector_environment_do_what_one_does_alone() -> None:
    envs = make_vector_env(2, LiftConfig(steps=30), "hand", overrides=SMALL, features=None)
    alone = make_env(LiftConfig(steps=30), "hand", overrides=SMALL, features=None)
    both, _ = envs.reset(seed=[3, 4])
    one, _ = alone.reset(seed=4)
    ended = np.zeros(2, bool)
    for number in range(16):
        up, hold, open_hand = [1.0, HOLD], [0.0, HOLD], [0.0, -1.0]
        if not ended[0]:
            both, _, ended, _, _ = envs.step(np.array([open_hand, up if number < 4 else hold], np.float32))
            one, *_ = alone.step(np.array(up if number < 4 else hold, np.float32))
        assert all(np.array_equal(both[key][1], one[key]) for key in one)
    assert ended.tolist() == [True, False]  # one is dropped, the other goes on


@pytest.mark.parametrize(("version", "message"), [("None", "MuJoCo is missing"), ("'3.3.0'", "MuJoCo 3.3.0 is inst")])
def test_without_its_mujoco_only_rigs_in_mujoco_are_refused(version: str, message: str) -> None:
    program = f"""
import sys, types
version = {version}
sys.modules["mujoco"] = None if version is None else types.SimpleNamespace(__version__=version)
import robot
assert robot.open_rig("sim").spec.arms == ("lower", "upper")
try:
    robot.open_rig("hand")
except robot.CannotOpen as failure:
    print(failure)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert f"rig 'hand' needs MuJoCo: {message}" in done.stdout


# ------------------------------------------------------- models of the user


OWN = """name: own
clock: mujoco
period: 50 ms
motion: dynamic
scene: hold
arms: {{ clamp: {{ driver: mujoco, model: {model}, joints: [{joints}], flange: mount }} }}
grippers: {{ hand: {{ driver: mujoco, arm: clamp, {gripper} }} }}
sensors: {{ left: {{ driver: mujoco, gripper: hand, side: left }} }}
"""
JOINTS = "up, side, out, roll, pitch, yaw"
FINGERS = (
    "model: null, joints: [left, right], tool: grip, pads: [left_gel, right_gel], width: [0, 60 mm], "
    "force: [0, 50 N], speed: 50 mm/s"
)


def rig_joints(path: Path) -> int:
    return load_rig(path).config.arms["clamp"].joint_count


def write_own(folder: Path, gripper: str = FINGERS, joints: str = JOINTS, *, fingers: bool = True) -> Path:
    write_clamp(folder, fingers=fingers)
    path = folder / "own.yaml"
    path.write_text(OWN.format(model="clamp.xml", joints=joints, gripper=gripper), encoding="utf-8")
    return path


@pytest.mark.parametrize("gripper", [FINGERS, "model: parallel"], ids=["fingers", "mounted"])
def test_a_model_of_the_user_holds_and_lifts(tmp_path: Path, gripper: str) -> None:
    path = write_own(tmp_path, gripper, fingers=gripper == FINGERS)
    with open_rig(path, task=LiftConfig()) as rig:
        begin = rig.reset().arms["clamp"].pose
        target = Pose(begin.position + [0, 0, 2e-3], begin.quaternion)
        for _ in range(4):
            observation, _ = rig.step(Action({"clamp": target}))
        assert observation.arms["clamp"].joints is not None
        assert len(observation.arms["clamp"].joints) == rig_joints(path) == 6
        assert observation.arms["clamp"].pose.position == pytest.approx(target.position, abs=0.1e-3)
        assert observation.arms["clamp"].wrench[2] == pytest.approx(0.981, abs=0.01)


@pytest.mark.parametrize(
    ("gripper", "joints", "message"),
    [
        (FINGERS.replace("left_gel", "nowhere"), JOINTS, "pad 'clamp/nowhere': the model has no site of that name"),
        (FINGERS.replace("grip,", "nothing,"), JOINTS, "no site of that name"),
        (FINGERS, "up, sideways", "clamp.xml: no joint 'sideways'; there are 'up', 'side'"),
        (FINGERS.replace("[left,", "[other,"), JOINTS, "clamp.xml: no joint 'other'"),
    ],
)
def test_a_model_of_the_user_without_what_is_named_is_refused(
    tmp_path: Path, gripper: str, joints: str, message: str
) -> None:
    with pytest.raises(CannotOpen, match=message):
        open_rig(write_own(tmp_path, gripper, joints))


def test_a_missing_or_broken_model_is_refused(tmp_path: Path) -> None:
    path = write_own(tmp_path)
    (tmp_path / "clamp.xml").write_text("<mujoco><worldbody><geom/></worldbody></mujoco>", encoding="utf-8")
    with pytest.raises(CannotOpen, match=r"clamp\.xml"):
        open_rig(path)
    (tmp_path / "clamp.xml").unlink()
    with pytest.raises(CannotOpen, match="no such MJCF file"):
        open_rig(path)
