"""Series that are wrapped in rows, rows of count and step, and tables beside which they must not be taken."""

import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings, strategies as st

from jaxrock.motions.files.reading import read_record
from references.damaged_files import FILES

SERIES = np.round(np.random.default_rng(8).normal(0, 0.1, 61), 5)
FIXED = "%10.5f"


@pytest.fixture
def file(tmp_path):
    """Write a file, by default motion.dat, and return its path."""

    def write(content, name="motion.dat"):
        path = tmp_path / name
        path.write_bytes(content.encode())
        return path

    return write


def wrapped(values=SERIES, per_row=8, form=FIXED, separator=""):
    """Values in reading order, so many to a row."""
    rows = [values[k : k + per_row].tolist() for k in range(0, values.size, per_row)]
    return "".join(separator.join(form % x for x in row) + "\n" for row in rows)


@pytest.mark.parametrize("count", [56, 61, 57])
@pytest.mark.parametrize(
    "per_row, form, separator",
    [
        (8, FIXED, ""), (5, "%15.7E", ""), (8, "%r", ","), (10, "%r", ";"), (3, "%r", "\t"), (8, "%8.5f", ""),
        (2, "%g", " "),
    ],
)  # fmt: skip
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_wrapped_rows_are_read_in_reading_order(file, count, per_row, form, separator, end):
    """Check also rows whose numbers touch ("%8.5f" of negative numbers)."""
    values = SERIES[:count]
    path = file(wrapped(values, per_row, form, separator).replace("\n", end))
    record = read_record(path, layout="rows", dt=0.02, unit="g")
    np.testing.assert_array_equal(record.samples, values)
    assert (record.dt, record.origin.format) == (0.02, "csv")


def test_wrapped_rows_below_words(file):
    """Check that the header of a series states its unit."""
    header = "# El Centro, S00E component\n# made up\nAcceleration (cm/s2)\n"
    record = read_record(file(header + wrapped()), layout="rows", dt=0.02)
    np.testing.assert_allclose(record.samples, SERIES / 980.665, rtol=1e-12)
    with pytest.raises(ValueError, match="Argument `unit` must agree with file `motion.dat`"):
        read_record(file(header + wrapped()), layout="rows", dt=0.02, unit="g")


def test_fields_that_are_empty_at_the_end_of_rows(file):
    """Check what spreadsheets write: the last row filled up with commas, or commas behind all rows."""
    rows = wrapped(SERIES, 8, "%r", ",")
    for text in (rows.rstrip() + ",,,\n", rows.replace("\n", ",\n"), rows + ",,,,,,,\n" * 3):
        np.testing.assert_array_equal(read_record(file(text), layout="rows", dt=0.02, unit="g").samples, SERIES)


@pytest.mark.parametrize("text", [wrapped(), wrapped(SERIES[:56]), wrapped(SERIES, 3), "# a title\n" + wrapped()])
def test_wrapped_rows_are_asked_for(file, text):
    """Check that `column`, which would take every eighth number, is nowhere suggested."""
    with pytest.raises(
        ValueError, match="^Argument `layout` must be 'rows' for text file `motion.dat`, .*line"
    ) as found:
        read_record(file(text), dt=0.02, unit="g")
    assert "`column`" not in str(found.value)
    assert ("or 'columns' if" in str(found.value)) == (text == wrapped(SERIES[:56]))


@pytest.mark.parametrize("column", [None, 0, 3])
def test_a_table_whose_last_row_is_short_is_cut_off(file, column):
    """Check that titles and times tell a table, of which no row is short."""
    table = "".join(f"{0.01 * k:.2f} {x} {2 * x} {3 * x}\n" for k, x in enumerate(SERIES))
    for header in ("", "t a b c\n"):
        with pytest.raises(ValueError, match="^File `motion.dat`: line 6[23]? has 3 columns|line 61 has 3 columns"):
            read_record(file(header + table.rsplit(" ", 1)[0] + "\n"), column=column, unit="g", dt=0.01)


