"""`thermocald check`: is this recording, configuration or store sound?"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from thermocald.cli.common import say, write_result
from thermocald.cli.options import JsonOption
from thermocald.errors import ConfigurationError, DataError, DeviceError

if TYPE_CHECKING:
    from thermocald.config import DeviceConfig
    from thermocald.hal import Kind

__all__ = ["check"]

_SHOWN = 20  # lines of a kind


def check(
    source: Annotated[Path, typer.Argument(help="A recording, a config.yaml, or a store.")],
    probe: Annotated[
        bool,
        typer.Option(
            "--probe", help="Take one frame and one reading from every device of a config."
        ),
    ] = False,
    json: JsonOption = None,
) -> None:
    """Read everything and say what it is; the first thing that is wrong ends it.

    With --probe every device is tried, whatever the others did: exit status 3 where one failed.

    Example: thermocald check config.yaml
    """
    if not source.exists():
        raise DataError(f"{source}: does not exist")
    if source.is_dir():
        document = _recording(source)
    elif source.suffix in (".yaml", ".yml"):
        document = _config(source, probe)
    else:
        document = _store(source)
    if write_result(document, json):
        for line in document.pop("lines"):
            typer.echo(line)
    if damaged := document.get("damaged"):
        raise DataError(
            f"{source}: {len(damaged)} places are damaged, the first: {damaged[0]}; restore a "
            "backup, or read what is sound"
        )
    probes = document.get("probes", [])
    failed = [probe["name"] for probe in probes if probe["error"]]
    if failed:
        raise DeviceError(
            f"{len(failed)} of {len(probes)} devices gave nothing: {', '.join(failed)}; why stands "
            "in their lines"
        )


def _recording(path: Path) -> dict[str, Any]:
    from thermocald.store.recording.reader import read_recording

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
    lines = [
        f"{path}: a sound recording of camera {recording.camera.name}, series {recording.series}",
        f"  {len(columns)} epochs, {frames} frames, {len(recording.testfield)} targets",
        *(f"  {name}: {n} of {len(columns)} readings" for name, n in readings.items()),
    ]
    if seen:
        lines.append(f"  {np.median(seen):.0f} targets an epoch (median), {min(seen)} at least")
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
        "lines": lines,
    }


def _config(path: Path, probe: bool) -> dict[str, Any]:
    from thermocald.cli.devices import probe as probe_devices
    from thermocald.cli.devices import probe_document, probe_lines
    from thermocald.config import load_config
    from thermocald.daemon.plan import plan_cameras
    from thermocald.hal import SystemClock, open_device, option_names

    config = load_config(path, option_names)
    lines = [f"{path}: a sound configuration"]
    devices: list[dict[str, Any]] = []
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
            devices.append({"kind": kind, "name": entry.name, "driver": entry.driver})
            if not probe or kind == "output":
                lines.append(f"  {kind} {entry.name}: driver {entry.driver}")
            lines += [f"  {kind} {entry.name}: warning: {text}" for text in device.warnings()]
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


def _store(path: Path) -> dict[str, Any]:
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
            "  the last write was cut off, as when its writer is killed: it had not been "
            "committed, and the store is used without it"
        )
    if found.unchecked:
        lines.append(
            f"  {found.unchecked} epochs are of an older version and have no checksum: they were "
            "not verified"
        )
    return {
        "format": "thermocald-check/1",
        "kind": "store",
        "path": path,
        "series": series,
        "epochs": found.epochs,
        "damaged": list(found.damaged),
        "gaps": [asdict(gap) for gap in found.gaps],
        "unchecked": found.unchecked,
        "unfinished": found.unfinished,
        "lines": lines,
    }
