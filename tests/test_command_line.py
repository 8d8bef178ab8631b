"""The command line: what it writes and prints, and one clear line where the input is bad."""

import argparse
import dataclasses
import errno
import io
import json
import logging
import os
import re
import subprocess
import sys
import types
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.figure
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.command_line import invert, output
from jaxrock.command_line.fragility import _entries, _write
from jaxrock.command_line.main import main
from jaxrock.command_line.options import add_pulse, each_once, extent_of, files_of, pulse_of
from jaxrock.command_line.output import Entry, heard
from jaxrock.command_line.results import HASH_FILE, ResultFolder
from jaxrock.inverse.observation_files import EXAMPLE
from jaxrock.motions.pulses import PULSES

STEPS = np.arange(60)
SAMPLES = np.round(0.5 * np.sin(0.3 * STEPS) * np.exp(-0.04 * STEPS), 5)  # g
AT2 = (
    "PEER STRONG MOTION DATABASE RECORD\nACCELERATION TIME SERIES IN UNITS OF G\nNPTS=  60, DT= .02 SEC\n"
    + "\n".join("".join(f"{a:15.7E}" for a in row) for row in SAMPLES.reshape(-1, 5))
)
BLOCK = rk.Block.from_dimensions(0.6, 3.0)
# With the same kinds of options, all runs on the file compile once.
GIVEN = ("--restitution", "0.9", "--model", "linear", "--duration", "4")
ENDLESS = ("--restitution", "1", "--model", "linear", "--duration", "1e6")  # impacts never die out


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


@pytest.fixture
def undrawn(monkeypatch):
    """Figures are made, and their files are empty: of tests that look at none."""
    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", lambda self, path, **_: Path(path).touch())


@pytest.fixture
def at2(tmp_path):
    path = tmp_path / "motion.AT2"
    path.write_text(AT2)
    return str(path)


@pytest.fixture
def column(tmp_path):
    """Return a file with the record as a column of cm/s2."""
    path = tmp_path / "motion.csv"
    path.write_text("acceleration\n" + "".join(f"{float(a) * 980.665!r}\n" for a in SAMPLES))
    return str(path)


@pytest.fixture
def command(tmp_path, capsys):
    """Run a command; return its exit status, its table as a dictionary (its title as `title`), and its error stream."""

    def run(*words):
        capsys.readouterr()
        status = main([*map(str, words), "--out", str(tmp_path / "out")])
        printed = capsys.readouterr()
        first, *lines = printed.out.splitlines()
        title, rest = ("", [first, *lines]) if first.startswith("  ") else (first, lines)
        rows = (re.split(r"\s{2,}", line.strip()) for line in rest if line.startswith("  "))
        return status, {"title": title} | {row[0]: row[1] for row in rows}, printed.err

    return run


def table_of(path):
    """Header and numbers of a CSV file."""
    header, *rows = path.read_text().splitlines()
    return header.split(","), np.array([[float(x) for x in row.split(",")] for row in rows])


def is_figure(path):
    return path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and path.stat().st_size > 5000


def test_run_on_the_built_in_record(command, tmp_path):
    status, table, errors = command("run")
    record = rk.example_record()
    result, response = rk.outcome(BLOCK, record), rk.simulate(BLOCK, record)
    assert status == 0 and errors == ""
    assert table["title"] == record.name
    assert table["peak ground acceleration"] == "0.3110"
    assert table["block, width x height"] == "0.6 x 3"
    assert table["slenderness alpha"] == "0.1974"
    assert table["frequency parameter p"] == f"{float(BLOCK.p):.4f}"
    assert table["restitution"] == f"{1 - 1.5 * 0.04 / 1.04:.4f}"
    assert table["uplift threshold"] == "0.2000"
    assert table["impacts during the motion, above 1e-6 alpha"] == str(result.large_impact_count)
    assert table["with hops down to rounding"] == str(result.impact_count)
    assert result.large_impact_count < result.impact_count
    assert table["peak rotation"] == f"{float(result.max_rotation):.6f}"
    assert table["at time"] == f"{float(result.time_of_max):.4f}"
    assert table["peak angular velocity"] == f"{float(result.max_velocity):.6f}"
    assert table["margin (0: boundary)"] == f"{float(result.margin):+.4f}"
    assert table["verdict"] == "stands"
    header, history = table_of(tmp_path / "out" / "history.csv")
    assert header == ["time_s", "rotation_rad", "velocity_rad_per_s"]
    np.testing.assert_allclose(history, np.stack([response.time, response.rotation, response.velocity], 1), rtol=1e-11)
    header, impacts = table_of(tmp_path / "out" / "impacts.csv")
    assert header == ["time_s", "velocity_before_rad_per_s"]
    np.testing.assert_allclose(impacts, np.stack([response.impact_times, response.impact_velocities], 1), rtol=1e-11)
    assert is_figure(tmp_path / "out" / "history.png") and is_figure(tmp_path / "out" / "phase.png")


def test_run_on_files(command, at2, column, tmp_path):
    """Compare the tables of one record as AT2 in g and as a column in cm/s2."""
    status, table, errors = command("run", at2, *GIVEN)
    assert status == 0 and errors == ""
    assert table["title"] == "motion"
    assert table["uplift threshold"] == f"{np.arctan(0.2):.4f}"
    assert table["peak ground acceleration"] == f"{np.abs(SAMPLES).max():.4f}"
    assert table["verdict"] == "stands"
    assert float(table["peak rotation / alpha"]) > 0
    again = command("run", column, "--dt", "0.02", "--unit", "cm/s2", *GIVEN)
    assert again == (0, table, "")
    _, history = table_of(tmp_path / "out" / "history.csv")
    assert history[-1, 0] == 4.0


