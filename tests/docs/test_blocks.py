"""Every bash and python block of README.md and docs/*.md runs; `make test` runs the first Python block of each page.

The blocks of one page run in order in one temporary folder, so a later block can use what an earlier one made; the
examples lie there.
A block is left out only by a comment right above it: ``<!-- not run: reason -->``.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
NOT_RUN = re.compile(r"<!--\s*not run:\s*(?P<reason>\S.*?)\s*-->")
RUN = {"bash", "python"}
SHOWN = {"", "text", "yaml", "json", "toml", "mermaid"}  # read, not run
LIMIT = 150.0  # one block [s]


@dataclass(frozen=True)
class Block:
    page: str
    line: int
    language: str
    code: str
    skipped: str | None  # the reason


def blocks_of(text: str, page: str) -> list[Block]:
    """The fenced blocks of a page, those in lists included, in order."""
    found = []
    above = ""
    for token in MarkdownIt().parse(text):
        if token.type == "fence":
            assert token.map is not None
            marker = NOT_RUN.search(above)
            language = (token.info.split() or [""])[0]
            found.append(Block(page, token.map[0] + 1, language, token.content, marker and marker["reason"]))
        if token.nesting == 0:  # openings and closings of lists do not stand between a comment and its block
            above = token.content if token.type == "html_block" else ""
    return found


def all_blocks() -> list[Block]:
    pages = (page for page in PAGES if page.is_file())
    return [block for page in pages for block in blocks_of(page.read_text(encoding="utf-8"), page.name)]


def run(block: Block, folder: Path, limit: float = LIMIT) -> tuple[int, str]:
    """Exit status and output of a block, run in `folder` with this environment's commands first in PATH."""
    shell = ["bash", "--noprofile", "--norc", "-euo", "pipefail", "-c"]
    command = [*shell, block.code] if block.language == "bash" else [sys.executable, "-c", block.code]
    binaries = str(Path(sys.executable).parent)
    environment = {**os.environ, "PATH": f"{binaries}{os.pathsep}{os.environ['PATH']}", "MPLBACKEND": "Agg"}
    with subprocess.Popen(
        command,
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,  # so that what the block started ends with it
    ) as process:
        try:
            output, _ = process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            output, _ = process.communicate()
            return 124, f"{output}\n(stopped after {limit:g} s)"
    return process.returncode, output


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {page.name: tmp_path_factory.mktemp(page.stem) for page in PAGES}


BLOCKS = [block for block in all_blocks() if block.language in RUN and block.skipped is None]
FIRST = {block.page: block for block in reversed(BLOCKS) if block.language == "python"}


def require_success(block: Block, folder: Path) -> None:
    shutil.copytree(ROOT / "examples", folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
    status, output = run(block, folder)
    assert status == 0, (
        f"{block.page}:{block.line} ends with {status}:\n{block.code}\n--- its output:\n{output[-4000:]}"
    )


@pytest.mark.slow
@pytest.mark.timeout(LIMIT + 30)
@pytest.mark.parametrize("page", sorted(FIRST))
def test_the_first_python_block_of_a_page_runs(page: str, tmp_path: Path) -> None:
    require_success(FIRST[page], tmp_path)


@pytest.mark.deep
@pytest.mark.timeout(LIMIT + 30)
@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: f"{block.page}:{block.line}")
def test_block_runs(block: Block, folders: dict[str, Path]) -> None:
    require_success(block, folders[block.page])


def test_readme_has_blocks_that_run() -> None:
    assert [
        block for block in all_blocks() if block.page == "README.md" and block.language in RUN and not block.skipped
    ]


def test_no_block_hides_behind_its_language() -> None:
    """`sh`, `shell`, `console`, `py` would silently not run: write bash or python."""
    assert [block for block in all_blocks() if block.language not in RUN | SHOWN] == []


EXAMPLE = """
```bash
echo one
```

- in a list

  <!-- not run: it would recurse -->
  ```bash
  make test
  ```

<!-- not run: -->
```python
print("a marker without a reason does not count")
```

<!-- not run: far away -->

A paragraph between.

```python
print("two")
```
"""


def test_blocks_are_found_and_left_out_only_by_a_reason_right_above() -> None:
    found = blocks_of(EXAMPLE, "example.md")
    assert [(block.line, block.language, block.skipped) for block in found] == [
        (2, "bash", None),
        (9, "bash", "it would recurse"),
        (14, "python", None),
        (22, "python", None),
    ]
    assert found[1].code == "make test\n"


@pytest.mark.parametrize(
    ("language", "code", "status", "output"),
    [
        ("bash", "echo a; false | true; echo b", 1, "a\n"),
        ("bash", "echo $undefined_name", 1, "unbound"),
        ("bash", "command -v python", 0, str(Path(sys.executable).parent)),
        ("python", "import pathlib; print(pathlib.Path.cwd())", 0, "{folder}"),
        ("python", "raise SystemExit(3)", 3, ""),
    ],
)
def test_a_failing_block_is_seen(language: str, code: str, status: int, output: str, tmp_path: Path) -> None:
    ended, said = run(Block("example.md", 1, language, code, None), tmp_path)
    assert ended == status, said
    assert output.replace("{folder}", str(tmp_path)) in said


def test_a_hanging_block_is_stopped_with_all_that_it_started(tmp_path: Path) -> None:
    ended, said = run(Block("example.md", 1, "bash", "echo before; sleep 60 | sleep 60", None), tmp_path, limit=1.0)
    assert ended == 124
    assert said.startswith("before")
