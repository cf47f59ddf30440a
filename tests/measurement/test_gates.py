"""The gates on simulated campaigns of the AVIS: silent on clean ones, and each fault named by its gate."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from gates_rig import (
    LSB,
    RATE,
    RIG,
    U_NAMES,
    Y_NAMES,
    Simulator,
    changed,
    everywhere,
    known,
    measured,
    multisine_campaign,
    noise_campaign,
    record,
    response_of,
)
from scipy import signal

from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader
from avis_ctrl.measurement.gates import GATES, Expectation, examine
from avis_ctrl.measurement.gates.channel_map import ChannelMap
from avis_ctrl.measurement.gates.examine import CONSEQUENCES, OF_ALL, after_missing_samples
from avis_ctrl.measurement.gates.excerpt import excerpt
from avis_ctrl.measurement.gates.finding import Finding
from avis_ctrl.measurement.gates.missing_samples import MissingSamples, delays, explained
from avis_ctrl.measurement.gates.repeatability import significance

SEVERE = ("warning", "stop")


@pytest.fixture(scope="module")
def clean():
    return multisine_campaign(1)


def alarms(campaign, expectation=None):
    return [f for f in examine(campaign, expectation or known()) if f.severity in SEVERE]


def gates(found):
    return {f.gate for f in found}


def test_every_gate_speaks_and_each_that_applies_has_a_picture(clean):
    findings = examine(clean, known())
    assert len({f.gate for f in findings}) == len(GATES) + 2  # of order and polarity, of repeatability and level
    assert [f.gate for f in findings if f.picture is None] == ["stepped sine"]
    for f in findings:
        assert f.sentence.endswith(".")
        assert f.picture is None or all(len(s.x) == len(s.y) > 0 for s in f.picture.series)


@pytest.mark.parametrize("make", [multisine_campaign, lambda seed: noise_campaign(seed, 16000)])
def test_clean_campaigns_pass(make):
    for seed in (2, 3):
        assert not alarms(make(seed))


@pytest.mark.slow
@pytest.mark.parametrize("make", [multisine_campaign, noise_campaign])
def test_twenty_clean_campaigns_pass(make):
    found = [(seed, f.sentence) for seed in range(20) for f in alarms(make(seed))]
    assert not found


def test_without_a_model_clean_campaigns_pass(clean):
    assert not [f for f in examine(clean) if f.severity in SEVERE]


def clipped(u, y):
    y[:, 1] = np.clip(y[:, 1], -1.2, 1.2)
    return u, y


def overdriven(u, y):
    y[:, 1] = np.clip(8 * y[:, 1], -10, 10 - LSB)
    return u, y


def constant(u, y):
    y[:, 2] = 0.3
    return u, y


def noise_alone(u, y):
    y[:, 2] = LSB * np.round(1e-3 * np.random.default_rng(5).standard_normal(len(y)) / LSB)
    return u, y


def stuck(u, y):
    y[5000:5300, 2] = y[5000, 2]
    return u, y


def humming(u, y):
    y[:, 4] += 0.01 * np.sin(2 * np.pi * 50.03 * np.arange(len(y)) / RATE)
    return u, y


def noisy(u, y):
    y[:, 0] += 0.05 * np.random.default_rng(6).standard_normal(len(y))
    return u, y


def doubled(u, y):
    y[:, 3] = 0.5 * y[:, 1]
    return u, y


FAULTS = [
    (overdriven, {}, "clipping", ("Sz1",), {"signal to noise"}),
    (clipped, {"y_range_V": None}, "clipping", ("Sz1",), set()),
    (constant, {}, "dead channel", ("Sx2",), {"signal to noise", "coherence", "channel order"}),
    (noise_alone, {}, "dead channel", ("Sx2",), {"signal to noise", "coherence", "channel order"}),
    (stuck, {}, "dead channel", ("Sx2",), set()),
    (humming, {}, "hum", ("Sy3",), {"periodicity"}),
    (noisy, {}, "signal to noise", ("Sy1",), {"channel order"}),
    (doubled, {"response": None}, "channel order", ("Sz1", "Sz2"), set()),
]


@pytest.mark.parametrize(
    ("fault", "expected", "gate", "channels", "others"),
    FAULTS,
    ids=[f"{f[0].__name__}-{k}" for k, f in enumerate(FAULTS)],
)
def test_a_fault_is_named_by_its_gate(clean, fault, expected, gate, channels, others):
    found = alarms(everywhere(clean, fault), known(**expected))
    assert gate in gates(found) and gates(found) <= {gate} | others
    assert {f.channels for f in found} == {channels}


def test_drive_at_its_limit():
    campaign = multisine_campaign(1, levels=(0.2,))
    limit = 0.9 * float(np.max(np.abs(campaign.records[0].u)))
    clip = everywhere(campaign, lambda u, y: (np.clip(u, -limit, limit), y))
    assert gates(alarms(clip, known(drive_limits_V=dict.fromkeys(U_NAMES, limit), response=None))) == {"clipping"}
    one = known(drive_limits_V={U_NAMES[0]: 10.0, U_NAMES[1]: limit}, response=None)
    assert {f.channels for f in alarms(clip, one)} == {(U_NAMES[1],)}


@pytest.mark.parametrize("count", [1, 3, 20])
@pytest.mark.parametrize("make", [multisine_campaign, lambda seed: noise_campaign(seed, 24000)])
def test_lost_samples_are_counted(make, count):
    """From y alone, at 11.003 s: found within 0.3 samples, and the place within a segment."""
    campaign = make(1)
    y = np.delete(campaign.records[0].y, np.arange(11003, 11003 + count), axis=0)
    found = [f for f in alarms(changed(campaign, 0, y=y), known(response=None)) if f.gate == "missing samples"]
    assert [f.records for f in found] == [("00",)]
    assert found[0].value == pytest.approx(-count, abs=0.3)
    assert "samples shorter" in found[0].sentence and f"about {count} samples were lost" in found[0].sentence


def test_rows_lost_from_u_and_y(clean):
    old, lost = clean.records[0], np.arange(11003, 11006)
    broken = changed(clean, 0, u=np.delete(old.u, lost, axis=0), y=np.delete(old.y, lost, axis=0))
    found = [f for f in alarms(broken) if f.gate == "missing samples"]
    assert "3 samples off" in found[0].sentence and "period 3" in found[0].sentence
    assert abs(found[0].value) == 3


def test_a_buffer_written_twice(clean):
    y = clean.records[0].y.copy()
    y[9000:9256] = y[8744:9000]
    found = [f for f in alarms(changed(clean, 0, y=y)) if f.gate == "missing samples"]
    assert "repeats 256 rows at 9 s" in found[0].sentence


def test_channels_are_not_called_exchanged_where_every_record_lacks_samples():
    lost = Finding("missing samples", "stop", "36 samples were lost", (), ("00", "01"))
    mixed, copied = (Finding("channel order", "stop", "said", ("Sy1", "Sz2"), of) for of in ((), ("00",)))
    judged = after_missing_samples([lost, mixed, copied], {"00", "01"})
    assert [f.severity for f in judged] == ["stop", "note", "stop"] and "consequence" in judged[1].sentence
    judged = after_missing_samples([lost, mixed, copied], {"00", "01", "02"})
    assert [f.severity for f in judged] == ["stop"] * 3


def test_gates_affected_by_missing_samples_exist(clean):
    assert {*CONSEQUENCES, *OF_ALL} < {f.gate for f in examine(clean, known())}


def test_records_that_overlap_in_time(clean):
    found = alarms(changed(clean, 1, start_s=clean.records[0].header.start_s + 1))
    assert gates(found) == {"missing samples"} and found[0].records == ("00", "01")


def stiffer(part):
    names = [n for n, p in RIG.parameters().items() if p.unit == "N/m"]
    return Simulator(RIG.with_parameters({n: RIG.parameters()[n].value * (1 + part) for n in names}))


@pytest.mark.parametrize("part", [0.005, 0.05])
def test_drift_between_records_of_one_multisine(part):
    """Stiffness half a percent up: seen; five percent: a warning."""
    found = examine(multisine_campaign(4, sims=(Simulator(), stiffer(part)), levels=(0.2, 0.2), same=True), known())
    (said,) = [f for f in found if f.gate == "repeatability"]
    assert said.severity == ("warning" if part == 0.05 else "note") and said.records == ("record 00", "record 01")
    assert "does not repeat" in said.sentence
    assert {f.gate for f in found if f.severity in SEVERE} <= {"repeatability"}


def test_dependence_on_the_level():
    soft = stiffer(-0.05)
    found = alarms(multisine_campaign(4, sims=(soft, soft, Simulator()), same=True))
    assert gates(found) == {"level dependence"}


def test_lines_beside_the_band_are_not_compared():
    """At 121 Hz, where 80 Hz end the band, one level's records hold a line that the drives did not put there."""

    def beside(u, y):
        return u, y + 0.02 * (np.abs(u).max() > 0.5) * np.sin(2 * np.pi * 121.0 * np.arange(len(y)) / RATE)[:, None]

    found = alarms(everywhere(noise_campaign(3, 16000, levels=(0.2, 0.05)), beside))
    assert "level dependence" not in gates(found)


