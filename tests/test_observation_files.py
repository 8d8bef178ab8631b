"""Numbers of a table of rocks that cannot be: refused with the line, the column and the number."""

import numpy as np
import pytest

import jaxrock as rk

ONE = {"alpha_deg": "12", "p_rad_per_s": "3", "restitution": "0.9", "observed": "rocked", "rotation_deg": "5"}
RECTANGLE = {"width_m": "0.5", "height_m": "2", "observed": "stood"}
RADIUS = {"alpha_deg": "12", "half_diagonal_m": "1", "observed": "stood"}
TWO_SIDES = {
    "alpha1_deg": "12", "alpha2_deg": "14", "radius1_m": "1", "radius2_m": "1.1", "inertia_ratio": "0.7", "facing": "1",
    "observed": "stood",
}  # fmt: skip
TWO_RATES = {
    "alpha1_rad": "0.2", "alpha2_rad": "0.25", "p1_rad_per_s": "3", "p2_rad_per_s": "2.9", "observed": "stood",
}  # fmt: skip
TABLES = (ONE, RECTANGLE, RADIUS, TWO_SIDES, TWO_RATES, {"alpha_rad": "0.2", "p_rad_per_s": "3", "observed": "stood"})
NUMBERS = [(table, name) for table in TABLES for name in table if name != "observed"]
DEVIATIONS = [
    (table, f"{name}_sd")
    for table, name in NUMBERS
    if name not in ("alpha2_deg", "alpha2_rad", "p2_rad_per_s", "radius2_m", "inertia_ratio", "facing")
]


def read(tmp_path, row):
    path = tmp_path / "rocks.csv"
    path.write_text(f"{','.join(row)}\n{','.join(row.values())}\n")
    return rk.inverse.read_observations(path)


@pytest.mark.parametrize("number", ["nan", "inf", "-inf"])
@pytest.mark.parametrize("table, name", NUMBERS, ids=[name for _, name in NUMBERS])
def test_a_number_is_finite(tmp_path, table, name, number):
    good = table | ({"rotation_deg_sd": "0.5"} if table is ONE else {})
    read(tmp_path, good)
    with pytest.raises(ValueError, match=f"line 2: `{name}` must be a finite number, but is '{number}'; an empty"):
        read(tmp_path, good | {name: number})


@pytest.mark.parametrize("number, message", [("-1", "0 or more, but is -1"), ("nan", "a finite"), ("inf", "a finite")])
@pytest.mark.parametrize("table, name", DEVIATIONS, ids=[name for _, name in DEVIATIONS])
def test_a_deviation_is_0_or_more(tmp_path, table, name, number, message):
    good = table | ({"rotation_deg_sd": "0.5"} if table is ONE else {})
    with pytest.raises(ValueError, match=f"line 2: `{name}` must be {message}"):
        read(tmp_path, good | {name: number})


def test_a_deviation_that_belongs_to_nothing_is_a_number_too(tmp_path):
    """A deviation beside a rotation that was not measured must be a number too."""
    row = ONE | {"observed": "stood", "rotation_deg": "", "rotation_deg_sd": "-1"}
    with pytest.raises(ValueError, match="line 2: `rotation_deg_sd` must be 0 or more, but is -1"):
        read(tmp_path, row)


@pytest.mark.parametrize("spare", ["", ",", ",,,"])
@pytest.mark.parametrize("end", ["", ",,,\n,,,\n", ",,,,,,\n\n"])
def test_empty_columns_and_rows_at_the_end(tmp_path, spare, end):
    """Check tables of rocks as spreadsheets save them."""
    path, rows = tmp_path / "rocks.csv", ["alpha_deg,p_rad_per_s,observed,rotation_deg", "9,3,toppled,", "15,2,stood,"]
    path.write_text("".join(row + spare + "\n" for row in rows) + end)
    rocks = rk.inverse.read_observations(path)
    np.testing.assert_allclose(rocks.alpha, np.radians([9, 15]))
    path.write_text("".join(row + spare + "\n" for row in rows[:2]) + ",,,\n" + rows[2] + "\n")
    with pytest.raises(ValueError, match="^File `rocks.csv`: line 3: "):
        rk.inverse.read_observations(path)
    path.write_text(f"{rows[0]},,\n{rows[1]},,0.5\n")
    with pytest.raises(ValueError, match="^File `rocks.csv`: line 2: has 6 fields, but there are 4 columns"):
        rk.inverse.read_observations(path)
