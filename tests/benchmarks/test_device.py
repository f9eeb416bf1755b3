"""Reports of a GPU: what they say, what they leave out, and how they come on the page. No GPU is needed."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from benchmarks.cases.real import ball_touch, costs
from benchmarks.cases.registry import CPU_ONLY, select_cases
from benchmarks.harness import machine
from benchmarks.harness.runner import run_cases
from benchmarks.harness.schema import Device, Failure, Missing, Report, Row, json_schema
from benchmarks.pages.page import INDEX, NO_DEVICE, pages
from tests.robot.cli.invoked import plain_text, tacsim

ROOT = Path(__file__).resolve().parents[2]
REFERENCE = ROOT / "benchmarks" / "reference.json"
GPU = Device(backend="cuda", name="Made-up 9000", memory_gb=24.0, driver="555.1")


@pytest.fixture(scope="module")
def cpu() -> Report:
    return Report.model_validate_json(REFERENCE.read_bytes())


def on(device: Device | None, report: Report, rows: list[Row], **more: object) -> Report:
    """`report` as if it had been measured on a device, with these rows alone."""
    machine = report.metadata.machine.model_copy(update={"device": device})
    config = report.metadata.model_copy(update={"machine": machine})
    return report.model_copy(update={"metadata": config, "results": rows, "failures": [], "missing": [], **more})


def row(report: Report, case: str) -> Row:
    return next(row for row in report.results if row.case == case)


def faster(row: Row, times: float, **changes: object) -> Row:
    return row.model_copy(update={"seconds": row.seconds / times, **changes})


def saved(folder: Path, **reports: Report) -> list[Path]:
    for name, report in reports.items():
        (folder / f"{name}.json").write_text(report.model_dump_json(), encoding="utf-8")
    return [folder / f"{name}.json" for name in reports]


def test_a_report_keeps_its_device(cpu: Report) -> None:
    there = on(GPU, cpu, cpu.results)
    assert Report.model_validate_json(there.model_dump_json()) == there
    assert there.metadata.machine.device == GPU
    assert cpu.metadata.machine.device is None  # an older report says nothing of devices
    assert "device" not in json_schema()["$defs"]["Machine"]["required"]
    assert json_schema()["$defs"]["Device"]["required"] == ["backend"]


@pytest.mark.skipif(sys.platform == "win32", reason="the made-up tool is a shell script")
@pytest.mark.parametrize(
    ("visible", "answer", "found"),
    [
        ("", "echo 'Made-up 9000, 24576, 555.1'; echo 'Other, 1, 555.1'", ("Made-up 9000", 25.8, "555.1")),
        ("1,0", "test $3 = --id=1 && echo 'Second, 1000, 555.1'", ("Second", 1.0, "555.1")),
        ("", "echo 'Shared, [N/A], 555.1'", ("Shared", None, "555.1")),
        ("", "echo 'no such words'", (None, None, None)),
        ("", "true", (None, None, None)),
        ("", "echo broken >&2; exit 9", (None, None, None)),
        ("", None, (None, None, None)),
    ],
)
def test_a_gpu_is_named_as_far_as_a_tool_names_it(
    visible: str, answer: str | None, found: tuple[object, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if answer is not None:
        (tmp_path / "nvidia-smi").write_text(f"#!/bin/sh\n{answer}\n", encoding="utf-8")
        (tmp_path / "nvidia-smi").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    monkeypatch.setenv("TACSIM_DEVICE", "cuda")
    device = run_cases([], 1, baselines=False).metadata.machine.device
    assert device is not None and device.backend == "cuda"
    assert (device.name, device.memory_gb, device.driver) == found
    assert device.title == (found[0] or "a cuda device")
    for variable, backend in (("vulkan", "vulkan"), ("cpu", None), ("", None)):
        monkeypatch.setenv("TACSIM_DEVICE", variable)
        other = run_cases([], 1, baselines=False).metadata.machine.device
        assert other == (None if backend is None else Device(backend=backend))


def test_what_needs_the_cpu_is_named_and_not_run_on_a_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TACSIM_DEVICE", raising=False)
    groups = ("press", "squeeze", "materials", "scenes")
    here = select_cases(groups, baselines=True, long=True)
    assert not any(case.missing for case in here)
    monkeypatch.setenv("TACSIM_DEVICE", "cuda")
    there = select_cases(groups, baselines=True, long=True)
    assert [case.name for case in there] == [case.name for case in here]
    left = [case for case in there if case.missing]
    blocks = {"oedometer", "wave_speed", "momentum", "plasticine_alone"}
    assert {case.name for case in left if case.method == "tacsim"} == blocks
    assert {case.method for case in left} == {"tacsim", "seed", "textbook", "tacchi-settings", "layer"}
    measured = {case.name for case in there if not case.missing}
    assert measured >= {"sphere_press", "squeeze", "control_step", "batch", "gel_step", "yield_plateau", "second_world"}
    assert all(case.needs_cpu for case in (*costs.CASES, *ball_touch.CASES))
    report = run_cases(left, 1, baselines=True)
    assert report.results == [] and report.failures == []
    assert {lack.cause for lack in report.missing} == {CPU_ONLY}


def test_what_is_marked_in_the_materials_group_makes_a_single_block(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which `start` refuses on a device."""
    from benchmarks.truth import blocks

    def refuse(cpu_only: str | None = None) -> str:
        raise RuntimeError(cpu_only or "")

    monkeypatch.setattr(blocks, "start_taichi", refuse)
    for case in select_cases(["materials"], baselines=False):
        if case.cpu:
            with pytest.raises(RuntimeError, match="a single block"):
                case.measure(1)


