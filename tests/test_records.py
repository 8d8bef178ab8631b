"""Readers of accelerograms: every variant of the formats, and every way in which a file can be wrong."""

import warnings

import numpy as np
import pytest

from jaxrock.motions.files.example import example_record
from jaxrock.motions.files.format import AbstractFormat, Accelerogram
from jaxrock.motions.files.parsing import STANDARD_GRAVITY
from jaxrock.motions.files.reading import FORMATS, read_record
from jaxrock.motions.record import Record

SAMPLES = np.array([0.01, -0.2556093, 0.3, -0.04, 0.05, 1.06e-3, -7e-5])  # g


@pytest.fixture
def file(tmp_path):
    """Write a file, by default motion.txt, and return its path."""

    def write(content, name="motion.txt"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


def rows(values, form, per_line, end="\n"):
    """Values printed in lines of `per_line`, the last one short."""
    printed = [form % value for value in values]
    return "".join("".join(printed[start : start + per_line]) + end for start in range(0, len(printed), per_line))


# ---------------------------------------------------------------------------------------------- AT2

TITLES = "PEER STRONG MOTION DATABASE RECORD\nLOMA PRIETA 10/18/89, WAHO, 090\n"
UNIT = "ACCELERATION TIME SERIES IN UNITS OF G\n"
COUNTS = "NPTS=     7, DT= .00500 SEC\n"
BODY = rows(SAMPLES, "%15.7E", 5)
AT2 = TITLES + UNIT + COUNTS + BODY


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(AT2, id="old PEER"),
        pytest.param(AT2.replace(" SEC", " SEC,         "), id="trailing blanks"),
        pytest.param(AT2.replace(" SEC", " SEC, LOW CUT 0.1 HZ, 2 PASSES"), id="trailing text"),
        pytest.param(AT2.replace("7, DT", "7  DT"), id="no comma"),
        pytest.param(AT2.replace("DT=", "dt="), id="lower case dt"),
        pytest.param(AT2.replace(COUNTS, "npts=7,dt=.005sec\n"), id="no blanks"),
        pytest.param(AT2.replace(COUNTS, "7    0.0050    NPTS, DT\n"), id="numbers first"),
        pytest.param(AT2.replace(COUNTS, "  7  5.0E-3  NPTS DT\n"), id="numbers first, no comma"),
        pytest.param(UNIT.join(["LOMA PRIETA 10/18/89, WAHO, 090\n", COUNTS + BODY]), id="3 header lines"),
        pytest.param("A NOTE\n\n" + AT2, id="6 header lines"),
        pytest.param(AT2.replace(".00500 SEC", "5.0 MSEC"), id="milliseconds"),
        pytest.param(TITLES + UNIT + COUNTS + "FILTERED\n\n" + BODY, id="text after the counts"),
        pytest.param(AT2.replace("\n", "\r\n"), id="CRLF"),
        pytest.param(AT2.replace("\n", "\r"), id="CR"),
        pytest.param(AT2 + "\x1a\x1a", id="DOS end of file"),
        pytest.param(AT2.rstrip(), id="no end of line"),
        pytest.param(AT2 + "\n  \n", id="blank lines at the end"),
        pytest.param(b"\xef\xbb\xbf" + AT2.encode(), id="byte order mark"),
        pytest.param(AT2.encode().replace(b"WAHO", b"WAH\xd3"), id="latin-1"),
        pytest.param(TITLES + UNIT + COUNTS + rows(SAMPLES, "%12.7f", 8), id="8 a line"),
        pytest.param(TITLES + UNIT + COUNTS + "\n".join(map(str, SAMPLES)) + "\n", id="1 a line"),
        pytest.param(AT2.replace("E-", "D-"), id="Fortran exponents"),
        pytest.param(TITLES + UNIT + COUNTS + BODY.replace(" -", "-"), id="some touch"),
        pytest.param(
            TITLES + UNIT + COUNTS + "   .1E-01-.2556093E+00 .3-.04+.05\n.106E-02-.7E-04\n", id="all kinds of touching"
        ),
        pytest.param(AT2.replace("OF G", "OF G. FILTER POINTS: HP=0.2 Hz LP=15.0 Hz"), id="filter after the unit"),
        pytest.param(AT2.replace("OF G", "OF (g)"), id="unit in brackets"),
        pytest.param("SUCH THAT DISPLACEMENT TIME HISTORY ENDS AT 0\n" + AT2, id="a word of displacement"),
    ],
)
def test_at2(file, content):
    record = read_record(file(content))
    np.testing.assert_allclose(record.samples, SAMPLES, rtol=1e-6)
    assert record.dt == 0.005


@pytest.mark.parametrize(
    "unit, per_g",
    [
        ("G", 1.0),
        ("g", 1.0),
        ("CM/SEC/SEC", 980.665),
        ("cm/s2", 980.665),
        ("CM/S**2", 980.665),
        ("cm/sec^2.", 980.665),
        ("Gal", 980.665),
        ("M/S2", 9.80665),
        ("m/sec/sec", 9.80665),
    ],
)
@pytest.mark.parametrize(
    "told",
    ["ACCELERATION TIME SERIES IN UNITS OF {}", "ACCELERATION TIME HISTORY IN {}", "ACCELERATION TIME HISTORY ({})"],
)
def test_at2_in_other_units(file, unit, per_g, told):
    content = AT2.replace(UNIT, told.format(unit) + "\n").replace(BODY, rows(SAMPLES * per_g, "%16.8E", 5))
    np.testing.assert_allclose(read_record(file(content)).samples, SAMPLES, rtol=1e-7)
    with pytest.raises(ValueError, match="Argument `unit` must agree with file"):
        read_record(file(content), unit="g" if per_g != 1 else "m/s2")


def test_units_of_at2_go_before_that_of_a_peak(file):
    for peak in ("PGA (CM/S2) = 805", "ACC (CM/S2)"):
        content = AT2.replace(UNIT, f"{peak}\n{UNIT}")
        assert "UNITS OF G" in UNIT and read_record(file(content)).origin.unit == "g"
    with pytest.raises(ValueError, match="line 3 states the unit 'CM/S2', but line 4 'G'"):
        read_record(file(AT2.replace(UNIT, f"UNITS: CM/S2\n{UNIT}")))


