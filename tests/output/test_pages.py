"""Every report as a page, in a real browser: at 1280 and 390 px wide, and on A4.

That of a study also as text: complete in one small file.

With THERMOCALD_PAGES=FOLDER the pages are kept as pictures there.
"""

from __future__ import annotations

import os
import re
import sys
from dataclasses import replace
from functools import cache
from html import unescape
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.analysis.conftest import WarmUp
from tests.blind.bridge import series_input
from tests.blind.case import Case
from tests.blind.generator import generate
from tests.commands import call, invoke
from tests.conftest import watch
from tests.daemon.conftest import make_recording
from tests.marks import mostly_slow
from tests.pictures import from_five_places
from thermocald.analysis.camera.photographs import calibrate_observations
from thermocald.analysis.series.drift import with_drifts
from thermocald.analysis.series.recorded import series_epochs
from thermocald.analysis.study.measured import StudySettings
from thermocald.analysis.study.study import study
from thermocald.discovery.result import discover_series
from thermocald.errors import DriverMissing
from thermocald.figures import Curve, Figure, Panel, draw_panel
from thermocald.fleet.overview import _drawing, render_fleet
from thermocald.numbers import spanned, with_sd
from thermocald.output.calibration import _by_radius, render_calibration
from thermocald.output.discovery import report_html
from thermocald.output.study.figures import deviation_figure
from thermocald.output.study.report import render_study, save_figures
from thermocald.photogrammetry.camera.camera_model import CameraSpec, Sensor
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.physics.testfields import corner_field, demonstration_model
from thermocald.report import Answer, Chapter
from thermocald.store.recording.reader import open_recording
from thermocald.thermal.reduce import reduce_together

LONG = "Temp °C LGR SN 20493821 SEN SN 20493821 of the northern river bank, behind the gauge"
NAMES = (LONG, "相机外壳温度传感器", "درجة حرارة غلاف الكاميرا")
FEW = StudySettings(sets=500)
_MARKS = re.compile(
    r"\d\.?\d*\)?e[+-]?\d+\b|mm-\d|<bound|object at 0x|\b(?:nan|inf|None)\b|np\.float"
)
_TEXT = """() => { const all = document.body.cloneNode(true);
  all.querySelectorAll('script, style').forEach(e => e.remove()); return all.textContent; }"""
