"""The report of a study: whole in one file, in words, and small; its figures and its JSON."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from thermocald.analysis.study.measured import Clip
from thermocald.analysis.study.study import StudySettings, study
from thermocald.output.study.report import cut_clip, render_study, save_figures
from thermocald.output.study.summary import study_document
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES


class Page(HTMLParser):
    """Addresses, ids, texts of a page."""

    def __init__(self, html):
        super().__init__()
        self.addresses, self.ids, self.captions, self.words = [], [], [], []
        self._inside = []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.addresses += [given[name] for name in ("src", "href") if given.get(name)]
        if "id" in given:
            self.ids.append(given["id"])
        if tag not in ("meta", "img", "br", "path", "use", "rect"):
            self._inside.append(tag)
        if tag == "figcaption":
            self.captions.append("")

    def handle_endtag(self, tag):
        if tag in self._inside:
            while self._inside.pop() != tag:
                pass

    def handle_data(self, data):
        if "figcaption" in self._inside:
            self.captions[-1] += data
        if "script" not in self._inside and "style" not in self._inside:
            self.words.append(data)


@pytest.fixture(scope="module")
def html(warm_study):
    return render_study(warm_study, "My camera")


def test_nothing_is_loaded_from_anywhere(html):
    outside = [a for a in Page(html).addresses if not a.startswith(("#", "data:"))]
    assert outside == []
    # Beside addresses: styles.
    assert not re.search(r"@import|url\((?!#)", html)


def test_ids_are_unique(html):
    ids = Page(html).ids
    assert sorted(ids) == sorted(set(ids))


def test_every_figure_has_a_caption_in_words(html):
    captions = Page(html).captions
    assert len(captions) >= 9
    assert all(len(caption.split()) > 12 for caption in captions)
    everything = " ".join(captions).replace("\xa0", " ")
    assert "The principal point has moved in M1 by up to 15.9 px" in everything
    assert "to the lower right" in everything


def test_a_study_of_nearly_nothing_says_why(empty_study):
    words = " ".join(Page(render_study(empty_study)).words)
    assert "The series has a single epoch: nothing can be said about change." in words
    assert "No Monte-Carlo" in words


def test_tables_hold_the_numbers_of_the_study(html, warm_study):
    words = " ".join(Page(html).words)
    mc = warm_study.cameras[0].montecarlo
    assert f"{100 * mc.fractions[0]:.1f} %" in words
    assert f"{mc.overall_mean / 10:.2f} cm" in words
    for name in ("success ratio", "n effective", "p naive", "sd over time"):
        assert name in words


def test_labels_are_text_and_no_markup(warm_up):
    series = warm_up()(name="<script>alert(1)</script>", label="a & <b>")
    page = render_study(study([series], StudySettings(sets=500)))
    assert "<script>alert" not in page
    assert "a &amp; &lt;b&gt;" in page


@pytest.mark.slow
def test_a_years_report_is_as_small_and_as_quick_to_open(warm_up, html, page_of, tmp_path):
    """3,155,760 epochs, one every 10 s: at most 3 MB, opened in the time of one of 150 epochs."""
    series = warm_up(epochs=3_155_760)(
        correlations=np.tile(np.eye(10), (100, 1, 1)), correlation_rows=np.arange(100)
    )
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
def test_figures_for_a_paper(warm_study, tmp_path):
    paths = save_figures(warm_study, tmp_path / "figures")
    names = {p.name for p in paths}
    for name in ("deviations", "significance", "temperature-dependence", "object-space-errors"):
        assert {f"{name}.svg", f"{name}.png"} <= names
    assert all(p.stat().st_size > 3000 for p in paths)


def test_json_has_no_nan_and_a_standard_deviation_beside_each_value(warm_study, empty_study):
    for one in (warm_study, empty_study):
        json.dumps(study_document(one), allow_nan=False)
    document = study_document(warm_study)
    assert document["format"] == "thermocald-study/1"
    camera = document["cameras"][0]
    deviation = camera["series"][0]["deviations"]["x0"]
    assert deviation["sd_change"] == pytest.approx(7e-6 * np.sqrt(2))
    dependence = camera["series"][0]["temperature_dependence"]["temperature"]["parameters"]["c"]
    assert {"slope", "sd_slope", "p", "p_naive", "p_holm"} <= set(dependence)
    assert set(camera["sd_over_time"]) == set(IOP_NAMES)
    assert sum(camera["object_space"]["fractions"]) == pytest.approx(1)


@pytest.mark.slow
def test_image_clips_stand_side_by_side(warm_up, tmp_path):
    import cv2

    frame = np.zeros((300, 400), np.uint8)
    frame[100:110, 200:210] = 200
    for name in ("first.png", "last.png"):
        cv2.imwrite(str(tmp_path / name), frame)
    clip = Clip("17", tmp_path / "first.png", tmp_path / "last.png", 0, 149, (204.5, 104.5))
    series = replace(warm_up()(), clip=clip)
    page = render_study(study([series], StudySettings(sets=500)))
    assert len(re.findall(r'src="data:image/png;base64,', page)) == 2
    assert "Image around target 17" in page


def test_a_clip_is_cut_about_the_target_and_black_beyond_the_edge(tmp_path):
    import cv2

    frame = np.full((30, 40), 50, np.uint8)
    frame[10, 5] = 250
    cv2.imwrite(str(tmp_path / "f.png"), frame)
    clip = cut_clip(tmp_path / "f.png", (5.0, 10.0), 15)
    assert clip[7, 7] == 250
    assert (clip[:, :2] == 0).all()
    assert (clip[:, 2] == 50).all()


def test_style_and_script_are_not_escaped(html):
    for part in re.findall(r"<style>.*?</style>|<script>.*?</script>", html, flags=re.DOTALL):
        assert "&#3" not in part
        assert "&gt;" not in part


def test_matrices_name_their_rows_and_columns(html):
    """Every label twice, as a row and as a column, in each of three matrices."""
    figures = re.findall(r'<figure id="[^"]*correlation[^"]*".*?</figure>', html, flags=re.DOTALL)
    assert len(figures) == 3
    for figure in figures:
        texts = re.findall(r"<text[^>]*>([^<]*)</text>", figure)
        assert texts.count("x₀") == texts.count("B2") == 2