def test_run_of_a_block_that_overturns(command, at2, tmp_path, monkeypatch):
    # It has overturned after half a second: a short film, of few pictures.
    animate = rk.plot.animate
    monkeypatch.setattr(rk.plot, "animate", lambda response, block, fps: animate(response, block, fps=min(fps, 3)))
    status, table, _ = command("run", at2, *GIVEN, "--duration", "0.5", "--scale", "30", "--animate")
    assert status == 0
    assert (tmp_path / "out" / "animation.gif").read_bytes().startswith(b"GIF89a")
    assert table["verdict"] == "OVERTURNS"
    assert table["restitution"] == "0.9000"
    assert table["peak rotation"] == table["peak angular velocity"] == "overturned"
    assert float(table["margin (0: boundary)"]) < 0


def test_run_of_a_block_that_never_moves(command, at2, tmp_path):
    """A film of an earlier run, of whatever kind, is not left beside its results."""
    film = tmp_path / "out" / "animation.mp4"
    with ResultFolder(film.parent).whole(film.name) as aside:
        aside.touch()
    status, table, _ = command("run", at2, *GIVEN, "--scale", "0.1")
    assert status == 0 and not film.exists()
    assert (table["verdict"], table["with hops down to rounding"], table["peak rotation"]) == (
        "stands",
        "0",
        "0.000000",
    )
    assert (tmp_path / "out" / "impacts.csv").read_text() == "time_s,velocity_before_rad_per_s\n"


@pytest.mark.parametrize("words", [(), ("--json",)])
def test_no_film_of_a_block_that_never_moves(words, at2, tmp_path, capsys, monkeypatch, undrawn):
    """It says so at once; a film of an earlier run, which would be overwritten, is not left beside these results."""
    monkeypatch.setattr(rk.plot, "animate", lambda *_, **__: pytest.fail("draws a block that stands still"))
    film = tmp_path / "out" / "animation.gif"
    with ResultFolder(film.parent).whole(film.name) as aside:
        aside.write_bytes(b"GIF89a of a block that rocks")
    assert main(["run", at2, *GIVEN, "--scale", "0.1", "--animate", "--out", str(film.parent), *words]) == 0
    printed = capsys.readouterr().out
    assert not film.exists() and str(film) not in printed
    if words:
        assert json.loads(printed)["results"]["overturned"] is False
    else:
        assert printed.splitlines()[-1] == "no film: the block never uplifts"


def test_impacts_of_a_history_that_is_shorter(command, at2, tmp_path, undrawn):
    """The table counts those of the motion, and those in the file beside them."""
    words = ("run", at2, *GIVEN, "--duration", "0.01")
    _, table, _ = command(*words)
    assert int(table["impacts during the motion, above 1e-6 alpha"]) > 0
    assert table["with these in 0.01 s of history"] == "0"
    assert (tmp_path / "out" / "impacts.csv").read_text().count("\n") == 1


class Unwritable(io.StringIO):
    """A stream that raises on every write."""

    def __init__(self, error):
        super().__init__()
        self.error = error

    def flush(self):
        raise self.error


@pytest.mark.parametrize("words", [["cache"], ["cache", "--json"]])
@pytest.mark.parametrize(
    "error, status, said",
    [
        (BrokenPipeError(errno.EPIPE, "Broken pipe"), 141, ""),
        (OSError(errno.ENOSPC, "No space left on device"), 2, "jaxrock: error: [Errno 28] No space left on device\n"),
    ],
)
def test_output_that_cannot_be_written(monkeypatch, capsys, words, error, status, said):
    """At once, or at the end of what is said; nothing is left for Python to complain of."""
    monkeypatch.setattr(sys, "stdout", Unwritable(error))
    assert main(words) == status
    assert capsys.readouterr().err == said


@pytest.mark.parametrize("kind", ["table", "figure"])
def test_a_file_is_there_whole_or_not_at_all(monkeypatch, tmp_path, kind):
    """The disk is full in the middle of it; the message says of which."""

    def half(file, *_, **__):
        Path(file).write_text("0.1,")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savetxt", half)
    figure, given = types.SimpleNamespace(savefig=half), (output.Report("map", quiet=True), ResultFolder(tmp_path))
    with pytest.raises(OSError, match=r"map.png cannot be written: No space left on device"):
        output.write_table(*given, "map.png", "x", [1.0]) if kind == "table" else output.save(*given, "map.png", figure)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_is_found_before_the_work(monkeypatch, capsys, at2, tmp_path):
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setattr(rk, "simulate", None)
    assert main(["run", at2, "--out", str(tmp_path / "new" / "folder")]) == 2
    assert "Argument `--out` must be a folder that can be written" in capsys.readouterr().err


def test_run_that_cannot_be_completed(command, at2):
    """Impacts that never die out: exit status 1, and the reason."""
    status, table, errors = command("run", at2, *ENDLESS)
    assert status == 1
    assert re.fullmatch(r"jaxrock: these are not results: The step budget was used up .*\n", errors)


@pytest.mark.parametrize("kind", ["chaotic", "undecided"])
def test_run_of_a_chaotic_scene(kind, at2, tmp_path, capsys, monkeypatch, undrawn):
    """A verdict that holds is a result, with the error of its peak; of an open one the share is told."""
    computed = rk.outcome
    numbers = {"known_until": 1.5, "error": 0.01, "overturned_share": 0.4}
    changes = {"status": getattr(rk.Status, kind)} | jax.tree.map(jnp.asarray, numbers)
    monkeypatch.setattr(rk, "outcome", lambda *given: dataclasses.replace(computed(*given), **changes))
    status = main(["run", at2, *GIVEN, "--out", str(tmp_path / "out")])
    printed = capsys.readouterr()
    assert re.search(r"one of many motions after +1\.50  s", printed.out)
    chaotic = kind == "chaotic"
    for said in (r"\nThe verdict holds, but the peak is known only", r"known to a standard error of +0\.010000  rad"):
        assert bool(re.search(said, printed.out)) == chaotic
    assert bool(re.search(r"share of possible motions that overturns +0\.40", printed.out)) != chaotic
    assert status == (0 if chaotic else 1)
    assert printed.err == "" if chaotic else printed.err.startswith("jaxrock: these are not results: Too close to call")