@pytest.mark.parametrize(
    "content, error",
    [
        pytest.param(
            AT2.replace("  7,", "  8,"), r"File `motion.txt`: header announces 8 samples, but 7 follow\.", id="fewer"
        ),
        pytest.param(AT2.replace("  7,", "  6,"), "header announces 6 samples, but 7 follow", id="more"),
        pytest.param(TITLES + UNIT + COUNTS, "header announces 7 samples, but 0 follow", id="none"),
        pytest.param(TITLES + UNIT + "NPTS= 0, DT= .01 SEC\n", "announces 0 samples", id="zero announced"),
        pytest.param(AT2.replace("OF G", "OF CM/S"), r"line 3 states the unit 'CM/S'", id="velocity"),
        pytest.param(AT2.replace("OF G", "OF G/10"), r"line 3 states the unit 'G/10'", id="unknown unit"),
        pytest.param(AT2.replace("OF G", "OF G * 0.001"), r"line 3 states the unit 'G \* 0.001'", id="a factor"),
        pytest.param(AT2.replace("OF G", "OF G X 10^-3"), r"line 3 states the unit 'G X 10\^-3'", id="a power"),
        pytest.param(AT2.replace("IN UNITS OF G", "IN MG"), "line 3 states the unit 'MG'", id="thousandths"),
        pytest.param(
            AT2.replace("ACCELERATION TIME SERIES IN UNITS OF G", "VELOCITY TIME HISTORY IN G"),
            "line 3 states velocity, but samples must be accelerations",
            id="velocity in g",
        ),
        pytest.param(AT2.replace(".00500 SEC", "200 HZ"), "line 4 states DT in 'HZ', but it must be a time", id="rate"),
        pytest.param(AT2.replace("IN UNITS OF G", ""), "`unit` must be given for file `motion.txt`", id="no unit"),
        pytest.param(AT2.replace(".00500", "0.000"), "time step of 0 s, which is not positive", id="zero dt"),
        pytest.param(AT2.replace(".00500", "-.005"), "time step of -0.005 s", id="negative dt"),
        pytest.param(AT2.replace(" SEC", " SEC, DT= .01"), "line 4 states time steps of 0.005 and 0.01 s", id="two dt"),
        pytest.param(AT2 + AT2, "line 10 announces samples once more: one record to a file", id="two records"),
        pytest.param(
            AT2 + "1.0 garbled\n", "line 7 should hold samples, but is '1.0 garbled'", id="garbled after the last"
        ),
        pytest.param(AT2.replace("\n  1.06", "\nx 1.06"), "line 6 should hold samples, but is 'x 1.06", id="garbled"),
        pytest.param(
            AT2.replace("  1.0600000E-03", "            NaN"), "line 6 should hold samples, but is 'NaN", id="NaN"
        ),
        pytest.param(
            AT2.replace("  1.0000000E-02", "            nan"), "line 5 should hold samples, but is 'nan", id="nan first"
        ),
        pytest.param(
            AT2.replace("1.0600000E-03", "*************"), "line 6 should hold samples", id="overflow in print"
        ),
        pytest.param(
            AT2.replace("1.0600000E-03", "1.060000E+999"), "line 6 holds a number that is not finite", id="infinite"
        ),
        pytest.param(
            AT2.replace("  1.0600000E-03", "  1.234562.34567"), "line 6 should hold samples", id="touching, no sign"
        ),
    ],
)
def test_at2_errors(file, content, error):
    with pytest.raises(ValueError, match=error):
        read_record(file(content))


def test_at2_without_counts_is_recognised_by_its_suffix(file):
    with pytest.raises(ValueError, match="File `motion.AT2`: no header line states NPTS and DT"):
        read_record(file(AT2.replace(COUNTS, ""), "motion.AT2"))


def test_at2_without_unit_takes_the_argument(file):
    path = file(AT2.replace("IN UNITS OF G", ""))
    np.testing.assert_allclose(read_record(path, unit="m/s2").samples, SAMPLES / STANDARD_GRAVITY, rtol=1e-6)


# ----------------------------------------------------------------------------------------------- V2

SHAKE = np.array([-1.72, 0.5, 305.02, -12.345, 0.001, 9.999, -99.5, 3.0, 4.25, -5.5])  # cm/s2
PER_G = 100 * STANDARD_GRAVITY


def channel(number=1, values=SHAKE, announce=" (UNITS: CM/SEC/SEC)", form="%10.3f", step=".010", count=None, peak=None):
    """One channel of a V2 file: three headers, three blocks, and the line that ends it."""
    count = len(values) if count is None else count
    peak = np.abs(values).max() if peak is None else peak
    text = [
        "CORRECTED ACCELEROGRAM   01336-C0165-79290.04       CHAN  2: 360 DEG     FROM   ",
        "UNCORRECTED ACCELEROGRAM DATA              PROCESSED:           USGS            ",
        "IMPERIAL VALLEY, CA  EARTHQUAKE                                                 ",
        "15 OCT 1979 - 2317 UTC",
        "01336-C0165-79290.04",
        "STATION NO.  1336   32.773N, 115.448W     CRA-1  S/N 0165 (13 CHNS OF 26 AT STA)",
        "EL CENTRO - HWY 8/MELOLAND OVERPASS                                             ",
        f"CHAN  {number}:   0 DEG     LOCATION: FREEFIELD",
        f"  {count} POINTS OF INSTRUMENT- AND BASELINE-CORRECTED ACCEL, VELOC AND DISPL DATA ",
        "AT EQUALLY-SPACED INTERVALS OF    .010  SEC.",
        f"PEAK ACCELERATION = {peak:9.3f}    CM/SEC/SEC  AT     .020   SEC.",
    ]
    headers = "\n".join(text) + "\n" + rows([0] * 100, "%5d", 16) + rows(np.zeros(100), "%10.3f", 8)
    blocks = "".join(
        f"{len(values):5d} POINTS OF {what} DATA EQUALLY SPACED AT  .010 SEC.  (UNITS: {unit})\n"
        + rows(0.1 * values, "%10.3f", 8)
        for what, unit in (("VELOC", "CM/SEC"), ("DISPL", "CM"))
    )
    announced = f"{count:5d} POINTS OF ACCEL DATA EQUALLY SPACED AT  {step} SEC. {announce}\n"
    end = f"/&  ----------  END OF DATA FOR CHANNEL  {number}  ----------\n"
    return headers + announced + rows(values, form, 8) + blocks + end