@pytest.mark.parametrize(
    ("T", "said"), [(46358975614.2, "far more than noise explains"), (3.04, "3.0 times the 1 % limit of noise alone")]
)
def test_statistics_are_said_in_words_that_one_can_read(T, said):
    assert significance(T).startswith(said)


def test_records_of_different_voltages_say_how_little_their_comparison_tells():
    """Short segments leak: 5 % of stiffness stays hidden, and the sentence says how much could."""
    found = examine(multisine_campaign(4, sims=(Simulator(), stiffer(0.05)), levels=(0.2, 0.2)), known())
    (said,) = [f for f in found if f.gate == "repeatability"]
    assert said.severity == "note" and "would not be detected" in said.sentence


def test_the_transient_is_counted_in_periods(clean):
    (note,) = [f for f in examine(clean, known()) if f.gate == "periodicity"]
    assert note.severity == "note" and note.value in (1, 2, 3)


def test_a_response_that_grows_has_not_settled(clean):
    def growing(u, y):
        return u, y * np.linspace(1, 1.1, len(y))[:, None]

    assert "periodicity" in gates(alarms(everywhere(clean, growing), known(response=None)))


def channel_alarms(campaign, expectation):
    gate = ChannelMap(campaign, expectation)
    kept = [gate.look(excerpt(r)) for r in campaign.records]
    return [f for f in gate.conclude(kept) if f.severity in SEVERE]


