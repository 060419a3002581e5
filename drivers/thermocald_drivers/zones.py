"""Thermal zones (/sys/class/thermal): which are temperatures, and in what unit.

The kernel's interface is 1/1000 °C, but vendors' kernels mix units within one phone: 37000, 370 and
37 all mean 37 °C, and a zone may hold percent, mA or mV. The unit is taken from the zone's family
where only one fits, else from the phone's other zones, and is otherwise unknown: 45 may be 45 °C or
4.5 °C, and a wrong temperature is worse than none. The option `units` states it.
Source: qcom tsens and qpnp-adc-tm of kernels 3.10 to 4.9, MediaTek mtk_ts_*, power_supply class;
zones of eleven phones.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from thermocald.hal import Clock

UNITS = {"degC": 1.0, "tenths": 0.1, "thousandths": 0.001}
"""The option's words: what a zone's number is multiplied by to be °C."""

LOWEST_C, HIGHEST_C = -30.0, 125.0
SWITCH_K, SWITCH_S = 5.0, 600.0
COOLER_K = 10.0
"""No zone of a phone is colder than its coldest other zone by more than this."""

_OTHER_QUANTITIES = re.compile(
    r"soc|socd|(?:batt?(?:ery)?|bms|maxfg|fg)[-_]?soc"
    r"|(?:.*[-_ ])?(?:ibat|vbat|vph|bcl|icl|ocp|vsys|vbus|ibus|curr|current|volt"
    r"|voltage|power|pwr|percent|pct|capacity|cycle|cycles|level|duty|pwm|fan|minus|smpl|reduce"
    r"|lvl[0-9]*|mv|ma|uv|ua|mw)(?:[-_ ].*)?|batoilo[0-9]*|vdroop[0-9]*|smpl_gm",
    re.IGNORECASE,
)
_LIMIT = re.compile(r"lmh[-_]dcvs.*", re.IGNORECASE)  # always 75 or 95 °C


@dataclass(frozen=True)
class _Family:
    """Zones whose names match: the units seen, by the size of the number.

    whole_c, tenths_c: the highest temperature in that unit that such a zone can have, °C; None if
    the family does not use the unit. thousandths_from: the smallest |number| that is read as
    1/1000 °C, below 1251 from which on it can be nothing else.
    """

    pattern: str
    whole_c: float | None
    tenths_c: float | None
    thousandths_from: int


_FAMILIES = (
    # qcom tsens: tenths on msm8909 … msm8998, whole degrees before
    _Family(r"tsens_tz_sensor\d*", 105.0, HIGHEST_C, 1251),
    # power supply class: tenths; fuel gauges: thousandths; a battery above 70 °C is on fire
    _Family(r"(?:.*[-_])?(?:batt?|battery|bms|maxfg|fg)(?:[-_].*)?", 70.0, 70.0, 500),
    # MediaTek: thousandths, mtktsAP of some kernels whole degrees
    _Family(r"mtkts(?:batt).*", 70.0, None, 126),
    _Family(r"mtkts.*", 105.0, None, 126),
    # qcom ADC thermistors of kernels 3.x: whole degrees
    _Family(r".*_therm(?:\d|_.*)?", 105.0, None, 1251),
)
_ANY = _Family(r".*", 105.0, HIGHEST_C, 500)


class UnitWatch:
    """The last temperature of each source, by which a unit that switches is noticed.

    Kernels give 45000 for 45 °C and, after an update of the fuel gauge or a suspend, 45.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._last: dict[str, tuple[float, float]] = {}

    def switched(self, source: str, number: float, scale: float) -> bool:
        """Whether the number agrees with the last temperature in another unit only."""
        value, now = number * scale, self._clock.monotonic()
        at, last = self._last.get(source, (now, value))
        other = None
        if now - at <= SWITCH_S and abs(value - last) > SWITCH_K:
            rest = [number * unit for unit in UNITS.values() if unit != scale]
            other = next((c for c in rest if abs(c - last) <= SWITCH_K), None)
        self._last[source] = (now, value if other is None else other)
        return other is not None


def is_temperature(zone: str) -> bool:
    """Whether a zone of that name holds a temperature, not percent, mA, mV or a limit."""
    return _OTHER_QUANTITIES.fullmatch(zone) is None and not is_limit(zone)


def is_limit(name: str) -> bool:
    """Whether a zone or sensor of that name holds a limit of the hardware, not a temperature."""
    return _LIMIT.fullmatch(name) is not None


def raw_zones(text: str) -> dict[str, int]:
    """{zone: number} of lines "type number"; a name that is used twice is left out."""
    values: dict[str, int] = {}
    ambiguous = set()
    for line in text.replace("\r", "").split("\n"):
        name, _, number = line.strip().rpartition(" ")
        name = name.strip()
        if not name or not re.fullmatch(r"-?[0-9]{1,9}", number):
            continue
        if values.setdefault(name, int(number)) != int(number):
            ambiguous.add(name)
    return {name: value for name, value in values.items() if name not in ambiguous}


def zone_scales(raw: Mapping[str, int], known: Mapping[str, float]) -> dict[str, float]:
    """{zone: factor to °C} of those whose unit is certain.

    raw: all zones of the phone at one time; known: factors that were stated or found before.
    """
    found = {name: known[name] for name in raw if name in known}
    temperatures = {n: v for n, v in raw.items() if v != 0 and n not in known and is_temperature(n)}
    choices = {name: _candidates(name, value) for name, value in temperatures.items()}
    found |= {name: fits[0] for name, fits in choices.items() if len(fits) == 1}
    others = [raw[name] * scale for name, scale in found.items()]
    others = [celsius for celsius in others if LOWEST_C <= celsius <= HIGHEST_C]
    whole = any(scale == 1.0 for scale in found.values())
    for name, fits in choices.items():
        if len(fits) > 1 and (scale := _among(raw[name], fits, others, whole)) is not None:
            found[name] = scale
    return found


def _candidates(name: str, value: int) -> list[float]:
    """The factors that make a possible temperature of the number, for a zone of that name."""
    family = next((f for f in _FAMILIES if re.fullmatch(f.pattern, name, re.IGNORECASE)), _ANY)
    fits = []
    if family.whole_c is not None and LOWEST_C <= value <= family.whole_c:
        fits.append(1.0)
    if family.tenths_c is not None and LOWEST_C <= value * 0.1 <= family.tenths_c:
        fits.append(0.1)
    if abs(value) >= family.thousandths_from and LOWEST_C <= value * 0.001 <= HIGHEST_C:
        fits.append(0.001)
    return fits


def _among(value: int, fits: list[float], others: Iterable[float], whole: bool) -> float | None:
    """The one factor that agrees with the phone's other zones; None if that does not decide."""
    coldest = min(others, default=None)
    if coldest is None:
        return None
    near = [scale for scale in fits if value * scale >= coldest - COOLER_K]
    if len(near) == 1:
        return near[0]
    # colder than everything else in any unit: as its neighbours are written
    return 1.0 if not near and whole and 1.0 in fits else None
