"""All generated pages of the site, by their path below docs/."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from tools.site import commands, files, interface, notebook

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOK = "first_ten_minutes.ipynb"
LISTS = {
    "decisions": "Each page states one decision, its reason, and what was tried instead.",
    "measurements": "How figures were measured, and their tables. The decisions refer to them.",
}


def generated_names() -> list[str]:
    """The paths of the generated pages, without making them."""
    pages = ["first_ten_minutes.md", "reference/commands.md", "reference/examples.md"]
    pages += [f"reference/files/{kind}.md" for kind in files.TITLES]
    pages += [f"reference/python/{subject}.md" for subject in interface.SUBJECTS]
    return pages + [f"{folder}/index.md" for folder in LISTS]


def generated_pages() -> Iterator[tuple[str, str]]:
    """Path and text of each generated page."""
    from robot.cli import app

    yield "first_ten_minutes.md", notebook.markdown(ROOT / "docs" / NOTEBOOK)
    yield "reference/commands.md", commands.markdown(app)
    yield "reference/examples.md", examples()
    for kind in files.TITLES:
        yield f"reference/files/{kind}.md", files.markdown(kind)
    for subject in interface.SUBJECTS:
        yield f"reference/python/{subject}.md", interface.markdown(subject)
    for folder in LISTS:
        yield f"{folder}/index.md", list_pages(folder)


def examples() -> str:
    """The example programs, each with the first paragraph of its docstring."""
    parts = ["# Examples", "Short programs with a check at their end. They need no hardware and leave no files."]
    for path in sorted((ROOT / "examples").glob("*.py")):
        source = path.read_text(encoding="utf-8")
        words = (ast.get_docstring(ast.parse(source)) or "").split("\n\n")[0].replace("\n", " ")
        parts += [f"## {path.name}", words, f"```python\n{source.strip()}\n```"]
    return "\n\n".join(parts) + "\n"


def list_pages(folder: str) -> str:
    """The list of the pages of a folder below docs/, by their titles."""
    parts = [f"# {folder.capitalize()}", LISTS[folder]]
    lines = []
    for path in sorted((ROOT / "docs" / folder).glob("*.md")):
        title = path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
        lines.append(f"- [{title.replace('. ', chr(92) + '. ', 1)}]({path.name})")
    return "\n\n".join([*parts, "\n".join(lines)]) + "\n"