def told_chance(finding):
    return float(re.search(r"p-value at most ([-\de.]+)\)", finding.sentence)[1])


SHORT = multisine_campaign(1, period=2048, periods=4)
PAIRS = [("y", pair) for pair in combinations(range(6), 2)] + [("u", pair) for pair in combinations(range(8), 2)]


@pytest.mark.parametrize(("which", "pair"), PAIRS)
def test_every_exchanged_pair_is_named(which, pair):
    i, k = pair

    def exchange(u, y):
        a = y if which == "y" else u
        a[:, [i, k]] = a[:, [k, i]]
        return u, y

    names = Y_NAMES if which == "y" else U_NAMES
    found = channel_alarms(everywhere(SHORT, exchange), known())
    assert [(f.gate, set(f.channels)) for f in found] == [("channel order", {names[i], names[k]})]
    assert "are exchanged" in found[0].sentence
    assert told_chance(found[0]) < 1e-5


@pytest.mark.parametrize(("which", "k"), [("y", k) for k in range(6)] + [("u", k) for k in range(8)])
def test_every_flipped_channel_is_named(which, k):
    def flip(u, y):
        (y if which == "y" else u)[:, k] *= -1
        return u, y

    found = channel_alarms(everywhere(SHORT, flip), known())
    assert told_chance(found[0]) < 1e-5
    assert [(f.gate, f.channels) for f in found] == [("polarity", ((Y_NAMES if which == "y" else U_NAMES)[k],))]


