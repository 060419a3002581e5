"""The epochs of a recording measured and adjusted one by one, on one process or several.

A calibrator takes from each epoch what the next starts from. Every 200 epochs it begins from
nothing, so that these blocks need nothing of one another and give the same bits on any process.
"""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING

from thermocald.parallel import in_order

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from thermocald.acquisition.calibrator import CalibratedEpoch, Calibrator
    from thermocald.epoch import Epoch


EPOCHS_OF_A_BLOCK = 200


def calibrated_epochs(
    calibrator: Calibrator, epochs: Iterable[Epoch], jobs: int = 1
) -> Iterator[CalibratedEpoch]:
    """The epochs as calibrated, in their order.

    calibrator: one that has not seen an epoch; jobs: processes. Never raises for data: an epoch
    without a result has a status and a reason.
    """
    if jobs <= 1:
        for number, epoch in enumerate(epochs):
            if number and number % EPOCHS_OF_A_BLOCK == 0:
                calibrator.reset()
            yield calibrator.calibrate(epoch)
        return
    for block in in_order(_calibrated, calibrator, _blocks(epochs), jobs):
        yield from block


def _blocks(epochs: Iterable[Epoch]) -> Iterator[list[Epoch]]:
    source = iter(epochs)
    while block := list(islice(source, EPOCHS_OF_A_BLOCK)):
        yield block


def _calibrated(calibrator: Calibrator, epochs: list[Epoch]) -> list[CalibratedEpoch]:
    """A block from nothing; the calibrator is that of a process."""
    calibrator.reset()
    return [calibrator.calibrate(epoch) for epoch in epochs]
