"""The hook of MkDocs: adds the generated pages, and turns links of the checkout into links of the site."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from tools.site.pages import LISTS, generated_names, generated_pages

EXAMPLE = re.compile(r"\]\(((?:\.\./)+)examples/(\w+)\.py\)")
LOADED = re.compile(r"<(?:script|link|img|iframe)[^>]*(?:src|href)=[\"']?(https?:[^\"' >]*)")
FOLDER = re.compile(rf"\]\(({'|'.join(LISTS)})/\)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Puts all pages of a folder where the navigation names the folder ("decisions/")."""
    assert config.nav is not None
    config.nav = _expand(config.nav, config.docs_dir)
    return config


def _expand(entry: Any, docs: str) -> Any:
    if isinstance(entry, list):
        return [_expand(each, docs) for each in entry]
    if isinstance(entry, dict):
        return {title: _expand(each, docs) for title, each in entry.items()}
    if not entry.endswith("/"):
        return entry
    written = {path.relative_to(docs).as_posix() for path in Path(docs, entry).glob("*.md")}
    generated = [name for name in generated_names() if name.startswith(entry)]
    pages = generated + sorted(written - set(generated))
    return sorted(pages, key=lambda page: not page.endswith("/index.md"))  # an index comes first


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the generated pages."""
    for path, text in generated_pages():
        files.append(File.generated(config, path, content=text))
    return files


def on_post_page(output: str, page: Page, **_: Any) -> str:
    """Refuses a page that would load something from the network. Raises PluginError."""
    if found := LOADED.search(output):
        raise PluginError(f"{page.file.src_uri} loads {found[1]}: the site must need no network where it is read")
    return output


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Leads links to examples and to folders to their pages on the site."""
    markdown = EXAMPLE.sub(lambda match: f"]({match[1][3:]}reference/examples.md#{match[2]}py)", markdown)
    return FOLDER.sub(r"](\1/index.md)", markdown)
