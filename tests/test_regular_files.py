"""Readers take regular files alone, and refuse endless ones at once; writers replace regular files alone."""

import contextlib
import os
import signal
import socket
import stat
import threading
from pathlib import Path

import pytest

import jaxrock as rk
from jaxrock._core.atomic_files import written_atomically
from jaxrock._core.regular_files import open_regular
from jaxrock.command_line.main import main

READERS = {
    "records": rk.read_record,
    "components": rk.motions.read_components,
    "spectra": rk.motions.read_spectra,
    "rocks": rk.inverse.read_observations,
    "hazard curves": rk.hazard.read_hazard_curves,
}


@contextlib.contextmanager
def a_pipe(folder):
    """Make a pipe without a writer: opening it waits."""
    os.mkfifo(folder / "file")
    yield folder / "file"


@contextlib.contextmanager
def a_pipe_of_a_shell(folder):
    """Make a pipe as of `<(zcat record.gz)`: its writer exists, and has written nothing yet."""
    read, write = os.pipe()
    yield Path(f"/dev/fd/{read}")
    os.close(read)
    os.close(write)


@contextlib.contextmanager
def a_socket(folder):
    with socket.socket(socket.AF_UNIX) as made:
        before = os.getcwd()
        os.chdir(folder)  # their paths must be short
        made.bind("file")
        os.chdir(before)
        yield folder / "file"


@contextlib.contextmanager
def an_endless_device(folder):
    yield Path("/dev/zero")


KINDS = {a_pipe: "a pipe", a_pipe_of_a_shell: "a pipe", a_socket: "a socket", an_endless_device: "a device"}


@pytest.fixture
def at_once():
    """Interrupt a body that waits."""

    def waited(*_):
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, waited)
    signal.setitimer(signal.ITIMER_REAL, 20)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("reader", READERS)
def test_only_regular_files_are_read(tmp_path, at_once, reader, kind):
    with kind(tmp_path) as path, pytest.raises(ValueError, match=f"File `{path.name}`: is {KINDS[kind]}, and only"):
        READERS[reader](path)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_meshes_are_regular_files(tmp_path, at_once, kind):
    pytest.importorskip("trimesh")
    with kind(tmp_path) as path, pytest.raises(ValueError, match=f"is {KINDS[kind]}, and only regular"):
        rk.blocks.Rock.from_mesh(path)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_grids_are_regular_files(tmp_path, at_once, kind):
    pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    with kind(tmp_path) as path, pytest.raises(ValueError, match=f"is {KINDS[kind]}, and only regular"):
        rk.studies.Grid.load(path)


def test_descriptions_of_stores_are_regular_files(tmp_path, at_once):
    os.mkfifo(tmp_path / "zarr.json")
    with pytest.raises(ValueError, match="must be the store of a sweep or a saved grid"):
        rk.studies.Grid.load(tmp_path)


@pytest.mark.parametrize("command", ["run", "spectrum", "fragility", "invert"])
def test_the_command_refuses_a_pipe(tmp_path, at_once, capsys, command):
    with a_pipe_of_a_shell(tmp_path) as path:
        assert main([command, str(path), "--out", str(tmp_path / "out")]) == 2
    assert "is a pipe, and only regular files are read" in capsys.readouterr().err


def test_a_pipe_that_takes_the_place_of_a_file_is_not_waited_for(tmp_path, at_once, monkeypatch):
    (tmp_path / "file").touch()
    before = (tmp_path / "file").stat()
    (tmp_path / "file").unlink()
    os.mkfifo(tmp_path / "file")
    monkeypatch.setattr(Path, "stat", lambda self, **_: before)
    with pytest.raises(ValueError, match="is a pipe"):
        open_regular(tmp_path / "file")


def test_a_folder_and_a_missing_file_are_said_as_ever(tmp_path):
    with pytest.raises(IsADirectoryError, match=str(tmp_path)):
        rk.read_record(tmp_path)
    with pytest.raises(FileNotFoundError, match="missing"):
        rk.read_record(tmp_path / "missing")


def test_links_to_files_are_read(tmp_path):
    rk.motions.write_csv(rk.example_record(), tmp_path / "record.csv")
    (tmp_path / "link.csv").symlink_to("record.csv")
    assert rk.read_record(tmp_path / "link.csv").samples.size == rk.example_record().samples.size


@pytest.mark.parametrize("reader", READERS)
def test_a_file_that_memory_does_not_hold_is_refused(tmp_path, reader):
    """The refusal comes at once: the lines would take several times the size of the file."""
    with (tmp_path / "large.csv").open("wb") as file:
        file.truncate(3 * 2**40)  # a sparse file
    with pytest.raises(ValueError, match="File `large.csv`: holds 3.07e.03 GiB, but of text at most 1 GiB is read"):
        READERS[reader](tmp_path / "large.csv")


WRITERS = {
    "write_at2": lambda path: rk.motions.write_at2(rk.example_record(), path),
    "write_csv": lambda path: rk.motions.write_csv(rk.example_record(), path),
    "write_nrml": lambda path: rk.hazard.write_nrml({"topples": rk.hazard.LogNormalFragility(0.3, 0.4)}, path),
}


@pytest.mark.parametrize("kind", [a_pipe, a_socket], ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("writer", WRITERS)
def test_only_regular_files_are_replaced(tmp_path, writer, kind):
    """Root could put a file in the place of /dev/null."""
    with kind(tmp_path) as path:
        before = path.lstat()
        with pytest.raises(OSError, match="Only regular files are replaced"):
            WRITERS[writer](path)
        assert path.lstat().st_ino == before.st_ino and not stat.S_ISREG(path.lstat().st_mode)
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("writer", WRITERS)
def test_a_folder_is_not_replaced(tmp_path, writer):
    """Even an empty folder stays, and the error comes before anything is written."""
    (tmp_path / "results").mkdir()
    with pytest.raises(IsADirectoryError, match="results"):
        WRITERS[writer](tmp_path / "results")
    assert [each.name for each in tmp_path.iterdir()] == ["results"]


@pytest.mark.parametrize("there", [True, False])
@pytest.mark.parametrize("writer", WRITERS)
def test_the_target_of_a_link_is_written(tmp_path, writer, there):
    """The link stays, as with `numpy.savetxt`: it may lead to a larger disk."""
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to("disk/file")
    if there:
        (tmp_path / "disk" / "file").write_text("before")
    WRITERS[writer](tmp_path / "link")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "disk" / "file").stat().st_size > 100
    assert [each.name for each in (tmp_path / "disk").iterdir()] == ["file"]


def test_new_files_are_not_written_through_a_link(tmp_path):
    """A writer that replaces nothing refuses a link, even one that leads nowhere."""
    (tmp_path / "link").symlink_to("nowhere")
    with pytest.raises(FileExistsError), written_atomically(tmp_path / "link") as aside:
        aside.touch()
    assert [each.name for each in tmp_path.iterdir()] == ["link"]


def test_threads_that_write_one_file_leave_one_whole(tmp_path):
    """One whole file is left, and nothing beside it."""
    threads = [threading.Thread(target=WRITERS["write_nrml"], args=(tmp_path / "file",)) for _ in range(8)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert [each.name for each in tmp_path.iterdir()] == ["file"]