def test_fragility(command, column, tmp_path):
    """Compare the fragility of two records with the library's table."""
    other = tmp_path / "other.csv"
    other.write_text("acceleration\n" + "".join(f"{float(a) * 980.665!r}\n" for a in SAMPLES[::-1]))
    words = ["--unit", "cm/s2", "--dt", "0.02", "--levels", "0.2", "6", "--points", "10", "--model", "linear"]
    words += ["--scatter", "0.4", "--draws", "6", "--width", "0.4", "--height", "1.2"]
    status, table, errors = command("fragility", column, other, *words)
    levels = np.geomspace(0.2, 6.0, 10)
    blocks = rk.blocks.draw_blocks(rk.Block.from_dimensions(0.4, 1.2), 6, alpha=0.4)
    found = rk.hazard.simulated_fragility(
        blocks, [rk.Record(x, 0.02) for x in (SAMPLES, SAMPLES[::-1])], levels, rk.Linear()
    )
    _, rows = table_of(tmp_path / "out" / "fragility.csv")
    np.testing.assert_allclose(rows[:, 1], found.lower)
    assert (tmp_path / "out" / "stripes.csv").read_text().count("\n") == 21
    assert is_figure(tmp_path / "out" / "fragility.png")
    fit = found.fit("upper")
    assert (
        (status == 0) == (fit.status == rk.hazard.FitStatus.successful) == (tmp_path / "out" / "fragility.xml").exists()
    )
    assert status == 0 and f"{float(fit.fragility.median):.4f}" in table["median PGA"]
    assert table["pairs of motion and block that stand again at a higher level"] == str(int((~found.monotone).sum()))
    assert " to ".join(f"{end:.3f}" for end in found.intervals().dispersion) == table["95 % interval of the dispersion"]
    words[words.index("6")] = "0.21"  # none topples: no fit, and none of the run before in its place
    assert command("fragility", column, other, *words)[0] == 1
    assert not (tmp_path / "out" / "fragility.xml").exists()


def test_errors_of_one_record_are_not_known():
    """Check that errors are unknown from one record: it says nothing of others, whatever its blocks did."""
    levels = jnp.geomspace(0.2, 6.0, 10)
    verdict = (np.arange(10)[:, None] > np.array([2, 5, 8])).astype(np.int8)[None]
    found = rk.hazard.SimulatedFragility(levels, verdict, *jnp.ones((2, 1)), ("a",), "PGA")
    entries = {entry.label: entry for entry in _entries(found, {"lower": found.fit()})}
    errors = entries["standard errors of their logarithms"]
    assert errors.text == "not known" and output.plain(errors.value) == [None, None]
    assert not any("interval" in label for label in entries) and float(entries["median PGA"].text) > 0


def test_patterns_that_no_shell_has_expanded(tmp_path):
    names = [str(tmp_path / name) for name in ("a.AT2", "b.AT2", "[c].AT2")]
    for name in names:
        Path(name).touch()
    assert files_of([str(tmp_path / "?.AT2")]) == names[:2]
    assert files_of([names[2], "missing.AT2"]) == [names[2], "missing.AT2"]
    with pytest.raises(ValueError, match=r"Pattern '\*.none' matches no file"):
        files_of([names[2], "*.none"])


def test_spectral_velocities_are_not_written_for_openquake(tmp_path, monkeypatch, capsys):
    """Check that the command refuses spectral velocities, which OpenQuake does not know, and writes all other files."""
    monkeypatch.setattr(rk.plot, "fragility", lambda *_: types.SimpleNamespace(figure=plt.figure()))
    found = rk.hazard.SimulatedFragility(
        jnp.array([0.1, 0.2]), np.zeros((1, 2, 1), np.int8), *jnp.ones((2, 1)), ("a",), "SV(0.5)", np.ones(1)
    )
    report = output.Report("fragility")
    _write(report, argparse.Namespace(out=ResultFolder(tmp_path)), found, rk.hazard.LogNormalFragility(0.3, 0.4))
    assert "no fragility.xml: OpenQuake knows no SV(0.5)" in capsys.readouterr().out
    assert {path.name for path in tmp_path.iterdir()} == {"fragility.csv", "stripes.csv", "fragility.png", HASH_FILE}


def test_no_unexceeded_motion_of_an_earlier_run(tmp_path, monkeypatch):
    """Where all rocks toppled there is none."""
    monkeypatch.setattr(rk.plot, "feasible_region", lambda *_: types.SimpleNamespace(figure=plt.figure()))
    one = np.ones(1)
    observations = types.SimpleNamespace(
        blocks=types.SimpleNamespace(alpha=one, p=one), other=None, names=("Mój",), seen=np.ones(1, int)
    )
    estimate = types.SimpleNamespace(
        names=("amplitude",), values=one, interval=[[0, 2]], open=[[False, False]], probability=one
    )
    region = types.SimpleNamespace(values=(one, one), names=("amplitude", "period"), log_likelihood=one, allowed=one)
    with ResultFolder(tmp_path).whole("unexceeded.csv") as aside:
        aside.write_text("of an earlier run")
    files = invert._write(ResultFolder(tmp_path), observations, estimate, region, None)
    assert sorted([tmp_path / HASH_FILE, *files]) == sorted(tmp_path.iterdir())