V2 = channel()


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(V2, id="CSMIP"),
        pytest.param(V2.replace("\n", "\r\n") + "\x1a" * 40, id="CRLF and DOS end of file"),
        pytest.param(channel(announce=", in cm/sec2. (8f10.3)").lower(), id="later CSMIP"),
        pytest.param(channel(announce=", in cm/sec2. (8f11.6)", form="%11.6f"), id="width stated"),
        pytest.param(channel(announce="in units of cm/sec2. (8f11.6)", form="%11.6f"), id="in units of"),
        pytest.param(
            V2.replace("OF ACCEL DATA", "OF ACC DATA").replace("(UNITS: CM/SEC/SEC)", "IN UNITS CM/SEC/SEC"), id="USC"
        ),
        pytest.param(channel(announce="(UNITS: G)", values=SHAKE / PER_G, form="%10.7f", peak=305.02), id="in g"),
        pytest.param(V2[: V2.index("   10 POINTS OF VELOC")], id="acceleration only"),
        pytest.param(V2[V2.index("   10 POINTS OF ACCEL") :], id="no header"),
    ],
)
def test_v2(file, content):
    record = read_record(file(content))
    np.testing.assert_allclose(record.samples, SHAKE / PER_G, rtol=0, atol=1e-7)
    assert record.dt == 0.01


@pytest.mark.filterwarnings("ignore:.*holds an acceleration of")
def test_v2_values_that_touch_are_split_by_width(file):
    values = np.array([-12345.678, -23456.789, 123456.789, 1.5])
    record = read_record(file(channel(values=values)))
    np.testing.assert_allclose(record.samples, values / PER_G)


@pytest.mark.parametrize("column, factor", [(None, 1), (0, 1), (1, -2), (np.int64(2), 3)])
def test_v2_channels(file, column, factor):
    content = channel(1) + channel(2, -2 * SHAKE) + channel(3, 3 * SHAKE)
    record = read_record(file(content), column=column)
    np.testing.assert_allclose(record.samples, factor * SHAKE / PER_G)
    assert (
        record.name == f"IMPERIAL VALLEY, CA EARTHQUAKE, EL CENTRO - HWY 8/MELOLAND OVERPASS, CHAN {abs(factor)}: 0 DEG"
    )


def test_v2_channels_of_acceleration_only(file):
    first = V2[: V2.index("   10 POINTS OF VELOC")]
    for column in (0, 1):
        assert read_record(file(first + first), column=column).samples.shape == (10,)


@pytest.mark.parametrize(
    "content, error",
    [
        pytest.param(channel(count=11), r"File `motion.txt`: header announces 11 samples, but 10 follow\.", id="fewer"),
        pytest.param(channel(count=9), "header announces 9 samples, but 10 follow", id="more"),
        pytest.param(channel(announce="(UNITS: CM/SEC)"), "line 32 states the unit 'CM/SEC'", id="unknown unit"),
        pytest.param(channel(announce=""), "Argument `unit` must be given for file `motion.txt`", id="no unit"),
        pytest.param(
            V2.replace("    -1.720", "  -712.000"),
            "line 11 states a peak of 305.02 cm/s2, but the largest sample is 712",
            id="peak",
        ),
        pytest.param(channel(step=".000"), "time step of 0 s, which is not positive", id="zero dt"),
        pytest.param(V2.replace("   305.020", "   305.O20"), "line 33 should hold samples, but is", id="garbled"),
        pytest.param(V2.replace("    -5.500", "       NaN"), "line 34 should hold samples, but is", id="NaN"),
        pytest.param(V2.replace("   305.020", "          "), "line 33 should hold samples, but is", id="missing value"),
        pytest.param(
            V2.replace("    -1.720", "       -1.720"), "line 33 should hold samples, but is", id="shifted columns"
        ),
    ],
)
def test_v2_errors(file, content, error):
    with pytest.raises(ValueError, match=error):
        read_record(file(content))


@pytest.mark.parametrize("announce, form", [("(8f10.3)", "%10.3f"), (", (8f11.6)", "%11.6f"), ("", "%10.3f")])
def test_v2_without_unit_takes_the_argument(file, announce, form):
    path = file(channel(announce=announce, form=form))
    np.testing.assert_allclose(read_record(path, unit="cm/s2").samples, SHAKE / PER_G, atol=1e-7)
    with pytest.raises(
        ValueError, match="Argument `unit` must be given for file `motion.txt`, whose header states non"
    ):
        read_record(path)


def test_v2_without_block_is_recognised_by_its_suffix(file):
    with pytest.raises(ValueError, match="File `motion.v2`: no line announces 'POINTS OF ACCEL DATA'"):
        read_record(file(V2.replace("POINTS OF ACCEL DATA", ""), "motion.v2"))


# ------------------------------------------------------------------------------------------ columns

TIMES = 0.02 * np.arange(7)


def two_columns(separator, header="", form="%.2f"):
    return header + "".join(f"{form % t}{separator}{a}\n" for t, a in zip(TIMES, SAMPLES))


ONE_COLUMN = rows(SAMPLES, "%.9g", 1)
PAIRS = two_columns(",")


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(ONE_COLUMN, id="plain"),
        pytest.param("Station 5\nacceleration [g]\n\n" + ONE_COLUMN, id="header"),
        pytest.param("# 7 samples\n" + ONE_COLUMN.replace("\n", "  # sample\n"), id="comments"),
        pytest.param(ONE_COLUMN.replace("\n", ",\n"), id="trailing commas"),
        pytest.param(ONE_COLUMN.replace("\n", "\r\n"), id="CRLF"),
        pytest.param(ONE_COLUMN.replace("e-", "D-"), id="Fortran exponents"),
    ],
)
def test_one_column(file, content):
    record = read_record(file(content), dt=0.02, unit="g")
    np.testing.assert_allclose(record.samples, SAMPLES)
    assert record.dt == 0.02


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(PAIRS, id="comma"),
        pytest.param(two_columns(", "), id="comma and blank"),
        pytest.param(two_columns(";"), id="semicolon"),
        pytest.param(two_columns("\t"), id="tab"),
        pytest.param(two_columns("   "), id="blanks"),
        pytest.param(two_columns(",", "time,acceleration\ns,g\n"), id="header"),
        pytest.param(two_columns(",", "# NPTS= 7, DT= .02 SEC\n"), id="comment like AT2"),
        pytest.param(two_columns(",", "\ufeff"), id="byte order mark"),
        pytest.param(two_columns(" ", "# made by hand\n% t a\n"), id="comments"),
        pytest.param(two_columns(",", form="%.1E").replace("-0", "-"), id="times with exponents"),
    ],
)
def test_two_columns(file, content):
    record = read_record(file(content), unit="g")
    np.testing.assert_allclose(record.samples, SAMPLES)
    assert record.dt == 0.02


