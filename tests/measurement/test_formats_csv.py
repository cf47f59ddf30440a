"""CSV records: separators, decimal commas, encodings, time stamps, real data, and where a file is wrong."""

from __future__ import annotations

import codecs
import csv as standard_csv

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from refusals import refused

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.formats import csv, read_measurements
from avis_ctrl.measurement.formats.time_axis import sample_rate_from

FINITE = st.floats(allow_nan=False, allow_infinity=False)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.csv"


def test_columns_that_are_not_used_are_stated(path):
    path.write_text("t,A1,Sz1,SZ_2\n0,1,2,3\n0.001,2,3,4\n")
    campaign = read_measurements(path, excitation="noise", level_V=1.0)
    assert campaign.y_names == ("Sz1",)
    assert "record a: columns without a usual name are not used: SZ_2" in campaign.notes


@given(
    arrays(float, st.tuples(st.integers(2, 30), st.just(2)), elements=FINITE),
    st.sampled_from(",;\t"),
    st.booleans(),
    st.sampled_from(["\n", "\r\n", "\r"]),
    st.booleans(),
    st.sampled_from(["utf-8", "utf-8-sig", "utf-16"]),
    st.integers(1, 7),
)
@settings(max_examples=60, deadline=None)
def test_numbers_survive_every_spelling(tmp_path_factory, table, separator, comma, newline, final, encoding, chunk):
    path = tmp_path_factory.getbasetemp() / "spelling.csv"
    comma = comma and separator != ","
    lines = ["# sample_rate_Hz = 1000", separator.join(["A1 [V]", "Sz1 [m/s]"])]
    for row in table:
        text = separator.join(repr(float(number)) for number in row)
        lines.append(text.replace(".", ",") if comma else text)
    path.write_bytes((newline.join(lines) + newline * final).encode(encoding))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(csv, "SETTINGS", csv.CsvSettings(chunk))
        campaign = read_measurements(path, excitation="noise", level_V=1.0)
    record = campaign.records[0].load()
    np.testing.assert_array_equal(np.hstack([record.u, record.y]), table)
    assert (campaign.u_names, campaign.y_names, campaign.y_unit) == (("A1",), ("Sz1",), "m/s")
    assert record.header.sample_rate_Hz == 1000.0


def stamped(path, time, header="t,A1,S1"):
    path.write_text(header + "\n" + "".join(f"{t:.6f},{i % 5},{i % 3}\n" for i, t in enumerate(time)))
    return path


def test_time_stamps_give_the_rate_and_jitter_is_noted(path, rng):
    even = np.arange(500) / 610.35
    record = read_measurements(stamped(path, even + 3)).records[0]
    assert record.header.sample_rate_Hz == pytest.approx(610.35, rel=1e-6) and record.header.start_s == 3.0
    campaign = read_measurements(stamped(path, np.arange(500) / 100 + rng.uniform(0, 4e-4, 500)))
    assert campaign.records[0].header.sample_rate_Hz == pytest.approx(100, rel=1e-5)
    assert any("uneven by up to 0.0" in note for note in campaign.notes)


def shifted(at, by):
    time = np.arange(200) / 100
    time[at] += by
    return time


STAMPS = {
    "backwards": (
        np.concatenate([np.arange(100), np.arange(90, 190)]) / 100,
        r"not later than the one before: 1, the first at line 102 \(sample 100\): 0.9 s after 0.99 s",
    ),
    "still": (
        np.repeat(np.arange(100), 2) / 100,
        r"not later than the one before: 100, the first at line 3 \(sample 1\): ",
    ),
    "gap": (
        np.delete(np.arange(200), [50, 51, 120]) / 100,
        r"gaps: 2, the first before line 52 \(sample 50\): 0.03 s instead",
    ),
    "uneven": (
        shifted(30, 0.003),
        r"1 are more than 0.1 of a sample off, the worst at line 32 \(sample 30\) by 0.3 samples",
    ),
}


