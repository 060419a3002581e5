"""An instrument on a pseudo terminal behind a link, as udev makes one."""

from __future__ import annotations

from contextlib import contextmanager

from tests.drivers.fakes.pty_instrument import Instrument
from tests.drivers.laboratory.bench import Bench
from thermocald.hal import SystemClock


@contextmanager
def thermometer(tmp_path, monkeypatch):
    link = tmp_path / "usb-instrument"
    instruments = []

    def plug():
        instruments.append(Instrument({b"read?\r": b"t: 21.125 C\r\n"}))
        link.unlink(missing_ok=True)
        link.symlink_to(instruments[-1].port)

    plug()
    yield Bench(
        {"port": str(link), "instrument": "fluke-1522", "timeout_s": 0.5},
        unplug=instruments[-1].unplug,
        plug=plug,
        clock=SystemClock(),
    )
    for instrument in instruments:
        instrument.close()