@pytest.mark.parametrize(
    "title, per_g",
    [
        ("time,acceleration [g]", 1.0),
        ("time,acceleration [m/s²]", 9.80665),
        ("time,acceleration [m s-2]", 9.80665),
        ("t (s),a (m/s^2)", 9.80665),
        ("# time [s], acceleration [cm/s2]", 980.665),
        ("Station A (upper)\nt [s], a [Gal]\n", 980.665),
    ],
)
def test_unit_of_a_column_is_in_its_title(file, title, per_g):
    path = file(f"{title}\n{PAIRS}")
    np.testing.assert_allclose(read_record(path).samples, SAMPLES / per_g)
    with pytest.raises(ValueError, match="Argument `unit` must agree with file `motion.txt`"):
        read_record(path, unit="m/s2" if per_g != 9.80665 else "g")


@pytest.mark.parametrize(
    "separator, title",
    [
        ("\t", "t [ms]\tacceleration of the table [cm/s2]"),
        ("\t", "t (ms)\ta (Gal)\t"),
        ("\t", "t [ms], a [cm/s2]"),
        (" ", "Time (ms)  Acc (cm/s/s)"),
        (" ", "t [ms] ground acceleration [cm/s2]"),
    ],
)
def test_titles_hold_blanks_beside_tabs_and_blanks(file, separator, title):
    path = file(f"{title}\n{PAIRS.replace(',', separator)}")
    record = read_record(path)
    np.testing.assert_allclose(record.samples, SAMPLES / 980.665)
    np.testing.assert_allclose(record.dt, 1e-3 * read_record(file(PAIRS, "usual.txt"), unit="g").dt, rtol=1e-12)
    with pytest.raises(ValueError, match="Argument `unit` must agree with file"):
        read_record(path, unit="g")


@pytest.mark.parametrize("title", ["t (ms)\ta", "t (ms) a"])
def test_unit_of_times_counts_beside_a_title_without_a_unit(file, title):
    record = read_record(file(f"{title}\n{PAIRS.replace(',', ' ')}"), unit="g")
    np.testing.assert_allclose(record.dt, 1e-3 * read_record(file(PAIRS, "usual.txt"), unit="g").dt, rtol=1e-12)


def test_a_mark_of_a_gap_and_a_wrong_unit_are_warned_of(file):
    """Samples beyond all that was ever recorded."""
    with pytest.warns(
        UserWarning,
        match="`motion.txt` holds an acceleration of 999 g, more than .* is its unit g.* it holds 1.02 g .980.7 times",
    ):
        read_record(file("0.1\n-999\n0.2\n"), dt=0.01, unit="g")
    with pytest.warns(
        UserWarning, match="holds an acceleration of 3.924 g, .* its unit g.*0.4 g .9.807 times"
    ) as found:
        read_record(file("0.1\n-3.924\n0.2\n"), dt=0.01, unit="g")
    assert len(found) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_record(file("100\n-999\n200\n"), dt=0.01, unit="cm/s2")


def test_a_title_of_one_column_states_its_unit(file):
    path = file("Ground acceleration (cm/s2)\n" + "".join(f"{a!r}\n" for a in SAMPLES.tolist()))
    np.testing.assert_allclose(read_record(path, dt=0.02).samples, SAMPLES / 980.665)
    with pytest.raises(ValueError, match="Argument `unit` must agree with file"):
        read_record(path, dt=0.02, unit="g")


@pytest.mark.parametrize(
    "title",
    ["time,acceleration", "t [s],a [filtered]", "a record [g]", "t [s],a (090)", "Sta A (NS) motion (corrected)"],
)
def test_other_titles_state_no_unit(file, title):
    path = file(f"{title}\n{PAIRS}")
    with pytest.raises(ValueError, match="which states none"):
        read_record(path)
    np.testing.assert_allclose(read_record(path, unit="g").samples, SAMPLES)


@pytest.mark.parametrize("unit", ["mg", "%g", "mGal", "ft/s2", "km/s2", "cm/s", "m", "counts"])
@pytest.mark.parametrize("given", [None, "g"])
def test_a_column_in_another_unit_is_refused_whatever_is_asked_for(file, unit, given):
    with pytest.raises(ValueError, match=f"line 1 states the unit '{unit}', but accelerations must be in g"):
        read_record(file(f"time [s],motion [{unit}]\n{PAIRS}"), unit=given)


@pytest.mark.parametrize(("unit", "seconds"), [("s", 1.0), ("sec.", 1.0), ("ms", 1e-3), ("us", 1e-6), ("min", 60.0)])
def test_unit_of_times_is_in_their_title(file, unit, seconds):
    usual = read_record(file(PAIRS), unit="g")
    record = read_record(file(f"t ({unit}),a [g]\n{PAIRS}"))
    np.testing.assert_allclose(record.dt, seconds * usual.dt, rtol=1e-12)
    with pytest.raises(ValueError, match="Argument `dt` must agree with file"):
        read_record(file(f"t ({unit}),a [g]\n{PAIRS}"), dt=3 * seconds * usual.dt)


IN_MS = "".join(f"{20 * k},{a}\n" for k, a in enumerate(SAMPLES))


@pytest.mark.parametrize(
    "header, per_g",
    [
        ("time_ms,acc (g)", 1.0),
        ("Time/ms,acc/g", 1.0),
        ("t/ms,a/(m/s^2)", 9.80665),
        ("Time in ms,acc (g)", 1.0),
        ("Time ms;Acc cm/s2", 980.665),
        ("TIME MS,ACC G", 1.0),
        ('"Time [ms]","Acc [g]"', 1.0),
        ("time_ms acc_m_s2", 9.80665),
        ("time,acc\nms,cm/s2", 980.665),
        ("time acc\n(ms) (cm/s2)", 980.665),
        ("time,acc (NS)\nms,g", 1.0),
        ("time [ms],acc [g]\n# station X", 1.0),
        ("time [ms],acc [g]\n-----,-----", 1.0),
        ("time [ms],acc {cm/s2}", 980.665),
        ("time [ms],acc [g] corrected", 1.0),
        ("time [ms],acc [cm·s⁻²]", 980.665),
        ("# Units: ms, cm/s2", 980.665),
        ("# Times in ms\n# Units: cm/s2\ntime,acc", 980.665),
    ],
)
def test_units_of_a_header_wherever_they_stand(file, header, per_g):
    """In words, beside a slash, in a line of their own, above a comment or a rule: a factor of 1000 or 981 each."""
    separator = next((mark for mark in ",;" if mark in header.splitlines()[-1]), ",")
    path = file(f"{header}\n{IN_MS.replace(',', separator)}")
    record = read_record(path)
    np.testing.assert_allclose(record.samples, SAMPLES / per_g)
    np.testing.assert_allclose(record.dt, 0.02, rtol=1e-12)
    with pytest.raises(ValueError, match="Argument `unit` must agree with file"):
        read_record(path, unit="g" if per_g != 1 else "cm/s2")


