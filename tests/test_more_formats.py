"""V1, V3, COSMOS, SMC and K-NET, where records come from, components, ObsPy's traces, writing, a million samples."""

import time
import types
import warnings

import numpy as np
import pytest
import scipy.signal

import jaxrock as rk
from jaxrock.motions.components import _together as together
from references.damaged_files import FILES, SAMPLES

CM = 980.665
COSMOS, SMC, KNET, V1, V3 = (FILES[name].text for name in ("COSMOS", "SMC", "K-NET", "V1", "V3"))
PAIRS = FILES["V1 with times"].text


@pytest.fixture
def file(tmp_path):
    """Write a file and return its path."""

    def write(content, name="motion.txt"):
        path = tmp_path / name
        path.write_text(content)
        return path

    return write


@pytest.mark.parametrize(
    "text, dt, kind",
    [
        pytest.param(COSMOS, 0.005, "cosmos", id="COSMOS V2"),
        pytest.param(COSMOS.replace("Corrected", "Uncorrected"), 0.005, "cosmos", id="COSMOS V1"),
        pytest.param(COSMOS.replace("acceleration pts", "uncorrected accel. pts"), 0.005, "cosmos", id="COSMOS words"),
        pytest.param(COSMOS[: COSMOS.index("End-of")], 0.005, "cosmos", id="COSMOS without end"),
        pytest.param(SMC, 0.005, "smc", id="SMC"),
        pytest.param(SMC.replace("\n", "\r\n"), 0.005, "smc", id="SMC with CRLF"),
        pytest.param(SMC.replace("2 CORRECTED", "1 UNCORRECTED"), 0.005, "smc", id="SMC uncorrected"),
    ],
)
def test_formats_of_fixed_places(file, text, dt, kind):
    """Found from the content alone."""
    record = rk.read_record(file(text))
    np.testing.assert_allclose(record.samples, SAMPLES, rtol=1e-4, atol=1e-7)
    assert (float(record.dt), record.origin.format, record.origin.unit) == (dt, kind, "cm/s2")


@pytest.mark.parametrize("name", ["motion.NS", "motion.txt"])
def test_knet_takes_the_offset_off(file, name):
    record = rk.read_record(file(KNET, name))
    counts = np.array(KNET.split("Memo.")[1].split(), float)
    np.testing.assert_allclose(record.samples, (counts - counts.mean()) * 3920 / 6182761 / CM, rtol=1e-12)
    assert float(record.dt) == 0.01


def test_knet_peaks_are_rounded_in_print(file):
    """NIED prints three decimals: of peaks below 0.5 gal that is more than a thousandth."""
    head, body = KNET.split("Memo.")
    counts = np.rint(np.array(body.split(), float) / 300)
    peak = np.abs(counts - counts.mean()).max() * 3920 / 6182761
    head = head[: head.index("Max. Acc.")]
    written = head + "Max. Acc. (gal)   {}\nMemo.\n" + "\n".join(f"{x:.0f}" for x in counts) + "\n"
    assert abs(round(peak, 3) - peak) > 1e-3 * peak
    np.testing.assert_allclose(np.abs(rk.read_record(file(written.format(f"{peak:.3f}"))).samples).max(), peak / CM)
    with pytest.raises(ValueError, match="line 9 states a peak of"):
        rk.read_record(file(written.format(f"{peak + 0.002:.3f}")))