def test_the_page_shows_a_device_and_how_much_faster_it_is(cpu: Report) -> None:
    press, step = row(cpu, "sphere_press"), row(cpu, "control_step")
    new = faster(press, 1.0, case="never_before")
    lost = Failure(group="press", case="flat_punch", method="tacsim", resolution="h", cause="it broke")
    lack = Missing(group="materials", case="momentum", method="tacsim", resolution="dx", cause=CPU_ONLY)
    first = on(GPU, cpu, [faster(press, 4.0), new], failures=[lost])
    second = on(GPU, cpu, [faster(step, 12.5)], missing=[lack])
    found, alone = pages(cpu, [first, second]), pages(cpu)
    assert [name for name in alone if alone[name] != found[name]] == [INDEX]  # nothing of the CPU's changes
    assert set(found) - set(alone) == {"benchmarks/gpu-made-up-9000.md"}
    assert NO_DEVICE not in found[INDEX] and NO_DEVICE in alone[INDEX]
    section = found["benchmarks/gpu-made-up-9000.md"]
    assert section.startswith("# On a GPU: Made-up 9000\n")
    assert f"Made-up 9000 (cuda, 24 GB, driver 555.1) next to {cpu.metadata.machine.cpu}," in section
    assert "| substeps | CPU / GPU |" in section
    lines = [line for line in section.splitlines() if line.startswith("| ")]
    assert next(line for line in lines if line.startswith("| sphere_press ")).endswith("| 4 x |")
    assert next(line for line in lines if line.startswith("| control_step: ")).endswith("| 12.5 x |")
    assert next(line for line in lines if line.startswith("| never_before ")).endswith("|  |")
    assert "- flat_punch, tacsim, h: it broke" in section
    assert f"Not measured there ({CPU_ONLY}): momentum, tacsim." in section
    other = on(Device(backend="vulkan"), cpu, [press])
    assert "benchmarks/gpu-a-vulkan-device.md" in pages(cpu, [first, other, second])


