"""A page of HTML from a template: one file in the style of all reports, that works offline."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from thermocald import __version__

__all__ = ["render_page"]

_STYLE = Path(__file__).parent / "study" / "templates" / "study.css"


def render_page(template: Path, **values: Any) -> str:
    """The template's text with its values, and with `style` and `footer`, which all pages share.

    A name that a template asks for and is not given is an error: jinja2.UndefinedError.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

    environment = Environment(
        loader=FileSystemLoader(template.parent),
        autoescape=select_autoescape(["html", "j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    values["style"] = _STYLE.read_text(encoding="utf-8")
    values["footer"] = f"thermocald {__version__}"
    return environment.get_template(template.name).render(values)
