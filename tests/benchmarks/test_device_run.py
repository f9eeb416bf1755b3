"""The program of `make test-gpu`, tried on the CPU: what it measures, keeps and says. No GPU is needed."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks.device_run import EXIT_NO_DEVICE, run_tests, wanted_cases
from benchmarks.harness.schema import Report
from tests.robot.cli.invoked import environment

ROOT = Path(__file__).resolve().parents[2]
START = (sys.executable, "-m", "benchmarks.device_run", "--largest", "1")
QUICK = "tests/tacsim/physics/motion/test_path.py"


def started(folder: Path, *words: str, device: str = "cpu") -> subprocess.Popen[str]:
    command = [*START, "--json", str(folder / "gpu/report.json"), *words]
    given = {**environment(), "TACSIM_DEVICE": device}
    return subprocess.Popen(
        command, env=given, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, bufsize=1
    )


def report_in(folder: Path) -> Report:
    return Report.model_validate_json((folder / "gpu/report.json").read_bytes())


def test_the_figures_are_of_one_to_1024_worlds() -> None:
    counts = [(case.name, int(case.resolution.partition(" ")[0])) for case in wanted_cases(1024)]
    assert sorted(counts) == sorted(
        [("batch", number) for number in (1, 64, 1024, 1, 64)] + [("random_actions", n) for n in (16, 256, 1024)]
    )
    assert [number for _, number in counts] == sorted(number for _, number in counts)  # the longest come last
    assert len(wanted_cases(1)) == 3


@pytest.mark.slow
def test_all_figures_and_tests_are_in_the_file(tmp_path: Path) -> None:
    with started(tmp_path, "--tests", QUICK, "--budget", "290") as program:
        said, _ = program.communicate()
    assert program.returncode == 0, said
    report = report_in(tmp_path)
    learn, draft, actions, tests = report.results
    assert learn.figures["wall_per_particle_substep_ns"] > 1.0 and learn.error == draft.error == actions.error == 0.0
    assert draft.seconds * 1e9 == pytest.approx(
        draft.figures["wall_per_particle_substep_ns"] * (draft.substeps or 0) * 8000
    )
    assert actions.figures["env_steps_per_s"] == pytest.approx(1 / actions.seconds, rel=0.9)
    assert tests.case == "device_tests" and tests.error == 0 and tests.figures["passed"] > 5
    assert not report.failures and report.metadata.machine.device is None


@pytest.mark.slow
def test_a_killed_run_keeps_what_it_has_measured(tmp_path: Path) -> None:
    with started(tmp_path) as program:
        while not (tmp_path / "gpu/report.json").exists():
            assert program.poll() is None
            time.sleep(0.05)
        program.send_signal(signal.SIGKILL)
        program.communicate()
    assert [row.case for row in report_in(tmp_path).results] == ["batch"]


@pytest.mark.slow
def test_what_the_budget_does_not_allow_is_named(tmp_path: Path) -> None:
    """20 s of the smallest budget are for the end of the tests."""
    with started(tmp_path, "--budget", "20.1") as program:
        said, _ = program.communicate()
    assert program.returncode == 1
    assert "not taken: random_actions, 1 x particles 1 mm, gel 2 mm, flowing: the run was stopped" in said
    assert "not taken: device_tests, physics: the budget was spent" in said
    assert len(report_in(tmp_path).failures) >= 3


@pytest.mark.slow
def test_a_failed_test_is_counted(tmp_path: Path) -> None:
    (tmp_path / "test_x.py").write_text("def test_a():\n    assert 0\ndef test_b():\n    pass\n", encoding="utf-8")
    (row,), wrong = run_tests(tmp_path / "test_x.py", lambda: False)
    assert row.error == 1 and row.figures["passed"] == 1 and wrong == "1 tests failed"
    (tmp_path / "test_y.py").write_text("import time\ndef test_c():\n    time.sleep(99)\n", encoding="utf-8")
    begun = time.monotonic()
    none, wrong = run_tests(tmp_path / "test_y.py", lambda: time.monotonic() > begun + 8)
    assert none == [] and "before all tests had run" in wrong and time.monotonic() < begun + 60


@pytest.mark.slow
@pytest.mark.skipif(Path("/dev/nvidia0").exists(), reason="there is a GPU")
def test_without_a_device_it_says_so(tmp_path: Path) -> None:
    with started(tmp_path, device="cuda") as program:
        said, _ = program.communicate()
    assert program.returncode == EXIT_NO_DEVICE
    assert "finds no device 'cuda'" in said and "Traceback" not in said
    assert not (tmp_path / "gpu").exists()
