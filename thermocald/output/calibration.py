"""The report of a calibration from photographs, and the report of a test field's check.

Residuals and coverage show what a standard deviation does not: distortion that the model does not
describe, and parts of the image in which no target was seen. The check of a test field predicts the
precision of a calibration and advises what to add.
"""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.field import CELLS, FieldCheck
from thermocald.analysis.series.epochs import CAUSES_OF_SIGMA0, MATERIAL
from thermocald.arrays import spread_rows
from thermocald.figures import BAND, PALETTE, Arrows, Curve, Figure, Panel, image_panel
from thermocald.numbers import (
    UNITS,
    coefficient,
    counted,
    enumerated,
    listed,
    parameter_label,
    percent,
    plain,
    with_sd,
)
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, Sensor, project
from thermocald.photogrammetry.epoch.adjustment import image_coverage
from thermocald.photogrammetry.linalg import correlations
from thermocald.report import Answer, Chapter, Section, Table, as_sentence

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.analysis.camera.photographs import PhotographResult, Photographs
    from thermocald.arrays import Array


_MOST_ARROWS = 3000
_RINGS = 10
_LITTLE_COVERED = 0.6
_FIELD_DOMINATES = 2.0  # times the standard deviation from the image points alone
_FEW_NAMES = 3  # for which a legend or a line has room


def render_calibration(
    result: Photographs, sensor: Sensor, name: str, notes: Sequence[str] = ()
) -> str:
    """Return the report as HTML text; notes: doubts of the estimated camera, and assumptions."""
    posed = [p for p in result.photographs if len(p.points)]
    tables = (interior_table(result, sensor), _correlations(result))
    sections = (
        Section("Residuals and coverage", figures=_figures(posed, sensor) if posed else ()),
        Section("Interior orientation", tables=tuple(t for t in tables if t.rows)),
        Section("Photographs", tables=(_photographs(result),)),
    )
    return Chapter(
        f"Calibration of {name}",
        _answer(result, posed, sensor),
        tuple(s for s in sections if s.figures or s.tables),
        (f"{name}, {sensor}.",),
        tuple(map(as_sentence, notes)),
    ).page()


def _answer(result: Photographs, posed: Sequence[PhotographResult], sensor: Sensor) -> Answer:
    proof = residual_figure(result, sensor) if posed else None
    without: dict[str, list[str]] = {}
    for p in result.photographs:
        if not len(p.points):
            without.setdefault(_outcome(p, ", "), []).append(Path(p.path).name)
    steps = [f"{listed(names, _FEW_NAMES)}: {outcome}." for outcome, names in without.items()]
    if not posed or result.interior is None:
        return Answer(f"Not calibrated: {result.reason}.", proof, next_steps=tuple(steps))
    points, residuals = _used(posed)
    left_out = sum(int(np.count_nonzero(~p.used)) for p in posed)
    rms = float(np.sqrt(np.mean(residuals**2)))
    covered = image_coverage(sensor, points)
    if result.estimated:
        rows = interior_table(result, sensor).rows
        found = [f"{name} is {mm} ({px} px)" for name, mm, px in rows if px]
        sentence = f"{enumerated(found)}."
        fit = f"; σ₀ {result.sigma0:.2f}, redundancy {result.redundancy}"
        fit += f"; {CAUSES_OF_SIGMA0}" if result.sigma0 > 1.0 + MATERIAL else ""
    else:
        sentence = f"The interior orientation was held fixed, not estimated: {result.reason}."
        fit = ""
    more = (
        (
            f"{len(posed)} of {len(result.photographs)} photographs, {len(points)} image points, "
            f"{left_out} left out; residuals of {plain(rms, 'px', 3)} (RMS per coordinate){fit}. "
            f"The points cover {percent(covered)} of the image."
        ),
    )
    if covered < _LITTLE_COVERED:
        steps.append("Take photographs with the field in the parts of the image that are empty.")
    if result.estimated:
        steps.append("Use the camera that --camera-out writes in every later command.")
    return Answer(
        sentence, proof, more, tuple(steps),
        (
            ("Temperatures other than that of the photographs: a series with a thermometer shows "
            "how the camera changes."),
            "Parts of the image without targets: there the distortion is extrapolated.",
            "Errors of the camera model, which the standard deviations do not include.",
        ),
    )  # fmt: skip