def test_a_column_of_wrapped_rows_is_warned_of(file):
    path = file(wrapped(SERIES[:56]))
    with pytest.warns(
        UserWarning, match="`motion.dat` has rows of 8 numbers from line 1 on, .* which column 2 is read"
    ):
        record = read_record(path, column=2, dt=0.02, unit="g")
    np.testing.assert_array_equal(record.samples, SERIES[2:56:8])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(
            read_record(path, column=2, dt=0.02, unit="g", layout="columns").samples, record.samples
        )
        titled = file(", ".join("abcdefgh") + "\n" + wrapped(SERIES[:56], 8, "%r", ","))
        read_record(titled, column=2, dt=0.02, unit="g")


@pytest.mark.parametrize(
    "text, given, message",
    [
        (wrapped().replace(FIXED % SERIES[20], ""), {}, "line 3 has 7 numbers, but line 1 has 8: of rows"),
        (wrapped(SERIES[:60]) + wrapped(SERIES[:8]), {}, "line 8 has 4 numbers, but line 1 has 8"),
        (wrapped(SERIES[:56]) + FIXED % 1 * 9, {}, "line 8 has 9 numbers, but line 1 has 8"),
        (wrapped(SERIES[:56]), {"column": 0}, "Argument `column` must be None, because the rows of text file"),
        (wrapped(), {"layout": "columns"}, "line 8 has 5 columns, but line 1 has 8"),
        (wrapped(SERIES[:56]), {"layout": "columns"}, "Argument `column` must be 0 to 7"),
        (wrapped(), {"layout": "row"}, "Argument `layout` must be one of 'columns', 'rows', but is 'row'"),
        (wrapped(), {"dt": None}, "Argument `dt` must be given for text file `motion.dat`"),
        (wrapped(), {"unit": None}, "Argument `unit` must be 'g', 'm/s2'"),
        ("0.00 0.5\n0.02 0.1\n0.04 -1\n", {}, "must be 'columns' .* column 0 holds times"),
        ("time [s],acc [g]\n0.0,0.1\n0.1,-0.2\n", {}, "line 1 states the unit 's or else g'"),
        ("0,123,0,456\n0,789,0,12\n", {}, "line 1 may hold decimal commas, which must be points"),
        ("0,123 0,456\n0,789 0,12\n", {}, "line 1 holds decimal commas, which must be points"),
        ("0.1,,0.2\n0.3,0.4,0.5\n", {}, "line 1 holds more than numbers"),
        ("0.1,0.2\n,,\n0.3,0.4\n", {}, "line 2 has empty fields only, but numbers follow"),
        (wrapped() + "the end\n", {}, "line 9 should hold numbers only, but is 'the end'"),
        (FILES["AT2"].text, {}, "Argument `layout` must be None, because AT2 file `motion.dat` has one layout"),
        (FILES["V2"].text, {"layout": "columns"}, "Argument `layout` must be None, because V2 file"),
    ],
)  # fmt: skip
def test_rows_that_are_no_series(file, text, given, message):
    with pytest.raises(ValueError, match=message):
        read_record(file(text), **{"layout": "rows", "dt": 0.02, "unit": "g"} | given)


# ---------------------------------------------------------------------------------- count and step

ONE = "".join(f"{x!r}\n" for x in SERIES.tolist())
TABLE = "".join(f"{0.02 * k:.2f} {x!r}\n" for k, x in enumerate(SERIES.tolist()))


@pytest.mark.parametrize("body", [ONE, TABLE, wrapped(), wrapped(per_row=3), wrapped(per_row=2)])
@pytest.mark.parametrize(
    "head",
    ["61 0.02\n", "61,0.02\n", "made-up motion\n61 0.0200\n", "name, NS\n  61\t2.0E-2 \n", "0.02 61\n", "61;.02;\n"],
)
def test_a_row_of_count_and_step_is_no_sample(file, head, body):
    record = read_record(file(head + body), unit="g")
    np.testing.assert_array_equal(record.samples, SERIES)
    assert record.dt == 0.02
    with pytest.raises(ValueError, match="Argument `dt` must agree with file `motion.dat`, which has 0.02 s"):
        read_record(file(head + body), unit="g", dt=0.01)


@pytest.mark.parametrize("body", [ONE, wrapped(), wrapped(per_row=2)])
def test_count_and_step_in_rows_of_their_own(file, body):
    record = read_record(file("a name\n61\n0.02\n" + body), unit="g")
    np.testing.assert_array_equal(record.samples, SERIES)
    assert record.dt == 0.02
    whole = "".join(f"{x}\n" for x in (3, 0.5, 1, 2, 4))  # five samples in cm/s2
    np.testing.assert_allclose(read_record(file(whole), dt=0.1, unit="cm/s2").samples * 980.665, [3, 0.5, 1, 2, 4])


