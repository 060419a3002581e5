"""Simulated devices that obey the rules of real ones and fail on demand as hardware does.

    cameras:
      - name: mock
        driver: mock                  # renders a known test field with a known thermal drift
        testfield: markers            # markers, circles, plain, or the path of a testfield.csv
        model: camera.thermal.yaml    # default: an RPi camera v2.1, half a pixel per kelvin
        programme: [[0, 25.0], [700, 50.0], [1500, 27.0]]   # s since the first open, °C
        seed: 0                       # of the noise, which depends only on the time
        exposure_s: 0.02
        latency_s: 0.3                # from the call to the end of the exposure
    thermometers:
      - name: mock
        driver: mock                  # the programme with lag, offset, noise and quantisation
        programme: [[0, 25.0], [700, 50.0], [1500, 27.0]]
        channels:                     # default: one channel `temperature` with these values
          temperature: {lag_s: 0, offset_k: 0, gain: 1, noise_k: 0.02, resolution_k: 0.0625}
        seed: 0
        conversion_s: 0.1             # from the call to the value
    outputs:
      - {name: kept, driver: mock, keep: 1000}              # the last results, in memory

The programme is linear between its points and constant before and after them. Time counts from the
first `open`: a device does not cool down while it is unplugged. `gain` scales the difference from
the first temperature, for a second channel that warms more. All three accept faults:

    timeout_s: 1
    faults:
      - {kind: timeout, at: 3}                      # the 3rd capture or reading gets no answer
      - {kind: unplugged, at_s: 60, for_s: 30}      # s after the first open; open fails meanwhile
      - {kind: stuck, at: 10, count: 20}            # 20 times the same value

Kinds: `timeout` (no answer within `timeout_s`), `unplugged` (gone, also for `open`), `truncated`
(half a frame or line, which a driver rejects as a bad reading), `wrong_size` (a frame of another
size, an answer of another length), `stuck` (the same value or image with new times, which no driver
can detect).
"""

from __future__ import annotations

import itertools
from collections import deque
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from thermocald.errors import BadReading, ConfigurationError, DeviceGone, DeviceTimeout
from thermocald.hal import Camera, Device, DriverOptions, Frame, Output, Thermometer
from thermocald_drivers import support

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from thermocald.hal import Reading
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.physics.effect import Prediction
    from thermocald.physics.model import ThermalModel
    from thermocald.physics.scene import Scene

Kind = Literal["timeout", "unplugged", "truncated", "wrong_size", "stuck"]


class Fault(DriverOptions):
    """A fault of `count` calls from call number `at`, or of `for_s` seconds from `at_s`."""

    kind: Kind
    at: Annotated[int, Field(ge=1)] = 1
    count: Annotated[int, Field(ge=1)] = 1
    at_s: Annotated[float, Field(ge=0.0, le=1e9)] | None = None
    for_s: Annotated[float, Field(ge=0.0, le=1e9)] = 0.0

    @model_validator(mode="after")
    def _calls_or_seconds(self) -> Self:
        if (self.at_s is None) != ("for_s" not in self.model_fields_set):
            raise ValueError("`at_s` and `for_s` belong together")
        if self.at_s is not None and self.model_fields_set & {"at", "count"}:
            raise ValueError("either `at` and `count`, or `at_s` and `for_s`")
        return self

    def active(self, call: int, elapsed_s: float) -> bool:
        if self.at_s is not None:
            return self.at_s <= elapsed_s < self.at_s + self.for_s
        return self.at <= call < self.at + self.count


def _points(points: list[list[float]]) -> list[list[float]]:
    """Validate [seconds, °C] points; raises ConfigurationError."""
    if any(len(point) != 2 for point in points):
        raise ConfigurationError("must be a list of [seconds, °C]")
    if any(b[0] <= a[0] for a, b in itertools.pairwise(points)):
        raise ConfigurationError("its times must increase")
    if any(not -273.15 <= celsius <= 2000.0 for _, celsius in points):
        raise ConfigurationError("a temperature is not within -273.15 … 2000 °C")
    return points


Programme = Annotated[list[list[float]], Field(min_length=1), AfterValidator(_points)]
DEFAULT_PROGRAMME = [[0.0, 25.0], [700.0, 50.0], [1500.0, 27.0]]
Seed = Annotated[int, Field(ge=0, le=2**31)]


