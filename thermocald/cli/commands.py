"""Every command, by the name that it is called by, in the order of `thermocald --help`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import typer

from thermocald.cli import camera, server, session, testfield
from thermocald.cli.archive import archive
from thermocald.cli.backup import backup
from thermocald.cli.calibrate import calibrate
from thermocald.cli.check import check
from thermocald.cli.convert import convert
from thermocald.cli.correct import correct
from thermocald.cli.demo import demo
from thermocald.cli.devices import devices
from thermocald.cli.discover import discover
from thermocald.cli.doctor import doctor
from thermocald.cli.fit import fit
from thermocald.cli.fleet import fleet
from thermocald.cli.forward import forward
from thermocald.cli.import_ import import_
from thermocald.cli.predict import predict
from thermocald.cli.replay import export, replay
from thermocald.cli.reprocess import reprocess
from thermocald.cli.run import dashboard, run
from thermocald.cli.simulate import simulate
from thermocald.cli.status import status, top
from thermocald.cli.study import study

__all__ = ["COMMANDS", "GROUPS"]

COMMANDS: dict[str, Callable[..., Any]] = {
    "archive": archive,
    "backup": backup,
    "calibrate": calibrate,
    "check": check,
    "convert": convert,
    "correct": correct,
    "demo": demo,
    "devices": devices,
    "discover": discover,
    "doctor": doctor,
    "fit": fit,
    "fleet": fleet,
    "forward": forward,
    "import": import_,
    "predict": predict,
    "replay": replay,
    "export": export,
    "reprocess": reprocess,
    "run": run,
    "dashboard": dashboard,
    "simulate": simulate,
    "status": status,
    "top": top,
    "study": study,
}
GROUPS: dict[str, typer.Typer] = {
    "camera": camera.group,
    "server": server.group,
    "session": session.group,
    "testfield": testfield.group,
}
