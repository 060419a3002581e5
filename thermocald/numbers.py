"""Numbers in texts: with a standard deviation of two digits, and a unit."""

from __future__ import annotations

import math
import re
from itertools import takewhile
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

UNITS = {
    "c": "mm", "x0": "mm", "y0": "mm", "A1": "mm⁻²", "A2": "mm⁻⁴", "A3": "mm⁻⁶", "B1": "mm⁻¹",
    "B2": "mm⁻¹", "C1": "", "C2": "", "sigma0": "",
}  # fmt: skip
_SYMBOLS = {"sigma0": "σ₀", "x0": "x₀", "y0": "y₀"}
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_COMPUTED = re.compile(r"(?<![\w.])(\d+(?:\.\d+)?|\([-+]?\d[\d. ±]*\))e([+-]?\d{1,3})(?![\w.]*\w)")
_UNIT_POWER = re.compile(r"(?<![\w-])mm(-\d)(?![\w-])")
_MEASURED = re.compile(r"(?<![\w.,-])[+−]?\d[\d,]*(?:\.\d+)?(?: ± [\d.]*\d)?(?!\w)")
_DEGREES = re.compile(r"(?<=[\d)] )degC\b")
_NEGATIVE = re.compile(r"(?<![^\s(])-(?=\d)")
_MINUS = "−"
_LETTERS = {"c": "degC", "℃": "degC", "k": "K"}  # others, also 华, stand for °F
_STATED = re.compile(
    r"(?:°|º|˚|(?<![^\W\d_])deg(?:rees?|\.)?|(?<![^\W\d_])grad)[\s_-]*(?P<degree>[CFK])(?![^\W\d_])"
    r"|(?<![^\W\d_])(?P<before>[CFK])\s?[°º˚]"
    r"|[(\[{<]\s*[o*]?(?P<bracket>[CFK])\.?\s*[)\]}>,]"
    r"|(?P<word>celsius|f\w?[ah]r?h?r?[ae]n?h?ei[td]|fahr(?![^\W\d_])|kelvin)"
    r"|(?P<sign>[℃℉])|(?P<chinese>[华華]氏)"
    r"|te?mp(?:eratur[ae]?)?[\s_./:-]*(?P<temp>[CFK])(?![^\W\d_])"
    r"|[_,/]\s*(?P<tail>[CFK])$",
    re.IGNORECASE,
)


def parameter_label(name: str) -> str:
    """Return a parameter's or a thermometer's name for figures and tables."""
    return _SYMBOLS.get(name) or column_label(name).replace("_", " ")


def column_label(name: str) -> str:
    """Return the label (LBL) that a logger's column was given, else its quantity.

    Serial numbers are left out: `Temp, °C (LGR S/N: 204, SEN S/N: 204, LBL: housing)` is `housing`.
    """
    if label := re.search(r"(?<![^\W_])LBL(?![^\W_])[\W_]*(.*\w)", name):
        return label[1]
    serial = re.search(
        r"[\s,(_]*(?:(?:°\s?|deg)[CFK][\W_]+)?(?<![^\W_])(?:LGR|SEN)(?![^\W_]).*\d", name
    )
    return (name[: serial.start()] if serial else "") or name


def stated_unit(text: str) -> str | None:
    """Return the unit, one of `UNITS`, that a column's head or a reading states, or None.

    `(F)`, `[F]`, `°F`, `ºF`, `℉`, `degF`, `deg. F`, `TempF`, `temp_f`, `Temperature, F` and
    `Fahrenheit` are equivalent.
    """
    found = _STATED.search(text)
    if found is None:
        return None
    return _LETTERS.get(next(filter(None, found.groups()))[0].lower(), "degF")


def without_unit(text: str) -> str:
    """Return a column's head without the unit that it states: `Temp` of `Temp (°F)`, `temp_f`."""
    while found := _STATED.search(text):
        begin = found.start("temp") if found["temp"] else found.start()
        text = f"{text[:begin]} {text[found.end() :]}"
    return " ".join(text.split()).replace("_ _", "_").strip(" _.,/-()[]{}")


