"""The commands' output is unchanged, or updated on purpose (`make golden`)."""

from __future__ import annotations

import pytest

from tests.blind.tables import summary
from tests.golden.cases import CASES, EXCUSED, Case
from tests.golden.compare import Bounds, differences, shortened
from tests.golden.corpora import CORPORA, check
from tests.golden.workshop import DATA, EXPECTED, Workshop
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
    assert workshop.check(case.name)[0] == []


def test_every_command_has_a_case_or_is_excused():
    tested = {case.words[0] for case in CASES}

    assert set(COMMANDS) == tested | set(EXCUSED)
    assert not tested & set(EXCUSED)


def test_every_expected_file_has_a_case():
    stored = {path.stem for path in EXPECTED.iterdir()}

    assert stored <= {c.name for c in CASES} | {f"corpus-{name}" for name in CORPORA}
    assert sum(path.stat().st_size for path in EXPECTED.iterdir()) < 400_000


BEFORE = {"c": 3.04, "sd_c": 1e-4, "text": "c = 3.0400 mm in 12 epochs", "n": 12}
SMALL = {"rms_px": 1.6e-4, "significance_sigmas": 0.02}  # its sd is 0.008 px
LONG = shortened([-1e-6, *range(20)])


@pytest.mark.parametrize(
    ("before", "alike", "other"),
    [
        (BEFORE, {"c": 3.04 + 1e-11}, {"c": 3.04 + 1e-8}),
        (BEFORE, {"sd_c": 1.0005e-4}, {"sd_c": 1.002e-4}),
        (BEFORE, {"text": "c = 3.0401 mm in 12 epochs"}, {"text": "c = 3.0402 mm in 12 epochs"}),
        (BEFORE, {}, {"text": "c = 3.0400 mm in 13 epochs"}),
        (BEFORE, {}, {"n": 13}),
        (BEFORE, {}, {"new": 1}),
        (SMALL, {"rms_px": 1.60005e-4}, {"rms_px": 1.601e-4}),
        # a bound of the RMS of the list: 12
        (LONG, {"some": [-9.95e-7, *LONG["some"][1:]]}, {"some": [1e-7, *LONG["some"][1:]]}),
    ],
)
def test_a_changed_number_is_found(before, alike, other):
    bounds = Bounds(1e-9, 1e-6, 1e-3)
    assert list(differences(before, before | alike, bounds)) == []
    assert list(differences(before, before | other, bounds))
    assert list(differences(before | other, {}, bounds))


@pytest.mark.timeout(1800)
@pytest.mark.slow
def test_the_blind_corpus_is_unchanged_and_reaches_its_goals():
    different, outcomes = check("blind")
    assert different == []
    score = summary(outcomes)
    assert score["exact_or_listed"] >= 0.95
    assert min(score["within_3_sd"], score["gap_closed_90"]) >= 0.9


@pytest.mark.slow
def test_the_corpus_of_real_corners_is_unchanged_and_reaches_its_goals(shared):
    different, outcomes = check("real-corners")
    assert different == []
    assert missed("nine", [o for o in outcomes if o.case.effects]) == []
    assert missed("none", [o for o in outcomes if not o.case.effects]) == []
