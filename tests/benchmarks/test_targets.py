"""What must be reached: figures from rows, and what is said of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.cases.real import ball_touch, costs
from benchmarks.cases.registry import CASES
from benchmarks.harness.schema import Report, Row
from benchmarks.pages.targets import TARGETS, Selection, Target, Verdict, lines

ROOT = Path(__file__).resolve().parents[2]


def row(**changes: Any) -> Row:
    config = {
        "group": "press", "case": "sphere_press", "method": "tacsim", "resolution": "h 0.5 mm", "seconds": 0.2,
        "spread": None, "cpu_seconds": 0.2, "repeats": 1, "error": 2.0, "error_unit": "µm rms", "against": "limit",
        "peak_mb": 170.0,
    }  # fmt: skip
    return Row.model_validate({**config, **changes})


def target(name: str) -> Target:
    (found,) = [each for each in TARGETS if each.name == name]
    return found


def judged(name: str, rows: list[Row]) -> tuple[float | None, Verdict]:
    value = target(name).find(rows)
    return value, target(name).evaluate(value)


def test_met_missed_and_in_between() -> None:
    seconds = target("press of a ball R 4 mm, 1 mm deep, h 0.5 mm")
    assert (seconds.must, seconds.aim) == (0.3, 0.05)
    name = seconds.name
    for value, verdict in ((0.31, "missed"), (0.3, "met"), (0.06, "met"), (0.05, "aim met")):
        assert judged(name, [row(seconds=value)]) == (value, verdict)
    assert judged(name, []) == (None, "not measured")
    assert judged(name, [row(resolution="h 1 mm")])[1] == "not measured"
    assert judged(name, [row(method="layer")])[1] == "not measured"


def test_a_ratio_is_of_one_run_and_larger_is_better() -> None:
    faster = "... faster than at Tacchi's settings"
    ours, theirs = row(seconds=0.1), row(method="tacchi-settings", resolution="dx 0.129 mm", seconds=20.0)
    assert judged(faster, [ours, theirs]) == (pytest.approx(200.0), "met")
    assert judged(faster, [ours, row(method="tacchi-settings", seconds=9.0)])[1] == "missed"
    assert judged(faster, [ours, row(method="tacchi-settings", seconds=51.0)])[1] == "aim met"
    assert judged(faster, [ours])[1] == judged(faster, [theirs])[1] == "not measured"
    seconds = Selection(what="seconds", case="a")
    assert Target(name="b", value=seconds, over=seconds).find([row(case="a", seconds=0.0)]) is None


def test_the_worst_row_counts() -> None:
    rows = [row(case="squeeze", variant="settled to 1 %", error=e, resolution=r) for e, r in ((0.2, "a"), (1.4, "b"))]
    assert judged("... force against the slow limit", rows) == (1.4, "missed")
    assert judged("... force against the slow limit", rows[:1]) == (0.2, "aim met")


def test_figures_of_a_row_and_units() -> None:
    step = row(case="plasticine_alone", figures={"wall_per_particle_substep_ns": 76.0})
    assert judged("plasticine step, 64,000 particles, wall: plasticine alone", [step]) == (76.0, "missed")
    control = row(
        case="control_step", variant="0.1 mm, flowing, and two images", seconds=0.02, resolution="particles 0.5 mm"
    )
    assert judged("control step, draft, two images: flowing", [control]) == (pytest.approx(20.0), "met")
    assert judged("control step, draft, two images: each one settled", [control])[1] == "not measured"


def test_only_an_aim() -> None:
    force = "gel force, ball against FFT layer, h 0.5 mm"
    assert target(force).must is None
    assert judged(force, [row(case="sphere_force", error=1.5)])[1] == "aim missed"
    assert judged(force, [row(case="sphere_force", error=0.5)])[1] == "aim met"


def test_shallow_real_presses_do_not_count() -> None:
    def real(depth: float, error: float, what: str) -> Row:
        return row(case="contact_radius", variant=f"R 3 mm, {depth} mm deep: {what}", error=error,
                   figures={"depth_mm": depth})  # fmt: skip

    rows = [real(0.25, 5.0, "image"), real(0.5, 1.0, "image"), real(1.0, 1.5, "image"), real(1.0, 3.0, "pressure")]
    image = Selection(what="error", case="contact_radius", ending=": image", from_depth_mm=0.5)
    assert image(rows) == 1.5
    assert judged("contact radius, our image against real ones", rows)[1] == "met"
    assert judged("contact radius, our contact against labels", rows)[1] == "missed"
    assert image(rows[:1]) is None
    thin = [each.model_copy(update={"resolution": f"gel {8 + index} mm"}) for index, each in enumerate(rows)]
    assert image.model_copy(update={"gel": "gel 10 mm"})(thin) == 1.5


def test_the_table_says_it_in_words() -> None:
    shown = {cells[0]: cells[1:] for cells in lines([row(seconds=0.5)])}
    assert shown["press of a ball R 4 mm, 1 mm deep, h 0.5 mm"] == ["0.5 s", "≤ 0.3", "≤ 0.05", "**missed**"]
    assert shown["... faster than at Tacchi's settings"] == ["", "≥ 100", "≥ 500", "not measured"]
    assert shown["soft gels, sensors closed by 80 %: force against slab theory"][-1] == "not measured"
    slab = lines([row(case="slab", variant="sensors closed by 80 %", error=40.0)], TARGETS)
    assert "**missed**: beyond the limit it must be explained: docs/physics.md, How to choose" in {c[-1] for c in slab}
    assert "test_no_case_ended_the_process" in shown["hard cases that end their process"][-1]


def test_targets_have_names_of_their_own_and_an_aim_no_laxer_than_the_must() -> None:
    assert len({each.name for each in TARGETS}) == len(TARGETS)
    for each in TARGETS:
        assert each.must is not None or each.aim is not None
        if each.must is not None and each.aim is not None:
            assert each.aim >= each.must if each.is_min_limit else each.aim <= each.must


NOT_YET = {"hard cases that end their process"}


def test_every_figure_is_fed_by_a_case_that_exists() -> None:
    """Rows made of the cases' own names and resolutions, with the variants and figures that the targets ask for."""
    variants = ["", "tolerance", "kernels compiled", "two speeds, Mach 0.03 and 0.015", "not settled", "settled to 1 %",
                "force balance", "overlap", "0.1 mm, flowing", "0.1 mm, settled",
                "gap", "sensors closed by 80 %", "by 67 %", "by 80 %",
                "settled", "flowing at Mach 0.03, the default", "flowing, heights and forces: a step of 16",
                "settled, heights and forces: a step of 16", "flowing, two pictures of 160 x 120: a step of 16",
                "flowing, two pictures of 160 x 120: a reset", "a ball: force", "a ball: contact radius",
                "0.5 mm, friction 0.6", "round box, friction 0.6", "time 10: force", "700 cycles",
                "its centre", "its farthest particle", "stick limit", "lattice, 3 mm", "random, 3 mm",
                "R 3 mm, 1 mm deep: image", "R 3 mm, 1 mm deep: pressure",
                "THUsight: picture", "THUsight: normals", "Taxim: picture", "FOTS: picture", "R 3 mm: height",
                "surfaces: drift, gain −30 %", "640 x 480", "320 x 240",
                "pictures: rho, difference", "pictures: rho, gradient", "pictures: rho, height",
                "surfaces: rho, gradient", "surfaces: rho, height"]  # fmt: skip
    names = ["wall_per_particle_substep_ns", "cpu_per_element_substep_ns", "second_ms", "momentum", "angular_momentum"]
    names += ["worst_percent", "env_steps_per_s", "volume_off", "settled_error"]
    names += ["kept_percent", "kept_in_picture_percent", "jitter_px"]
    names += ["ncc", "ssim", "whole_percent", "auc", "auc_low", "extra_deg", "bound_ratio"]
    figures = {**dict.fromkeys(names, 1.0), "depth_mm": 1.0}
    keys = [(case.group, case.name, case.method, case.resolution) for case in CASES]
    keys.append(("real", "contact_radius", "tacsim", "ball R 3 mm, gel 8 mm"))
    keys.append(("real", "marker_film", "tacsim", "the film's own pixels"))
    keys += [("real", name, "tacsim", "") for name in ("ball_presses", "known_depth", "invariance")]
    keys.append(("real", "punch", "layer", ""))
    keys += [(case.group, case.name, case.method, case.resolution) for case in (*costs.CASES, *ball_touch.CASES)]
    rows = [
        row(group=group, case=name, method=method, resolution=resolution, variant=variant, figures=figures)
        for group, name, method, resolution in keys
        for variant in variants
    ]
    assert {each.name for each in TARGETS if each.find(rows) is None} == NOT_YET


def test_figures_of_the_published_report_follow_from_its_rows() -> None:
    report = Report.model_validate_json((ROOT / "benchmarks" / "reference.json").read_bytes())
    by = {(r.case, r.method, r.resolution.partition(",")[0]): r for r in report.results}
    ours, theirs = by["sphere_press", "tacsim", "h 0.5 mm"], by["sphere_press", "tacchi-settings", "dx 0.129 mm"]
    value, _ = judged("... faster than at Tacchi's settings", report.results)
    assert value == pytest.approx(theirs.seconds / ours.seconds)
