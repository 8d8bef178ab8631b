"""Results of the command line replace its own results alone, and outlast streams that are closed or full."""

import errno
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import matplotlib.figure
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.command_line import main as module, results
from jaxrock.command_line.main import main
from jaxrock.command_line.results import HASH_FILE, ResultFolder
from jaxrock.inverse.observation_files import EXAMPLE

RECORD = "acceleration [g]\n" + "".join(f"{0.5 * np.sin(0.3 * k) * np.exp(-0.04 * k):.5f}\n" for k in range(60))
RUN = ("run", "--restitution", "0.9", "--model", "linear", "--duration", "2", "--dt", "0.02")

# Every command with the words that it needs, and the files that it may write.
WRITES = {
    "run": ((), ("history.csv", "impacts.csv", "history.png", "phase.png")),
    "run --animate": (("--animate",), ("animation.gif",)),
    "run --animate mp4": (("--animate", "mp4"), ("animation.mp4",)),
    "spectrum": ((), ("spectrum.csv", "spectrum.png")),
    "map": ((), ("map.csv", "map.png")),
    "critical": ((), ("critical.csv", "critical.png")),
    "fragility": (("RECORD",), ("fragility.csv", "stripes.csv", "fragility.xml", "fragility.png")),
    "invert": (
        ("ROCKS",),
        ("estimate.csv", "probabilities.csv", "region.csv", "region.png", "unexceeded.csv"),
    ),
}  # fmt: skip


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


@pytest.fixture
def out(tmp_path, monkeypatch):
    """A folder of results beside two inputs, in the folder where commands run. Figures are made, and not drawn."""
    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", lambda self, path, **_: Path(path).write_bytes(b"\x89PNG"))
    (tmp_path / "record.csv").write_text(RECORD)
    (tmp_path / "rocks.csv").write_text(EXAMPLE)
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path / "out"


@pytest.fixture
def nothing_computes(monkeypatch):
    """Let every long computation fail: a refusal must come before it."""
    for name in ("simulate", "rocking_spectrum", "overturning_map", "critical_amplitudes"):
        monkeypatch.setattr(rk, name, lambda *_, **__: pytest.fail("computes"))
    monkeypatch.setattr(rk.hazard, "simulated_fragility", lambda *_, **__: pytest.fail("computes"))
    monkeypatch.setattr(rk.inverse, "estimate_motion", lambda *_, **__: pytest.fail("computes"))


def names(out):
    return {path.name for path in out.iterdir()}


def words_of(command, record="record.csv", rocks="rocks.csv"):
    given = WRITES[command][0]
    return [command.split()[0], *({"RECORD": record, "ROCKS": rocks}.get(word, word) for word in given)]


@pytest.mark.parametrize("command, name", [(command, name) for command, (_, files) in WRITES.items() for name in files])
def test_a_file_of_the_users_is_not_replaced(out, capsys, nothing_computes, command, name):
    (out / name).write_text("years of work")
    assert main([*words_of(command), "--out", "out"]) == 2
    told = capsys.readouterr()
    assert f"out/{name} was not made by jaxrock" in told.err and "Give another --out, or --force" in told.err
    assert names(out) == {name} and (out / name).read_text() == "years of work" and not told.out


def by_its_name(path):
    return path


def by_a_link(path):
    (path.parents[1] / "linked.csv").symlink_to(path)
    return path.parents[1] / "linked.csv"


def by_a_hard_link(path):
    """Return a second name of the same file, as on file systems that ignore case."""
    (path.parents[1] / path.name.upper()).hardlink_to(path)
    return path.parents[1] / path.name.upper()


def by_a_way_around(path):
    return path.parent / ".." / path.parent.name / path.name


@pytest.mark.parametrize("called", [by_its_name, by_a_link, by_a_hard_link, by_a_way_around])
@pytest.mark.parametrize(
    "command, name",
    [
        ("run", "history.csv"),
        ("run", "phase.png"),
        ("spectrum", "spectrum.csv"),
        ("fragility", "stripes.csv"),
        ("invert", "region.csv"),
    ],
)
def test_an_input_is_not_replaced(out, capsys, nothing_computes, command, name, called):
    """An input stays even where jaxrock itself made it."""
    with ResultFolder(out).whole(name) as aside:
        aside.write_text(EXAMPLE if command == "invert" else RECORD)
    before, given = (out / name).read_text(), str(called(out / name))
    words = {"fragility": ["record.csv", given], "invert": [given]}.get(command, [given])
    assert main([command, *words, "--out", str(out)]) == 2
    assert f"{name} is an input" in capsys.readouterr().err
    assert (out / name).read_text() == before and names(out) == {name, HASH_FILE}


def test_patterns_name_inputs(out, capsys, nothing_computes):
    (out / "fragility.csv").write_text(RECORD)
    assert main(["fragility", "out/*.csv", "--out", "out"]) == 2
    assert "out/fragility.csv is an input" in capsys.readouterr().err