@pytest.mark.parametrize(
    "header, message",
    [
        ("time [ms],acc [g],note", "line 1 has 3 titles, but 2 columns of numbers follow"),
        ("time,acc,note\nms,g,-", "line 2 has 3 titles, but 2 columns"),
        ("t [ms],acc [g]\ns,g", "line 1 states the unit 'ms', but line 2 's'"),
        ("t [ms],acc [g]\n# Units: cm/s2", "line 1 states the unit 'g', but line 2 'cm/s2'"),
        ("# Units: counts", "line 1 states the unit 'counts', but accelerations must be in g"),
        (
            "acc [g],time [s]",
            "`column` must be a column of accelerations, but column 1 of text file `motion.txt` holds",
        ),
        ("time [ms],acc (g) [cm/s2]", "states the unit 'g or else cm/s2'"),
        ("time [0.01 s],acc [g]", "titles column 0 'time \\[0.01 s\\]'"),
    ],
)
def test_a_header_that_is_not_clear_is_refused(file, header, message):
    with pytest.raises(ValueError, match=message):
        read_record(file(f"{header}\n{IN_MS}"), unit="g")


@pytest.mark.parametrize(
    "unit",
    [
        "[g/10]", "[0.1 g]", "[10^-3 g]", "[percent g]", "[% of g]", "[cm/ss]", "[cmps2]", "[cm/sq.s]", "[cm/(s*s)]",
        "[cm/s2 x 10]", "in mg", "/mg", "_counts",
    ],
)  # fmt: skip
def test_a_part_of_g_is_not_g(file, unit):
    with pytest.raises(
        ValueError, match="line 1 states the unit|must agree with file `motion.txt`, which is in 'cm/s2'"
    ):
        read_record(file(f"time [ms],acc {unit}\n{IN_MS}"), unit="g")


VALUES = [
    "PGA = 300 cm/s2", "peak (cm/s2): 300", "PGA 300 cm/s2, at 3 s", "PGA, 300 gal", "Peak acceleration in m/s2: 2.94",
    "Peak acceleration in cm/s2 is 300", "Peak acceleration in m/s2 (NS): 3", "Peak acc in (m/s2) at 3.2 s: 3",
    "Total time in minutes: 1.5", "Total time in minutes 1.5",
]  # fmt: skip


@pytest.mark.parametrize("line", VALUES)
@pytest.mark.parametrize("titles", ["", "time,acc\n", "time,acc [g]\n"])
def test_a_value_in_a_header_is_no_title(file, line, titles):
    dt = read_record(file(PAIRS), unit="g").dt
    for header in (f"# {line}\n{titles}", f"{titles}# {line}\n"):
        record = read_record(file(header + PAIRS), unit="g")
        np.testing.assert_array_equal(record.samples, SAMPLES)
        assert record.dt == dt
    if not titles:
        np.testing.assert_array_equal(read_record(file(f"# {line}\n{ONE_COLUMN}"), unit="g", dt=1).samples, SAMPLES)


def test_a_title_beside_an_empty_last_field_is_passed_over(file):
    path = file("time [ms],acc [g],note\n" + IN_MS.replace("\n", ",\n"))
    np.testing.assert_array_equal(read_record(path).samples, SAMPLES)


def test_a_long_step_of_times_without_a_unit_is_warned_of(file):
    path = file(f"time,acc\n{IN_MS}")
    with pytest.warns(UserWarning, match="`motion.txt` does not say in what its times are: .* time step is 20 s, long"):
        read_record(path, unit="g")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_record(path, unit="g", dt=20.0)
        read_record(file(f"time [s],acc\n{IN_MS}"), unit="g")


@pytest.mark.parametrize("header, dt", [("time [s],NS,UD", 0.3), ("time,NS,UD", 0.3), ("# no titles", 0.02)])
def test_times_are_no_accelerations(file, header, dt):
    table = "".join(f"{t:.2f},{a},{2 * a}\n" for t, a in zip(TIMES, SAMPLES))
    with pytest.raises(ValueError, match="`column` must be a column of accelerations, but column 0 of text file"):
        read_record(file(f"{header}\n{table}"), column=0, dt=dt, unit="g")


@pytest.mark.parametrize("title", ["frequency [Hz]", "period [s]", "Period", "NS [g]", "t [Hz]"])
def test_what_is_said_to_be_no_time_is_none(file, title):
    with pytest.raises(ValueError, match="before accelerations there must be times"):
        read_record(file(f"{title},Sa [g]\n{PAIRS}"))


@pytest.mark.parametrize("title", ["", "step", "Sample", "#,n"])
def test_a_count_of_samples_is_no_time(file, title):
    rows = "".join(f"{k},{a!r}\n" for k, a in enumerate(SAMPLES.tolist()))
    path = file(f"{title.removeprefix('#,')},a [g]\n{rows}")
    with pytest.raises(ValueError, match="Argument `dt` must be given for text file"):
        read_record(path)
    record = read_record(path, dt=0.02)
    np.testing.assert_array_equal(record.samples, SAMPLES)
    assert record.dt == 0.02


@pytest.mark.parametrize("unit, per_g", [("g", 1.0), ("m/s2", 9.80665), ("cm/s2", 980.665)])
def test_unit_of_text(file, unit, per_g):
    np.testing.assert_allclose(read_record(file(PAIRS), unit=unit).samples, SAMPLES / per_g)


@pytest.mark.parametrize(
    "step, form, start",
    [
        pytest.param(0.01, "%.2f", 0.0, id="as few digits as the step has"),
        pytest.param(0.01, "%.2f", 3.0, id="start not at 0"),
        pytest.param(0.01, "%r", 0.0, id="all digits"),
        pytest.param(1 / 256, "%.3f", 0.0, id="1-256 s in milliseconds"),
        pytest.param(1 / 256, "%.6g", 0.0, id="1-256 s in 6 digits"),
        pytest.param(0.0025, "%.6g", 100.0, id="6 digits beyond 100 s"),
        pytest.param(0.005, "%.8E", 0.0, id="exponents"),
        pytest.param(0.004, "%g", -1.0, id="from negative times"),
        pytest.param(0.02, "%.2f", 1e5, id="times of day"),
        pytest.param(0.001, "%r", 100.0, id="milliseconds beyond 100 s"),
    ],
)
@pytest.mark.parametrize("single", [False, True], ids=["double", "single precision"])
def test_times_rounded_in_print(file, step, form, start, single):
    times = start + step * np.arange(2000)
    times = times.astype(np.float32).astype(float) if single and start < 1e5 else times
    content = "".join(f"{form % float(t)} 0.1\n" for t in times)
    assert read_record(file(content), unit="g").dt == pytest.approx(step, rel=3e-4)
    assert read_record(file(content), unit="g", dt=step).dt == step


