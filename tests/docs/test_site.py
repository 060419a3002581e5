"""The documentation as a site: built strictly, whole in itself, with nothing from elsewhere."""

from __future__ import annotations

import inspect
import os
import pkgutil
import re
import subprocess
import sys
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
import yaml

from tests.docs.blocks import ROOT

sys.path.insert(0, str(ROOT / "docs"))

from _site import five_pages, reference

LOADED = {
    "script": "src", "img": "src", "iframe": "src", "source": "src", "audio": "src", "video": "src",
    "embed": "src", "object": "data", "image": "href", "use": "href",
}  # fmt: skip
LOADING_LINKS = {"stylesheet", "icon", "preload", "modulepreload", "preconnect", "dns-prefetch",
                 "manifest", "prefetch"}  # fmt: skip


def build(folder: Path, api: bool) -> Path:
    """The site as `make docs` builds it; warnings are errors."""
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        check=False,
        env={
            **os.environ,
            "NO_MKDOCS_2_WARNING": "1",
            "THERMOCALD_DOCS_API": "yes" if api else "no",
        },
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "WARNING" not in done.stderr
    return folder


class Document(HTMLParser):
    """Anchors, links, what is loaded, and the text of one page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.styles: list[str] = []
        self.text: list[str] = []
        self._inside: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        self._inside.append(tag)
        have = {k: v or "" for k, v in attrs}
        self.anchors |= {have[k] for k in ("id", "name") if k in have}
        self.styles.append(have.get("style", ""))
        if tag == "a" and "href" in have:
            self.links.append(have["href"])
        if tag == "link" and set(have.get("rel", "").split()) & LOADING_LINKS:
            self.loaded.append(have["href"])
        if tag in LOADED and LOADED[tag] in have:
            self.loaded.append(have[LOADED[tag]])
        if "srcset" in have:
            self.loaded += [part.split()[0] for part in have["srcset"].split(",")]

    def handle_endtag(self, tag):
        while self._inside and self._inside.pop() != tag:
            pass

    def handle_data(self, data):
        if self._inside[-1:] == ["style"]:
            self.styles.append(data)
        elif self._inside[-1:] != ["script"]:
            self.text.append(data)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """api → the folder of the site, built once."""
    return cache(lambda api: build(tmp_path_factory.mktemp("site"), api))


@pytest.fixture(
    scope="module", params=["pages", pytest.param("with modules", marks=pytest.mark.slow)]
)
def site(request, built):
    """{path: Document} of the built site, and its folder."""
    folder = built(request.param == "with modules")
    return folder, {path: Document(path) for path in sorted(folder.rglob("*.html"))}


def outside(address: str) -> bool:
    parts = urlsplit(address)
    return bool(parts.netloc) or parts.scheme in ("http", "https")


def test_every_link_and_anchor_resolves(site):
    folder, documents = site
    assert len(documents) > 30
    broken = []
    for path, document in documents.items():
        if path.name == "404.html":
            continue  # its links are absolute, since it stands for any address
        for link in document.links:
            parts = urlsplit(link)
            if outside(link) or parts.scheme in ("mailto", "data"):
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if target.is_dir():
                target /= "index.html"
            if not target.exists() or (
                parts.fragment
                and target in documents
                and unquote(parts.fragment) not in documents[target].anchors
            ):
                broken.append(f"{path.relative_to(folder)}: {link}")
    assert not broken, "\n".join(broken)


def test_nothing_is_loaded_from_elsewhere(site):
    folder, documents = site
    for path, document in documents.items():
        assert not [a for a in document.loaded if outside(a)], path
        assert not re.search(r"url\(['\"]?(https?:)?//|@import", " ".join(document.styles)), path
        if path.name != "404.html":
            missing = [a for a in document.loaded if not a.startswith("data:")
                       and not (path.parent / unquote(urlsplit(a).path)).exists()]  # fmt: skip
            assert not missing, path
    for style in folder.rglob("*.css"):
        assert not re.search(r"url\(['\"]?(https?:)?//|@import\s+['\"u]", style.read_text()), style


def test_formulas_are_mathml(site):
    _, documents = site
    pages = [p for p in documents if p.parent.name == "explanation"]
    count = sum(p.read_text().count("<math") for p in pages)
    assert count > 150
    for path, document in documents.items():
        text = "".join(document.text)
        assert "arithmatex" not in path.read_text(), path
        assert not re.search(r"\\(frac|sum|text|mathsf|bar|sigma)\b", text), path


def test_every_page_is_reached(site):
    """From the start page by links alone."""
    folder, documents = site
    reached, waiting = set(), [folder / "index.html"]
    while waiting:
        path = waiting.pop()
        if path in reached or path not in documents:
            continue
        reached.add(path)
        for link in documents[path].links:
            parts = urlsplit(link)
            if not outside(link) and parts.path:
                waiting.append((path.parent / unquote(parts.path)).resolve())
    assert set(documents) - reached == {folder / "404.html"}


def test_the_reference_has_every_command_key_effect_and_driver(site):
    from importlib.metadata import entry_points

    from thermocald.config import CalibrationConfig, Config
    from thermocald.physics import catalogue

    folder, documents = site

    def text(page):
        return "".join(documents[folder / "reference" / page].text)

    commands = text("cli.html")
    for name, _ in reference.commands():
        assert name in commands
    configuration = text("config.html")
    for key in (*keys(Config), *keys(CalibrationConfig)):
        assert re.search(rf"\b{key}\b", configuration), key
    for name in catalogue.names():
        assert name in text("effects.html")
    for kind in ("cameras", "thermometers", "outputs"):
        for point in entry_points(group=f"thermocald.{kind}"):
            if point.value.startswith("thermocald_drivers"):
                assert point.name in text("drivers.html")


def test_five_pages_of_code(site):
    """Each is there with its code, and none is longer than a page."""
    folder, documents = site
    text = "".join(documents[folder / "explanation" / "five-pages.html"].text)
    for title, (_, *names) in five_pages.PAGES.items():
        sources = [inspect.getsource(pkgutil.resolve_name(name)) for name in names]
        assert title in text
        assert all(source.splitlines()[0].strip() in text for source in sources)
        assert sum(len(source.splitlines()) for source in sources) <= 66, title


def keys(model) -> set[str]:
    from thermocald import config

    found = set()
    for name, field in model.model_fields.items():
        found.add(field.alias or name)
        for inner in re.findall(r"(\w+Config)", str(field.annotation)):
            found |= keys(getattr(config, inner))
    return found


def test_the_makefile_builds_it():
    text = (ROOT / "Makefile").read_text()
    assert re.search(r"^docs:.*\n\t.*mkdocs build", text, re.M)
    settings = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
    assert settings["strict"] is True
    assert settings["site_dir"] == "build/site"
    assert settings["theme"]["font"] is False
    # search from a folder: the index is a script, its worker a frame, and neither comes from a net
    assert "offline" in settings["plugins"]
    (script,) = settings["extra"]["polyfills"]
    assert "iframe-worker" in script  # else the plugin adds one from a public server
    assert (ROOT / "docs" / script).is_file()


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