def test_one_command_after_the_other_into_one_folder(out, capsys):
    """Results and a film of the command's own are replaced; other files stay, even one named as a film."""
    (out / "animation.mp4").write_text("a film from the field")
    (out / "notes.txt").write_text("years of work")
    with ResultFolder(out).whole("animation.gif") as aside:
        aside.write_bytes(b"GIF89a")
    tables = []
    for scale in ("1", "0.9", "1"):
        assert main([*RUN, "record.csv", "--scale", scale, "--out", "out"]) == 0, capsys.readouterr().err
        tables.append((out / "history.csv").read_text())
        assert names(out) == {*WRITES["run"][1], "animation.mp4", "notes.txt", HASH_FILE}
    assert tables[0] == tables[2] != tables[1]
    assert (out / "animation.mp4").read_text() == "a film from the field"
    assert len((out / HASH_FILE).read_text().splitlines()) == 8  # a title, a film, four files, two of them again


def test_a_result_that_was_changed_later_is_not_replaced(out, capsys, nothing_computes):
    with ResultFolder(out).whole("history.csv") as aside:
        aside.write_text("time_s\n1\n")
    (out / "history.csv").write_text("time_s\n1 # and a word on it\n")
    assert main([*RUN, "record.csv", "--out", "out"]) == 2
    assert "out/history.csv was not made by jaxrock, or was changed since" in capsys.readouterr().err


def test_force(out):
    """`--force` replaces results, and no more; of a link the link itself, not its target."""
    for name in ("history.csv", "animation.mp4"):
        (out / name).write_text("years of work")
    (out / "impacts.csv").symlink_to("../record.csv")
    assert main([*RUN, "record.csv", "--out", "out", "--force"]) == 0
    assert (out / "history.csv").read_text().startswith("time_s") and not (out / "impacts.csv").is_symlink()
    assert (out / "animation.mp4").read_text() == "years of work"
    assert (out.parent / "record.csv").read_text() == RECORD
    assert main([*RUN, "record.csv", "--out", "out"]) == 0


def test_a_link_a_pipe_and_a_folder_are_not_replaced(out):
    (out / "link").symlink_to("nowhere")
    os.mkfifo(out / "pipe")
    (out / "folder").mkdir()
    for force in (False, True):
        with pytest.raises(FileExistsError, match=r"out/folder is a folder\. Give another --out"):
            ResultFolder(out, force=force).check(["folder"])
    for name in ("link", "pipe"):
        with pytest.raises(FileExistsError, match=f"out/{name} was not made by jaxrock"):
            ResultFolder(out).check([name])


def test_a_list_of_another_is_not_written(out):
    (out / HASH_FILE).write_text("mine")
    for force in (False, True):
        with pytest.raises(FileExistsError, match=f"{HASH_FILE} is not jaxrock's"):
            ResultFolder(out, force=force).check(["history.csv"])
    (out / HASH_FILE).unlink()
    (out / HASH_FILE).symlink_to("../rocks.csv")
    with pytest.raises(FileExistsError, match=f"{HASH_FILE} is not jaxrock's"):
        ResultFolder(out).check([])


def test_a_file_that_appears_during_the_computation_is_not_replaced(out):
    folder = ResultFolder(out)
    folder.check(["map.csv"])
    with pytest.raises(FileExistsError, match="map.csv was not made by jaxrock"), folder.whole("map.csv") as aside:
        aside.write_text("1")
        (out / "map.csv").write_text("years of work")
    assert (out / "map.csv").read_text() == "years of work"


@pytest.mark.parametrize("moment", ["before it has its name", "after"])
def test_a_killed_run_leaves_results_that_the_next_one_replaces(out, monkeypatch, moment):
    def killed(*given, **options):
        moment == "after" and move(*given, **options)
        raise KeyboardInterrupt

    folder, move = ResultFolder(out), results.move_into_place
    with folder.whole("map.csv") as aside:
        aside.write_text("first")
    monkeypatch.setattr(results, "move_into_place", killed)
    with pytest.raises(KeyboardInterrupt), folder.whole("map.csv") as aside:
        aside.write_text("second")
    monkeypatch.undo()
    assert (out / "map.csv").read_text() == ("second" if moment == "after" else "first")
    ResultFolder(out).check(["map.csv"])
    assert names(out) == {"map.csv", HASH_FILE}


def test_two_runs_at_once_know_each_others_results(out):
    first, second = ResultFolder(out), ResultFolder(out)
    with first.whole("map.csv") as one, second.whole("map.csv") as other, second.whole("map.png") as picture:
        for aside, text in ((one, "one"), (other, "other"), (picture, "picture")):
            aside.write_text(text)
    for folder in (first, second):
        folder.check(["map.csv", "map.png"])


def test_a_list_that_a_full_disk_has_cut(out):
    for name in ("map.csv", "map.png"):
        with ResultFolder(out).whole(name) as aside:
            aside.write_text(name)
    (out / HASH_FILE).write_bytes((out / HASH_FILE).read_bytes()[:-20])
    with pytest.raises(FileExistsError, match="map.png"):
        ResultFolder(out).check(["map.csv", "map.png"])
    with ResultFolder(out, force=True).whole("map.png") as aside:
        aside.write_text("anew")
    ResultFolder(out).check(["map.csv", "map.png"])


