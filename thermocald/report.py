"""The page of every report: the answer first, then sections that fold; one file, without network.

A report is one or more chapters. Each opens with its answer: a sentence with the number, its
standard deviation and the condition, the one plot that proves it, what to do next, and what it
does not cover. The page can be read without its script, which copies tables and reads plots off.
"""

from __future__ import annotations

import base64
import re
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald import __version__
from thermocald.figures import Figure, draw_matrix, draw_panel, inline_svg
from thermocald.numbers import typeset_powers

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array

_TEMPLATES = Path(__file__).parent / "templates"
_A_YEAR = 31_557_600.0
_RIGHT_TO_LEFT = "\u0590-\u08ff\ufb1d-\ufdff\ufe70-\ufefc"
_WORDS_TO_LEFT = re.compile(
    f"[{_RIGHT_TO_LEFT}](?:[{_RIGHT_TO_LEFT}\\s\u200c\u200d-]*[{_RIGHT_TO_LEFT}])?"
)


@dataclass(frozen=True)
class Drawing:
    """A figure as the page shows it; images: (label, PNG bytes)."""

    name: str
    title: str
    caption: str
    svgs: tuple[str, ...] = ()
    images: tuple[tuple[str, bytes], ...] = ()
    columns: int = 1
    width_rem: float = 27.0  # of a single column, on a page that has the room

    def sources(self) -> list[tuple[str, str]]:
        """(label, address) of each image."""
        start = "data:image/png;base64,"
        return [(label, start + base64.b64encode(png).decode()) for label, png in self.images]


@dataclass(frozen=True, slots=True)
class Table:
    """Headings and rows of text; note: what the columns mean."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


@dataclass(frozen=True)
class Answer:
    """The card that a chapter opens with; more: sentences beside the first."""

    sentence: str
    proof: Drawing | None = None
    more: tuple[str, ...] = ()
    next_steps: tuple[str, ...] = ()
    not_covered: tuple[str, ...] = ()


@dataclass(frozen=True)
class Section:
    """Text, figures, items (head, text), tables, in that order; folded: shut at first.

    printed: lines of a terminal, kept as they are.
    """

    title: str
    text: tuple[str, ...] = ()
    figures: tuple[Drawing, ...] = ()
    tables: tuple[Table, ...] = ()
    items: tuple[tuple[str, str], ...] = ()
    folded: bool = False
    printed: str = ""


@dataclass(frozen=True)
class Chapter:
    """One camera, recording or field; about: where its data come from."""

    title: str
    answer: Answer
    sections: tuple[Section, ...]
    about: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def render_report(
    title: str, chapters: Sequence[Chapter], lead: str = "", made: datetime | None = None
) -> str:
    """Return the page as HTML text; made: the time that it bears, by default now."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=select_autoescape(["html", "j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        finalize=lambda value: isolated(value) if type(value) is str else value,
    )
    environment.filters["powers"] = typeset_powers
    at = made or datetime.now(tz=UTC)
    versions = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy"))
    return environment.get_template("report.html.j2").render(
        title=title,
        lead=lead,
        chapters=chapters,
        made=f"Made on {at:%Y-%m-%d at %H:%M} UTC with thermocald {__version__} ({versions}). "
        "Numbers bear one standard deviation (±); bands in figures hold 95 %.",
        style=(_TEMPLATES / "report.css").read_text(encoding="utf-8"),
        script=(_TEMPLATES / "report.js").read_text(encoding="utf-8"),
    )


def isolated(text: str) -> str:
    """Return a text in which Hebrew and Arabic words turn nothing around but themselves.

    Else a camera's name exchanges the width and the height that follow it.
    """
    return _WORDS_TO_LEFT.sub(lambda m: f"\u2068{m[0]}\u2069", text)


def of_figure(figure: Figure, prefix: str = "") -> Drawing:
    """A figure of panels as the page shows it."""
    name = f"{prefix}{figure.name}"
    svgs = tuple(
        inline_svg(draw_panel(panel, legend=i == 0), f"{name}-{i}", panel.title)
        for i, panel in enumerate(figure.panels)
    )
    columns = min(figure.columns, len(figure.panels))
    return Drawing(name, figure.title, figure.caption, svgs, columns=columns)


def of_drawing(drawing: Any, name: str, title: str, caption: str) -> Drawing:
    """A drawing that is wider than a panel as the page shows it."""
    width_rem = 7.4 * float(drawing.get_size_inches()[0])
    return Drawing(name, title, caption, (inline_svg(drawing, name, title),), width_rem=width_rem)


def of_matrix(matrix: Array, names: Sequence[str], name: str, title: str, caption: str) -> Drawing:
    """A correlation matrix as the page shows it."""
    return of_drawing(draw_matrix(matrix, names, title), name, title, caption)


def day(start_utc: float) -> str:
    """The start of a series, or that it has no date: simulated recordings count from 1970."""
    if not start_utc > _A_YEAR:
        return "(no date)"
    return f"{datetime.fromtimestamp(start_utc, tz=UTC):%Y-%m-%d %H:%M} UTC"
