"""Damaged files of every format: a result that can be trusted, or one line that names the file; never another error."""

from __future__ import annotations

import struct

import h5py
import numpy as np
import pytest
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from refusals import refused
from test_formats_matlab import Matlab73
from test_formats_uff import data_set

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader
from avis_ctrl.measurement.formats import (
    FORMATS,
    common,
    parse_columns,
    read_measurements,
    write_campaign,
    write_frequency_response,
)
from avis_ctrl.measurement.frequency_response import FrequencyResponse

CSV = "# excitation = noise\r\nt [s];A1 [V];S1 [mV]\r\n" + "".join(
    f"{i / 8:g};{i % 3},5;-1,{i}\r\n".replace(".", ",") for i in range(12)
)


def time_function(name, values, binary):
    """A data set 58 or 58b of a real, single precision, even time response."""
    order = "<" if binary else None
    return data_set(values, name=name, step=0.125, ordinate=(1, "V"), order=order, double=False)


class Files(dict):
    """Bytes by format, that a failing test does not print."""

    def __repr__(self):
        return f"Files({', '.join(self)})"


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """One valid file of each format, as bytes."""
    rng, folder = np.random.default_rng(3), tmp_path_factory.mktemp("valid")
    u, y = rng.normal(size=(60, 2)), rng.normal(size=(60, 3))
    header = RecordHeader("00", 100.0, 60, ("A1", "A2"), ("S1", "S2", "S3"), "noise", 1.0)
    write_campaign(folder / "h5", Campaign("avis", (Record(header, u, y),)))
    write_frequency_response(
        folder / "frf",
        FrequencyResponse(
            np.arange(1.0, 9.0),
            rng.normal(size=(8, 1, 1)) + 0j,
            None,
            None,
            ("A1",),
            ("S1",),
            entry_variance=np.ones((8, 1, 1)),
        ),
    )
    fields = {
        "sample_rate_Hz": 100.0,
        "excitation": "noise",
        "level_V": 1.0,
        "start_s": 0.0,
        "u": u,
        "y": y,
        "u_names": np.array(["A1", "A2"], object),
        "y_names": np.array(["S1", "S2", "S3"], object),
    }
    scipy.io.savemat(folder / "mat", {"records": [fields, fields], "rig": "avis"})
    scipy.io.savemat(folder / "zip", {"u": u, "y": y, "fs": 100.0}, do_compression=True)
    Matlab73(folder / "v73", {"records": [fields, fields], "rig": "avis"})
    (folder / "csv").write_bytes(CSV.encode())
    for name, binary in (("uff", False), ("58b", True)):
        (folder / name).write_bytes(time_function("A1", u[:, 0], binary) + time_function("S1", y[:, 0], binary))
    return Files({path.name: path.read_bytes() for path in folder.iterdir()})


FORMATS_FUZZED = ["h5", "frf", "mat", "zip", "v73", "csv", "uff", "58b"]


def read_whole(path, **hints):
    """Everything that the file gives, or the refusal; any other exception fails the test."""
    try:
        read = read_measurements(path, **hints)
        if isinstance(read, Campaign):
            for record in read.records:
                piece = record.load(0, min(record.header.samples, 1000))
                assert np.all(np.isfinite(piece.u)) and np.all(np.isfinite(piece.y))
        return read
    except InputError as error:
        text = str(error)
        assert text.startswith(str(path)) and "\n" not in text and len(text) < 900
        return text


@pytest.mark.parametrize("kind", FORMATS_FUZZED)
def test_the_valid_files_are_valid(valid, tmp_path, kind):
    path = tmp_path / "file"
    path.write_bytes(valid[kind])
    assert not isinstance(read_whole(path), str)


@pytest.mark.parametrize("kind", FORMATS_FUZZED)
@given(data=st.data())
@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
def test_cut_anywhere(valid, tmp_path_factory, kind, data):
    path = tmp_path_factory.getbasetemp() / f"cut_{kind}"
    content = valid[kind]
    path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    read_whole(path)


