"""Files of a study are whole or absent: after a kill, on a full disk, in a folder that cannot be written."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl import files
from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.files import write_together, write_whole
from avis_ctrl.study import files as folders
from avis_ctrl.study.files import as_json
from avis_ctrl.study.output import FILES, FOLDERS

SIZE = 300_000

WRITER = (
    f"SIZE = {SIZE}"
    + """
import sys
from pathlib import Path
from avis_ctrl import files
if sys.argv[2] == "renamed":
    del files.os.O_TMPFILE
k = 0
while True:
    files.write_whole(Path(sys.argv[1]) / "report.html", bytes([65 + k % 26]) * SIZE)
    if not k:
        print("writing", flush=True)
    k += 1
"""
)


@pytest.mark.parametrize("way", ["nameless", "renamed"])
def test_a_kill_leaves_a_whole_file_or_none(way, tmp_path):
    """kill -9 in the middle of endless writing: a file as it was written, and nothing visible beside it."""
    rng = np.random.default_rng(7)
    for round_number in range(4):
        folder = tmp_path / str(round_number)
        folder.mkdir()
        child = subprocess.Popen([sys.executable, "-c", WRITER, str(folder), way], stdout=subprocess.PIPE)
        assert child.stdout is not None
        child.stdout.readline()
        time.sleep(rng.uniform(0.0, 0.05))
        child.send_signal(signal.SIGKILL)
        child.wait()
        child.stdout.close()
        content = (folder / "report.html").read_bytes()
        assert len(content) == SIZE
        assert len(set(content)) == 1
        assert [path.name for path in folder.iterdir() if not path.name.startswith(".")] == ["report.html"]
        # Writing again succeeds in spite of what the killed process may have left hidden.
        write_whole(folder / "report.html", b"new")
        assert (folder / "report.html").read_bytes() == b"new"


FULL = """
import resource, signal, sys
from pathlib import Path
from avis_ctrl.errors import ComputationError
from avis_ctrl import files
if sys.argv[2] == "renamed":
    del files.os.O_TMPFILE
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    files.write_whole(Path(sys.argv[1]) / "result.json", b"x" * 100_000)
except ComputationError as error:
    print(error)
    sys.exit(error.exit_code)
