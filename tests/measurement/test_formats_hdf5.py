"""HDF5 campaigns: round trips, files written by h5py alone, every damage in one line, records larger than memory."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from dataclasses import replace

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from refusals import refused

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader, digest, ranges
from avis_ctrl.measurement.formats import read_measurements, write_campaign, write_frequency_response
from avis_ctrl.measurement.frequency_response import FrequencyResponse

FINITE = st.floats(allow_nan=False, allow_infinity=False)
NAMES = st.lists(
    st.text("ABCxyz0123456789_ é", min_size=1).map(str.strip).filter(bool), min_size=1, max_size=3, unique=True
)


@st.composite
def campaigns(draw):
    u_names, y_names, rate = draw(NAMES), draw(NAMES), draw(st.sampled_from([1.0, 610.35, 2000.0, 1e5 / 3]))
    records = []
    for i in range(draw(st.integers(1, 3))):
        samples = draw(st.integers(3, 12))
        floor = draw(st.booleans())
        header = RecordHeader(
            f"{9 - i:02d}",
            rate,
            samples,
            tuple(u_names),
            tuple(y_names),
            draw(st.sampled_from(["noise", "rest", "multisine"])),
            draw(st.floats(0, 1e3)),
            draw(st.floats(-1e9, 1e9)),
            period_s=2 / rate,
            y_unit="m/s",
            floor_names=("vx", "vy", "vz") if floor else (),
        )
        records.append(
            Record(
                header,
                draw(arrays(float, (samples, len(u_names)), elements=FINITE)),
                draw(arrays(float, (samples, len(y_names)), elements=FINITE)),
                draw(arrays(float, (samples, 3), elements=FINITE)) if floor else None,
            )
        )
    return Campaign("rig ä", tuple(records))


@given(campaigns(), st.integers(1, 13))
@settings(max_examples=40, deadline=None)
def test_what_is_written_is_read(tmp_path_factory, campaign, longest):
    path = tmp_path_factory.mktemp("round") / "campaign.h5"
    write_campaign(path, campaign, longest)
    read = read_measurements(path)
    assert [r.header for r in read.records] == [r.header for r in campaign.records]
    for mine, theirs in zip(read.records, campaign.records, strict=True):
        loaded = mine.load()
        np.testing.assert_array_equal(loaded.u, theirs.u)
        np.testing.assert_array_equal(loaded.y, theirs.y)
        assert (loaded.floor is None) == (theirs.floor is None)
        if loaded.floor is not None:
            np.testing.assert_array_equal(loaded.floor, theirs.floor)
    assert digest(read) == digest(campaign)
    assert os.listdir(path.parent) == ["campaign.h5"]


@given(st.integers(2, 200), st.integers(2, 60))
def test_pieces_cover_every_sample(samples, longest):
    covered = np.zeros(samples, int)
    for start, stop in ranges(samples, longest):
        assert 2 <= stop - start <= longest + 1
        covered[start:stop] += 1
    assert np.all(covered == 1)


@given(st.integers(2, 40), st.integers(2, 12), st.sampled_from([None, 2, 3, 4]))
def test_pieces_put_together_are_the_record(samples, longest, period):
    header = RecordHeader("00", 10.0, samples, ("A",), ("S",), "noise", period_s=period and period / 10)
    whole = Record(header, np.arange(samples)[:, None], -np.arange(samples)[:, None])
    if period and period > longest:
        with pytest.raises(InputError, match="expected periods of at most"):
            list(whole.pieces(longest))
        return
    pieces = list(whole.pieces(longest))
    np.testing.assert_array_equal(np.vstack([piece.u for piece in pieces]), whole.u)
    np.testing.assert_array_equal(np.vstack([piece.y for piece in pieces]), whole.y)
    assert all(piece.header.samples % (period or longest) == 0 for piece in pieces[:-1])
    for piece in pieces:
        assert 2 <= piece.header.samples <= longest + 1
        assert piece.time[0] == pytest.approx(piece.u[0, 0] / 10)


def test_every_sample_enters_the_digest_once_however_long_the_pieces_are():
    header = RecordHeader("00", 10.0, 7, ("A",), ("S",), "noise")
    loaded = []

    class Watched(Record):
        def load(self, start=0, stop=None):
            loaded.append((start, stop))
            return super().load(start, stop)

    u, y = np.arange(7.0)[:, None], np.ones((7, 1))
    digest(Campaign("avis", (Watched(header, u, y),)), longest=3)
    assert loaded == [(0, 3), (3, 7)]
    changed = u.copy()
    changed[6] = 8.0
    one, other = (Campaign("avis", (Record(header, samples, y),)) for samples in (u, changed))
    assert digest(one, 3) != digest(other, 3)


def plain_file(path, **changes):
    """A campaign as the contract prints it, by h5py alone; changes edit it."""
    rng = np.random.default_rng(5)
    with h5py.File(path, "w") as file:
        file.attrs.update({"format": "avis-campaign", "version": 1, "rig": "avis"})
        for name in ("00", "01"):
            group = file.create_group(f"records/{name}")
            group.attrs.update({"sample_rate_Hz": 100.0, "excitation": "noise", "level_V": 0.5, "start_s": 0.0})
            for role, names, unit in (
                ("u", ["A1", "A2"], "V"),
                ("y", ["S1", "S2", "S3"], "V"),
                ("floor", ["vx", "vy", "vz"], "m/s"),
            ):
                group[role] = rng.normal(size=(40, len(names)))
                group[role].attrs.update({"names": names, "unit": unit})
        for change in changes.values():
            change(file)
    return path


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.h5"


def test_values_as_other_writers_store_them(path):
    def spellings(file):
        file.attrs["format"] = np.bytes_(b"avis-campaign")
        file.attrs["version"] = np.array([1], np.int8)
        file.attrs["rig"] = np.array(["avis"], dtype=h5py.string_dtype())
        record = file["records/00"]
        record.attrs["sample_rate_Hz"] = np.array([[100]], np.int32)
        record.attrs["excitation"] = np.bytes_(b"noise\0\0")
        record.attrs["level_V"] = np.array(0.5, np.float32)
        record["u"].attrs["names"] = np.array([b"A1", b"A2"])
        record["y"].attrs["names"] = "S1,S2,S3"
        record["y"].attrs["unit"] = np.array([b"V"])

    plain_file(path, edit=spellings)
    campaign = read_measurements(path)
    assert campaign.rig == "avis" and campaign.u_names == ("A1", "A2") and campaign.y_names == ("S1", "S2", "S3")
    assert campaign.records[0].header.sample_rate_Hz == 100.0


def test_one_dimensional_y_is_one_channel_and_units_become_si(path):
    y = np.arange(40, dtype=np.int16)

    def edit(file):
        del file["records/01"], file["records/00/y"]
        file["records/00/y"] = y
        file["records/00/y"].attrs.update({"names": "S1", "unit": "mm/s"})

    record = read_measurements(plain_file(path, edit=edit)).records[0]
    assert record.header.y_unit == "m/s" and record.header.y_names == ("S1",)
    np.testing.assert_allclose(record.load(5, 9).y, 1e-3 * y[5:9, None], rtol=1e-15)


def test_a_record_travels_to_another_process_and_loads_only_the_rows_asked_for(path):
    plain_file(path)
    with h5py.File(path) as file:
        expected = file["records/01/y"][7:11]
    record = pickle.loads(pickle.dumps(read_measurements(path).records[1]))
    piece = record.load(7, 11)
    np.testing.assert_array_equal(piece.y, expected)
    assert piece.header.start_s == 0.07 and piece.header.samples == 4


def test_records_keep_their_natural_order(path):
    def edit(file):
        for name in ("10", "2"):
            file.copy("records/00", f"records/{name}")

    names = [record.header.name for record in read_measurements(plain_file(path, edit=edit)).records]
    assert names == ["00", "01", "2", "10"]


def at(target, field, value):
    def edit(file):
        file[target].attrs[field] = value

    return edit


def without(target, field=None):
    def edit(file):
        if field is None:
            del file[target]
        else:
            del file[target].attrs[field]

    return edit


def data(role, value, names=None, unit="V"):
    def edit(file):
        names_ = file[f"records/00/{role}"].attrs["names"] if names is None else names
        del file[f"records/00/{role}"]
        if isinstance(value, list):
            file["records/00"].create_dataset(role, data=value, dtype=h5py.string_dtype())
        else:
            file[f"records/00/{role}"] = value
        file[f"records/00/{role}"].attrs.update({"names": names_, "unit": unit})

    return edit


REFUSED = {
    "no format": (without("/", "format"), "format: missing; expected 'avis-campaign'"),
    "other format": (at("/", "format", "other"), "format = 'other': expected 'avis-campaign'"),
    "later version": (at("/", "version", 2), "version = 2.0: expected 1, the version that this release reads"),
    "version as text": (at("/", "version", "one"), "version = 'one': expected one number"),
    "no records": (without("records"), "/records: missing; expected a group .*; the file holds nothing"),
    "no u": (without("records/00/u"), "record 00: u: missing; expected a data set .*; the record holds floor, y"),
    "no rate": (without("records/00", "sample_rate_Hz"), "record 00: sample_rate_Hz: missing; expected the samp"),
    "rate as text": (at("records/00", "sample_rate_Hz", "fast"), "record 00: sample_rate_Hz = 'fast': expected one"),
    "rate zero": (at("records/00", "sample_rate_Hz", 0.0), "expected a positive sample rate in Hz"),
    "rate infinite": (at("records/00", "sample_rate_Hz", np.inf), "expected a finite number"),
    "other rate": (at("records/01", "sample_rate_Hz", 50.0), "record 01: sample_rate_Hz = 50.0: expected 100.0"),
    "excitation": (at("records/00", "excitation", "hammer"), "record 00: excitation = 'hammer': expected one of"),
    "negative level": (at("records/00", "level_V", -1.0), "record 00: level_V = -1.0: expected 0 or more"),
    "no period": (at("records/00", "excitation", "multisine"), "record 00: period_s: missing; expected the per"),
    "odd period": (at("records/00", "period_s", 0.123), "expected a whole number of samples; at 100 Hz it is 12.3"),
    "array of numbers": (at("records/00", "start_s", [1.0, 2.0]), "record 00: start_s = .*: expected one number"),
    "no names": (without("records/00/y", "names"), "record 00: y: names: missing"),
    "few names": (at("records/00/y", "names", ["a", "b"]), "y names = .*; there are 3 channels and 2 names"),
    "twice a name": (at("records/00/y", "names", ["a", "a", "b"]), "expected different names"),
    "number as name": (at("records/00/y", "names", [1.0, 2.0, 3.0]), "y names = 1.0: expected a text"),
    "unit": (at("records/00/y", "unit", "furlong"), "record 00: y unit = 'furlong': expected a unit of V, m/s, m/s"),
    "unit of u": (at("records/00/u", "unit", "m"), "record 00: u unit = 'm': expected a unit of V"),
    "floor names": (at("records/00/floor", "names", ["x", "y", "z"]), "expected the three velocities vx, vy, vz"),
    "transposed": (data("y", np.zeros((3, 40))), "look transposed"),
    "lengths": (data("y", np.zeros((39, 3))), "expected equally many samples; u has 40, y has 39, floor has 40"),
    "three dimensions": (data("y", np.zeros((40, 3, 1))), r"y = \(40, 3, 1\): expected shape \(samples, channels\)"),
    "scalar": (data("y", np.float64(1.0)), r"expected shape \(samples, channels\)"),
    "text": (data("y", ["a", "b", "c"]), "expected real numbers"),
    "complex": (data("y", np.zeros((40, 3), complex)), "y = 'data set of complex numbers': expected real numbers"),
    "structures": (data("y", np.zeros(40, [("a", float)])), "expected real numbers"),
    "booleans": (data("y", np.zeros((40, 3), bool)), "expected real numbers"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_wrong_campaign_is_refused_in_one_line(path, case):
    change, message = REFUSED[case]
    plain_file(path, edit=change)
    refused(message, path)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_samples_that_are_no_numbers_are_named_by_place(path, value):
    def edit(file):
        file["records/01/y"][33, 2] = value

    record = read_measurements(plain_file(path, edit=edit)).records[1]
    record.load(0, 33)
    with pytest.raises(InputError, match=rf"a.h5: record 01: y = {value}: .* infinite: 1, .* sample 33 of .* S3"):
        record.load(20, 40)


def test_a_constant_channel_is_read(path):
    def edit(file):
        file["records/00/y"][:, 1] = 3.0

    assert np.ptp(read_measurements(plain_file(path, edit=edit)).records[0].load().y[:, 1]) == 0.0


@pytest.mark.parametrize("limits", [(0, 41), (-1, 5), (5, 5), (9, 3)])
def test_a_range_outside_the_record_is_refused(path, limits):
    with pytest.raises(InputError, match=r"expected 0 <= start < stop <= 40"):
        read_measurements(plain_file(path)).records[0].load(*limits)


def test_a_file_that_changed_after_it_was_opened(path):
    record = read_measurements(plain_file(path)).records[0]
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(InputError, match=r"a.h5: the HDF5 file is cut short"):
        record.load()
    path.unlink()
    with pytest.raises(InputError, match=r"a.h5: no such file"):
        record.load()


def campaign_of_one(name="00", **fields):
    header = replace(RecordHeader(name, 10.0, 4, ("A",), ("S",), "noise"), **fields)
    return Campaign("avis", (Record(header, np.zeros((4, 1)), np.ones((4, 1))),))


class Failing(Record):
    def load(self, start=0, stop=None):
        raise InputError("the disk is gone")


def test_a_failed_write_leaves_the_old_file_and_nothing_else(path):
    good = campaign_of_one()
    write_campaign(path, good)
    before = path.read_bytes()
    record = good.records[0]
    with pytest.raises(InputError, match="the disk is gone"):
        write_campaign(path, replace(good, records=(Failing(record.header, record.u, record.y),)))
    assert path.read_bytes() == before and os.listdir(path.parent) == ["a.h5"]


@pytest.mark.parametrize("name", ["", "a/b", "..", "a\0"])
def test_names_that_cannot_be_groups(path, name):
    with pytest.raises(InputError, match="expected a record's name without '/'"):
        write_campaign(path, campaign_of_one(name))


def test_places_that_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        write_campaign(tmp_path / "absent" / "a.h5", campaign_of_one())
    with pytest.raises(InputError, match="cannot be written"):
        write_campaign(tmp_path, campaign_of_one())


def test_two_records_of_one_name_cannot_be_written(path):
    with pytest.raises(InputError, match="expected different names of records"):
        write_campaign(path, replace(campaign_of_one(), records=campaign_of_one().records * 2))


# Frequency responses


def covariance_response(rng, n=5, n_y=3, n_u=2):
    def hermitian(m):
        factor = rng.normal(size=(n, m, m)) + 1j * rng.normal(size=(n, m, m))
        return factor @ factor.conj().transpose(0, 2, 1)

    value = rng.normal(size=(n, n_y, n_u)) + 1j * rng.normal(size=(n, n_y, n_u))
    return FrequencyResponse(
        np.sort(rng.uniform(1, 9, n)),
        value,
        hermitian(n_y),
        hermitian(n_u),
        ("A1", "A2"),
        ("S1", "S2", "S3"),
        "V",
        "m/s",
        12.0,
        hermitian(n_y),
        hermitian(n_y),
        method="local polynomial",
    )


def same(one, two):
    for field in FrequencyResponse.__dataclass_fields__:
        a, b = getattr(one, field), getattr(two, field)
        assert (a is None) == (b is None), field
        if a is not None:
            assert np.array_equal(a, b), field


def test_frequency_responses_are_read_as_written(path, rng):
    response = covariance_response(rng)
    write_frequency_response(path, response, "avis")
    same(read_measurements(path), response)
    entries = replace(
        response,
        noise=None,
        gram=None,
        measurement_noise=None,
        distortion=None,
        dof=np.inf,
        entry_variance=rng.uniform(0, 1, response.value.shape),
    )
    write_frequency_response(path, entries)
    same(read_measurements(path), entries)


def response_file(path, rng, edit):
    with h5py.File(path, "w") as file:
        file.attrs.update({"format": "avis-campaign", "version": 1, "rig": "avis"})
        group = file.create_group("frf")
        group["frequency_Hz"] = np.arange(1.0, 6.0)
        group["value"] = rng.normal(size=(5, 2, 1)) + 0j
        group["coherence"] = rng.uniform(0.5, 1, (5, 2, 1))
        group.attrs.update(
            {"inputs": ["A1"], "outputs": ["S1", "S2"], "input_unit": "V", "output_unit": "mV", "averages": 20}
        )
        edit(file)
    return path


@pytest.mark.parametrize(("units", "factor"), [(("V", "mV"), 1e-3), (("mV", "V"), 1e3), (("mV", "mm/s"), 1.0)])
def test_a_response_with_coherence_gets_variances_in_si(path, rng, units, factor):
    response = read_measurements(
        response_file(path, rng, lambda file: file["frf"].attrs.update(input_unit=units[0], output_unit=units[1]))
    )
    with h5py.File(path) as file:
        c, value = file["frf/coherence"][()], file["frf/value"][()] * factor
    np.testing.assert_allclose(response.value, value)
    np.testing.assert_allclose(response.entry_variance, np.abs(value) ** 2 * (1 - c) / (c * 19), rtol=1e-12)


def test_coherence_tells_the_errors_of_averaged_responses(rng):
    """Monte Carlo: H1 of random inputs, E|error|^2 known from the draws themselves."""
    from avis_ctrl.measurement.formats.response import coherence_variance

    trials, averages, G = 20000, 12, 2.0 - 1.0j

    def complex_normal():
        return (rng.normal(size=(trials, averages)) + 1j * rng.normal(size=(trials, averages))) / np.sqrt(2)

    u = complex_normal()
    y = G * u + 1.5 * complex_normal()
    uu, yy, yu = ((np.abs(u) ** 2).sum(1), (np.abs(y) ** 2).sum(1), (y * u.conj()).sum(1))
    estimate = yu / uu
    stated = coherence_variance(estimate, np.abs(yu) ** 2 / (uu * yy), averages)
    true = np.mean(np.abs(estimate - G) ** 2)
    # Standard error of the ratio: below 1 % each for 20000 draws; the rule with n_d itself would be 8 % low.
    assert abs(np.mean(stated) / true - 1) < 0.04
    # Closed form: sigma^2 E[1 / sum|u|^2] = 1.5^2 / (n_d - 1).
    assert abs(true / (1.5**2 / (averages - 1)) - 1) < 0.03


def group_edit(action):
    return lambda file: action(file["frf"])


def put(name, value):
    def edit(group):
        del group[name]
        group[name] = value

    return group_edit(edit)


RESPONSES_REFUSED = {
    "no averages": (group_edit(lambda g: g.attrs.pop("averages")), "averages: missing; the errors follow"),
    "one average": (group_edit(lambda g: g.attrs.update(averages=1)), "averages = 1.0: expected 2 or more"),
    "no errors": (group_edit(lambda g: g.pop("coherence")), "pass relative_standard_deviation"),
    "coherence": (put("coherence", np.full((5, 2, 1), 1.5)), "coherence = 1.5: expected values from 0 to 1"),
    "coherence 0": (put("coherence", np.zeros((5, 2, 1))), "expected a line at which no entry is 0"),
    "shape": (put("value", np.zeros((5, 1, 2), complex)), r"value = \(5, 1, 2\): expected shape \(5, 2, 1\)"),
    "nan": (put("value", np.full((5, 2, 1), np.nan)), "NaN or infinite: 10, the first at line 0"),
    "text": (put("value", "abc"), "/frf: value = 'data set of objects': expected numbers"),
    "order": (put("frequency_Hz", [1.0, 2.0, 2.0, 3.0, 4.0]), "expected increasing frequencies"),
    "no inputs": (group_edit(lambda g: g.attrs.pop("inputs")), "/frf: inputs: missing"),
    "unit": (group_edit(lambda g: g.attrs.update(output_unit="K")), "/frf: output_unit = 'K': expected a unit of"),
}


@pytest.mark.parametrize("case", RESPONSES_REFUSED)
def test_a_wrong_response_is_refused_in_one_line(path, rng, case):
    edit, message = RESPONSES_REFUSED[case]
    response_file(path, rng, edit)
    refused(message, path)


def test_a_stated_deviation_stands_in_for_unknown_errors_and_lines_of_no_coherence_are_left_out(path, rng):
    response_file(path, rng, group_edit(lambda g: g.pop("coherence")))
    response = read_measurements(path, relative_standard_deviation=0.1)
    np.testing.assert_allclose(response.entry_variance, (0.1 * np.abs(response.value)) ** 2)
    assert "stated relative standard deviation 0.1" in response.method

    def one_zero(group):
        group["coherence"][2, 1, 0] = 0.0

    response = read_measurements(response_file(path, rng, group_edit(one_zero)))
    assert list(response.frequency_Hz) == [1.0, 2.0, 4.0, 5.0] and "1 lines of coherence 0" in response.method


READ_IN_PIECES = """
import resource, sys
from avis_ctrl.measurement.formats import read_measurements
record = read_measurements(sys.argv[1]).records[0]
step, samples, total = 1 << 21, record.header.samples, 0
for start in range(0, samples, step * int(sys.argv[2])):
    piece = record.load(start, min(start + step, samples))
    total += piece.header.samples
