"""MATLAB files: v5 by scipy.io, v7.3 as MATLAB lays it out (written here by h5py), real data, what is refused."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import scipy.io
from refusals import refused

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import digest
from avis_ctrl.measurement.formats import read_measurements, write_campaign
from avis_ctrl.measurement.formats.stored import StoredRecord

MISSING = object()


def cells(names):
    return np.array(names, object)


def fields(rng, **changes):
    record = {
        "sample_rate_Hz": 100.0,
        "excitation": "multisine",
        "level_V": 1.0,
        "start_s": 0.0,
        "period_s": 0.2,
        "u": rng.normal(size=(60, 2)),
        "y": rng.normal(size=(60, 3)),
        "floor": rng.normal(size=(60, 3)),
        "u_names": cells(["A1", "A2"]),
        "y_names": cells(["S1", "S2", "S3"]),
        "u_unit": "V",
        "y_unit": "m/s",
    }
    return {key: value for key, value in (record | changes).items() if value is not MISSING}


class Matlab73:
    """A v7.3 file as MATLAB writes it: dimensions reversed, char as codes, cells and struct arrays by reference."""

    def __init__(self, path, tree):
        with h5py.File(path, "w", userblock_size=512) as self.file:
            self.refs, self.count = self.file.create_group("#refs#"), 0
            for name, value in tree.items():
                self.put(self.file, name, value)
        with path.open("r+b") as stream:
            stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")

    def put(self, group, name, value):
        if isinstance(value, dict):
            item = group.create_group(name)
            item.attrs["MATLAB_class"] = np.bytes_("struct")
            for key, part in value.items():
                self.put(item, key, part)
        elif isinstance(value, list):  # struct array
            item = group.create_group(name)
            item.attrs["MATLAB_class"] = np.bytes_("struct")
            for key in value[0]:
                item[key] = np.array([[self.reference(part[key])] for part in value], h5py.ref_dtype)
        elif isinstance(value, str):
            group[name] = np.array([[ord(letter)] for letter in value], np.uint16)
            group[name].attrs["MATLAB_class"] = np.bytes_("char")
        elif np.asarray(value).dtype.kind == "O":
            group[name] = np.array([[self.reference(part)] for part in value], h5py.ref_dtype)
            group[name].attrs["MATLAB_class"] = np.bytes_("cell")
        else:
            array = np.atleast_2d(np.asarray(value, float))
            group[name] = array.T if array.size else np.array([0, 0], np.uint64)
            group[name].attrs["MATLAB_class"] = np.bytes_("double")
            if not array.size:
                group[name].attrs["MATLAB_empty"] = np.uint8(1)
        return group[name]

    def reference(self, value):
        self.count += 1
        return self.put(self.refs, f"r{self.count}", value).ref


def save(path, version, tree):
    if version == "v5":
        scipy.io.savemat(path, tree)
    else:
        Matlab73(path, tree)


both = pytest.mark.parametrize("version", ["v5", "v7.3"])


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.mat"


@both
@pytest.mark.parametrize("transposed", [False, True])
def test_records_of_a_struct_array(path, rng, version, transposed):
    one, two = fields(rng), fields(rng, excitation="noise", period_s=np.zeros((0, 0)), floor=np.zeros((0, 0)))
    stored = [
        record | {key: record[key].T for key in ("u", "y", "floor")} if transposed else record for record in (one, two)
    ]
    save(path, version, {"records": stored, "rig": "avis", "format": "avis-campaign"})
    campaign = read_measurements(path)
    assert campaign.rig == "avis" and campaign.y_names == ("S1", "S2", "S3") and campaign.y_unit == "m/s"
    assert [r.header.period_s for r in campaign.records] == [0.2, None]
    assert isinstance(campaign.records[0], StoredRecord) == (version == "v7.3")
    for record, source in zip(campaign.records, (one, two), strict=True):
        piece = record.load(20, 33)
        np.testing.assert_array_equal(piece.u, source["u"][20:33])
        np.testing.assert_array_equal(piece.y, source["y"][20:33])
    np.testing.assert_array_equal(campaign.records[0].load().floor, one["floor"])
    assert campaign.records[1].load().floor is None


@both
def test_one_record_and_the_same_content_in_hdf5(path, tmp_path, rng, version):
    save(path, version, {"records": fields(rng), "rig": "avis"})
    campaign = read_measurements(path)
    write_campaign(tmp_path / "a.h5", campaign)
    assert digest(read_measurements(tmp_path / "a.h5")) == digest(campaign)


@both
def test_names_as_the_rows_of_a_char_matrix(path, rng, version):
    """Padded to one length; stored by columns."""
    names = ["A1", "A12"]
    save(path, version, {"records": fields(rng, u_names=np.array(names) if version == "v5" else "x"), "rig": "avis"})
    if version == "v7.3":
        with h5py.File(path, "r+") as file:
            del file["records/u_names"]
            file["records/u_names"] = np.array(
                [[ord(letter) for letter in name.ljust(3)] for name in names], np.uint16
            ).T
            file["records/u_names"].attrs["MATLAB_class"] = np.bytes_("char")
    assert list(read_measurements(path).u_names) == names


@both
@pytest.mark.parametrize("shape", ["row", "column"])
def test_flat_vectors_either_way_round(path, rng, version, shape):
    u, y = rng.normal(size=(2, 50))
    turn = (lambda v: v[None, :]) if shape == "row" else (lambda v: v[:, None])
    save(path, version, {"u": turn(u), "y": turn(y), "Fs": 200.0})
    campaign = read_measurements(path, excitation="noise")
    record = campaign.records[0].load()
    np.testing.assert_array_equal(record.u[:, 0], u)
    np.testing.assert_array_equal(record.y[:, 0], y)
    assert record.header.sample_rate_Hz == 200.0 and any("unit of y not stated" in note for note in campaign.notes)


def test_flat_matrices_that_only_names_or_time_can_tell(path, rng):
    u, y = rng.normal(size=(4, 6)), rng.normal(size=(4, 6))
    tree = {"u": u, "y": y, "fs": 10.0}
    scipy.io.savemat(path, tree)
    refused("rows and columns could both be the samples: u is 4x6, y is 4x6", path)
    scipy.io.savemat(path, tree | {"t": np.arange(6) / 10})
    np.testing.assert_array_equal(read_measurements(path).records[0].load().y, y.T)
    scipy.io.savemat(path, tree | {"u_names": cells(list("abcdef"))})
    np.testing.assert_array_equal(read_measurements(path).records[0].load().y, y)


def test_real_data_by_a_mapping(data):
    emps = data / "emps" / "DATA_EMPS.mat"
    record = read_measurements(emps, {"t": "t", "u": "vir", "y": ["qm", "qg"]}, y_unit="m").records[0].load()
    raw = scipy.io.loadmat(emps)
    assert record.header.sample_rate_Hz == 1000.0 and record.header.y_names == ("qm", "qg")
    np.testing.assert_array_equal(record.y, np.hstack([raw["qm"], raw["qg"]]))
    box = data / "silverbox" / "Schroeder80mV.mat"
    record = read_measurements(box, {"u": "V1", "y": "V2"}, sample_rate_Hz=610.35).records[0].load()
    np.testing.assert_array_equal(record.u[:, 0], scipy.io.loadmat(box)["V1"][0])
    refused("u: no variable has a usual name", box)
    refused("sample rate: expected t, fs or sample_rate_Hz", box, {"u": "V1", "y": "V2"})


@both
@pytest.mark.parametrize("lines", ["first", "last"])
def test_frequency_responses(path, rng, version, lines):
    G = rng.normal(size=(7, 3, 2)) + (0 if version == "v7.3" else 1j * rng.normal(size=(7, 3, 2)))
    coherence = rng.uniform(0.4, 0.9, (7, 3, 2))
    turn = (lambda a: a) if lines == "first" else (lambda a: np.moveaxis(a, 0, 2))
    save(
        path,
        version,
        {
            "frequency_Hz": np.arange(1.0, 8.0),
            "H": turn(G),
            "coherence": turn(coherence),
            "averages": 25.0,
            "inputs": cells(["A1", "A2"]),
            "outputs": cells(["S1", "S2", "S3"]),
            "output_unit": "mm/s",
        },
    )
    response = read_measurements(path)
    np.testing.assert_allclose(response.value, 1e-3 * G, rtol=1e-14)
    np.testing.assert_allclose(response.entry_variance, 1e-6 * np.abs(G) ** 2 * (1 - coherence) / (coherence * 24))
    assert response.outputs == ("S1", "S2", "S3") and response.output_unit == "m/s"


@pytest.mark.parametrize("named", ["inputs", "outputs"])
def test_channels_without_names_are_numbered(path, rng, named):
    """The shape of H tells how many there are, where only the others have names."""
    names = {"inputs": ["A1", "A2"], "outputs": ["S1", "S2", "S3"]}
    G = rng.normal(size=(7, 3, 2))
    scipy.io.savemat(
        path, {"frequency_Hz": np.arange(1.0, 8.0), "H": G, "variance": np.ones((7, 3, 2)), named: cells(names[named])}
    )
    response = read_measurements(path)
    expected = {"inputs": ["u1", "u2"], "outputs": ["y1", "y2", "y3"]} | {named: names[named]}
    assert [list(response.inputs), list(response.outputs)] == [expected["inputs"], expected["outputs"]]
    np.testing.assert_array_equal(response.value, G)


def test_as_many_lines_as_channels_are_refused(path, rng):
    scipy.io.savemat(
        path,
        {
            "frequency_Hz": np.arange(1.0, 3.0),
            "H": rng.normal(size=(2, 2, 2)),
            "variance": np.ones((2, 2, 2)),
            "inputs": cells(["a", "b"]),
            "outputs": cells(["c", "d"]),
        },
    )
    refused("the dimension of frequency is ambiguous", path)


WRONG = {
    "no rate": (
        {"sample_rate_Hz": MISSING},
        "records: missing: sample_rate_Hz, fs or a time vector t; the records have excitation, floor",
    ),
    "no y": ({"y": MISSING}, "records: missing: y, the sensor signals; the records have"),
    "all at once": (
        {"y": MISSING, "sample_rate_Hz": MISSING, "period_s": 0.0},
        "missing: y, the sensor signals; sample_rate_Hz, fs or a time vector t; period_s, the period",
    ),
    "names": ({"y_names": cells(["S1", "S2"])}, "expected 2 channels, as many as names; it is 60x3"),
    "same names": ({"y_names": cells(["S1", "S1", "S2"])}, "expected different names"),
    "lengths": ({"y": np.zeros((59, 3))}, "expected equally many samples; u is 60x2, y is 59x3, floor is 60x3"),
    "text": ({"y": "none"}, "record 00: y = 'text': expected a real matrix"),
    "cells": ({"y": cells([1.0, 2.0])}, "y = 'cell or struct array': expected a real matrix"),
    "empty": ({"y": np.zeros((0, 0))}, "records: missing: y, the sensor signals"),
    "period": ({"period_s": 0.123}, "expected a whole number of samples"),
    "no period": ({"period_s": np.nan}, "missing: period_s, the period in s of a multisine"),
    "unit": ({"y_unit": "Pa"}, "record 00: y unit = 'Pa': expected a unit of V"),
}


@both
@pytest.mark.parametrize("case", WRONG)
def test_wrong_records_in_one_line(path, rng, version, case):
    changes, message = WRONG[case]
    save(path, version, {"records": fields(rng, **changes), "rig": "avis"})
    refused(message, path)


@both
def test_samples_that_are_no_numbers_are_named_by_place(path, rng, version):
    record = fields(rng)
    record["y"][41, 1] = np.inf
    save(path, version, {"records": record, "rig": "avis"})
    with pytest.raises(InputError, match=r"record 00: y = inf: .* infinite: 1, the first at sample 41 of channel S2"):
        read_measurements(path).records[0].load()


def test_function_handles_and_objects_are_refused_only_where_they_are_used(path, rng):
    Matlab73(path, {"u": rng.normal(size=50), "y": rng.normal(size=50), "fs": 10.0, "f": 1.0, "o": 1.0})
    with h5py.File(path, "r+") as file:
        file["f"].attrs["MATLAB_class"] = np.bytes_("function_handle")
        file["o"].attrs["MATLAB_class"] = np.bytes_("string")
    assert read_measurements(path, excitation="noise").records[0].header.samples == 50
    for name, kind in (("f", "function handle"), ("o", "MATLAB string")):
        refused(f"{name} = 'a {kind}': expected a real matrix", path, {"u": "u", "y": name})
    scipy.io.savemat(path, {"u": np.zeros((9, 1), complex), "y": np.zeros((9, 1)), "fs": 1.0, "rig": 3.0})
    refused("u = 'complex array of 9x1': expected a real matrix", path)
