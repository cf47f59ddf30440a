"""A part of a record, where it lies."""

from __future__ import annotations

from dataclasses import replace

from avis_ctrl.measurement.campaign import Record, RecordSource


class Portion(RecordSource):
    """Samples start .. stop of another record, still where they lie."""

    def __init__(self, whole: RecordSource, start: int, stop: int):
        h = whole.header
        self.whole, self.start, self.stop = whole, start, stop
        self.header = replace(h, samples=stop - start, start_s=h.start_s + start / h.sample_rate_Hz)

    def load(self, start: int = 0, stop: int | None = None) -> Record:
        stop = self.header.samples if stop is None else stop
        return self.whole.load(self.start + start, self.start + stop)