FAULTS = {
    "wider": """() => [...document.querySelectorAll('body *')]
  .filter(e => !e.closest('.scroll, svg, .panel'))
  .filter(e => e.getBoundingClientRect().right > innerWidth + 1)
  .map(e => e.outerHTML.slice(0, 120))""",
    # texts in one drawing that overlap by more than a tolerance
    "overlapping": """() => {
  const quad = text => {
    const b = text.getBBox(), m = text.getScreenCTM(), e = 0.12 * b.height;
    const [left, top, right, bottom] = [b.x + e, b.y + e, b.x + b.width - e, b.y + b.height - e];
    return [[left, top], [right, top], [right, bottom], [left, bottom]]
      .map(([x, y]) => new DOMPoint(x, y).matrixTransform(m));
  };
  const apart = (p, q) => [p, q].some(shape => shape.some((a, i) => {
    const b = shape[(i + 1) % 4], n = [b.y - a.y, a.x - b.x];
    const along = s => s.map(v => v.x * n[0] + v.y * n[1]);
    const u = along(p), v = along(q);
    return Math.max(...u) <= Math.min(...v) || Math.max(...v) <= Math.min(...u);
  }));
  const found = [];
  for (const svg of document.querySelectorAll('svg')) {
    const texts = [...svg.querySelectorAll('text')].filter(t => t.textContent.trim());
    const quads = texts.map(quad);
    quads.forEach((q, i) => quads.slice(0, i).forEach((p, j) => {
      if (!apart(p, q)) found.push([texts[j].textContent, texts[i].textContent,
        svg.getAttribute('aria-label')]);
    }));
  }
  return found;
}""",
    # texts that are cut off at the edge of their drawing
    "cut": """() => [...document.querySelectorAll('svg text')].filter(t => {
  const box = t.getBoundingClientRect(), all = t.closest('svg').getBoundingClientRect();
  return t.textContent.trim() && (box.left < all.left - 2 || box.right > all.right + 2
    || box.top < all.top - 2 || box.bottom > all.bottom + 2);
}).map(t => t.textContent)""",
    # axes whose ticks are numbers and whose label is missing or has no unit
    "no unit": """() => [...document.querySelectorAll('svg g[id*="matplotlib.axis_"]')]
.filter(axis => {
  const numbers = [...axis.querySelectorAll('g[id*="tick_"] text')]
    .map(t => t.textContent.trim()).filter(Boolean);
  if (!numbers.length || !numbers.every(t => /^[−\\d][\\d.,·⁰-⁹¹²³⁻]*$/.test(t))) return false;
  const label = [...axis.children].filter(g => /-text_\\d+$/.test(g.id))
    .map(g => g.textContent.trim()).join(' ');
  return !/ in \\S|\\((no unit|number|count|UTC)\\)/.test(label);
}).map(axis => axis.closest('svg').getAttribute('aria-label') + ': ' + axis.id)""",
    "no caption": """() => [...document.querySelectorAll('figure')].filter(f =>
  (f.querySelector('figcaption')?.textContent || '').split(/\\s+/).length < 10).length""",
    # a drawing is empty when it holds no stroke or face that is longer than an axis tick
    "empty": """() => [...document.querySelectorAll('figure .panel svg')].filter(svg => {
  const marks = [...svg.querySelectorAll('[id*="axes_"] path, [id*="axes_"] use')]
    .filter(p => (p.closest('[clip-path]') || p.closest('[id*="Quiver"]'))
      && !p.closest('[id*="matplotlib.axis"]'));
  return !marks.some(p => p.tagName === 'use' || p.getBBox().width > 2 || p.getBBox().height > 2);
}).map(svg => svg.getAttribute('aria-label'))""",
}
ON_A_DESK = {
    "a table is wider than the page": """() => [...document.querySelectorAll('.scroll')]
  .filter(e => e.scrollWidth > e.clientWidth + 1).map(e => e.getAttribute('aria-label'))""",
    "less than 12 px between the texts of two columns": """() =>
  [...document.querySelectorAll('table')].filter(t => {
  const texts = [...t.rows].map(r => [...r.cells].map(c => {
    const text = document.createRange();
    text.selectNodeContents(c);
    return text.getBoundingClientRect(); }));
  return texts[0].some((_, k) => k &&
    Math.min(...texts.filter(r => r[k].width).map(r => r[k].left))
    - Math.max(...texts.map(r => r[k - 1].right)) < 12);
}).map(t => t.closest('.scroll').getAttribute('aria-label'))""",
}
ON_A_PHONE = {
    "a drawing must be scrolled sideways": """() => [...document.querySelectorAll('.panel')]
  .filter(p => p.scrollWidth > p.clientWidth + 1
  || p.querySelector('svg')?.getBoundingClientRect().right > innerWidth)
  .map(p => p.closest('figure').id)""",
    "letters too small to read": """() =>
  [...document.querySelectorAll('.panel svg')].filter(svg => {
  const scale = svg.getBoundingClientRect().width / svg.viewBox.baseVal.width;
  return [...svg.querySelectorAll('text')]
    .some(t => scale * parseFloat(getComputedStyle(t).fontSize) < 6.5); })
  .map(svg => svg.getAttribute('aria-label'))""",
}


@cache
def warm_study():
    """The camera and its second series have names with HTML in them."""
    names = enumerate(("M1", "<script>M2"), start=1)
    series = [WarmUp(seed=k)(name, label="a & <b>") for k, name in names]
    return study(series, StudySettings(sets=5000))


def _study_of_names(_):
    series = []
    for k, name in enumerate(NAMES, start=1):
        one = WarmUp(seed=k)(name, label=LONG)
        (thermometer,) = one.thermometers
        more = tuple(replace(thermometer, name=n) for n in NAMES)
        series.append(replace(one, thermometers=more))
    return render_study(study(series, FEW), LONG)


def _discovered(effects, title, **more):
    series, _ = generate(Case(effects, 0.3, **more))
    return report_html(discover_series(reduce_together([series_input(s) for s in series])), title)


