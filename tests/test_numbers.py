"""Numbers in texts are typeset as in a book, whichever code printed them."""

import pytest

from thermocald.numbers import typeset_powers, with_sd


@pytest.mark.parametrize(
    ("text", "set_"),
    [
        ("a_B1 = (-7.69 ± 0.33)e-7 mm-1/K, 2.0e-06", "a_B1 = (−7.69 ± 0.33)·10⁻⁷ mm⁻¹/K, 2.0·10⁻⁶"),
        ("A2 = (4.9 ± 0.3)e+12 mm-4", "A2 = (4.9 ± 0.3)·10¹² mm⁻⁴"),
        ("above 40.2 ± 0.3 degC; --unit degC", "above 40.2 ± 0.3 °C; --unit degC"),
        ("series mm-1-b of IMG_1e5.jpg at 10 mm", "series mm-1-b of IMG_1e5.jpg at 10 mm"),
        ("(see M1)e-7, 0x1e5, 1e5b", "(see M1)e-7, 0x1e5, 1e5b"),
    ],
)  # fmt: skip
def test_powers_are_raised_and_names_are_left(text, set_):
    assert typeset_powers(text) == set_
    assert with_sd(-7.49e-7, 0.47e-7, "mm-1/K") == "(−7.49 ± 0.47)·10⁻⁷ mm⁻¹/K"


def test_nothing_is_no_negative_nothing():
    assert with_sd(-1e-9, 1e-6) == "(0.0 ± 1.0)·10⁻⁶"
