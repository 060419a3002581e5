"""Checks of a recording, a configuration or a store, with a summary of its content.

Also lists the devices attached to the machine, as stanzas of a configuration, and probes configured
devices. An uncertain device (on a serial port or an I2C bus, which cannot be identified) is a
comment.
"""

from __future__ import annotations

import os
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.arrays import spread_rows
from thermocald.errors import ConfigurationError, DataError, DeviceError, ThermocaldError
from thermocald.hal import SystemClock, driver_names, load_driver, open_device
from thermocald.names import file_name
from thermocald.numbers import counted
from thermocald.store.database.file import helper
from thermocald.store.database.store import Store
from thermocald.store.server.connection import require_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from thermocald.config import DeviceConfig
    from thermocald.hal import Kind
    from thermocald.store.recording.reader import Recording


KINDS: tuple[Kind, ...] = ("camera", "thermometer", "output")


def attached() -> tuple[list[dict[str, Any]], list[str]]:
    """Return the attached devices, and notes on drivers that could not search.

    Each device has `kind`, `driver` and the fields of `hal.Found`.
    """
    found: list[dict[str, Any]] = []
    notes: list[str] = []
    for kind in KINDS:
        for name in driver_names(kind):
            try:
                found += [
                    {"kind": kind, "driver": name, **asdict(one)}
                    for one in load_driver(kind, name).attached()
                ]
            except DeviceError as error:
                driver = f"{kind} driver {name!r}"
                notes.append(f"{driver}: {str(error).removeprefix(driver).strip()}")
    return found, notes


def _probe(kind: Kind, device: DeviceConfig) -> dict[str, Any]:
    """Take one frame or reading of a configured device; `error`: why there is none."""
    found: dict[str, Any] = {"kind": kind, "name": device.name, "driver": device.driver}
    begin = time.monotonic()
    try:
        with open_device(kind, device.driver, device.options, SystemClock()) as driver:
            begin = time.monotonic()
            result = driver.capture() if kind == "camera" else driver.read()
            took_s = time.monotonic() - begin
    except Exception as error:  # noqa: BLE001
        # a bug in a driver is reported like a fault, so that the other devices are probed, too
        took_s = time.monotonic() - begin
        known = isinstance(error, ThermocaldError)
        why = str(error) if known else f"its driver failed: {type(error).__name__}: {error}"
        return {**found, "took_s": took_s, "values": {}, "error": why}
    if kind == "camera":
        values = {"age_s": round(time.time() - result.utc, 3)}
        if (image := result.image) is not None:
            height, width = image.shape
            mean, most = round(float(image.mean()), 1), int(image.max())
            values |= {"width_px": width, "height_px": height, "grey_mean": mean, "grey_max": most}
        values |= {"exposure_s": result.exposure, "sequence": result.sequence}
    else:
        values = {f"{channel}_c": round(celsius, 4) for channel, celsius in result.values.items()}
        values |= {f"{channel}_missing": why for channel, why in result.missing.items()}
    return {**found, "took_s": took_s, "values": values, "error": None}


