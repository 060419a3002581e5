"""The report in a real browser, at desk and phone width: no console error, no empty plot."""

import pytest

from thermocald.output.study.report import render_report

_WIDTHS = {"desk": (1280, 900), "phone": (390, 844)}
# A drawing is empty when it holds no stroke that is longer than an axis tick.
_EMPTY_DRAWINGS = """() => [...document.querySelectorAll('figure .panel svg')].filter(svg => {
  const marks = [...svg.querySelectorAll('[id*="line2d"] path, [id*="FillBetween"] path, '
    + '[id*="QuadMesh"] path')].filter(p => p.getAttribute('clip-path'));
  const box = svg.getBoundingClientRect();
  return box.width < 150 || box.height < 100 || !marks.some(p => p.getBBox().width > 2
    || p.getBBox().height > 2);
}).map(svg => svg.getAttribute('aria-label'))"""
_EMPTY_PLOTS = """() => [...document.querySelectorAll('.js-plotly-plot')].filter(plot => {
  const marks = [...plot.querySelectorAll('.scatterlayer path')];
  return !marks.some(p => (p.getAttribute('d') || '').length > 10 && p.getBBox().width > 0);
}).length"""


@pytest.fixture
def open_page(page_of, tmp_path):
    """(html, desk or phone) → the page from a file, without a network."""

    def open_(html, width):
        file = tmp_path / "report.html"
        file.write_text(html, encoding="utf-8")
        return page_of(file.as_uri(), *_WIDTHS[width], offline=True)

    return open_


@pytest.mark.slow
@pytest.mark.parametrize("width", list(_WIDTHS))
def test_report_at(width, open_page, warm_study):
    page = open_page(render_report(warm_study), width)
    assert page.evaluate("document.documentElement.scrollWidth") <= _WIDTHS[width][0]
    assert page.locator("figure .panel svg").count() > 30
    assert page.evaluate(_EMPTY_DRAWINGS) == []

    buttons = page.locator("button.closer")
    for i in range(buttons.count()):
        buttons.nth(i).click()
    page.wait_for_function(
        "document.querySelectorAll('figure.panels .static[hidden]').length"
        " === document.querySelectorAll('button.closer').length"
        " && document.querySelectorAll('.js-plotly-plot').length >= 30"
    )
    page.wait_for_timeout(500)
    assert page.evaluate(_EMPTY_PLOTS) == 0
    assert page.evaluate("document.documentElement.scrollWidth") <= _WIDTHS[width][0]
    page.locator("button.copy").first.click()
    assert page.problems == []


@pytest.mark.slow
def test_an_empty_plot_and_a_console_error_would_be_seen(open_page, warm_study):
    """The test above can fail: drawings without curves, and a script that throws."""
    html = render_report(warm_study)
    cut = html.replace("clip-path", "data-cut").replace("</body>", "<script>lost()</script></body>")
    page = open_page(cut, "desk")
    assert len(page.evaluate(_EMPTY_DRAWINGS)) > 30
    assert page.problems


@pytest.mark.slow
def test_printing_shows_drawings_and_no_buttons(open_page, warm_study):
    page = open_page(render_report(warm_study), "desk")
    page.locator("button.closer").first.click()
    page.wait_for_selector(".js-plotly-plot")
    page.emulate_media(media="print")
    assert not page.locator("button").first.is_visible()
    assert not page.locator(".js-plotly-plot").first.is_visible()
    assert page.locator("figure .static").first.is_visible()
    assert len(page.pdf(format="A4")) > 50_000