"""


@pytest.mark.parametrize("way", ["nameless", "renamed"])
def test_a_file_that_the_system_cuts_short_leaves_the_old_one(way, tmp_path):
    """A real limit of the system (1000 bytes a file): the write fails half-way with EFBIG."""
    (tmp_path / "result.json").write_bytes(b"old")
    done = subprocess.run([sys.executable, "-c", FULL, str(tmp_path), way], capture_output=True, text=True, check=False)
    assert done.returncode == 3
    assert "result.json was not written" in done.stdout
    assert "File too large" in done.stdout
    assert (tmp_path / "result.json").read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [tmp_path / "result.json"]


@pytest.mark.parametrize("step", ["fsync", "replace", "write"])
def test_a_full_disk_leaves_the_old_file_and_says_so(step, tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    (tmp_path / "report.pdf").write_bytes(b"old")
    if step == "write":
        monkeypatch.setattr(files.os, "open", full)
        monkeypatch.setattr(files.tempfile, "mkstemp", full)
    else:
        monkeypatch.setattr(files.os, step, full)
    with pytest.raises(ComputationError, match="No space left on device") as refused:
        write_whole(tmp_path / "report.pdf", b"new" * 1000)
    monkeypatch.undo()
    assert refused.value.exit_code == 3
    assert "free some space" in str(refused.value)
    assert (tmp_path / "report.pdf").read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [tmp_path / "report.pdf"]


def test_without_nameless_files_the_renamed_way_is_taken(tmp_path, monkeypatch):
    """Some file systems (NFS, old overlays) refuse O_TMPFILE."""
    opened = os.open

    def unsupported(path, flags, *args, **kwargs):
        if flags & os.O_TMPFILE == os.O_TMPFILE:
            raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))
        return opened(path, flags, *args, **kwargs)

    monkeypatch.setattr(files.os, "open", unsupported)
    write_whole(tmp_path / "plant.json", b"{}")
    assert (tmp_path / "plant.json").read_bytes() == b"{}"
    assert list(tmp_path.iterdir()) == [tmp_path / "plant.json"]


def test_without_links_a_copy_takes_the_name(tmp_path, monkeypatch):
    """Without /proc a file that has no name cannot get one."""

    def absent(*args, **kwargs):
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))

    monkeypatch.setattr(files.os, "link", absent)
    write_whole(tmp_path / "plant.json", b"{}" * 10000)
    assert (tmp_path / "plant.json").read_bytes() == b"{}" * 10000
    assert list(tmp_path.iterdir()) == [tmp_path / "plant.json"]


def test_several_files_are_all_written_or_none(tmp_path, monkeypatch):
    """The third of three is refused: the folder is as it was, with an old file that was to go."""
    (tmp_path / "result.json").write_bytes(b"old")
    (tmp_path / "old.pdf").write_bytes(b"old")
    contents = {"controllers/mu.json": b"1", "report.html": b"2", "result.json": b"3"}
    synced, fsync = [], os.fsync

    def full(descriptor):
        synced.append(descriptor)
        if len(synced) == 3:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(descriptor)

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(ComputationError, match=r"before is untouched.*No space left"):
        write_together(tmp_path, contents, [tmp_path / "old.pdf", tmp_path / "absent"])
    assert {one.name: one.read_bytes() for one in tmp_path.iterdir()} == {"result.json": b"old", "old.pdf": b"old"}
    monkeypatch.undo()
    written = write_together(tmp_path, contents, [tmp_path / "old.pdf", tmp_path / "absent"])
    assert [one.read_bytes() for one in written] == [b"1", b"2", b"3"]
    assert sorted(one.name for one in tmp_path.iterdir()) == ["controllers", "report.html", "result.json"]


def refused_rename(monkeypatch, path):
    """Renaming to this path fails."""
    replace = os.replace

    def refuse(source, target):
        if Path(target) == path:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        replace(source, target)

    monkeypatch.setattr(files.os, "replace", refuse)


def test_a_rename_that_fails_after_old_files_went_says_what_is_missing(tmp_path, monkeypatch):
    for name in ("result.json", "report.html", "old.pdf"):
        (tmp_path / name).write_bytes(b"old")
    refused_rename(monkeypatch, tmp_path / "report.html")
    with pytest.raises(ComputationError) as caught:
        write_together(
            tmp_path,
            {"controllers/mu.json": b"1", "report.html": b"2", "result.json": b"3"},
            [tmp_path / name for name in ("result.json", "report.html", "old.pdf", "absent")],
        )
    assert caught.value.failed == (
        f"{tmp_path} is incomplete, do not use what is in it (missing: report.html, result.json, old.pdf; "
        f"new: {os.path.join('controllers', 'mu.json')})"
    )
    assert caught.value.cause == os.strerror(errno.EIO)
    assert [one for one in tmp_path.rglob("*") if one.is_file()] == [tmp_path / "controllers" / "mu.json"]


def test_a_rename_that_fails_between_two_files_says_which_one_is_older(tmp_path, monkeypatch):
    for name in ("a.json", "b.json"):
        (tmp_path / name).write_bytes(b"old")
    refused_rename(monkeypatch, tmp_path / "b.json")
    with pytest.raises(ComputationError, match=r"incomplete.*\(new: a\.json; of an earlier run: b\.json\)"):
        write_together(tmp_path, {"a.json": b"1", "b.json": b"2"})
    assert (tmp_path / "b.json").read_bytes() == b"old"


def test_a_rename_that_fails_before_anything_changed_leaves_all(tmp_path, monkeypatch):
    (tmp_path / "a.json").write_bytes(b"old")
    refused_rename(monkeypatch, tmp_path / "a.json")
    with pytest.raises(ComputationError, match="before is untouched"):
        write_together(tmp_path, {"a.json": b"1"})
    assert [one.read_bytes() for one in tmp_path.iterdir()] == [b"old"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device")
def test_a_device_is_not_replaced():
    with pytest.raises(InputError, match="not a regular file"):
        write_whole(Path("/dev/full"), b"x")
    assert Path("/dev/full").is_char_device()


def test_files_can_be_read_by_others(tmp_path):
    write_whole(tmp_path / "a.json", b"{}")
    assert (tmp_path / "a.json").stat().st_mode & 0o444 == 0o444


def open_folder(folder):
    return folders.open_folder(folder, FILES, FOLDERS)


def test_what_was_made_goes_again_where_an_error_leaves_it_empty(tmp_path):
    (tmp_path / "mine").mkdir()
    for folder in ("a/b", "mine"):
        with pytest.raises(KeyError), folders.output_folder(tmp_path / folder):
            raise KeyError
    with pytest.raises(KeyError), folders.output_folder(tmp_path / "written" / "b") as path:
        (path / "result.json").write_text("{}")
        raise KeyError
    assert sorted(one.relative_to(tmp_path).as_posix() for one in tmp_path.rglob("*")) == [
        "mine",
        "written",
        "written/b",
        "written/b/result.json",
    ]


def test_what_is_read_is_never_written(tmp_path):
    campaign = tmp_path / "campaign.h5"
    campaign.write_bytes(b"precious")
    (tmp_path / "link.h5").symlink_to(campaign)
    for out in (campaign, tmp_path / "link.h5", tmp_path / "." / "campaign.h5"):
        with pytest.raises(InputError, match="other than the input file"):
            folders.require_output(out, "avis", None, campaign)
    folders.require_output(tmp_path / "new.h5", campaign, None, "avis")


def test_a_file_of_another_kind_is_not_overwritten(tmp_path):
    """A design file named as the output by a slip."""
    design, old = tmp_path / "design.toml", tmp_path / "old.h5"
    design.write_text("title = 'a day of work'\n")
    with h5py.File(old, "w") as file:
        file["x"] = 1.0
    with pytest.raises(InputError, match="is no HDF5 file: give another name"):
        folders.require_hdf5_output(design, "avis")
    folders.require_hdf5_output(old, "avis")
    folders.require_hdf5_output(tmp_path / "new.h5", "avis")
    assert design.read_text().startswith("title")


def test_a_file_in_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "out").write_bytes(b"precious")
    with pytest.raises(InputError, match="--out") as refused:
        open_folder(tmp_path / "out")
    assert refused.value.exit_code == 2
    assert (tmp_path / "out").read_bytes() == b"precious"


def test_a_folder_below_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(InputError, match="Not a directory"):
        open_folder(tmp_path / "file" / "out")


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a file system that nobody can write")
def test_a_file_system_that_nobody_can_write_is_refused():
    with pytest.raises(InputError, match="a writable folder"):
        open_folder("/proc/avis")
    with pytest.raises(InputError, match="a writable folder"):
        open_folder("/proc")


@pytest.mark.skipif(os.geteuid() == 0, reason="permissions do not bind the superuser")
def test_a_read_only_folder_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="Permission denied"):
        open_folder(tmp_path)
    tmp_path.chmod(0o700)


def test_folders_are_made_with_their_parents_and_left_empty(tmp_path):
    made = open_folder(tmp_path / "a" / "b")
    assert made.is_dir()
    assert list(made.iterdir()) == []
    assert open_folder(made) == made


@pytest.mark.parametrize("name", ["plant.json", "result.json", "report.html", "report.pdf"])
def test_a_folder_in_place_of_a_file_is_refused_before_hours_of_computing(name, tmp_path):
    (tmp_path / name).mkdir()
    with pytest.raises(InputError, match=name):
        open_folder(tmp_path)


def test_a_file_in_place_of_the_controllers_is_refused(tmp_path):
    (tmp_path / "controllers").write_bytes(b"precious")
    with pytest.raises(InputError, match="controllers"):
        open_folder(tmp_path)
    assert (tmp_path / "controllers").read_bytes() == b"precious"


numbers = st.one_of(st.floats(), st.integers(-(2**53), 2**53), st.booleans(), st.none(), st.text(max_size=5))
values = st.recursive(
    numbers,
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=3), inner, max_size=3)),
    max_leaves=10,
)


@settings(max_examples=60, deadline=None)
@given(value=st.dictionaries(st.text(max_size=3), values, max_size=4))
def test_json_is_strict_and_exact(value):
    text = as_json(value).decode()

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    def finite(one):
        if isinstance(one, dict):
            return {key: finite(inner) for key, inner in one.items()}
        if isinstance(one, list):
            return [finite(inner) for inner in one]
        return None if isinstance(one, float) and not np.isfinite(one) else one

    assert json.loads(text, parse_constant=refuse) == finite(value)


def test_json_of_numpy_values():
    text = as_json(
        {
            "a": np.array([[1.0, np.nan], [np.inf, 0.1]]),
            "b": np.float64(2.5),
            "c": np.int64(3),
            "d": np.bool_(True),
            "e": ("x", np.float32(0.5)),
        }
    )
    assert json.loads(text) == {"a": [[1.0, None], [None, 0.1]], "b": 2.5, "c": 3, "d": True, "e": ["x", 0.5]}