def test_step_from_times_is_the_printed_one(file):
    content = "".join(f"{0.01 * k:.2f} 0\n" for k in range(30))
    assert 0.29 / 29 != 0.01
    assert read_record(file(content), unit="g").dt == 0.01


@pytest.mark.parametrize(
    "column, dt",
    [
        pytest.param(2, None, id="times in column 0"),
        pytest.param(2, 0.02, id="times that agree"),
        pytest.param(0, 0.3, id="column 0 itself"),
    ],
)
def test_many_columns(file, column, dt):
    table = np.stack([TIMES, 2 * SAMPLES, 3 * SAMPLES], 1)
    record = read_record(
        file("".join(f"{a!r},{b!r},{c!r}\n" for a, b, c in table.tolist())), unit="g", dt=dt, column=column
    )
    np.testing.assert_allclose(record.samples, table[:, column])
    assert record.dt == (dt or 0.02)


def test_many_columns_without_times(file):
    content = "".join(f"{a} {2 * a} {3 * a}\n" for a in SAMPLES)
    np.testing.assert_allclose(read_record(file(content), unit="g", dt=0.01, column=1).samples, 2 * SAMPLES)


@pytest.mark.parametrize(
    "content, arguments, error",
    [
        pytest.param(ONE_COLUMN, {"unit": "g"}, "Argument `dt` must be given for text file `motion.txt`", id="no dt"),
        pytest.param(
            ONE_COLUMN,
            {"dt": 0.01, "unit": None},
            "Argument `unit` must be 'g', 'm/s2', 'cm/s2' or 'mm/s2' for text",
            id="no unit",
        ),
        pytest.param(PAIRS, {"unit": None}, "Argument `unit` must be", id="no unit, 2 columns"),
        pytest.param(PAIRS, {"dt": 0.01}, "file `motion.txt`, which has 0.02 s, but is 0.01", id="other dt"),
        pytest.param(PAIRS, {"dt": 0.01, "column": 1}, "which has 0.02 s, but is 0.01", id="other dt, with column"),
        pytest.param(PAIRS, {"column": 0}, "Argument `dt` must be given", id="column of times"),
        pytest.param(PAIRS, {"column": 2}, r"`column` must be 0 to 1, .*`motion.txt`, but is 2\.", id="no such column"),
        pytest.param("0 1 2\n1 2 3\n", {}, "Argument `column` must be 0 to 2, .* but is None", id="3 columns"),
        pytest.param(
            "t a b\n0 1 2\n1 2 3\n", {"column": -1}, "`column` must be a whole number, at least 0, but is -1", id="-1"
        ),
        pytest.param(
            PAIRS.replace("0.02,", "0.020,x"), {}, "line 2 should hold numbers only, but is '0.020,x", id="text"
        ),
        pytest.param(
            PAIRS + "the end\n", {}, "line 8 should hold numbers only, but is 'the end'", id="text at the end"
        ),
        pytest.param(PAIRS.replace("0.00,0", "0.00,O"), {}, "line 1 holds more than numbers", id="broken first line"),
        pytest.param(PAIRS.replace("0.3", "nan"), {}, "line 3 holds a number that is not finite: '0.04,nan'", id="nan"),
        pytest.param("t a\n" + PAIRS.replace("0.3", "-inf"), {}, "line 4 holds a number that is not finite", id="inf"),
        pytest.param("nan\n0.1\n", {"dt": 0.01}, "line 1 holds a number that is not finite", id="nan first"),
        pytest.param(PAIRS.replace("0.3", "1e999"), {}, "line 3 holds a number that is not finite", id="1e999"),
        pytest.param(PAIRS.replace(",0.3", ""), {}, "line 3 has 1 column, but line 1 has 2", id="missing field"),
        pytest.param(
            PAIRS.replace("0.3", "0.3,1"), {}, "line 3 has 3 columns, but line 1 has 2", id="additional field"
        ),
        pytest.param(PAIRS.replace("0.3", ""), {}, "line 3 has 1 column, but line 1 has 2", id="empty field"),
        pytest.param(
            "0,00;0,1\n0,01;0,2\n", {}, "line 1 holds decimal commas, which must be points", id="decimal commas"
        ),
        pytest.param("t [s];a [g]\n0;0,1e-3\n", {}, "line 2 holds decimal commas", id="decimal commas below titles"),
        pytest.param("0\t0,1\n", {}, "line 1 holds decimal commas", id="decimal commas and tabs"),
        pytest.param("0,123\n-0,456\n0,789\n", {"dt": 0.01}, "line 1 holds decimal commas", id="decimal commas alone"),
        pytest.param(
            "0,123\n-0,456\n0,789\n", {"dt": 0.01, "column": 1}, "line 1 holds decimal commas", id="the same, column 1"
        ),
        pytest.param("0.00 1_0\n0.01 1_1\n", {}, "line 1 holds more than numbers", id="underscores"),
        pytest.param("time,acceleration\n", {}, "no line holds columns of numbers", id="header only"),
        pytest.param("0.0,0.1\n", {}, "has one row only, so its times give no time step", id="one row"),
        pytest.param("0,1.0\n0,2.0\n", {}, "the times in column 0 do not increase", id="constant times"),
        pytest.param("1700000000 1\n1700000000.01 2\n1700000000.03 3\n", {}, "not equally spaced", id="epoch times"),
        pytest.param("0.00 1\n0.00 2\n0.01 3\n0.01 4\n0.02 5\n", {}, "not equally spaced", id="times too coarse"),
        pytest.param("1,1.0\n0,2.0\n", {}, "the times in column 0 do not increase", id="times that fall"),
        pytest.param(
            PAIRS.replace("0.06,-0.04\n", ""),
            {},
            "times in column 0 are not equally spaced: 0.04 s before line 4, but 0.02 s elsewhere",
            id="missing row",
        ),
        pytest.param(
            PAIRS.replace("0.06,-0.04\n", ""), {"dt": 0.02, "column": 1}, "not equally spaced", id="the same, dt given"
        ),
        pytest.param(
            two_columns(",", form="%.4f").replace("0.0600,", "0.0602,"), {}, "not equally spaced", id="uneven by 1 %"
        ),
    ],
)
def test_column_errors(file, content, arguments, error):
    with pytest.raises(ValueError, match=error):
        read_record(file(content), **{"unit": "g"} | arguments)


