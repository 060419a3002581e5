"""Whether a recording, a configuration or a store is sound, and what it is."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import ConfigurationError, DataError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from thermocald.config import DeviceConfig
    from thermocald.hal import Kind
    from thermocald.store.recording.reader import Recording

_SHOWN = 20  # lines of a kind
_TRIED = 3  # epochs of a recording that are calibrated


def examine(source: Path, probe: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Read everything of a recording, a config.yaml or a store, and return what it is.

    probe: take one frame and one reading from every device of a configuration; say: is told what
    takes long. The document's `lines` are for people. Raises the error of the first thing wrong,
    of a store's rows none: they stand in `damaged`.
    """
    if not source.exists():
        raise DataError(f"{source}: does not exist")
    if _is_system(source):
        raise DataError(f"{source}: is the system's; give a recording, a config.yaml, or a store")
    if source.is_dir():
        return _recording(source)
    if source.suffix in (".yaml", ".yml"):
        return _config(source, probe)
    return _store(source, say)


def _is_system(path: Path) -> bool:
    """Whether a path leads into a file system of the kernel, which keeps nothing."""
    return path.resolve().parts[:2] in (("/", "proc"), ("/", "sys"), ("/", "dev"))


def _recording(path: Path) -> dict[str, Any]:
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
            f"{path}: {len(missing)} of {frames} frames of epochs.csv do not exist; the first "
            f"is {missing[0].frame}"
        )
    readings = {
        name: int(np.isfinite(values).sum()) for name, values in columns.temperatures.items()
    }
    doubts = [
        *recording.doubts(),
        *strange_photographs([e.frame for e in recording.epochs if e.frame is not None]),
        *_calibration_doubts(recording),
    ]
    sort = "a doubtful" if doubts else "a sound"
    lines = [
        f"{path}: {sort} recording of camera {recording.camera.name}, series {recording.series}",
        f"  {len(columns)} epochs, {frames} frames, {len(recording.testfield)} targets",
        *(f"  {name}: {n} of {len(columns)} readings" for name, n in readings.items()),
    ]
    if seen:
        lines.append(f"  {np.median(seen):.0f} targets an epoch (median), {min(seen)} at least")
    lines += [f"  {line}" for line in doubt_lines(doubts)]
    return {
        "format": "thermocald-check/1",
        "kind": "recording",
        "path": path,
        "camera": recording.camera.name,
        "series": recording.series,
        "epochs": len(columns),
        "frames": frames,
        "targets": len(recording.testfield),
        "readings": readings,
        "doubts": doubts,
        "lines": lines,
    }


def _calibration_doubts(recording: Recording) -> list[str]:
    """Return what is doubtful in the interior orientation that some epochs give."""
    from thermocald.acquisition.calibrator import Calibrator
    from thermocald.store.recording.sense import interior_doubts

    calibrator = Calibrator.of_recording(recording)
    last = len(recording) - 1
    tried = [
        calibrator.calibrate(recording.epochs[row]).adjustment
        for row in np.unique(np.linspace(0, last, _TRIED).astype(int)).tolist()
    ]
    found = [a.values[:3] for a in tried if a.ok]
    if not found:
        return [f"none of {len(tried)} epochs can be calibrated: {tried[0].reason}"]
    return interior_doubts(recording.camera, *np.median(found, axis=0).tolist())


def _config(path: Path, probe: bool) -> dict[str, Any]:
    from thermocald.config import load_config
    from thermocald.daemon.plan import plan_cameras, require_thermometer_columns
    from thermocald.daemon.probe import probe as probe_devices
    from thermocald.daemon.probe import probe_document, probe_lines
    from thermocald.hal import SystemClock, open_device, option_names

    config = load_config(path, option_names)
    lines = [f"{path}: a sound configuration"]
    for key, place in (("store.path", config.store.path), ("frames.folder", config.frames.folder)):
        if _is_system(place):
            raise ConfigurationError(f"{path}: {key}: {place}: nothing can be kept there")
    devices: list[dict[str, Any]] = []
    channels: dict[str, Sequence[str]] = {}
    clock = SystemClock()
    groups: tuple[tuple[Kind, tuple[DeviceConfig, ...]], ...] = (
        ("camera", config.cameras),
        ("thermometer", config.thermometers),
        ("output", config.outputs),
    )
    for kind, entries in groups:
        for entry in entries:
            try:
                device = open_device(kind, entry.driver, entry.options, clock)  # not opened
            except ConfigurationError as error:
                raise ConfigurationError(f"{path}: {kind} {entry.name}: {error}") from error
            if kind == "thermometer":
                channels[entry.name] = device.named_channels()
            devices.append({"kind": kind, "name": entry.name, "driver": entry.driver})
            if not probe or kind == "output":
                lines.append(f"  {kind} {entry.name}: driver {entry.driver}")
            lines += [f"  {kind} {entry.name}: warning: {text}" for text in device.warnings()]
    require_thermometer_columns(config, channels, ConfigurationError)
    lines += [
        f"  test field of {plan.name}: {len(plan.testfield)} targets"
        for plan in plan_cameras(config, clock)
        if plan.testfield is not None
    ]
    document: dict[str, Any] = {
        "format": "thermocald-check/1",
        "kind": "configuration",
        "path": path,
        "devices": devices,
        "lines": lines,
    }
    if probe:
        answers = probe_devices(config)
        document["probes"] = probe_document(answers)["devices"]
        lines += [f"  {line}" for line in probe_lines(answers)]
    return document


def _store(path: Path, say: Callable[[str], None]) -> dict[str, Any]:
    from thermocald.store.database.store import Store

    with Store.open(path) as store:
        say(f"{path}: reading the whole file")
        found = store.examine()
        series = [
            {"camera": s.camera, "series": s.name, "last_epoch": store.last_epoch(s)}
            for s in store.all_series()
        ]
    sound = "a damaged store" if found.damaged else "a sound store"
    lines = [f"{path}: {sound} of {len(series)} series, {found.epochs} epochs"]
    lines += [f"  {s['camera']}/{s['series']}: up to epoch {s['last_epoch']}" for s in series]
    lines += [f"  {gap.text}" for gap in found.gaps[:_SHOWN]]
    if len(found.gaps) > _SHOWN:
        lines.append(f"  and {len(found.gaps) - _SHOWN} more gaps")
    lines += [f"  damaged: {text}" for text in found.damaged[:_SHOWN]]
    if found.unfinished:
        lines.append(
            "  the last write was cut off: its writer was killed before it was committed, or the "
            "-wal file was cut off in copying, and more may be missing; the store is used without"
        )
    return {
        "format": "thermocald-check/1",
        "kind": "store",
        "path": path,
        "series": series,
        "epochs": found.epochs,
        "damaged": list(found.damaged),
        "gaps": [asdict(gap) for gap in found.gaps],
        "unfinished": found.unfinished,
        "lines": lines,
    }
