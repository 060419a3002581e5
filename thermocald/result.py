"""What an analysis gives: one object that is printed, written as JSON, drawn and reported."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald.errors import DriverMissing
from thermocald.files import write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Result(ABC):
    """What an analysis found; `print` shows what the command prints."""

    heading = "What was found"
    caption = "What was found over time, and its standard deviations."

    @abstractmethod
    def as_dict(self) -> dict[str, Any]:
        """Return the document that the command writes with `--json`."""

    @abstractmethod
    def lines(self) -> list[str]:
        """Return the lines that the command prints."""

    @abstractmethod
    def plot(self) -> Figure:
        """Draw the result with matplotlib (extra `report`)."""

    def report(self, path: Path | str, title: str = "") -> Path:
        """Write the result as one HTML file that works offline.

        title: of the page, by default `heading`. Returns the file's path; raises OutputError where
        it cannot be written.
        """
        from thermocald.report import Answer, Chapter, Section, of_drawing, render_report

        first, *others = self.lines()
        proof = of_drawing(self.plot(), "proof", "The result drawn", self.caption)
        said = Section("What the command prints", printed="\n".join(others))
        chapter = Chapter(title or self.heading, Answer(f"{first}.", proof), (said,))
        write_text(Path(path), render_report(chapter.title, [chapter]))
        return Path(path)

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.lines()[0]}>"

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        return f"<pre>{escape(str(self))}</pre>"


def new_figure(
    rows: int, columns: int = 1, panel: tuple[float, float] = (7.0, 2.2)
) -> tuple[Figure, Any]:
    """Make a figure of matplotlib and its axes (rows, columns), which no window and no state knows.

    panel: width and height of one, inches. Raises DriverMissing without matplotlib.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise DriverMissing(
            "a drawing needs matplotlib: pip install 'thermocald[report]'"
        ) from None

    class Shown(Figure):
        """A figure that a notebook shows without `%matplotlib`."""

        def _repr_svg_(self) -> str:
            return svg(self)

    figure = Shown(figsize=(panel[0] * columns, panel[1] * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, sharex=columns == 1)


def svg(figure: Figure) -> str:
    """Return a figure as an <svg> element."""
    import io

    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def jsonable(value: Any) -> Any:
    """Return a value as JSON has it: NaN and infinity as null, paths as text.

    Arrays and tuples become lists, what has `as_dict` that document, other dataclasses mappings of
    their fields, named as `metadata={"json": …}` says, left out where that is empty.
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
    fields = getattr(value, "__dataclass_fields__", None)
    if fields is not None and not isinstance(value, type):
        named = {name: field.metadata.get("json", name) for name, field in fields.items()}
        return {key: jsonable(getattr(value, name)) for name, key in named.items() if key}
    return value
