"""The base class of results, which can be printed, written as JSON, drawn and reported."""

from __future__ import annotations

import csv
import io
import math
from abc import ABC, abstractmethod
from dataclasses import fields, is_dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald.errors import UsageError
from thermocald.files import write_text
from thermocald.names import checked

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    Column = NDArray[Any] | Sequence[str]
    Columns = dict[str, Column]


_ROWS = 20_000


@checked
class Result(ABC):
    """The result of an analysis; `print` shows what the command prints."""

    def __init_subclass__(cls) -> None:
        """Let every result print alike, and its public methods check their arguments."""
        super().__init_subclass__()
        cls.__repr__ = Result.__repr__  # type: ignore[method-assign] # not that of its dataclass
        checked(cls)

    heading = "Results"
    caption = "The results over time, with their standard deviations."

    @abstractmethod
    def as_dict(self) -> dict[str, Any]:
        """Return the document that the command writes with `--json`."""

    @abstractmethod
    def lines(self) -> list[str]:
        """Return the lines that the command prints."""

    def answer(self) -> str:
        """Return a report's first sentence, without its full stop."""
        return self.lines()[0]

    def plot(self) -> Figure:
        """Draw the result with matplotlib (extra `report`). Raises UsageError without a drawing."""
        raise UsageError(f"a {type(self).__name__} has no drawing: print it, or use as_dict()")

    def report(self, path: Path | str, title: str = "") -> Path:
        """Write the result as one HTML file that works offline; return its path.

        title: the page's, by default `heading`. Raises OutputError if the file cannot be written.
        """
        write_text(Path(path), self.page(title))
        return Path(path)

    def page(self, title: str = "") -> str:
        """Return the report as HTML text; title: by default `heading`."""
        from thermocald.figures import Figure
        from thermocald.report import Answer, Chapter, Section

        answer = self.answer()
        others = [line for line in self.lines() if line != answer]
        drawn = type(self).plot is not Result.plot
        proof = Figure("proof", "Results", self.caption, drawing=self.plot()) if drawn else None
        text = Section("What the command prints", printed="\n".join(others))
        return Chapter(title or self.heading, Answer(f"{answer}.", proof), (text,)).page()

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.lines()[0]}>"

    def _repr_html_(self) -> str:
        """Return the HTML that a notebook shows."""
        return f"<pre>{escape(str(self))}</pre>"


def new_figure(rows: int, panel: tuple[float, float] = (5.0, 2.0)) -> tuple[Figure, Any]:
    """Make a matplotlib figure and its axes (rows, 1) without a window or pyplot's state.

    panel: width and height of an axis, inches. Raises DriverMissing if matplotlib is not installed.
    """
    from thermocald.figures import new_drawing

    with new_drawing(panel[0], panel[1] * rows) as figure:
        return figure, figure.subplots(rows, 1, squeeze=False, sharex=True)


def jsonable(value: Any) -> Any:
    """Return a value as JSON holds it: NaN and infinity as null, paths as text.

    Arrays and tuples become lists; an object with `as_dict` becomes that document, another
    dataclass its `document_of`.
    """
    if isinstance(value, dict):
        return {str(key): jsonable(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(inner) for inner in value]
    if hasattr(value, "tolist"):  # an array, or one of its numbers
        return jsonable(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "as_dict"):
        return jsonable(value.as_dict())
    return document_of(value) if is_dataclass(value) and not isinstance(value, type) else value


def document_of(record: Any) -> dict[str, Any]:
    """Return a dataclass as JSON holds it: its fields by name.

    The class attribute JSON, {attribute: key}, changes this: it gives another key, "" to leave an
    attribute out, or "*" to merge the attribute's own document; an attribute that is no field is
    added.
    """
    named = {field.name: field.name for field in fields(record)} | getattr(record, "JSON", {})
    document: dict[str, Any] = {}
    for name, key in named.items():
        if key:
            value = jsonable(getattr(record, name))
            document |= value if key == "*" else {key: value}
    return document


def with_sds(names: Iterable[str], values: Iterable[Any], sds: Iterable[Any]) -> dict[str, float]:
    """Return {name: value} and {sd_name: standard deviation} in one mapping."""
    named = list(names)
    numbers = {name: float(value) for name, value in zip(named, values, strict=True)}
    return numbers | {f"sd_{name}": float(sd) for name, sd in zip(named, sds, strict=True)}


def csv_text(
    parts: Iterable[Mapping[str, Column]], separator: str = ",", decimal: str = "."
) -> Iterator[str]:
    """Yield columns as CSV, with every digit of the numbers; unknown values are empty."""
    for number, columns in enumerate(parts):
        text = io.StringIO()
        writer = csv.writer(text, delimiter=separator, lineterminator="\n")
        if number == 0:
            writer.writerow(columns)
        cells = [_cells(name, values, decimal) for name, values in columns.items()]
        writer.writerows(zip(*cells, strict=True))
        yield text.getvalue()


def in_parts(columns: Columns) -> Iterator[Columns]:
    """Yield columns some thousand rows at a time: the text of a year's takes gigabytes."""
    for first in range(0, max(len(next(iter(columns.values()))), 1), _ROWS):
        yield {name: values[first : first + _ROWS] for name, values in columns.items()}


def _cells(name: str, values: Column, decimal: str) -> Iterable[str]:
    import numpy as np  # the command line's list of commands does without

    if not isinstance(values, np.ndarray):
        return values
    if values.dtype.kind in "iU":
        return map(str, values.tolist())
    digits = (
        "" if not math.isfinite(v) else f"{v:.6f}" if name == "frame_time" else repr(v)
        for v in values.tolist()
    )
    return (d.replace(".", decimal) for d in digits) if decimal != "." else digits
