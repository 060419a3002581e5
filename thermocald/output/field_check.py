"""The report of a test field's check: what a camera would get out of it, and what to add."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.field.check import CELLS, FieldCheck
from thermocald.figures import PALETTE, Curve, Figure, Panel
from thermocald.numbers import parameter_label, percent, plain
from thermocald.photogrammetry.camera.camera_model import CameraModel, project
from thermocald.report import Answer, Chapter, Section, Table, of_figure, render_report

if TYPE_CHECKING:
    from datetime import datetime

    from thermocald.analysis.field.advice import FieldAssessment
    from thermocald.photogrammetry.field.testfield import TestField


def render_field_check(assessed: FieldAssessment, made: datetime | None = None) -> str:
    """Return the report as HTML text; made: the time that it bears, by default now."""
    result, field, model = assessed.check, assessed.field, assessed.camera
    pitch = model.sensor.pixel_pitch
    sds = result.precision.pixels(pitch)
    said = ", ".join(f"{parameter_label(n)} to ± {_sd(one)}" for n, (one, *_) in sds.items())
    if result.weak:
        sentence = f"Not enough for a result from there: {'; '.join(result.weak)}."
    else:
        sentence = f"One image gives {said}, for image points of ± {assessed.sigma_px:g} px."
    X, Y, Z = result.station.centre
    more = (
        f"{len(result.visible)} of {len(field)} targets are visible from ({X:.0f}, {Y:.0f}, "
        f"{Z:.0f}) mm, {result.distance:.0f} mm away; they cover {percent(result.coverage)} of the "
        f"image, and their depth spans {percent(result.depth_relief)} of the distance."
    )
    rows = tuple((parameter_label(n), *(_sd(value) for value in row)) for n, row in sds.items())
    reasons = list(result.hidden.values())
    chapter = Chapter(
        "Check of a test field",
        Answer(
            sentence,
            of_figure(_seen(result, field, model)),
            (more,),
            tuple(f"{text[0].upper()}{text[1:]}." for text in assessed.advice)
            or ("Nothing would help by a seventh: put it up.",),
            (
                "Blur, shadow, glare and paper that is not flat: look at the first frames.",
                "Errors of the camera model, which no field shows beforehand.",
            ),
        ),
        (
            Section(
                "How precise",
                tables=(
                    Table(
                        "Standard deviations",
                        ("parameter", "one image", "in a series", "with the field's own errors"),
                        rows,
                        "In a series: one epoch relative to the others, of a camera that stands "
                        "still.",
                    ),
                ),
            ),
            Section(
                "Which targets are not seen, and why",
                items=tuple((f"{reasons.count(r)} targets", r) for r in sorted(set(reasons))),
                text=() if reasons else ("All are seen.",),
            ),
        ),
        (f"{model.sensor.width} × {model.sensor.height} px of {pitch * 1000:g} µm.",),
    )
    return render_report(chapter.title, [chapter], made=made)


def _sd(value: float) -> str:
    return f"{plain(value, 'px', 2)}" if value < 1e300 else "nothing"


def _seen(result: FieldCheck, field: TestField, model: CameraModel) -> Figure:
    """The visible targets in the image, with the parts that ought to be filled."""
    w, h = float(model.sensor.width), float(model.sensor.height)
    lines = [Curve("", np.array([x, x]), np.array([0.0, h]), colour="#bbbbbb")
             for x in np.linspace(0, w, CELLS[0] + 1)]  # fmt: skip
    lines += [Curve("", np.array([0.0, w]), np.array([y, y]), colour="#bbbbbb")
              for y in np.linspace(0, h, CELLS[1] + 1)]  # fmt: skip
    points = project(
        model.sensor, model.interior.as_array(), result.station.as_array(),
        field.points[result.visible],
    )  # fmt: skip
    targets = Curve("", points[:, 0], h - points[:, 1], "points", PALETTE[0])
    empty = int(np.count_nonzero(result.cells == 0))
    panel = Panel("Targets in the image", "x in px", "y in px, up", (*lines, targets), equal=True)
    return Figure(
        "seen", "What the camera sees",
        f"The visible targets in the image, in {CELLS[0]} × {CELLS[1]} parts, {empty} of them "
        "empty. Distortion is only known where there are targets.",
        (panel,),
    )  # fmt: skip
