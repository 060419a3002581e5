"""The documentation as a site: built strictly, whole in itself, with nothing from elsewhere.

With `strict` and the `validation` of mkdocs.yml, MkDocs itself fails for links and anchors that do
not resolve, and for pages that the navigation does not reach.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from functools import cache
from html import unescape
from importlib.metadata import entry_points
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from tests.docs.blocks import ROOT
from thermocald import config
from thermocald.physics import catalogue

sys.path.insert(0, str(ROOT / "docs"))

from _site import reference

LOADED = re.compile(
    r"""<(?:script|img|iframe|source|audio|video|embed|object|image|use|link)\b[^>]*?
    \s(?:src|href|data|srcset)=["']?([^"'\s>]+)""", re.VERBOSE,
)  # fmt: skip
OUTSIDE = re.compile(r"(https?:)?//")


def build(folder: Path, api: bool) -> Path:
    """The site as `make docs` builds it; warnings are errors."""
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", folder],
        cwd=ROOT, check=False, capture_output=True, text=True,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1",
             "THERMOCALD_DOCS_API": "yes" if api else "no"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "WARNING" not in done.stderr
    return folder


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """api → the folder of the site, built once."""
    return cache(lambda api: build(tmp_path_factory.mktemp("site"), api))


@pytest.fixture(
    scope="module", params=["pages", pytest.param("with modules", marks=pytest.mark.slow)]
)
def site(request, built):
    """The folder of the built site, and {its page: HTML}."""
    folder = built(request.param == "with modules")
    return folder, {path: path.read_text() for path in sorted(folder.rglob("*.html"))}


def text_of(html: str) -> str:
    return unescape(re.sub(r"<(script|style)\b.*?</\1>|<[^>]*>", "", html, flags=re.DOTALL))


def test_nothing_is_loaded_from_elsewhere(site):
    folder, pages = site
    assert len(pages) > 30
    for path, html in pages.items():
        loaded = [unescape(address) for address in LOADED.findall(html)]
        assert loaded, path
        assert not [a for a in loaded if OUTSIDE.match(a)], path
        if path.name != "404.html":  # its addresses are absolute, since it stands for any page
            missing = [a for a in loaded if not a.startswith("data:")
                       and not (path.parent / unquote(urlsplit(a).path)).exists()]  # fmt: skip
            assert not missing, path
    for path in (*pages, *folder.rglob("*.css")):
        assert not re.search(r"url\(['\"]?(https?:)?//|@import\s+['\"u]", path.read_text()), path


def test_formulas_are_mathml(site):
    _, pages = site
    of_explanation = [html for path, html in pages.items() if path.parent.name == "explanation"]
    assert sum(html.count("<math") for html in of_explanation) > 150
    for path, html in pages.items():
        assert "arithmatex" not in html, path
        assert not re.search(r"\\(frac|sum|text|mathsf|bar|sigma)\b", text_of(html)), path


def test_the_reference_has_every_command_key_effect_and_driver(site):
    folder, pages = site
    commands, configuration, effects, drivers = (
        text_of(pages[folder / f"reference/{name}.html"])
        for name in ("cli", "config", "effects", "drivers")
    )
    assert [name for name, _ in reference.commands() if name not in commands] == []
    known = keys(config.Config) | keys(config.CalibrationConfig)
    assert [key for key in known if not re.search(rf"\b{key}\b", configuration)] == []
    assert [name for name in catalogue.names() if name not in effects] == []
    for kind in ("cameras", "thermometers", "outputs"):
        for point in entry_points(group=f"thermocald.{kind}"):
            assert point.name in drivers or not point.value.startswith("thermocald_drivers")


def keys(model) -> set[str]:
    found = set()
    for name, field in model.model_fields.items():
        found.add(field.alias or name)
        for inner in re.findall(r"(\w+Config)", str(field.annotation)):
            found |= keys(getattr(config, inner))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 390])
def test_the_search_works_from_a_folder(built, page_of, width):
    page = page_of((built(False) / "index.html").as_uri(), width=width, height=800)
    if width < 600:
        page.locator("label.md-icon[for=__search]").first.click()
    box = page.locator("input.md-search__input")
    box.click()
    box.press_sequentially("hysteresis", delay=30)
    page.locator("li.md-search-result__item").first.wait_for(timeout=20_000)
    assert "hysteresis" in page.locator("ol.md-search-result__list").inner_text().lower()
    assert [p for p in page.problems if not p.startswith("file:")] == []
