"""Scenarios of drivers with real kernel drivers, run in the guest: check.py NAME [ARGUMENTS]

Each prints one line of JSON with the driver's results or errors, which the test on the host checks.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import runpy
import signal
import sys
import time

sys.path.insert(0, "/mnt/host")

from thermocald.errors import ThermocaldError
from thermocald.hal import SystemClock, open_device

FEED = "/mnt/host/guest/feed.py"
LOG = "/run/feed.log"
TRANSIENT = ("BadReading", "DeviceGone", "DeviceTimeout")


def outcome(action):
    """Run an action; return its result, or the error's name and text, and its time."""
    begin = time.monotonic()
    try:
        value, error, text = action(), None, ""
    except ThermocaldError as problem:
        value, error, text = None, type(problem).__name__, str(problem)
    return {"value": value, "error": error, "text": text, "took_s": time.monotonic() - begin}


def described(frame):
    from tests_hil.bars import number_of

    return {
        "number": number_of(frame.image),
        "monotonic": frame.monotonic,
        "sequence": frame.sequence,
        "shape": list(frame.image.shape),
    }


def camera(device, width, height, pixel_format, **more):
    options = {"device": device, "width": width, "height": height, "pixel_format": pixel_format}
    return open_device("camera", "v4l2", {**options, **more}, SystemClock())


@contextlib.contextmanager
def feeder(width, height, pixel_format, fps=10.0):
    import numpy as np

    frames = np.zeros((1, height, width), np.uint8)
    frames[:] = np.add.outer(np.arange(height), np.arange(width)) // 8 % 200
    np.save("/run/frames.npy", frames)
    np.save("/run/temperatures.npy", np.array([20.0]))
    arguments = ["/dev/video40", "/run/frames.npy", "/run/temperatures.npy", LOG]
    more = ["--fps", str(fps), "--format", pixel_format]
    with contextlib.suppress(FileNotFoundError):
        os.unlink(LOG)
    process = multiprocessing.get_context("fork").Process(target=feed, args=[*arguments, *more])
    process.start()
    deadline = time.monotonic() + 60
    while not (os.path.exists(LOG) and os.path.getsize(LOG)):
        if not process.is_alive() or time.monotonic() > deadline:
            raise SystemExit("the feeder does not run")
        time.sleep(0.05)
    try:
        yield process
    finally:
        process.kill()  # which also ends one that is stopped
        process.join()


def feed(*words):
    sys.argv = [FEED, *words]
    runpy.run_path(FEED, run_name="__main__")


def times(*cases):
    """Return {case: frames} of the loopback; a case is format:backend."""
    return {case: written_and_captured(*case.split(":"), 640, 480) for case in cases}


def written_and_captured(pixel_format, backend, width, height):
    """Return frames of the loopback with the times at which each was written."""
    with (
        feeder(width, height, pixel_format),
        camera("/dev/video40", width, height, pixel_format, backend=backend) as device,
    ):
        captured = []
        for _ in range(10):
            called = time.monotonic()
            frame = device.capture()
            captured.append(
                {"called": called, "took_s": time.monotonic() - called, **described(frame)}
            )
            time.sleep(0.35)  # longer than the queue, so that an old frame would show
    written = {}
    with open(LOG) as log:
        for line in log:
            number, before, after, _ = line.split()
            written[int(number)] = (float(before), float(after))
    for frame in captured:
        frame["written"] = written.get(frame["number"])
    return captured


def stalls(backend):
    """Capture from a feeder that stops, goes on and is killed, and from a new one."""
    result = {}
    with feeder(320, 240, "GREY") as process:
        device = camera("/dev/video40", 320, 240, "GREY", timeout_s=1.5, backend=backend)
        device.open()
        device.capture()
        os.kill(process.pid, signal.SIGSTOP)
        result["stopped"] = outcome(lambda: described(device.capture()))
        os.kill(process.pid, signal.SIGCONT)
        device.close()
        result["continued"] = until_captured(device)  # OpenCV releases the node 10 s later
        process.kill()
        process.join()
        result["killed"] = outcome(lambda: described(device.capture()))
        device.close()
    with feeder(320, 240, "GREY"):
        result["again"] = until_captured(device)
        device.close()
    return result