def test_spectrum(command, column, tmp_path):
    described = ("--dt", "0.02", "--unit", "cm/s2", "--restitution", "0.9", "--model", "linear")
    status, table, errors = command("spectrum", column, *described, "--shortest", 1, "--longest", 4, "--points", 5)
    assert status == 0 and errors == ""
    assert (table["block sizes"], table["not computed"]) == ("5", "0")
    header, rows = table_of(tmp_path / "out" / "spectrum.csv")
    assert header == ["two_pi_over_p_s", "rotation_ratio", "velocity_ratio", "impacts", "overturned", "margin"]
    np.testing.assert_allclose(rows[:, 0], [1, 1.75, 2.5, 3.25, 4])
    assert table["of these overturn"] == str(int(rows[:, 4].sum()))
    alpha = np.arctan(0.2)
    for period, rotation, velocity, impacts, lost, margin in rows:
        p = 2 * np.pi / period
        result = rk.outcome(rk.Block(alpha, p, 0.9), rk.Record(SAMPLES, 0.02, "motion"), rk.Linear())
        assert (impacts, lost) == (result.impact_count, result.overturned)
        expected = [result.max_rotation / alpha, result.max_velocity / (p * alpha), result.margin]
        np.testing.assert_allclose([rotation, velocity, margin], expected, rtol=1e-7)
    assert is_figure(tmp_path / "out" / "spectrum.png")


def test_scenes_without_a_result_are_no_results(command, column, tmp_path, monkeypatch):
    """Neither counted as overturned nor written; what became of them is said."""
    computed = rk.rocking_spectrum

    def partly(*given, **settings):
        result, failed = computed(*given, **settings), jnp.arange(5) < 2
        status = jax.vmap(lambda bad, kind: rk.Status.where(bad, rk.Status.undecided, kind))(failed, result.status)
        parts = status, result.overturned | failed
        return eqx.tree_at(lambda x: (x.status, x.overturned), result, parts)

    described = ("--dt", "0.02", "--unit", "cm/s2", "--restitution", "0.9", "--model", "linear")
    given = (column, *described, "--shortest", 1, "--longest", 4, "--points", 5)
    monkeypatch.setattr(rk, "rocking_spectrum", partly)
    status, table, errors = command("spectrum", *given)
    assert status == 1 and errors.startswith("jaxrock: 2 scenes were not computed: Too close to call")
    assert (table["of these overturn"], table["not computed"]) == ("0", "2")
    _, rows = table_of(tmp_path / "out" / "spectrum.csv")
    np.testing.assert_array_equal(np.isnan(rows).sum(axis=1), [5, 5, 0, 0, 0])


def test_chaotic_scenes_are_results(command, column, tmp_path, monkeypatch):
    """Their verdicts count, and their peaks are written."""
    computed = rk.rocking_spectrum

    def chaotic(*given, **settings):
        result = computed(*given, **settings)
        kinds = jax.vmap(lambda kind: rk.Status.where(True, rk.Status.chaotic, kind))(result.status)
        return eqx.tree_at(lambda x: x.status, result, kinds)

    monkeypatch.setattr(rk, "rocking_spectrum", chaotic)
    status, table, errors = command("spectrum", column, *DESCRIBED, *FIVE)
    assert status == 0 and errors == "" and table["not computed"] == "0"
    _, rows = table_of(tmp_path / "out" / "spectrum.csv")
    assert not np.isnan(rows).any()


DESCRIBED = ("--dt", "0.02", "--unit", "cm/s2", "--restitution", "0.9", "--model", "linear")
FIVE = ("--shortest", 1, "--longest", 4, "--points", 5)
OF_AT2 = ("--restitution", "0.9", "--model", "linear", *FIVE)


@pytest.fixture
def records(tmp_path):
    """Return a folder of three records, one in a folder of its own, with files that are none."""
    folder = tmp_path / "records"
    (folder / "inner").mkdir(parents=True)
    for name, factor in (("a.AT2", 1.0), ("b.at2", 0.5), ("inner/c.AT2", 2.0)):
        head, numbers = AT2.split("DT= .02 SEC\n")
        rows = ("".join(f"{factor * float(x):15.7E}" for x in line.split()) for line in numbers.splitlines())
        (folder / name).write_text(head + "DT= .02 SEC\n" + "\n".join(rows))
    (folder / "README.md").write_text("no record")
    (folder / ".hidden.AT2").write_text("no record")
    return folder


def rows_of(path):
    """Return the header, and the rows by record, of the table of a suite."""
    header, *rows = (line.split(",") for line in path.read_text().splitlines())
    found = {}
    for name, *numbers in rows:
        found.setdefault(name, []).append([float(x) for x in numbers])
    return header, {name: np.array(each) for name, each in found.items()}


def test_spectra_of_several_records(command, records, tmp_path):
    """A row a record and size, the same as each record's own table; one picture."""
    given = (records, str(records / "inner" / "*.AT2"), records / "a.AT2")
    status, table, errors = command("spectrum", *given, *OF_AT2)
    assert status == 0 and errors == "" and table["title"] == "3 records"
    assert (table["scenes"], table["files that could not be read"], table["not computed"]) == ("15", "0", "0")
    assert table["files of folders without an ending of records"] == "1"
    header, found = rows_of(tmp_path / "out" / "spectrum.csv")
    assert header[:2] == ["record", "two_pi_over_p_s"] and list(found) == ["a.AT2", "b.at2", "c.AT2"]
    assert is_figure(tmp_path / "out" / "spectrum.png")
    lost = np.array([rows[:, 4] for rows in found.values()])
    assert table["of these overturn"] == str(int(lost.sum()))
    for name, rows in found.items():
        (path,) = records.rglob(name)
        status, *_ = command("spectrum", path, *OF_AT2)
        _, own = table_of(tmp_path / "out" / "spectrum.csv")
        assert status == 0
        np.testing.assert_allclose(rows, own, rtol=1e-9)


