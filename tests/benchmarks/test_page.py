"""The command, the page, the picture."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from matplotlib.image import imread

from benchmarks.harness.schema import Report, Row
from benchmarks.pages import reliability
from benchmarks.pages.page import FIGURES_PAGE, INDEX, cells, costs, pages
from benchmarks.pages.picture import PICTURE, RADII, VERDICTS, draw, draw_radii, draw_verdicts
from benchmarks.pages.targets import TARGETS
from tests.robot.cli.invoked import tacsim

ROOT = Path(__file__).resolve().parents[2]
REFERENCE = ROOT / "benchmarks" / "reference.json"


@pytest.fixture(scope="module")
def report() -> Report:
    return Report.model_validate_json(REFERENCE.read_bytes())


@pytest.mark.slow
def test_the_published_pages_are_those_of_the_published_reports(report: Report) -> None:
    gpus = [Report.model_validate_json(p.read_bytes()) for p in sorted((ROOT / "benchmarks" / "gpu").glob("*.json"))]
    robot = Report.model_validate_json((ROOT / "benchmarks" / "reliability.json").read_bytes())
    made = {**pages(report, gpus), "reliability.md": reliability.markdown(robot)}
    stale = [name for name, text in made.items() if (ROOT / "docs" / name).read_text(encoding="utf-8") != text]
    left = {f"benchmarks/{path.name}" for path in (ROOT / "docs/benchmarks").glob("*.md")} - set(made)
    assert stale == [] and left == set(), (
        "run `tacsim bench --from benchmarks/NAME.json --docs docs`, with every report of the page"
    )


def test_the_published_report_is_whole(report: Report) -> None:
    assert report.failures == []
    groups = {row.group for row in report.results}
    assert groups == set(report.metadata.groups) >= {"press", "squeeze", "materials", "scenes", "real"}
    assert {"tacsim", "layer", "seed", "textbook", "tacchi-settings"} == {row.method for row in report.results}


def test_a_row_is_shown_with_time_error_and_memory(report: Report) -> None:
    row = report.results[0].model_copy(
        update={
            "seconds": 0.12345,
            "spread": 0.02,
            "error": 3.4567,
            "error_unit": "%",
            "peak_mb": 171.3,
            "variant": "v",
        }
    )
    shown = cells(row)
    assert shown[0] == f"{row.case}: v"
    assert "0.123 ± 0.02" in shown and "3.46 %" in shown and "171" in shown
    beside = row.model_copy(update={"error": 3.4567, "error_unit": "grey", "figures": {"null_grey": 42.17}})
    assert "3.46 grey (null 42.2)" in cells(beside)
    bare = row.model_copy(update={"figures": {"wall_per_particle_substep_ns": 75.4, "force_n": 1.0}})
    assert costs(bare) == ["75 ns wall a substep and particle"]


@pytest.mark.slow
def test_a_report_is_shown_and_written_again_without_measuring(tmp_path: Path, report: Report) -> None:
    result = tacsim(
        "bench", "--from", REFERENCE, "--json", tmp_path / "new" / "again.json", "--docs", tmp_path / "docs"
    )
    assert result.exit_code == 0, result.output
    assert "sphere_press" in result.stdout and "tacchi-settings" in result.stdout
    again = Report.model_validate_json((tmp_path / "new" / "again.json").read_bytes())
    assert again == report
    assert imread(tmp_path / "new" / PICTURE).std() > 0.01
    made = {name: (tmp_path / "docs" / name).read_text(encoding="utf-8") for name in pages(report)}
    assert made == pages(report)
    assert all((tmp_path / "docs" / "images" / name).is_file() for name in (PICTURE, VERDICTS, RADII))


@pytest.mark.parametrize("make", [draw, draw_verdicts])
def test_a_picture_of_nothing_is_drawn_too(make: Callable[[list[Row], Path], None], tmp_path: Path) -> None:
    make([], tmp_path / "empty.png")
    assert imread(tmp_path / "empty.png").shape[2] in (3, 4)


def test_every_row_is_on_one_page_and_the_index_leads_to_all(report: Report) -> None:
    found = pages(report)
    names = {f"benchmarks/{group}.md" for group in {row.group for row in report.results}} | {FIGURES_PAGE}
    assert set(found) == names | {INDEX}
    assert all(f"]({name})" in found[INDEX] for name in names)
    assert f"](images/{PICTURE})" in found[INDEX] and f"](images/{VERDICTS})" in found[INDEX]
    for group in {row.group for row in report.results} - {"oracles"}:  # there a line is a case
        lines = [line for line in found[f"benchmarks/{group}.md"].splitlines() if line.startswith("| ")]
        assert len(lines) == 1 + sum(row.group == group for row in report.results)


def test_the_picture_of_figures_shows_how_many_met_their_requirement(tmp_path: Path, report: Report) -> None:
    """A figure twice its requirement moves a point to the right of the line."""
    target = next(each for each in TARGETS if each.must is not None and each.find(report.results) is not None)
    limit = target.find(report.results)
    shown = []
    for must in (2 * limit, limit / 2):
        draw_verdicts(report.results, tmp_path / "one.png", [target.model_copy(update={"must": must, "aim": None})])
        shown.append(imread(tmp_path / "one.png"))
    assert abs(shown[0] - shown[1]).max() > 0.1


@pytest.mark.slow
def test_a_failure_is_shown_and_is_the_exit_code(tmp_path: Path, report: Report) -> None:
    failure = {"group": "press", "case": "lost", "method": "tacsim", "resolution": "h", "cause": "it broke | here"}
    broken = json.loads(report.model_dump_json()) | {"failures": [failure]}
    (tmp_path / "broken.json").write_text(json.dumps(broken), encoding="utf-8")
    result = tacsim("bench", "--from", tmp_path / "broken.json")
    assert result.exit_code == 1
    assert "lost" in result.output and "it broke" in result.output


def test_what_is_no_report_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other.json").write_text('{"results": []}', encoding="utf-8")
    result = tacsim("bench", "--from", tmp_path / "other.json")
    assert result.exit_code == 2
    assert "metadata" in result.output
    assert tacsim("bench", "--from", tmp_path / "none.json").exit_code != 0
    assert tacsim("bench", "nothing").exit_code == 2
    assert tacsim("bench", "--repeat", "0").exit_code == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "repetitions"),
    [(["robot"], 1), (["robot", "--long"], 5), (["press"], 5), (["robot", "--repeat", "3"], 3)],
)
def test_the_robot_is_measured_once_without_long(
    monkeypatch: pytest.MonkeyPatch, report: Report, words: list[str], repetitions: int
) -> None:
    asked = []

    def run(first: object, repeat: int | None = None, **_: object) -> Report:
        asked.append(first if repeat is None else repeat)
        return report

    monkeypatch.setattr("benchmarks.command.run_cases", run)
    monkeypatch.setattr("benchmarks.command._measure_robot", run)
    assert tacsim("bench", *words).exit_code == 0
    assert asked == [repetitions]


@pytest.mark.parametrize("words", [("bench", "press"), ("schema", "bench")])
def test_without_a_checkout_it_says_where_the_benchmarks_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    """As from a wheel; a foreign package `benchmarks` beside it, or on the path, is not taken for ours."""
    installed = tmp_path / "robot" / "cli" / "bench.py"
    (tmp_path / "benchmarks").mkdir()
    (tmp_path / "benchmarks" / "command.py").write_text("raise AssertionError")
    monkeypatch.setattr(sys.modules["robot.cli.bench"], "__file__", str(installed))
    result = tacsim(*words)
    assert result.exit_code == 2
    assert f"tacsim {' '.join(words[:1])}" in result.output and "needs a checkout of tacsim" in result.output


def test_a_foreign_package_of_that_name_is_not_taken(tmp_path: Path) -> None:
    (tmp_path / "benchmarks").mkdir()
    (tmp_path / "benchmarks" / "__init__.py").write_text("raise AssertionError")
    code = f"import sys; sys.path[:0] = [{str(tmp_path)!r}, {str(ROOT)!r}]; from robot.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, "schema", "bench"], capture_output=True, text=True, cwd=ROOT, timeout=60
    )
    assert done.returncode == 0, done.stderr


def test_the_page_shows_figures_and_a_missed_one(report: Report) -> None:
    found = pages(report)
    assert "| figure | measured | must | aim | verdict |" in found[FIGURES_PAGE]
    assert "## How to read and rerun" in found[INDEX]
    late = {"figures": {"second_ms": 99.0}}
    slow = [row.model_copy(update=late) for row in report.results if row.case == "second_world"]
    missed = pages(report.model_copy(update={"results": slow}))[FIGURES_PAGE]
    assert "| a second world is ready | 99 ms | ≤ 50 |  | **missed** |" in missed


def test_the_page_shows_how_long_a_group_takes(report: Report) -> None:
    def page(**seconds: float) -> str:
        metadata = report.metadata.model_copy(update={"group_seconds": seconds})
        return pages(report.model_copy(update={"metadata": metadata}))[FIGURES_PAGE]

    name = "a group without `--baselines` and `--long`"
    assert f"| {name} (press 12 s, squeeze 39 s) | 39.4 s | ≤ 40 |  | met |" in page(press=12.3, squeeze=39.4)
    assert f"| {name} (press 41 s) | 41 s | ≤ 40 |  | **missed** |" in page(press=41.0)
    assert f"| {name} |  | ≤ 40 |  | not measured |" in page()


@pytest.mark.slow
def test_real_rows_bring_their_picture(tmp_path: Path, report: Report) -> None:
    figures = {"depth_mm": 0.5, "ball_radius_mm": 3.0, "thickness_mm": 10.0, "real_px": 20.0, "pressure_px": 21.0}
    changes = {"group": "real", "case": "contact_radius", "variant": "R 3 mm: image", "figures": figures}
    row = report.results[0].model_copy(update=changes)
    made_up = report.model_copy(update={"results": [row for row in report.results if row.group != "real"]})
    more = made_up.model_copy(update={"results": [*made_up.results, row]})
    assert f"](../images/{RADII})" in pages(more)["benchmarks/real.md"] and "benchmarks/real.md" not in pages(made_up)
    assert not draw_radii(made_up.results, tmp_path / RADII) and not (tmp_path / RADII).exists()
    (tmp_path / "real.json").write_text(more.model_dump_json(), encoding="utf-8")
    result = tacsim("bench", "--from", tmp_path / "real.json", "--docs", tmp_path)
    assert result.exit_code == 0, result.output
    assert imread(tmp_path / "images" / RADII).std() > 0.01


def test_help_and_schema() -> None:
    assert "Example: tacsim bench" in tacsim("bench", "--help").stdout
    schema = json.loads(tacsim("schema", "bench").stdout)
    assert set(schema["required"]) == {"metadata", "results"}


def test_listing_the_cases_starts_no_taichi() -> None:
    code = "import sys, benchmarks.cases.registry, benchmarks.pages.page; print('taichi' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "False"