VIVID = "/sys/bus/platform/drivers/vivid"
NODE = "/dev/v4l/by-path/platform-vivid.0-video-index0"  # /dev/videoN changes at each plug
OUTPUT_NODE = "/dev/v4l/by-path/platform-vivid.0-video-index1"


def write(path, text):
    with open(path, "w") as file:
        file.write(text)


def vivid():
    """Check controls, and the kernel's faults: error flag, fatal error, unplug and plug."""
    result = {}
    device = camera(NODE, 640, 360, "GREY", timeout_s=3.0)
    result["opened"] = outcome(device.open)
    result["captured"] = outcome(lambda: list(device.capture().image.shape))
    asked = camera(NODE, 640, 360, "GREY", controls={"brightness": 77, "contrast": 100})
    device.close()
    with asked:
        result["controls"] = outcome(lambda: dict(asked.capture().settings))
    result["no_control"] = outcome(camera(NODE, 640, 360, "GREY", controls={"zoomiest": 1}).open)
    result["no_size"] = outcome(camera(NODE, 641, 360, "GREY").open)
    result["output_node"] = outcome(camera(OUTPUT_NODE, 640, 360, "GREY").open)
    device.open()
    other = camera(NODE, 640, 360, "GREY")
    result["busy"] = outcome(other.open)
    other.close()
    for name in ("inject_v4l2_buf_flag_error", "inject_fatal_streaming_error"):
        push(name)
        result[name] = outcome(lambda: list(device.capture().image.shape))
        device.close()
        result[f"after {name}"] = outcome(
            lambda: (device.open(), list(device.capture().image.shape))[1]
        )
    write(f"{VIVID}/unbind", "vivid.0")
    result["unplugged"] = outcome(lambda: list(device.capture().image.shape))
    device.close()
    result["still unplugged"] = outcome(device.open)
    write(f"{VIVID}/bind", "vivid.0")
    result["plugged"] = until_open(device)
    result["captured again"] = outcome(lambda: list(device.capture().image.shape))
    device.close()
    return result


def push(name):
    """Press one of vivid's fault buttons."""
    from linuxpy.video import device as video
    from thermocald_drivers.v4l2_stream import plain_name

    with open(NODE, "r+b", buffering=0) as file:
        for control in video.iter_read_controls(file):
            if plain_name(control.name.decode()) == name:
                video.set_control(file, control.id, 1)
                return
    raise SystemExit(f"vivid has no control {name}")


def until_open(device):
    """Open repeatedly, like the daemon, until it works; udev makes the node with a delay."""
    deadline = time.monotonic() + 20
    while True:
        last = outcome(device.open)
        if last["error"] is None or time.monotonic() > deadline:
            return last
        time.sleep(0.1)


def until_captured(device):
    """Open and capture, like the daemon, until there is no transient error."""
    deadline = time.monotonic() + 30
    while True:
        last = outcome(lambda: (device.open(), described(device.capture()))[1])
        if last["error"] not in TRANSIENT or time.monotonic() > deadline:
            return last
        device.close()
        time.sleep(0.25)


def thermometer(name, **options):
    return open_device("thermometer", name, options, SystemClock())


def repeated(device, count=20):
    """Return the values and times of some readings."""
    values, took = [], []
    for _ in range(count):
        begin = time.monotonic()
        reading = device.read()
        took.append(time.monotonic() - begin)
        values.append(dict(reading.values))
    return {"values": values, "took_s": took}


def swapped(value):
    return (value & 0xFF) << 8 | value >> 8


def i2c(bus):
    """Read the kernel's lm75 over i2c-stub, and another one by its registers."""
    import smbus2

    bus = int(bus)
    result = {}
    with smbus2.SMBus(bus, force=True) as wire:

        def put(address, register, value):
            wire.write_word_data(address, register, swapped(value))

        for address in (0x48, 0x49):
            put(address, 2, 0x4B00)
            put(address, 3, 0x5000)
            put(address, 0, 0x1910)
            wire.write_byte_data(address, 1, 0)
        if not os.path.exists(f"/sys/bus/i2c/devices/{bus}-0048"):
            write(f"/sys/bus/i2c/devices/i2c-{bus}/new_device", "tmp75 0x48")
        with thermometer("hwmon", chip="tmp75") as device:
            result["kernel"] = repeated(device)
            put(0x48, 0, 0xE6F0)  # below 0 °C; the kernel reads at most every 0.1 s
            time.sleep(1.5)
            result["kernel cold"] = outcome(lambda: dict(device.read().values))
            put(0x48, 0, 0x1910)
        with thermometer("lm75", chip="tmp75", bus=bus, address=0x49) as device:
            result["registers"] = repeated(device)
        busy = thermometer("lm75", chip="tmp75", bus=bus, address=0x48)
        result["kernel has it"] = outcome(busy.open)
        result["nobody"] = outcome(thermometer("tmp117", bus=bus, address=0x4A).open)
        result["no bus"] = outcome(thermometer("tmp117", bus=99).open)
        with thermometer("hwmon", chip="tmp75") as device:
            write(f"/sys/bus/i2c/devices/i2c-{bus}/delete_device", "0x48")
            result["unbound"] = outcome(device.read)
            write(f"/sys/bus/i2c/devices/i2c-{bus}/new_device", "tmp75 0x48")
            device.close()
            result["bound"] = outcome(lambda: (device.open(), dict(device.read().values))[1])
    return result


