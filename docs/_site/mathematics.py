"""Formulas as MathML, which browsers draw by themselves: no script, no fonts, no network."""

from __future__ import annotations

import html
import re

from latex2mathml.converter import convert

__all__ = ["as_mathml"]

_FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\(?P<open>[(\[])(?P<latex>.*?)\\[)\]]</(?P=tag)>', re.S
)


def as_mathml(page: str) -> str:
    """Return a page with its `arithmatex` elements converted; ValueError if one cannot be."""
    return _FORMULA.sub(_converted, page)


def _converted(match: re.Match[str]) -> str:
    latex = html.unescape(match["latex"]).strip()
    block = match["open"] == "["
    mathml = convert(latex, display="block" if block else "inline")
    # the converter outputs unknown commands as text
    if unknown := re.search(r">(\\[A-Za-z]+)", mathml):
        raise ValueError(f"{unknown[1]} is unknown, in the formula {latex!r}")
    return f'<div class="formula">{mathml}</div>' if block else mathml
