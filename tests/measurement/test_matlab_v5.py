"""Our v5 reader against scipy.io.loadmat, on files of scipy.io.savemat and on files put together here from the format's
document in both byte orders; what does not fit together is refused in one line; random damage never ends a process."""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest
import scipy.io
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from refusals import refused

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.formats import read_measurements
from avis_ctrl.measurement.formats.matlab import variables
from avis_ctrl.measurement.formats.matlab_tree import SETTINGS, Matrix, Unreadable

TYPES = ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "c16", "c8", "?"]


def plain(value):
    """What scipy.io.loadmat gives, as the tree that we give."""
    if value.dtype.names is not None:
        items = [{name: plain(element[name]) for name in value.dtype.names} for element in value.ravel("F")]
        return items[0] if len(items) == 1 else items
    if value.dtype.kind == "O":
        return [plain(element) for element in value.ravel("F")]
    if value.dtype.kind == "U":
        rows = [str(row).strip() for row in value.ravel()]
        return rows[0] if len(rows) == 1 else rows or ""
    return value


def same(ours, theirs):
    assert type(ours) is (Matrix if isinstance(theirs, np.ndarray) else type(theirs))
    if isinstance(ours, Matrix):
        array = ours.read()
        assert array.shape == ours.shape and array.dtype.kind == ours.kind
        assert array.dtype.itemsize >= theirs.dtype.itemsize  # MATLAB's class; scipy's may be the smaller stored type
        np.testing.assert_array_equal(array, theirs)
    elif isinstance(ours, dict):
        assert list(ours) == list(theirs)
        for name in ours:
            same(ours[name], theirs[name])
    elif isinstance(ours, list):
        for one, other in zip(ours, theirs, strict=True):
            same(one, other)
    else:
        assert ours == theirs


def compare(path):
    theirs = {name: plain(value) for name, value in scipy.io.loadmat(path).items() if not name.startswith("__")}
    same(variables(path), theirs)
    return theirs


NUMBERS = st.sampled_from(TYPES).flatmap(
    lambda kind: arrays(np.dtype(kind), array_shapes(max_dims=3, min_side=0, max_side=4))
)
TEXT = st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), min_size=1, max_size=12)
LEAVES = st.one_of(NUMBERS, TEXT, st.floats(), st.integers(-9, 9))
FIELDS = st.text("abcXYZ_0123456789", min_size=1, max_size=9).map(lambda name: "v" + name)


def boxed(items):
    cell = np.empty(len(items), object)
    for i, item in enumerate(items):
        cell[i] = item
    return cell


VALUES = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4).map(boxed),
        st.dictionaries(FIELDS, inner, min_size=1, max_size=4),
        st.lists(st.fixed_dictionaries({"a": inner, "b": inner}), min_size=1, max_size=3),
    ),
    max_leaves=8,
)


@given(st.dictionaries(FIELDS, VALUES, min_size=1, max_size=4), st.booleans(), st.sampled_from(["row", "column"]))
@settings(max_examples=60, deadline=None)
def test_what_scipy_writes_is_read_as_scipy_reads_it(tmp_path_factory, tree, compressed, vectors):
    path = tmp_path_factory.getbasetemp() / "written.mat"
    scipy.io.savemat(path, tree, do_compression=compressed, oned_as=vectors, long_field_names=True)
    assert set(compare(path)) == set(tree)


@pytest.mark.parametrize("name", ["emps/DATA_EMPS.mat", "silverbox/Schroeder80mV.mat"])
def test_files_that_matlab_wrote(data, name):
    assert len(compare(data / name)) >= 2


# Files put together from the document, in both byte orders.


def element(order, kind, content, small=False):
    if small:
        assert len(content) <= 4
        return struct.pack(order + "I", len(content) << 16 | kind) + content.ljust(4, b"\0")
    return struct.pack(order + "II", kind, len(content)) + content + b"\0" * (-len(content) % 8)


def matrix(order, name, own, shape, *parts, flags=0, small=False):
    """A matrix; parts are its elements after the name."""
    name = name.encode()
    body = element(order, 6, struct.pack(order + "II", own | flags << 8, 0))
    body += element(order, 5, struct.pack(f"{order}{len(shape)}i", *shape))
    body += element(order, 1, name, small and len(name) <= 4) + b"".join(parts)
    return element(order, 14, body)


def numbers(order, kind, form, content, small=False):
    return element(order, kind, np.asarray(content, order + form).tobytes(), small)


def file(order, *elements_):
    mark = b"IM" if order == "<" else b"MI"
    return b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack(order + "H", 0x0100) + mark + b"".join(elements_)


def double(order, name, shape=(2, 3), content=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0)):
    return matrix(order, name, 6, shape, numbers(order, 9, "f8", content))


