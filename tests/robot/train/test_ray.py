"""Environments and trainings on a Ray cluster: the bits of one process, and a worker that is killed.

Runs where the extra `cluster` is installed (make test-extras).
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ray = pytest.importorskip("ray")
psutil = pytest.importorskip("psutil")
pytest.importorskip("torch")

from ray.cluster_utils import Cluster  # noqa: E402

from robot.common.cluster import ClusterError  # noqa: E402
from robot.open import CannotOpen, make_sharded_env  # noqa: E402
from robot.rig.sharded_env import ShardedVectorEnv, WorkerFailed  # noqa: E402
from robot.train.run_folder import RunFolder  # noqa: E402
from robot.train.train import begin_run, train  # noqa: E402
from tacsim.limits import ActionError  # noqa: E402
from tests.robot.cli.invoked import START, environment, plain_text, tacsim  # noqa: E402
from tests.robot.train.short import training  # noqa: E402
from tests.tacsim.gym.small import SMALL, VARIANTS, assert_equal, make_native  # noqa: E402

# Ray leaves sockets and files to the collector
pytestmark = [pytest.mark.filterwarnings("ignore"), pytest.mark.timeout(280), pytest.mark.slow]


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """A cluster of two CPUs on the loopback; 127.0.0.1 Ray takes for the machine's other address."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("PYTHONPATH", environment()["PYTHONPATH"])  # a node's workers import what this process does
        few = {"num_cpus": 2, "object_store_memory": 100 * 2**20, "include_dashboard": False}
        cluster = Cluster(initialize_head=True, head_node_args={**few, "node_ip_address": "127.0.0.2"})
        try:
            yield cluster.address
        finally:
            cluster.shutdown()


def make_on_ray(address: str, number: int, **more: Any) -> ShardedVectorEnv:
    options: dict[str, Any] = {"overrides": [*SMALL, "motion=flowing"], "variants": VARIANTS, "features": None}
    return make_sharded_env(number, "squeeze", **{**options, "cluster": address, **more})


def checkpoint_of(run: RunFolder) -> bytes:
    """The policy and the rounds that it learned from, as bytes."""
    files = sorted(run.folder.glob("*.onnx")) + sorted(run.folder.glob("*.npz"))
    return b"".join(path.read_bytes() for path in files)


@pytest.mark.cpu
def test_environments_on_a_cluster_give_the_bits_of_one_process(address: str) -> None:
    on_ray = make_on_ray(address, 3, autoreset_mode="SameStep")
    whole = make_native(3, "SameStep", overrides=[*SMALL, "motion=flowing"])
    rng = np.random.default_rng(1)
    try:
        assert len(set(on_ray.pids)) == 2 and os.getpid() not in on_ray.pids
        assert_equal(on_ray.reset(seed=[5, 9, 7]), whole.reset(seed=[5, 9, 7]))
        for _ in range(5):
            actions = rng.uniform(-1.0, 1.0, (3, 2)).astype(np.float32)
            assert_equal(on_ray.step(actions), whole.step(actions))
        bad = np.zeros((3, 2), np.float32)
        bad[2] = np.nan
        with pytest.raises(ActionError) as caught:
            on_ray.step(bad)
        assert "environments 1 to 2" in "".join(caught.value.__notes__)
        assert_equal(on_ray.step(0.5 * np.ones((3, 2), np.float32)), whole.step(0.5 * np.ones((3, 2), np.float32)))
    finally:
        on_ray.close()
        whole.close()
    on_ray.close()
    with pytest.raises(WorkerFailed, match="is closed"):
        on_ray.call("expert")
    assert not ray.is_initialized()


def test_what_a_cluster_cannot_do_is_an_error_in_words(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ClusterError, match="3 workers need as many CPUs, and the Ray cluster has 2"):
        make_on_ray(address, 3, processes=3)
    with pytest.raises(ClusterError, match=r"--ray 127\.0\.0\.1:1: no Ray cluster answers at this address"):
        make_on_ray("127.0.0.1:1", 3)
    with pytest.raises(CannotOpen, match="physics 'seed'"):
        make_on_ray(address, 2, overrides=["scene.physics=seed"], variants=[])
    monkeypatch.setattr("robot.rig.env_workers.tacsim_version", lambda: "9.9")
    with pytest.raises(ClusterError, match=r"a node has tacsim .*, this program runs 9\.9"):
        make_on_ray(address, 1)
    assert not ray.is_initialized()


@pytest.mark.parametrize("algorithm", ["dagger", "sac"])
def test_training_whose_worker_is_killed_continues_to_the_same_policy(
    address: str, algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """kill -9 of a worker in the middle of the third round."""
    settings = training(algorithm=algorithm)
    whole = begin_run(settings, tmp_path / "whole")
    train(whole)
    pids: list[int] = []
    made = ShardedVectorEnv.__init__

    def spy(self: ShardedVectorEnv, *given: Any) -> None:
        made(self, *given)
        pids.extend(self.pids)

    def kill_in_round_3(words: str, done: int, of: int) -> None:
        if "round 3" in words and done >= of // 2 and len(pids) == 2:
            os.kill(pids.pop(), signal.SIGKILL)

    monkeypatch.setattr(ShardedVectorEnv, "__init__", spy)
    cut = begin_run(settings, tmp_path / "cut")
    with pytest.raises(
        WorkerFailed, match=r"worker 1 on the Ray cluster \(process \d+, node \w+\) has ended: Actor.*died"
    ):
        train(cut, kill_in_round_3, processes=2, cluster=address)
    assert len(pids) == 1 and cut.load_checkpoint()[0] == 2
    train(RunFolder(tmp_path / "cut"), processes=2, cluster=address)
    assert checkpoint_of(cut) == checkpoint_of(whole) != b""


def test_train_command_names_the_command_that_continues(address: str, tmp_path: Path) -> None:
    """Its worker is killed as soon as the first round is complete; then the command is continued without a cluster."""
    file, folder = tmp_path / "short.json", tmp_path / "run"
    file.write_text(training(dagger={"rounds": 6, "epochs": 2}).model_dump_json(exclude_none=True), encoding="utf-8")
    command = [*START, "train", str(file), "--out", str(folder), "--ray", address]
    with subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        assert process.stdout is not None
        said = b""
        while b"round 1:" not in said:
            line = process.stdout.readline()
            assert line, said.decode()
            said += line
        workers = [each for each in psutil.Process().children(recursive=True) if "ray::_RayServer" in each.name()]
        assert len(workers) == 2
        workers[0].kill()
        said += process.stdout.read()
    assert process.returncode == 1
    words = plain_text(said.decode())
    assert re.search(r"error: environment worker \d on the Ray cluster .* has ended", words), words
    assert f"Continue: tacsim train --resume {folder} --ray {address}" in words
    assert "Traceback" not in words
    result = tacsim("train", "--resume", folder)
    assert result.exit_code == 0, result.output
    assert (folder / "policy.onnx").exists()
