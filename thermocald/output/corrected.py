"""Correct the points or images of a file for thermal drift, into a new file or folder."""

from __future__ import annotations

import csv
import io
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.thermal.correction import (
    STANDARD_INPUT,
    RowBlock,
    correct_points,
    image_corrections,
    row_blocks,
)
from thermocald.errors import DataError, ImageError, ThermocaldError, UsageError
from thermocald.files import new_file, write_parts
from thermocald.numbers import counted, listed
from thermocald.photogrammetry.targets.image_file import EncodedImage, with_metadata
from thermocald.result import Result
from thermocald.store.logger.clock import iso

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from thermocald.analysis.camera.undistortion import Maps
    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.arrays import Array
    from thermocald.store.logger.clock import DeviceClock
    from thermocald.store.logger.temperatures import TemperatureLog

_ADDED = ("dx", "dy", "sd_x", "sd_y", "temperature", "extrapolated_K")
_MOST_NAMED = 20  # refused rows that are reported by line


@dataclass(repr=False)
class Correction(Result):
    """A correction with a thermal model and a log; `write` computes it.

    path: the CSV, `-` is standard input; of_images: whether it lists images, not points; to: °C to
    correct to, None for the model's T₀; temperature_sd K, of a reading of the log; say: receives a
    line for each row that cannot be corrected; date_order: of the CSV's dates, None to find it.
    """

    path: Path
    of_images: bool
    thermal: ThermalCamera
    log: TemperatureLog
    clock: DeviceClock
    to: float | None
    temperature_sd: float
    extrapolate: bool = False
    say: Callable[[str], None] = print
    date_order: str | None = None
    points: int = 0
    extrapolated_rows: int = 0
    images: list[dict[str, Any]] = field(default_factory=list)
    refused: list[dict[str, Any]] = field(default_factory=list)
    _moved: float = 0.0
    _left_over: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return the result as the document that `--json` writes."""
        head = {
            "format": "thermocald-correction/1",
            "corrected_to": self.thermal.model.T0 if self.to is None else self.to,
            "temperature_sd": self.temperature_sd,
        }
        if self.images:
            return {**head, "images": self.images, "refused": self.refused}
        return {
            **head,
            "points": self.points,
            "rms_correction_px": self._rms(self._moved),
            "rms_left_over_px": self._rms(self._left_over),
            "extrapolated_rows": self.extrapolated_rows,
            "refused": self.refused,
        }

    def lines(self) -> list[str]:
        """Return what `correct` prints."""
        left = "remaining error ±"
        if self.images:
            worst = max(d["rms_left_over_px"] for d in self.images)
            most = max(d["largest_correction_px"] for d in self.images)
            images = counted(len(self.images), "image")
            return [
                f"{images} corrected by up to {most:.3f} px; {left} {worst:.3f} px at most (RMS)"
            ]
        if not self.points:
            return [f"{self.path}: not corrected yet; write(path) does it"]
        moved, rest = self._rms(self._moved), self._rms(self._left_over)
        corrected = counted(self.points, "point")
        return [f"{corrected} corrected by {moved:.3f} px (RMS); {left} {rest:.3f} px"]

    def write(self, out: Path | str, advance: Callable[[int], None] | None = None) -> None:
        """Write the corrected CSV, or the corrected images into a folder.

        advance: receives the number of images done.
        """
        if self.of_images:
            self._write_images(Path(out), advance or (lambda _: None))
        else:
            _require_other(Path(out), self.path)
            write_parts(Path(out), self.rows())

    def rows(self) -> Iterator[str]:
        """Yield the corrected CSV of points, a block of rows at a time.

        Rows of standard input are corrected as they arrive. Rows that cannot be corrected are added
        to `refused`. Raises DataError if no row can be corrected, or a column would occur twice.
        """
        for block in self._blocks(("x", "y")):
            yield self._corrected(self._possible(block))
        self._require_any(self.points)

    def _write_images(self, out: Path, advance: Callable[[int], None]) -> None:
        """Correct the images that a CSV of time and image lists, into a folder; EXIF is preserved.

        Images that cannot be corrected are added to `refused`. Raises DataError if no image can be
        corrected, UsageError if one would be overwritten.
        """
        lines: dict[Path, int] = {}
        for block in self._blocks(()):
            possible = self._possible(block)
            if not possible.lines:
                continue
            maps, cameras, summaries = image_corrections(
                self.thermal, self.log, possible.times, self.to, self.temperature_sd,
                self.extrapolate,
            )  # fmt: skip
            for line, row, values, summary in zip(
                possible.lines, possible.rows, cameras, summaries, strict=True
            ):
                source = self.path.parent / row["image"]
                written = out / row["image"].rsplit("/", 1)[-1]
                try:
                    if "\0" in row["image"]:
                        raise ImageError("its image's name holds a NUL character")
                    if (first := lines.setdefault(written, line)) != line:
                        raise ImageError(f"{written} is the corrected image of line {first}")
                    _write_corrected(source, written, maps, values)
                except ImageError as cause:
                    self._refuse(line, str(cause))
                else:
                    self.images.append({"image": str(source), "corrected": str(written), **summary})
                advance(1)
        self._require_any(len(self.images))

    def require_all(self) -> None:
        """Raise DataError if a row was refused."""
        if self.refused:
            count = len(self.refused) + self.points + len(self.images)
            lines = listed([str(r["line"]) for r in self.refused], _MOST_NAMED)
            raise DataError(
                f"{self.path}: {len(self.refused)} of {count} rows were not corrected: line"
                f"{'s' if len(self.refused) > 1 else ''} {lines}"
            )

    def _blocks(self, columns: tuple[str, ...]) -> Iterator[RowBlock]:
        """Return the rows, none of which is counted yet."""
        self.points, self.extrapolated_rows, self._moved, self._left_over = 0, 0, 0.0, 0.0
        self.images, self.refused = [], []
        return row_blocks(self.path, columns, self.clock, self.date_order, self.log)

    def _possible(self, block: RowBlock) -> RowBlock:
        """Return the rows within the image whose temperature is known; refuse the others."""
        log = self.log.times
        possible = block.kept(
            self.log.known_at(block.times),
            f"was measured outside the temperature log ({iso(log[0])} to {iso(log[-1])}), or in a "
            "gap of over ten of its intervals",
        )
        if possible.values.shape[1]:
            sensor = self.thermal.model.sensor
            possible = possible.kept(
                sensor.contains(possible.values),
                f"lies outside the model's {sensor.width}×{sensor.height} px; is it of another "
                "camera, or binned (--size)?",
            )
        for line, reason in possible.refused:
            self._refuse(line, reason)
        return possible

    def _corrected(self, block: RowBlock) -> str:
        if not len(block.times):
            return ""
        try:
            points, sds, temperatures, beyond = correct_points(
                self.thermal, self.log, block.times, block.values, self.to, self.temperature_sd,
                self.extrapolate,
            )  # fmt: skip
        except ThermocaldError as cause:
            if self.path != STANDARD_INPUT:
                raise
            # on standard input one bad row must not stop the others
            if len(block.times) == 1:
                self._refuse(block.lines[0], str(cause))
                return ""
            ones = [
                block.kept(np.arange(len(block.times)) == i, "") for i in range(len(block.times))
            ]
            return "".join(map(self._corrected, ones))
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        if not self.points:
            header = [*block.header, *_ADDED]
            if twice := [name for name in header if name and header.count(name) > 1]:
                raise DataError(
                    f"{self.path}: column {twice[0]} would occur twice; rename it, unless these "
                    "points are corrected already"
                )
            writer.writerow(header)
        moved = points - block.values
        for i, row in enumerate(block.rows):
            row = {**row, "x": f"{points[i, 0]:.5f}", "y": f"{points[i, 1]:.5f}"}
            tail = [*moved[i], *sds[i], temperatures[i], beyond[i]]
            writer.writerow([*(row[n] for n in block.header), *(f"{v:.6g}" for v in tail)])
        self.points += len(block.rows)
        self._moved += float(np.sum(moved**2))
        self._left_over += float(np.sum(sds**2))
        self.extrapolated_rows += int((beyond > 0).sum())
        return text.getvalue()

    def _refuse(self, line: int, reason: str) -> None:
        self.refused.append({"line": line, "reason": reason})
        if len(self.refused) <= _MOST_NAMED:
            self.say(f"{self.path}, line {line}: not corrected: {reason}")

    def _require_any(self, count: int) -> None:
        if not count:
            first = self.refused[0]
            raise DataError(
                f"{self.path}: no row was corrected; line {first['line']}: {first['reason']}"
            )

    def _rms(self, squares: float) -> float:
        return float((squares / (2 * self.points)) ** 0.5) if self.points else float("nan")


def _require_other(written: Path, source: Path) -> None:
    if os.path.exists(written) and os.path.exists(source) and written.samefile(source):
        raise UsageError(f"{written}: would be overwritten; give another --out")


def _write_corrected(source: Path, written: Path, maps: Maps, values: Array) -> None:
    import cv2

    image = EncodedImage(source).as_it_is()
    _require_other(written, source)
    width, height = maps.sensor.width, maps.sensor.height
    if image.shape[:2] != (height, width):
        raise ImageError(
            f"{source}: has {image.shape[1]}×{image.shape[0]} px, the model's camera "
            f"{width}×{height}; give --size if it is binned"
        )
    corrected = maps.resample(image, values)
    try:
        _, data = cv2.imencode(written.suffix, corrected)
    except cv2.error:  # the name has another ending, or none
        raise ImageError(f"{written}: an image of such a name cannot be written") from None
    with new_file(written) as partial:
        partial.write_bytes(with_metadata(data.tobytes(), source.read_bytes()))