def _calibrated(title, names=("",), gross=0.0, factor=1.0, more=()):
    """Photographs from five places with a gross error, sds of a factor, and more photographs."""
    field = corner_field("plain", per_side=6, pitch_mm=100.0)
    model = demonstration_model(field)
    measured = [replace(o, sigmas=factor * o.sigmas) for o in from_five_places(field, model)]
    measured[1].points[3] += gross
    return _calibration([*measured, *more], names, field, model, title)


def _calibration(measured, names, field, model, title):
    photographs = [f"{names[k % len(names)]}{k}.jpg" for k in range(len(measured))]
    camera = CameraSpec("", model.sensor, model.interior.c)
    result = calibrate_observations(photographs, measured, {}, field, camera, AdjustmentSettings())
    return render_calibration(result, model.sensor, title)


def _fleet(_):
    """Twelve cameras, two unlike their type, one without a result, one with a twin."""
    rng, rates = np.random.default_rng(7), ("c", "x0", "y0")
    odd = [{"kind": "odd", "text": f"c follows {LONG} unlike the others"}]
    findings = {2: odd, 7: odd, 4: [{"kind": "twins", "text": "two stores"}]}
    cameras = [
        {
            "station": NAMES[k] if k < 3 else f"gauge{k}", "camera": f"cam{k}",
            "type": "rpi-v2.1", "lag_s": 60.0 * k, "on_the_way_s": 2.0, "waiting": None,
            "ok": None if k == 5 else 0.99, "temperature": 20.0 + k,
            "temperature_range": None if k == 5 else [5.0, 40.0],
            "rates": {n: {"value": rng.normal(1e-4, 2e-5), "sd": 5e-6} for n in rates},
            "findings": findings.get(k, []),
        } for k in range(12)
    ]  # fmt: skip
    of_type = {n: {"value": 1e-4, "sd": 1e-5, "sd_between": 2e-5} for n in rates}
    kind = {"type": "rpi-v2.1", "rates": of_type,
            "cameras": [f"{c['station']}/{c['camera']}" for c in cameras]}  # fmt: skip
    none = dict.fromkeys(("late", "sensor", "calibrate", "clock", "refused"), 0)
    summary = none | {"cameras": 12, "stations": 12, "sound": 9, "odd": 2, "twins": 1}
    return render_fleet(
        {
            "summary": summary,
            "cameras": cameras,
            "servers": ["postgresql://db"],
            "types": [kind],
            "absent": ["mill"],
        }
    )


def _epochs(folder):
    recording = open_recording(make_recording(folder / "small", 60))
    epochs = with_drifts(series_epochs(recording, AdjustmentSettings(), "auto"))
    return epochs.report(folder / "epochs.html").read_text(encoding="utf-8")


def _of_command(folder, *arguments):
    call(*arguments, "--report", folder / "page.html")
    return (folder / "page.html").read_text(encoding="utf-8")


def _certificate(folder):
    for k, name in enumerate(("M1", "M2")):
        call("simulate", "--preset", "rpi-v2.1-heating", "--seed", k, "--series", name,
             "--out", folder / name)  # fmt: skip
    return _of_command(folder, "fit", folder / "M1", folder / "M2", "-o", folder / "c.yaml")


REPORTS = {
    "field-check": lambda folder: _of_command(folder, "testfield", "check", "--paper", "A4"),
    "certificate": _certificate,
    "epochs": _epochs,
    "study": lambda _: render_study(warm_study(), "My camera"),
    "study-names": _study_of_names,
    "discovery": lambda _: _discovered(("thermal_lag", "decentering_drift"), NAMES[1], seed=1),
    "discovery-unexplained": lambda _: _discovered(("outside",), LONG, seed=24, with_m2=False),
    "calibration": lambda _: _calibrated(NAMES[2], NAMES, gross=20.0),
    "fleet": _fleet,
}
_QUICK = ("field-check", "study", "epochs", "calibration", "fleet")


@pytest.fixture(scope="module")
def page_text(tmp_path_factory):
    """Map a name to the report as HTML, made once."""
    return cache(lambda name: REPORTS[name](tmp_path_factory.mktemp(name)))


