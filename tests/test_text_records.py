"""Accelerograms as people's files hold them: words around numbers, wrapped rows, ends without a line end."""

import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from jaxrock.motions.files.parsing import PER_G, unit_named
from jaxrock.motions.files.reading import read_record
from references.damaged_files import FILES, SAMPLES

VALUES = np.array([-0.00669, 0.02654, 0.0362, -0.25554, 0.1, 0.00023, -0.0411, 0.05, 0.00959, -0.1569, 0.135])


@pytest.fixture
def file(tmp_path):
    """Write a file, by default motion.txt, and return its path."""

    def write(content, name="motion.txt"):
        path = tmp_path / name
        path.write_bytes(content.encode())
        return path

    return write


# ------------------------------------------------------------------------------------------- units


@pytest.mark.parametrize(
    "written, unit",
    [
        ("g's", "g"), ("G’S", "g"), ("CMS/SEC/SEC", "cm/s2"), ("cm/sec**2", "cm/s2"),
        ("cm per second squared", "cm/s2"),
        ("metres per sec per sec", "m/s2"), ("meters/second^2", "m/s2"), ("Gals", "cm/s2"), ("mm/s/s", "mm/s2"),
        ("mm s⁻2", "mm/s2"), ("mm/s²", "mm/s2"), ("mg", None), ("km/s2", None), ("cm/s", None),
        ("cms", None), ("g's squared", None),
    ],
)  # fmt: skip
def test_spellings_of_units(written, unit):
    assert unit_named(written) == unit


def test_millimetres(file):
    told = "".join(f"{0.01 * k:.2f},{9806.65 * x:.4f}\n" for k, x in enumerate(VALUES))
    for record in (read_record(file(f"t [s],a [mm/s2]\n{told}")), read_record(file(told), unit="mm/s2")):
        np.testing.assert_allclose(record.samples, VALUES, atol=1e-8)
        assert record.origin.unit == "mm/s2"


# ------------------------------------------------------------------------- refused without need


@pytest.mark.parametrize(
    "line, unit",
    [
        ("The units are (g)", "g"), ("Units are in CM/SEC/SEC", "cm/s2"), ("ACCELERATION, UNITS: [m/s2]", "m/s2"),
        ("UNIT IS G", "g"), ("Unit: gal", "cm/s2"), ("UNITS=(G)", "g"), ("ACCELERATION IN UNITS OF G's", "g"),
        ("ACCELERATION TIME HISTORY IN UNITS OF {mm/s2}", "mm/s2"),
    ],
)  # fmt: skip
def test_at2_states_its_unit_in_words(file, line, unit):
    path = file(FILES["AT2"].text.replace("ACCELERATION IN UNITS OF G", line))
    record = read_record(path)
    np.testing.assert_allclose(record.samples, SAMPLES / PER_G[unit], rtol=1e-7)
    assert record.origin.unit == unit
    with pytest.raises(ValueError, match="Argument `unit` must agree with file `motion.txt`"):
        read_record(path, unit="g" if unit != "g" else "cm/s2")


@pytest.mark.parametrize("line", ["The units are (ft)", "UNITS OF COUNTS", "Unit: mg", "UNITS ARE G/10"])
def test_at2_in_units_that_are_no_accelerations(file, line):
    with pytest.raises(ValueError, match="line 3 states the unit '"):
        read_record(file(FILES["AT2"].text.replace("ACCELERATION IN UNITS OF G", line)), unit="g")


COSMOS_END = ["End of data for channel 1 acceleration", "END OF DATA", "End-of-data for Chan 1", "/& ---", "the end"]


@pytest.mark.parametrize("end", COSMOS_END)
@pytest.mark.parametrize("ended", ["\n", ""])
def test_the_end_of_cosmos_data_in_any_words(file, end, ended):
    text = FILES["COSMOS"].text
    record = read_record(file(text[: text.index("End-of-data")] + end + ended))
    np.testing.assert_allclose(record.samples, SAMPLES, rtol=1e-4, atol=1e-7)