print(total, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def large_file(path):
    """10 GB of fill values: 8 + 6 channels of doubles that take no place on disk."""
    samples = 90_000_000
    with h5py.File(path, "w") as file:
        file.attrs.update({"format": "avis-campaign", "version": 1, "rig": "avis"})
        group = file.create_group("records/00")
        group.attrs.update({"sample_rate_Hz": 2000.0, "excitation": "noise", "level_V": 0.5, "start_s": 0.0})
        for role, count in (("u", 8), ("y", 6)):
            group.create_dataset(role, (samples, count), float, chunks=(1 << 14, count), fillvalue=0.25)
            group[role].attrs.update({"names": [f"{role}{i}" for i in range(count)], "unit": "V"})
    assert samples * 14 * 8 > 10e9 and path.stat().st_size < 1e5
    return samples


@pytest.mark.slow
@pytest.mark.parametrize("skip", [6, 1])
def test_ten_gigabytes_are_read_in_pieces_with_less_than_two(path, skip):
    samples = large_file(path)
    done = subprocess.run(
        [sys.executable, "-c", READ_IN_PIECES, str(path), str(skip)],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
    )
    total, peak_kB = map(int, done.stdout.split())
    assert total == samples if skip == 1 else total > samples / 10
    assert peak_kB < 2e6, f"{peak_kB} kB"
    print(f"peak {peak_kB / 1e6:.2f} GB")
