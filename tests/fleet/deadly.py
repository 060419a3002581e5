"""A block that kills the process that works on it, as a frame that crashes a decoder would."""

from __future__ import annotations

import os
import signal

from thermocald.fleet.reprocess import Block, Outcome, calibrate_block


def die(block: Block) -> Outcome:
    if block.first == 0 and "M2" in str(block.recording):
        os.kill(os.getpid(), signal.SIGKILL)
    return calibrate_block(block)