def test_a_file_that_cannot_be_read_is_named(command, capsys, records, column, tmp_path, undrawn):
    """The others go on; a file without a unit, one of another unit than is said, and one that does not move count."""
    (records / "still.csv").write_text("time [s],acceleration [g]\n" + "".join(f"{0.01 * k:g},0\n" for k in range(9)))
    given = (records, column, records / "missing.AT2")
    status, table, errors = command("spectrum", *given, *OF_AT2)
    said = [line for line in errors.splitlines() if " was not read: " in line]
    assert status == 1 and len(said) == 3 and table["title"] == "2 records"
    assert table["files that could not be read"] == "3"
    for name, reason in (
        ("still.csv", "must move the ground"),
        ("motion.csv", "but is not given"),
        ("missing.AT2", "No such"),
    ):
        assert any(name in line and reason in line for line in said), said
    _, found = rows_of(tmp_path / "out" / "spectrum.csv")
    assert list(found) == ["a.AT2", "b.at2"]
    status, table, errors = command("spectrum", records / "a.AT2", column, *DESCRIBED, *FIVE)
    assert status == 1 and table["title"] == "1 records" and "a.AT2 was not read: " in errors and "'cm/s2'" in errors
    for words, told in (
        ((*given, "--strict"), "error: .*still.csv was not read: Argument"),
        ((records / "README.md", records / "missing.AT2"), "error: None of 2 files could be read"),
    ):
        assert main([*map(str, ("spectrum", *words, *OF_AT2)), "--out", str(tmp_path / "other")]) == 2
        printed = capsys.readouterr()
        assert re.search(told, printed.err) and printed.out == "" and not (tmp_path / "other").exists()
        assert "missing.AT2" not in printed.err or "None of" in told


def test_records_with_one_name_are_told_apart_by_their_paths(command, records, tmp_path, undrawn):
    (records / "inner" / "a.AT2").write_text((records / "inner" / "c.AT2").read_text())
    given = (records / "a.AT2", records / "inner" / "a.AT2")
    assert command("spectrum", *given, *OF_AT2)[0] == 0
    _, found = rows_of(tmp_path / "out" / "spectrum.csv")
    assert list(found) == [str(path) for path in given]


def test_files_are_listed_once(records, monkeypatch):
    monkeypatch.chdir(records)
    assert each_once(files_of(["b.at2", ".", "./b.at2", "missing.AT2"])) == ["b.at2", "a.AT2", "missing.AT2"]
    assert each_once(files_of(["inner/*", "*.AT2"])) == ["inner/c.AT2", "a.AT2"]


def check_map(folder, points):
    """A map's file agrees with itself; return the states."""
    header, rows = table_of(folder / "map.csv")
    assert header == ["frequency_ratio", "intensity", "state", "rotation_ratio", "impacts", "margin"]
    ratio, intensity, state, rotation, impacts, margin = rows.T
    assert rows.shape == (points**2, 6)
    np.testing.assert_allclose(np.unique(ratio), np.linspace(0.3, 8.0, points), rtol=1e-11)
    np.testing.assert_allclose(np.unique(intensity), np.linspace(1.02, 10.0, points), rtol=1e-11)
    np.testing.assert_array_equal(state > 0, margin < 0)
    np.testing.assert_array_equal(state > 0, np.isinf(rotation))
    np.testing.assert_array_equal(state == 2, (margin < 0) & (impacts > 0))
    # Long and strong pulses overturn; the shortest and weakest do not.
    assert state[(ratio == ratio.min()) & (intensity == intensity.max())] == 1
    assert state[(ratio == ratio.max()) & (intensity == intensity.min())] == 0
    assert is_figure(folder / "map.png")
    return state


def test_map(command, tmp_path):
    given = ("--pulse", "exponential", "--shape", "0.5", "--model", "linear")  # as below: they compile once
    status, table, errors = command("map", "--points", "8", *given)
    assert status == 0 and errors == ""
    state = check_map(tmp_path / "out", 8)
    names = {"safe": 0, "overturned without impact": 1, "overturned after impacts": 2, "not computed": -1}
    assert {name: int(table[name]) for name in names} == {
        name: np.count_nonzero(state == value) for name, value in names.items()
    }


def test_map_of_a_pulse_with_more_parameters(command, tmp_path):
    status, _, errors = command("map", "--points", "4", "--pulse", "exponential", "--shape", "0.5", "--model", "linear")
    assert status == 0 and errors == ""
    _, rows = table_of(tmp_path / "out" / "map.csv")
    expected = rk.overturning_map(
        np.linspace(0.3, 8.0, 4),
        np.linspace(1.02, 10.0, 4),
        pulse=lambda amplitude, duration: rk.ExponentialPulse(amplitude, duration, 0.5),
        model=rk.Linear(),
    )
    np.testing.assert_allclose(rows[:, 5], np.ravel(expected.margin), rtol=1e-11)


def test_map_of_a_lobe(command, tmp_path):
    """Check a map over pulse duration and uplift strength: overturned below the closed form's wall, safe above."""
    words = ["--uplift-strength", "0.1", "0.9", "--pulse-duration", "0.5", "6", "--model", "linear"]
    status, _, errors = command("map", "--points", "7", "--pulse", "exponential", "--shape", "0.5", *words)
    assert status == 0 and errors == ""
    header, rows = table_of(tmp_path / "out" / "map.csv")
    assert header[:3] == ["pulse_duration", "uplift_strength", "state"] and is_figure(tmp_path / "out" / "map.png")
    duration, strength, state = rows[:, :3].T
    np.testing.assert_allclose(np.unique(duration), np.linspace(0.5, 6, 7), rtol=1e-11)
    np.testing.assert_allclose(np.unique(strength), np.linspace(0.1, 0.9, 7), rtol=1e-11)
    wall = np.asarray(rk.closed_form.single_lobe.safety_wall(duration, 0.5))
    np.testing.assert_array_equal(state > 0, strength < wall)
    assert 10 < (state > 0).sum() < 40


