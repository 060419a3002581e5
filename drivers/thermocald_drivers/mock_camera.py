"""A simulated camera: rendered images of a known test field with a known thermal drift.

    cameras:
      - name: mock
        driver: mock
        testfield: markers            # markers, circles, plain, or the path of a testfield.csv
        model: camera.thermal.yaml    # default: an RPi camera v2.1, half a pixel per kelvin
        programme: [[0, 25.0], [700, 50.0], [1500, 27.0]]   # s since the first open, °C
        seed: 0                       # of the noise, which depends on the time alone
        exposure_s: 0.02
        latency_s: 0.3                # from the call to the end of the exposure
        faults: []                    # see thermocald_drivers/faults.py
        timeout_s: 1

The programme is linear between its points and constant before and after them. It is the mock
thermometer's, with the same default, so that both together are a camera that warms up. Time counts
from the first `open`: unplugging the device does not cool it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.hal import Camera, Frame, KnownScene
from thermocald_drivers import support
from thermocald_drivers.faults import Faults, MockDevice

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from thermocald.hal import Clock
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.simulation.model import Prediction, ThermalModel
    from thermocald.simulation.scene import Scene

__all__ = ["MockCamera"]


class MockCamera(MockDevice, Camera):
    """Renders what a warming camera would see; equal times give equal frames."""

    name = "mock camera"

    def __init__(
        self,
        *,
        clock: Clock,
        testfield: str = "markers",
        model: str | None = None,
        programme: Sequence[Sequence[float]] = ((0.0, 25.0), (700.0, 50.0), (1500.0, 27.0)),
        seed: int = 0,
        exposure_s: float = 0.02,
        latency_s: float = 0.3,
        faults: Sequence[Mapping[str, object]] = (),
        timeout_s: float = 1.0,
    ) -> None:
        self.clock = clock
        self._testfield = support.text("testfield", testfield)
        self._model_path = None if model is None else support.text("model", model)
        self._times, self._values = support.programme(programme)
        self._seed = int(support.number("seed", seed, 0, 2**31, whole=True))
        self._exposure_s = support.number("exposure_s", exposure_s, 1e-6, 10.0, "s")
        latency = support.number("latency_s", latency_s, 0.0, 60.0, "s")
        self._latency_s = max(latency, self._exposure_s)
        self.faults = Faults(self.name, clock, faults, timeout_s)
        self._sequence = 0
        self._scene: Scene | None = None
        self._last: NDArray[np.uint8] | None = None

    def open(self) -> None:
        super().open()
        _ = self.scene

    def identity(self) -> Mapping[str, str]:
        return {"name": self.name, "serial": f"mock-{self._seed}", "testfield": self._testfield}

    @property
    def scene(self) -> Scene:
        """The test field in front of the camera; loaded at first use."""
        if self._scene is None:
            from thermocald.simulation.demonstration import demonstration_model, load_field
            from thermocald.simulation.model_file import read_model
            from thermocald.simulation.scene import Scene

            field = load_field(self._testfield)
            if self._model_path is None:
                self._model = demonstration_model(field)
            else:
                self._model = read_model(Path(self._model_path))
            if self._model.exterior is None:
                raise ConfigurationError(
                    f"{self._model_path}: has no exterior orientation; the mock camera needs "
                    "one in front of its test field"
                )
            self._scene = Scene(self._model.sensor, field)
        return self._scene

    def known_scene(self) -> KnownScene:
        return KnownScene(self.model.sensor, self.field)

    @property
    def field(self) -> TestField:
        """The test field that is rendered."""
        return self.scene.field

    @property
    def model(self) -> ThermalModel:
        """The true thermal model."""
        _ = self.scene
        return self._model

    def capture(self) -> Frame:
        self._require_open()
        kind = self.faults.on_call()
        self.clock.sleep_until(self.clock.monotonic() + self._latency_s)
        self.faults.refuse(kind, "frame")
        monotonic = self.clock.monotonic() - 0.5 * self._exposure_s
        utc = self.clock.utc() - 0.5 * self._exposure_s
        self._sequence += 1
        if kind != "stuck" or self._last is None:
            self._last = self._picture(monotonic)
        return Frame(self._last, monotonic, utc, exposure=self._exposure_s, sequence=self._sequence)

    def truth(self, monotonic: float) -> Prediction:
        """The true orientation and effects at a time of the monotonic clock."""
        from thermocald.simulation.history import History

        readings = {"temperature": self._values}
        history = History(
            np.array([self._elapsed(monotonic)]), self._times, readings, "temperature", 0.0
        )
        return self.model.predict(history, self.field)

    def _picture(self, monotonic: float) -> Any:
        truth = self.truth(monotonic)
        points = truth.points(self.field.points)[0] if truth.moves_points else None
        seed = [self._seed, round(monotonic * 1e6) & 2**63 - 1]
        return self.scene.render(
            truth.iop[0], truth.eop[0], points, seed, float(truth.blur_factor[0])
        )