@pytest.mark.parametrize(
    "text, name, message",
    [
        (COSMOS.replace("      23 acc", "      22 acc"), "a.V2c", "announces 22 samples, but 23 follow"),
        (COSMOS.replace("acceleration pts", "velocity pts"), "a.V2c", "announces velocity, but samples must be"),
        (COSMOS.replace("cm/sec2(04)", "counts(50)"), "a.V2c", "states the unit 'counts'"),
        (COSMOS.replace("approx    0 secs", "approx  120 secs"), "a.V2c", "23 samples in 120 s, but the header a time"),
        (COSMOS.replace("Real-header", "Whole-header"), "a.V2c", "no line announces 'Real-header values'"),
        (COSMOS.replace("e+01\n", "e+02\n", 3), "a.V2c", "the header states a peak of"),
        (COSMOS.replace("acceleration pts", ""), "a.V2c", "no line announces 'acceleration pts'"),
        (SMC.replace("2 CORRECTED ACCELEROGRAM", "3 VELOCITY"), "a.smc", "line 1 states velocity"),
        (SMC.replace("        23    -32768", "        24    -32768"), "a.smc", "announces 24 samples, but 23 follow"),
        (SMC.replace("\n|\n", "\n"), "a.smc", "announces 1 lines of comments, which are not there"),
        (SMC.replace("2.0000000E+02", "0.0000000E+02"), "a.smc", "states 0 samples a second"),
        (SMC.replace("2.0000000E+02", "1.7000000E+38"), "a.smc", "line 18 states no samples a second, so the file"),
        (SMC.replace("    -32768      ", "    -3276x      ", 1), "a.smc", "lines 12 to 27 should hold"),
        (SMC.replace("E+1", "E+2", 2), "a.smc", "the header states a peak of"),
        (KNET.replace("100Hz", "50Hz"), "a.NS", "announces 12 samples, but 24 follow"),
        (KNET.replace("(gal)/", "(cm)/"), "a.NS", "must state a number as 'Scale Factor'"),
        (KNET.replace("3920", "39200"), "a.NS", "line 9 states a peak of"),
        (KNET.replace("100Hz", "0Hz"), "a.NS", "must state a positive frequency"),
        ("RESPONSE AND FOURIER AMPLITUDE SPECTRA\n 1 2 3\n", "a.V3", r"holds response spectra \(V3\)"),
        (
            "Response spectra  (Format v01.20 with 13 text lines)\n 1 2 3\n",
            "a.V3c",
            r"holds response spectra \(COSMOS V3\)",
        ),
        (V1.replace(" 23 Acc", " 22 Acc"), "a.V1", "announces 22 samples, but 23 follow"),
        (V1.replace("units of g .", "units of g/10"), "a.V1", "line 12 states a peak of 0.[0-9]+ g, but the largest"),
        (V1.replace("units of g .", "units of g/100"), "a.V1", "line 28 states the unit 'g/100'"),
        (V1.replace("units of g .", "units of counts ."), "a.V1", "line 28 states the unit 'counts'"),
        (V1.replace("at 200 pts", "at 0 pts"), "a.V1", "line 28 states 0 samples a second"),
        (V1[: V1.index(" 23 Acc")], "a.V1", "header must state 'No. of points' and 'Units"),
        (PAIRS.replace("=     23", "=     24"), "a.V1", "announces 48 times and samples, but 46 follow"),
        (PAIRS.replace("SEC AND G/10", "SEC AND G"), "a.V1", "line 12 states a peak of"),
        (PAIRS.replace("  0.010 ", "  0.030 "), "a.V1", "the times of its samples do not increase"),
        (PAIRS.replace("\n    0    0", "\n    x    0", 1), "a.V1", "lines 14 to 27 should hold the numbers"),
        (PAIRS.replace("UNCORRECTED", "SOME"), "a.V1", "no line begins with 'Uncorrected accelerogram data'"),
    ],
)
def test_what_is_mislabelled_is_refused(file, text, name, message):
    assert text not in (COSMOS, SMC, KNET, V1, PAIRS), "nothing was replaced"
    with pytest.raises(ValueError, match=f"^File `{name}`: .*{message}"):
        rk.read_record(file(text, name))


@pytest.mark.parametrize(
    "text, origin",
    [
        (SMC, ("Loma Prieta, CA", "San Francisco, 1295 Shafter, F", "360", "1989 10 18 0004", "SAF0A", "smc", "cm/s2")),
        (KNET, ("2011/03/11 14:46:00 M9.0", "MYG004", "N-S", "2011/03/11 14:46:21 JST", "MYG004", "knet", "cm/s2")),
        (FILES["AT2"].text, ("LOMA PRIETA 10/18/89", "WAHO", "090", "", "", "at2", "g")),
        (FILES["ESM"].text, ("GREECE", "", "", "", "", "esm", "cm/s2")),
    ],
)
def test_origin(file, text, origin):
    assert tuple(rk.read_record(file(text)).origin) == (*origin, "motion.txt")


@pytest.mark.parametrize(
    "said, station, component",
    [
        ("station = APEEL Array #2 - Redwood City  component=   up", "APEEL Array #2 - Redwood City", "up"),
        ("station = Del Valle Dam, crest           component=     65", "Del Valle Dam, crest", "65"),
        ("station = El Centro                      component=", "El Centro", ""),
        ("station = El Centro", "El Centro", ""),
        ("*", "", ""),
    ],
)
def test_station_and_component_of_smc(file, said, station, component):
    """The name ends where its place does, not at a comma; without a component a vertical one goes unnoticed."""
    was = "station = San Francisco, 1295 Shafter, F component=    360"
    assert rk.read_record(file(SMC.replace(was, said))).origin[1:3] == (station, component)


USC = """CORRECTED ACCELEROGRAM  IIBB127  94.610.0 COMP {0}   FILE   0  CORRESPONDING T
FILE     0 OF UNCORRECTED ACCELEROGRAM DATA OF VOLUME I:
NORTHRIDGE EARTHQUAKE                                                   21
JAN 17, 1994 -1230 GMT                                                  22
IBB127  94.610.0 N                                                      18
STATION USC# 0061   34 17 11N, 118 13 31W                               39
BIG TUJUNGA STATION, ANGELES NATIONAL FOREST, CA                        48
COMP {0}                                                               9
   2 POINTS OF ACC DATA EQUALLY SPACED AT  .020 SEC. IN UNITS CM/SEC/SEC
    98.067   -49.033
"""


def test_components_of_usc(file):
    """They stand behind the word COMP."""
    paths = [file(USC.format(each), each.strip()) for each in ("UP  ", "N08W", "S82W")]
    found = rk.motions.read_components(paths)
    assert [each.origin.component for each in (found.first, found.second, found.vertical)] == ["N08W", "S82W", "UP"]
    assert found.first.name == "NORTHRIDGE EARTHQUAKE, BIG TUJUNGA STATION, ANGELES NATIONAL FOREST, CA, COMP N08W"


