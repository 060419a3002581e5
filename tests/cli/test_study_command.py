"""`thermocald study`: from recordings and stores to numbers, report, and figures."""

import re
from functools import partial

import pytest

import thermocald as tc
from tests.commands import document, finish, succeed

run = partial(succeed, "study")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Some minutes of a warm phone."""
    path = tmp_path_factory.mktemp("recordings") / "nexus"
    tc.simulate("nexus5-warm", seed=5, epochs=31, out=path)
    return path


@pytest.mark.slow
def test_labels_make_cameras_and_a_report_is_written(recording, tmp_path):
    other = tmp_path / "other"
    tc.simulate("nexus5-warm", seed=6, epochs=40, out=other)
    result = run(
        f"cold={recording}", f"warm={other}", "--sets", "500", "--report", tmp_path / "r.html"
    )
    assert "cold" in result.stdout
    assert "warm" in result.stdout
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert re.findall(r"<h2>(.*?)</h2>", page) == ["cold", "warm"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["other", "r.html"]


def test_a_store_gives_the_same_as_its_recording(recording, tmp_path):
    def study(source, *more):
        return document("study", source, "--sets", "500", *more)["cameras"][0]["series"][0]

    store, report = tmp_path / "camera.db", tmp_path / "new folder" / "r.html"
    finish("replay", recording, "--store", store, "--exterior", "per_epoch")
    direct = study(recording)
    one, other = direct["deviations"], study(store)["deviations"]
    for name in ("c", "x0", "y0"):
        # a store has image points to 1e-5 px
        assert other[name]["change"] == pytest.approx(one[name]["change"], rel=1e-3)
        assert other[name]["sd_change"] == pytest.approx(one[name]["sd_change"], rel=1e-2)
    # the preset has 3 µm over 8 K
    fit = direct["temperature_dependence"]["temperature"]["parameters"]["c"]
    assert abs(fit["slope"] - 0.003 / 8) < max(5 * fit["sd_slope"], 0.05 * 0.003 / 8)

    apart = study(store, "--exterior", "per_epoch")
    assert apart["exterior"] == "per_epoch"
    assert "are weakly separated" in " ".join(apart["notes"])
    assert apart["deviations"]["x0"]["sd_change"] > 5 * one["x0"]["sd_change"]
    free = study(store, "--free", "c,x0")
    assert "A3, B1, B2, C1, C2 were held fixed" in " ".join(free["notes"])  # `--free` was ignored
    held = run(recording, "--free", "none", "--sets", "2", "--report", report, COLUMNS="60").stdout
    assert held.count("held fixed") == held.count("was not examined") == 1
    assert str(report) in held  # in one piece
    page = report.read_text(encoding="utf-8")
    assert "Let the study estimate parameters" in page
    # σ₀ alone followed the temperature, and rounding errors were drawn
    assert "thermocald fit" not in page
    assert "Movement of the image" not in page


@pytest.mark.slow
def test_the_reference_table_is_reproduced():
    """Bounds of the issue: shares 3 points, means 0.1 cm, maxima 15 %, |r| 0.98.

    Only the F-test of c is outside: a camera that approaches its equilibrium as exp(-t/300 s)
    no longer changes its principal distance by more than its standard deviation at the end.
    """
    figures = document("study", "--reference")["reference"]
    assert len({f["camera"] for f in figures}) == 5
    missed = {(f["camera"], f["quantity"]) for f in figures if not f["reproduced"]}
    allowed = {f["camera"] for f in figures if "rpi" not in f["camera"]}
    assert missed <= {(camera, "F-test of c, success ratio") for camera in allowed} | {
        # 0.70: the warm phone's σ₀ rises too little against its own scatter.
        ("galaxy-s8-warm", "|r| of σ₀ with the temperature")
    }
