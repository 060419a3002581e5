"""Frames on disk: which are kept, for how long, and which are deleted when the disk fills up.

A frame is `<folder>/<camera>/<series>/<thousands>/<epoch>.jpg` or `.png`: a JPEG as the camera gave
it, grey values as PNG. `<epoch>-corrected.jpg` may be beside it. A file appears as a whole or not
at all.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import logging
import os
import re
import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING

from thermocald.files import is_unmounted, mount_point
from thermocald.machine import NOT_BEFORE

if TYPE_CHECKING:
    from collections.abc import Iterator

    from thermocald.config import FramesConfig
    from thermocald.hal import Frame


log = logging.getLogger(__name__)

_DAY_S = 86400.0
_GB = 1e9
_PER_FOLDER = 1000
_NUMBER = re.compile(r"\d{4,}")
_OURS = re.compile(r"\d{7,}(-corrected)?\.(jpg|png)(\.partial)?")
_FAST_PNG = 1  # of 9: higher levels take longer, and the file is hardly smaller


def is_chosen(rule: str, every_n: int, number: int, eventful: bool) -> bool:
    """Return whether `all`, `every_n`, `events` or `none` chooses the frame of an epoch."""
    return {"all": True, "every_n": number % every_n == 0, "events": eventful}.get(rule, False)


class FrameFolder:
    """The folder with the frames of all cameras; threads may share it."""

    def __init__(self, config: FramesConfig) -> None:
        self.config = config
        self.root = config.folder
        self.paused = ""  # why frames are not written at present
        self._since = time.time()
        self._mount = mount_point(self.root)

    def wanted(self, number: int, eventful: bool) -> bool:
        """Return whether the frame of an epoch is to be kept by the configuration."""
        return is_chosen(self.config.keep, self.config.every_n, number, eventful)

    def keep(self, camera: str, series: str, number: int, frame: Frame) -> Path | None:
        """Write a frame; return its path relative to the folder, None if it cannot be written.

        `paused` is then the reason; the next frame that can be written clears it.
        """
        if frame.image is None and frame.encoded is None:
            return None
        free = self.free_bytes()
        if free < self.config.min_free_gb * _GB:
            self._pause(
                f"{self.root}: {free / 1e6:.0f} MB are free, less than min_free_gb "
                f"{self.config.min_free_gb:g}; no frames are kept"
            )
            return None
        data = frame.encoded
        if data is None:
            import cv2

            assert frame.image is not None
            fast = [cv2.IMWRITE_PNG_COMPRESSION, _FAST_PNG]
            data = cv2.imencode(".png", frame.image, fast)[1].tobytes()
        suffix = ".jpg" if data[:2] == b"\xff\xd8" else ".png"
        relative = Path(camera, series, f"{number // _PER_FOLDER:04d}", f"{number:07d}{suffix}")
        if not self._write(relative, data):
            return None
        if self.paused:
            log.info("%s: frames are kept again", self.root)
            self.paused = ""
        return relative

    def keep_corrected(self, relative: Path, jpeg: bytes) -> None:
        """Write a corrected frame beside the original; if that fails, `paused` is the reason."""
        self._write(_beside(relative), jpeg)

    def delete(self, relative: Path) -> None:
        """Delete a frame and its corrected frame, if they exist."""
        for path in (relative, _beside(relative)):
            with contextlib.suppress(OSError):
                (self.root / path).unlink()

    def free_bytes(self) -> int:
        """Return the free space of the disk, bytes; 0 if it cannot be read."""
        for folder in (self.root, *self.root.parents):
            with contextlib.suppress(OSError):  # it does not exist, or in a closed folder
                return shutil.disk_usage(folder).free
        return 0

    def enforce(self, now_utc: float | None) -> list[str]:
        """Delete frames that are too old, then the oldest if space is short.

        Returns a sentence for each reason. now_utc: s; None if the clock is not trusted, so that no
        frame is deleted for its age.
        """
        config = self.config
        files = sorted(self._files())
        deleted: list[str] = []
        if config.max_age_days is not None and now_utc is not None:
            limit = now_utc - config.max_age_days * _DAY_S
            # a time before this program existed: the clock was not set, the age is unknown
            old = [f for f in files if NOT_BEFORE <= f[0] < limit]
            files = [f for f in files if not NOT_BEFORE <= f[0] < limit]
            deleted += self._delete(old, f"older than {config.max_age_days:g} days")
        surplus, why = 0, ""
        if config.max_size_gb is not None:
            surplus = int(sum(size for _, size, _ in files) - config.max_size_gb * _GB)
            why = f"more than {config.max_size_gb:g} GB"
        missing = int(config.min_free_gb * _GB) - self.free_bytes()
        if missing > surplus:
            surplus, why = missing, f"less than {config.min_free_gb:g} GB of the disk were free"
        freed = itertools.accumulate((size for _, size, _ in files), initial=0)
        victims = [file for file, before in zip(files, freed, strict=False) if before < surplus]
        return [*deleted, *self._delete(victims, why)]

    def restamp(self, seconds: float) -> None:
        """Correct the times of files written by this process, after the clock was set by `seconds`.

        Otherwise a frame taken before NTP set the clock would look too old by the clock's error.
        """
        now = time.time() - seconds  # by the clock before it was set
        for modified, _, path in self._files():
            if self._since - 1.0 <= modified <= now + 1.0:
                with contextlib.suppress(OSError):
                    os.utime(path, (modified + seconds,) * 2)
        self._since += seconds

    def _delete(self, files: list[tuple[float, int, str]], why: str) -> list[str]:
        count = size = 0
        for _, bytes_, path in files:
            with contextlib.suppress(OSError):
                os.unlink(path)
                count += 1
                size += bytes_
        if not count:
            return []
        text = f"frames deleted: {count} ({size / 1e6:.1f} MB), {why}"
        log.info(text, extra={"event": "frames_deleted"})
        return [text]

    def _files(self) -> Iterator[tuple[float, int, str]]:
        """Yield (modification time s, bytes, path) of frames, and partial files after a crash."""
        for folder, _, names in os.walk(self.root):
            for name in names:
                if not _OURS.fullmatch(name) or not _NUMBER.fullmatch(os.path.basename(folder)):
                    continue  # not written by this program
                path = os.path.join(folder, name)
                with contextlib.suppress(OSError):
                    status = os.stat(path)
                    yield status.st_mtime, status.st_size, path

    def _write(self, relative: Path, data: bytes) -> bool:
        """Write a file; return whether it was written. If not, `paused` is the reason."""
        path = self.root / relative
        partial = path.with_name(path.name + ".partial")
        try:
            if is_unmounted(self.root, self._mount):
                raise OSError(errno.ENODEV, f"{self._mount} is not mounted any more")
            self._mount = mount_point(self.root)
            path.parent.mkdir(parents=True, exist_ok=True)
            partial.write_bytes(data)
            os.replace(partial, path)
        except OSError as error:
            with contextlib.suppress(OSError):
                partial.unlink()
            self._pause(f"{self.root}: {error.strerror or error}; no frames are kept")
            return False
        return True

    def _pause(self, why: str) -> None:
        if not self.paused:
            log.warning(why, extra={"event": "frames_paused"})
        self.paused = why


def _beside(relative: Path) -> Path:
    return relative.with_name(f"{relative.stem}-corrected.jpg")