def stanzas(found: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the stanzas of devices as lines of YAML; uncertain devices are comments."""
    import yaml

    if not found:
        yield "# nothing found"
    for kind in KINDS:
        mine = [one for one in found if one["kind"] == kind]
        certain = [one for one in mine if one["certain"]]
        if mine:
            yield f"{kind}s:" if certain else f"# {kind}s:"
        for number, one in enumerate(sorted(mine, key=lambda one: not one["certain"]), 1):
            mark, driver = "" if one["certain"] else "# ", one["driver"]
            yield f"  # {one['about']}"
            stanza = {"name": f"{driver}-{number}", "driver": driver, **one["options"]}
            text = yaml.safe_dump(stanza, default_flow_style=True, sort_keys=False, width=10_000)
            yield f"  {mark}- {text.strip()}"


_LONGEST_NAME = 255  # bytes, of every usual file system
_SHOWN = 20  # most lines of a kind
_TRIED = 3  # epochs of a recording that are calibrated


def examine(source: Path, probe: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Check a recording, a config.yaml or a store as a whole; return a summary.

    probe: take one frame or reading from every device of a configuration; say: prints a step that
    takes long. `lines` is the summary as text. Raises the first error; damaged rows of a store
    raise none, but are listed in `damaged`.
    """
    if not require_file(source).exists():
        raise DataError(f"{source}: does not exist")
    if _is_system(source):
        raise DataError(f"{source}: belongs to the system; give a recording, config.yaml or store")
    if source.is_dir():
        kind, found = "recording", _examine_recording(source)
    elif source.suffix in (".yaml", ".yml"):
        kind, found = "configuration", _examine_config(source, probe)
    else:
        kind, found = "store", _examine_store(source, say)
    return {"format": "thermocald-check/1", "kind": kind, "path": source, **found}


def _is_system(path: Path) -> bool:
    """Return whether a path leads into a file system of the kernel, which stores nothing."""
    return Path(os.path.realpath(path)).parts[1:2] in (("proc",), ("sys",), ("dev",))


def _examine_recording(path: Path) -> dict[str, Any]:
    from thermocald.store.logger.photographs import strange_photographs
    from thermocald.store.recording.reader import read_recording
    from thermocald.store.recording.sense import doubt_lines

    recording = read_recording(path)
    columns = recording.columns
    seen = [len(o) for e in recording.epochs if (o := e.observations) is not None]
    frames = sum(bool(f) for f in columns.frames)
    missing = [e for e in recording.epochs if e.frame is not None and not e.frame.is_file()]
    if missing:
        raise DataError(
            f"{path}: {len(missing)} of {frames} frames in epochs.csv do not exist; the first "
            f"is {missing[0].frame}"
        )
    readings = {
        name: int(np.isfinite(values).sum()) for name, values in columns.temperatures.items()
    }
    doubts = []
    for what, name in (("camera", recording.camera.name), ("series", recording.series)):
        try:
            file_name(name, what, DataError)
        except DataError as error:
            doubts.append(f"{error}; no store accepts it")
    doubts += [
        *recording.doubts(),
        *strange_photographs([e.frame for e in recording.epochs if e.frame is not None]),
        *calibration_doubts(recording),
    ]
    sort = "a doubtful" if doubts else "a valid"
    lines = [
        f"{path}: {sort} recording of camera {recording.camera.name}, series {recording.series}",
        f"  {counted(len(columns), 'epoch')}, {frames} frames, {len(recording.testfield)} targets",
        *(f"  {name}: {n} of {counted(len(columns), 'reading')}" for name, n in readings.items()),
    ]
    if seen:
        lines.append(f"  {np.median(seen):.0f} targets an epoch (median), {min(seen)} at least")
    lines += [f"  {line}" for line in doubt_lines(doubts)]
    return {
        "camera": recording.camera.name,
        "series": recording.series,
        "epochs": len(columns),
        "frames": frames,
        "targets": len(recording.testfield),
        "readings": readings,
        "doubts": doubts,
        "lines": lines,
    }


def calibration_doubts(recording: Recording) -> list[str]:
    """Calibrate some epochs; return doubts about their interior orientation and test field."""
    from thermocald.acquisition.calibrator import Calibrator
    from thermocald.analysis.series.recorded import misplaced_doubts
    from thermocald.store.recording.sense import interior_doubts

    calibrator = Calibrator.of_recording(recording)
    rows = spread_rows(len(recording), _TRIED)
    tried = [calibrator.calibrate(recording.epochs[row]).adjustment for row in rows.tolist()]
    good = np.array([a.ok for a in tried])
    if not good.any():
        weak = all(a.status == "weak_geometry" for a in tried)
        by_itself = " by itself" if weak else ""
        none = f"none of {counted(len(tried), 'epoch')} can be calibrated"
        return [f"{none}{by_itself}: {tried[0].reason}"]
    found = np.array([a.values for a in tried if a.ok])
    c, x0, y0 = np.median(found[:, :3], axis=0).tolist()
    of_camera = interior_doubts(recording.camera, c, x0, y0)
    return [*of_camera, *misplaced_doubts(recording, rows[good], found)]


def _examine_config(path: Path, probe: bool) -> dict[str, Any]:
    from thermocald.acquisition.calibrator import Calibrator
    from thermocald.acquisition.thermometers import Thermometers
    from thermocald.config import load_config
    from thermocald.daemon.plan import plan_cameras

    config = load_config(path, load_driver)
    lines = [f"{path}: a valid configuration"]
    for key, place in (("store.path", config.store.path), ("frames.folder", config.frames.folder)):
        if _is_system(place):
            raise ConfigurationError(f"{path}: {key}: {place}: nothing can be stored there")
    store = config.store.path
    unit = "thermocald" if path.stem == "config" else f"thermocald@{path.stem}"
    if not os.path.exists(store.parent) and store.parent == Path("/var/lib", *unit.split("@")):
        lines.append(f"  store.path: systemd will make {store.parent} when it starts {unit}")
    elif not os.path.isdir(store.parent):
        raise ConfigurationError(f"{path}: store.path: {store}: its folder does not exist; make it")
    if len(os.fsencode(helper(store, "wal").name)) > _LONGEST_NAME:
        name = f"{store.name[:20]}…"
        raise ConfigurationError(f"{path}: store.path: {name}: its name is too long")
    if os.access(store, os.R_OK | os.W_OK) and os.path.getsize(store):
        Store.open(store).close()  # raises for a folder, and for a file that is no store
    devices: list[dict[str, Any]] = []
    clock = SystemClock()
    for kind in KINDS:
        for entry in getattr(config, f"{kind}s"):
            try:
                device = open_device(kind, entry.driver, entry.options, clock)  # built, not opened
            except ConfigurationError as error:
                raise ConfigurationError(f"{path}: {kind} {entry.name}: {error}") from error
            devices.append({"kind": kind, "name": entry.name, "driver": entry.driver})
            if not probe or kind == "output":
                lines.append(f"  {kind} {entry.name}: driver {entry.driver}")
            lines += [f"  {kind} {entry.name}: warning: {text}" for text in device.warnings()]
    Thermometers(config, clock)  # raises for channels that conflict
    for plan in plan_cameras(config, clock):
        if plan.calibrator is not None and not isinstance(plan.calibrator, Calibrator):
            lines.append(f"  camera {plan.name}: {plan.calibrator.outlook()}")
        elif plan.testfield is not None:
            lines.append(f"  test field of {plan.name}: {len(plan.testfield)} targets")
    document: dict[str, Any] = {"devices": devices, "lines": lines}
    if probe:
        document["probes"] = answers = [
            *(_probe("camera", device) for device in config.cameras),
            *(_probe("thermometer", device) for device in config.thermometers),
        ]
        for one in answers:
            shown = ", ".join(f"{key} {v}" for key, v in one["values"].items() if v is not None)
            what = f"FAILED: {one['error']}" if one["error"] else shown
            lines.append(
                f"  {one['kind']} {one['name']} ({one['driver']}), {one['took_s'] * 1e3:.0f} ms: "
                f"{what}"
            )
    return document


def _examine_store(path: Path, say: Callable[[str], None]) -> dict[str, Any]:
    with Store.open(path) as store:
        say(f"{path}: reading the whole file")
        found = store.examine()
        series = [
            {"camera": s.camera, "series": s.name, "last_epoch": store.last_epoch(s)}
            for s in store.all_series()
        ]
    state = "a damaged store" if found.damaged else "an intact store"
    lines = [f"{path}: {state} of {len(series)} series, {counted(found.epochs, 'epoch')}"]
    for s in series:
        last = "no epochs" if s["last_epoch"] is None else f"up to epoch {s['last_epoch']}"
        lines.append(f"  {s['camera']}/{s['series']}: {last}")
    lines += [f"  {gap.text}" for gap in found.gaps[:_SHOWN]]
    if len(found.gaps) > _SHOWN:
        lines.append(f"  and {len(found.gaps) - _SHOWN} more gaps")
    lines += [f"  damaged: {text}" for text in found.damaged[:_SHOWN]]
    if found.unfinished:
        lines.append(
            "  the last write was cut off before its commit and is ignored: the disk was full or "
            "its writer killed, or the -wal file was cut off in copying, and more may be missing"
        )
    return {
        "series": series,
        "epochs": found.epochs,
        "damaged": list(found.damaged),
        "gaps": [asdict(gap) for gap in found.gaps],
        "unfinished": found.unfinished,
        "lines": lines,
    }
