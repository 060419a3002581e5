"""The report of a study: one HTML file that works offline, prints, and needs no other knowledge.

Drawings are SVG in the page; the script of plotly, embedded too, is only used when a reader looks
closer. `save_figures` writes the same drawings for a paper.
"""

from __future__ import annotations

import base64
import gzip
import json
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald import __version__
from thermocald.atomic_file import make_folder, write_text
from thermocald.output.figures.clips import clip_png, cut_clip, data_uri
from thermocald.output.figures.draw import draw_figure, draw_matrix, draw_panel, inline_svg, save
from thermocald.output.figures.numbers import parameter_label
from thermocald.output.figures.panels import Figure, document
from thermocald.output.page import render_page
from thermocald.output.study import figures, tables
from thermocald.output.study import object_space_figures as object_space
from thermocald.output.study.dependence import dependence_figure, dependence_tables
from thermocald.output.study.object_space_tables import cluster_table, point_table
from thermocald.output.study.summary import summary
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES

if TYPE_CHECKING:
    from thermocald.analysis.study.study import CameraStudy, Study
    from thermocald.output.study.tables import Table

__all__ = ["render_report", "save_figures", "write_report"]

_TEMPLATES = Path(__file__).parent / "templates"
_CLIP_PX = 96
_A_YEAR = 31_557_600.0
_LEAD = (
    "How the interior orientation of this camera changes with its temperature, whether the changes "
    "are significant, and what they do to measurements in object space. The analysis is that of "
    "Elias, Eltner, Liebold and Maas (2020), Sensors 20, 643, section 4."
)


@dataclass(frozen=True)
class _Drawing:
    """A figure as the template shows it."""

    id: str
    kind: str
    title: str
    caption: str
    svgs: tuple[str, ...] = ()
    images: tuple[dict[str, str], ...] = ()
    columns: int = 3
    data: str = ""


@dataclass(frozen=True)
class _Part:
    title: str
    figures: tuple[_Drawing, ...] = ()
    tables: tuple[Table, ...] = ()


@dataclass(frozen=True)
class _Matrix:
    """A correlation matrix to be drawn."""

    name: str
    title: str
    caption: str
    names: tuple[str, ...]
    values: Any = field(repr=False)


def render_report(
    study: Study, title: str = "Thermal study of a camera", made: datetime | None = None
) -> str:
    """The report as HTML text.

    made: the time that it bears, by default now.
    """
    from plotly.offline import get_plotlyjs

    cameras = [
        {
            "id": f"camera-{i}",
            "label": camera.label,
            "device": _device(camera),
            "summary": summary(camera),
            "notes": _notes(camera),
            "parts": _parts(camera, study, f"c{i}"),
        }
        for i, camera in enumerate(study.cameras)
    ]
    return render_page(
        _TEMPLATES / "study.html.j2",
        title=title,
        lead=_LEAD,
        cameras=cameras,
        script=(_TEMPLATES / "study.js").read_text(encoding="utf-8"),
        plotly=_packed(get_plotlyjs()),
        made=_made(made),
    )


def _made(at: datetime | None) -> str:
    """When and with what the report was made."""
    at = at or datetime.now(tz=UTC)
    versions = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy"))
    return f"Made on {at:%Y-%m-%d at %H:%M} UTC with thermocald {__version__} ({versions})."


def _device(camera: CameraStudy) -> str:
    """The camera, its sensor, and when each series was measured."""
    sensor = camera.series[0].series.sensor
    names = ", ".join(dict.fromkeys(study.series.camera for study in camera.series))
    measured = "; ".join(
        f"{s.name} {_day(s.start_utc)}" for s in (study.series for study in camera.series)
    )
    return (
        f"{names}, {sensor.width} × {sensor.height} px of {sensor.pixel_pitch * 1000:g} µm. "
        f"Measured: {measured}."
    )


def _day(start_utc: float) -> str:
    """The start of a series, or that it has no date: simulated recordings count from 1970."""
    if not start_utc > _A_YEAR:
        return "(no date)"
    return f"{datetime.fromtimestamp(start_utc, tz=UTC):%Y-%m-%d %H:%M} UTC"


def write_report(path: Path, html: str) -> None:
    """Write the file whole or not at all; OutputError if it cannot be."""
    write_text(path, html)


def _packed(script: str) -> str:
    """A script as base64 of its gzip: a third of the size, unpacked by the reader's browser."""
    return base64.b64encode(gzip.compress(script.encode(), 9, mtime=0)).decode("ascii")


def save_figures(study: Study, folder: Path) -> list[Path]:
    """Every figure as SVG and PNG in `folder`, which is made; returns the files."""
    make_folder(folder)
    paths = []
    for camera in study.cameras:
        prefix = _file_name(camera.label) + "-" if len(study.cameras) > 1 else ""
        for figure in _panel_figures(camera):
            paths += save(draw_figure(figure), folder, prefix + figure.name)
        for matrix in _matrices(camera):
            drawing = draw_matrix(matrix.values, matrix.names, matrix.title)
            paths += save(drawing, folder, prefix + matrix.name)
    return paths


