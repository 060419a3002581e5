"""Run scripts of this folder in forks of a process that has imported what they need.

preloaded.py SOCKET

In the emulated machine their imports take longer than they do. A connection receives a line, sends
the words of a command line as JSON, and then receives what the script prints.
"""

from __future__ import annotations

import json
import os
import runpy
import signal
import socket
import sys
import traceback

sys.path.insert(0, "/mnt/host")

import cv2  # noqa: F401
import linuxpy.video.device  # noqa: F401
import serial  # noqa: F401
import simplejpeg  # noqa: F401
import smbus2  # noqa: F401
import tests_hil.bars  # noqa: F401

import thermocald.store.database.store  # noqa: F401
from thermocald.hal import load_driver

READY = b"ready\n"


def work(line):
    """Run a script with the connection as its output, in the child."""
    words = json.loads(line.makefile().readline())
    for stream in (1, 2):
        os.dup2(line.fileno(), stream)
    sys.argv = words
    try:
        runpy.run_path(words[0], run_name="__main__")
    except SystemExit as end:
        print(end)
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    os._exit(0)


def main():
    for name in ("ds18b20", "hwmon", "lm75", "serial"):
        load_driver("thermometer", name)
    load_driver("camera", "v4l2")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(sys.argv[1])
        server.listen()
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)
        while True:
            line, _ = server.accept()
            if os.fork() == 0:
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                line.sendall(READY)
                work(line)
            line.close()


main()
