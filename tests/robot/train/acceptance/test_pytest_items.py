"""The plug-in in sessions of pytest of their own: options, its one test, exit codes; others as ever."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from tests.robot.train.benchmark.small import TASK, write_task

pytestmark = pytest.mark.slow  # processes
ROOT = Path(__file__).resolve().parents[4]
COARSE = ("--success=0.9", "--indifference=0.5", "--alpha=0.1", "--beta=0.1", "--max-episodes=4")


def run_pytest(folder: Path, *words: str) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *words],
        cwd=folder, capture_output=True, text=True, timeout=200, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    return done.returncode, done.stdout + done.stderr


def test_sessions_without_a_policy_are_as_ever(tmp_path: Path) -> None:
    """A conftest.py may have options of the same names, and nothing of tacsim is imported."""
    (tmp_path / "conftest.py").write_text(
        "def pytest_addoption(parser):\n    parser.addoption('--task')\n    parser.addoption('--rig')\n"
    )
    (tmp_path / "test_one.py").write_text(
        "import sys\ndef test_one(request):\n    assert request.config.getoption('--task') == 'mine'\n"
        "    assert not {'robot', 'tacsim'} & set(sys.modules)\n"
    )
    code, said = run_pytest(tmp_path, "--task", "mine")
    assert code == 0 and "1 passed" in said, said


def test_an_accepted_policy_passes_and_the_folders_tests_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "test_fails.py").write_text("def test_fails():\n    assert False\n")
    values = TASK["values"] | {"task.goal": {"uniform": ["2.35 mm", "2.6 mm"]}}
    task = write_task(tmp_path, episodes=4, values=values)
    code, said = run_pytest(tmp_path, "--policy", "analytic", "--task", task, *COARSE, "--junitxml=found.xml")
    assert code == 0 and "1 passed" in said and "accepted: policy 'analytic'" in said, said
    properties = {
        each.get("name"): each.get("value") for each in ElementTree.parse(tmp_path / "found.xml").iter("property")
    }
    assert properties["verdict"] == "accepted" and properties["episodes"] == "3"


def test_a_rejected_policy_fails_in_words_without_a_traceback(tmp_path: Path) -> None:
    task = write_task(tmp_path, episodes=4)
    code, said = run_pytest(tmp_path, "--policy=random", "--task", task, *COARSE)
    assert code == 1 and "a failure of the policy" in said and "Traceback" not in said, said


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "--policy needs a task: --task squeeze"),
        (("--task", "squeez"), "did you mean 'squeeze'"),
        (("--task", "squeeze", "--success", "2"), "--success and --indifference"),
        (("--task", "squeeze", "--alpha", "0.9"), "alpha is a probability"),
        (("--task", "squeeze", "test_one.py"), "with --policy pytest tests the policy alone"),
        (("--task", "squeeze", "-n", "2"), "a sequential test is one process"),
        (("--task", "squeeze", "--rig", "real"), "invalid choice"),
    ],
)
def test_bad_requests_are_usage_errors(tmp_path: Path, words: tuple[str, ...], says: str) -> None:
    (tmp_path / "test_one.py").write_text("def test_one():\n    assert False\n")
    code, said = run_pytest(tmp_path, "--policy", "learned", *words)
    assert code == 4 and says in said and "Traceback" not in said, said