def as_in_1992(values=SAMPLES, form="%9.6f", count=None, rate="200", peak=None, unit="G"):
    """Write an uncorrected file of CSMIP whose samples are announced as in a corrected one."""
    peak = np.abs(values).max() if peak is None else peak
    head = "UNCORRECTED ACCELEROGRAM DATA              PROCESSED: 06/16/98, CDMG 99999\n" + "text\n" * 9
    head += f"NO. OF POINTS = {count or values.size:6d}  RECORD LENGTH =   .110 SEC   AT {rate} SAMPLES/SEC\n"
    head += f"UNITS OF UNCOR ACCEL IS {unit}.                 MAX  = {peak:7.3f} {unit}, AT    .1 SEC.\ntext\n"
    head += "".join("    0" * 16 + "\n" for _ in range(7)) + "".join("      .000" * 8 + "\n" for _ in range(7))
    rows = ["".join(form % x for x in values[k : k + 8]) for k in range(0, values.size, 8)]
    announced = f"{values.size:5d} POINTS OF ACCEL DATA EQUALLY SPACED AT .005 SEC.  (UNITS: {unit})\n"
    return head + announced + "\n".join(rows) + "\n/&  ----------  END OF DATA FOR CHANNEL  1  ----------\n"


@pytest.mark.parametrize("form", ["%9.6f", "%10.6f", "%8.5f", "%12.7f", "%10.3E"])
@pytest.mark.parametrize("ending", ["/&  ----------  END OF DATA FOR CHANNEL  1  ----------\n", ""])
def test_v1_that_announces_as_v2(file, form, ending):
    """Check any width of the columns, which no line states."""
    text = as_in_1992(form=form)
    record = read_record(file(text[: text.index("/&")] + ending))
    np.testing.assert_array_equal(record.samples, [float(form % x) for x in SAMPLES])
    assert (record.dt, record.origin.format, record.origin.unit) == (0.005, "v1", "g")


def test_channels_of_v1_that_announce_as_v2(file):
    path = file(as_in_1992() + as_in_1992(-2 * SAMPLES))
    np.testing.assert_allclose(read_record(path, column=1).samples, -2 * SAMPLES, atol=1e-6)


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"count": 24}, "line 11 states 24 samples, but line 28 23"),
        ({"rate": "100"}, "line 11 states 100 samples a second, but line 28 200"),
        ({"peak": 9.81 * np.abs(SAMPLES).max()}, "line 12 states a peak of .* g, but the largest sample is"),
        ({"unit": "CM/SEC"}, "line 28 states the unit 'CM/SEC'"),
    ],
)
def test_v1_that_contradicts_itself(file, changed, message):
    with pytest.raises(ValueError, match=f"^File `motion.txt`: {message}"):
        read_record(file(as_in_1992(**changed)))


def test_a_sample_is_missing_where_no_width_is_stated(file):
    with pytest.raises(ValueError, match="^File `motion.txt`: (line 29 should hold samples|header announces 23)"):
        read_record(file(as_in_1992().replace(f"{SAMPLES[2]:9.6f}", "", 1)))


@pytest.mark.parametrize("unit, per", [("CM/SEC/SEC", 1.0), ("G", 980.665), ("CM/SEC**2,", 1.0)])
@pytest.mark.parametrize("factor", [1.0, 9.81])
def test_peaks_of_v2_are_compared_in_any_unit(file, unit, per, factor):
    stated = factor * np.abs(SAMPLES).max() * 980.665 / per
    text = FILES["V2"].text
    line = next(line for line in text.splitlines() if "PEAK" in line)
    path = file(text.replace(line, f"PEAK ACCELERATION = {stated:9.3f}    {unit}  AT     .020   SEC."))
    if factor == 1.0:
        np.testing.assert_allclose(read_record(path).samples, SAMPLES, atol=1e-6)
    else:
        with pytest.raises(ValueError, match="line 2 states a peak of"):
            read_record(path)


def pairs(values=VALUES, form="%r"):
    return "".join(f"{0.01 * k:.2f},{form % x}\n" for k, x in enumerate(values.tolist()))


def test_a_file_without_a_line_end_is_read_with_a_warning(file):
    """Editors and spreadsheets write such files: numbers of unlike length, and none after them."""
    text = "time [s],acc [g]\n" + pairs().rstrip()
    with pytest.warns(UserWarning, match="File `motion.txt`: line 12 ends without a line end, .* '0.135', may be cut"):
        record = read_record(file(text))
    np.testing.assert_array_equal(record.samples, VALUES)
    for end in ("\n", ",", " ", "  # the last", "\n# 11 samples"):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            np.testing.assert_array_equal(read_record(file(text + end)).samples, VALUES)