def residual_figure(result: Photographs, sensor: Sensor) -> Figure:
    """Draw measured minus adjusted image points of all photographs as arrows; may be empty."""
    points, residuals = _used(result.photographs)
    lengths = np.linalg.norm(residuals, axis=1)
    rows = spread_rows(len(points), _MOST_ARROWS)
    arrows = Arrows(
        points[rows], residuals[rows], (sensor.width, sensor.height), PALETTE[0],
        max(1.5 * float(np.percentile(lengths, 95)), 1e-9) if len(rows) else 1.0,
    )  # fmt: skip
    return Figure(
        "residuals", "Residuals",
        "Measured minus adjusted image points of all photographs. Without pattern they are noise; "
        "neighbours that point the same way show distortion that the model does not describe, or "
        "wrong coordinates of the test field.",
        (image_panel("Residuals", arrows=arrows),),
    )  # fmt: skip


def _used(photographs: Sequence[PhotographResult]) -> tuple[Array, Array]:
    """Return the image points (n, 2) that the adjustment used, and their residuals, px."""
    found = [np.hstack([p.points, p.residuals])[p.used] for p in photographs if len(p.points)]
    points, residuals = np.hsplit(np.concatenate([np.empty((0, 4)), *found]), 2)
    return points, residuals


def _figures(posed: Sequence[PhotographResult], sensor: Sensor) -> tuple[Figure, ...]:
    """Return the figures of the coverage and of the residuals."""
    points, residuals = _used(posed)
    w, h = float(sensor.width), float(sensor.height)
    seen = [Curve("", np.array([0, w, w, 0, 0]), np.array([0, 0, h, h, 0]), "line", "#888888")]
    for i, photograph in enumerate(posed):
        name = Path(photograph.path).name if len(posed) <= _FEW_NAMES else ""
        x, y = photograph.points[photograph.used].T
        seen.append(Curve(name, x, y, "points", PALETTE[i % len(PALETTE)]))
    cloud = Curve("", residuals[:, 0], residuals[:, 1], "points", PALETTE[0])
    return (
        Figure(
            "coverage", "Coverage",
            "The targets seen, coloured by photograph, and the frame of the image.",
            (image_panel("Coverage", *seen),),
        ),
        _by_radius(points, residuals, sensor),
        Figure(
            "scatter", "Residuals in x and y",
            "The same residuals, x against y: they should form a round cloud without outliers.",
            (image_panel("Residuals in x and y", cloud),),
        ),
    )  # fmt: skip


def _by_radius(points: Array, residuals: Array, sensor: Sensor) -> Figure:
    from_centre = points - sensor.centre
    radius = np.linalg.norm(from_centre, axis=1)
    outwards = np.einsum("ni,ni->n", residuals, from_centre) / np.maximum(radius, 1e-9)
    rings = np.array_split(np.argsort(radius), min(_RINGS, len(radius)))
    x, y, sd = np.array(
        [
            (radius[r].mean(), outwards[r].mean(), outwards[r].std(ddof=1) / np.sqrt(len(r)))
            for r in rings
            if len(r) > 1
        ]
    ).reshape(-1, 3).T  # fmt: skip
    curves = (
        Curve("points", radius, outwards, "points", "#9fc4dc"),
        Curve("mean, 95 %", x, y, "line", PALETTE[1], BAND * sd),
    )
    panel = Panel(
        "Residuals outwards", "distance from the image centre in px", "outwards in px", curves,
        horizontal=((0.0, ""),),
    )  # fmt: skip
    return Figure(
        "outwards", panel.title,
        "The residuals' component away from the image centre, and its mean in rings with equal "
        "numbers of points. A band that excludes zero shows radial distortion that the model does "
        "not describe.",
        (panel,),
    )  # fmt: skip


def interior_table(
    result: Photographs, sensor: Sensor, label: Callable[[str], str] = parameter_label
) -> Table:
    """Return the values with their standard deviations, c, x0 and y0 in px too."""
    values = () if result.interior is None else result.interior.as_array()
    sds = np.sqrt(np.diag(result.covariance)[:10])

    pitch = sensor.pixel_pitch
    rows = [
        (
            label(n),
            with_sd(v, sd, UNITS[n]) if sd > 0 else f"{plain(v, UNITS[n], 6)} (held)",
            with_sd(v / pitch, sd / pitch) if sd > 0 and n in ("c", "x0", "y0") else "",
        )
        for n, v, sd in zip(IOP_NAMES, values, sds, strict=False)
    ]
    return Table(
        "Values",
        ("parameter", "value ± sd", "in px"),
        tuple(rows),
        "The standard deviations, also of the poses, include the noise of the image points, the "
        "errors of the test field's coordinates, and what photographs differ in (focus, rolling "
        "shutter, a board that bends), but not the errors of the camera model.",
    )


