"""Tasks in several processes: their order, errors, and a process that dies."""

import os

import pytest

from thermocald.errors import DataError
from thermocald.parallel import in_order


def scaled(factor, item):
    if item == "bad":
        raise ValueError("this one is bad")
    if item == "dies":
        os._exit(3)
    return factor * item


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_order_and_an_error_comes_through(jobs):
    assert list(in_order(scaled, 3, range(12), jobs)) == [3 * k for k in range(12)]
    assert list(in_order(scaled, 3, [], jobs)) == []
    with pytest.raises(ValueError, match="this one is bad"):
        list(in_order(scaled, 3, [1, "bad", 2], jobs))


def test_items_are_taken_as_results_are_asked_for():
    """Items handed out are in memory, which a year of blocks must not be."""
    taken = []

    def items():
        for k in range(100):
            taken.append(k)
            yield k

    results = in_order(scaled, 1, items(), 2)
    assert next(results) == 0
    assert len(taken) <= 8
    results.close()


def test_a_process_that_dies_is_an_error_in_words():
    with pytest.raises(DataError, match="give fewer --jobs"):
        list(in_order(scaled, 1, [1, "dies", 2, 3], 2))