@pytest.mark.parametrize("case", STAMPS)
def test_wrong_time_stamps_are_counted_and_placed(path, case):
    time, message = STAMPS[case]
    with pytest.raises(InputError, match=message) as caught:
        read_measurements(stamped(path, time))
    assert str(caught.value).startswith(f"{path}: t: ")


@given(st.floats(1e-3, 1e6), st.floats(-1e3, 1e3), st.integers(2, 3000))
@settings(deadline=None)
def test_the_rate_of_even_stamps_is_recovered(rate, start, samples):
    found, first, _ = sample_rate_from(start + np.arange(samples) / rate)
    # Rounding of the stamps: eps |t| against the length of the record.
    length = (samples - 1) / rate
    assert abs(found / rate - 1) <= 1e-8 / (samples - 1) + 8 * np.finfo(float).eps * (abs(start) + length) / length
    assert first == start


def test_real_data_by_a_mapping(data):
    file = data / "seismometer_sm3" / "1_0Hz.csv"
    campaign = read_measurements(file, {"t": "Seconds", "u": "FuncGen", "y": ["Current", "SM-3 Z"]})
    record = campaign.records[0].load()
    assert record.header.sample_rate_Hz == pytest.approx(130.21, abs=5e-3) and record.header.samples == 6400
    with file.open(newline="") as stream:
        raw = list(standard_csv.DictReader(stream))
    np.testing.assert_array_equal(record.y[:, 0], [float(row["Current"]) for row in raw])
    np.testing.assert_array_equal(record.u[:, 0], [float(row["FuncGen"]) for row in raw])
    assert any("unit of y not stated" in note for note in campaign.notes)
    refused("expected at least one column; the file has Pt#, SM-3 Z, FuncGen", file)


def test_a_directory_is_a_campaign_and_comments_state_the_record(tmp_path):
    head = "# excitation = multisine\n# period_s = 1,0\n# level_V = 0,1\n# rig = avis\nt [ms];A1 [mV];S1;vx;vy;vz\n"
    for name in ("b", "a"):
        (tmp_path / f"{name}.csv").write_text(head + "".join(f"{100 * i};{i};2,5;0;0;{i}\n" for i in range(20)))
    campaign = read_measurements(tmp_path)
    header = campaign.records[0].header
    assert [r.header.name for r in campaign.records] == ["a", "b"] and campaign.rig == "avis"
    assert (header.sample_rate_Hz, header.excitation, header.period_s, header.level_V) == (10.0, "multisine", 1.0, 0.1)
    record = campaign.records[1].load()
    np.testing.assert_allclose(record.u[:, 0], 1e-3 * np.arange(20))
    assert record.floor.shape == (20, 3) and record.floor[7, 2] == 7.0
    (tmp_path / "c.csv").write_text(head + "".join(f"{200 * i};{i};2,5;0;0;0\n" for i in range(20)))
    refused(r"record c: sample_rate_Hz = 5.0: expected 10.0 as in record a", tmp_path)


def test_latin_1_units_and_closing_separators(path):
    path.write_bytes("t;A1 [V];S1 [m/s²];\n0;1;2;\n1;0;2;\n2;1;2;\n".encode("latin-1"))
    campaign = read_measurements(path)
    assert campaign.y_unit == "m/s^2" and np.ptp(campaign.records[0].load().y) == 0.0  # a constant channel is read


@pytest.mark.parametrize("mark", [";", "\t", ","])
def test_the_separator_line_of_excel(path, mark):
    path.write_text(
        f"sep={mark}\n" + "".join(mark.join(line) + "\n" for line in (["t", "a", "s"], *["012", "103", "214"]))
    )
    campaign = read_measurements(path, {"t": "t", "u": "a", "y": "s"})
    np.testing.assert_allclose(campaign.records[0].load().y[:, 0], [2.0, 3.0, 4.0])