def shortened(text: str, most: int) -> str:
    """Shorten a text to at most `most` letters, in its middle, since the unit is at the end."""
    if len(text) <= most:
        return text
    tail = (most - 1) // 2
    return f"{text[: most - 1 - tail].rstrip()}…{text[-tail:].lstrip()}"


def distinct_names(names: Sequence[str], most: int) -> list[str]:
    """Shorten names to `most` letters each; those that would look alike begin where they differ."""
    short = [shortened(name, most) for name in names]
    if len(set(short)) == len(set(names)):
        return short
    same = sum(
        1 for _ in takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
    )
    word = max(names[0].rfind(" ", 0, same), names[0].rfind("_", 0, same)) + 1
    short = [f"…{name[word : word + most - 2]}…" for name in names]
    if len(set(short)) == len(set(names)):
        return short
    return [shortened(f"{names.index(name) + 1}: {name}", most) for name in names]


def without_numbers(text: str) -> str:
    """Return a text with a mark in place of each number and its standard deviation."""
    return _MEASURED.sub("#", text)


def spanned(texts: Sequence[str]) -> str:
    """Return one text for several that differ in numbers: `3.1 ± 0.2 to 4.5 ± 0.1 px`, `2–3 s`."""

    def value(number: str) -> float:
        return float(number.split(" ")[0].replace(_MINUS, "-").replace(",", ""))

    def span(row: tuple[str, ...]) -> str:
        ends = dict.fromkeys((min(row, key=value), max(row, key=value)))
        plain_numbers = all(end[0].isdigit() and " " not in end for end in ends)
        return ("–" if plain_numbers else " to ").join(ends)

    spans = map(span, zip(*map(_MEASURED.findall, texts), strict=True))
    return _MEASURED.sub(lambda _: next(spans), texts[0])


def superscript(exponent: int) -> str:
    """Return an exponent in superscript digits."""
    return str(exponent).translate(_SUPERSCRIPT)


def typeset_powers(text: str) -> str:
    """Return a text with powers typeset: (-1.2 ± 0.1)e-06 mm-1 as (−1.2 ± 0.1)·10⁻⁶ mm⁻¹.

    The unit degC behind a number, as files spell it, becomes °C, a hyphen that opens one a minus.
    """
    text = _COMPUTED.sub(lambda m: f"{m[1]}·10{superscript(int(m[2]))}", text)
    text = _UNIT_POWER.sub(lambda m: f"mm{m[1].translate(_SUPERSCRIPT)}", text)
    return _NEGATIVE.sub(_MINUS, _DEGREES.sub("°C", text))


def with_sd(value: float, sd: float, unit: str = "") -> str:
    """Write `6.959 ± 0.028 mm`; NaN as a dash.

    With a power of ten below 0.001, and from 10000 if whole numbers would have idle digits.
    """
    if not math.isfinite(value):
        return "–"
    if not math.isfinite(sd) or sd <= 0:
        return plain(value, unit)
    largest = max(abs(value), sd)
    exponent = math.floor(math.log10(largest))
    scale = 0 if exponent >= -3 and (exponent < 4 or sd < 100) else exponent
    v, s = value / 10**scale, sd / 10**scale
    decimals = max(0, 1 - math.floor(math.log10(s)))
    body = f"{v:z.{decimals}f} ± {s:.{decimals}f}".replace("-", _MINUS)
    if scale:
        body = f"({body})·10{superscript(scale)}"
    return typeset_powers(f"{body} {unit}").rstrip()


def signed(value: float, sd: float, unit: str = "") -> str:
    """Write a number and its standard deviation with a sign: `+0.350 ± 0.002 px/K`."""
    text = with_sd(value, sd, unit)
    return f"+{text}" if value > 0 and not text.startswith("(") else text


def rounded(value: float, sd: float, unit: str = "") -> str:
    """Write a number, without its standard deviation, to the latter's second digit."""
    if not math.isfinite(value) or not math.isfinite(sd) or sd <= 0:
        return plain(value, unit, 6)
    largest = max(abs(value), sd)
    exponent = math.floor(math.log10(largest)) if largest < 1e-3 else 0
    decimals = max(0, 1 + exponent - math.floor(math.log10(sd)))
    return _times_power(value, exponent, decimals, unit)