def test_a_row_of_count_and_step_above_components(file):
    table = "".join(f"{0.02 * k:.2f} {x!r} {2 * x!r}\n" for k, x in enumerate(SERIES.tolist()))
    np.testing.assert_array_equal(read_record(file("61 0.02\n" + table), unit="g", column=2).samples, 2 * SERIES)


@pytest.mark.parametrize(
    "text, message",
    [
        ("62 0.02\n" + ONE, "line 1 states 62 samples 0.02 s apart, but 61 numbers follow"),
        ("a name\n60,0.02\n" + ONE, "line 2 states 60 samples 0.02 s apart, but 61 numbers follow"),
        ("62 0.02\n" + wrapped(), "line 1 states 62 samples 0.02 s apart, but 61 numbers follow"),
        ("62 0.02\n" + TABLE, "not equally spaced|do not increase"),
        ("61 0.02 1.0\n" + ONE, "line 2 has 1 column, but line 1 has 3"),
        ("61 2.5\n" + ONE, "line 2 has 1 column, but line 1 has 2"),
    ],
)
def test_a_row_of_count_and_step_that_is_wrong(file, text, message):
    with pytest.raises(ValueError, match=f"^File `motion.dat`: .*({message})"):
        read_record(file(text), unit="g")


def test_a_table_that_begins_like_a_count_is_a_table(file):
    """Check rows of whole numbers beside small ones, which may be numbered samples."""
    for start in (1, 2, 6, 12):
        rows = "".join(f"{start + k} {0.01 + 0.001 * k:.3f}\n" for k in range(7))
        record = read_record(file("n a\n" + rows), unit="g", dt=0.01)
        np.testing.assert_allclose(record.samples, 0.01 + 0.001 * np.arange(7))


# ------------------------------------------------------------------------------------- by chance


@st.composite
def texts(draw):
    """Draw how many numbers are in a row, samples, and a text that holds them."""
    count = draw(st.integers(2, 40))
    digits = draw(st.integers(1, 7))
    bound = 10**digits
    values = np.array(draw(st.lists(st.integers(-bound, bound), min_size=count, max_size=count))) / bound
    per_row = draw(st.integers(1, 10))
    separator = draw(st.sampled_from([" ", "  ", "\t", ",", ", ", " , ", ";", "; "]))
    form = draw(st.sampled_from(["%r", "%.7f", "%12.7f", "%.8E", "%g"]))
    end = draw(st.sampled_from(["\n", "\r\n", "\r"]))
    trail = draw(st.sampled_from(["", separator.rstrip(" ") or " ", "  # said"]))
    comments = draw(st.lists(st.sampled_from(["# a comment", "% made up", "", "// x", "A title", "#"]), max_size=3))
    counted = draw(st.sampled_from(["", "", f"{count} 0.01", f"{count},0.01"]))
    rows = [values[k : k + per_row].tolist() for k in range(0, count, per_row)]
    lines = [separator.join(form % x for x in row) + trail for row in rows]
    last = draw(st.sampled_from([end, end + end, ""]))
    values = np.array([float(form % x) for x in values.tolist()])
    return per_row, values, end.join([*comments, *([counted] if counted else []), *lines]) + last


@given(texts(), st.sampled_from(["rows", None]))
@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_rows_by_chance(file, drawn, layout):
    """Check that what was written is read, or refused by its name; another number is never read."""
    per_row, values, text = drawn
    assume(layout == "rows" or per_row != 2)  # two numbers to a row may be times and accelerations
    path = file(text)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            record = read_record(path, layout=layout, dt=0.01, unit="g")
        except ValueError as error:
            assert str(error).startswith(("File `motion.dat`: ", "Argument `"))
            if layout == "rows":  # nothing but times in the first column, or an uncertain end, is refused
                assert any(
                    word in str(error) for word in ("holds times", "may be cut off", "cut off", "decimal commas")
                )
            return

    np.testing.assert_allclose(record.samples, values, rtol=0, atol=0)
