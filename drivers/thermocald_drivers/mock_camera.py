"""A camera that is rendered: a known test field, a known thermal drift.

    camera:
      driver: mock
      testfield: markers            # markers, circles, plain, or the path of a testfield.csv
      model: camera.thermal.yaml    # default: an RPi camera v2.1, half a pixel per kelvin
      temperatures: [[0, 25.0], [700, 50.0], [1500, 27.0]]   # s since the first open, °C
      seed: 0                       # of the noise; a frame's noise hangs on its number alone
      exposure_s: 0.02
      latency_s: 0.3                # from the call to the end of the exposure
      faults: {…}                   # see `faults`

Between the given temperatures it is a straight line, before and after them constant; the camera
keeps its own clock from the first `open` on, so that unplugging it does not cool it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import ConfigurationError, DeviceGone
from thermocald.hal import Camera, Frame, SystemClock

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.hal import Clock
    from thermocald.simulation.model import Prediction

__all__ = ["MockCamera"]


class MockCamera(Camera):
    """Renders what a warming camera would see; obeys the rules of hardware."""

    def __init__(
        self,
        clock: Clock | None = None,
        testfield: str = "markers",
        model: str | None = None,
        temperatures: Sequence[Sequence[float]] = ((0.0, 25.0), (700.0, 50.0), (1500.0, 27.0)),
        seed: int = 0,
        exposure_s: float = 0.02,
        latency_s: float = 0.3,
    ) -> None:
        self.clock = clock or SystemClock()
        self._testfield = testfield
        self._model_path = model
        self._seed = seed
        self._exposure = exposure_s
        self._latency = max(latency_s, exposure_s)
        course = np.array(temperatures, dtype=float)
        if course.ndim != 2 or course.shape[1] != 2 or not np.isfinite(course).all():
            raise ConfigurationError("mock camera: temperatures must be [[seconds, °C], …]")
        if np.any(np.diff(course[:, 0]) <= 0):
            raise ConfigurationError("mock camera: the times of temperatures must increase")
        self._course = course
        self._begin: float | None = None
        self._sequence = 0
        self._open = False
        self._scene: Any = None

    def open(self) -> None:
        if self._scene is None:
            from thermocald.simulation.demonstration import demonstration_model, load_field
            from thermocald.simulation.model_file import read_model
            from thermocald.simulation.scene import Scene

            self.field = load_field(self._testfield)
            if self._model_path:
                self.model = read_model(Path(self._model_path))
            else:
                self.model = demonstration_model(self.field)
            if self.model.exterior is None:
                raise ConfigurationError(
                    f"mock camera: the model {self._model_path} has no exterior orientation; "
                    "add one, the camera must stand somewhere"
                )
            self._scene = Scene(self.model.sensor, self.field)
        if self._begin is None:
            self._begin = self.clock.monotonic()
        self._open = True

    def close(self) -> None:
        self._open = False

    def identity(self) -> Mapping[str, str]:
        return {
            "name": "mock",
            "testfield": self._testfield,
            "model": self._model_path or "built in",
        }

    def capture(self) -> Frame:
        if not self._open:
            raise DeviceGone("mock camera: it is not open")
        start = self.clock.monotonic()
        self.clock.sleep_until(start + self._latency)
        monotonic = self.clock.monotonic() - 0.5 * self._exposure
        utc = self.clock.utc() - 0.5 * self._exposure
        self._sequence += 1
        image = self.picture(monotonic)
        return Frame(
            image,
            monotonic,
            utc,
            exposure=self._exposure,
            sequence=self._sequence,
            metadata={"driver": "mock", "temperature": self.temperature(monotonic)},
        )

    def picture(self, monotonic: float) -> Any:
        """What the camera sees at an instant, (H, W) 8 bit."""
        p = self.truth(monotonic)
        points = p.points(self.field.points)[0] if p.moves_points else None
        seed = self._seed * 1_000_003 + self._sequence
        return self._scene.render(p.iop[0], p.eop[0], points, seed, float(p.blur_factor[0]))

    def temperature(self, monotonic: float) -> float:
        """The true temperature °C at an instant of the monotonic clock."""
        elapsed = monotonic - (self._begin if self._begin is not None else monotonic)
        return float(np.interp(elapsed, self._course[:, 0], self._course[:, 1]))

    def truth(self, monotonic: float) -> Prediction:
        """The true orientation and effects at an instant of the monotonic clock."""
        from thermocald.simulation.history import History

        elapsed = monotonic - (self._begin if self._begin is not None else monotonic)
        times, values = self._course.T
        return self.model.predict(
            History(np.array([elapsed]), times, {"temperature": values}, "temperature", 0.0),
            self.field,
        )
