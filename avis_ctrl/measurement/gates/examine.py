"""All gates over a campaign, each record loaded once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates.channel_map import ChannelMap
from avis_ctrl.measurement.gates.clipping import Clipping
from avis_ctrl.measurement.gates.dead_channel import DeadChannel
from avis_ctrl.measurement.gates.excerpt import LONGEST, Gate, excerpt
from avis_ctrl.measurement.gates.finding import Expectation, Finding
from avis_ctrl.measurement.gates.hum import Hum
from avis_ctrl.measurement.gates.missing_samples import MissingSamples
from avis_ctrl.measurement.gates.periodicity import Periodicity
from avis_ctrl.measurement.gates.repeatability import LevelDependence, Repeatability
from avis_ctrl.measurement.gates.signal_quality import Coherence, SignalToNoise
from avis_ctrl.measurement.gates.stepped_sine import SteppedSine

GATES: tuple[type[Gate], ...] = (
    Clipping,
    DeadChannel,
    ChannelMap,
    SteppedSine,
    MissingSamples,
    Hum,
    SignalToNoise,
    Coherence,
    Periodicity,
    Repeatability,
    LevelDependence,
)


def examine(campaign: Campaign, expectation: Expectation | None = None, longest: int = LONGEST) -> tuple[Finding, ...]:
    """What the gates say of a campaign, at least one finding of each, with a picture.

    Of a record longer than `longest` samples four evenly spread pieces of that many samples together are looked at; the
    sentences of warnings and the notes then say so.

    Parameters
    ----------
    expectation : what is known of the rig; gates that need a model say that they had none.

    Raises
    ------
    InputError : records that cannot be read.
    """
    known = expectation or Expectation()
    gates = [gate() for gate in GATES]
    kept: list[list[Any]] = [[] for _ in gates]
    shortened = []
    for record in campaign.records:
        seen = excerpt(record, longest)
        if not seen.whole:
            shortened.append(seen.header.name)
        for gate, of in zip(gates, kept, strict=True):
            of.append(gate.look(seen, known))
    findings = [f for gate, of in zip(gates, kept, strict=True) for f in gate.conclude(of, campaign, known)]
    if shortened:
        said = (
            f" (Of record {', '.join(shortened[:4])}{' and others' if len(shortened) > 4 else ''} only pieces of"
            f" {longest} samples together were examined.)"
        )
        findings = [replace(f, sentence=f.sentence + said) for f in findings]
    return tuple(findings)
