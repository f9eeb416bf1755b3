"""Rigs from files: what is opened, what is refused, and that Gymnasium finds the environments."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot.open import RIG_ATTACHMENT, CannotOpen, make_env, make_vector_env, open_rig
from tacsim.config import ConfigError, load_rig
from tacsim.interface import Action, IncompatibleRig, Needs, RigSpec
from tacsim.record.episode import EpisodeMeta, Step
from tacsim.record.images import reference_attachments
from tacsim.record.writer import Recorder

SMALL = ("scene.body.geometry.size=[4 mm, 4 mm, 4 mm]", "scene.gel.size=[8 mm, 8 mm, 2 mm]")


def write(folder: Path, text: str) -> Path:
    path = folder / "rig.yaml"
    path.write_text(text)
    return path


def test_sim_ends_its_reset_in_gentle_contact() -> None:
    with open_rig("sim", overrides=SMALL) as rig:
        observation = rig.reset()
        forces = [-arm.wrench[2] for arm in observation.arms.values()]
        assert all(0.05 <= force <= 0.06 * 1.01 for force in forces)
        rig.require(
            Needs(frozenset({"lower", "upper"}), frozenset({"lower", "upper"}), height=True, truth=True), "test"
        )
        assert rig.references["upper"].surface is not None
        assert float(np.abs(rig.references["upper"].surface.height).max()) < 1e-6  # taken clear of the body


def test_a_real_world_resets_to_the_same_bits() -> None:
    with open_rig("sim", overrides=SMALL) as rig:
        runs = []
        for _ in range(2):
            observation = rig.reset()
            up = observation.arms["upper"].pose
            target = type(up)(up.position - [0, 0, 1e-4], up.quaternion)
            observation, _ = rig.step(Action({"upper": target}))
            runs.append(observation)
        for name in ("lower", "upper"):
            assert np.array_equal(runs[0].tactile[name].image, runs[1].tactile[name].image)
            assert np.array_equal(runs[0].arms[name].wrench, runs[1].arms[name].wrench)


@pytest.mark.parametrize("rig", ["sim", "press"])
def test_a_rig_that_is_refused_makes_no_world(rig: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A world takes seconds, a refusal none."""
    monkeypatch.setattr("robot.rig.sim_rig.make_world", lambda scene: pytest.fail("a world was made"))

    def refuse(spec: RigSpec) -> None:
        raise IncompatibleRig(", ".join(spec.sensors))

    with pytest.raises(IncompatibleRig, match="lower"):
        open_rig(rig, check=refuse)


def test_a_rigid_press_is_a_rig_too(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        "name: bench\nclock: sim\nscene: {extends: press, gel: {size: [8 mm, 8 mm, 2 mm], material: silicone}}\n"
        "arms: {plate: {driver: sim}, indenter: {driver: sim}}\nsensors: {lower: {driver: sim, arm: plate}}\n",
    )
    with open_rig(path) as rig:
        observation = rig.reset()
        assert rig.truth() is None
        assert not rig.spec.truth
        ball = observation.arms["indenter"].pose
        down = type(ball)([0.0, 0.0, 4e-3 - 0.3e-3], ball.quaternion)  # ball of 4 mm, 0.3 mm deep
        for _ in range(3):
            observation, _ = rig.step(Action({"indenter": down}))
        assert observation.tactile["lower"].height is not None
        assert float(observation.tactile["lower"].height.max()) == pytest.approx(0.3e-3, rel=0.15)
        plate, ball_wrench = observation.arms["plate"].wrench, observation.arms["indenter"].wrench
        assert plate[2] < -0.01
        assert ball_wrench[:3] == pytest.approx(-plate[:3], abs=1e-9)  # both frames are upright


def test_a_replayed_episode_is_observed_as_it_was_then(tmp_path: Path) -> None:
    """The rig file inside the episode tells the replay how to normalise; nothing of it is said again."""
    loaded, path = load_rig("sim", overrides=SMALL), tmp_path / "episode.mcap"
    with open_rig(loaded) as rig:
        first = rig.reset()
        frames, references = rig.frames, reference_attachments(rig.references)
        attachments = {RIG_ATTACHMENT: loaded.text.encode(), **references}
        meta = EpisodeMeta("sim", None, "none", 0, rig.spec, {}, attachments)
    with Recorder(path, meta) as recorder:
        recorder.write(Step(0, first.time, frames, first.arms))
    rig_file = write(
        tmp_path,
        f"name: r\nclock: replay\narms: {{upper: {{driver: replay, source: '{path}'}}}}\n"
        f"sensors: {{upper: {{driver: replay, source: '{path}', arm: upper}}}}\n",
    )
    with open_rig(rig_file) as rig:
        again = rig.reset()
    then, now = first.tactile["upper"], again.tactile["upper"]
    for name in ("image", "height", "gradient", "contact", "valid"):
        assert np.array_equal(getattr(then, name), getattr(now, name)), name
    assert np.array_equal(first.arms["upper"].wrench, again.arms["upper"].wrench)


def test_replay_says_how_to_name_a_recording() -> None:
    with pytest.raises(CannotOpen, match=r"sensors\.finger\.source: no recording given; name one with --set"):
        open_rig("replay")