@pytest.mark.parametrize("byte", [0x80, 0xFF])
def test_every_byte_that_is_no_utf_8_is_a_latin_1_letter(path, byte):
    path.write_bytes(b"t,A1,S" + bytes([byte]) + b"\n0,1,2\n1,0,2\n2,1,3\n")
    name = "S" + chr(byte)
    assert read_measurements(path, {"t": "t", "u": "A1", "y": name}).y_names == (name,)


GOOD = ["t,A1,S1"] + [f"{i / 4},{i % 2},{i}" for i in range(8)]


def edited(line, text):
    return "\n".join([*GOOD[:line], text, *GOOD[line + 1 :]])


WRONG = {
    "text in the middle": (edited(4, "0.75,abc,3"), r"line 5 \(sample 3\), column A1 = 'abc': expected a number"),
    "nothing": (edited(4, "0.75,,3"), r"line 5 \(sample 3\), column A1 = '': expected a number, found nothing"),
    "below an empty line": (edited(4, "\n0.75,abc,3"), r"line 6 \(sample 3\), column A1 = 'abc': expected a number"),
    "short line": (edited(3, "0.5,1"), r"line 4 = '0.5,1': expected 3 columns, as in the header; there are 2"),
    "long line": (edited(3, "0,5,1,3"), r"expected 3 columns, as in the header; there are 4"),
    "second header": (edited(5, GOOD[0]), r"line 6 \(sample 4\), column t = 't': expected a number"),
    "nan": (edited(4, "\n0.75,1,nan"), r"NaN or infinite: 1, the first at line 6 \(sample 3\) of channel S1"),
    "spaces": ("t A1 S1\n0 1 2\n1 1 2\n", r"line 1 = .*these are separated by spaces"),
    "units below": (edited(1, "s,V,V"), r"line 2 \(sample 0\), column t = 's': .* header, such as t \[s\]"),
    "no header": ("\n".join(GOOD[1:]), r"line 1 = '0.0,0,0': expected a header line .* found numbers"),
    "only a header": (GOOD[0], r"expected at least two lines of numbers; there are 0"),
    "only comments": ("# a = 1\n# b = 2", r"expected a header line"),
    "twice a name": (edited(0, "t,A1,A1"), r"line 1 = 'A1': expected column names that differ"),
    "no time": (edited(0, "x,A1,S1"), r"t: expected a column t \(time in s\) or a comment line"),
    "unit": (edited(0, "t,A1,S1 [bar]"), r"record a: y unit = 'bar': expected a unit of V"),
    "unit of time": (edited(0, "t [h],A1,S1"), r"unit of t = 'h': expected one of s, sec, ms"),
    "no input": (edited(0, "t,S2,S1"), r"record a: u: expected at least one input"),
    "comment": ("# period_s = long\n" + "\n".join(GOOD), r"comment: period_s = 'long': expected one number"),
    "period": ("# period_s = 0.3\n" + "\n".join(GOOD), r"expected at least two samples in a period; at 4 Hz it is 1.2"),
    "binary": ("\n".join(GOOD) + "\n\0\1\2", r"expected (3 columns|text|HDF5)"),
}


@pytest.mark.parametrize("case", WRONG)
@pytest.mark.parametrize("bom", [b"", codecs.BOM_UTF8])
def test_wrong_files_in_one_line(path, case, bom):
    text, message = WRONG[case]
    path.write_bytes(bom + text.encode())
    refused(message, path)


def test_hints_that_contradict_the_time_stamps(path):
    path.write_text("\n".join(GOOD))
    assert read_measurements(path, sample_rate_Hz=4.001).sample_rate_Hz == 4.001
    refused(r"sample_rate_Hz = 0: expected 4 Hz, the rate of the time stamps", path, sample_rate_Hz=0)
    refused(r"sample_rate_Hz = 5.0: expected 4 Hz, the rate of the time stamps", path, sample_rate_Hz=5.0)