@pytest.mark.parametrize("flips", [1, 2])
def test_half_of_the_channels_flipped_could_be_the_other_half(rng, flips):
    """Two drives and two sensors by a random response of eight samples; a sensor is flipped, and a drive with it."""
    h, u = rng.standard_normal((8, 2, 2)), rng.standard_normal((16000, 2))
    y = sum(np.vstack([np.zeros((k, 2)), u[: len(u) - k]]) @ h[k].T for k in range(8))
    y += 0.01 * rng.standard_normal(y.shape)
    y[:, 0] *= -1
    u[:, 0] *= (-1) ** (flips - 1)
    header = RecordHeader("00", RATE, len(u), ("u1", "u2"), ("y1", "y2"), "noise", 1.0)
    expectation = Expectation(
        response=lambda omega, inputs: np.tensordot(np.exp(-1j * np.outer(omega, np.arange(8)) / RATE), h, 1)
    )
    found = channel_alarms(Campaign("", (Record(header, u, y),)), expectation)
    assert [f.gate for f in found] == ["polarity"] * flips
    assert all(("all other channels are reversed" in f.sentence) == (flips == 2) for f in found)


@pytest.mark.parametrize("late", [4, 8, 15])
def test_a_delay_is_no_channel_fault(late):
    """A loop that is later than the model's by some milliseconds, at noise: the channels are what they are called."""
    slow = everywhere(noise_campaign(5, 12000), lambda u, y: (u, np.vstack([np.zeros((late, 6)), y[:-late]])))
    assert not channel_alarms(slow, known())


def test_one_late_channel_is_named_but_does_not_stop():
    def delayed(u, y):
        y[:, 3] = np.concatenate([np.zeros(30), y[:-30, 3]])
        return u, y

    (said,) = channel_alarms(everywhere(SHORT, delayed), known())
    assert (said.severity, said.channels) == ("warning", ("Sz2",)) and "20 ms late" in said.sentence


def one_axis_after_the_other(levels=(0.2, 0.1), samples=6000):
    """Six patterns over the eight drives, one in each record, at two levels."""
    rng = np.random.default_rng(8)
    sos = signal.butter(4, [1, 60], "bandpass", fs=RATE, output="sos")
    patterns = rng.standard_normal((6, 8))
    records = []
    for k in range(6):
        one = signal.sosfilt(sos, rng.standard_normal(samples))
        u = levels[k % 2] * np.outer(one / one.std(), patterns[k] / np.abs(patterns[k]).max())
        records.append(record(f"{k:02d}", u, measured(rng, u), "noise", levels[k % 2], 10.0 * k))
    return Campaign("avis", tuple(records))


def test_one_axis_after_the_other_is_no_change_of_the_response():
    """The records excite different directions: nothing of them can be compared, and no number is made of that."""
    assert not gates(alarms(one_axis_after_the_other())) & {"repeatability", "level dependence", "missing samples"}


def test_drives_exchanged_under_logical_axes_are_named():
    def exchange(u, y):
        u[:, [0, 3]] = u[:, [3, 0]]
        return u, y

    found = channel_alarms(everywhere(one_axis_after_the_other(), exchange), known())
    assert [(f.gate, set(f.channels)) for f in found] == [("channel order", {"Ay1", "Az2"})]


def test_a_swept_sine_lacks_no_samples():
    """Its delay changes with the frequency, and so with time."""
    rng, t = np.random.default_rng(9), np.arange(8000) / RATE
    u = 0.1 * np.outer(np.sin(2 * np.pi * (1 * t + 59 / 16 * t**2)), np.eye(8)[1])
    whole = record("00", u, measured(rng, u), "noise", 0.07, 0.0)
    gate = MissingSamples(Campaign("avis", (whole,)), known())
    (said,) = gate.conclude([gate.look(excerpt(whole))])
    assert said.severity == "ok", said.sentence


