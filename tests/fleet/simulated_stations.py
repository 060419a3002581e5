"""Simulated stations: stores written at 100 × speed while being forwarded, several per process.

python -m tests.fleet.simulated_stations FOLDER FIRST COUNT EPOCHS ADDRESS
"""

from __future__ import annotations

import json
import sys
import threading
import time
from pathlib import Path

import numpy as np

from thermocald.epoch import Epoch
from thermocald.fleet.forward import Forwarder, Progress, forward_forever
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.store.database.store import Store
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.series import EpochResult, Event, LoggedReading
from thermocald.store.server.connection import ServerAddress

SPEED = 100
INTERVAL_S = 10.0
TARGETS = 30
START = 1.7e9


def station_name(number: int) -> str:
    return f"gauge{number:02d}"


class Writer:
    """The writer of a station's store: epochs, and now and then an event and a reading."""

    def __init__(self, folder: Path, number: int) -> None:
        self.rng = np.random.default_rng([21, number])
        self.number = number
        self.store = Store.open(folder / f"{station_name(number)}.db", "append", durable=False)
        rng = np.random.default_rng(1)
        field = TestField.build(
            [f"t{i}" for i in range(TARGETS)], rng.uniform(0, 2000, (TARGETS, 3)), 0.02
        )
        camera = CameraSpec("rpi", Sensor(3280, 2464, 0.00112), 3.04)
        head = Head("watch", "watch", INTERVAL_S, camera, {"temperature": Channel(0.0625)})
        self.series = self.store.create_series(head, field, created_utc=START)

    def write(self, epoch: int) -> None:
        rng, time_ = self.rng, START + INTERVAL_S * epoch
        seen = Observations(
            np.arange(TARGETS), rng.uniform(0, 2400, (TARGETS, 2)), np.full((TARGETS, 2), 0.04)
        )
        a = rng.normal(size=(20, 16))
        temperature = 20 + 5 * np.sin(epoch / 500) + self.number / 10
        values = rng.normal(size=16)
        result = EpochResult("ok", "", values, a.T @ a * 1e-6, 1.0, 40, 60, ())
        self.store.append(
            self.series,
            Epoch(epoch, time_, time_, {"temperature": temperature}, observations=seen),
            result,
        )
        if epoch % 10 == 0:
            self.store.add_event(Event(time_, "knock", f"at {epoch}", self.series.id, epoch))
            self.store.add_readings([LoggedReading("air", time_, {"t": temperature})])


def run(folder: Path, first: int, count: int, epochs: int, address: str) -> dict[str, float]:
    """Write and forward until all is sent; return the longest wait after a store's last row."""
    writers = [Writer(folder, first + i) for i in range(count)]
    written = threading.Event()
    lag: dict[str, float] = {}
    ended = 0.0

    def forward(number: int) -> None:
        name = station_name(number)
        forwarder = Forwarder(folder / f"{name}.db", ServerAddress.parse(address), name, batch=50)
        idle, send_waiting = False, forwarder.send_waiting

        def send() -> Progress:
            nonlocal idle
            idle = False
            progress = send_waiting()
            idle = progress.rows == 0
            return progress

        def wait(seconds: float) -> bool:
            if idle and written.is_set():
                return True
            time.sleep(seconds / SPEED)
            return False

        forwarder.send_waiting = send  # type: ignore[method-assign]
        forward_forever(forwarder, wait)
        lag[name] = time.monotonic() - ended

    threads = [threading.Thread(target=forward, args=(first + i,)) for i in range(count)]
    for thread in threads:
        thread.start()
    begin = time.monotonic()
    for epoch in range(1, epochs + 1):
        for writer in writers:
            writer.write(epoch)
        time.sleep(max(0.0, begin + epoch * INTERVAL_S / SPEED - time.monotonic()))
    ended = time.monotonic()
    written.set()
    for thread in threads:
        thread.join()
    for writer in writers:
        writer.store.close()
    return lag


if __name__ == "__main__":
    folder, first, count, epochs, address = sys.argv[1:]
    print(json.dumps(run(Path(folder), int(first), int(count), int(epochs), address)))