@pytest.mark.parametrize("jitter, fine", [(5e-4, True), (2e-3, False)])
def test_even_spacing_is_demanded_to_a_thousandth(file, jitter, fine):
    times = TIMES + 0.02 * jitter * np.array([0, 0, 1, 0, 0, 0, 0])
    path = file("".join(f"{t:.9f} {a}\n" for t, a in zip(times, SAMPLES)))
    if fine:
        assert read_record(path, unit="g").dt == pytest.approx(0.02)
    else:
        with pytest.raises(ValueError, match="not equally spaced"):
            read_record(path, unit="g")


# ---------------------------------------------------------------------------- any file, any argument


@pytest.mark.parametrize("content", [AT2, V2], ids=["at2", "v2"])
@pytest.mark.parametrize(
    "arguments, error",
    [
        ({"dt": 0.02}, r"Argument `dt` must agree with file `motion.txt`, which has 0.0\d+ s, but is 0.02\."),
        (
            {"unit": "m/s2"},
            r"Argument `unit` must agree with file `motion.txt`, which is in '(g|cm/s2)', but is 'm/s2'\.",
        ),
        ({"column": 1}, "Argument `column` must be (None|0 to 0), .* file `motion.txt`.*, but is 1"),
        ({"unit": "ft"}, r"^Argument `unit` must be one of 'g', 'm/s2', 'cm/s2', 'mm/s2', but is 'ft'\.$"),
        (
            {"format": "sac"},
            r"^Argument `format` must be one of 'at2', 'v2', 'v1', 'esm', .*'csv', but is 'sac'\.$",
        ),
        ({"dt": 0.0}, r"Argument `dt` must be positive and finite, from 1e-9 to 1e9, but is 0\.0"),
        ({"dt": float("nan")}, "Argument `dt` must be positive and finite, from 1e-9 to 1e9, but is nan"),
        ({"dt": np.array([0.01, 0.01])}, r"Argument `dt` must be one number, but has shape \(2,\)"),
        ({"column": True}, "Argument `column` must be a whole number, at least 0, but is True"),
    ],
)
def test_argument_errors(file, content, arguments, error):
    with pytest.raises(ValueError, match=error):
        read_record(file(content), **arguments)


@pytest.mark.parametrize(
    "arguments, error",
    [
        ({"column": 1.0}, "Argument `column` must be a whole number, at least 0, but is 1.0"),
        ({"column": "1"}, "Argument `column` must be a whole number, at least 0, but is '1'"),
    ],
)
def test_arguments_of_a_wrong_type(file, arguments, error):
    with pytest.raises(ValueError, match=error):
        read_record(file(V2), **arguments)


@pytest.mark.parametrize(
    "content, arguments",
    [
        pytest.param(AT2, {"dt": 0.005, "unit": "g", "format": "at2"}, id="at2"),
        pytest.param(V2, {"dt": 0.01, "unit": "cm/s2", "format": "v2", "column": 0}, id="v2"),
        pytest.param(PAIRS, {"dt": 0.02, "unit": "g", "format": "csv", "column": 1}, id="csv"),
    ],
)
def test_arguments_that_agree_are_accepted(file, content, arguments):
    path = file(content)
    np.testing.assert_array_equal(
        read_record(path, **arguments).samples, read_record(path, unit=arguments["unit"]).samples
    )


@pytest.mark.parametrize(
    "content, format, error",
    [
        (PAIRS, "at2", "no header line states NPTS and DT"),
        (AT2, "v2", "no line announces 'POINTS OF ACCEL DATA'"),
        (AT2, "csv", "line 6 has 2 columns, but line 5 has 5"),
    ],
)
def test_a_wrong_format_raises(file, content, format, error):
    with pytest.raises(ValueError, match=error):
        read_record(file(content), format=format, unit="g", dt=0.01)


@pytest.mark.parametrize("name", ["a.csv", "a.txt", "a.AT2", "a.v2", "a"])
@pytest.mark.parametrize("content, size", [(AT2, 7), (V2, 10)], ids=["at2", "v2"])
def test_content_comes_before_suffix(file, content, size, name):
    assert read_record(file(content, name)).samples.shape == (size,)


def test_v2_may_hold_a_line_like_a_header_of_at2(file):
    path = file("NPTS= 3, DT= .5\n" + V2)
    np.testing.assert_array_equal(read_record(path).samples, read_record(file(V2, "a.v2")).samples)


class Counted(AbstractFormat):
    """A format of its own: a line COUNTED, then accelerations in g, a tenth of a second apart."""

    name = "counted"
    suffixes = (".cnt",)

    def recognises(self, lines):
        return lines[0] == "COUNTED"

    def read(self, name, lines, dt, unit, column):
        return Accelerogram(np.array([float(line) for line in lines[-2:]]), 0.1, "g", "")


def test_another_format_is_a_line_in_the_table(file, monkeypatch):
    monkeypatch.setitem(FORMATS, Counted.name, Counted())
    for path, given in (("a", None), ("a.txt", "counted"), ("a.CNT", None)):
        text = "COUNTED\n1\n2" if path == "a" else "1\n2"
        record = read_record(file(text, path), format=given)
        np.testing.assert_array_equal(record.samples, [1, 2])
        assert (record.dt, record.name) == (0.1, "a")
    with pytest.raises(
        ValueError,
        match="^Argument `format` must be one of 'at2', 'v2', .*, 'csv', 'counted', but is",
    ):
        read_record(file("1"), format="sac")


@pytest.mark.parametrize("name", ["a.csv", "a.txt", "a.dat", "a"])
def test_columns_need_no_suffix(file, name):
    assert read_record(file(PAIRS, name), unit="g").samples.shape == (7,)


@pytest.mark.parametrize(
    "content, error",
    [
        pytest.param(b"", "File `motion.txt`: is empty", id="empty"),
        pytest.param(b" \r\n\n \x1a", "File `motion.txt`: is empty", id="blank"),
        pytest.param(bytes(range(256)), "File `motion.txt`: is not plain text", id="binary"),
        pytest.param(b"PK\x03\x04" + b"0.1\n" * 9, "File `motion.txt`: is not plain text", id="zip"),
        pytest.param(PAIRS.encode("utf-16"), "File `motion.txt`: is not plain text", id="UTF-16"),
        pytest.param(
            b"<html>\n<p>Not found</p>\n", "File `motion.txt`: no line holds columns of numbers", id="web page"
        ),
    ],
)
def test_unreadable_content(file, content, error):
    with pytest.raises(ValueError, match=error):
        read_record(file(content), unit="g")


def test_files_that_cannot_be_opened(tmp_path):
    with pytest.raises(FileNotFoundError, match="missing.at2"):
        read_record(tmp_path / "missing.at2")
    with pytest.raises(OSError, match=tmp_path.name):
        read_record(tmp_path)