@pytest.mark.parametrize(
    "before, last",
    [
        (["0.25", "-0.125", "0.0625"], "0.1"),
        (["0.25", "-0.125", "0.0625"], "0."),
        (["1.5e-03", "-2.25e-03", "1e-03"], "1.25e-0"),
        (["1.5e-03", "-2.25e-03", "1e-03"], "1.25"),
        ([" 1200", "  -25", "   17"], "  -1"),
        ([" 1200", "  -25", "   17"], "   1"),
    ],
)
def test_a_last_number_shorter_than_its_column_is_refused(file, before, last):
    with pytest.raises(ValueError, match="^File `motion.txt`: line 4 ends without a line end, and .* may be cut off"):
        read_record(file("\n".join([*before, last])), dt=0.01, unit="cm/s2")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert read_record(file("\n".join([*before, last, ""])), dt=0.01, unit="cm/s2").samples.size == 4


@pytest.mark.parametrize("spare", ["", ",", ",,", ", ,  ,"])
@pytest.mark.parametrize("titles", ["", "time [s],acc [g]", "time [s],acc [g],note", "time [s],acc [g],,"])
@pytest.mark.parametrize("end", ["", ",,,\n", ",\n,,\n\n"])
def test_empty_columns_and_rows_at_the_end(file, spare, titles, end):
    """Check tables as spreadsheets save them."""
    if "note" in titles and not spare:
        return  # a title without a column is refused
    text = (titles + spare * ("," not in titles[-2:]) + "\n" if titles else "") + pairs().replace("\n", spare + "\n")
    record = read_record(file(text + end), unit="g")
    np.testing.assert_array_equal(record.samples, VALUES)
    assert record.dt == 0.01


@pytest.mark.parametrize(
    "text, message",
    [
        ("0.00,0.1\n,\n0.02,0.3\n", "line 2 has empty fields only, but numbers follow: ','"),
        ("0.00,0.1,,\n0.01,,,\n", "line 2 has 1 column, but line 1 has 2"),
        ("0.00,0.1,,\n0.01,0.2,,0.3\n", "line 2 should hold numbers only"),
        ("0.00,,0.1\n0.01,,0.2\n", "line 1 holds more than numbers"),
        ("t [s],a [g],note\n0.00,0.1\n0.01,0.2\n", "line 1 has 3 titles, but 2 columns of numbers follow"),
        ("t [s],a [g],b,c\n0.00,0.1,\n0.01,0.2,\n", "line 1 has 4 titles, but 2 columns of numbers follow"),
    ],
)
def test_fields_that_are_empty_between_numbers(file, text, message):
    with pytest.raises(ValueError, match=f"^File `motion.txt`: {message}"):
        read_record(file(text), unit="g")


# ------------------------------------------------------------------------------ words around numbers


def table(columns=1, separator=" ", values=VALUES):
    """Times and accelerations."""
    rows = ([f"{0.01 * k:.2f}", *(f"{(j + 1) * x:.6f}" for j in range(columns))] for k, x in enumerate(values.tolist()))
    return "".join(separator.join(row) + "\n" for row in rows)


WORDS = [
    ("# Time (s),Acceleration (g's)", "g"), ("The units are (g)", "g"), 
    ("%Made up. Acc. in cm/sec^2 and dt=0.01 sec.", "cm/s2"),
    ("# North-south acceleration (cm/s/s)", "cm/s2"), ("#AmplitudeUnit:  gal. DCoffset(corr)", "cm/s2"),
    ("ACCELERATION IN CMS/SEC/SEC", "cm/s2"), ("acceleration values are given in mm/s2", "mm/s2"),
    ("# Acceleration data {m/s/s}", "m/s2"), ("# Acc_units = m/s^2", "m/s2"), ("% Units_of_data: g's", "g"),
    ("# Column 1: Time (s)\n# Column 2: acceleration (cm/s/s) (+ is up)", "cm/s2"), ("# acc [Gal]", "cm/s2"),
    ("#Col. 0 = t (s)\n#Col. 1 = a (m/s2)", "m/s2"), ("# VelocityUnit: cm/s\n# AccUnit: gal", "cm/s2"),
    ("# Duration (s): 40\n# acceleration time history (g)", "g"), ("# Units: gal\n# PGA = 0.0002606 g", "cm/s2"),
]  # fmt: skip


@pytest.mark.parametrize("header, unit", WORDS)
@pytest.mark.parametrize("separator", [" ", ",", "\t"])
def test_a_unit_in_words_is_a_unit(file, header, unit, separator):
    path = file(f"{header}\n{table(1, separator)}")
    record = read_record(path)
    np.testing.assert_allclose(record.samples, VALUES / PER_G[unit], rtol=1e-12)
    assert (record.origin.unit, record.dt) == (unit, 0.01)
    for other in set(PER_G) - {unit}:
        with pytest.raises(ValueError, match="Argument `unit` must agree with file `motion.txt`, which is in"):
            read_record(path, unit=other)