# --------------------------------------------------------------------------------------------- V1 and V3


@pytest.mark.parametrize(
    "text, digits, dt, unit",
    [
        pytest.param(V1, 1e-12, 0.005, "g", id="samples"),
        pytest.param(V1[: V1.index("/&")], 1e-12, 0.005, "g", id="without end"),
        pytest.param(PAIRS, 5e-5, 0.01, "g", id="times and tenths of g"),
        pytest.param(V1 + V1.replace("Channel  1", "Channel  2"), 1e-12, 0.005, "g", id="two channels"),
    ],
)
def test_uncorrected_accelerograms(file, text, digits, dt, unit):
    record = rk.read_record(file(text))
    np.testing.assert_allclose(record.samples, SAMPLES, atol=digits)
    assert (float(record.dt), record.origin.format, record.origin.unit) == (dt, "v1", unit)


def test_channels_and_origin_of_an_uncorrected_accelerogram(file):
    lines = V1.splitlines()
    lines[1], lines[3] = (
        "Record of Mon Feb 13, 2012 13:06:45.0 PST             (Avol1 v9.2)",
        "Start time:  2/13/12, 21:06",
    )
    lines[4], lines[5], lines[6] = (
        "Station No. 89146   40.941N, 123.633W",
        "Willow Creek          CGS",
        "Chan  1: 360 Deg",
    )
    first, second = "\n".join(lines) + "\n", "\n".join(lines).replace("Chan  1: 360 Deg", "Chan  2:  Up") + "\n"
    record = rk.read_record(file(first + second), column=1)
    expected = "Record of Mon Feb 13, 2012 13:06:45.0 PST", "Willow Creek", "Up", "2/13/12, 21:06", "89146"
    assert tuple(record.origin)[:5] == expected
    with pytest.raises(ValueError, match="`column` must be 0 to 1, a channel of V1 file"):
        rk.read_record(file(first + second), column=2)


def test_times_that_are_not_equally_spaced(file):
    """As film was digitised: straight lines between the samples are followed, at the step that is asked for."""
    path = file(PAIRS.replace("  0.050 ", "  0.057 "))
    with pytest.raises(ValueError, match="`dt` must be given for file `motion.txt`, whose samples are not equally"):
        rk.read_record(path)
    times = 0.01 * np.arange(23)
    times[5] = 0.057
    record = rk.read_record(path, dt=0.001)
    expected = np.interp(0.001 * np.arange(221), times, np.round(10 * SAMPLES, 3) / 10)
    np.testing.assert_allclose(record.samples, expected, atol=1e-12)


def test_response_spectra(file):
    found = rk.motions.read_spectra(file(V3))
    period = np.array([0.1, 0.2, 0.5])
    np.testing.assert_array_equal(found.period, period)
    np.testing.assert_array_equal(found.damping, [0.02, 0.05])
    for row, damping in enumerate(found.damping):
        np.testing.assert_allclose(found.displacement[row], 0.0254 * period / (1 + damping), rtol=6e-4)
        np.testing.assert_allclose(found.velocity[row], 6 * 0.0254 * period / (1 + damping), rtol=6e-4)
        np.testing.assert_allclose(found.acceleration[row], period / (1 + damping), rtol=6e-4)
        np.testing.assert_allclose(found.pseudo_velocity[row], 0.0254 * 2 * np.pi / (1 + damping), rtol=6e-4)
    assert (found.origin.format, found.origin.unit) == ("v3", "inches")


def block_of(share):
    """The lines of one damping."""
    at = V3.index(f"Damping =  {share}")
    return V3[at : V3.index("Damping", at + 1) if "Damping" in V3[at + 1 :] else V3.index("/&")]


@pytest.mark.parametrize(
    "text, message",
    [
        (V3[: V3.index("/&")], "should end the channel: the file is cut off"),
        (V3.replace(block_of("0.02"), ""), r"states dampings \[0.02, 0.05\], but spectra follow for \[0.05\]"),
        (V3.replace("(3 periods", "(2 periods"), "announces 2 periods, but the numbers of a list go on"),
        (V3.replace("inches", "furlongs"), "header must state 1 to 100 periods, units of inches or cm"),
        (V3.replace("     0.200     0.500", "     0.500     0.200"), "the 3 periods before line 51 do not increase"),
        (V3.replace("     0.200     0.500", "     0.300     0.500"), "its pseudo-velocity at 0.3 s is not that of"),
        (V3.replace(" 9.804E-02", " 9.80XE-02"), "should hold samples, but is"),
        (V1, "no line begins with 'Response and Fourier amplitude spectra'"),
        ("Response spectra  (Format v01.20 with 13 text lines)\n 1 2 3\n", "is a V3 file of COSMOS"),
    ],
)
def test_spectra_that_are_refused(file, text, message):
    assert text != V3, "nothing was replaced"
    with pytest.raises(ValueError, match=f"^File `motion.txt`: .*{message}"):
        rk.motions.read_spectra(file(text))


