"""The page of every report: the answer first, then folding sections; one file that works offline.

A report has one or more chapters. Each opens with its answer: a sentence with the number, its
standard deviation and the condition; the plot that proves it; what to do next; and what it does not
cover. The page can be read without its script, which copies tables and reads values off plots.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from thermocald import __version__
from thermocald.errors import DriverMissing
from thermocald.numbers import typeset_powers

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from thermocald.figures import Figure

_Record = TypeVar("_Record")
_TEMPLATES = Path(__file__).parent / "templates"
_A_YEAR = 31_557_600.0
_RIGHT_TO_LEFT = "\u0590-\u08ff\ufb1d-\ufdff\ufe70-\ufefc"
# no line break between a number, its standard deviation and their unit, or within an option
_PROSE = re.compile(r"<(p|li|figcaption)\b[^>]*>.*?</\1>", re.DOTALL)
_BEFORE_UNIT = re.compile(
    r"(?<=[\d)¹²³⁰-⁹]) (?=[±%°]|(?:px|[mµc]?m|[hsKσ]|min|minutes)\b)|(?<=±) | (?==)"
)
_SYMBOL = re.compile(r"[cσxy][₀\s:,]")
_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
_WORDS_TO_LEFT = re.compile(
    f"[{_RIGHT_TO_LEFT}](?:[{_RIGHT_TO_LEFT}\\s\u200c\u200d-]*[{_RIGHT_TO_LEFT}])?"
)


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text; note: what the columns mean."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    @classmethod
    def of(
        cls,
        title: str,
        records: Iterable[_Record],
        columns: Mapping[str, Callable[[_Record], str]],
        note: str = "",
    ) -> Table:
        """Return a table with a row per record; columns: {heading: function that writes a cell}."""
        rows = tuple(tuple(cell(record) for cell in columns.values()) for record in records)
        return cls(title, tuple(columns), rows, note)


@dataclass(frozen=True)
class Answer:
    """A chapter's opening card; more: sentences after the first."""

    sentence: str
    proof: Figure | None = None
    more: tuple[str, ...] = ()
    next_steps: tuple[str, ...] = ()
    not_covered: tuple[str, ...] = ()


@dataclass(frozen=True)
class Section:
    """Text, figures, items (head, text) and tables, in that order; folded: shut at first.

    printed: a command's output, shown unchanged.
    """

    title: str
    text: tuple[str, ...] = ()
    figures: tuple[Figure, ...] = ()
    tables: tuple[Table, ...] = ()
    items: tuple[tuple[str, str], ...] = ()
    folded: bool = False
    printed: str = ""


@dataclass(frozen=True)
class Chapter:
    """A chapter about one camera, recording or field; about: where its data come from."""

    title: str
    answer: Answer
    sections: tuple[Section, ...]
    about: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def page(self) -> str:
        """Return a report of this chapter alone, as HTML text."""
        return render_report(self.title, [self])


def render_report(title: str, chapters: Sequence[Chapter], lead: str = "") -> str:
    """Return the page of a report as HTML text; DriverMissing if Jinja is not installed."""
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
    except ImportError:
        raise DriverMissing("a report needs Jinja: pip install 'thermocald[report]'") from None

    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=select_autoescape(["html", "j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        # else a camera's name in Hebrew or Arabic would swap the width and height after it
        finalize=lambda value: (
            _WORDS_TO_LEFT.sub(lambda m: f"\u2068{m[0]}\u2069", value)
            if type(value) is str
            else value
        ),
    )
    environment.filters["powers"] = typeset_powers
    at = datetime.now(tz=UTC)
    versions = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy"))
    page = environment.get_template("report.html.j2").render(
        title=title,
        lead=lead,
        chapters=chapters,
        made=f"Made on {at:%Y-%m-%d at %H:%M} UTC with thermocald {__version__} ({versions}). "
        "Numbers have one standard deviation (±); bands in figures hold 95 %.",
        style=(_TEMPLATES / "report.css").read_text(encoding="utf-8"),
        script=(_TEMPLATES / "report.js").read_text(encoding="utf-8"),
    )
    together = r'<span class="option">\g<0></span>'
    return _PROSE.sub(lambda m: _OPTION.sub(together, _BEFORE_UNIT.sub("\u00a0", m[0])), page)


def as_sentence(text: str) -> str:
    """Return a line with a full stop and a capital letter, unless it begins with a symbol."""
    text = text.strip().rstrip(".")
    return f"{text if _SYMBOL.match(text) else text[:1].upper() + text[1:]}."


def day(start_utc: float) -> str:
    """Return a series' start, or that it has no date: simulated recordings begin in 1970."""
    if not start_utc > _A_YEAR:
        return "(no date)"
    return f"{datetime.fromtimestamp(start_utc, tz=UTC):%Y-%m-%d %H:%M} UTC"