@pytest.fixture(scope="module")
def only_page(browser):
    """A page without a network for one report after the other; a new one costs half a second."""
    page = browser.new_page(offline=True)
    page.set_default_timeout(120_000)  # ms: busy machines
    yield page
    page.close()


@pytest.fixture
def open_page(only_page, page_text, tmp_path):
    """Open a report, or HTML, in place of the last one, with every section unfolded."""

    def open_(report: str, width: int = 1280):
        file = tmp_path / "report.html"
        html = page_text(report) if report in REPORTS else report
        assert len(html) < 3e6
        file.write_text(html, encoding="utf-8")
        only_page.set_viewport_size({"width": width, "height": 900})
        only_page.emulate_media(media="screen")
        watch(only_page, file.as_uri())
        only_page.goto(file.as_uri())
        only_page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
        return only_page

    return open_


def faults_of(page, more=()) -> dict:
    found = {name: page.evaluate(fault) for name, fault in {**FAULTS, **dict(more)}.items()}
    found |= {"marks": _MARKS.findall(page.evaluate(_TEXT)), "console": page.problems}
    return {name: fault for name, fault in found.items() if fault}


@pytest.mark.parametrize("name", mostly_slow(REPORTS, *_QUICK))
def test_a_report_as_a_page(name, open_page):
    for width, more in ((1280, ON_A_DESK), (390, ON_A_PHONE)):
        page = open_page(name, width)
        assert faults_of(page, more) == {}
        keep(page, f"{name}-{width}")
    # what a command prints may be wider
    assert not any(page.evaluate(ON_A_DESK["a table is wider than the page"]))
    page = open_page(name, 794)  # A4 at 96 px per inch
    page.emulate_media(media="print")
    assert page.locator("button:visible, nav:visible").count() == 0
    assert faults_of(page) == {}
    assert len(page.pdf(format="A4")) > 10_000
    keep(page, f"{name}-a4")


def test_every_fault_of_a_page_would_be_seen(open_page):
    """The test above fails for a page with each of the faults."""
    html = """<body><p>x is &lt;bound method A.b of &lt;a object at 0x7f>, nan or None</p>
      <div style="width:2000px">wide</div><figure><div class="panel"><svg aria-label="drawing"
      width="300" height="100"><g id="matplotlib.axis_1"><g id="xtick_1"><text x="9" y="20">1</text>
      </g></g><text x="90" y="20">one label</text><text x="100" y="22">another</text>
      <text x="280" y="60">cut by the edge</text></svg></div>
      </figure><script>lost()</script></body>"""
    assert set(faults_of(open_page(html))) == {*FAULTS, "marks", "console"}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "bars"), [("discovery", 2), ("discovery-unexplained", 0)])
def test_a_candidate_is_blue_only_where_it_is_named(name, bars, open_page):
    blue = """() => [...document.querySelectorAll('#candidates svg g[id*="patch_"] path')]
      .filter(p => getComputedStyle(p).fill === 'rgb(0, 114, 178)').length"""
    assert open_page(name).evaluate(blue) == bars


@pytest.mark.slow
def test_only_effects_that_move_the_image_have_a_pattern(undrawn):
    words = words_of(_discovered(("decentering_drift", "defocus"), "two", seed=1))
    assert "Effect found: defocus" in words
    assert "in the pattern of decentering_drift, root mean square" in words


def test_bands_hold_95_percent():
    """Of a fleet: a rate and its standard deviation of 1 and 0.2 µm/K; the type's 3 and 0.5 µm/K.

    Of residuals of 0.1 px: the mean of 100 in each ring.
    """
    one = {"station": "weir", "camera": "cam", "findings": [],
           "rates": {"c": {"value": 1e-3, "sd": 2e-4}}}  # fmt: skip
    kind = {"cameras": ["weir/cam"], "rates": {"c": {"value": 3e-3, "sd_between": 5e-4}}}
    (axis,) = _drawing("drawing", "c", kind, [one]).drawing.axes
    band = axis.patches[0].get_extents().transformed(axis.transData.inverted())
    assert band.intervalx == pytest.approx([3 - 1.96 * 0.5, 3 + 1.96 * 0.5])
    (bar,) = axis.collections[0].get_segments()
    assert bar[:, 0] == pytest.approx([1 - 1.96 * 0.2, 1 + 1.96 * 0.2])
    rng, sensor = np.random.default_rng(1), Sensor(1000, 1000, 0.001)
    figure = _by_radius(rng.uniform(0, 999, (1000, 2)), rng.normal(0, 0.1, (1000, 2)), sensor)
    assert figure.panels[0].curves[1].half == pytest.approx(np.full(10, 0.0196), rel=0.25)


