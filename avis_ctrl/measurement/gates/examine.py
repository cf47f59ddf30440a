"""Run all gates on a campaign; each record is loaded once."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import replace
from typing import Any

from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates.channel_map import ORDER, POLARITY, ChannelMap
from avis_ctrl.measurement.gates.clipping import Clipping
from avis_ctrl.measurement.gates.dead_channel import DeadChannel
from avis_ctrl.measurement.gates.excerpt import SETTINGS as EXCERPT
from avis_ctrl.measurement.gates.excerpt import Gate, excerpt
from avis_ctrl.measurement.gates.finding import Expectation, Finding
from avis_ctrl.measurement.gates.hum import Hum
from avis_ctrl.measurement.gates.missing_samples import MissingSamples, is_step
from avis_ctrl.measurement.gates.periodicity import Periodicity
from avis_ctrl.measurement.gates.repeatability import LEVEL_DEPENDENCE, Comparison
from avis_ctrl.measurement.gates.sample_clock import SampleClock
from avis_ctrl.measurement.gates.signal_quality import Coherence, SignalToNoise
from avis_ctrl.measurement.gates.spikes import Spikes
from avis_ctrl.measurement.gates.stepped_sine import SteppedSine

GATES: tuple[type[Gate], ...] = (
    Clipping,
    Spikes,
    DeadChannel,
    ChannelMap,
    SteppedSine,
    MissingSamples,
    SampleClock,
    Hum,
    SignalToNoise,
    Coherence,
    Periodicity,
    Comparison,
)
# Gates that missing or doubled samples of any record affect.
CONSEQUENCES = (
    SampleClock.name,
    SignalToNoise.name,
    Coherence.name,
    Periodicity.name,
    Comparison.name,
    LEVEL_DEPENDENCE,
    Spikes.name,
)
# Gates that these affect only if every record has them.
OF_ALL = (ORDER, POLARITY)


def examine(
    campaign: Campaign, expectation: Expectation | None = None, longest: int = EXCERPT.longest
) -> tuple[Finding, ...]:
    """Findings of all gates on a campaign, at least one per gate, with pictures.

    Records longer than `longest` samples are examined in four evenly spaced pieces with this many samples in total; the
    sentences of all findings then state this.

    Parameters
    ----------
    expectation : what is known of the rig; gates that need a model report its absence.

    Raises
    ------
    InputError : records that cannot be read.
    """
    known = expectation or Expectation()
    gates = [gate(campaign, known) for gate in GATES]
    kept: list[list[Any]] = [[] for _ in gates]
    shortened = []
    for record in campaign.records:
        seen = excerpt(record, longest)
        if not seen.whole:
            shortened.append(seen.header.name)
        for gate, of in zip(gates, kept, strict=True):
            of.append(gate.look(seen))
    findings = [f for gate, of in zip(gates, kept, strict=True) for f in gate.conclude(of)]
    names = {record.header.name for record in campaign.records}
    findings = after_clipping(after_missing_samples(after_clocks(findings), names))
    if shortened:
        said = (
            f" (Of record {', '.join(shortened[:4])}{' and others' if len(shortened) > 4 else ''} only pieces with "
            f"{longest} samples in all were examined.)"
        )
        findings = [replace(f, sentence=f.sentence + said) for f in findings]
    return tuple(findings)


def after_clocks(findings: list[Finding]) -> list[Finding]:
    """Turn findings that follow from two clocks of different rates into notes that state this; lost samples, too: a
    steady drift of the delay resembles a step."""
    if not any(f.gate == SampleClock.name and f.severity == "stop" and not f.records for f in findings):
        return findings
    said = " This is likely a consequence of the different clocks of u and y."
    return [
        replace(f, severity="note", sentence=f.sentence + said)
        if f.severity in ("warning", "stop") and (f.gate in CONSEQUENCES or is_step(f)) and f.gate != SampleClock.name
        else f
        for f in findings
    ]


def after_missing_samples(findings: list[Finding], names: Set[str]) -> list[Finding]:
    """Turn findings that follow from missing samples into notes that state this; missing samples are themselves a stop.

    Only gates that compare samples with the commanded voltage or with each other are affected, for the records
    concerned or for all records. Channel order and polarity are judged over all records together; they are affected
    only if samples are missing in every record in `names`.
    """
    records = {r for f in findings if f.gate == MissingSamples.name and f.severity == "stop" for r in f.records}
    said = (
        f" This is likely a consequence of the missing or doubled samples of record {', '.join(sorted(records))}: "
        "check again without them."
    )

    def follows(f: Finding) -> bool:
        of = {name.removeprefix("record ") for name in f.records}
        if f.severity not in ("warning", "stop"):
            return False
        if f.gate in OF_ALL:
            return not of and records >= names
        return f.gate in CONSEQUENCES and (not of or bool(of & records))

    if not records:
        return findings
    return [replace(f, severity="note", sentence=f.sentence + said) if follows(f) else f for f in findings]


def after_clipping(findings: list[Finding]) -> list[Finding]:
    """Turn consequences of clipping into notes: spikes at the corners of flat tops, and noise if the unit is wrong."""
    stops = [f for f in findings if f.gate == Clipping.name and f.severity == "stop"]
    clipped = {(f.channels[0], record) for f in stops for record in f.records}
    scaled = {name for f in stops if f.limit for name in f.channels}
    spikes = " The channel is clipped in this record: these are probably the corners of its flat tops."
    noise = " This is likely a consequence of the wrong unit or scale."
    made = []
    for f in findings:
        grave, channels = f.severity in ("warning", "stop"), set(f.channels)
        if grave and f.gate == Spikes.name and {(n, r) for n in channels for r in f.records} <= clipped:
            f = replace(f, severity="note", sentence=f.sentence + spikes)
        elif grave and f.gate == SignalToNoise.name and channels and channels <= scaled:
            f = replace(f, severity="note", sentence=f.sentence + noise)
        made.append(f)
    return made
