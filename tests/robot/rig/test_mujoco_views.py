"""Cameras that look at a rig in MuJoCo: pictures of what was there, made when somebody looks; and where none can be."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from robot.open import CannotOpen, make_env, open_rig
from tacsim.config import ConfigError, load_rig
from tacsim.interface import Action, IncompatibleRig, Needs, Pose
from tacsim.sim.engines.picture import NoRendering, PictureRenderer, require_rendering
from tests.robot.rig.lift import LiftConfig
from tests.robot.rig.test_mujoco_rig import SMALL

VIEW = "cameras.front={position: [0.12, -0.22, 0.14], target: [0, 0, 0.05], size: [64, 48]}"


def can_render() -> bool:
    try:
        require_rendering()
    except NoRendering:
        return False
    return True


rendering = pytest.mark.skipif(not can_render(), reason="neither EGL nor OSMesa is on this machine")


@rendering
def test_a_picture_shows_what_was_there_and_is_made_when_it_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []
    render = PictureRenderer.render

    def counted(self: PictureRenderer, data: object, camera: str) -> np.ndarray:
        made.append(camera)
        return render(self, data, camera)

    monkeypatch.setattr(PictureRenderer, "render", counted)
    with open_rig("hand", overrides=(*SMALL, VIEW)) as rig:
        rig.require(Needs(views=frozenset({"front"})), "test")
        first = rig.reset()
        up = Pose(first.arms["hand"].pose.position + [0, 0, 2e-3], first.arms["hand"].pose.quaternion)
        for _ in range(3):
            last, _ = rig.step(Action({"hand": up}))
        assert made == []
        then, now = first.views["front"].image, last.views["front"].image
        assert made == ["front", "front"]
        assert now.shape == (48, 64, 3)
        assert now.dtype == np.uint8
        assert last.views["front"].time == pytest.approx(0.15)
        assert np.array_equal(first.views["front"].image, then)  # once
        assert np.array_equal(rig.reset().views["front"].image, then)  # of the state that it was seen in
        assert np.abs(then.astype(int) - now).max() > 50  # the fingers have risen
        red = (now[..., 0] > 1.5 * now[..., 2]) & (now[..., 0] > 120)
        assert 10 < red.sum() < 400  # the object


@rendering
def test_an_environment_that_shows_everything_shows_views() -> None:
    env = make_env(LiftConfig(), "hand", overrides=(*SMALL, VIEW), features=None)
    flat, _ = env.reset(seed=0)
    assert env.observation_space.contains(flat)
    assert flat["view_front"].shape == (48, 64, 3)


def test_a_policy_that_wants_a_view_is_refused_where_there_is_none() -> None:
    with (
        open_rig("hand", overrides=SMALL) as rig,
        pytest.raises(IncompatibleRig, match="it lacks camera 'front' that looks at the scene"),
    ):
        rig.require(Needs(views=frozenset({"front"})), "policy")


@pytest.mark.parametrize(
    ("rig", "override", "message"),
    [
        ("sim", VIEW, "only a rig with clock 'mujoco' has cameras that look at its scene"),
        ("hand", "cameras.front={position: [0, 0, 0]}", "position and target are the same point"),
        ("hand", "cameras.front={position: [1, 0, 0], size: [8, 8]}", r"cameras\.front\.size"),
    ],
)
def test_a_camera_that_sees_nothing_is_refused(rig: str, override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_rig(rig, overrides=[override])


@pytest.mark.parametrize(
    ("backend", "message"),
    [("osmesa", "rig 'hand'.*MUJOCO_GL is 'osmesa': unset it"), ("off", "MUJOCO_GL=off switches rendering off")],
)
def test_without_its_library_only_rigs_with_views_are_refused(backend: str, message: str, tmp_path: Path) -> None:
    program = f"""
import re, robot
try:
    robot.open_rig("hand", overrides=[{VIEW!r}])
except robot.CannotOpen as failure:
    assert re.search({message!r}, str(failure), re.DOTALL), failure
    print("refused")
"""
    # EGL, once it was used in this process, has left its name for others
    env = {**{key: text for key, text in os.environ.items() if key != "PYOPENGL_PLATFORM"}, "MUJOCO_GL": backend}
    look = [sys.executable, "-c", "import mujoco.osmesa"]
    if backend == "osmesa" and subprocess.run(look, env=env, check=False, capture_output=True).returncode == 0:
        pytest.skip("OSMesa is on this machine")
    done = subprocess.run([sys.executable, "-c", program], env=env, capture_output=True, text=True, check=False)
    assert done.stdout == "refused\n", done.stderr


def test_all_that_a_machine_lacks_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def lacks(name: str) -> object:
        raise OSError(f"no {name}")

    monkeypatch.setattr("tacsim.sim.engines.picture.import_module", lacks)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    require_rendering.cache_clear()
    try:
        with pytest.raises(
            CannotOpen, match=r"no off-screen rendering by egl \(OSError: no mujoco\.egl\) or by osmesa .*libegl1"
        ):
            open_rig("hand", overrides=(*SMALL, VIEW))
    finally:
        require_rendering.cache_clear()


@pytest.mark.slow
def test_a_ur5e_grips_and_lifts() -> None:
    overrides = (*SMALL, "task.touch_force=20", "cameras={}")
    with open_rig("ur5e-mujoco", task=LiftConfig(), overrides=overrides) as rig:
        observation = rig.reset()
        begin, joints = observation.arms["hand"].pose, observation.arms["hand"].joints
        assert joints is not None
        assert observation.grippers["hand"].force == pytest.approx(20.0)
        for number in range(1, 6):
            target = Pose(begin.position + [0, 0, 2e-3 * number], begin.quaternion)
            observation, _ = rig.step(Action({"hand": target}))
        for _ in range(3):
            observation, _ = rig.step(Action({"hand": target}))
        assert observation.arms["hand"].pose.position == pytest.approx(target.position, abs=50e-6)
        assert observation.arms["hand"].wrench[2] == pytest.approx(0.981, abs=0.01)
        assert not np.array_equal(observation.arms["hand"].joints, joints)
