"""The laboratory: a bench for each driver, where tests set it up, break it and unplug it.

`LABORATORY` has an entry (kind, driver) for each driver: a context manager of (tmp_path,
monkeypatch) that yields a Bench and cleans up.
"""

from __future__ import annotations

import errno
import os
import shutil
import sys
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import gpiozero
import linuxpy.ioctl
import numpy as np
import pytest
import smbus2
from gpiozero.pins.mock import MockFactory

from tests.drivers.fakes import picamera2_stand_in
from tests.drivers.fakes.adb_server import AdbServer, FakePhone, wait_little
from tests.drivers.fakes.alert_servers import MailServer, WebServer
from tests.drivers.fakes.chips import CHIPS
from tests.drivers.fakes.mqtt_broker import Broker
from tests.drivers.fakes.pty_instrument import Instrument
from tests.drivers.fakes.smbus import Bus
from tests.drivers.fakes.sysfs import Sysfs, w1_slave
from tests.drivers.fakes.v4l2_kernel import FakeCamera
from tests.drivers.small_camera import write_small_camera
from thermocald.epoch import Epoch
from thermocald.errors import BadReading, DeviceError, DeviceGone, DeviceNotFound
from thermocald.hal import Clock, SystemClock, VirtualClock, open_device
from thermocald.photogrammetry.camera.camera_model import Sensor
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.recording.writer import RecordingWriter

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass
class Bench:
    """A device on the bench.

    options: for the driver's constructor; unplug: makes the device vanish below the driver; plug:
    brings it back. clock: the driver's clock. says: the message of the first fault then; gone: the
    error of an attempt to open it, which the daemon repeats. fake: what stands below the driver, of
    which tests set attributes; driver: its (kind, name).
    """

    options: dict[str, Any]
    unplug: Callable[[], None]
    plug: Callable[[], None]
    clock: Clock = field(default_factory=VirtualClock)
    says: str | None = None
    gone: type[DeviceError] = DeviceGone
    fake: Any = None
    driver: tuple[str, str] = ("", "")

    def device(self, **more: Any) -> Any:
        """Construct the driver, with further options."""
        return open_device(*self.driver, {**self.options, **more}, self.clock)

    @contextmanager
    def broken(self, attributes):
        """Set attributes of the fake for a while."""
        with pytest.MonkeyPatch.context() as patch:
            for name, value in attributes.items():
                patch.setattr(self.fake, name, value)
            yield


def check_readings(device, put, steps):
    """Read after each output that is put below a driver; steps: (output, °C or the refusal)."""
    for output, expected in steps:
        put(output)
        if isinstance(expected, str):
            with pytest.raises(BadReading, match=expected):
                device.read()
        else:
            assert [*device.read().values.values()] == [pytest.approx(expected, abs=1e-9)], output


def aside(path):
    """Return how to unplug and plug what is a path, by its name."""
    away = path.with_name("away")
    return lambda: path.rename(away), lambda: away.rename(path)


@contextmanager
def on_loopback(server, options, tmp_path, monkeypatch, clock=VirtualClock):
    """An output to a server on loopback; unplugging breaks the connections and stops the server."""
    running = [server()]
    port = running[0].port
    place = {"host": "127.0.0.1", "port": port}
    if server is WebServer:
        place = {"url": f"http://127.0.0.1:{port}/hook"}
    yield Bench(
        {**place, "timeout_s": 1.0, **options},
        unplug=running[0].close,
        plug=lambda: running.append(server(port)),
        clock=clock(),
        fake=running[0],
    )
    running[-1].close()


@contextmanager
def script(tmp_path, monkeypatch):
    """A program; unplugging deletes it."""
    hook = tmp_path / "hook"
    hook.write_text("#!/bin/sh\ncat > /dev/null\n")
    hook.chmod(0o755)
    options = {"command": [str(hook)], **WHEN, "timeout_s": 5}
    yield Bench(options, *aside(hook), gone=DeviceNotFound)


@contextmanager
def on_sysfs(attach, says, options, tmp_path, monkeypatch):
    """A sensor in a sysfs tree; unplugging deletes its folder, as w1_therm does.

    attach: (tree, 0 or 1 the second time) → the folder.
    """
    tree = Sysfs(tmp_path)
    folder = attach(tree, 0)
    yield Bench(
        {"sysfs": str(tmp_path), **options},
        unplug=lambda: shutil.rmtree(folder),
        plug=lambda: attach(tree, 1),
        says=says,
    )