def compressed(order, content):
    content = zlib.compress(content)
    return struct.pack(order + "II", 15, len(content)) + content


orders = pytest.mark.parametrize("order", ["<", ">"])


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.mat"


@orders
def test_every_class_in_both_byte_orders(path, order):
    text = "äb€".encode("utf-16-le" if order == "<" else "utf-16-be")
    field_names = element(order, 5, struct.pack(order + "i", 8), small=True) + element(
        order, 1, b"a".ljust(8, b"\0") + b"longer".ljust(8, b"\0")
    )
    path.write_bytes(
        file(
            order,
            double(order, "plain"),
            compressed(order, double(order, "packed")),
            matrix(order, "few", 6, (1, 2), numbers(order, 2, "u1", [3, 200], small=True), small=True),
            matrix(
                order, "complex", 6, (2, 1), numbers(order, 9, "f8", [1, 2]), numbers(order, 3, "i2", [-3, 4]), flags=8
            ),
            matrix(order, "single", 7, (1, 3), numbers(order, 7, "f4", [1.5, -2.5, 0.25])),
            matrix(order, "logical", 9, (1, 3), numbers(order, 2, "u1", [1, 0, 1]), flags=2),
            matrix(order, "long", 14, (1, 2), numbers(order, 12, "i8", [-(1 << 60), 7])),
            matrix(order, "shorter", 12, (1, 2), numbers(order, 4, "u2", [65535, 1], small=True)),
            matrix(order, "text", 4, (1, 3), element(order, 17, text)),
            matrix(order, "rows", 4, (2, 2), numbers(order, 4, "u2", [97, 99, 98, 100])),
            matrix(order, "utf8", 4, (1, 3), element(order, 16, "äb€".encode())),
            matrix(order, "cell", 1, (2, 2), *(double(order, "", (1, 1), [i]) for i in range(4))),
            matrix(order, "structs", 2, (1, 2), field_names, *(double(order, "", (1, 1), [i]) for i in range(4))),
            matrix(order, "cube", 6, (2, 1, 2), numbers(order, 9, "f8", range(4))),
        )
    )
    tree = compare(path)
    np.testing.assert_array_equal(tree["complex"], [[1 - 3j], [2 + 4j]])
    assert tree["text"] == tree["utf8"] == "äb€" and tree["rows"] == ["ab", "cd"]
    assert [float(item["longer"][0, 0]) for item in tree["structs"]] == [1.0, 3.0]


@orders
def test_what_holds_no_measurement_is_refused_only_where_it_is_used(path, order):
    path.write_bytes(
        file(
            order,
            matrix(order, "handle", 16, (1, 1), element(order, 14, b"")),
            matrix(order, "old", 3, (1, 1), element(order, 1, b"inline")),
            element(
                order,
                14,
                element(order, 6, struct.pack(order + "II", 17, 0))
                + element(order, 1, b"new")
                + element(order, 1, b"MCOS"),
            ),
            double(order, "u", (6, 1)),
            double(order, "y", (6, 1)),
            double(order, "fs", (1, 1), [9.0]),
        )
    )
    tree = variables(path)
    assert {name: tree[name].kind for name in ("handle", "old", "new")} == {
        "handle": "function handle",
        "old": "MATLAB object",
        "new": "MATLAB object",
    }
    assert read_measurements(path).records[0].load().u[5, 0] == 6.0
    refused("handle = 'a function handle': expected a real matrix", path, {"u": "u", "y": "handle"})
    path.write_bytes(file(order, matrix(order, "bare", 1, (1, 2), element(order, 14, b""), double(order, ""))))
    assert [part.shape for part in variables(path)["bare"]] == [(0, 0), (2, 3)]  # MATLAB's []
    scipy.io.savemat(path, {"y": scipy.sparse.eye(5).tocsc(), "u": np.ones(5), "fs": 1.0})
    refused("y = 'a sparse matrix': expected a real matrix", path)


def test_deep_and_wide_structures_cost_nothing(path):
    deep = double("<", "")
    for _ in range(400):
        deep = matrix("<", "", 1, (1, 1), deep)
    path.write_bytes(
        file(
            "<",
            matrix("<", "deep", 1, (1, 1), deep),
            matrix("<", "wide", 1, (SETTINGS.most_cells + 1, 1), *[element("<", 14, b"")] * (SETTINGS.most_cells + 1)),
            matrix("<", "none", 2, (1 << 30, 1), element("<", 5, struct.pack("<i", 8)), element("<", 1, b"")),
            matrix("<", "rows", 4, (1 << 30, 0), element("<", 16, b"")),
        )
    )
    tree = variables(path)
    assert isinstance(tree["wide"], Unreadable) and isinstance(tree["none"], Unreadable) and tree["rows"] == ""
    inner, depth = tree["deep"], 0
    while isinstance(inner, list):
        inner, depth = inner[0], depth + 1
    assert inner == Unreadable("structure nested too deep") and depth == 8


