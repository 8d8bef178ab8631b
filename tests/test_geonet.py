"""GeoNet's V1A and V2A: values, components, and what contradicts itself."""

import re

import numpy as np
import pytest

import jaxrock as rk
from references.damaged_files import SAMPLES, _geonet

RAW = _geonet()
CORRECTED = _geonet(True) + _geonet(True, "N74W", 0.5) + _geonet(True, "Up", 0.25)


@pytest.fixture
def file(tmp_path):
    def write(text, name="motion.txt"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


@pytest.mark.parametrize("text", [RAW, CORRECTED, RAW.replace("\n", "\r\n")], ids=["V1A", "V2A", "CRLF"])
def test_samples_are_in_millimetres(file, text):
    """Found from the content alone."""
    record = rk.read_record(file(text))
    np.testing.assert_allclose(record.samples, np.round(SAMPLES * 9806.65, 1) / 9806.65, rtol=1e-12)
    assert float(record.dt) == 0.02
    assert record.origin[:7] == (
        "11 km east of Christchurch", "New Brighton Library", "S16W", "2016 February 14         00:13:43 UT", "NBLC",
        "geonet", "mm/s2",
    )  # fmt: skip


def test_components(file):
    path = file(CORRECTED, "motion.V2A")
    for column, (component, factor) in enumerate((("S16W", 1.0), ("N74W", 0.5), ("Up", 0.25))):
        record = rk.read_record(path, column=column)
        assert record.origin.component == component
        np.testing.assert_allclose(record.samples, np.round(SAMPLES * factor * 9806.65, 1) / 9806.65, rtol=1e-12)
    both = rk.motions.read_components(path)
    np.testing.assert_allclose(both.first.samples, rk.read_record(path).samples)
    with pytest.raises(ValueError, match="Argument `column` must be 0 to 2, a channel of GeoNet file"):
        rk.read_record(path, column=3)


def test_one_component_is_no_pair(file):
    with pytest.raises(ValueError, match="Argument `paths` must be a file for each component, because GeoNet file"):
        rk.motions.read_components(file(RAW))


COUNT = f"Number of points  {SAMPLES.size}"


@pytest.mark.parametrize(
    "text, said",
    [
        (RAW.replace(COUNT, f"Number of points  {SAMPLES.size + 1}"), "announces"),
        (RAW.replace(COUNT, "Number of points"), "lines 1 to 16 state no number of points"),
        (RAW.replace("at intervals of 0.020 s", "at intervals"), "lines 1 to 16 state no interval of its samples"),
        (RAW.replace("units of 1.00", "units of 2.00"), "line 11 states readings in units of 2.00 mm/s/s"),
        (re.sub("Peak  (-?)", r"Peak  \g<1>9", RAW, count=1), "line 14 states a peak of"),
        (RAW[: RAW.rindex("\n", 0, -2) + 1], "samples"),
        (CORRECTED[: CORRECTED.index("Corrected", 9)] + "0.0\n", "rows follow its"),
        (RAW.replace("      0       0", "      0       x", 1), "should hold ten numbers each"),
    ],
)
def test_contradictions_are_refused(file, text, said):
    assert text not in (RAW, CORRECTED), "nothing was replaced"
    with pytest.raises(ValueError, match=f"^File `motion.V1A`: .*{said}"):
        rk.read_record(file(text, "motion.V1A"))


def test_a_unit_that_the_file_contradicts_is_refused(file):
    with pytest.raises(ValueError, match="Argument `unit` must agree with file `motion.txt`, which is in 'mm/s2'"):
        rk.read_record(file(RAW), unit="g")