# ------------------------------------------------------------------------------- whole files of an agency

CHANNELS, COUNT, RATE = ("360 Deg", "Up", "90 Deg"), 1603, 200
PERIODS, DAMPINGS = np.round(np.geomspace(0.04, 15.0, 91), 3), (0.0, 0.02, 0.05, 0.1, 0.2)


def columns(values, form, each):
    """Numbers in lines, as FORTRAN prints them, with the ends of lines of another system."""
    told = [form % value for value in values]
    return "".join("".join(told[k : k + each]) + "\r\n" for k in range(0, len(told), each))


def shaken(channel):
    """A made accelerogram of a channel [g], to the digits of a file."""
    time = np.arange(COUNT) / RATE
    return np.round(0.3 * np.sin((7 + 5 * channel) * time) * np.exp(-(((time - 3) / 1.5) ** 2)), 6)


def peaks(samples, period, damping):
    """Sd, Sv [inches, s] and Sa [g] by SciPy: of an oscillator relative to the ground, and its own acceleration."""
    omega = 2 * np.pi / period
    system = scipy.signal.lti(
        [[0, 1], [-(omega**2), -2 * damping * omega]], [[0], [-980.665 / 2.54]], np.eye(2), np.zeros((2, 1))
    )
    step = min(1 / RATE, period / 40)  # straight lines between samples
    time = np.arange(0, (COUNT - 1) / RATE, step)
    _, state, _ = scipy.signal.lsim(system, np.interp(time, np.arange(COUNT) / RATE, samples), time)
    own = (omega**2 * state[:, 0] + 2 * damping * omega * state[:, 1]) / (980.665 / 2.54)
    return np.abs(state[:, 0]).max(), np.abs(state[:, 1]).max(), np.abs(own).max()


def whole_v1(channel, name):
    head = ["Uncorrected Accelerogram Data             Processed: 02/13/12, CGS  146be002",
            "Record of Mon Feb 13, 2012 13:06:45.0 PST             (Avol1 v9.2)", "", "Start time:  2/13/12, 21:06 UTC",
            "Station No. 89146   40.941N, 123.633W", "Willow Creek - Fire Station              CGS",
            f"Chan  {channel + 1}: {name}", *[""] * 3, "Units of uncor data are sec and g .        "
            f"Max  = {np.abs(shaken(channel)).max():6.3f} g , at   3.010 sec.", "", ""]  # fmt: skip
    announced = f" {COUNT} Accelerogram points at {RATE} pts/sec in units of g .      Format: (8f9.6)\r\n"
    return (
        "\r\n".join(head) + "\r\n" + columns(np.zeros(100, int), "%5d", 16) + columns(np.zeros(50), "%10.3f", 8)
        + announced + columns(shaken(channel), "%9.6f", 8)
        + f"/&  ----------  End of Data for Channel  {channel + 1}  ----------\r\n"
    )  # fmt: skip


def whole_v3(channel, name, few):
    """Spectra by SciPy at the periods `few`, and ones that agree with each other at the others."""
    head = [f"Response and Fourier amplitude spectra ({PERIODS.size} periods,  .04 - 15.0 sec)   for",
            "Corrected accelerogram, band of 0.1 to 40 Hz", "", "Record of Mon Feb 13, 2012 13:06:45.0 PST", "",
            "Start time:  2/13/12, 21:06 UTC", "Station No. 89146   40.941N, 123.633W", "Willow Creek - Fire Station",
            f"Chan  {channel + 1}: {name}", *[""] * 12,
            "Units for spectra are inches and sec, except Sa is in fraction of g.", ""]  # fmt: skip
    room = np.zeros(100 - PERIODS.size)
    text = "\r\n".join(head) + "\r\n" + columns(np.zeros(100), "%10.3f", 8) + columns(DAMPINGS, "%10.3f", 8)
    text += columns([*PERIODS, *room], "%10.3f", 8) + "Fourier amplitude spectra in in/sec.\r\n"
    text += columns(np.zeros(100), "%10.2E", 8)
    for damping in DAMPINGS:
        spectra = np.stack([PERIODS, 2 * np.pi * np.ones_like(PERIODS), np.ones_like(PERIODS)])
        for k in few:
            spectra[:, k] = peaks(shaken(channel), PERIODS[k], damping)
        pseudo, times = 2 * np.pi * spectra[0] / PERIODS, np.full(PERIODS.size, 3.0)
        text += f"Damping = {damping:5.2f}. Data of Sd,Sv,Sa,Pssv,ttSd,ttSv,ttSa :\r\n"
        for values in (*spectra, pseudo, times, times, times):
            text += columns([*values, *room], "%10.3E", 8)
    return text + f"/&   ----------  End of spectral data for channel  {channel + 1}  ----------\r\n"