def bomb(order):
    """A small stream that inflates to a gigabyte, behind a tag that states 100 bytes."""
    content = zlib.compress(struct.pack(order + "II", 14, 100) + bytes(10_000_000), 9)
    return struct.pack(order + "II", 15, len(content)) + content


def damaged_zip(order):
    content = bytearray(compressed(order, double(order, "u")))
    content[-1] ^= 1  # of the check sum
    return bytes(content)


FLAGS, DIMENSIONS, NAME = (
    lambda o: element(o, 6, struct.pack(o + "II", 6, 0)),
    lambda o: element(o, 5, struct.pack(o + "ii", 2, 3)),
    lambda o: element(o, 1, b"u"),
)
WRONG = {
    "bytes": (lambda o: matrix(o, "u", 6, (2, 4), numbers(o, 9, "f8", range(6))), "48 bytes for 8 numbers of 8 bytes"),
    "huge": (lambda o: matrix(o, "u", 6, (1 << 20, 1 << 20), numbers(o, 9, "f8", [1])), r"\[1048576, 1048576\] are no"),
    "negative": (lambda o: matrix(o, "u", 6, (-2, -3), numbers(o, 9, "f8", range(6))), r"\[-2, -3\] are not possible"),
    "empty, huge": (lambda o: matrix(o, "u", 6, (0, *[2**31 - 1] * 9), numbers(o, 9, "f8", [])), "are not possible"),
    "one dimension": (lambda o: matrix(o, "u", 6, (6,), numbers(o, 9, "f8", range(6))), r"\[6\] are not possible"),
    "wide": (lambda o: matrix(o, "u", 8, (1, 2), numbers(o, 9, "f8", [1, 2])), "int8 is not stored as float64"),
    "range": (lambda o: matrix(o, "u", 8, (1, 2), numbers(o, 2, "u1", [1, 200])), "values beyond int8"),
    "type": (lambda o: matrix(o, "u", 6, (1, 2), numbers(o, 11, "f8", [1, 2])), "real part: of type 11, not 1 or 2"),
    "no data": (lambda o: matrix(o, "u", 6, (1, 2)), "real part: missing"),
    "no imaginary part": (lambda o: matrix(o, "u", 6, (1, 1), numbers(o, 9, "f8", [1]), flags=8), "imaginary part: mi"),
    "class": (lambda o: matrix(o, "u", 99, (1, 1), numbers(o, 9, "f8", [1])), "class 99 does not exist"),
    "more": (lambda o: matrix(o, "u", 6, (1, 1), *[numbers(o, 9, "f8", [1])] * 2), "16 bytes follow the last part"),
    "element beyond": (
        lambda o: element(o, 14, FLAGS(o) + DIMENSIONS(o) + NAME(o) + struct.pack(o + "II", 9, 4000)),
        "real part: 4000 bytes are stated, 0 are left",
    ),
    "small element": (lambda o: matrix(o, "u", 6, (1, 1), struct.pack(o + "II", 5 << 16 | 2, 0)), "5 bytes are stated"),
    "order": (lambda o: element(o, 14, DIMENSIONS(o) + FLAGS(o) + NAME(o)), "array flags: of type 5, not 6"),
    "cells": (lambda o: matrix(o, "u", 1, (1 << 15, 1 << 15), double(o, "")), "1073741824 parts are stated"),
    "cell of numbers": (lambda o: matrix(o, "u", 1, (1, 1), numbers(o, 9, "f8", [1])), "cell 1: of type 9, not 14"),
    "field names": (
        lambda o: matrix(
            o, "u", 2, (1, 1), element(o, 5, struct.pack(o + "i", 3)), element(o, 1, b"abcd"), double(o, "")
        ),
        r"field names: 4 bytes in names of \[3\]",
    ),
    "no width": (
        lambda o: matrix(o, "u", 2, (1, 1), element(o, 5, struct.pack(o + "i", 0)), element(o, 1, b"a"), double(o, "")),
        "field names: 1 bytes in names of",
    ),
    "equal fields": (
        lambda o: matrix(
            o,
            "u",
            2,
            (1, 1),
            element(o, 5, struct.pack(o + "i", 1)),
            element(o, 1, b"aa"),
            double(o, ""),
            double(o, ""),
        ),
        "empty or equal ones",
    ),
    "name": (lambda o: double(o, "a\nb"), r"name: 'a\\nb' is not a name"),
    "text": (lambda o: matrix(o, "u", 4, (1, 5), element(o, 16, b"abc")), "characters: 3 for dimensions 1x5"),
    "twice": (lambda o: double(o, "u") + double(o, "u"), "variable at byte 240: the name 'u' comes twice"),
    "top": (lambda o: numbers(o, 9, "f8", [1]), "it is of type 9, not a matrix"),
    "cut": (lambda o: double(o, "u")[:-9], "it states 104 bytes; 95 are left"),
    "cut tag": (lambda o: double(o, "u") + b"abc", "3 bytes are left, no whole variable"),
    "bomb": (bomb, "the compressed bytes do not end where 100 bytes are inflated"),
    "no bomb": (lambda o: compressed(o, struct.pack(o + "II", 14, 1 << 30)), "compressed bytes cannot hold the stated"),
    "check sum": (damaged_zip, "its bytes cannot be decompressed"),
    "no zip": (lambda o: struct.pack(o + "II", 15, 8) + b"12345678", "its bytes cannot be decompressed"),
    "nested zip": (lambda o: compressed(o, compressed(o, double(o, "u"))), "hold type 15, not a matrix"),
}


