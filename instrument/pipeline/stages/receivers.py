"""The errors of receivers put into perfect blocks, where a stage compares with what a perfect instrument sees."""

from __future__ import annotations

from instrument.jones.chain import Chain
from instrument.model import Instrument
from instrument.pipeline.stage import StageRun
from instrument.visibilities import Visibilities

NAME = "receivers"


class Receivers(StageRun):
    """Gains and feed errors of an instrument on what was predicted without them."""

    def __init__(self, instrument: Instrument) -> None:
        self.chain = Chain(*instrument.receivers())

    def take(self, block: Visibilities) -> Visibilities:
        """What the receivers make of a block."""
        return block.corrupted(self.chain)
