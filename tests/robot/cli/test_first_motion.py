"""From a shipped hardware file to a first motion: every command of README and docs/bringup.md on a copy with only
hosts and cameras changed, before mocks that pass for real arms."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path

import pytest

from robot.rig import hardware_rig
from tests.robot.cli.invoked import tacsim
from tests.robot.cli.lab import Lab, copy_of

if find_spec("rtde_control") is None:
    pytest.skip("ur_rtde has no wheel for this Python and machine", allow_module_level=True)

pytestmark = pytest.mark.usefixtures("empty_folder")


def test_a_dry_run_on_a_copy_of_the_one_arm_file(tmp_path: Path) -> None:
    file = copy_of("ur5e-one", tmp_path, 61)
    with Lab(file):
        result = tacsim("run", str(file), "--dry-run", "--steps", "2", "--out", "dry")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "dry" / "report.html").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--task", "squeeze"], r"task 'squeeze'.*lacks .*ground truth.*--set task=null"),
        (["--policy", "mine:NeedsHeight"], r"lacks surface height.*Take --policy grip, which needs pictures alone"),
        (["--policy", "nothing"], "no policy 'nothing'"),
        (["--set", "arms.arm.limits.depth=1 mm"], r"limits\.depth: sensor 'finger' does not measure it"),
        (["--set", "arms.arm.simulator=false"], "is a real one, but its host .* is this machine.*simulator: true"),
        (["--set", "arms.arm.host=192.0.2.1"], r"simulator: true.*host 192\.0\.2\.1 is outside this machine"),
        (["--set", "arms.arm.mock={}"], "either a maker's simulator .* or our mock"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_is_opened(
    tmp_path: Path, words: list[str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def opened(*_: object, **__: object) -> None:
        pytest.fail("something was opened")

    for part in ("MockCell", "Camera", "URArm"):
        monkeypatch.setattr(getattr(hardware_rig, part), "__init__", opened)
    (tmp_path / "mine.py").write_text(
        "from tacsim import Needs\nclass NeedsHeight:\n    needs = Needs(height=True)\n"
        "    def reset(self): ...\n    def __call__(self, observation): ...\n"
    )
    file = copy_of("ur5e-one", tmp_path, 61)
    result = tacsim("run", str(file), *words, "--dry-run", "--out", "out")
    assert result.exit_code in (1, 2), result.output
    assert re.search(said, " ".join(result.stderr.split())), result.stderr
    assert not (tmp_path / "out").exists()
