"""Feed rendered frames into a v4l2loopback device and their temperatures into an I2C register.

feed.py DEVICE FRAMES.npy TEMPERATURES.npy LOG --fps F [--hold N] [--format GREY|YUYV|MJPG]
        [--bus B] [--go FILE]

Frame n is written at n/F s, or 1/F s after the frame before if that one was late, with the image
and temperature number n // hold (counted from the appearance of FILE), and the bars of n in its top
rows. Each line of LOG is: n, CLOCK_MONOTONIC before and after the write, temperature.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
import time

import numpy as np

sys.path.insert(0, "/mnt/host")

from linuxpy.video import device as video
from tests_hil.bars import stamp

SENSOR = 0x48


def encode(image, fourcc):
    if fourcc == "GREY":
        return image.tobytes()
    if fourcc == "YUYV":
        return np.stack([image, np.full_like(image, 128)], -1).tobytes()
    import simplejpeg

    grey = np.ascontiguousarray(image[..., None])
    return simplejpeg.encode_jpeg(grey, quality=92, colorspace="GRAY")


def opened(device, width, height, fourcc):
    """Open the device as an output; retry while a reader has it open, when it accepts no format."""
    deadline = time.monotonic() + 60
    while True:
        out = open(device, "r+b", buffering=0)  # noqa: SIM115 - given to the caller
        try:
            video.set_format(out, video.BufferType.VIDEO_OUTPUT, width, height, fourcc)
            return out
        except OSError:
            out.close()
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)


def main():
    options = argparse.ArgumentParser()
    for name in ("device", "frames", "temperatures", "log"):
        options.add_argument(name)
    options.add_argument("--fps", type=float, default=5.0)
    options.add_argument("--hold", type=int, default=1)
    options.add_argument("--format", default="GREY")
    options.add_argument("--bus", type=int)
    options.add_argument("--go", help="repeat the first frame until this file exists")
    given = options.parse_args()
    frames = np.load(given.frames, mmap_mode="r")
    temperatures = np.load(given.temperatures)
    height, width = frames.shape[1:]
    bus = None
    if given.bus is not None:
        import smbus2

        bus = smbus2.SMBus(given.bus, force=True)
    with (
        opened(given.device, width, height, given.format) as out,
        open(given.log, "w", buffering=1) as log,
    ):
        due, last, first = time.monotonic(), None, 0
        for n in itertools.count():
            if given.go and not os.path.exists(given.go):
                first = n
            k = min((n - first) // given.hold, len(frames) - 1)
            celsius = round(float(temperatures[k]) * 16) / 16
            data = encode(stamp(np.asarray(frames[k]), n), given.format)
            # no frames are made up for: the loopback has two buffers, and a burst would put the
            # next frame into the one that a reader has just got, with the time of the former
            time.sleep(max(0.0, due - time.monotonic()))
            due = max(due, time.monotonic()) + 1.0 / given.fps
            if bus is not None and celsius != last:
                raw = round(celsius * 16) << 4
                bus.write_word_data(SENSOR, 0, (raw & 0xFF) << 8 | raw >> 8)
                last = celsius
            before = time.monotonic()
            out.write(data)
            log.write(f"{n} {before:.6f} {time.monotonic():.6f} {celsius:.4f}\n")


main()
