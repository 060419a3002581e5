"""`thermocald testfield check`: what a camera would get out of a field."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermocald.cli.common import say
from thermocald.cli.options import JsonOption, PixelPitchOption
from thermocald.cli.testfield_options import (
    CameraFile,
    Diameter,
    Flat,
    Landscape,
    Paper,
    design_of,
)

if TYPE_CHECKING:
    from thermocald.analysis.field.check import FieldCheck
    from thermocald.photogrammetry.camera.camera_model import CameraModel
    from thermocald.photogrammetry.field.testfield import TestField

__all__ = ["check"]

# What most people point at a test field: the Raspberry Pi camera v2.1.
_USUAL = {"width": 3280, "height": 2464, "pixel_pitch": 0.00112, "c": 3.04}
_EOP = ("omega", "phi", "kappa", "X0", "Y0", "Z0")


def check(
    field: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FIELD]", help="A testfield.csv; without it what `print` would draw."
        ),
    ] = None,
    paper: Paper = "A3",
    flat: Flat = False,
    landscape: Landscape = None,
    diameter: Diameter = None,
    camera: CameraFile = None,
    pixel_pitch: PixelPitchOption = None,
    place: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--from", metavar="X Y Z", help="Where the camera stands, mm."),
    ] = None,
    at: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="What it looks at; default the field's middle."),
    ] = None,
    roll: Annotated[float, typer.Option(help="Turned about its axis, degrees.")] = 0.0,
    sigma: Annotated[float, typer.Option(min=1e-4, help="Of an image coordinate, px.")] = 0.03,
    json: JsonOption = None,
) -> None:
    """Assess a test field: what a camera sees of it, how well it would be calibrated, what to add.

    Without FIELD it is the field that `testfield print` would draw with the same --paper, --flat,
    --landscape and --diameter, so that you know before you print. Without --from the camera stands
    where the field just fills its image; without --camera it is a Raspberry Pi camera v2.1.

    Example: thermocald testfield check --paper A4
    Example: thermocald testfield check field/testfield.csv --from 900 900 700
    """
    import numpy as np

    from thermocald.analysis.field.check import check_field, station_at, usual_station
    from thermocald.cli.common import write_result
    from thermocald.output.testfield.layout import field_of, lay_out
    from thermocald.store.recording.testfield_file import read_testfield

    if field is None:
        targets = field_of(lay_out(design_of(paper, flat, landscape, diameter)))
    else:
        targets = read_testfield(field)
    model = _camera(camera, pixel_pitch)
    middle = (targets.points.min(axis=0) + targets.points.max(axis=0)) / 2
    look_at = middle if at is None else np.array(at)
    if place is None:
        stand = usual_station(model, targets)
        if at is not None or roll:
            stand = station_at(stand.centre, look_at, np.radians(roll))
    else:
        stand = station_at(np.array(place), look_at, np.radians(roll))
    result = check_field(model, targets, stand, sigma)
    document = _check_document(result, targets, model, sigma)
    if write_result(document, json):
        _show_check(result, targets, model, document["advice"])


def _camera(file: Path | None, pixel_pitch: float | None) -> CameraModel:
    from thermocald.output import camera_files
    from thermocald.photogrammetry.camera.camera_model import (
        CameraModel,
        InteriorOrientation,
        Sensor,
    )

    if file is not None:
        return camera_files.read(file, pixel_pitch=pixel_pitch).model
    say("no --camera: a Raspberry Pi camera v2.1 (3280 × 2464 px of 1.12 µm, 3.04 mm) is assumed")
    sensor = Sensor(int(_USUAL["width"]), int(_USUAL["height"]), _USUAL["pixel_pitch"])
    return CameraModel(sensor, InteriorOrientation(c=_USUAL["c"]))


def _check_document(
    result: FieldCheck, field: TestField, model: CameraModel, sigma: float
) -> dict[str, Any]:
    from thermocald.analysis.field.advice import advise
    from thermocald.analysis.field.check import FREE

    def finite(value: float) -> float | None:
        return float(value) if value < 1e300 else None

    sds = {}
    for kind in ("epoch", "series", "level"):
        values = getattr(result.precision, kind)
        sds[kind] = {f"sd_{n}": finite(v) for n, v in zip(FREE, values, strict=True)}
    return {
        "format": "thermocald-testfield-check/1",
        "targets": len(field),
        "visible": [field.names[i] for i in result.visible],
        "hidden": result.hidden,
        "station": dict(zip(_EOP, result.station.as_array().tolist(), strict=True)),
        "distance": result.distance,
        "depth_relief": result.depth_relief,
        "coverage": result.coverage,
        "cells": result.cells.tolist(),
        "median_size_px": float(sorted(result.sizes)[len(result.sizes) // 2])
        if len(result.sizes)
        else None,
        "sigma_px": sigma,
        "pixel_pitch": model.sensor.pixel_pitch,
        **sds,
        "calibrates": not result.weak,
        "weak": list(result.weak),
        "advice": advise(model, field, result, sigma),
    }


def _show_check(
    result: FieldCheck, field: TestField, model: CameraModel, advice: list[str]
) -> None:
    if result.weak:
        typer.echo("NOT ENOUGH: a series of a fixed camera gets no result from there")
        for reason in result.weak:
            typer.echo(f"  because: {reason}")
    else:
        typer.echo("good: every image from there can be calibrated by itself")
    X, Y, Z = result.station.centre
    typer.echo(
        f"{len(result.visible)} of {len(field)} targets visible from ({X:.0f}, {Y:.0f}, {Z:.0f}) "
        f"mm, {result.distance:.0f} mm away; they cover {result.coverage:.0%} of the image, depth "
        f"relief {result.depth_relief:.0%} of the distance"
    )
    reasons = list(result.hidden.values())
    for reason in sorted(set(reasons)):
        typer.echo(f"  {reasons.count(reason)} {reason}")
    typer.echo("  standard deviations in px    one image    in a series    with the field's own")
    for name, row in result.precision.pixels(model.sensor.pixel_pitch).items():
        cells = [f"{v:.3g}" if v < 1e300 else "none" for v in row]
        typer.echo(f"    {name:<24} {cells[0]:>12} {cells[1]:>14} {cells[2]:>20}")
    for note in advice:
        typer.echo(f"  better: {note}")