def test_three_channels_and_their_spectra(file):
    """A V1 and a V3 of one station: what is published of a channel is what its record's oscillators do, by SciPy."""
    few = (30, 60)
    record_file = "".join(whole_v1(*each) for each in enumerate(CHANNELS))
    spectra_file = "".join(whole_v3(*each, few) for each in enumerate(CHANNELS))
    for channel, name in enumerate(CHANNELS):
        record = rk.read_record(file(record_file), column=channel)
        np.testing.assert_allclose(record.samples, shaken(channel), atol=1e-12)
        assert (float(record.dt), record.samples.size, record.origin.component) == (1 / RATE, COUNT, name)
        found = rk.motions.read_spectra(file(spectra_file), channel=channel)
        assert found.origin.component == name and tuple(found.damping) == DAMPINGS
        np.testing.assert_array_equal(found.period, PERIODS)
        for row in (2, 3):
            for k in few:
                for pseudo, told in ((True, found.pseudo_velocity), (False, found.velocity)):
                    own = rk.intensity.spectral_velocity(record, PERIODS[k], DAMPINGS[row], pseudo)
                    assert told[row, k] == pytest.approx(float(own), rel=5e-3)
        with pytest.raises(ValueError, match="the file is cut off, or holds more"):
            whole = spectra_file[: spectra_file.rindex("/&")]
            rk.motions.read_spectra(file(whole), channel=2)
    assert rk.read_record(file(record_file.replace("\r\n", "\n")), column=1).origin.component == "Up"


# ------------------------------------------------------------------------------------------- components


def component(direction, factor=1):
    """A K-NET file of one direction."""
    peak = KNET.index("Max. Acc. (gal)")
    text = KNET[:peak] + KNET[KNET.index("Memo.") :]
    head, body = text.replace("Dir.              N-S", f"Dir.              {direction}").split("Memo.")
    counts = factor * np.array(body.split(), int)
    return head + "Memo.\n" + "".join(f" {x}\n" for x in counts)


@pytest.mark.parametrize("order", [("N-S", "E-W", "U-D"), ("U-D", "N-S", "E-W"), ("4", "6", "5")])
def test_components_are_known_by_what_they_say(file, order):
    factors = {"N-S": 1, "4": 1, "E-W": 2, "5": 2, "U-D": 3, "6": 3}
    paths = [file(component(each, factors[each]), f"motion{k}") for k, each in enumerate(order)]
    found = rk.motions.read_components(paths)
    one = rk.read_record(file(component("N-S"))).samples
    for part, factor in ((found.first, 1), (found.second, 2), (found.vertical, 3)):
        np.testing.assert_allclose(part.samples, factor * one, rtol=1e-12)


def cosmos(direction, factor):
    """A COSMOS record of one direction, as it stands in a file of several."""
    lines = COSMOS.replace("\n", f"\nSta Chan  1: {direction}\n", 1).splitlines()
    at = next(k for k, line in enumerate(lines) if "acceleration pts" in line)
    values = [f"{factor * float(x):15.6e}" for x in lines[at + 1 : -1]]
    text = "\n".join([*lines[: at + 1], *values, lines[-1]]) + "\n"
    return text.replace(f"{np.abs(SAMPLES * CM).max():15.6f}", f"{np.abs(factor * SAMPLES * CM).max():15.6f}")


def test_a_cosmos_file_of_several_records(file):
    """`column` says which; velocities of a channel, which stand beside its accelerations, are none."""
    others = cosmos("N", 1).replace("acceleration", "velocity")
    path = file(cosmos("UP", 3) + cosmos("N", 1) + others + cosmos("E", 2))
    for column, factor, name in ((None, 3, "UP"), (0, 3, "UP"), (1, 1, "N"), (2, 2, "E")):
        record = rk.read_record(path, column=column)
        np.testing.assert_allclose(record.samples, factor * SAMPLES, rtol=1e-5, atol=1e-7)
        assert record.origin.component == name
    with pytest.raises(ValueError, match="`column` must be 0 to 2, a channel of COSMOS file `motion.txt`, but is 3"):
        rk.read_record(path, column=3)
    found = rk.motions.read_components(path)
    for part, factor in ((found.first, 1), (found.second, 2), (found.vertical, 3)):
        np.testing.assert_allclose(part.samples, factor * SAMPLES, rtol=1e-5, atol=1e-7)
    with pytest.raises(ValueError, match="announces 23 samples, but 22 follow"):
        rk.read_record(file(cosmos("N", 1) + "\n".join(cosmos("E", 2).splitlines()[:-2]) + "\n"), column=1)


@pytest.mark.parametrize("comma", [",", ""])
def test_components_that_began_at_other_times_as_cosmos_tells_it(file, comma):
    def text(seconds):
        return COSMOS.replace("\n", f"\nRcrd start time:12/20/2021{comma} 20:13:{seconds} UTC (Q= 5)\n", 1)

    assert rk.read_record(file(text("10.750"))).origin.start == "12/20/2021 20:13:10.750"
    with pytest.raises(ValueError, match="must begin at one time"):
        rk.motions.read_components([file(text("10.750"), "a.V2c"), file(text("20.750"), "b.V2c")])