@contextmanager
def on_i2c(name, tmp_path, monkeypatch):
    """A chip on a fake SMBus adapter, which every driver releases; unplugging frees its address."""
    bus = Bus()
    monkeypatch.setattr(smbus2, "SMBus", bus)
    address, chip, _ = CHIPS[name]
    bus.chips[address] = chip()
    yield Bench(
        {"bus": 1, "address": address},
        unplug=bus.chips.clear,
        plug=lambda: bus.chips.update({address: chip()}),
        fake=bus,
    )
    assert bus.opened == 0


@contextmanager
def on_pins(options, tmp_path, monkeypatch):
    """gpiozero's mock pins; unplugging removes the machine's pins."""

    def none(*_args):
        raise gpiozero.BadPinFactory("no pins here")

    pins = MockFactory()
    monkeypatch.setattr(gpiozero.Device, "pin_factory", pins)
    monkeypatch.setattr(gpiozero.Device, "_default_pin_factory", staticmethod(none))
    put = partial(setattr, gpiozero.Device, "pin_factory")
    yield Bench(options, lambda: put(None), lambda: put(pins), gone=DeviceNotFound, fake=pins)
    pins.close()


@contextmanager
def on_adb(options, tmp_path, monkeypatch):
    """A phone behind an adb server on loopback; unplugging removes it from the server's list."""
    wait_little(monkeypatch)
    server, phone = AdbServer(), FakePhone()
    phones = {"0A1B2C3D4E": phone}
    server.phones.update(phones)
    common = {"port": server.port, "start_server": False, "timeout_s": 2.0}
    yield Bench(
        {"serial": "0A1B2C3D4E", **common, **options},
        unplug=server.phones.clear,
        plug=lambda: server.phones.update(phones),
        clock=SystemClock(),
        fake=phone,
    )
    server.close()


@contextmanager
def fifo(tmp_path, monkeypatch):
    """A named pipe; unplugging closes its reader."""
    path = tmp_path / "results.fifo"
    os.mkfifo(path)
    read = partial(os.open, path, os.O_RDONLY | os.O_NONBLOCK)
    reader = [read()]
    yield Bench(
        {"path": str(path), "timeout_s": 0.5},
        unplug=lambda: os.close(reader.pop()),
        plug=lambda: reader.append(read()),
    )
    for descriptor in reader:
        os.close(descriptor)


@contextmanager
def mock(options_of, tmp_path, monkeypatch):
    """A mock, unplugged by its own faults, which are set by time before it is constructed."""
    clock = VirtualClock()
    fault = {"kind": "unplugged", "at_s": 1000.0, "for_s": 1000.0}
    yield Bench(
        {"faults": [fault], **options_of(tmp_path)},
        unplug=lambda: clock.sleep_until(1500.0),
        plug=lambda: clock.sleep_until(2500.0),
        clock=clock,
    )


@contextmanager
def picamera2(tmp_path, monkeypatch):
    """A stand-in with its API; unplugging empties libcamera's list and hangs captures."""
    pi = type("Camera", (picamera2_stand_in.StandIn,), {"instances": []})
    monkeypatch.setitem(sys.modules, "picamera2", picamera2_stand_in.module(pi))
    there = pi.cameras

    def put(cameras, hang_s):
        pi.cameras, pi.hang_s = cameras, hang_s

    options = {"width": 96, "height": 64, "exposure_s": 0.004, "timeout_s": 0.4}
    yield Bench(
        options, lambda: put((), 0.8), lambda: put(there, 0.0), clock=SystemClock(), fake=pi
    )


@contextmanager
def v4l2(tmp_path, monkeypatch):
    """The ioctls of one camera; unplugging deletes the node, and they fail with ENODEV."""
    kernel = FakeCamera(tmp_path / "video0")
    monkeypatch.setattr(linuxpy.ioctl, "fcntl", SimpleNamespace(ioctl=kernel.ioctl))
    away = tmp_path / "away"

    def unplug():
        kernel.path.rename(away)
        kernel.errors = dict.fromkeys(("DQBUF", "STREAMOFF", "G_CTRL"), errno.ENODEV)

    def plug():
        away.rename(kernel.path)
        kernel.errors = {}

    options = {"device": str(kernel.path), "width": 64, "height": 48, "pixel_format": "GREY"}
    yield Bench({**options, "timeout_s": 0.5}, unplug, plug, SystemClock(), fake=kernel)


