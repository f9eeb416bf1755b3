"""Environments in several processes give what they give in one, and lose nothing when a process fails."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ResetNeeded

from robot.open import CannotOpen, make_sharded_env
from robot.rig.sharded_env import ShardedVectorEnv, WorkerFailed, merge_infos
from tacsim.config import ConfigError
from tacsim.limits import ActionError
from tests.tacsim.gym.small import SMALL, VARIANTS, assert_equal, make_native

OPTIONS: dict[str, Any] = {"overrides": [*SMALL, "motion=flowing"], "variants": VARIANTS, "features": None}


def make_sharded(number: int, mode: str, processes: int = 2, **more: Any) -> ShardedVectorEnv:
    return make_sharded_env(number, "squeeze", autoreset_mode=mode, processes=processes, **{**OPTIONS, **more})


@pytest.fixture(scope="module")
def envs() -> Iterator[ShardedVectorEnv]:
    """Three environments in two processes."""
    with_two = make_sharded(3, "Disabled")
    yield with_two
    with_two.close()


@pytest.mark.slow
@pytest.mark.cpu
@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_processes_give_the_bits_of_one_process(mode: str) -> None:
    """Also where episodes end, at different steps."""
    sharded, whole = make_sharded(3, mode), make_native(3, mode, overrides=OPTIONS["overrides"])
    rng = np.random.default_rng(1)
    try:
        assert sharded.observation_space == whole.observation_space and sharded.metadata == whole.metadata
        assert_equal(sharded.reset(seed=[5, 9, 7]), whole.reset(seed=[5, 9, 7]))
        assert len(set(sharded.pids)) == 2
        for _ in range(5):
            actions = rng.uniform(-1.0, 1.0, (3, 2)).astype(np.float32)
            found, wanted = sharded.step(actions), whole.step(actions)
            assert_equal(found, wanted)
            over = found[2] | found[3]
            if mode == "Disabled" and over.any():
                options = {"reset_mask": over}
                assert_equal(sharded.reset(options=dict(options)), whole.reset(options=dict(options)))
        assert_equal((sharded.call("expert"),), (whole.call("expert"),))
    finally:
        sharded.close()
        whole.close()


@pytest.mark.slow
def test_a_refused_action_moves_no_environment_of_any_process(envs: ShardedVectorEnv) -> None:
    envs.reset(seed=1)
    before = [observation.arms["lower"].pose.position for observation in envs.get_attr("observation")]
    bad = np.zeros((3, 2), np.float32)
    bad[2] = np.nan
    with pytest.raises(ActionError) as caught:
        envs.step(bad)
    assert "environments 1 to 2" in "".join(caught.value.__notes__)
    envs.step(np.zeros((3, 2), np.float32))
    after = [observation.arms["lower"].pose.position for observation in envs.get_attr("observation")]
    assert np.array_equal(before, after)
    with pytest.raises(ValueError, match="2 actions for 3"):
        envs.step(bad[:2])


@pytest.mark.slow
def test_selected_environments_are_called_and_set(envs: ShardedVectorEnv) -> None:
    envs.reset(seed=1)
    envs.set_attr("next_variant", [1, 0, 1])
    assert envs.call_selected([2, 0], "next_variant") == (1, 1) and envs.get_attr("next_variant") == (1, 0, 1)
    with pytest.raises(ValueError, match="2 values for 3"):
        envs.set_attr("next_variant", [1, 0])


@pytest.mark.slow
def test_a_reset_mask_may_leave_out_a_process(envs: ShardedVectorEnv) -> None:
    envs.reset(seed=1)
    seen = envs.step(np.ones((3, 2), np.float32))[0]
    again, infos = envs.reset(options={"reset_mask": np.array([True, False, False])})
    assert infos["_distance"].tolist() == [True, False, False]
    for key in seen:
        assert np.array_equal(seen[key][1:], again[key][1:])
    for mask, error in (
        ([True] * 3, TypeError),
        (np.zeros(3, np.bool_), ValueError),
        (np.ones(2, np.bool_), ValueError),
    ):
        with pytest.raises(error, match="reset_mask"):
            envs.reset(options={"reset_mask": mask})


@pytest.mark.slow
def test_a_killed_process_is_reported_and_ends_the_others() -> None:
    envs = make_sharded(2, "Disabled")
    with pytest.raises(ResetNeeded, match="environment 1"):
        envs.reset(options={"reset_mask": np.array([True, False])})
    envs.reset(seed=1)
    first, second = envs.pids
    os.kill(second, signal.SIGKILL)
    with pytest.raises(WorkerFailed, match=rf"process {second}.*SIGKILL.*make the environments again"):
        envs.step(np.zeros((2, 2), np.float32))
    with pytest.raises(ProcessLookupError):
        os.kill(first, 0)
    envs.close()


@pytest.mark.slow
def test_errors_and_warnings_of_a_process_reach_the_program(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(CannotOpen, match="physics 'seed'"):
        make_sharded(2, "Disabled", overrides=["scene.physics=seed"], variants=[])
    with pytest.raises(ConfigError, match="spacing: unknown key"):
        make_sharded(2, "Disabled", overrides=["scene.spacing=2 mm"], variants=[])
    with caplog.at_level(logging.WARNING):
        envs = make_sharded(2, "Disabled", variants=[])
        envs.reset(seed=1)
        envs.close()
    assert [record.getMessage()[:36] for record in caplog.records] == ["warning: a body has fewer than 12 la"]


@pytest.mark.parametrize("processes", [0, -1, 1.5, True, "2"])
def test_a_wrong_number_of_processes_is_refused(processes: Any) -> None:
    with pytest.raises(ValueError, match="processes is a number from 1"):
        make_sharded_env(2, processes=processes)


@pytest.mark.parametrize("number", [0, -2, 1.5, "3", None])
def test_a_wrong_number_of_environments_is_refused(number: Any) -> None:
    with pytest.raises(ValueError, match="num_envs is a number from 1"):
        make_sharded_env(number)


def test_infos_of_parts_are_filled_where_one_has_no_entry() -> None:
    first = {"a": np.array([1.0]), "_a": np.array([True]), "final_info": {"b": np.array(["x"], object)}}
    second = {"a": np.array([2.0, 3.0]), "_a": np.array([True, True]), "c": np.ones((2, 4), np.int8)}
    merged = merge_infos([first, second], [1, 2])
    assert merged["a"].tolist() == [1.0, 2.0, 3.0] and merged["_a"].all()
    assert merged["final_info"]["b"].tolist() == ["x", None, None]
    assert merged["c"].shape == (3, 4) and not merged["c"][0].any() and merged["c"][1:].all()