def test_twelve_series_are_drawn_in_twelve_ways():
    """Those after the tenth had the colours of the first, in lines as in points.

    The bands hold 95 %.
    """
    (camera,) = warm_study().cameras
    sd_c = camera.series[0].series.sds[:, 0]
    figure = deviation_figure(replace(camera, series=12 * camera.series[:1]))
    assert all(len({(c.colour, c.dashed) for c in p.curves}) == 12 for p in figure.panels)
    assert figure.panels[0].curves[0].half == pytest.approx(1.96 * 1000 * sd_c)


def test_the_epochs_report_opens_with_the_drift(open_page):
    page = open_page("epochs", 794)
    sentence = page.text_content(".answer .sentence").replace("\xa0", " ")
    assert re.search(r"°C .*x₀ moves by −0\.4\d+ ± 0\.0\d+ µm/K; y₀ moves by −0\.\d+ ±", sentence)
    page.emulate_media(media="print")
    wide = "[...document.querySelectorAll('pre')].map(e => e.scrollWidth - e.clientWidth)"
    assert max(page.evaluate(wide)) <= 0  # what the command prints stays on the paper


def test_the_time_axis_of_a_single_epoch_is_a_minute(tmp_path):
    """It was four years, with a warning."""
    recording = open_recording(make_recording(tmp_path / "small", 1))
    axis = series_epochs(recording, AdjustmentSettings(), "auto").plot().axes[0]
    assert np.ptp(axis.get_xlim()) == pytest.approx(1 / 1440)  # days


@pytest.mark.parametrize("name", ["calibration", "field-check"])
def test_down_in_a_figure_is_down_in_the_image(name, open_page):
    """If a label states that y grows downwards, its ticks do."""
    axes = open_page(name).evaluate(
        """() => [...document.querySelectorAll('svg g[id*="matplotlib.axis_"]')]
      .filter(a => a.textContent.includes('y in px, down'))
      .map(a => [...a.querySelectorAll('g[id*="tick_"] text')].map(
        t => [Number(t.textContent.replace('−', '-')), t.getBoundingClientRect().top]))"""
    )
    assert axes
    for ticks in axes:
        places = [top for _, top in sorted(ticks)]
        assert places == sorted(places)


def test_strong_correlations_and_what_limits_a_printed_field_are_stated(page_text):
    table = page_text("calibration").partition("Correlations beyond ±0.5")[2]
    table = table.partition("</table>")[0]
    strong = [float(r) for r in re.findall(r">−?(0\.\d+)</td>", table)]
    assert 0.5 <= min(strong) < 0.95
    words = words_of(page_text("field-check"))
    assert "With the stated errors of the targets' coordinates one image gives" in words


def test_photographs_without_targets_are_one_line(undrawn):
    words = words_of(_calibrated("camera", factor=0.25, more=[Observations.none()] * 90))
    assert words.count("5.jpg, 6.jpg, 7.jpg and 87 more: ") == 1
    assert re.search(r"σ₀ \d\.\d+, redundancy \d+; above 1 if the image", words)


@pytest.mark.parametrize("name", ["calibration", "fleet"])
def test_a_name_from_right_to_left_is_isolated(name, page_text):
    """A camera of 3280 × 2464 px looked like one of 2464 × 3280, station/camera like the camera's
    station.
    """
    assert f"\u2068{NAMES[2]}\u2069" in page_text(name)