def test_pictures_alone_are_a_rig_without_arms(tmp_path: Path) -> None:
    from PIL import Image

    for k in range(2):
        Image.fromarray(np.full((48, 64, 3), 100 + 20 * k, np.uint8)).save(tmp_path / f"{k}.png")
    with open_rig("replay", overrides=[f"sensors.finger.source={tmp_path}"]) as rig:
        observation = rig.reset()
        assert (rig.spec.arms, rig.spec.sensors["finger"].arm, dict(observation.arms)) == ((), None, {})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "name: r\nclock: replay\nscene: squeeze\narms: {lower: {driver: sim}}\n"
            "sensors: {lower: {driver: sim, arm: lower}}\n",
            "arms.lower has driver 'sim', which does not support clock 'replay'",
        ),
        (
            "name: r\nclock: sim\nscene: squeeze\narms: {left: {driver: sim}}\n"
            "sensors: {left: {driver: sim, arm: left}}\n",
            "scene 'squeeze' has no sensor 'left'; it has lower, upper",
        ),
        (
            "name: r\nclock: sim\nscene: squeeze\narms: {lower: {driver: sim}, spare: {driver: sim}}\n"
            "sensors: {lower: {driver: sim, arm: lower}}\n",
            "arms.spare carries no sensor",
        ),
        (
            "name: r\nclock: sim\nscene: squeeze\narms: {one: {driver: sim}}\n"
            "sensors: {lower: {driver: sim, arm: one}, upper: {driver: sim, arm: one}}\n",
            "arms.one carries several sensors",
        ),
    ],
)
def test_parts_that_make_no_rig_are_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(CannotOpen, match=message):
        open_rig(write(tmp_path, text))


def test_recordings_of_two_rates_are_refused(tmp_path: Path) -> None:
    import cv2

    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "0.png"), np.full((20, 20, 3), 100, np.uint8))
    text = "name: r\nclock: replay\nsensors:\n"
    text += "".join(
        f"  {n}: {{driver: replay, source: '{tmp_path / n}', fps: {f}}}\n" for n, f in (("a", 30), ("b", 60))
    )
    with pytest.raises(CannotOpen, match=r"sensors\.b has one every 0\.01667 s and sensors\.a every 0\.03333 s"):
        open_rig(write(tmp_path, text))


def test_a_wrong_file_is_a_config_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        open_rig(write(tmp_path, "name: r\nclock: sun\nsensors: {}\n"))


def test_a_loaded_configuration_takes_no_more_overrides() -> None:
    with pytest.raises(TypeError, match="loaded already"):
        open_rig(load_rig("sim"), overrides=["period=1 s"])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"overrides": "scene.preset=learn"}, "lists of texts"),
        ({"overrides": 5}, "lists of texts, such as .*; 5 was given"),
        ({"task": 5}, "a task is a name, the path of a file, or a configuration; 5 was given"),
        ({"overrides": [None]}, r"\[None\] was given"),
        ({"variants": ["scene.preset=learn"]}, "lists of texts"),
        ({"variants": [[["a"]]]}, r"\[\['a'\]\] was given"),
        ({"variants": 3}, "list of lists of overrides, .*; 3 was given"),
        ({"rig": 4}, "by the path of its file; 4 was given"),
        ({"features": {"period": "often"}}, "features: "),
        ({"features": 5}, "features: "),
        ({"randomise": 5}, "randomise: "),
    ],
)
def test_wrong_arguments_of_an_environment_are_told_in_words(arguments: dict[str, Any], said: str) -> None:
    with pytest.raises((TypeError, ConfigError), match=said) as caught:
        make_env(**arguments)
    assert "pydantic" not in str(caught.value)


@pytest.mark.parametrize("number", [0, -1, 2.5, "2", 10**7])
def test_a_number_of_environments_that_is_none_is_refused(number: Any) -> None:
    with pytest.raises(ValueError, match=f"1 to 10,000 environments, got {number!r}"):
        make_vector_env(number)


@pytest.mark.slow
@pytest.mark.parametrize(("first", "module"), [("", "tacsim.gym:"), ("import tacsim.gym\n", "")])
def test_gymnasium_finds_the_environments_by_an_import_or_the_id(first: str, module: str) -> None:
    """In a fresh process, with a small scene."""
    program = (
        f"{first}import gymnasium, sys\n"
        f"env = gymnasium.make('{module}tacsim/Squeeze-v0', overrides={[*SMALL, 'task.goal=3 mm']!r})\n"
        "flat, info = env.reset(seed=1)\n"
        "flat, reward, *_ = env.step(env.action_space.sample())\n"
        "assert flat in env.observation_space and reward < 0 and 'touch' in flat\n"
        "env.close()\n"
        "assert 'tacsim/Reposition-v0' in gymnasium.registry\n"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, timeout=110)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("module", ["tacsim.gym.encode", "tacsim.gym.env", "gymnasium"])
def test_any_of_ours_may_import_gymnasium_first(module: str) -> None:
    """Registration runs inside `import tacsim.gym`: it must not need a module of ours that is half imported."""
    program = f"import {module}, tacsim.gym, gymnasium\n"
    program += "assert 'tacsim/Squeeze-v0' in gymnasium.registry\n"
    done = subprocess.run([sys.executable, "-W", "error", "-c", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