@pytest.mark.parametrize("word", ["DWN", "D"])
def test_a_component_that_says_it_points_downward_is_warned_of(file, word):
    paths = [file(component(each), f"motion{k}") for k, each in enumerate(("N-S", "E-W", word))]
    with pytest.warns(
        UserWarning, match=f"vertical component says '{word}', and is taken as it stands, positive upward"
    ):
        found = rk.motions.read_components(paths)
    np.testing.assert_array_equal(found.vertical.samples, found.first.samples)


def test_two_components_and_columns_of_one_file(file):
    assert rk.motions.read_components([file(component("N-S"), "a"), file(component("E-W"), "b")]).vertical is None
    text = "".join(f"{0.02 * k:.2f},{x!r},{2 * x!r},{3 * x!r}\n" for k, x in enumerate(SAMPLES.tolist()))
    found = rk.motions.read_components(file(text), columns=(1, 2, 3), unit="g")
    np.testing.assert_allclose(found.second.samples, 2 * SAMPLES)
    np.testing.assert_allclose(found.vertical.samples, 3 * SAMPLES)


@pytest.mark.parametrize(
    "titles, columns, order",
    [
        ("time [s],NS [g],EW [g],UD [g]", None, (1, 2, 3)),
        ("time,NS,EW,UD", None, (1, 2, 3)),
        ("# no titles", None, (1, 2, 3)),
        ("time,UD,NS,EW", None, (2, 3, 1)),
        ("time,UD,NS,EW", (1, 2, 3), (2, 3, 1)),
        ("time [s],acc_z [g],acc_x [g],acc_y [g]", (1, 2, 3), (2, 3, 1)),
        ("time,acc (Z),acc (N),acc (E)\ns,g,g,g", None, (2, 3, 1)),
        ("time [s],Vertical acceleration [g],NS [g],EW [g]", (3, 1, 2), (3, 2, 1)),
    ],
)
def test_titles_say_which_columns_are_components(file, titles, columns, order):
    """Not the times, and the vertical one where it stands."""
    factors = (1, 2, 3)
    rows = (",".join([f"{0.02 * k:.2f}", *(repr(f * x) for f in factors)]) for k, x in enumerate(SAMPLES.tolist()))
    path = file(f"{titles}\n" + "\n".join(rows) + "\n")
    for given in ({}, {"dt": 0.02}):
        found = rk.motions.read_components(path, unit="g", columns=columns, **given)
        for part, column in zip((found.first, found.second, found.vertical), order):
            np.testing.assert_allclose(part.samples, column * SAMPLES)
        assert float(found.first.dt) == 0.02


@pytest.mark.parametrize("kind", ["AT2", "ESM", "SMC", "K-NET"])
def test_a_file_of_one_component_asks_for_the_others(file, kind):
    with pytest.raises(ValueError, match="`paths` must be a file for each component, because .* holds one component"):
        rk.motions.read_components(file(FILES[kind].text))


def test_columns_that_are_not_two_or_three_must_be_said(file):
    text = "".join(f"{0.02 * k:.2f},{x}\n" for k, x in enumerate(SAMPLES))
    with pytest.raises(
        ValueError, match="`columns` must be given, because text file `motion.txt` has 2 columns, the f"
    ):
        rk.motions.read_components(file(text), unit="g")


@pytest.mark.parametrize(
    "name", ["D", "VRT", "VT", "V1", "UPDN", "UP-DN", "000V", "V", "VERT", "UP", "HNZ", "-UP", "Vertical"]
)
def test_names_of_vertical_components(file, name):
    paths = [file(FILES["AT2"].text.replace("WAHO, 090", f"WAHO, {each}"), each) for each in ("000", name)]
    with pytest.raises(ValueError, match="must hold two horizontal components, but .* are vertical"):
        rk.motions.read_components(paths)


@pytest.mark.parametrize(
    "names",
    [
        ("000", "090", "180"),
        ("360 Deg", "90 Deg", "5 deg"),
        ("N-S", "E-W", "N08W"),
        ("HN1", "HNN", "HNE"),
        ("", "E", "S"),
        ("long", "x", "Trans"),
        ("EW", "", "North-South"),
        ("N-S", "", "W-E"),
        ("WE", "", "SN"),
        ("90", "", "0"),
        ("10°", "", "12 deg"),
    ],
)
def test_three_horizontal_components_are_refused(names):
    """The last would be taken to be vertical."""
    records = [rk.Record([0.1, 0.2], 0.01, origin=rk.motions.Origin(component=each)) for each in names]
    with pytest.raises(ValueError, match="`paths` must hold a vertical component among three, .* but they say"):
        together("paths", records)


@pytest.mark.parametrize(
    "names",
    [
        ("", "", ""),
        ("000", "090", ""),
        ("1", "2", "3"),
        ("10", "11", "12"),
        ("01", "02", "03"),
        ("HN1", "HN2", "HN3"),
        ("x", "y", "z"),
        ("a", "b", "c"),
    ],
)
def test_where_components_do_not_say_the_last_is_vertical(names):
    records = [rk.Record([0.1, 0.2], 0.01, origin=rk.motions.Origin(component=each)) for each in names]
    assert together("paths", list(records)).vertical.origin.component == names[2]


