"""The report of a study: how the camera follows its temperature, and what that does.

`save_figures` writes the drawings of the page for a paper.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import ImageError
from thermocald.figures import Figure, draw_figure, draw_matrix, save
from thermocald.files import make_folder
from thermocald.numbers import parameter_label, plain
from thermocald.output.study import figures, tables
from thermocald.output.study.summary import answer_sentences, detail_sentences
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.report import (
    Answer,
    Chapter,
    Drawing,
    Section,
    Table,
    day,
    of_figure,
    of_matrix,
    render_report,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from datetime import datetime
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.analysis.study.study import CameraStudy, Study, StudySettings
    from thermocald.arrays import Array

_CLIP_PX = 96
_CLIP_LONGEST_PX = 480
_LEAD = (
    "How the interior orientation of a camera changes with its temperature, whether the changes "
    "are significant, and what they do to measurements in object space; the analysis is that of "
    "Elias, Eltner, Liebold and Maas (2020), Sensors 20, 643, section 4."
)


def render_study(
    study: Study, title: str = "Thermal study of a camera", made: datetime | None = None
) -> str:
    """Return the report as HTML text; made: the time that it bears, by default now."""
    chapters = [
        Chapter(
            camera.label,
            _answer(camera, f"c{i}-"),
            tuple(_sections(camera, study.settings, f"c{i}-")),
            (_device(camera),),
            tuple(_notes(camera)),
        )
        for i, camera in enumerate(study.cameras)
    ]
    return render_report(title, chapters, _LEAD, made)


def _answer(camera: CameraStudy, prefix: str) -> Answer:
    sentences = answer_sentences(camera)
    proof = figures.dependence_figure(camera, "proof", ("c", "x0", "y0"))
    if proof is None:
        proof = figures.principal_point_figure(camera, "proof")
    first = sentences[0] if sentences else "Nothing can be said about change."
    return Answer(
        first,
        of_figure(proof, prefix) if proof is not None else None,
        tuple(sentences[1:]),
        _next_steps(camera),
        _not_covered(),
    )


def _next_steps(camera: CameraStudy) -> tuple[str, ...]:
    steps = []
    if any(c.dependences for study in camera.series for c in study.channels):
        steps.append("Fit a thermal model to correct measurements with: thermocald fit.")
        steps.append("See what a straight line leaves, and why: thermocald discover.")
    else:
        steps.append("Record a temperature with the frames; without one nothing can be corrected.")
    if len(camera.series) < 2:
        steps.append("Measure a second series on another day: only that shows what repeats.")
    return tuple(steps)


def _not_covered() -> tuple[str, ...]:
    return (
        "Temperatures other than those measured, and changes faster than the epochs.",
        "Errors of the camera model itself, and focus or lens moved by hand.",
        "How another specimen of this camera behaves: that is measured with it.",
    )


def _device(camera: CameraStudy) -> str:
    """The camera, its sensor, and when each series was measured."""
    sensor = camera.series[0].series.sensor
    names = ", ".join(dict.fromkeys(study.series.camera for study in camera.series))
    measured = "; ".join(
        f"{s.name} {day(s.start_utc)}" for s in (study.series for study in camera.series)
    )
    return (
        f"{names}, {sensor.width} × {sensor.height} px of {sensor.pixel_pitch * 1000:g} µm. "
        f"Measured: {measured}."
    )


def save_figures(study: Study, folder: Path) -> list[Path]:
    """Write every figure as SVG and PNG in `folder`, which is made; return the files."""
    make_folder(folder)
    paths = []
    for camera in study.cameras:
        prefix = _file_name(camera.label) + "-" if len(study.cameras) > 1 else ""
        for figure in _panel_figures(camera):
            paths += save(draw_figure(figure), folder, prefix + figure.name)
        for name, (values, names, title, _) in _matrices(camera).items():
            paths += save(draw_matrix(values, names, title), folder, prefix + name)
    return paths


def _panel_figures(camera: CameraStudy) -> list[Figure]:
    made = (
        figures.deviation_figure(camera) if figures.has_course(camera) else None,
        figures.principal_point_figure(camera),
        figures.movement_figure(camera),
        figures.significance_figure(camera),
        figures.dependence_figure(camera),
        figures.error_figure(camera),
        figures.point_figure(camera),
    )
    return [figure for figure in made if figure is not None]


def _matrices(camera: CameraStudy) -> dict[str, tuple[Array, list[str], str, str]]:
    """By file name: correlations, what they are of, title, caption."""
    made = {
        f"correlation-{_file_name(study.series.name)}": (
            study.matrix,
            [parameter_label(n) for n in study.columns],
            study.series.name,
            (
                "Pearson's correlation over the epochs among parameters, σ₀ and temperatures. Red: "
                "they rise together; blue: one rises as the other falls."
            ),
        )
        for study in camera.series
        if len(study.series) > 2
    }
    free = [k for k in range(10) if camera.sds[k] > 0]
    if camera.correlations is not None and free:
        noise = camera.correlations.noise[free][:, free]
        made["iop-correlations"] = (
            camera.correlations.median[free][:, free],
            [parameter_label(IOP_NAMES[k]) for k in free],
            "Within the adjustments",
            (
                "Correlation of the estimated parameters within an epoch's adjustment: median over "
                f"{camera.correlations.epochs} epochs, of which the noise (sd) is "
                f"{plain(float(np.max(noise)), digits=2)} at most. High values belong to the "
                "geometry of the calibration, not to the temperature."
            ),
        )
    return made


def _sections(camera: CameraStudy, settings: StudySettings, prefix: str) -> list[Section]:
    drawn = {figure.name: of_figure(figure, prefix) for figure in _panel_figures(camera)}
    matrices = {
        name: of_matrix(values, names, f"{prefix}{name}", f"Correlation matrix, {title}", caption)
        for name, (values, names, title, caption) in _matrices(camera).items()
    }
    within = [matrices.pop("iop-correlations")] if "iop-correlations" in matrices else []

    def section(
        title: str, names: tuple[str, ...], found: Sequence[Table | None],
        more: list[Drawing] | None = None, text: tuple[str, ...] = (), folded: bool = False,
    ) -> Section:  # fmt: skip
        shown = [drawn[name] for name in names if name in drawn] + (more or [])
        rows = tuple(t for t in found if t is not None and t.rows)
        return Section(title, text, tuple(shown), rows, folded=folded)

    parts = [
        section(
            "How the camera changed", ("deviations", "principal-point", "movement"),
            [tables.deviation_table(camera)], _clips(camera, prefix),
        ),
        section(
            "How it depends on the temperature", ("temperature-dependence",),
            tables.dependence_tables(camera), list(matrices.values()),
            tuple(detail_sentences(camera)),
        ),
        section(
            "What it means in object space", ("object-space-errors", "errors-by-point"),
            [tables.cluster_table(camera), tables.point_table(camera)],
        ),
        section(
            "Whether the changes are significant", ("significance",),
            [tables.significance_table(camera, settings)], folded=True,
        ),
        section("Correlations of the parameters", (), [], within, folded=True),
        section(
            "What was measured and assumed", (), [tables.overview_table(camera)],
            text=_assumed(camera, settings), folded=True,
        ),
    ]  # fmt: skip
    return [part for part in parts if part.figures or part.tables]


def _assumed(camera: CameraStudy, settings: StudySettings) -> tuple[str, ...]:
    """What follows from values that nobody measured: said, not given as a result."""
    changes = [
        f"{plain(study.focus.change, 'mm', 2)} in {study.series.name}"
        for study in camera.series
        if study.focus is not None
    ]
    if not changes:
        return ()
    lens = f"f/{settings.f_number:g} and focused at {settings.focus_mm / 1000:g} m"
    change = f"its depth of field would change by {' and '.join(changes)}"
    return (f"If the lens were {lens}, {change}. Neither was measured.",)


def _clips(camera: CameraStudy, prefix: str) -> list[Drawing]:
    """First and last image around one target, side by side, for every series that has frames."""
    made = []
    for i, study in enumerate(camera.series):
        clip = study.series.clip
        if clip is None:
            continue
        images = tuple(
            (f"{study.series.name}, epoch {epoch}", clip_png(cut_clip(path, clip.centre, _CLIP_PX)))
            for path, epoch in ((clip.first, clip.first_epoch), (clip.last, clip.last_epoch))
        )
        made.append(
            Drawing(
                f"{prefix}clips-{i}",
                f"Image around target {clip.target}",
                f"The same {_CLIP_PX} × {_CLIP_PX} px of the first and the last frame; the cross "
                "is where the target was in the first.",
                images=images,
                columns=2,
            )
        )
    return made


def cut_clip(path: Path, centre: tuple[float, float], size: int) -> NDArray[np.uint8]:
    """Return a square of `size` px about `centre` (px), grey; black beyond the image's edge.

    Raises ImageError for what is not an image.
    """
    import cv2

    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror}") from None
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
    if image is None:
        raise ImageError(f"{path}: is not an image")
    left, top = (round(v - (size - 1) / 2) for v in centre)
    clip = np.zeros((size, size), dtype=np.uint8)
    height, width = image.shape
    x0, x1 = max(left, 0), min(left + size, width)
    y0, y1 = max(top, 0), min(top + size, height)
    if x0 < x1 and y0 < y1:
        clip[y0 - top : y1 - top, x0 - left : x1 - left] = image[y0:y1, x0:x1]
    return clip


def clip_png(clip: NDArray[np.uint8]) -> bytes:
    """Return a clip as PNG, enlarged by whole pixels, with a cross at its centre."""
    import cv2

    factor = max(1, _CLIP_LONGEST_PX // len(clip))
    large = cv2.cvtColor(np.kron(clip, np.ones((factor, factor), np.uint8)), cv2.COLOR_GRAY2BGR)
    middle = len(large) // 2
    cv2.line(large, (middle, 0), (middle, len(large)), (0, 94, 213), 1)
    cv2.line(large, (0, middle), (len(large), middle), (0, 94, 213), 1)
    done, png = cv2.imencode(".png", large)
    if not done:
        raise ImageError("an image clip could not be written as PNG")
    return bytes(png.tobytes())


def _notes(camera: CameraStudy) -> list[str]:
    """Notes of all series, each once, with the series that it holds for."""
    holders: dict[str, list[str]] = {}
    for study in camera.series:
        for note in study.notes:
            holders.setdefault(note, []).append(study.series.name)
    notes = [
        note if len(names) == len(camera.series) else f"{', '.join(names)}: {note}"
        for note, names in holders.items()
    ]
    doubts = [
        f"{study.series.name} is doubtful: {text}."
        for study in camera.series
        for text in study.series.doubts
    ]
    return doubts + notes + list(camera.notes)


def _file_name(label: str) -> str:
    """A label with nothing in it that a file name cannot hold."""
    return "".join(c if c.isalnum() or c in "-_." else "-" for c in label).strip(".") or "camera"
