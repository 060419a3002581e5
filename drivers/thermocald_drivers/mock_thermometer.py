"""A simulated thermometer: a programme with lag, offset, noise and quantisation.

    thermometers:
      - name: mock
        driver: mock
        programme: [[0, 25.0], [700, 50.0], [1500, 27.0]]   # s since the first open, °C
        channels:                       # default: one channel `temperature` with these values
          temperature: {lag_s: 0, offset_k: 0, gain: 1, noise_k: 0.02, resolution_k: 0.0625}
        seed: 0                         # of the noise, which depends on the time alone
        conversion_s: 0.1               # from the call to the value
        faults: []                      # see thermocald_drivers/faults.py
        timeout_s: 1

The programme is linear between its points and constant before and after them. `gain` scales the
difference to the first temperature, for a second channel that warms more.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.hal import Reading, Thermometer
from thermocald_drivers import support
from thermocald_drivers.faults import Faults, MockDevice

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from thermocald.hal import Clock

__all__ = ["MockThermometer", "lagged"]

_DEFAULTS = {"lag_s": 0.0, "offset_k": 0.0, "gain": 1.0, "noise_k": 0.02, "resolution_k": 0.0625}
_BOUNDS = {
    "lag_s": (0.0, 1e5, "s"),
    "offset_k": (-100.0, 100.0, "K"),
    "gain": (-100.0, 100.0, ""),
    "noise_k": (0.0, 10.0, "K"),
    "resolution_k": (0.0, 10.0, "K"),
}


def lagged(
    times: NDArray[np.float64], values: NDArray[np.float64], lag_s: float, at: float
) -> float:
    """The response of a first-order lag to a piecewise linear temperature, at a time.

    times (n,) s, values (n,) °C; in equilibrium before the first. On a line of slope m the response
    is value - m·lag plus the decaying rest of the state before (closed form, no step size).
    """
    if lag_s == 0.0:
        return float(np.interp(at, times, values))
    state, now = float(values[0]), float(times[0])
    pieces = zip(times, np.append(times[1:], math.inf), values, strict=True)
    for i, (start, end, value) in enumerate(pieces):
        if at <= start:
            break
        slope = 0.0 if math.isinf(end) else (values[i + 1] - value) / (end - start)
        until = min(at, end)
        settled_before, settled = value - slope * lag_s, value + slope * (until - start - lag_s)
        state = settled + (state - settled_before) * math.exp(-(until - start) / lag_s)
        now = until
        if now >= at:
            break
    return state


class MockThermometer(MockDevice, Thermometer):
    """Reads a programme; equal times give equal readings."""

    name = "mock thermometer"

    def __init__(
        self,
        *,
        clock: Clock,
        programme: Sequence[Sequence[float]] = ((0.0, 25.0), (700.0, 50.0), (1500.0, 27.0)),
        channels: Mapping[str, Mapping[str, float]] | None = None,
        seed: int = 0,
        conversion_s: float = 0.1,
        faults: Sequence[Mapping[str, object]] = (),
        timeout_s: float = 1.0,
    ) -> None:
        self.clock = clock
        self._times, self._values = support.programme(programme)
        self._channels = {
            support.text("channels", name): _channel(name, options)
            for name, options in (channels or {"temperature": {}}).items()
        }
        self._seed = int(support.number("seed", seed, 0, 2**31, whole=True))
        self._conversion_s = support.number("conversion_s", conversion_s, 0.0, 60.0, "s")
        self.faults = Faults(self.name, clock, faults, timeout_s)
        self._last: dict[str, float] = {}

    def identity(self) -> Mapping[str, str]:
        return {"name": self.name, "serial": f"mock-{self._seed}"}

    def read(self) -> Reading:
        self._require_open()
        kind = self.faults.on_call()
        start = self.clock.monotonic()
        self.clock.sleep_until(start + self._conversion_s)
        self.faults.refuse(kind, "answer")
        middle = start + 0.5 * self._conversion_s
        if kind != "stuck" or not self._last:
            self._last = {name: self._value(name, middle) for name in self._channels}
        return support.middle_reading(self.clock, self._last, start)

    def truth(self, monotonic: float) -> float:
        """The programme's temperature (°C) at a time of the monotonic clock."""
        return lagged(self._times, self._values, 0.0, self._elapsed(monotonic))

    def _value(self, name: str, at: float) -> float:
        options = self._channels[name]
        true = lagged(self._times, self._values, options["lag_s"], self._elapsed(at))
        value = self._values[0] + options["gain"] * (true - self._values[0]) + options["offset_k"]
        seed = [self._seed, list(self._channels).index(name), round(at * 1e6) & 2**63 - 1]
        value += options["noise_k"] * float(np.random.default_rng(seed).standard_normal())
        step = options["resolution_k"]
        return float(round(value / step) * step if step > 0 else value)


def _channel(name: str, options: Mapping[str, float]) -> dict[str, float]:
    for key in options:
        if key not in _DEFAULTS:
            raise ConfigurationError(
                f"channels.{name}: it has no {key!r}; known are {', '.join(_DEFAULTS)}"
            )
    return {
        key: support.number(f"channels.{name}.{key}", options.get(key, default), *_BOUNDS[key])
        for key, default in _DEFAULTS.items()
    }
