"""Two outputs compared number by number; long lists are shortened.

Numbers of a document agree within a relative bound, or a share of their standard deviation (`sd_c`
for `c`, `sd` for `value`, or from their significance); members of a long list within a relative
bound of its RMS; numbers in a text within one unit of the last digit.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Iterator
from decimal import Decimal
from typing import Any, NamedTuple

import yaml

_NUMBER = re.compile(r"(?<![\w.])[-+−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_LONG = 12
_SAMPLES = 6
_NOTHING = 1e-13
_SHORTENED = ("some", "mean", "rms")


class Bounds(NamedTuple):
    """Bounds: relative to a number, in units of its standard deviation, and relative for sds."""

    relative: float
    in_sds: float
    of_sds: float


def shortened(value: Any) -> Any:
    """Return a document with long lists as length, some members, and mean and RMS of numbers."""
    if isinstance(value, dict):
        return {str(k): shortened(v) for k, v in value.items()}
    if not isinstance(value, list):
        return value
    if len(value) <= _LONG:
        return [shortened(v) for v in value]
    rows = sorted({round(i * (len(value) - 1) / (_SAMPLES - 1)) for i in range(_SAMPLES)})
    out = {"length": len(value), "some": [shortened(value[i]) for i in rows]}
    numbers = [v for v in value if isinstance(v, int | float)]
    if len(numbers) == len(value):
        out["mean"] = math.fsum(numbers) / len(numbers)
        out["rms"] = math.sqrt(math.fsum(v * v for v in numbers) / len(numbers))
    return out


def parsed(name: str, text: str) -> Any:
    """Parse a file as a document: JSON, YAML, columns of a CSV, or else lines of text."""
    if name.endswith(".json"):
        return json.loads(text)
    if name.endswith((".yaml", ".yml")) and not text.startswith("%"):  # OpenCV's is text
        return yaml.safe_load(text)
    if name.endswith(".csv"):
        rows = list(csv.DictReader(io.StringIO(text)))
        columns = {k: [_cell(row[k]) for row in rows] for k in (rows[0] if rows else {})}
        return {"rows": len(rows), **columns}
    return text.splitlines()


def _cell(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text


def differences(
    expected: Any, found: Any, bounds: Bounds, where: str = "", sd: float = 0.0, size: float = 0.0
) -> Iterator[str]:
    """Yield a sentence per difference; `size` is the RMS of the list that contains a number."""
    if isinstance(expected, dict) and isinstance(found, dict):
        if missing := [k for k in expected if k not in found]:
            yield f"{where}: without {', '.join(missing)}"
        if new := [k for k in found if k not in expected]:
            yield f"{where}: {', '.join(new)} is new"
        for key in expected.keys() & found.keys():
            own = sd if key in _SHORTENED else _beside(expected, key)
            inner = bounds._replace(relative=bounds.of_sds) if _is_sd(key) else bounds
            rms = expected.get("rms", 0.0) if key == "some" else 0.0
            yield from differences(expected[key], found[key], inner, f"{where}.{key}", own, rms)
    elif isinstance(expected, list) and isinstance(found, list):
        if len(expected) != len(found):
            yield f"{where}: {len(found)} instead of {len(expected)}"
            return
        for i, (a, b) in enumerate(zip(expected, found, strict=True)):
            yield from differences(a, b, bounds, f"{where}[{i}]", sd, size)
    elif _is_number(expected) and _is_number(found):
        bound = (
            bounds.relative * max(abs(expected), abs(found), size) + bounds.in_sds * sd + _NOTHING
        )
        if not (abs(expected - found) <= bound or expected == found):
            yield f"{where}: {found!r} instead of {expected!r}, beyond {bound:.1e}"
    elif isinstance(expected, str) and isinstance(found, str):
        if wrong := _text_difference(expected, found, bounds.relative):
            yield f"{where}: {wrong}"
    elif expected != found:
        yield f"{where}: {found!r} instead of {expected!r}"


def _beside(document: dict[str, Any], key: str) -> float:
    """Return the standard deviation of an entry (the largest of a column), or 0."""
    if key.endswith("_sigmas"):
        return 1.0  # it counts standard deviations
    if key == "rms_px" and (sigmas := document.get("significance_sigmas")):
        return abs(float(document[key]) / sigmas)
    own = document.get("sd" if key == "value" else f"sd_{key}")
    if own is None and key in ("mean", "change", "last_minus_first", "scatter"):
        own = document.get("stated_sd")
    if isinstance(own, dict):
        own = own.get("rms")
    if isinstance(own, list):
        own = max((v for v in own if _is_number(v)), default=0.0)
    return float(own) if _is_number(own) and math.isfinite(own) else 0.0


def _is_sd(key: str) -> bool:
    return key == "sd" or key.startswith("sd_") or key.endswith("_sd")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _text_difference(expected: str, found: str, relative: float) -> str:
    if expected == found:
        return ""
    words = [" ".join(_NUMBER.sub("#", t).split()) for t in (expected, found)]
    if words[0] != words[1]:
        return f"{found!r} instead of {expected!r}"
    for a, b in zip(_NUMBER.findall(expected), _NUMBER.findall(found), strict=True):
        x, y = (Decimal(t.replace("−", "-")) for t in (a, b))
        unit = max(Decimal(10) ** int(v.as_tuple().exponent) for v in (x, y))
        if "." not in a + b and "e" not in a + b:
            unit = Decimal(0)  # a count
        if abs(x - y) > max(unit, Decimal(relative) * abs(x)):
            return f"{b} instead of {a} in {expected!r}"
    return ""