def test_half_of_the_results_are_replaced_by_the_next_run(out, monkeypatch):
    """The disk was full at one of them."""
    with monkeypatch.context() as full:
        full.setattr(
            rk.plot, "phase", lambda *_: (_ for _ in ()).throw(OSError(errno.ENOSPC, "No space left on device"))
        )
        assert main([*RUN, "record.csv", "--out", "out", "--quiet"]) == 2
    assert names(out) == {"history.csv", "impacts.csv", "history.png", HASH_FILE}
    assert main([*RUN, "record.csv", "--out", "out", "--quiet"]) == 0


@pytest.mark.parametrize("command", ["run", "spectrum", "map", "fragility", "invert"])
def test_help_tells_of_it(capsys, command):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    text = capsys.readouterr().out
    assert "--force" in text and HASH_FILE in text


# Streams


class Unwritable(io.StringIO):
    """A stream that raises on every write."""

    def __init__(self, number=errno.EPIPE):
        super().__init__()
        self.error = OSError(number, os.strerror(number))

    def flush(self):
        raise self.error


@pytest.mark.parametrize("closed", ["stdin", "stdout", "stderr"])
@pytest.mark.parametrize("more", [(), ("--json",), ("--quiet",)])
def test_a_stream_that_is_closed(tmp_path, monkeypatch, capfd, closed, more):
    """Python has no stream for `>&-`; an error is not printed to standard output instead."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, closed, None)
    assert main(["cache", *more]) == 0
    assert main(["run", "missing.AT2", *more]) == 2
    told = capfd.readouterr()
    assert "missing" not in told.out and ("missing.AT2" in told.err) == (closed != "stderr")
    assert getattr(sys, closed).name == os.devnull
    getattr(sys, closed).close()


def test_files_do_not_take_the_place_of_closed_streams(tmp_path):
    """C libraries write to descriptors 1 and 2, even if those are files."""
    code = """
import os, sys
from jaxrock.command_line.main import main
status = main(["cache"])
with open("told", "w") as file:
    print(status, *(os.readlink(f"/proc/self/fd/{n}") for n in (0, 1, 2)), file.fileno() > 2, file=file)
"""
    if not Path("/proc/self/fd").exists():
        code = code.replace('os.readlink(f"/proc/self/fd/{n}")', "os.devnull")
    subprocess.run(["sh", "-c", 'exec "$0" -c "$1" <&- >&- 2>&-', sys.executable, code], cwd=tmp_path, check=True)
    assert (tmp_path / "told").read_text().split() == ["0", *3 * [os.devnull], "True"]


@pytest.mark.parametrize("number, status", [(errno.EPIPE, 141), (errno.ENOSPC, 2)])
def test_results_are_written_where_words_cannot_be(out, monkeypatch, number, status):
    """Results that took long to compute outlast `jaxrock run | head -1`, and a full disk."""

    class Once(Unwritable):
        said = 0

        def flush(self):
            self.said += bool(self.getvalue())
            if self.said > 1:
                raise self.error

    monkeypatch.setattr(sys, "stdout", Once(number))
    assert main([*RUN, "record.csv", "--out", "out"]) == status
    assert names(out) == {*WRITES["run"][1], HASH_FILE}


@pytest.mark.parametrize("number, status", [(errno.EPIPE, 141), (errno.ENOSPC, 2)])
@pytest.mark.parametrize("words", [["--help"], ["run", "--help"], ["--version"], ["invert", "--example"]])
def test_help_that_cannot_be_printed(monkeypatch, capsys, words, number, status):
    monkeypatch.setattr(sys, "stdout", Unwritable(number))
    assert main(words) == status
    assert ("No space left" in capsys.readouterr().err) == (status == 2)


def test_errors_that_cannot_be_printed(out, monkeypatch, capsys):
    """The exit status reports the error, and the package's log, which goes to the same stream, stops nothing."""
    monkeypatch.setattr(sys, "stderr", Unwritable(errno.ENOSPC))
    assert main(["run", "missing.AT2"]) == 2
    monkeypatch.setattr(
        module.cache, "keep_compiled", lambda: __import__("logging").getLogger("jaxrock").warning("a word")
    )
    assert main([*RUN, "record.csv", "--out", "out", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["exit_status"] == 0


@pytest.mark.parametrize(
    "stream, words, said", [("2>/dev/full", "run missing.AT2", ""), (">/dev/full", "--help", "28")]
)
def test_python_complains_of_nothing_at_its_end(tmp_path, stream, words, said):
    if not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full")
    told = "import sys; from jaxrock.command_line.main import main; sys.exit(main(sys.argv[1:]))"
    shell = ["sh", "-c", f'exec "$0" -c "$1" {words} {stream}', sys.executable, told]
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run(shell, cwd=tmp_path, env=buffered, capture_output=True, text=True)
    assert done.returncode == 2 and not done.stdout
    assert done.stderr == ("jaxrock: error: [Errno 28] No space left on device\n" if said else "")
