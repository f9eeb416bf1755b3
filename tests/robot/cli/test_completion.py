"""Completion in a shell: commands, options, and the names of rigs, sensors, tasks, policies and drivers."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.robot.cli.invoked import START, environment, tacsim


def complete(words: str) -> set[str]:
    """What bash would offer for the last word of a command line."""
    done = tacsim(
        _TACSIM_COMPLETE="complete_bash",
        COMP_WORDS=words,
        COMP_CWORD=str(len(words.split(" ")) - 1),
        _TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION="1",
    )
    return set(done.stdout.split("\n")) - {""}


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("tacsim tra", {"train", "transfer"}),
        ("tacsim calibrate t", {"touch"}),
        ("tacsim run --see", {"--seed"}),
        ("tacsim run ur", {"ur5e", "ur5e-mujoco", "ur5e-one"}),
        ("tacsim doctor --rig moc", {"mock"}),
        ("tacsim calibrate latency ur5e-", {"ur5e-mujoco", "ur5e-one"}),
        (
            "tacsim run --task ",
            {"squeeze", "reposition", "knead", "lengthen", "relief", "hold", "turn", "peg", "drawer"},
        ),
        ("tacsim run --policy ", {"scripted", "grip", "learned"}),
        ("tacsim evaluate squeeze --policy te", {"teacher"}),
        ("tacsim press sphere --sensor gelsight-m", {"gelsight-mini"}),
        ("tacsim press sphere --preset ", {"learn", "draft", "standard"}),
        ("tacsim show arm.", {"arm.ur", "arm.sim", "arm.replay"}),
        ("tacsim list dr", {"driver"}),
        ("tacsim new rig mine --from ur5e-", {"ur5e-mujoco", "ur5e-one"}),
        ("tacsim schema be", {"bench", "benchmark"}),
        ("tacsim run my.ya", set()),  # the shell then completes files
    ],
)
def test_words_that_are_offered(words: str, offered: set[str]) -> None:
    found = complete(words)
    assert offered <= found if words.startswith("tacsim show") else found == offered


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_bash_completes_by_the_script_that_the_command_prints(tmp_path: Path) -> None:
    command = tmp_path / "tacsim"
    command.write_text(f"#!{sys.executable}\n{START[-1]}\n", encoding="utf-8")
    command.chmod(0o755)
    script = (
        f'PATH="{tmp_path}:$PATH"\n'
        'eval "$(_TACSIM_COMPLETE=source_bash tacsim)"\n'
        "COMP_WORDS=(tacsim run ur); COMP_CWORD=2\n"
        '_tacsim_completion tacsim\nprintf "%s\\n" "${COMPREPLY[@]}"\n'
    )
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, env=environment(), check=True)
    assert set(done.stdout.split()) == {"ur5e", "ur5e-mujoco", "ur5e-one"}, done.stderr


def test_completion_costs_the_start_nothing() -> None:
    """The catalogue of names, which needs pydantic, is loaded for a completion only."""
    code = f"import sys; sys.argv = ['tacsim', 'run', '-h']\ntry:\n    {START[-1]}\nfinally:\n    print(*sys.modules)"
    words = {key: value for key, value in os.environ.items() if not key.startswith("_")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment() | words)
    assert "tacsim.config" not in done.stdout.split() and "robot.cli.run" in done.stdout.split()