def plain(value: float, unit: str = "", digits: int = 4) -> str:
    """Write a number to `digits` significant digits, with a power of ten if it needs one."""
    if not math.isfinite(value):
        return "∞" if math.isinf(value) else "–"
    if value == 0:
        return f"0 {unit}".rstrip()
    exponent = math.floor(math.log10(abs(value)))
    if -3 <= exponent < 5:
        return _times_power(value, 0, max(0, digits - 1 - exponent), unit)
    return _times_power(value, exponent, digits - 1, unit)


def _times_power(value: float, exponent: int, decimals: int, unit: str) -> str:
    """Write a number as a multiple of a power of ten, if that is not 1."""
    power = f"·10{superscript(exponent)}" if exponent else ""
    body = f"{value / 10**exponent:z.{decimals}f}{power}"
    return typeset_powers(f"{body} {unit}").rstrip().replace("-", _MINUS)


def celsius(T: float, decimals: int | None = None) -> str:
    """Write a temperature in °C, without the unit; by default to a hundredth at most."""
    text = f"{round(T, 2):zg}" if decimals is None else f"{T:z.{decimals}f}"
    return text.replace("-", _MINUS)


def counted(count: int, noun: str) -> str:
    """Write `1 epoch`, `3 epochs`."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def enumerated(parts: Sequence[str]) -> str:
    """Write `a`, `a and b`, `a, b and c`; empty for none."""
    return f"{', '.join(parts[:-1])} and {parts[-1]}" if len(parts) > 1 else "".join(parts)


def listed(names: Sequence[str], most: int) -> str:
    """Write `a, b, c`, or `a, b and 3 more` if there are more than `most`."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def duration(seconds: float) -> str:
    """Write a duration in words: `25 minutes`, `1 minute`, `3.5 hours`, `12 days`."""
    units = (("day", 86_400.0, 2.0), ("hour", 3600.0, 2.0), ("minute", 60.0, 59.5 / 60))
    longer = (one for one in units if seconds >= one[1] * one[2])
    unit, length, _ = next(longer, ("second", 1.0, 0.0))
    count = seconds / length
    shown = f"{count:.1f}" if count < 10 and length > 60 else f"{count:.0f}"
    return f"{shown} {unit}{'' if shown == '1' else 's'}"


def percent(share: float, decimals: int = 0) -> str:
    """Write a share as a percentage; 100 and 0 only for exactly all and none."""
    if not math.isfinite(share):
        return "–"
    shown = f"{100 * share:.{decimals}f}"
    smallest = 10**-decimals
    if share < 1 and float(shown) == 100:
        return f"> {100 - smallest:.{decimals}f} %"
    if share > 0 and float(shown) == 0:
        return f"< {smallest:.{decimals}f} %"
    return f"{shown} %"


def p_text(p: float) -> str:
    """Write a p-value with two digits, or as `≤ 0.001`."""
    if not math.isfinite(p):
        return "–"
    return "≤ 0.001" if p <= 0.001 else f"{p:.2g}"


def coefficient(r: float) -> str:
    """Write a correlation with two digits, near ±1 with three; ±1 only for exactly ±1."""
    if not math.isfinite(r):
        return "–"
    if abs(r) == 1:
        shown = f"{r:.0f}"
    elif abs(r) >= 0.995:
        # truncated, since rounding could give 1
        shown = f"{math.copysign(math.floor(abs(r) * 1000) / 1000, r):.3f}"
    else:
        shown = f"{r:.2f}".replace("-0.00", "0.00")
    return shown.replace("-", _MINUS)


def short_duration(seconds: float | None) -> str:
    """Write a duration in the largest unit that fits twice: `90 s`, `2 min`, `3 h`, `12 d`.

    seconds: may be negative; None or not finite is written `–`.
    """
    if seconds is None or not math.isfinite(seconds):
        return "–"
    for unit, size in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if abs(seconds) >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"