def keep(page, name: str) -> None:
    """Write an image of the whole page to the folder THERMOCALD_PAGES."""
    if folder := os.environ.get("THERMOCALD_PAGES"):
        Path(folder).mkdir(parents=True, exist_ok=True)
        # not by path=, for which Playwright begins a thread that outlives the test
        Path(folder, f"{name}.png").write_bytes(page.screenshot(full_page=True))


@pytest.mark.slow
def test_everything_can_be_read_without_its_script(page_text, page_of, tmp_path):
    file = tmp_path / "report.html"
    file.write_text(page_text("study"), encoding="utf-8")
    page = page_of(file.as_uri(), java_script_enabled=False)
    assert page.locator(".answer .sentence").is_visible()
    shut = page.locator("details:not([open]) > summary")
    while shut.count():
        shut.first.click()
    panels = page.locator("figure .panel").all()
    assert len(panels) > 30
    assert all(panel.is_visible() for panel in panels)
    assert page.locator("button:visible").count() == 0


def test_values_are_read_off_a_drawing_and_tables_copied(open_page):
    page = open_page("study")
    panel = page.locator("figure .panel:has(svg[data-scales])").first
    box = panel.locator("svg").bounding_box()
    page.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 0.5 * box["height"])
    assert len(panel.locator("output").text_content().split(", ")) == 2
    panel.locator("svg").click()
    assert panel.locator("svg").bounding_box()["width"] > 2 * box["width"]
    page.locator("button.copy").first.click()
    assert page.problems == []


def words_of(page):
    """The text of a page without its scripts, styles and tags, in which no mark of a fault is."""
    page = re.sub(r"<(script|style)\b.*?</\1>", "", page, flags=re.DOTALL)
    words = unescape(re.sub(r"<[^>]*>", "", page)).replace("\xa0", " ")
    assert _MARKS.findall(words) == []
    return words


def test_the_page_is_whole_and_holds_the_numbers_of_the_study(page_text):
    html = page_text("study")
    ids = re.findall(r'\sid="([^"]+)"', html)
    assert sorted(ids) == sorted(set(ids))
    assert not re.search(r"@import|url\((?!#)|(src|href)=\"(?!#|data:)", html)
    assert "<script>M2" not in html  # labels are text and no markup
    assert "a &amp; &lt;b&gt;" in html
    words = words_of(html)
    # the sd of the movement, not the root of those of x0 and y0 squared
    assert re.search(r"M1: in .* the principal point moved by 15\.\d+ ± 0\.0071 px", words)
    camera = warm_study().cameras[0]
    mc, moved = camera.montecarlo, camera.series[0].deviations["x0"]
    pitch = camera.series[0].series.sensor.pixel_pitch
    for said in (
        with_sd(moved.change / pitch, moved.sd_change / pitch),
        "to the lower right", f"{100 * mc.fractions[0]:.1f} %", f"{mc.overall_mean / 10:.2f} cm",
        "success ratio", "n effective", "p naive", "sd over time",
    ):  # fmt: skip
        assert said in words
    # every label twice, as a row and as a column, in each of three matrices
    figures = re.findall(r'<figure id="[^"]*correlation[^"]*".*?</figure>', html, flags=re.DOTALL)
    assert [(f.count(">x₀</text>"), f.count(">B2</text>")) for f in figures] == 3 * [(2, 2)]


RUNS = [f"Run of 2024-05-0{k} in the climate chamber, camera A" for k in (1, 2)]
MORE = [*(f"{RUNS[0]}{k}" for k in "12"), RUNS[1]]


@pytest.mark.parametrize("names", [[f"M{k}" for k in range(1, 8)], [LONG, "M"], RUNS, MORE])
def test_a_legend_stays_in_its_drawing(names):
    """The seventh series of a study was cut off; two with long names were one."""
    x = np.arange(3.0)
    drawing = draw_panel(Panel("c", "x in px", "y in px", tuple(Curve(n, x, x) for n in names)))
    drawing.draw_without_rendering()
    legend = drawing.axes[0].get_legend()
    assert legend.get_window_extent().x1 <= drawing.bbox.x1
    assert len({text.get_text() for text in legend.get_texts()}) == len(names)