@pytest.mark.parametrize("pulse", PULSES)
def test_every_pulse_has_its_words(pulse):
    """Check that every pulse is made from words; settings without words take their defaults, or a shape of 0."""
    parser = argparse.ArgumentParser()
    add_pulse(parser)
    motion = pulse_of(parser.parse_args(["--pulse", pulse]))(0.5, 1.0)
    assert type(motion) is PULSES[pulse]
    assert float(motion.amplitude) == 0.5 and float(getattr(motion, extent_of(type(motion)))) == 1.0
    assert pulse != "exponential" or motion.shape == 0
    assert pulse != "mavroeidis-papageorgiou" or (motion.oscillations, motion.phase) == (2, 0)


def test_parameters_of_pulses_are_options():
    parser = argparse.ArgumentParser()
    add_pulse(parser)
    given = ["--pulse", "ricker", "--kind", "antisymmetric", "--center", "3"]
    motion = pulse_of(parser.parse_args(given))(0.5, 1.0)
    assert (motion.kind, float(motion.center)) == ("antisymmetric", 3.0)
    assert "--throw" not in parser.format_help()  # which is no parameter


@pytest.mark.parametrize(
    "words, mentioned",
    [
        ([], ["run", "spectrum", "map", "critical", "fragility", "examples:"]),
        (["run"], ["--width", "--height", "--duration", "--dt", "--unit", "--column", "--scale", "--restitution"]),
        (["spectrum"], ["--slenderness", "--shortest", "--longest", "--points", "--model", "--out"]),
        (
            ["map"],
            [
                "--pulse",
                *PULSES,
                "--shape",
                "--alpha",
                "--frequency-ratio",
                "--intensity",
                "--points",
                "--pulse-duration",
                "--uplift-strength",
            ],
        ),
        (["critical"], ["--width", "--height", "--range", "--narrowest", "--dt", "--scale", "--restitution", "--out"]),
        (["invert"], ["--pulse", *PULSES, "--shape", "--amplitude", "--scatter", "--prior", "--starts", "--points"]),
    ],
    ids=["jaxrock", "run", "spectrum", "map", "critical", "invert"],
)
@pytest.mark.parametrize("option", ["--help", "-h"])
def test_help(capsys, words, mentioned, option):
    with pytest.raises(SystemExit) as stopped:
        main([*words, option])
    assert stopped.value.code == 0
    text = capsys.readouterr().out
    assert text.startswith("usage: jaxrock")
    assert all(word in text for word in mentioned)