@pytest.mark.parametrize("kind", FORMATS_FUZZED)
@given(data=st.data())
@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
def test_bytes_changed_anywhere(valid, tmp_path_factory, kind, data):
    path = tmp_path_factory.getbasetemp() / f"flip_{kind}"
    content = bytearray(valid[kind])
    for _ in range(data.draw(st.integers(1, 4))):
        # Half of the changes in the first kilobytes, where structure lies.
        top = data.draw(st.sampled_from([min(len(content), 2000), len(content)]))
        content[data.draw(st.integers(0, top - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(content))
    read_whole(path)


@given(
    content=st.binary(max_size=300),
    head=st.sampled_from(
        [
            b"",
            b"MATLAB 5.0 MAT-file" + b" " * 105 + b"\x00\x01IM",
            b"MATLAB 7.3 MAT-file",
            b"\x89HDF\r\n\x1a\n",
            b"    -1\n    58\n",
            b"    -1\n    58b     1     2          11         100\n",
            b"t,u1,y1\n",
            b"\xff\xfe",
        ]
    ),
)
@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
def test_garbage_behind_a_good_beginning(tmp_path_factory, content, head):
    path = tmp_path_factory.getbasetemp() / "garbage"
    path.write_bytes(head + content)
    read_whole(path)


def test_what_is_no_measurement_at_all(tmp_path):
    path = tmp_path / "a.h5"
    assert refused(None, path) == f"{path}: no such file"
    assert refused(None, tmp_path) == f"{tmp_path}: expected CSV files (*.csv) in the directory; there is none"
    path.write_bytes(b"")
    assert refused(None, path) == f"{path}: the file is empty (0 bytes)"
    path.write_bytes(np.random.default_rng(1).bytes(5000))
    assert refused(None, path) == (
        f"{path}: expected HDF5, MATLAB .mat (v5 to v7.3), UFF 58 or CSV; the content is none of them"
    )
    path.write_text("just words\nand more\n")
    assert "line 1 = 'just words': not a measurement file: a text" in refused(None, path)
    assert "cannot be opened" in refused(None, tmp_path / ("long" * 100))
    assert "cannot be opened" in refused(None, tmp_path / "x\0y")


def test_the_content_tells_the_format_not_the_name(valid, tmp_path):
    for kind in FORMATS_FUZZED:
        for suffix in ("h5", "mat", "csv", "uff", "txt"):
            path = tmp_path / f"file.{suffix}"
            path.write_bytes(valid[kind])
            assert not isinstance(read_whole(path), str), (kind, suffix)


def test_messages_of_cut_files(valid, tmp_path):
    path = tmp_path / "a"
    parts = {
        "h5": (0.5, "the HDF5 file is cut short (Unable to"),
        "mat": (0.5, "variable at byte 128: it states 6704 bytes; 3312 are left"),
        "uff": (0.7, "data set 2 (byte "),
        "58b": (0.3, "of 240 bytes of data are there"),
        "csv": (0.95, "expected 3 columns, as in the header; there are 1"),
    }
    for kind, (share, message) in parts.items():
        path.write_bytes(valid[kind][: int(share * len(valid[kind]))])
        assert message in refused(None, path), kind


def test_hints_and_columns_that_nobody_knows(valid, tmp_path):
    path = tmp_path / "a"
    path.write_bytes(valid["csv"])
    for hint, said in (
        ({"speed": 3}, "hint = 'speed': expected one of sample_rate_Hz, excitation"),
        ({"sample_rate_Hz": "1 kHz"}, "sample_rate_Hz = '1 kHz': expected one number"),
        ({"excitation": "loud"}, "excitation = 'loud': expected one of"),
        ({"columns": {"x": "A1"}}, "columns = 'x': expected the roles t, u, y"),
    ):
        with pytest.raises(InputError, match=said):
            read_measurements(path, **hint)
    assert "columns: y = 'S9': not found; the file has t, A1, S1" in refused(None, path, columns={"y": "S9", "u": "A1"})
    path.write_bytes(valid["h5"])
    assert "period_s = 1.0: an HDF5 campaign states this itself" in refused(None, path, period_s=1.0)


def test_columns_from_a_command_line():
    assert parse_columns("u=A1+A2, y=S1,t=time") == {"u": ["A1", "A2"], "y": ["S1"], "t": ["time"]}
    for wrong in ("", "u", "u=", "u=A1,u=A2", "speed=A1", "u=A1++A2"):
        with pytest.raises(InputError, match="expected role=name, each role once"):
            parse_columns(wrong)
    assert all(word in FORMATS for word in ("HDF5", "MATLAB", "UFF", "CSV"))


def test_a_huge_size_in_a_small_file_costs_no_memory(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs.update({"format": "avis-campaign", "version": 1, "rig": "avis"})
        group = file.create_group("records/00")
        group.attrs.update({"sample_rate_Hz": 100.0, "excitation": "noise", "level_V": 0.5, "start_s": 0.0})
        for role in "uy":
            group.create_dataset(role, (1 << 50, 1), float, chunks=(1024, 1))
            group[role].attrs.update({"names": [role], "unit": "V"})
    record = read_measurements(tmp_path / "a.h5").records[0]
    assert record.load(1 << 49, (1 << 49) + 2).u.shape == (2, 1)
    with pytest.raises(InputError, match="do not fit in memory"):
        record.load()


def test_a_uff_that_states_a_huge_number_of_values(tmp_path):
    content = time_function("A1", [1.0] * 12, True)
    path = tmp_path / "a"
    path.write_bytes(content.replace(f"{2:10d}{12:10d}".encode(), f"{2:10d}{999999999:10d}".encode()))
    assert "expected 3999999996 bytes for 999999999 values" in refused(None, path)
    path.write_bytes(content.replace(struct.pack("<f", 1.0), struct.pack("<f", np.nan), 1))
    assert "NaN or infinite: 1, the first at sample 0 of channel A1" in refused(
        None, path, excitation="rest", columns={"y": "A1"}
    )


@pytest.mark.parametrize("kind", ["mat", "zip", "csv", "uff", "58b"])
def test_formats_that_are_read_whole_are_refused_beyond_memory_by_the_size_on_disk(valid, tmp_path, kind):
    path = tmp_path / "a"
    path.write_bytes(valid[kind] + b"\n" * 5000 if kind == "csv" else valid[kind])
    with path.open("r+b") as stream:
        stream.truncate(3_000_000_000)  # a hole: takes no place on disk
    assert refused(None, path) == (
        f"{path}: has 3 GB; this format is read whole, up to 1.5 GB: convert the file to an HDF5 "
        "campaign (/records/00/u and y), which is read in pieces"
    )


def test_what_is_large_only_when_it_is_unpacked_is_refused_too(tmp_path, monkeypatch):
    """Small on disk: variables of 3 GB in a v7.3 file that have to be joined, and compressed zeros in a v5 file."""
    path, samples = tmp_path / "a", 125_000_000
    with h5py.File(path, "w", userblock_size=512) as file:
        for name in "uyz":
            file.create_dataset(name, (1, samples), float, chunks=(1, 1 << 14))
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        file["fs"] = np.array([[100.0]])
        file["fs"].attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    assert path.stat().st_size < 1e6
    assert "has 3 GB; this format is read whole" in refused(None, path, columns={"u": "u", "y": ["y", "z"]})
    record = read_measurements(path, excitation="noise", level_V=1.0).records[0]  # one variable each stays on disk
    assert record.load(samples - 3).y.shape == (3, 1)
    monkeypatch.setattr(common, "SETTINGS", common.ReadingSettings(5000))
    scipy.io.savemat(path, {"u": np.zeros(400), "y": np.zeros(400), "fs": 1.0}, do_compression=True)
    assert path.stat().st_size < 1000 and "has 6.5e-06 GB; this format is read whole" in refused(None, path)
    scipy.io.savemat(path, {"u": np.zeros(200), "y": np.zeros(200), "fs": 1.0}, do_compression=True)
    assert not isinstance(read_whole(path), str)


def test_csv_files_of_a_directory_count_together(valid, tmp_path):
    for name in "abc":
        (tmp_path / f"{name}.csv").write_bytes(valid["csv"])
        with (tmp_path / f"{name}.csv").open("r+b") as stream:
            stream.truncate(600_000_000)
    assert refused(None, tmp_path).startswith(f"{tmp_path}: has 1.8 GB; this format is read whole")
