"""The report of a study: complete in one small file, with text, figures and JSON."""

import re
from dataclasses import replace
from html import unescape

import cv2
import numpy as np
import pytest

from tests.pictures import ORIENTATION, save_photograph
from thermocald.analysis.study.measured import Clip
from thermocald.analysis.study.study import StudySettings, study
from thermocald.output.study.report import cut_clip, render_study, save_figures


@pytest.fixture(scope="module")
def told(warm_up, tmp_path_factory):
    """The first series has a clip; camera and second series have names with HTML in them."""
    folder = tmp_path_factory.mktemp("clip")
    frame = np.full((30, 40), 50, np.uint8)
    frame[10, 5] = 250
    for name in ("first.png", "last.png"):
        cv2.imwrite(str(folder / name), frame)
    clip = Clip("17", folder / "first.png", folder / "last.png", 0, 149, (5.0, 10.0))
    series = [
        replace(warm_up(seed=1)("M1", label="a & <b>"), clip=clip),
        warm_up(seed=2)("<script>alert(1)</script>", label="a & <b>"),
    ]
    return study(series, StudySettings(sets=5000))


@pytest.fixture(scope="module")
def html(told):
    return render_study(told, "My camera")


def words_of(page):
    """The text of a page without its scripts, styles and tags."""
    page = re.sub(r"<(script|style)\b.*?</\1>", "", page, flags=re.DOTALL)
    return unescape(re.sub(r"<[^>]*>", "", page)).replace("\xa0", " ")


def test_the_page_is_whole_and_holds_the_numbers_of_the_study(html, told):
    ids = re.findall(r'\sid="([^"]+)"', html)
    assert sorted(ids) == sorted(set(ids))
    assert not re.search(r"@import|url\((?!#)|(src|href)=\"(?!#|data:)", html)
    assert "<script>alert" not in html  # labels are text and no markup
    assert "a &amp; &lt;b&gt;" in html
    words = words_of(html)
    assert "The principal point has moved in M1 by up to 15.9 px" in words
    assert "to the lower right" in words
    mc = told.cameras[0].montecarlo
    assert f"{100 * mc.fractions[0]:.1f} %" in words
    assert f"{mc.overall_mean / 10:.2f} cm" in words
    for name in ("success ratio", "n effective", "p naive", "sd over time"):
        assert name in words
    # every label twice, as a row and as a column, in each of three matrices
    figures = re.findall(r'<figure id="[^"]*correlation[^"]*".*?</figure>', html, flags=re.DOTALL)
    assert len(figures) == 3
    for figure in figures:
        texts = re.findall(r"<text[^>]*>([^<]*)</text>", figure)
        assert texts.count("x₀") == texts.count("B2") == 2


def test_a_study_of_nearly_nothing_says_why(empty_study):
    words = words_of(render_study(empty_study))
    assert "The series has a single epoch: nothing can be said about change." in words
    assert "No Monte-Carlo" in words
    assert "Record more epochs, over a wider range of temperatures." in words


def test_three_epochs_are_correlated_by_chance_which_is_not_told(warm_up):
    words = words_of(render_study(study([warm_up(epochs=3)("M1")], StudySettings(sets=500))))
    assert "in M1 by up to" in words
    assert "Correlation matrix, M1" not in words
    assert "change together" not in words
    assert "Record more epochs, over a wider range of temperatures." in words


def test_image_clips_stand_side_by_side_and_are_black_beyond_the_edge(html, told, tmp_path):
    clip = told.cameras[0].series[0].series.clip
    cut = cut_clip(clip.first, clip.centre, 15)
    assert cut[7, 7] == 250
    assert (cut[:, :2] == 0).all()
    assert (cut[:, 2] == 50).all()
    assert len(re.findall(r'src="data:image/png;base64,', html)) == 2
    assert "Image around target 17" in html
    # the orientation for display in EXIF does not rotate the target's position
    turned = np.zeros((30, 40), np.uint8)
    turned[10, 5] = 250
    save_photograph(tmp_path / "turned.jpg", {ORIENTATION: 6}, turned, quality=100)
    assert cut_clip(tmp_path / "turned.jpg", clip.centre, 15)[7, 7] > 200


@pytest.mark.slow
def test_a_years_report_is_as_small_and_as_quick_to_open(warm_up, html, page_of, tmp_path):
    """3,155,760 epochs, one every 10 s: at most 3 MB, opened in the time of one of 150 epochs."""
    series = warm_up(epochs=3_155_760)(correlations=np.tile(np.eye(10), (100, 1, 1)))
    year = render_study(study([series], StudySettings(sets=500)))
    assert len(year) < 3e6
    assert len(year) < 1.5 * len(html)
    files = []
    for name, text in (("year", year), ("short", html)):
        files.append(tmp_path / f"{name}.html")
        files[-1].write_text(text, encoding="utf-8")
    opened = "() => performance.getEntriesByType('navigation')[0].loadEventEnd"
    times = np.array([[page_of(f.as_uri()).evaluate(opened) for f in files] for _ in range(3)]).min(
        axis=0
    )
    assert times[0] < 1.5 * times[1]


@pytest.mark.slow
def test_figures_for_a_paper(told, tmp_path):
    paths = save_figures(told, tmp_path / "figures")
    names = {p.name for p in paths}
    for name in ("deviations", "significance", "temperature-dependence", "object-space-errors"):
        assert {f"{name}.svg", f"{name}.png"} <= names
    assert all(p.stat().st_size > 3000 for p in paths)
