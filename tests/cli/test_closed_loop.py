"""`--until-separated` as a closed loop: planner, relay, a camera in a heated box, and the stop.

The relay is the driver on mock pins under a virtual clock; the box warms while its pin is on. Image
points are simulated with a hidden effect; only the program itself compares the effects.
"""

from __future__ import annotations

from concurrent.futures import wait

import gpiozero
import numpy as np
import pytest
from gpiozero.pins.mock import MockFactory

from tests.cli.test_session_separate import LIMIT_C, PIN, heated
from thermocald.config import parse_config
from thermocald.daemon.desk import plan_separation
from thermocald.daemon.session import Session
from thermocald.epoch import Epoch
from thermocald.hal import VirtualClock, open_device
from thermocald.photogrammetry.camera.camera_model import project
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.physics.history import History
from thermocald.physics.model import ModelEffect
from thermocald.physics.testfields import demonstration_field, demonstration_model
from thermocald.store.database.store import Store
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.series import EpochResult

RATE, INTERVAL, EPOCHS = 2.0, 10.0, 180
AMBIENT, RISE, TAU = 22.0, 35.0, 500.0
ALTERNATIVES = {
    "permanent_set": {"c": 1e-5, "x0": 6e-5, "y0": 4e-5},
    "self_heating": {"tau": 300.0, "c": 2e-4, "x0": 9e-4, "y0": -6e-4},
}


@pytest.fixture
def pin(monkeypatch):
    factory = MockFactory()
    monkeypatch.setattr(gpiozero.Device, "pin_factory", factory)
    yield factory.pin(PIN)
    factory.close()


@pytest.fixture
def config(tmp_path):
    return parse_config(heated(tmp_path, INTERVAL), tmp_path / "config.yaml")


class Box:
    """A camera in a box that a relay heats, with one time constant, observed step by step."""

    def __init__(self, hidden: str) -> None:
        self.field = demonstration_field("plain")
        self.model = demonstration_model(self.field).with_effect(
            ModelEffect(hidden, ALTERNATIVES[hidden])
        )
        self.temperatures: list[float] = [AMBIENT]
        self._rng = np.random.default_rng(7)

    def warm(self, on: bool) -> None:
        last = self.temperatures[-1]
        goal = AMBIENT + RISE * on
        self.temperatures.append(last + (goal - last) * (1 - np.exp(-INTERVAL / TAU)))

    def epoch(self) -> Epoch:
        """Return the observations at this time, and a reading with a noise of 0.04 K."""
        times = INTERVAL * np.arange(len(self.temperatures))
        readings = {"housing": np.array(self.temperatures)}
        history = History(times[-1:], times, readings, "housing", self.model.T0)
        seen = self.model.predict(history, self.field)
        points = project(self.model.sensor, seen.iop[0], seen.eop[0], self.field.points)
        points = points + self._rng.normal(0, 0.04, points.shape)
        rows = np.arange(len(points))
        now = 1.6e9 + float(times[-1])
        read = self.temperatures[-1] + self._rng.normal(0, 0.04)
        return Epoch(
            len(times), now, now, {"housing": read},
            observations=Observations(rows, points, np.full(points.shape, 0.04)),
        )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("hidden", ALTERNATIVES)
def test_the_loop_heats_within_the_limits_and_ends_when_separated(config, pin, hidden, capfd):
    asked = Session(camera="mock", series="M1", epochs=EPOCHS, check=False)
    names = ",".join(ALTERNATIVES)

    text, session, watch = plan_separation(config, asked, names, None, print, None, RATE, 0.8)
    assert "programme:" in text
    assert not config.store.path.exists()  # a plan does nothing
    programme = [{"seconds": s.seconds, "hold_c": s.hold_c} for s in session.programme]
    clock, box, heated = VirtualClock(), Box(hidden), 0
    options = {"pin": PIN, "limit_c": LIMIT_C, "programme": programme, "channel": "housing"}
    spec = CameraSpec("mock", box.model.sensor, 3.04)
    head = Head("loop", "M1", INTERVAL, spec, {"housing": Channel()})
    with open_device("output", "relay", options, clock) as relay:
        with Store.open(config.store.path, "append", durable=False) as store:
            series = store.create_series(head, box.field)
        while len(box.temperatures) <= EPOCHS and not watch.ended:
            taken = box.epoch()
            with Store.open(config.store.path, "append", durable=False) as store:
                store.append(series, taken, EpochResult("too_few_targets", "not adjusted here"))
            relay.emit({"status": "ok", "housing": taken.temperatures["housing"]})
            if not watch.look(taken.number) and watch._pending is not None:
                wait([watch._pending])
                watch.look(taken.number)
            heated += bool(pin.state)
            box.warm(bool(pin.state))
            clock.sleep_until(clock.monotonic() + INTERVAL)
    watch.close()

    assert watch.ended
    assert watch.found.better == hidden
    assert len(box.temperatures) < EPOCHS
    assert heated > 10
    assert not pin.state
    T = np.array(box.temperatures)
    assert T.max() < LIMIT_C
    # a thermostat of ± 0.25 K, over five minutes
    assert np.max(T[30:] - T[:-30]) / 5.0 < RATE + 0.3