COMMENTS = [
    "# PGA (cm/s2): 251", "#RecordLength(sec): 1.2", "#Duration(s): 40", "# Duration(s) 40", "#dt(s): 0.02",
    "#T(s): 0.5",
    "%1979 Some Valley Earthquake, El Centro. First column holds NS", "# Station: El Centro, NS", "# Vs30 (m/s): 213",
    "# Magnitude: 6.5, distance (km): 12", "# peak 251 cm/s2 here", "# Kobe 1995, JMA", "# M = 6.9, R = 12",
    "# Filter (Hz): 0.1 25", "# VelocityUnit: cm/s", "# peak acceleration (g) at 3 s: 0.25", "# scale 9.81 m/s2",
]  # fmt: skip


@pytest.mark.parametrize("comment", COMMENTS)
@pytest.mark.parametrize("columns", [1, 2, 3, 4])
@pytest.mark.filterwarnings("ignore:.*states a peak of")
def test_values_and_prose_are_neither_titles_nor_units(file, comment, columns):
    """Check any number of columns, as words of a comment may be as many."""
    path = file(f"{comment}\n{table(columns)}")
    record = read_record(path, column=columns, unit="g")
    np.testing.assert_allclose(record.samples, columns * VALUES, atol=1e-9)
    assert (record.origin.component, record.dt) == ("", 0.01)
    with pytest.raises(ValueError, match="Argument `unit` must be .* for text file `motion.txt`, which states none"):
        read_record(path, column=columns)


@pytest.mark.parametrize(
    "header, message",
    [
        ("# units: g\n# acceleration in cm/s2", "line 1 states the unit 'g', but line 2 'cm/s2'"),
        ("# acceleration (g)\n\n# Acceleration data (gal)", "line 1 states the unit 'g', but line 3 'gal'"),
        ("# Column 1: t (s)\n# Column 2: a (g)\n# Units: cm/s2", "line 2 states the unit 'g', but line 3 'cm/s2'"),
        ("# Column 2: a (g)\n# Column 2: b (g)", "line 2 titles column 2 once more"),
        ("# Column 1: t (s)\n# Column 2: velocity (cm/s)", "line 2 states the unit 'cm/s'"),
        ("# Acceleration (ft/s2)", "line 1 states the unit 'ft/s2'"),
        ("#AmplitudeUnit: counts", "line 1 states the unit 'counts'"),
    ],
)
def test_words_that_contradict_one_another(file, header, message):
    with pytest.raises(ValueError, match=f"^File `motion.txt`: {message}"):
        read_record(file(f"{header}\n{table()}"), unit="g")


@st.composite
def headers(draw):
    """Draw a header that states one unit in words, between comments that state none."""
    units = ["g", "g's", "G", "m/s2", "m/s/s", "m/s^2", "cm/s2", "CM/SEC/SEC", "gal", "mm/s2", "ft/s2"]
    unit = draw(st.sampled_from(units))
    left, right = draw(st.sampled_from(["()", "[]", "{}"]))
    words = [
        f"Acceleration {left}{unit}{right}", f"The units are {left}{unit}{right}", f"Units: {unit}", f"AccUnit: {unit}",
        f"acceleration values are in {unit}", f"UNITS OF {left}{unit}{right}", f"Acc. in {unit} and dt=0.01 sec.",
        f"Column 2: acceleration {left}{unit}{right}", f"Acceleration data {left}{unit}{right} of a station",
    ]  # fmt: skip
    calm = [comment for comment in COMMENTS if "PGA" not in comment and "peak" not in comment]
    others = draw(st.lists(st.sampled_from(calm), max_size=3))
    mark = draw(st.sampled_from(["", "# ", "#", "% "]))
    lines = [*others, mark + draw(st.sampled_from(words))]
    separator = draw(st.sampled_from([" ", ",", "\t", ", ", ";"]))
    end = draw(st.sampled_from(["\n", "\r\n"]))
    return unit, "\n".join([*draw(st.permutations(lines)), table(1, separator)]).replace("\n", end)


@given(headers(), st.sampled_from([None, *PER_G]))
@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_units_in_words_by_chance(file, drawn, said):
    """Check that a unit in words is used, or the file is refused; the user's word never goes before it."""
    unit, text = drawn
    stated = unit_named(unit)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            record = read_record(file(text), unit=said)
        except ValueError as error:
            assert str(error).startswith(("File `motion.txt`: line ", "Argument `unit` must agree with file"))
            assert stated is None or said not in (None, stated)
            return
    assert stated is not None and said in (None, stated)
    np.testing.assert_allclose(record.samples, VALUES / PER_G[stated], rtol=1e-12)
    assert record.dt == 0.01