def test_a_ratio_is_of_the_very_same_row(cpu: Report) -> None:
    press = row(cpu, "sphere_press")
    for changes in ({"resolution": "h 9 mm"}, {"variant": "other"}, {"method": "other"}, {"seconds": 0.0}):
        section = pages(cpu, [on(GPU, cpu, [faster(press, 4.0, **changes)])])["benchmarks/gpu-made-up-9000.md"]
        assert "| sphere_press" in section and " x |" not in section


@pytest.mark.slow
def test_the_command_puts_reports_together(cpu: Report, tmp_path: Path) -> None:
    press = on(GPU, cpu, [faster(row(cpu, "sphere_press"), 4.0)])
    squeeze = on(GPU, cpu, [faster(row(cpu, "squeeze"), 3.0)])
    gpu, more = saved(tmp_path, gpu=press, more=squeeze)
    result = tacsim("bench", "--from", gpu, "--from", REFERENCE, "--from", more, "--docs", tmp_path / "docs")
    assert result.exit_code == 0, result.output
    for name, text in pages(cpu, [press, squeeze]).items():
        assert (tmp_path / "docs" / name).read_text(encoding="utf-8") == text
    shown = tacsim("bench", "--from", REFERENCE, "--from", gpu)
    assert shown.exit_code == 0 and "tacchi-settings" in shown.stdout
    assert shown.stdout.index("tacchi-settings") < shown.stdout.index("Made-up 9000 (cuda, 24 GB, driver 555.1)")
    alone = tacsim("bench", "--from", gpu)
    assert alone.exit_code == 0 and "sphere_press" in alone.stdout


def test_reports_that_make_no_page_are_refused(cpu: Report, tmp_path: Path) -> None:
    docs = tmp_path / "docs"
    robot = on(None, cpu, [], metadata=cpu.metadata.model_copy(update={"groups": ["robot"]}))
    gpu, arms = saved(tmp_path, gpu=on(GPU, cpu, [row(cpu, "sphere_press")]), arms=robot)
    (tmp_path / "text.json").write_text("no report", encoding="utf-8")
    for files, words in (
        ([gpu], "one report of the CPU; given are: none"),
        ([REFERENCE, gpu, REFERENCE], "one report of the CPU; given are: "),
        ([arms, gpu], "belong to one of the physics"),
        ([REFERENCE, tmp_path / "none.json"], "cannot be read: No such file"),
        ([REFERENCE, tmp_path], "cannot be read: "),
        ([REFERENCE, tmp_path / "text.json"], "is not a report of tacsim bench"),
    ):
        result = tacsim("bench", *(word for file in files for word in ("--from", file)), "--docs", docs)
        assert result.exit_code == 2, result.output
        assert words in plain_text(result.output) and "Traceback" not in result.output
    both = tacsim("bench", "--from", REFERENCE, "--from", gpu, "--json", tmp_path / "both.json")
    assert both.exit_code == 2 and "one file holds one report" in plain_text(both.output)
    measured = tacsim("bench", "press", "--docs", docs, TACSIM_DEVICE="cuda")
    assert measured.exit_code == 2 and "needs the CPU's report too" in plain_text(measured.output)
    assert not docs.exists() and not (tmp_path / "both.json").exists()


def test_a_failure_on_a_device_is_the_exit_code(cpu: Report, tmp_path: Path) -> None:
    lost = Failure(group="press", case="flat_punch", method="tacsim", resolution="h", cause="it broke")
    (gpu,) = saved(tmp_path, gpu=on(GPU, cpu, [], failures=[lost]))
    assert tacsim("bench", "--from", REFERENCE, "--from", gpu).exit_code == 1


def test_the_variable_is_read_as_the_simulator_reads_it(monkeypatch: pytest.MonkeyPatch) -> None:
    from tacsim.compute.runtime import DEVICE

    assert machine.backend() == DEVICE
    monkeypatch.setenv("TACSIM_DEVICE", "")
    assert machine.backend() == "cpu"