def _panel_figures(camera: CameraStudy) -> list[Figure]:
    made = (
        figures.deviation_figure(camera),
        figures.principal_point_figure(camera),
        figures.movement_figure(camera),
        figures.significance_figure(camera),
        dependence_figure(camera),
        object_space.error_figure(camera),
        object_space.point_figure(camera),
    )
    return [figure for figure in made if figure is not None]


def _matrices(camera: CameraStudy) -> list[_Matrix]:
    made = [
        _Matrix(
            f"correlation-{_file_name(study.series.name)}",
            study.series.name,
            "Pearson's correlation over the epochs among parameters, σ₀ and temperatures. Red: "
            "they rise together; blue: one rises as the other falls.",
            tuple(parameter_label(n) for n in study.columns),
            study.matrix,
        )
        for study in camera.series
        if len(study.series) > 2
    ]
    if camera.correlations is not None:
        free = [k for k in range(10) if camera.sds[k] > 0]
        if free:
            made.append(
                _Matrix(
                    "iop-correlations",
                    "Within the adjustments",
                    "Correlation of the estimated parameters within an epoch's adjustment: median "
                    f"over {camera.correlations.epochs} epochs. High values belong to the geometry "
                    "of the calibration, not to the temperature.",
                    tuple(parameter_label(IOP_NAMES[k]) for k in free),
                    camera.correlations.median[free][:, free],
                )
            )
    return made


def _parts(camera: CameraStudy, study: Study, prefix: str) -> list[_Part]:
    drawn = {figure.name: _drawing(figure, prefix) for figure in _panel_figures(camera)}
    matrices = [_matrix_drawing(m, f"{prefix}-{m.name}") for m in _matrices(camera)]
    over_time = tuple(m for m in matrices if not m.id.endswith("iop-correlations"))
    within = tuple(m for m in matrices if m.id.endswith("iop-correlations"))

    def pick(*names: str) -> tuple[_Drawing, ...]:
        return tuple(drawn[name] for name in names if name in drawn)

    def some(*made: Table | None) -> tuple[Table, ...]:
        return tuple(t for t in made if t is not None and t.rows)

    s = study.settings
    parts = [
        _Part("What was measured", (), some(tables.overview_table(camera))),
        _Part(
            "How the camera changed",
            (*pick("deviations", "principal-point", "movement"), *_clips(camera, prefix)),
            some(tables.deviation_table(camera), tables.focus_table(camera, s)),
        ),
        _Part(
            "Whether the changes are significant",
            pick("significance"),
            some(tables.significance_table(camera, s)),
        ),
        _Part(
            "How it depends on the temperature",
            (*pick("temperature-dependence"), *over_time),
            some(*dependence_tables(camera)),
        ),
        _Part(
            "Correlations of the parameters", within, some(tables.correlation_noise_table(camera))
        ),
        _Part(
            "What it means in object space",
            pick("object-space-errors", "errors-by-point"),
            some(cluster_table(camera), point_table(camera)),
        ),
    ]
    return [part for part in parts if part.figures or part.tables]


def _drawing(figure: Figure, prefix: str) -> _Drawing:
    name = f"{prefix}-{figure.name}"
    svgs = tuple(
        inline_svg(draw_panel(panel, legend=i == 0), f"{name}-{i}", panel.title)
        for i, panel in enumerate(figure.panels)
    )
    # "<" inside a script element could end it.
    data = json.dumps(document(figure), ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    data = data.replace("<", "\\u003c")
    columns = min(figure.columns, len(figure.panels))
    return _Drawing(name, "panels", figure.title, figure.caption, svgs, (), columns, data)


def _matrix_drawing(matrix: _Matrix, name: str) -> _Drawing:
    svg = inline_svg(draw_matrix(matrix.values, matrix.names, matrix.title), name, matrix.title)
    title = f"Correlation matrix, {matrix.title[0].lower() + matrix.title[1:]}"
    if not name.endswith("iop-correlations"):
        title = f"Correlation matrix, {matrix.title}"
    return _Drawing(name, "matrix", title, matrix.caption, (svg,), (), 1)


def _clips(camera: CameraStudy, prefix: str) -> tuple[_Drawing, ...]:
    """First and last image around one target, side by side, for every series that has frames."""
    made = []
    for i, study in enumerate(camera.series):
        clip = study.series.clip
        if clip is None:
            continue
        images = tuple(
            {
                "uri": data_uri(clip_png(cut_clip(path, clip.centre, _CLIP_PX))),
                "label": f"{study.series.name}, epoch {epoch}",
            }
            for path, epoch in ((clip.first, clip.first_epoch), (clip.last, clip.last_epoch))
        )
        made.append(
            _Drawing(
                f"{prefix}-clips-{i}",
                "clips",
                f"Image around target {clip.target}",
                f"The same {_CLIP_PX} × {_CLIP_PX} px of the first and the last frame; the cross "
                "is where the target was in the first.",
                (),
                images,
                2,
            )
        )
    return tuple(made)


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
    return notes + list(camera.notes)


def _file_name(label: str) -> str:
    """A label with nothing in it that a file name cannot hold."""
    return "".join(c if c.isalnum() or c in "-_." else "-" for c in label).strip(".") or "camera"