# ------------------------------------------------------------------------------------------- peaks

ONE = "".join(f"{x!r}\n" for x in VALUES.tolist())
PEAKS = [
    ("# PGA (cm/s2): {:.6g}", "cm/s2"), ("# PGA = {:.6g} g at 3.2 s", "g"),
    ("Peak acceleration in m/s2: {:.6g}", "m/s2"),
    ("# max. acc. -{:.6g} mm/s/s", "mm/s2"), ("# Acceleration: peak {:.6g} gal at 0.3 sec", "cm/s2"),
    ("# peak ground acceleration {:.6g} (g's)", "g"),
]  # fmt: skip


@pytest.mark.parametrize("line, stated", PEAKS)
@pytest.mark.parametrize("unit", list(PER_G))
@pytest.mark.parametrize(
    "text, given", [(table(2), {"column": 1}), (table(), {}), (ONE, {"layout": "rows", "dt": 0.01})]
)
def test_a_stated_peak_tells_the_unit(file, line, stated, unit, text, given):
    """Check that samples whose peak is the stated one in another unit are refused, whoever says the unit."""
    peak = np.abs(VALUES).max() / PER_G[unit] * PER_G[stated]
    path = file(f"{line.format(peak)}\n{text}")
    np.testing.assert_allclose(read_record(path, unit=unit, **given).samples, VALUES / PER_G[unit], rtol=1e-9)
    for other in set(PER_G) - {unit}:
        with pytest.raises(ValueError, match=f"Argument `unit` must be '{unit}' .* whose line 1 states a peak of"):
            read_record(path, unit=other, **given)
        with pytest.raises(ValueError, match="File `other.txt`: line 1 states a peak of .* but the largest sample is"):
            read_record(file(f"{line.format(peak)}\n# units: {other}\n{text}", "other.txt"), **given)


def test_a_peak_of_nothing_that_is_there_is_warned_of(file):
    path = file("# PGA (cm/s2): 313\n" + table(3))
    with pytest.warns(UserWarning, match="`motion.txt`: line 1 states a peak of 313 cm/s2, but the largest sample is"):
        read_record(path, unit="g", column=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for peak in (251, 502, 755):  # of any component, to 5 %
            read_record(file(f"# PGA (cm/s2): {peak}\n" + table(3)), unit="g", column=1)
        for line in (
            "# PGA: 313",
            "# PGA (cm/s2), PGV (cm/s): 313, 20",
            "# magnitude 6.9, g",
            "# peak velocity 3 cm/s",
        ):
            read_record(file(f"{line}\n" + table(3)), unit="g", column=1)


@pytest.mark.parametrize(
    "unit, likely, times",
    [("g", "m/s2", "9.807"), ("g", "cm/s2", "980.7"), ("m/s2", "cm/s2", "100"), ("cm/s2", "mm/s2", "10")],
)
def test_a_file_beyond_3_g_names_the_likely_unit(file, unit, likely, times):
    values = VALUES / np.abs(VALUES).max() * 0.9 * PER_G[likely]
    with pytest.warns(
        UserWarning, match=f"`motion.txt` .* is its unit {unit}.* unit is {likely}, it holds 0.9 g .{times} "
    ):
        read_record(file(table(values=values)), unit=unit)


@pytest.mark.parametrize("factor", [1.0, 980.665, 9.81])
def test_peaks_of_cosmos_are_compared_in_any_unit(file, factor):
    """Check a file in g, whose header states the peak in g or in cm/s2."""
    head, body = FILES["COSMOS"].text.replace("cm/sec2(04)", "g(02)").split("acceleration pts")
    old = f"{np.abs(SAMPLES * 980.665).max():15.6f}"
    announced, *numbers = body.split("\n")
    numbers = [f"{float(x) / 980.665:15.6e}" if x.startswith(" ") else x for x in numbers]
    text = head.replace(old, f"{np.abs(SAMPLES).max() * factor:15.6f}") + "\n".join(
        ["acceleration pts" + announced, *numbers]
    )
    if factor == 9.81:
        with pytest.raises(ValueError, match="the header states a peak of"):
            read_record(file(text))
    else:
        np.testing.assert_allclose(read_record(file(text)).samples, SAMPLES, rtol=1e-5)