@pytest.mark.parametrize(
    "content, name",
    [
        pytest.param(AT2, "LOMA PRIETA 10/18/89, WAHO, 090", id="at2"),
        pytest.param(
            AT2.replace("WAHO, 090", "WAHO,  090    "), "LOMA PRIETA 10/18/89, WAHO, 090", id="at2 with blanks"
        ),
        pytest.param("TITLE\n" + UNIT + COUNTS + BODY, "motion", id="at2 without title"),
        pytest.param(V2, "IMPERIAL VALLEY, CA EARTHQUAKE, EL CENTRO - HWY 8/MELOLAND OVERPASS, CHAN 1: 0 DEG", id="v2"),
        pytest.param(V2[V2.index("   10 POINTS OF ACCEL") :], "motion", id="v2 without header"),
        pytest.param(PAIRS, "motion", id="csv"),
    ],
)
def test_name(file, content, name):
    assert read_record(file(content), unit="g" if content is PAIRS else None).name == name


def test_path_may_be_a_string(file):
    assert read_record(str(file(AT2))).samples.shape == (7,)


# ------------------------------------------------------------------------------------- real records


def test_example_record():
    record = example_record()
    size = np.abs(record.samples)
    assert record.samples.shape == (5690,)
    assert record.dt == 0.01
    assert size.max() == pytest.approx(305.020 / 980.665, rel=1e-12)
    assert size.argmax() * record.dt == pytest.approx(4.06)
    assert record.samples[0] == pytest.approx(-1.72 / 980.665, rel=1e-12)
    assert record.name == "IMPERIAL VALLEY, CA EARTHQUAKE, EL CENTRO - HWY 8/MELOLAND OVERPASS, CHAN 2: 360 DEG"


# -------------------------------------------------------------------------------------------------------- ESM

ESM_HEADER = """EVENT_NAME: GREECE
MAGNITUDE_W:
STATION_NAME: Town Hall,Argos
DATE_TIME_FIRST_SAMPLE_YYYYMMDD_HHMMSS: 20190728_160919.870
SAMPLING_INTERVAL_S: 0.005000
NDATA: 5
STREAM: HNE
UNITS: cm/s^2
PGA_CM/S^2: -2.500000
DATA_TYPE: ACCELERATION
USER5:
"""
ESM_SAMPLES = [0.0, 1.25, -2.5, 0.000001, -0.75]
ESM = ESM_HEADER + "".join(f"{x:.6f}\n" for x in ESM_SAMPLES)


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(ESM, id="as it is"),
        pytest.param(ESM.rstrip(), id="no end of line"),
        pytest.param(ESM.replace("NDATA", "DURATION_S: 0.025\nNDATA"), id="duration"),
        pytest.param(ESM.replace("\n", "\r\n"), id="CRLF"),
        pytest.param(ESM.replace("PGA_CM/S^2: -2.500000\n", ""), id="no peak"),
    ],
)
def test_esm(file, content):
    record = read_record(file(content, "motion.ASC"))
    np.testing.assert_allclose(record.samples, np.array(ESM_SAMPLES) / (100 * STANDARD_GRAVITY), rtol=1e-15)
    assert float(record.dt) == 0.005
    assert record.name == "GREECE, Town Hall,Argos, HNE"


@pytest.mark.parametrize(
    "content, given, message",
    [
        (ESM.replace("NDATA: 5", "NDATA: 6"), {}, "announces 6 samples, but 5 follow"),
        (ESM.replace("NDATA: 5", "NDATA:"), {}, "must state a number as NDATA, but states ''"),
        (ESM.replace("0.005000", "0"), {}, "which is not positive"),
        (ESM.replace("cm/s^2", "g"), {}, "line 9 states a peak of 2.5 cm/s2, but the largest sample is 2451"),
        (
            ESM.replace("NDATA", "DURATION_S: 0.025\nNDATA").replace(".005000", ".050000"),
            {},
            "line 6 states 0.025 s, but",
        ),
        (ESM.replace("ACCELERATION", "VELOCITY"), {}, "line 10 states velocity"),
        (ESM.replace("cm/s^2", "cm/s"), {}, "line 8 states the unit 'cm/s'"),
        (ESM.replace("1.250000", "1.25OOOO"), {}, "line 13 should hold samples"),
        (ESM.replace("PGA_CM/S^2: -2.5", "PGA_CM/S^2: -2500.0"), {}, "line 9 states a peak of 2500"),
        (ESM, {"column": 0}, "`column` must be None"),
        (ESM, {"dt": 0.01}, "`dt` must agree"),
        (ESM, {"unit": "g"}, "`unit` must agree"),
        (TITLES + UNIT + COUNTS + BODY, {"format": "esm"}, "must state a number as SAMPLING_INTERVAL_S"),
    ],
)
def test_esm_that_is_wrong(file, content, given, message):
    with pytest.raises(ValueError, match=message):
        read_record(file(content, "motion.ASC"), **given)


def test_esm_that_is_cut_anywhere(file):
    """Nowhere a wrong record: refused, or nothing is missing but the end of the last line."""
    whole = read_record(file(ESM, "whole.ASC"), format="esm")
    for end in range(len(ESM) - 1):
        try:
            record = read_record(file(ESM[:end], "cut.ASC"), format="esm")
        except ValueError:
            continue
        np.testing.assert_array_equal(record.samples, whole.samples)
        assert end == len(ESM) - 1


def test_an_at2_file_that_is_cut_within_its_last_number(tmp_path):
    """Anywhere: every digit that is missing would be a sample ten times as large, or less exact."""
    numbers = [f"{x:15.7E}" for x in (0.0, 1.5e-3, -2.25e-3, 4.125e-2, -1.0e-4)]
    whole = f"PEER\nTITLE\nACCELERATION TIME SERIES IN UNITS OF G\nNPTS=  5, DT=  .0050 SEC\n{''.join(numbers)}\n"
    path = tmp_path / "cut.AT2"
    for missing in range(len(numbers[-1].strip()) + 1):
        path.write_text(whole[: len(whole) - missing])
        if missing <= 1:  # the end of the line
            np.testing.assert_array_equal(read_record(path).samples, [0.0, 1.5e-3, -2.25e-3, 4.125e-2, -1.0e-4])
        else:
            with pytest.raises(ValueError, match="cut off|announces 5 samples|should hold samples"):
                read_record(path)


def test_a_column_is_no_record():
    """Check that a column of a file is refused: it would be many records of one sample."""
    with pytest.raises(ValueError, match=r"Argument `acceleration` must have its samples along the last axis"):
        Record(np.ones((500, 1)), 0.01)
