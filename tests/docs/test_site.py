"""The pages that the site generates from the code, the navigation, and the notebook. `make docs` builds the site."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer
import yaml
from pydantic import BaseModel

from robot.cli import app
from tacsim.config import load_rig
from tacsim.config.kinds import KINDS
from tests.docs.test_architecture import anchors
from tools.site import commands, files, interface, notebook
from tools.site.comments import comments_of_fields
from tools.site.pages import generated_names, generated_pages

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
NOTEBOOK = DOCS / "first_ten_minutes.ipynb"
MAX_GUIDE_LINES = 150
LONG = {"physics-motion.md", "architecture.md", "reliability.md"}  # the first is read by topic, the others have rules


@pytest.fixture(scope="module")
def made() -> dict[str, str]:
    return dict(generated_pages())


def navigation() -> list[str]:
    """Every page and folder that mkdocs.yml names."""
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]

    def leaves(entry: object) -> list[str]:
        if isinstance(entry, str):
            return [entry]
        children = entry.values() if isinstance(entry, dict) else entry
        assert not isinstance(children, str)
        return [leaf for child in children for leaf in leaves(child)]  # type: ignore[attr-defined]

    return leaves(yaml.safe_load(text))


def test_every_page_is_in_the_navigation_once() -> None:
    named = navigation()
    assert len(named) == len(set(named))
    folders = tuple(each for each in named if each.endswith("/"))
    written = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")} | set(generated_names())
    assert {each for each in named if not each.endswith("/")} <= written
    assert [page for page in sorted(written) if page not in named and not page.startswith(folders)] == []


def test_the_site_loads_nothing_from_the_network() -> None:
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert "\n  font: false\n" in text and "\nstrict: true\n" in text
    assert not re.search(r"https?://", text)


@pytest.mark.parametrize("page", sorted(DOCS.glob("*.md")), ids=lambda page: page.name)
def test_a_guide_is_short(page: Path) -> None:
    if page.name not in LONG:
        assert len(page.read_text(encoding="utf-8").splitlines()) <= MAX_GUIDE_LINES


def test_readme_is_one_screen() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120


@pytest.mark.slow
def test_names_of_generated_pages_are_those_that_are_made(made: dict[str, str]) -> None:
    assert list(made) == generated_names()
    assert all(text.startswith("# ") for text in made.values())


def test_every_command_and_option_is_on_the_page(made: dict[str, str]) -> None:
    page = made["reference/commands.md"]

    def check(name: str, command: object) -> None:
        section = re.search(rf"^#+ `{re.escape(name)}`\n(.*?)(?=^#+ |\Z)", page, re.MULTILINE | re.DOTALL)
        assert section is not None, name
        for parameter in command.params:  # type: ignore[attr-defined]
            for option in parameter.opts if parameter.param_type_name == "option" and not parameter.hidden else []:
                assert option == "--help" or option == "-h" or f"`{option}" in section[1], (name, option)
        for child, each in getattr(command, "commands", {}).items():
            check(f"{name} {child}", each)

    tops = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    assert {"run", "press", "doctor", "bench"} <= set(tops)
    for name, command in tops.items():
        check(f"tacsim {name}", command)


def test_a_new_command_appears_by_itself() -> None:
    mine = typer.Typer()

    @mine.command("stroke")
    def stroke(depth: float = typer.Option(0.5, help="How deep | it goes.")) -> None:
        """Strokes a gel.

        Slowly.

        Example: none
        """

    @mine.command("other")
    def other() -> None:
        """Another one."""

    page = commands.markdown(mine)
    assert "## `tacsim stroke`\n\nStrokes a gel.\n\nSlowly." in page
    assert "| `--depth DEPTH` | How deep \\| it goes. | `0.5` |" in page


@pytest.mark.parametrize("kind", KINDS)
def test_every_key_of_a_file_is_on_its_page(kind: str, made: dict[str, str]) -> None:
    page = made[f"reference/files/{kind}.md"]
    for model in files.models_by_kind()[kind]:
        assert f"\n## {model.__name__}\n" in page
        for name in model.model_fields:
            assert f"\n| `{name}` | " in page
    for path in sorted((ROOT / "configs" / KINDS[kind].folder).glob("*.yaml")):
        assert path.read_text(encoding="utf-8").strip() in page


def test_links_between_the_pages_of_files_lead_somewhere(made: dict[str, str]) -> None:
    pages = {name: text for name, text in made.items() if name.startswith("reference/files/")}
    headings = {
        name: {line[3:].lower() for line in text.splitlines() if line.startswith("## ")} for name, text in pages.items()
    }
    links = {link for text in pages.values() for link in re.findall(r"\]\((\w+\.md)#(\w+)\)", text)}
    assert len(links) > 20
    assert [link for link in links if link[1] not in headings[f"reference/files/{link[0]}"]] == []


def test_a_key_has_its_type_bounds_default_and_comment() -> None:
    page = files.markdown("scene")
    assert "| `housing` | length [m] ≥ 0 or `null` | `0.0003` | None: no housing |" in page
    assert "| `preset` | `learn` or `draft` or `standard` | `draft` |  |" in page


def test_comments_behind_and_above_a_field_are_found() -> None:
    source = '''
    class Part(Base):
        """A part."""

        # Above,
        # in two lines.
        first: int = 1
        second: str = "# no comment"  # behind [m]
        third: float = 2  # type: ignore
        fourth: tuple[int, ...] = (
            1,
        )  # after the end
    '''
    found = comments_of_fields(source)
    assert found == {"first": "Above, in two lines.", "second": "behind [m]", "third": "", "fourth": "after the end"}


def test_every_public_name_is_on_one_page_of_the_interface() -> None:
    import json

    surface = json.loads((ROOT / "tests/api_surface.json").read_text(encoding="utf-8"))
    for package, names in surface.items():
        found = [
            name
            for subject, (_, home, _) in interface.SUBJECTS.items()
            if home == package
            for name in interface.public_names(subject)
        ]
        assert sorted(found) == names


def test_models_are_described_once() -> None:
    models: list[type[BaseModel]] = [each for models in files.models_by_kind().values() for each in models]
    assert len(models) == len(set(models))


def test_the_stand_has_no_arm_and_can_be_copied() -> None:
    config = load_rig("stand").config
    assert config.arms == {} and list(config.sensors) == ["finger"] and config.task is None


def test_the_notebook_is_a_page_with_links_that_lead_somewhere() -> None:
    page = notebook.markdown(NOTEBOOK)
    assert page.startswith("# First ten minutes") and page.count("```python\n") == len(notebook.code_cells(NOTEBOOK))
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", page):
        assert (DOCS / target).is_file(), target
    assert NOTEBOOK.stat().st_size < 50_000
    assert all(not cell.get("outputs") for cell in notebook.read(NOTEBOOK)["cells"])


def test_outputs_of_a_notebook_are_shown(tmp_path: Path) -> None:
    (tmp_path / "one.ipynb").write_text(
        '{"cells": [{"cell_type": "code", "source": ["1 + 1"], "outputs": [{"data": {"text/plain": ["2"]}}]}]}'
    )
    assert notebook.markdown(tmp_path / "one.ipynb") == "```python\n1 + 1\n```\n\n```text\n2\n```\n"


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_cells_of_the_notebook_run(tmp_path: Path) -> None:
    """In one program, as a notebook runs them."""
    program = "\n".join(notebook.code_cells(NOTEBOOK))
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", "import matplotlib; matplotlib.use('Agg')\n" + program],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=590,
    )
    assert done.returncode == 0, done.stderr
    assert "contact radius" in done.stdout and "step 10:" in done.stdout
    assert (tmp_path / "episode.mcap").stat().st_size > 10_000


def test_anchors_of_the_site_and_of_the_checkout_agree() -> None:
    assert "the-bodys-surface" in anchors(DOCS / "physics-body.md")
