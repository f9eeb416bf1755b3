"""A notebook as a page: its text, its code, and the pictures and lines that it keeps as output."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def code_cells(path: Path) -> list[str]:
    """The code of a notebook, cell by cell."""
    return ["".join(cell["source"]) for cell in read(path)["cells"] if cell["cell_type"] == "code"]


def read(path: Path) -> dict[str, Any]:
    """The content of a notebook. Raises OSError, ValueError."""
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content


def markdown(path: Path) -> str:
    """The page of a notebook."""
    parts = []
    for cell in read(path)["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", []):
            parts += _output(output)
    return "\n\n".join(parts) + "\n"


def _output(output: dict[str, Any]) -> list[str]:
    """One output of a cell: a picture, or text."""
    data = output.get("data", {})
    if "image/png" in data:
        return [f"![output of the cell](data:image/png;base64,{''.join(data['image/png']).strip()})"]
    text = "".join(output.get("text", data.get("text/plain", "")))
    return [f"```text\n{text.rstrip()}\n```"] if text else []