@pytest.mark.parametrize(
    "second, message",
    [
        (component("U-D"), "must hold two horizontal components"),
        (component("E-W").replace("14:46:36", "14:46:37"), "must begin at one time"),
        (component("E-W").replace("100Hz", "50Hz").replace("0.24", "0.48"), "must have one time step"),
    ],
)
def test_components_that_do_not_go_together(file, second, message):
    with pytest.raises(ValueError, match=message):
        rk.motions.read_components([file(component("N-S"), "a"), file(second, "b")])


# --------------------------------------------------------------------------------------- traces, writing


def trace(**changed):
    stats = types.SimpleNamespace(network="US", station="ABC", location="", channel="HNZ", delta=0.02, starttime="")
    return types.SimpleNamespace(**{"data": SAMPLES * 9.80665, "stats": stats} | changed)


def test_a_trace_of_obspy():
    record = rk.motions.record_of_trace(trace(), "m/s2")
    np.testing.assert_allclose(record.samples, SAMPLES, rtol=1e-14)
    assert (record.name, record.origin.component, float(record.dt)) == ("US.ABC..HNZ", "HNZ", 0.02)
    assert rk.motions.components.is_vertical(record)


def test_a_real_trace_of_obspy():
    obspy = pytest.importorskip("obspy")
    made = obspy.Trace(SAMPLES * 9.80665, {"delta": 0.02, "station": "ABC", "channel": "HNE"})
    record = rk.motions.record_of_trace(made, "m/s2")
    np.testing.assert_allclose(record.samples, SAMPLES, rtol=1e-14)
    assert record.origin.start.startswith("1970-01-01")


@pytest.mark.parametrize(
    "given, message",
    [(trace(data=np.ma.array(SAMPLES, mask=SAMPLES > 0.1)), "no gaps"), ("x", "must be a trace of ObsPy"),
     (trace(data=[0.0, np.nan]), "must be finite")],
)  # fmt: skip
def test_traces_that_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        rk.motions.record_of_trace(given, "g")


def channels(*names, **changed):
    return [trace(stats=types.SimpleNamespace(**vars(trace().stats) | {"channel": name} | changed)) for name in names]


@pytest.mark.parametrize("names", [("HNE", "HNN", "HNZ"), ("HNZ", "HNE", "HNN"), ("HN1", "HN2", "HNZ"), ("HNE", "HNN")])
def test_a_stream_of_obspy(names):
    found = rk.motions.components_of_stream(channels(*names), "m/s2")
    flat = [name for name in names if name != "HNZ"]
    assert [found.first.origin.component, found.second.origin.component] == flat
    assert (found.vertical is None) == ("HNZ" not in names)


@pytest.mark.parametrize(
    "stream, message",
    [
        (channels("HNE"), "must hold two or three traces of ObsPy, but has 1"),
        (channels("HNE", "HNZ"), "must hold two horizontal components, but \\['HNZ'\\] are vertical"),
        (channels("HNE") + channels("HNN", station="XYZ"), "must be of one station, but is of \\['US.ABC', 'US.XYZ'"),
        (3.0, "must hold two or three traces of ObsPy, but is 3.0"),
        (np.array(0.3), "must hold two or three traces of ObsPy, but is array"),
    ],
)
def test_streams_that_are_refused(stream, message):
    with pytest.raises(ValueError, match=message):
        rk.motions.components_of_stream(stream, "m/s2")


def test_what_is_written_is_read_again(tmp_path):
    origin = rk.motions.Origin("LOMA PRIETA", "WAHO", "090")
    record = rk.Record(SAMPLES, 1 / 256, "some\nname", origin)
    for write, given, digits in ((rk.motions.write_at2, {}, 1e-8), (rk.motions.write_csv, {}, 0)):
        path = tmp_path / "motion"
        write(record, path)
        found = rk.read_record(path, **given)
        np.testing.assert_allclose(found.samples, SAMPLES, rtol=digits)
        assert float(found.dt) == pytest.approx(1 / 256, rel=1e-11)
    rk.motions.write_at2(record, path)
    assert tuple(rk.read_record(path).origin)[:3] == origin[:3]
    rk.motions.write_csv(record, path, "cm/s2")
    np.testing.assert_allclose(rk.read_record(path).samples, SAMPLES, rtol=1e-15)
    rk.motions.write_csv(rk.Record(SAMPLES.astype(np.float32), np.float32(0.01)), path)  # which is 0.00999999977
    assert path.read_text().splitlines()[3].startswith("0.01,")


ROUND_TRIPS = {  # samples [g], time step [s]
    "two": ([0.1, -0.2], 0.01),
    "two at rest": ([0.0, 0.0], 0.3),
    "negative zeros": ([-0.0, 0.1, -0.0], 0.005),
    "tiny": ([1e-300, -1e-12, 1e-9], 1e-9),
    "huge": ([2e8, -1e9, 3.0], 1e9),
    "like times": ([0.0, 0.01, 0.02, 0.03, 0.04], 1 / 3),
    "many": (0.3 * np.sin(np.arange(1001)), 1e-6),
}
NAMES = [
    "",
    "a, b, c",
    "a\nb",
    "acceleration [cm/s2]",
    "time [ms]",
    "DT= .1",
    "# 1.0,2.0",
    "x" * 5000,
    "\0bin\ufeff",
    "ü;\t1",
]