@orders
@pytest.mark.parametrize("case", WRONG)
def test_what_does_not_fit_together_in_one_line(path, case, order):
    make, message = WRONG[case]
    path.write_bytes(file(order, make(order)))
    with pytest.raises(InputError, match=message) as caught:
        read_measurements(path)
    assert str(caught.value).startswith(f"{path}: variable at byte ") and "\n" not in str(caught.value)


def test_headers(path):
    good = file("<", double("<", "u"))
    for at, value, message in ((124, b"\x00\x02", "expected version 0x0100"), (126, b"XX", "expected version 0x0100")):
        path.write_bytes(good[:at] + value + good[at + 2 :])
        refused(message, path)
    path.write_bytes(good[:100])
    refused(r"expected a \.mat file of version 5 to 7.3", path)


@pytest.mark.parametrize("value", [np.arange(9.0), np.arange(9, dtype=np.int16), "text", 1 + 2j, scipy.sparse.eye(3)])
def test_version_4_is_refused_by_name(path, value):
    scipy.io.savemat(path, {"u": value}, format="4")
    refused(r"a MATLAB v4 file; expected version 5 to 7\.3: load it in MATLAB and", path)


FUZZ = """
import resource, struct, sys, warnings, zlib
import numpy as np
from avis_ctrl.errors import InputError
from avis_ctrl.measurement.formats import matlab, read_measurements
from pathlib import Path
warnings.simplefilter("error")
resource.setrlimit(resource.RLIMIT_AS, (3 << 30, 3 << 30))
good, path = Path(sys.argv[1]).read_bytes(), Path(sys.argv[1] + ".damaged")
rng = np.random.default_rng(int(sys.argv[2]))
tally = {"valid": 0, "refused": 0}
for _ in range(int(sys.argv[3])):
    inside, content = rng.random() < 0.5, bytearray(good[128:])
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(0, len(content)))
        if rng.random() < 0.7:
            content[at] = rng.integers(0, 256)
        else:
            at -= at % 4
            content[at:at + 4] = struct.pack("<I", int(rng.choice([0, 7, 2**31 - 1, 2**31, 2**32 - 1, 1 << 24])))
    content = bytes(content[:int(rng.integers(0, len(content)))] if rng.random() < 0.1 else content)
    if inside:
        packed = zlib.compress(content, 1)
        content = struct.pack("<II", 15, len(packed)) + packed
    path.write_bytes(good[:128] + content)
    try:
        read_measurements(path, excitation="noise")
        tally["valid"] += 1
    except InputError as error:
        assert str(error).startswith(str(path)) and "\\n" not in str(error), error
        tally["refused"] += 1
print(tally["valid"], tally["refused"])
"""


@pytest.mark.parametrize("cases", [1500, pytest.param(100_000, marks=pytest.mark.slow)])
def test_random_damage_never_ends_the_process(path, rng, cases):
    names = [np.array(["A1", "A2"], object), np.array(["S1"], object)]
    scipy.io.savemat(
        path,
        {
            "records": {
                "sample_rate_Hz": 100.0,
                "excitation": "noise",
                "level_V": 1.0,
                "start_s": 0.0,
                "u": rng.normal(size=(9, 2)),
                "y": rng.normal(size=(9, 1)),
                "u_names": names[0],
                "y_names": names[1],
            },
            "rig": "avis",
        },
    )
    done = subprocess.run([sys.executable, "-c", FUZZ, str(path), "7", str(cases)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    valid, refused = map(int, done.stdout.split())
    assert valid + refused == cases and valid > cases / 50 and refused > cases / 5
