"""The hooks of mkdocs for this site: generated pages, notebooks, mathematics.

Run by `mkdocs.yml`. Nothing is loaded from elsewhere: formulas become MathML while the site is
built. With `THERMOCALD_DOCS_API=no` the reference of the Python modules, which takes most of the
time, is left out.
"""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mkdocs.structure.files import File

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

five_pages, mathematics, notebooks, reference = (
    importlib.import_module(f"_site.{name}")
    for name in ("five_pages", "mathematics", "notebooks", "reference")
)

GENERATED = "<!-- generated -->"
GENERATORS = {**reference.GENERATORS, "explanation/five-pages.md": five_pages.page}


def api_wanted() -> bool:
    """Return whether the reference of the Python modules is built."""
    return os.environ.get("THERMOCALD_DOCS_API", "yes") != "no"


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the generated pages into the navigation, in place of `generated …`."""
    packages = reference.packages() if api_wanted() else []
    pages: Mapping[str, list[Any]] = {
        "examples": [f"examples/{path.stem}.md" for path in notebooks.found()],
        "api": [f"reference/api/{name}.md" for name in packages],
    }
    config.nav = _filled(config.nav, pages)
    if not api_wanted():
        config.plugins.pop("mkdocstrings")
    return config


def _filled(nav: Any, pages: Mapping[str, list[Any]]) -> Any:
    if isinstance(nav, list):
        out: list[Any] = []
        for entry in nav:
            if isinstance(entry, str) and entry.startswith("generated "):
                out += pages[entry.removeprefix("generated ")]
            else:
                out.append(_filled(entry, pages))
        return [e for e in out if not (isinstance(e, dict) and [] in e.values())]
    if isinstance(nav, dict):
        return {title: _filled(inner, pages) for title, inner in nav.items()}
    return nav


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made from code and from notebooks."""
    contents: dict[str, str | bytes] = {**notebooks.pages()}
    if api_wanted():
        contents |= reference.api_pages()
    for uri, content in contents.items():
        files.append(File.generated(config, uri, content=content))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Fill in the generated part of a page."""
    if GENERATED not in markdown:
        return markdown
    return markdown.replace(GENERATED, GENERATORS[page.file.src_uri]())


def on_page_content(html: str, **_: Any) -> str:
    """Convert the formulas of a page to MathML."""
    return mathematics.as_mathml(html)
