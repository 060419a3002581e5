"""The daemon's live state: a folder of small files for other programs to read.

`status.json` (format thermocald-status/1); per camera `<camera>.json`, the last epoch with image
points and residuals, and `<camera>.jpg`, its reduced frame. Under systemd the folder is in memory
(RUNTIME_DIRECTORY), otherwise next to the store.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald.addresses import without_secrets
from thermocald.errors import DataError
from thermocald.files import overwrite_json, read_json
from thermocald.numbers import counted
from thermocald.result import jsonable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.acquisition.calibrator import CalibratedEpoch
    from thermocald.hal import Frame
    from thermocald.photogrammetry.field.testfield import TestField


log = logging.getLogger(__name__)

FORMAT = "thermocald-status/1"
_RUN = Path("/run")
_PREVIEW_PX = 1280
_PREVIEW_QUALITY = 80
_PAGE_BYTES = 4096


class LiveState:
    """The folder of live files; a failure to write is logged once and otherwise ignored."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._failed: set[str] = set()
        self._held = -1  # the folder, locked while this process lives

    @classmethod
    def beside(cls, store: Path) -> LiveState:
        """Return the live state of the daemon that writes a store."""
        runtime = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
        return cls(Path(runtime) if runtime else _beside(store))

    def write_status(self, status: Mapping[str, Any]) -> None:
        """Replace status.json, and hold the folder."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if self._held < 0 or not os.path.samestat(os.fstat(self._held), self.folder.stat()):
                self._release()
                self._held = os.open(self.folder, os.O_RDONLY | os.O_CLOEXEC)
                fcntl.flock(self._held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._release()  # tried again with the next status
        document = _without_secrets(jsonable({"format": FORMAT, **status}))
        self._write("status.json", json.dumps(document).encode())

    def _release(self) -> None:
        if self._held >= 0:
            os.close(self._held)
        self._held = -1

    def write_epoch(
        self, camera: str, row: Mapping[str, Any], calibrated: CalibratedEpoch | None,
        field: TestField | None,
    ) -> None:  # fmt: skip
        """Replace a camera's last epoch: its row, and its measured targets with residuals, px."""
        document: dict[str, Any] = {"row": row}
        if calibrated is not None and field is not None:
            seen, result = calibrated.epoch.observations, calibrated.adjustment
            document["targets"] = {}
            if seen is not None and len(seen) == len(result.targets):
                rejected = set(result.rejected)
                document["targets"] = {
                    "name": [field.names[t] for t in seen.targets.tolist()],
                    "x": seen.points[:, 0].round(3).tolist(),
                    "y": seen.points[:, 1].round(3).tolist(),
                    "vx": result.residuals[:, 0].round(4).tolist(),
                    "vy": result.residuals[:, 1].round(4).tolist(),
                    "rejected": [t in rejected for t in seen.targets.tolist()],
                }
        self._write(f"{camera}.json", json.dumps(jsonable(document)).encode())

    def write_frame(self, camera: str, frame: Frame) -> None:
        """Replace a camera's last frame, at most 1280 px wide."""
        import cv2

        from thermocald.arrays import eight_bit
        from thermocald.photogrammetry.targets.image_file import decode_grey

        try:
            image = frame.image if frame.image is not None else decode_grey(frame.encoded or b"")
        except DataError:
            return
        scale = min(1.0, _PREVIEW_PX / image.shape[1])
        size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
        small = cv2.resize(eight_bit(image), size, interpolation=cv2.INTER_AREA)
        done, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _PREVIEW_QUALITY])
        if done:
            self._write(f"{camera}.jpg", data.tobytes())

    def remove(self) -> None:
        """Delete status.json, when the daemon stops."""
        with contextlib.suppress(OSError):
            (self.folder / "status.json").unlink(missing_ok=True)
        self._release()

    def _write(self, name: str, data: bytes) -> None:
        if name.endswith(".json"):  # room to grow in place: JSON allows trailing blanks
            data = data.ljust((len(data) // _PAGE_BYTES + 2) * _PAGE_BYTES)
        partial = self.folder / f".{name}.partial"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            partial.write_bytes(data)
            os.replace(partial, self.folder / name)
            self._failed.discard(name)
        except OSError as error:
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)
            if name.endswith(".json") and overwrite_json(self.folder / name, data):
                return  # an old status from before the disk was full would look healthy
            if name not in self._failed:
                log.warning("%s: cannot be written: %s", self.folder / name, error)
            self._failed.add(name)


def _beside(store: Path) -> Path:
    # the same through any link, as the -wal file
    return Path(f"{os.path.realpath(store) if os.path.islink(store) else store}.live")


def _without_secrets(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_secrets(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_without_secrets(inner) for inner in value]
    return without_secrets(value) if isinstance(value, str) else value


def find_state(store: Path) -> Path:
    """Return the live folder of the daemon that writes a store, running or not."""
    for found in sorted(_RUN.glob("thermocald*/status.json")):  # thermocald-NAME: of the template
        other = read_json(found).get("store", {}).get("path", "")
        if os.path.realpath(other) == os.path.realpath(store):
            return found.parent
    return _beside(store)  # also while a killed one's, since started by systemd, is there


def running_status(path: Path) -> dict[str, Any]:
    """Return the status of the daemon that writes a store; DataError if none runs."""
    folder = find_state(path)
    document = read_json(folder / "status.json")
    if not document:
        raise DataError(f"no daemon is running for {path} (there is no {folder}/status.json)")
    # the daemon's clock may be stepped, so the age is by the machine's clock alone
    age_s = time.time() - (folder / "status.json").stat().st_mtime
    document["age_s"] = max(0.0, age_s)
    if not _is_held(folder):
        raise DataError(
            f"the daemon that wrote {path} was killed {age_s:.0f} s ago; start it again"
        )
    return document


def _is_held(folder: Path) -> bool:
    """Return whether a process holds a live folder.

    Its number would not tell: another process may have a killed one's, at the latest after booting.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    else:
        return False
    finally:
        os.close(handle)


def status_warnings(document: Mapping[str, Any]) -> list[str]:
    """Return the warnings of a status document, one sentence each."""
    found = list(document["stalled"])
    store = document["store"]
    if store["state"] == "results_only":
        found.append("store: its disk is nearly full: results are stored, observations are not")
    elif store["state"] != "ok":
        waiting = counted(store["waiting"], "epoch")
        found.append(f"store: {store['state']}: {store['why']} ({waiting} waiting)")
    if store["lost"]:
        lost = counted(store["lost"], "epoch")
        found.append(f"{lost} lost, taken but not stored: {store['lost_why']}")
    if store.get("notice"):
        found.append(f"store: {store['notice']}")
    if document.get("dashboard", {}).get("why"):
        found.append(document["dashboard"]["why"])
    frames, cameras = document["frames"], document["cameras"]
    if frames["paused"]:
        found.append(frames["paused"])
    if not document["clock"]["trusted"]:
        found.append("the clock is not synchronised: times may be wrong")
    if cameras and frames.get("keep") != "none" and not frames.get("ages_known", True):
        found.append("frames are not deleted for their age until the clock is synchronised")
    for kind in ("camera", "thermometer", "output"):
        for name, device in document[f"{kind}s"].items():
            found += [f"{kind} {name}: {text}" for text in device.get("warnings", ())]
            if device["why"]:
                found.append(f"{kind} {name}: {device['why']}")
    for name, camera in cameras.items():
        if (left := camera["deferred"] - camera["caught_up"]) > 0:
            found.append(f"camera {name}: {counted(left, 'epoch')} still to be calibrated")
    return found