FILE = ["run", "motion.txt", "--unit", "g", "--dt", "0.02"]
BAD = {
    "missing file": (["run", "missing.AT2"], r"No such file or directory: '\S*missing.AT2'"),
    "folder": (["run", "."], "Is a directory"),
    "no numbers": (["run", "words.txt"], "File `words.txt`: no line holds columns of numbers"),
    "no unit": (["run", "motion.txt", "--dt", "0.02"], "Argument `--unit` must be 'g', .*, but is not given"),
    "wrong unit": (
        [*FILE, "--unit", "ft/s2"],
        "Argument `--unit` must be one of 'g', 'm/s2', 'cm/s2', 'mm/s2', but is 'ft/s2'",
    ),
    "no dt": (["run", "motion.txt", "--unit", "g"], "Argument `--dt` must be given .*, but is not given"),
    "dt 0": ([*FILE, "--dt", "0"], "Argument `--dt` must be positive and finite, .*, but is 0.0"),
    "dt negative": ([*FILE, "--dt", "-0.01"], "Argument `--dt` must be positive and finite, .*, but is -0.01"),
    "dt NaN": ([*FILE, "--dt", "nan"], "Argument `--dt` must be positive and finite, .*, but is nan"),
    "column 3": ([*FILE, "--column", "3"], "Argument `--column` must be 0 to 0, .*, but is 3"),
    "column -1": ([*FILE, "--column", "-1"], "Argument `--column` must be a whole number, at least 0, but is -1"),
    "dt without file": (["run", "--dt", "0.01"], "Option --dt describes a file, but no RECORD is given"),
    "unit without file": (["spectrum", "--unit", "g"], "Option --unit describes a file, but no RECORD is given"),
    "width negative": (["run", "--width", "-0.6"], "Argument `--width` must be positive and finite, .*, but is -0.6"),
    "width 0": (["run", "--width", "0"], "Argument `--width` must be positive and finite, .*, but is 0.0"),
    "height NaN": (["run", "--height", "nan"], "Argument `--height` must be positive and finite, .*, but is nan"),
    "stocky": (["run", "--width", "6"], "Argument `alpha` must be at most 0.955"),
    "restitution 2": (["run", "--restitution", "2"], r"Argument `--restitution` must be in \[0, 1\], but is 2.0"),
    "duration 0": (["run", "--duration", "0"], "Argument `--duration` must be positive and finite, .*, but is 0.0"),
    "scale NaN": (["run", "--scale", "nan"], "Argument `--scale` must be finite, but is nan"),
    "fragility, missing file": (["fragility", "missing.AT2"], "No such file or directory"),
    "fragility, one file twice": (
        ["fragility", "motion.txt", "motion.txt", "--unit", "g", "--dt", "0.02"],
        "Argument `motions` must hold each motion once, but 'motion 1' and 'motion 2' are the same",
    ),
    "fragility, levels": (["fragility", "a", "--levels", "2", "1"], "`--levels` must be positive, finite and in order"),
    "fragility, points 2": (["fragility", "a", "--points", "2"], "Argument `--points` must be at least 3, but is 2"),
    "spectrum, missing file": (["spectrum", "missing.AT2"], "No such file or directory"),
    "spectrum, empty pattern": (["spectrum", "nothing*.AT2"], r"Pattern 'nothing\*.AT2' matches no file"),
    "spectrum, empty folder": (["spectrum", "empty"], "Folder 'empty' holds no file with an ending of records: .acc"),
    "fragility, empty folder": (["fragility", "empty"], "Folder 'empty' holds no file with an ending of records"),
    "spectrum, points 0": (["spectrum", "--points", "0"], "Argument `--points` must be at least 1, but is 0"),
    "spectrum, slenderness 0": (
        ["spectrum", "--slenderness", "0"],
        "Argument `--slenderness` must be positive, but is 0.0",
    ),
    "spectrum, restitution 2": (["spectrum", "--restitution", "2"], "Argument `--restitution` must be in"),
    "spectrum, shortest 0": (["spectrum", "--shortest", "0"], "`--shortest, --longest` must be positive, finite"),
    "spectrum, order": (["spectrum", "--shortest", "9"], "must be positive, finite and in order, but is 9 to 8"),
    "spectrum, longest NaN": (
        ["spectrum", "--longest", "nan"],
        "must be positive, finite and in order, but is 0.5 to nan",
    ),
    "spectrum, longest inf": (["spectrum", "--longest", "inf"], "must be .*finite.*inf"),
    "critical, missing file": (["critical", "missing.AT2"], "No such file or directory"),
    "critical, width 0": (["critical", "--width", "0"], "Argument `--width` must be positive"),
    "critical, restitution 2": (["critical", "--restitution", "2"], "Argument `--restitution` must be in"),
    "critical, reversed": (["critical", "--range", "2", "1"], "`--range` must be positive, .* in order, but is 2 to 1"),
    "critical, no range": (["critical", "--range", "2", "2"], "Argument `--range` must be rising, but is 2 to 2"),
    "critical, range NaN": (["critical", "--range", "nan", "2"], "`--range` must be positive, finite"),
    "critical, narrowest -1": (
        ["critical", "--narrowest", "-1"],
        "`--narrowest` must be 0 or more and finite, but is -1",
    ),
    "critical, narrowest NaN": (["critical", "--narrowest", "nan"], "`--narrowest` must be 0 or more and finite"),
    "critical, still ground": (["critical", "--scale", "0"], "The record must move the ground, but its peak is 0 g"),
    "map, points 0": (["map", "--points", "0"], "Argument `--points` must be at least 2, but is 0"),
    "map, points 1": (["map", "--points", "1"], "Argument `--points` must be at least 2, but is 1"),
    "map, restitution 2": (["map", "--restitution", "2"], r"Argument `--restitution` must be in \[0, 1\], but is 2.0"),
    "invert, shape of a sine": (
        ["invert", "rocks.csv", "--pulse", "sine", "--shape", "0", "1"],
        "Argument `--shape` is not a parameter of the pulse sine",
    ),
    "invert, amplitudes in no order": (
        ["invert", "rocks.csv", "--amplitude", "3", "1"],
        "Argument `--amplitude` must be positive, finite and in order, but is 3 to 1",
    ),
    "invert, prior below 0": (
        ["invert", "rocks.csv", "--prior", "amplitude", "-1", "0.2"],
        "Argument `--prior` must end with a positive median and deviation, but is amplitude -1 0.2",
    ),
    "map, shape of a sine": (["map", "--shape", "1"], "Argument `--shape` is not a parameter of the pulse sine"),
    "map, alpha 2": (["map", "--alpha", "2"], r"Argument `--alpha` must be in \(0, pi/2\), .*, but is 2.0"),
    "map, ratio from 0": (
        ["map", "--frequency-ratio", "0", "8"],
        "`--frequency-ratio` must be positive, finite and in order, but is 0 to 8",
    ),
    "map, intensity negative": (
        ["map", "--intensity", "-1", "8"],
        "`--intensity` must be positive, finite and in order, but is -1 to 8",
    ),
    "map, two names of axes": (
        ["map", "--frequency-ratio", "1", "8", "--uplift-strength", "0.1", "0.9"],
        "Options --frequency-ratio, --uplift-strength must not go together",
    ),
    "map, strength from 0": (["map", "--uplift-strength", "0", "1"], "Argument `--uplift-strength` must be positive"),
    "map, ratio to inf": (["map", "--frequency-ratio", "1", "inf"], "must be .*finite.*inf"),
    "map, intensity to inf": (["map", "--intensity", "1", "inf"], "must be .*finite.*inf"),
}


@pytest.mark.parametrize("words, error", BAD.values(), ids=BAD)
def test_bad_input(tmp_path, monkeypatch, capsys, words, error):
    """Exit status 2, one line on the error stream, nothing else printed, nothing written."""
    (tmp_path / "motion.txt").write_text("".join(f"{a}\n" for a in SAMPLES))
    (tmp_path / "words.txt").write_text("shaken, not stirred\n")
    (tmp_path / "rocks.csv").write_text(EXAMPLE)
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    printed = capsys.readouterr()
    assert re.fullmatch(rf"jaxrock: error: .*{error}.*\n", printed.err)
    assert printed.out == ""
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(
    "words, error",
    [
        ([], "the following arguments are required: COMMAND"),
        (["rock"], "invalid choice: 'rock'"),
        (["sepctrum"], "Did you mean 'spectrum'?"),
        (["map", "--points", "many"], "argument --points: invalid int value: 'many'"),
        (["map", "--pulse", "wave"], "argument --pulse: invalid choice: 'wave'"),
        (["map", "--pulse", "cosin"], "Did you mean 'cosine'?"),
        (["map", "--intensity", "2"], "argument --intensity: expected 2 arguments"),
        (["run", "--width", "wide"], "argument --width: invalid number value: 'wide'"),
        (["run", "--colour", "red"], "unrecognized arguments: --colour"),
        (["run", "--widht", "2"], "unrecognized arguments: --widht. Did you mean '--width'?"),
        (["run", "a.csv", "b.csv"], "unrecognized arguments: b.csv"),
    ],
)
def test_bad_words(capsys, words, error):
    """Check words that argparse refuses: usage, then one line."""
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert stopped.value.code == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert re.match(r"jaxrock( run| map)?: error: ", last) and error in last


