"""`thermocald correct`: what was measured before, as a camera without thermal drift had seen it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermocald.atomic_file import make_folder, new_file
from thermocald.cli.options import (
    ExtrapolateOption,
    JsonOption,
    ModelOption,
    TimezoneOption,
    device_clock,
)
from thermocald.errors import DataError, ImageError, UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from thermocald.analysis.thermal.temperature_log import TemperatureLog
    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.store.logger.clock import DeviceClock

__all__ = ["correct"]


def correct(
    points: Annotated[
        Path,
        typer.Argument(
            metavar="POINTS.csv", help="Columns time, x, y (px) and others; or time, image."
        ),
    ],
    model: ModelOption,
    log: Annotated[Path, typer.Option(help="CSV of temperatures, epochs.csv, or a store.")],
    out: Annotated[
        Path | None, typer.Option(help="CSV to write (points), or folder (images).")
    ] = None,
    to: Annotated[
        float | None, typer.Option(help="°C to correct to; default: the model's T0.")
    ] = None,
    column: Annotated[str | None, typer.Option(help="Temperature column of the log.")] = None,
    timezone: TimezoneOption = None,
    temperature_sd: Annotated[
        float, typer.Option(min=0.0, help="Of a reading of the log, K.")
    ] = 0.05,
    image_size: Annotated[
        str | None, typer.Option("--size", help="WIDTHxHEIGHT where images are binned.")
    ] = None,
    extrapolate: ExtrapolateOption = False,
    json: JsonOption = None,
) -> None:
    """Correct image points, or images, that were taken at known temperatures.

    Example: thermocald correct --model camera.thermal.yaml --log weather.csv points.csv
    """
    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.cli.predict import read_log, say_what_is_missing, warnings_said

    thermal = ThermalCamera.load(model)
    say_what_is_missing(thermal)
    table = read_log(thermal, log, column, timezone)
    if image_size is not None:
        thermal = thermal.for_images(*_size(image_size))
    try:
        with points.open(encoding="utf-8-sig") as file:
            header = [n.strip() for n in file.readline().split(",")]
    except (OSError, UnicodeDecodeError) as cause:
        raise DataError(f"{points}: cannot be read: {cause}") from cause
    if "image" in header and out is None:
        raise UsageError("--out is missing: the folder for the corrected images")
    task = _Task(thermal, table, points, to, temperature_sd, extrapolate, device_clock(timezone))
    with warnings_said():
        if "image" in header and out is not None:
            _images(task, out, json)
        else:
            _points(task, out, json)


@dataclass(frozen=True, eq=False)
class _Task:
    """What is corrected, with which model and log; temperature_sd K, of a reading of the log."""

    thermal: ThermalCamera
    log: TemperatureLog
    path: Path
    asked_c: float | None
    temperature_sd: float
    extrapolate: bool
    clock: DeviceClock

    @property
    def corrected_to(self) -> float:
        """°C."""
        return self.thermal.model.T0 if self.asked_c is None else self.asked_c


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not width.isdigit() or not height.isdigit() or int(width) * int(height) == 0:
        raise UsageError(f"--size {text}: write WIDTHxHEIGHT in px, such as 1640x1232")
    return int(width), int(height)


def _points(task: _Task, out: Path | None, json: str | None) -> None:
    from thermocald.cli.common import write_parts, write_result

    sums = _Sums()
    lines = _corrected_lines(task, sums)
    if out is not None:
        write_parts(lines, out)
    elif json == "-":
        for _ in lines:
            pass
    else:
        write_parts(lines, "-")
    summary: dict[str, Any] = {
        "format": "thermocald-correction/1",
        "points": sums.points,
        "corrected_to": task.corrected_to,
        "rms_correction_px": sums.rms(sums.moved),
        "rms_left_over_px": sums.rms(sums.left_over),
        "extrapolated_rows": sums.extrapolated,
    }
    if write_result(summary, json) and out is not None:
        typer.echo(
            f"{out}: {sums.points} points corrected by {summary['rms_correction_px']:.3f} px (RMS);"
            f" left over ± {summary['rms_left_over_px']:.3f} px"
        )


@dataclass
class _Sums:
    """Over the points that were corrected: squares px² of both coordinates, rows outside."""

    points: int = 0
    moved: float = 0.0
    left_over: float = 0.0
    extrapolated: int = 0

    def rms(self, squares: float) -> float:
        """Of one coordinate, px."""
        return float((squares / (2 * self.points)) ** 0.5)


def _corrected_lines(task: _Task, sums: _Sums) -> Iterator[str]:
    """The corrected CSV, a block of rows at a time: a year of points has to fit into memory."""
    import csv
    import io

    import numpy as np

    from thermocald.analysis.thermal.correction import correct_points
    from thermocald.analysis.thermal.temperature_log import row_blocks

    extra = ["dx", "dy", "sd_x", "sd_y", "temperature", "extrapolated_K"]
    for header, rows, numbers in row_blocks(task.path, ("time", "x", "y"), task.clock):
        inside = task.thermal.model.sensor.contains(numbers[:, 1:])
        if not inside.all():
            x, y = numbers[np.argmin(inside), 1:]
            sensor = task.thermal.model.sensor
            raise DataError(
                f"{task.path}: ({x:g}, {y:g}) px lies outside the model's {sensor.width}×"
                f"{sensor.height} px; of another camera, or binned (--size)?"
            )
        found = correct_points(
            task.thermal, task.log, numbers[:, 0], numbers[:, 1:], task.asked_c,
            task.temperature_sd, task.extrapolate,
        )  # fmt: skip
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        if not sums.points:
            writer.writerow([*header, *extra])
        moved = found.points - numbers[:, 1:]
        for i, row in enumerate(rows):
            row = {**row, "x": f"{found.points[i, 0]:.5f}", "y": f"{found.points[i, 1]:.5f}"}
            tail = [*moved[i], *found.sds[i], found.temperature[i], found.extrapolated[i]]
            writer.writerow([*(row[n] for n in header), *(f"{v:.6g}" for v in tail)])
        sums.points += len(rows)
        sums.moved += float(np.sum(moved**2))
        sums.left_over += float(np.sum(found.sds**2))
        sums.extrapolated += int((found.extrapolated > 0).sum())
        yield text.getvalue()


def _images(task: _Task, out: Path, json: str | None) -> None:
    import cv2

    from thermocald.analysis.thermal.correction import image_corrections
    from thermocald.analysis.thermal.temperature_log import read_rows
    from thermocald.cli.common import progress, write_result

    _, rows, numbers = read_rows(task.path, ("time",), task.clock)
    make_folder(out)
    sensor = task.thermal.model.sensor
    done: list[dict[str, Any]] = []
    with progress(len(rows), "correcting images") as advance:
        corrections = image_corrections(
            task.thermal, task.log, numbers[:, 0], task.asked_c, task.temperature_sd,
            task.extrapolate,
        )  # fmt: skip
        for row in rows:
            source, written = task.path.parent / row["image"], out / Path(row["image"]).name
            image = cv2.imread(str(source), cv2.IMREAD_UNCHANGED)
            if image is None:
                raise ImageError(f"{source}: is not a readable image")
            if written.exists() and written.samefile(source):
                raise UsageError(f"{written}: would be overwritten; give another --out")
            if image.shape[:2] != (sensor.height, sensor.width):
                raise ImageError(
                    f"{source}: has {image.shape[1]}×{image.shape[0]} px, the model's camera "
                    f"{sensor.width}×{sensor.height}; say --size where it is binned"
                )
            c = next(corrections)
            corrected = cv2.remap(image, c.map_x, c.map_y, cv2.INTER_CUBIC)
            encoded, data = cv2.imencode(written.suffix, corrected)
            if not encoded:
                raise DataError(f"{written}: its format cannot be written")
            with new_file(written) as partial:
                partial.write_bytes(data.tobytes())
            done.append(
                {
                    "image": str(source),
                    "corrected": str(written),
                    "temperature": c.temperature,
                    "rms_correction_px": c.rms_px,
                    "largest_correction_px": c.largest_px,
                    "rms_left_over_px": c.left_over_px,
                    "extrapolated_K": c.extrapolated,
                }
            )
            advance(1)
    summary = {
        "format": "thermocald-correction/1",
        "corrected_to": task.corrected_to,
        "images": done,
    }
    if write_result(summary, json):
        worst = max(d["rms_left_over_px"] for d in done)
        most = max(d["largest_correction_px"] for d in done)
        typer.echo(
            f"{out}: {len(rows)} images corrected by up to {most:.3f} px; left over ± "
            f"{worst:.3f} px at most (RMS)"
        )
