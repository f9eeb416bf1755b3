"""Students of the benchmark by what they see: `python -m benchmarks.policy_inputs FOLDER`.

Each learns from the same teacher (DAgger) in the training file of its task; what differs is what it sees: numbers,
maps of height, or pictures as the camera gives them. `tacsim benchmark run` then plays them in the frozen episodes of
`test` and `shift-all`. After an interruption the same command continues. docs/measurements/benchmark.md has the tables.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.transfer import run_tacsim, set_options

SPLITS = ("test", "shift-all")
MAPS = ["features.maps=[height]", "dagger.epochs=20"]  # a network with maps learns in fewer epochs
EQUAL_BUDGET = ["randomise.draws=128", "dagger.rounds=20"]  # of the students of hold: 38,400 control steps
# task -> what the student sees -> training file and its changes
POLICIES: dict[str, dict[str, tuple[str, list[str]]]] = {
    "squeeze": {
        "numbers": ("squeeze", []),
        "maps": ("squeeze", [*MAPS, "features.touch=[between]"]),
        "pictures": ("squeeze-pictures", ["features.touch=[between]"]),
    },
    "reposition": {
        "numbers": ("reposition", []),
        "maps": ("reposition", [*MAPS, "features.touch=[moved]"]),
        "pictures": ("reposition-pictures", []),
    },
    "squeeze-compliant": {
        "numbers": ("squeeze-compliant", []),
        "maps": (
            "squeeze-compliant",
            [*MAPS, "features.touch=[wrench, between, stepped]", "features.remembered=[wrench, between]"],
        ),
    },
    "reposition-compliant": {
        "numbers": ("reposition-compliant", []),
        "maps": (
            "reposition-compliant",
            [*MAPS, "features.touch=[moved, wrench, stepped]", "features.remembered=[moved, wrench]"],
        ),
    },
    "lengthen": {
        "numbers": ("lengthen", ["features.maps=[]"]),
        "maps": ("lengthen", ["dagger.epochs=20"]),
    },
    "hold": {
        "flow": ("hold", EQUAL_BUDGET),
        "depth": ("hold", [*EQUAL_BUDGET, "features.flow=false", "features.touch=[area, depth, wrench, grip]"]),
    },
}


def train(folder: Path, task: str, name: str, seed: int, processes: int) -> Path:
    """The policy's file; trained unless it is there. Needs the extra `train`."""
    policy = folder / "policies" / task / (name if seed == 0 else f"{name}-{seed}")
    file, run = policy.with_suffix(".onnx"), folder / "runs" / task / f"{name}-{seed}"
    if not file.exists():
        training, changes = POLICIES[task][name]
        given = ["--resume", str(run)] if run.exists() else [training, "--seed", str(seed), "--out", str(run)]
        run_tacsim("train", *given, "--processes", str(processes), *([] if run.exists() else set_options(changes)))
        file.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(run / "policy.onnx", file)
    return file


def main(
    folder: Annotated[Path, typer.Argument(help="Folder of all results.")] = Path("runs/policy-inputs"),
    task: Annotated[list[str] | None, typer.Option(help=f"Of {', '.join(POLICIES)}; none: all.")] = None,
    student: Annotated[list[str] | None, typer.Option(help="numbers, maps, pictures, flow, depth; none: all.")] = None,
    seed: int = 0,
    processes: int = 2,
) -> None:
    """Trains the students, and plays each in 24 frozen episodes of each split."""
    for each in task or list(POLICIES):
        for name in POLICIES[each]:
            if student and name not in student:
                continue
            file = train(folder, each, name, seed, processes)
            splits = [part for split in SPLITS for part in ("--split", split)]
            run_tacsim("benchmark", "run", each, "--policy", str(file), *splits, "--out", str(folder / "scores"))


if __name__ == "__main__":
    typer.run(main)
