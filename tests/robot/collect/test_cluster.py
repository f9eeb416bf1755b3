"""A Ray cluster of two nodes on this machine, of which one is killed in the middle: the files are those of one process.

Runs where the extra `cluster` is installed (make test-extras).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ray = pytest.importorskip("ray")

from ray.cluster_utils import Cluster  # noqa: E402

from robot.collect.collect import collect  # noqa: E402
from robot.collect.folder import SetFolder  # noqa: E402
from robot.collect.workers import CollectFailed, Piece  # noqa: E402
from robot.common.cluster import ClusterError  # noqa: E402
from tests.robot.cli.invoked import environment  # noqa: E402
from tests.robot.collect.small import contents, job, rows  # noqa: E402

# Ray leaves sockets and files to the collector
pytestmark = [pytest.mark.filterwarnings("ignore"), pytest.mark.timeout(280)]


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Head and a second node of one CPU each, on the loopback: 127.0.0.1 Ray takes for the machine's other address."""
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("PYTHONPATH", environment()["PYTHONPATH"])  # a node's workers import what this process does
    few = {"num_cpus": 1, "object_store_memory": 100 * 2**20, "include_dashboard": False}
    found = Cluster(initialize_head=True, head_node_args={**few, "node_ip_address": "127.0.0.2"})
    try:
        found.add_node(**few, node_ip_address="127.0.0.3")
        yield found
    finally:
        found.shutdown()


def test_a_node_dies_and_nothing_is_lost_or_there_twice(
    cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With it die a task under way and the results that nobody had fetched. It is killed once it has made a piece."""
    made = job(80)
    collect(made, tmp_path / "whole", {}, "x")
    second = next(node for node in cluster.list_all_nodes() if node is not cluster.head_node)
    before: list[int] = []
    after: list[str] = []
    put = SetFolder.write_piece

    def spy(self: SetFolder, piece: Piece) -> None:
        put(self, piece)
        by = piece.worker.partition(":")[0]
        if not before and by == second.node_id:
            before.append(self.done)
            cluster.remove_node(second, allow_graceful=False)
        elif before:
            after.append(by)

    monkeypatch.setattr(SetFolder, "write_piece", spy)
    told: list[int] = []
    found = collect(
        made, tmp_path / "set", {}, "x", cluster=cluster.address, report_progress=lambda done, total: told.append(done)
    )
    assert found.made == 80 and not found.failures
    assert before and before[0] < 70  # in the middle
    assert after.count(cluster.head_node.node_id) >= 5
    assert told == list(range(0, 81, 2))
    assert contents(tmp_path / "set") == contents(tmp_path / "whole")
    assert [row["index"] for row in rows(tmp_path / "set")] == list(range(80))
    assert not ray.is_initialized()


def test_nodes_with_another_version_are_told(cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("robot.collect.collect.tacsim_version", lambda: "9.9")
    with pytest.raises(CollectFailed, match=r"a node has tacsim .*, the command runs with 9\.9"):
        collect(job(2), tmp_path / "set", {}, "x", cluster=cluster.address)
    assert not (tmp_path / "set/data").exists()


def test_no_cluster_at_the_address_is_an_error_in_words(tmp_path: Path) -> None:
    with pytest.raises(ClusterError, match=r"--ray 127\.0\.0\.1:1: no Ray cluster answers at this address"):
        collect(job(2), tmp_path / "set", {}, "x", cluster="127.0.0.1:1")
    assert not (tmp_path / "set").exists()