class MockOptions(DriverOptions):
    """The options of every mock."""

    faults: list[Fault] = []  # noqa: RUF012 - pydantic copies it
    timeout_s: Annotated[float, Field(ge=0.0, le=3600.0)] = 1.0


class Channel(DriverOptions):
    """A channel's deviations from the programme."""

    lag_s: Annotated[float, Field(ge=0.0, le=1e5)] = 0.0
    offset_k: Annotated[float, Field(ge=-100.0, le=100.0)] = 0.0
    gain: Annotated[float, Field(ge=-100.0, le=100.0)] = 1.0
    noise_k: Annotated[float, Field(ge=0.0, le=10.0)] = 0.02
    resolution_k: Annotated[float, Field(ge=0.0, le=10.0)] = 0.0625


class MockDevice(Device):
    """A mock's opening and closing, its faults, and the time since it was first opened."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.timeout_s = 0.0  # the option is the length of a fault
        self._calls = 0
        self._started: float | None = None

    def open(self) -> None:
        if self._started is None:
            self._started = self.clock.monotonic()
        if self._fault(self._calls + 1) == "unplugged":
            self._calls += 1  # an attempt to open counts as a call
            raise DeviceGone(f"{self.where}: unplugged")
        self.handle = True

    def identity(self) -> Mapping[str, str]:
        return {**super().identity(), "serial": f"mock-{getattr(self.options, 'seed', 0)}"}

    def _fault(self, call: int) -> Kind | None:
        elapsed = self._elapsed(self.clock.monotonic())
        return next((f.kind for f in self.options.faults if f.active(call, elapsed)), None)

    def _call(self, unit: str, seconds: float = 0.0) -> bool:
        """Wait as long as a capture or reading takes, in seconds; return whether it is stuck.

        Raises the error of an active fault: DeviceTimeout after `timeout_s`, DeviceGone, or
        BadReading for an answer (a `unit`) that a driver must reject.
        """
        self.opened()
        self._calls += 1
        kind, timeout_s = self._fault(self._calls), self.options.timeout_s
        if kind == "unplugged":
            raise DeviceGone(f"{self.where}: unplugged")
        wait_s = timeout_s if kind == "timeout" else seconds
        self.clock.sleep_until(self.clock.monotonic() + wait_s)
        if kind == "timeout":
            raise DeviceTimeout(f"{self.where}: no answer within {timeout_s:g} s")
        if kind in ("truncated", "wrong_size"):
            what = "is cut off" if kind == "truncated" else "has the wrong size"
            raise BadReading(f"{self.where}: the {unit} {what}")
        return kind == "stuck"

    def _elapsed(self, monotonic: float) -> float:
        """Return the seconds since the device was first opened; 0 if it never was."""
        return monotonic - (monotonic if self._started is None else self._started)


class MockCamera(MockDevice, Camera):
    """A camera that renders the view of a warming camera; equal times give equal frames."""

    where = "mock camera"

    class Options(MockOptions):
        testfield: support.Text = "markers"
        model: support.Text | None = None
        programme: Programme = DEFAULT_PROGRAMME
        seed: Seed = 0
        exposure_s: Annotated[float, Field(ge=1e-6, le=10.0)] = 0.02
        latency_s: Annotated[float, Field(ge=0.0, le=60.0)] = 0.3

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._latency_s = max(self.options.latency_s, self.options.exposure_s)
        self._sequence = 0
        self._last: NDArray[np.uint8] | None = None

    def open(self) -> None:
        _ = self.scene  # first, since the time of the faults counts from the end of the opening
        super().open()

    def identity(self) -> Mapping[str, str]:
        return {**super().identity(), "testfield": self.options.testfield}

    @cached_property
    def field(self) -> TestField:
        """The rendered test field, loaded at first use like `model` and `scene`."""
        from thermocald.physics.testfields import load_field

        return load_field(self.options.testfield)

    @cached_property
    def model(self) -> ThermalModel:
        """The true thermal model."""
        from thermocald.physics.model_file import read_model
        from thermocald.physics.testfields import demonstration_model

        path = self.options.model
        model = demonstration_model(self.field) if path is None else read_model(Path(path))
        if model.exterior is None:
            raise ConfigurationError(
                f"{path}: has no exterior orientation; add one that places the camera in front of "
                "its test field"
            )
        return model

    @cached_property
    def scene(self) -> Scene:
        """The test field in front of the camera."""
        from thermocald.physics.scene import Scene

        return Scene(self.model.sensor, self.field)

    def known_scene(self) -> tuple[Any, Any]:
        return self.model.sensor, self.field

    def capture(self) -> Frame:
        stuck = self._call("frame", self._latency_s)
        exposure = self.options.exposure_s
        monotonic = self.clock.monotonic() - 0.5 * exposure
        utc = self.clock.utc() - 0.5 * exposure
        self._sequence += 1
        if not stuck or self._last is None:
            truth = self.truth(monotonic)
            points = truth.points(self.field.points)[0] if truth.moves_points else None
            seed = [self.options.seed, round(monotonic * 1e6) & 2**63 - 1]
            self._last = self.scene.render(
                truth.iop[0], truth.eop[0], points, seed, float(truth.blur_factor[0])
            )
        return Frame(self._last, monotonic, utc, exposure=exposure, sequence=self._sequence)

    def truth(self, monotonic: float) -> Prediction:
        """Return the true orientation and effects at a time of the monotonic clock."""
        from thermocald.physics.history import History

        times, values = np.array(self.options.programme, dtype=float).T
        at = np.array([self._elapsed(monotonic)])
        history = History(at, times, {"temperature": values}, "temperature", 0.0)
        return self.model.predict(history, self.field)


class MockThermometer(MockDevice, Thermometer):
    """A thermometer that follows a programme; equal times give equal readings."""

    where = "mock thermometer"

    class Options(MockOptions):
        programme: Programme = DEFAULT_PROGRAMME
        channels: Annotated[
            dict[support.Text, Channel],
            Field(min_length=1, default_factory=lambda: {"temperature": Channel()}),
        ]
        seed: Seed = 0
        conversion_s: Annotated[float, Field(ge=0.0, le=60.0)] = 0.1

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._times, self._values = np.array(self.options.programme, dtype=float).T
        self._last: dict[str, float] = {}

    def named_channels(self) -> list[str]:
        return list(self.options.channels)

    def read(self) -> Reading:
        start, wait = self.clock.monotonic(), self.options.conversion_s
        if not self._call("answer", wait) or not self._last:
            at = start + 0.5 * wait
            self._last = {
                name: self._value(k, channel, at)
                for k, (name, channel) in enumerate(self.options.channels.items())
            }
        return support.middle_reading(self.clock, self._last, start)

    def truth(self, monotonic: float, lag_s: float = 0.0) -> float:
        """Return the programme's temperature (°C) at a monotonic time, with a first-order lag.

        Before its first point the programme is in equilibrium.
        """
        elapsed, times, values = self._elapsed(monotonic), self._times, self._values
        if lag_s == 0.0:
            return float(np.interp(elapsed, times, values))
        from thermocald.physics.operators import lag

        later = max(elapsed, times[-1]) + 1.0  # the last value is held
        knots, held = np.append(times, later), np.append(values, values[-1])
        return float(lag(knots, held, lag_s, np.array([max(elapsed, times[0])]))[0])

    def _value(self, number: int, channel: Channel, at: float) -> float:
        true = self.truth(at, channel.lag_s)
        value = self._values[0] + channel.gain * (true - self._values[0]) + channel.offset_k
        seed = [self.options.seed, number, round(at * 1e6) & 2**63 - 1]
        value += channel.noise_k * float(np.random.default_rng(seed).standard_normal())
        step = channel.resolution_k
        return float(round(value / step) * step if step > 0 else value)


class MockOutput(MockDevice, Output):
    """An output that retains the last results in `results`, oldest first."""

    where = "mock output"

    class Options(MockOptions):
        keep: Annotated[int, Field(ge=1, le=1_000_000)] = 1000

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.results: deque[dict[str, Any]] = deque(maxlen=self.options.keep)

    def emit(self, result: Mapping[str, Any]) -> None:
        self._call("acknowledgement")
        self.results.append(dict(result))