def _correlations(result: Photographs) -> Table:
    """Return the pairs whose correlation exceeds ±0.5, the strongest first."""
    R = correlations(result.covariance[:10, :10])
    pairs = [(i, j) for i, j in combinations(range(10), 2) if abs(R[i, j]) > 0.5]
    rows = [
        (f"{parameter_label(IOP_NAMES[i])}, {parameter_label(IOP_NAMES[j])}", coefficient(R[i, j]))
        for i, j in sorted(pairs, key=lambda pair: -abs(R[pair]))
    ]
    return Table("Correlations beyond ±0.5", ("pair", "r"), tuple(rows))


def _outcome(p: PhotographResult, mark: str) -> str:
    return p.status.replace("_", " ") + (f"{mark}{p.reason}" if p.reason else "")


def _photographs(result: Photographs) -> Table:
    return Table.of(
        "Each photograph",
        result.photographs,
        {
            "photograph": lambda p: Path(p.path).name,
            "result": lambda p: _outcome(p, ": "),
            "targets": lambda p: str(p.n_targets),
            "left out": lambda p: str(len(p.rejected)),
            "RMS px": lambda p: plain(p.rms_px, digits=3),
            "X0, Y0, Z0 mm ± sd": lambda p: p.place or "–",
        },
    )


def render_field_check(result: FieldCheck, title: str = "") -> str:
    """Return the report as HTML text."""
    rows = tuple(
        (parameter_label(n), *(_sd(value) for value in row)) for n, row in result.sds_px.items()
    )
    reasons = list(result.hidden.values())
    return Chapter(
        title or "Check of a test field",
        _field_answer(result),
        (
            Section(
                "How precise",
                tables=(
                    Table(
                        "Standard deviations",
                        ("parameter", "one image", "in a series", "with the field's own errors"),
                        rows,
                        "In a series: one epoch relative to the others, for a fixed camera.",
                    ),
                ),
            ),
            Section(
                "Which targets are not seen, and why",
                items=tuple((counted(reasons.count(r), "target"), r) for r in sorted(set(reasons))),
                text=() if reasons else ("All are seen.",),
            ),
        ),
        (f"{result.camera.sensor}.",),
    ).page()


def _field_answer(result: FieldCheck) -> Answer:
    sds = result.sds_px
    expected, stated = (
        ", ".join(f"{parameter_label(n)} to ± {_sd(row[k])}" for n, row in sds.items())
        for k in (0, -1)
    )
    surveyed = f"gives {expected}, for image points of ± {result.sigma_px:g} px."
    dominated = max(field / one for one, _, field in sds.values()) > _FIELD_DOMINATES
    if result.weak:
        sentence = f"Not enough for a result from this position: {'; '.join(result.weak)}."
    elif dominated:
        sentence = f"With the stated errors of the targets' coordinates one image gives {stated}."
    else:
        sentence = f"One image {surveyed}"
    X, Y, Z = result.station.centre
    more = (
        f"{len(result.visible)} of {len(result.field)} targets are visible from ({X:.0f}, {Y:.0f}, "
        f"{Z:.0f}) mm, {result.distance:.0f} mm away; they cover {percent(result.coverage)} of the "
        f"image, and their depth spans {percent(result.depth_relief)} of the distance."
    )
    if dominated and not result.weak:
        more += f" With exact coordinates one image {surveyed}"
    return Answer(
        sentence,
        seen_figure(result),
        (more,),
        tuple(map(as_sentence, result.advice))
        or ("No addition would improve it by a seventh: mount it.",),
        (
            "Blur, shadow, glare and paper that is not flat: look at the first frames.",
            "Errors of the camera model, which cannot be predicted from a test field.",
        ),
    )


def _sd(value: float) -> str:
    return plain(value, "px", 2) if value < 1e300 else "undetermined"


def seen_figure(result: FieldCheck) -> Figure:
    """Draw the visible targets in the image, and the parts of it that should all hold some."""
    model, field = result.camera, result.field
    w, h = float(model.sensor.width), float(model.sensor.height)
    upright = [((x, x), (0.0, h)) for x in np.linspace(0, w, CELLS[0] + 1)]
    level = [((0.0, w), (y, y)) for y in np.linspace(0, h, CELLS[1] + 1)]
    lines = [
        Curve("", np.array(x), np.array(y), colour="#bbbbbb") for x, y in (*upright, *level)
    ]  # fmt: skip
    points = project(
        model.sensor, model.interior.as_array(), result.station.as_array(),
        field.points[result.visible],
    )  # fmt: skip
    targets = Curve("", points[:, 0], points[:, 1], "points", PALETTE[0])
    empty = int(np.count_nonzero(result.cells == 0))
    return Figure(
        "seen", "What the camera sees",
        f"The visible targets in the image, in {CELLS[0]} × {CELLS[1]} parts, {empty} of them "
        "empty. The distortion is determined only where there are targets.",
        (image_panel("Targets in the image", *lines, targets),),
    )  # fmt: skip