def test_a_sweep_shows_no_step_of_the_delay():
    """Each line is driven once, before an instant or after it: of sound records one in a hundred was called faulty."""
    t = np.arange(30000) / RATE
    phase = 2 * np.pi * 0.5 * 27 / np.log(160) * (160 ** np.minimum(t / 27, 1) - 1)
    u = np.outer(np.sin(phase) * (t < 27), np.eye(8)[5])
    seen = excerpt(record("00", u, measured(np.random.default_rng(3), u), "noise", 0.7, 0.0))
    t, _ = delays(seen)
    assert {explained(seen, t, k, size) for k in (4, 9, 20) for size in (-30.0, 4.3)} == {-np.inf}
    noise = SHORT.records[0]
    seen = excerpt(noise)
    assert np.isfinite(explained(seen, delays(seen)[0], 4, 4.3))


def test_parameter_errors_are_no_channel_faults():
    """Stiffness wrong by 5 % and damping by 20 %, in any direction each."""
    rng, parameters = np.random.default_rng(3), RIG.parameters()
    for _ in range(10):
        wrong = {}
        for name, p in parameters.items():
            if p.unit in ("N/m", "N s/m"):
                wrong[name] = p.value * (1 + (0.05 if p.unit == "N/m" else 0.2) * rng.choice([-1, 1]))
        assert len(wrong) == 24
        assert not channel_alarms(SHORT, known(response=response_of(RIG.with_parameters(wrong))))


def test_sensors_that_a_motion_makes_read_alike_are_no_copies():
    """A table driven along one axis after the other: symmetric sensors agree in some records, a copy in all."""
    rng = np.random.default_rng(12)
    one, two = (
        signal.sosfilt(signal.butter(2, [2, 40], "bandpass", fs=RATE, output="sos"), rng.standard_normal(6000))
        for _ in range(2)
    )
    shapes = np.array([[1.0, 1.0, 0.3], [1.0, -1.0, 0.5]])

    def campaign(doubled: bool, records: int) -> Campaign:
        made = []
        for k in range(records):
            y = np.outer(one, shapes[k]) + 1e-5 * rng.standard_normal((6000, 3))
            y[:, 2] = 2 * y[:, 0] if doubled else y[:, 2]
            header = RecordHeader(f"{k:02d}", RATE, 6000, ("u1", "u2"), ("y1", "y2", "y3"), "noise", 1.0, 10.0 * k)
            made.append(Record(header, np.outer(two if k else one, np.eye(2)[k]), y))
        return Campaign("", tuple(made))

    def said(measured: Campaign, model=None) -> list[tuple[str, tuple[str, ...]]]:
        found = examine(measured, Expectation(response=model))
        return [(f.severity, f.channels) for f in found if "times" in f.sentence and len(f.channels) == 2]

    assert said(campaign(False, 2)) == []
    assert said(campaign(True, 2)) == [("stop", ("y1", "y3"))]
    assert said(campaign(False, 1)) == [("stop", ("y1", "y2")), ("stop", ("y1", "y3")), ("stop", ("y2", "y3"))]
    assert said(campaign(False, 1), lambda omega, inputs: np.tensordot(np.ones(len(omega)), shapes.T, 0)) == [
        ("note", ("y1", "y2")),
        ("note", ("y1", "y3")),
        ("note", ("y2", "y3")),
    ]


def test_measured_channels_that_repeat_exactly_are_commanded_voltages(clean):
    """u and y exchanged in a file that does not state the period."""
    records = []
    for source in clean.records:
        record = source.load()
        header = replace(record.header, u_names=record.header.y_names, y_names=record.header.u_names, period_s=None)
        records.append(replace(record, header=header, u=record.y, y=record.u))
    found = [f for f in examine(replace(clean, records=tuple(records))) if f.gate == "missing samples"]
    assert found[0].severity == "stop" and "u and y are exchanged" in found[0].sentence
