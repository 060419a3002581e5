"""The commands' output is unchanged, or updated on purpose (`make golden`)."""

from __future__ import annotations

import pytest

from tests.blind.tables import summary
from tests.golden.cases import CASES, EXCUSED, Case
from tests.golden.compare import Bounds, differences, shortened
from tests.golden.corpora import CORPORA, check
from tests.golden.workshop import DATA, EXPECTED, Workshop, wrong
from tests.real_corners.score import missed
from thermocald.cli.commands import COMMANDS


@pytest.fixture(scope="module")
def workshop(tmp_path_factory):
    return Workshop(tmp_path_factory.mktemp("golden"))


SLOW = ("discover", "blind-time-offset", "blind-pair", "real-lag")
"""Discoveries of 5 to 20 s, like those of the corpora; `discover-lag` writes the same files."""


@pytest.mark.parametrize(
    "case",
    [pytest.param(c, id=c.name, marks=pytest.mark.slow if c.name in SLOW else ()) for c in CASES],
)
def test_golden(workshop, case: Case):
    if case.needs_data and not DATA.is_dir():
        pytest.skip("the reference data are absent")

    assert wrong(case, workshop.result(case.name)) == []


def test_every_command_has_a_case_or_is_excused():
    tested = {case.words[0] for case in CASES}

    assert set(COMMANDS) == tested | set(EXCUSED)
    assert not tested & set(EXCUSED)


def test_every_expected_file_has_a_case():
    stored = {path.stem for path in EXPECTED.iterdir()}

    assert stored <= {c.name for c in CASES} | {f"corpus-{name}" for name in CORPORA}
    assert sum(path.stat().st_size for path in EXPECTED.iterdir()) < 400_000


def test_a_changed_number_is_found():
    before = {"c": 3.04, "sd_c": 1e-4, "text": "c = 3.0400 mm in 12 epochs", "n": 12}
    bound = Bounds(1e-9, 1e-6, 1e-3)

    for change in (
        {"c": 3.04 + 1e-11},
        {"sd_c": 1.0005e-4},
        {"text": "c = 3.0401 mm in 12 epochs"},
    ):
        assert list(differences(before, before | change, bound)) == []
    for change in ({"c": 3.04 + 1e-8}, {"sd_c": 1.002e-4}, {"text": "c = 3.0402 mm in 12 epochs"},
                   {"text": "c = 3.0400 mm in 13 epochs"}, {"n": 13}):  # fmt: skip
        assert list(differences(before, before | change, bound))
    small = {"rms_px": 1.6e-4, "significance_sigmas": 0.02}  # its sd is 0.008 px
    assert list(differences(small, {**small, "rms_px": 1.60005e-4}, bound)) == []
    assert list(differences(small, {**small, "rms_px": 1.601e-4}, bound))
    some = shortened([-1e-6, *range(20)])
    moved = {**some, "some": [1e-9, *some["some"][1:]]}
    assert list(differences(some, moved, Bounds(1e-6, 0, 0))) == []
    assert list(differences(some, moved, Bounds(1e-8, 0, 0)))
    assert list(differences(before, {"c": 3.04}, bound)) == [": without sd_c, text, n"]


@pytest.mark.timeout(1800)
@pytest.mark.slow
def test_the_blind_corpus_is_unchanged_and_reaches_its_goals():
    different, outcomes = check("blind")

    assert different == []
    score = summary(outcomes)
    assert score["exact_or_listed"] >= 0.95
    assert score["within_3_sd"] >= 0.9
    assert score["gap_closed_90"] >= 0.9


@pytest.mark.slow
def test_the_corpus_of_real_corners_is_unchanged_and_reaches_its_goals():
    if not DATA.is_dir():
        pytest.skip("the reference data are absent")
    different, outcomes = check("real-corners")

    assert different == []
    for part, some in (("nine", [o for o in outcomes if o.case.effects]),
                       ("none", [o for o in outcomes if not o.case.effects])):  # fmt: skip
        assert missed(part, some) == []