@contextmanager
def replay(tmp_path, monkeypatch):
    """A recording, unplugged by moving its folder away."""
    path = tmp_path / "M1"
    head = Head("M1", "M1", 10.0, CameraSpec("c", Sensor(64, 48, 0.001)), {"lens": Channel()})
    field = TestField.build(["a", "b"], [[0, 0, 0], [1000, 0, 0]])
    image = np.zeros((48, 64), dtype=np.uint8)
    with RecordingWriter(path, head, field) as writer:
        for i in range(1, 30):
            epoch = Epoch(i, 1.6e9 + 10 * i, 1.6e9 + 10 * i + 1, {"lens": 20.0 + 0.1 * i})
            writer.append(epoch, image=image)
    clock = VirtualClock(utc=1.6e9 + 1000.0)  # its times are in the past
    yield Bench({"recording": str(path)}, *aside(path), clock=clock, gone=DeviceNotFound)


@contextmanager
def serial(tmp_path, monkeypatch):
    """An instrument on a pseudo terminal behind a link like udev's."""
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
        says="unplugged",
    )
    for instrument in instruments:
        instrument.close()


WHEN = {"when": [{"no_result": 2}]}
MAIL = {**WHEN, "security": "none", "sender": "a@example.org", "recipients": ["b@example.org"]}
PROGRAMME = {"programme": [{"seconds": 1000, "hold_c": 38.0}]}
ROM = "28-000000bfe244"
TMP117 = {"in_temp_raw": "1344", "in_temp_scale": "15.625"}


def on_tree(attach, says=None, **options):
    return partial(on_sysfs, attach, says, options)


LABORATORY = {
    ("camera", "android"): partial(on_adb, {"width": 96, "height": 64}),
    ("camera", "picamera2"): picamera2,
    ("camera", "v4l2"): v4l2,
    ("camera", "mock"): partial(
        mock, lambda folder: {"model": str(write_small_camera(folder / "small.thermal.yaml"))}
    ),
    ("camera", "replay"): replay,
    ("thermometer", "android"): partial(on_adb, {}),
    **{
        ("thermometer", name): partial(on_i2c, name)
        for name in ("bme280", "lm75", "mcp9808", "sht3x", "tmp117")
    },
    ("thermometer", "ds18b20"): on_tree(
        lambda tree, k: tree.w1(ROM, w1_slave(21.5 + 0.0625 * k)).parent,
        "is not on the bus",
        sensors={"temperature": ROM},
    ),
    ("thermometer", "hwmon"): on_tree(
        lambda tree, k: tree.hwmon(k, "lm75", temp1_input=("21062", "21125")[k]), chip="lm75"
    ),
    ("thermometer", "iio"): on_tree(lambda tree, _: tree.iio(0, "tmp117", **TMP117), chip="tmp117"),
    ("thermometer", "thermal_zone"): on_tree(
        lambda tree, k: tree.zone(2 * k, "cpu-thermal", ("48312", "47000")[k]), zone="cpu-thermal"
    ),
    ("thermometer", "serial"): serial,
    ("thermometer", "mock"): partial(mock, lambda _: {}),
    ("thermometer", "replay"): replay,
    ("output", "alert_exec"): script,
    ("output", "alert_mail"): partial(on_loopback, MailServer, {**MAIL, "timeout_s": 2.0}),
    ("output", "alert_mqtt"): partial(on_loopback, Broker, WHEN, clock=SystemClock),
    ("output", "alert_webhook"): partial(on_loopback, WebServer, {**WHEN, "timeout_s": 2.0}),
    ("output", "android_load"): partial(on_adb, {"limit_c": 42, **PROGRAMME}),
    ("output", "jsonl"): fifo,
    ("output", "led"): partial(on_pins, {"pin": 17}),
    ("output", "mqtt"): partial(on_loopback, Broker, {}, clock=SystemClock),
    ("output", "relay"): partial(on_pins, {"pin": 27, "limit_c": 60, **PROGRAMME}),
    ("output", "mock"): partial(mock, lambda _: {}),
}