def test_series_that_differ_only_in_their_numbers_share_a_sentence(undrawn):
    """Seven series were fourteen nearly equal sentences."""
    words = words_of(_study_of_names(None))
    assert words.count("All 3 series: between ") == words.count("All 3 series: in 25 minutes") == 1
    rates = [f"x₀ by {rate} px/K in {k} s" for k, rate in enumerate(("−0.35 ± 0.1", "+2", "−0.36"))]
    assert spanned(rates) == "x₀ by −0.36 to +2 px/K in 0–2 s"


def test_a_calibration_without_a_result_says_why(undrawn):
    field = corner_field("plain", per_side=2, pitch_mm=100.0)
    model = demonstration_model(field)
    words = words_of(_calibration([Observations.none()], ["a"], field, model, "camera"))
    assert "Not calibrated: " in words
    assert "a0.jpg" in words


@pytest.mark.parametrize(("missing", "named"), [("matplotlib", "matplotlib"), ("jinja2", "Jinja")])
def test_without_its_extra_a_report_names_it(monkeypatch, tmp_path, missing, named):
    """It was a traceback."""
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(DriverMissing, match=rf"needs {named}: pip install 'thermocald\[report\]'"):
        invoke("testfield", "check", "--report", tmp_path / "page.html")


@pytest.mark.parametrize(
    ("epochs", "drift", "said"),
    [
        (1, {}, "The series has a single epoch: nothing can be said about change."),
        (3, {"c": 0.007}, "M1: in 20 seconds the principal point"),
        (8, {}, "M1: in 1 minute the principal point"),
    ],
)
def test_few_epochs_allow_neither_correlations_nor_a_model(undrawn, epochs, drift, said):
    words = words_of(render_study(study([WarmUp(drift, epochs)("M1")], FEW)))
    assert said in words
    assert ("No Monte-Carlo" in words) is (epochs == 1)
    assert "Correlation matrix, M1" not in words
    assert "change together" not in words
    assert "Fit a thermal model" not in words
    assert "Record more epochs, over a wider range of temperatures." in words


@pytest.mark.slow
def test_a_years_report_is_as_small_and_as_quick_to_open(page_text, page_of, tmp_path):
    """3,155,760 epochs, one every 10 s: at most 3 MB, opened in the time of one of 150 epochs."""
    series = WarmUp(epochs=3_155_760)(correlations=np.tile(np.eye(10), (100, 1, 1)))
    year, short = render_study(study([series], FEW)), page_text("study")
    assert len(year) < min(3e6, 1.5 * len(short))
    files = [tmp_path / "year.html", tmp_path / "short.html"]
    for file, text in zip(files, (year, short), strict=True):
        file.write_text(text, encoding="utf-8")
    opened = "() => performance.getEntriesByType('navigation')[0].loadEventEnd"
    times = [[page_of(f.as_uri()).evaluate(opened) for f in files] for _ in range(3)]
    of_year, of_short = np.min(times, axis=0)
    assert of_year < 1.5 * of_short


def test_a_number_and_its_unit_share_a_line():
    sentence = "B2 changes by (−7.3 ± 0.4)·10⁻⁷ mm⁻¹/K in 20 minutes."
    page = Chapter("Camera", Answer(sentence), ()).page()
    assert "(−7.3\xa0±\xa00.4)·10⁻⁷\xa0mm⁻¹/K in 20\xa0minutes." in page


def test_figures_for_a_paper(tmp_path, monkeypatch):
    """Their PNG had no points: strokes of length zero are dropped there."""
    x = np.linspace(0.0, 1.0, 20)
    curves = (Curve("", x, x, "points"), Curve("", x[:1], x[:1], "points", "#ff0000"))
    one = Figure("path", "Path", "", (Panel("c", "x in px", "y in px", curves),))
    monkeypatch.setattr("thermocald.output.study.report.study_figures", lambda _: {"path": one})
    svg, png = save_figures(warm_study(), tmp_path / "figures")
    assert (svg.name, png.name) == ("path.svg", "path.png")
    seen = cv2.imread(str(png)).reshape(-1, 3).astype(int)
    for colour in ([178, 114, 0], [0, 0, 255]):  # blue, green, red
        assert (np.abs(seen - colour).max(axis=1) < 10).sum() > 10