# BME280 (BST-BME280-DS001 4.2.2): identity, coefficients of temperature, and 519888 = 25.08 °C
BME280 = {0xD0: 0x60} | dict(enumerate([0x70, 0x6B, 0x43, 0x67, 0x18, 0xFC], 0x88))
BME280 |= {0xFA: 0x7E, 0xFB: 0xED, 0xFC: 0x00}


def kernel(bus):
    """Read the kernel's bmp280 (iio) over i2c-stub, and the firmware's thermal zone."""
    import smbus2

    bus, result = int(bus), {}
    with smbus2.SMBus(bus, force=True) as wire:
        for register, value in BME280.items():
            wire.write_byte_data(0x76, register, value)
        folder = f"/sys/bus/i2c/devices/i2c-{bus}"
        write(f"{folder}/new_device", "bme280 0x76")
        with thermometer("iio", chip="bme280") as device:
            result["iio"] = repeated(device)
            write(f"{folder}/delete_device", "0x76")
            result["iio unbound"] = outcome(device.read)
        with thermometer("bme280", bus=bus, address=0x76) as device:
            result["bme280"] = repeated(device)
    with thermometer("thermal_zone", zone="acpitz") as device:
        result["thermal_zone"] = repeated(device)
    return result


def serial_thermometer(port):
    """Return the thermometer at a real USB serial adapter's tty; the instrument is on the host."""
    pattern = r"T=(?P<temperature>[-+]?\d+\.\d+)"
    return thermometer("serial", timeout_s=2.0, port=port, pattern=pattern, command="T?\r\n")


def serial_line(port):
    with serial_thermometer(port) as device:
        return repeated(device)


def serial_unplug(port):
    return unplug(serial_thermometer(port))


def ds18b20(*names, count="4"):
    """Return readings of probes on the kernel's 1-wire bus, with reasons for missing ones."""
    options = {"sensors": dict(zip(("field", "air"), names, strict=False)), "timeout_s": 10}
    result = {"readings": []}
    device = thermometer("ds18b20", **options)
    result["opened"] = outcome(device.open)
    for _ in range(int(count)):
        result["readings"].append(
            outcome(lambda: (r := device.read()) and [dict(r.values), dict(r.missing) or None])
        )
    device.close()
    return result


def ds18b20_unplug(name):
    return unplug(thermometer("ds18b20", sensors={"temperature": name}, timeout_s=10))


def unplug(device):
    """Read until the adapter is pulled, then until it is back; print when to pull and plug it."""
    device.open()
    result = {"before": outcome(lambda: dict(device.read().values))}
    print("pull", flush=True)
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        last = outcome(lambda: dict(device.read().values))
        if last["error"]:
            break
        time.sleep(0.05)
    result["pulled"] = last
    again = lambda: (device.open(), dict(device.read().values))[1]  # noqa: E731
    for name, wanted in (("gone", "DeviceGone"), ("back", None)):
        while time.monotonic() < deadline:
            device.close()
            last = outcome(again)
            if last["error"] == wanted:
                break
            time.sleep(0.1)
        result[name] = last
        if name == "gone":
            print("plug", flush=True)
    device.close()
    return result


if __name__ == "__main__":
    given = [word for word in sys.argv[2:] if "=" not in word]
    named = dict(word.split("=", 1) for word in sys.argv[2:] if "=" in word)
    print(json.dumps(globals()[sys.argv[1]](*given, **named)))