@pytest.mark.filterwarnings("ignore:A record peaks at")
@pytest.mark.parametrize("name", ROUND_TRIPS)
def test_all_that_is_written_is_read_again(tmp_path, name):
    samples, dt = ROUND_TRIPS[name]
    record = rk.Record(samples, dt)
    ways = [(rk.motions.write_at2, (), 1e-7)] + [(rk.motions.write_csv, (u,), 1e-15) for u in ("g", "m/s2", "cm/s2")]
    for write, given, digits in ways:
        write(record, tmp_path / "motion", *given)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # huge ones, and long steps
            found = rk.read_record(tmp_path / "motion")
        np.testing.assert_allclose(found.samples, samples, rtol=digits, atol=0)
        np.testing.assert_array_equal(np.signbit(found.samples), np.signbit(samples))
        assert float(found.dt) == pytest.approx(dt, rel=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_names_that_are_written_are_no_samples(tmp_path, name):
    for write in (rk.motions.write_at2, rk.motions.write_csv):
        write(rk.Record(SAMPLES, 0.005, name), tmp_path / "motion")
        found = rk.read_record(tmp_path / "motion")
        np.testing.assert_allclose(found.samples, SAMPLES, rtol=1e-7)
        assert float(found.dt) == 0.005


def test_one_sample_is_written_where_the_step_is_stated(tmp_path):
    record = rk.Record([0.1], 0.005)
    with pytest.raises(ValueError, match="`record` must have at least two samples, but has one: `write_at2` states"):
        rk.motions.write_csv(record, tmp_path / "motion.csv")
    assert not (tmp_path / "motion.csv").exists()
    rk.motions.write_at2(record, tmp_path / "motion.at2")
    found = rk.read_record(tmp_path / "motion.at2")
    assert found.samples.tolist() == [0.1] and float(found.dt) == 0.005


@pytest.mark.parametrize(
    "name",
    ["x UNITS OF CM/S2", "NPTS= 5, DT= .1", "VELOCITY TIME HISTORY", "5 POINTS OF ACCEL DATA EQUALLY SPACED AT 1 SEC"],
)
def test_a_name_that_looks_like_a_header_is_not_written(tmp_path, name):
    """Or what was written is read again."""
    for write in (rk.motions.write_at2, rk.motions.write_csv):
        path = tmp_path / write.__name__
        try:
            write(rk.Record(SAMPLES, 0.005, name), path)
        except ValueError as error:
            assert "`record` must have a name that readers do not take for a header, but has" in str(error)
            assert not path.exists()
        else:
            assert write is rk.motions.write_csv
            found = rk.read_record(path)
            np.testing.assert_allclose(found.samples, SAMPLES, rtol=1e-7)
            assert float(found.dt) == 0.005


@pytest.mark.parametrize("path", ["", "/"])
def test_a_folder_is_no_file(path):
    with pytest.raises(IsADirectoryError):
        rk.motions.write_at2(rk.Record(SAMPLES, 0.01), path)


@pytest.mark.parametrize("kind", ["AT2", "CSV", "V2", "V1"])
def test_long_records_in_a_moment(tmp_path, kind):
    """A million samples in a second on a quiet core; where lines are looked at one by one it takes twenty."""
    count, again = 250_000, 25  # times the same, so that the text is soon written
    some = np.round(np.random.default_rng(0).normal(0, 0.1, count // again), 7)
    heads = {
        "AT2": f"PEER\nA, B, C\nACCELERATION IN UNITS OF G\nNPTS= {count}, DT= .005 SEC\n",
        "CSV": "time,acceleration\n",
        "V2": f"{count} POINTS OF ACCEL DATA EQUALLY SPACED AT  .010 SEC.  (UNITS: G)\n",
        "V1": f"Uncorrected Accelerogram Data\n{count} Accelerogram points at 100 pts/sec in units of g. "
        "Format: (8f10.7)\n",
    }
    form = {"AT2": "%15.7E", "CSV": "%10.7f", "V2": "%10.7f", "V1": "%10.7f"}[kind]
    text = [form % value for value in some.tolist()]
    if kind == "CSV":
        lines = [f"{0.01 * k:.2f},{x}" for k, x in enumerate(again * text)]
    else:
        lines = again * ["".join(text[k : k + 8]) for k in range(0, len(text), 8)]
    path = tmp_path / "long"
    path.write_text(heads[kind] + "\n".join(lines) + "\n")
    begin = time.process_time()
    record = rk.read_record(path, **({"unit": "g"} if kind == "CSV" else {}))
    assert time.process_time() - begin < 1.25
    np.testing.assert_allclose(record.samples, np.tile(some, again), atol=1e-12)


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="'.*nowhere'"):
        rk.motions.write_at2(rk.Record([0.1, 0.2], 0.01), tmp_path / "nowhere" / "mine.AT2")
