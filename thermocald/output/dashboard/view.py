"""The data of the page, read from the live folder and the store; nothing is written."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import DataError, ThermocaldError
from thermocald.files import read_json
from thermocald.machine import NOT_BEFORE
from thermocald.photogrammetry.camera.camera_model import (
    EOP_NAMES,
    IOP_NAMES,
    PARAMETER_NAMES,
    CameraModel,
    InteriorOrientation,
    Sensor,
)
from thermocald.result import csv_text
from thermocald.store.database.store import Store

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

_SHOWN = ("c", "x0", "y0")
_COUNTS = ("n_observations", "n_rejected")
_ROWS_AT_ONCE = 500
_OLD_S = 30.0
_LOST_S = 3600.0  # the daemon is unhealthy for this long after an epoch was lost


@dataclass(frozen=True)
class View:
    """A view of a store and a live folder, which every call opens anew: threads may share it.

    live: returns the folder; a daemon that is started later may have another one.
    """

    store: Path
    live: Callable[[], Path]

    def status(self) -> dict[str, Any]:
        """Return status.json with its age in s; empty if no daemon runs."""
        written = self.changed()
        document = read_json(self.live() / "status.json") if written else {}
        return document and {**document, "age_s": max(0.0, time.time() - written)}

    def shown(self) -> dict[str, Any]:
        """Return the status; if no daemon runs, only `stopped`, the time the last one stopped."""
        if status := self.status():
            return status
        try:
            with Store.open(self.store) as store:
                ends = [e.utc for e in store.events() if e.kind == "stopped"]
        except ThermocaldError:
            return {}
        return {"stopped": ends[-1]} if ends else {}

    def healthy(self) -> tuple[bool, str]:
        """Return whether the daemon runs without a fault, and if not, why."""
        status = self.status()
        if not status:
            return False, "no daemon is running"
        if status["age_s"] > _OLD_S:
            return False, f"the daemon has not answered for {status['age_s']:.0f} s"
        if status.get("stalled"):
            return False, "; ".join(status["stalled"])
        store = status.get("store", {})
        if store.get("state") == "out":
            return False, "the store cannot be written"
        if (ago := store.get("lost_s_ago")) is not None and ago < _LOST_S:
            return False, f"an epoch was lost: {store['lost_why']}"
        return True, ""

    def changed(self) -> float:
        """Return the time at which status.json was last written, s; 0 if there is none."""
        try:
            return (self.live() / "status.json").stat().st_mtime
        except OSError:
            return 0.0

    def last_epoch(self, camera: str) -> dict[str, Any]:
        """Return the row, targets and residuals of the last epoch; DataError if there is none."""
        document = read_json(self._path(camera, "json"))
        if not document:
            raise DataError(f"camera {camera!r} has no epoch yet")
        return document

    def current_camera(self, name: str | None) -> dict[str, Any]:
        """Return the present camera in OpenCV's terms, and its pose if it is known.

        name: None for the only camera. Raises DataError for an unknown camera, or if its last epoch
        has no result.
        """
        names = list(self.status().get("cameras", {}))
        if name is None:
            if len(names) != 1:
                asked = f"give ?camera=NAME; the cameras are: {', '.join(names)}"
                raise DataError(asked if names else "no daemon with a camera is running")
            name = names[0]
        row = self.last_epoch(name).get("row", {})
        if not row.get("opencv"):
            raise DataError(
                f"camera {name!r}: its last epoch has no result: {row.get('status', 'unknown')}"
            )
        about = ("series", "epoch", "frame_time", "temperature", "status", "reason")
        pose = {n: row.get(n) for k in EOP_NAMES for n in (k, f"sd_{k}")}
        return {
            "format": "thermocald-current-camera/1", "camera": name,
            "age_s": max(0.0, time.time() - (self.live() / f"{name}.json").stat().st_mtime),
            **{key: row.get(key) for key in about}, **row["opencv"],
            "pixel_pitch_mm": row.get("pixel_pitch"),
            "interior": {n: row.get(n) for k in IOP_NAMES for n in (k, f"sd_{k}")},
            "pose": None if pose["X0"] is None else pose,
        }  # fmt: skip

    def camera_info(self, name: str | None) -> str:
        """Return the present camera as YAML of ROS' camera_info; errors as `current_camera`."""
        now = self.current_camera(name)
        sensor = Sensor(int(now["width"]), int(now["height"]), float(now["pixel_pitch_mm"]))
        interior = InteriorOrientation.from_array([now["interior"][n] or 0.0 for n in IOP_NAMES])
        about = f"{now['status']}, epoch {now['epoch']}"
        if now["temperature"] is not None:
            about += f", {now['temperature']:.2f} degC"
        # imported here: few clients request it, and the page's process is to stay small
        from thermocald.photogrammetry.camera_files import encode

        return encode(CameraModel(sensor, interior), "ros", None, about, now["camera"])[0]

    def last_frame(self, camera: str) -> bytes:
        """Return the last frame as JPEG; DataError if there is none."""
        try:
            return self._path(camera, "jpg").read_bytes()
        except OSError as error:
            raise DataError(f"camera {camera!r} has no frame yet") from error

    def series(self) -> list[dict[str, Any]]:
        """Return all series of the store, oldest first."""
        with Store.open(self.store) as store:
            return [
                {
                    "camera": s.camera,
                    "series": s.name,
                    "start": s.start,
                    "created": s.created_utc,
                    "pixel_pitch_mm": s.head.camera.sensor.pixel_pitch,
                    "width_px": s.head.camera.sensor.width,
                    "height_px": s.head.camera.sensor.height,
                    "epochs": store.last_epoch(s) or 0,
                }
                for s in store.all_series()
            ]

    def columns(
        self, camera: str, series: str, since_s: float | None, points: int
    ) -> dict[str, Any]:
        """Return columns for the charts: means over at most `points` bins with equal numbers of
        epochs.

        points: at least 1; since_s: only the last so many s, None: all. A standard deviation is the
        mean of those of the bin's epochs, hence larger than that of the bin's mean. Epochs taken
        before the machine knew the time, which `unset` counts, are left out if the series has later
        ones.
        """
        names = ["sigma0", *_SHOWN, *(f"sd_{n}" for n in _SHOWN)]
        with Store.open(self.store) as store:
            found = store.find_series(camera, series)
            channels = list(found.head.channels)
            # one column at a time: all columns of a year would not fit into the page's memory
            times = store.series_columns(found, ["frame_time"])["frame_time"]
            chosen = times >= NOT_BEFORE
            unset = int((~chosen).sum()) if chosen.any() else 0
            chosen |= unset == 0  # a simulated series begins in 1970
            if since_s is not None and chosen.any():
                chosen &= times >= times[chosen].max() - since_s
            rows = np.flatnonzero(chosen)
            bins = np.array_split(rows, min(points, len(rows))) if len(rows) else []
            averaged = {"frame_time": _means(times, bins)}
            for name in (*names, *channels):
                # epochs stored in the meantime are not among the times
                column = store.series_columns(found, [name])[name][: len(times)]
                averaged[name] = _means(column, bins)
        return {
            "epochs": len(rows),
            "unset": unset,
            "per_point": int(max((len(b) for b in bins), default=0)),
            "channels": channels,
            **averaged,
        }

    def events(self) -> list[dict[str, Any]]:
        """Return the latest events, newest first, at most 200."""
        with Store.open(self.store) as store:
            found = store.events()[-200:]
        shown = ("utc", "kind", "text", "epoch")
        return [{name: getattr(event, name) for name in shown} for event in reversed(found)]

    def csv(self, camera: str, series: str) -> Iterator[str]:
        """Yield a series as CSV: epoch, times, temperatures, parameters with sds, status."""
        with Store.open(self.store) as store:
            found = store.find_series(camera, series)
            names = [
                "epoch", "frame_time", "temperature_time", *found.head.channels, *PARAMETER_NAMES,
                *(f"sd_{n}" for n in PARAMETER_NAMES), "sigma0", *_COUNTS, "status",
            ]  # fmt: skip
            yield from csv_text(
                page | {n: page[n].astype(np.int64) for n in ("epoch", *_COUNTS)}
                for page in store.column_pages(found, names, _ROWS_AT_ONCE)
            )

    def _path(self, camera: str, suffix: str) -> Path:
        # a name from a request is checked before it becomes part of a path
        if camera not in self.status().get("cameras", {}):
            raise DataError(f"there is no camera {camera!r}")
        return self.live() / f"{camera}.{suffix}"


def _means(values: NDArray[Any], bins: list[NDArray[np.int64]]) -> list[float | None]:
    finite = (part[np.isfinite(part)] for part in (values[rows] for rows in bins))
    return [float(good.mean()) if len(good) else None for good in finite]