def test_programs_read_what_people_do(capsys, command, at2, tmp_path, undrawn):
    """One object on the standard output, with the numbers of the table; what is no number is null."""
    for scale in ("1", "8"):
        _, table, _ = command("run", at2, *GIVEN, "--scale", scale)
        assert main(["run", at2, *GIVEN, "--scale", scale, "--json", "--out", str(tmp_path / "out")]) == 0
        told = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
        found = told["results"]
        assert (told["command"], told["version"], told["title"], told["exit_status"]) == (
            "run",
            rk.__version__,
            "motion",
            0,
        )
        assert {Path(path).name for path in told["files"]} == {"history.csv", "impacts.csv", "history.png", "phase.png"}
        assert found["overturned"] == (table["verdict"] == "OVERTURNS") == (found["peak_rotation"] is None)
        assert f"{found['margin']:+.4f}" == table["margin (0: boundary)"]
        assert f"{found['p']:.4f}" == table["frequency parameter p"] and told["units"]["p"] == "rad/s"


def test_what_failed_is_told_to_programs(capsys, at2, tmp_path, undrawn):
    assert main(["run", at2, *ENDLESS, "--json", "--out", str(tmp_path / "out")]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["exit_status"] == 1 and re.match("these are not results: The step budget", told["failures"][0])


def test_quiet(capsys, at2, tmp_path):
    """Check that `--quiet` prints errors only."""
    out = ["--quiet", "--out", str(tmp_path / "out")]
    assert main(["run", at2, *GIVEN, *out]) == 0
    assert capsys.readouterr() == ("", "") and is_figure(tmp_path / "out" / "history.png")
    assert main(["run", at2, *ENDLESS, *out]) == 1
    assert capsys.readouterr().err.startswith("jaxrock: these are not results: ")


def test_the_package_is_heard_once_and_only_within_a_command(capsys):
    logger = logging.getLogger("jaxrock")
    for quiet, verbose, heard_there in [(False, False, "ab"), (True, False, "a"), (False, True, "abc")]:
        with heard(quiet, verbose):
            for _ in range(2):
                logger.warning("a")
                logger.info("b")
                logger.debug("c")
        assert capsys.readouterr().err == "".join(f"jaxrock: {word}\n" for word in heard_there)
    logger.warning("d")
    assert "jaxrock: " not in capsys.readouterr().err


@pytest.mark.parametrize(
    "value, form, text", [(-0.0, "+.4f", "+0.0000"), (-4e-5, ".3f", "0.000"), (-0.0, "g", "0"), (-0.1, ".1f", "-0.1")]
)
def test_zero_has_no_sign(value, form, text):
    assert Entry("key", "label", value, form).text == text


def test_version(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["--version"])
    assert capsys.readouterr().out == f"jaxrock {rk.__version__}\n"


def test_folder_that_is_a_file(capsys, at2, tmp_path):
    (tmp_path / "out").write_text("in the way")
    assert main(["run", at2, *GIVEN, "--out", str(tmp_path / "out")]) == 2
    assert re.fullmatch(r"jaxrock: error: Argument `--out` must be a folder, .* is a file\.\n", capsys.readouterr().err)
    assert (tmp_path / "out").read_text() == "in the way"


def test_as_a_program_that_keeps_what_it_compiled(tmp_path, monkeypatch, capsys):
    """A second call finds what the first has compiled, and answers the same to the last byte."""
    monkeypatch.setenv("JAXROCK_CACHE", str(tmp_path / "kept"))

    def call(folder):
        words = ["map", "--points", "4", "--model", "linear", "--pixels", "--out", str(folder)]
        done = subprocess.run(
            [sys.executable, "-m", "jaxrock", *words],
            cwd=Path(rk.__file__).parents[1],
            env=os.environ | {"JAX_PLATFORMS": "cpu"},
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, done.stderr
        said.append(done.stderr)
        check_map(folder, 4)
        return (folder / "map.csv").read_bytes()

    said = []

    def kept():
        files = (path for path in (tmp_path / "kept").rglob("*") if path.is_file())
        return {path.name for path in files if path.parent.name != "xla" or path.name.endswith("-cache")}

    table = call(tmp_path / "new" / "folder")
    first = kept()
    assert call(tmp_path / "second") == table
    assert said == ["jaxrock: compiling, once for this machine\n", ""]
    # What XLA compiles is kept if that takes long enough: now and then one more.
    assert first and first <= kept()
    assert {name for name in kept() - first if not name.endswith("-cache")} == set()
    assert main(["cache"]) == 0 and f"{len(kept())} compiled programs" in capsys.readouterr().out
    (tmp_path / "kept" / "of the user").touch()
    assert main(["cache", "--clear"]) == 0 and "deleted" in capsys.readouterr().out
    assert kept() == {"of the user"}


def test_nothing_is_kept_where_that_is_off(capsys):
    assert main(["cache"]) == 0
    assert "off" in capsys.readouterr().out


@pytest.mark.parametrize(("raised", "status"), [(KeyboardInterrupt, 130), (BrokenPipeError, 141)])
def test_what_ends_a_command_from_outside_is_no_bad_input(monkeypatch, capfd, raised, status):
    """Check an interrupt and a closed pipe: no traceback, and an exit status of its own."""

    def ended(words):
        raise raised

    monkeypatch.setattr("jaxrock.command_line.main._done", ended)
    monkeypatch.setattr("os.dup2", lambda *_: None)
    assert main(["run"]) == status
    assert capfd.readouterr().err == ("jaxrock: interrupted\n" if status == 130 else "")
