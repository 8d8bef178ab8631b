"""Against numbers that the package has no licence to hold: `python -m references.outside FOLDER`.

FOLDER holds `records/` (files as the agencies publish them) and `reference/` (`springs.json`, `springs.npz`: histories
of spring models by a DOP853 integrator of its own). What is there is judged; what does not agree raises.
"""

import json
import sys
from pathlib import Path

import jax
import numpy as np

import jaxrock as rk

# File, arguments of `read_record`, number of samples, time step [s], peak [g].
RECORDS = [
    ("at2-variants/IELC180.AT2", {}, 4000, 0.01, 0.3128806),
    ("at2-variants/NIS090.AT2", {}, 4096, 0.01, 0.502749),
    ("at2-variants/RSN6_IMPVALL.I_I-ELC180-hor1.AT2", {}, 5372, 0.01, 0.2807955),
    ("at2-variants/RSN77_SFERN_PUL164-hor1.AT2", {}, 4172, 0.01, 1.219037),
    ("paper_records/LOMAP_AND270_oldPEER.AT2", {}, 7921, 0.005, 0.24386),
    ("paper_records/RSN729_SUPER.B_B-IVW360.AT2", {}, 11999, 0.005, 0.207563),
    ("paper_records/RSN811_LOMAP_WAH090_unscaled.AT2", {}, 5001, 0.005, 0.65405904),
    ("formats/RSN763_LOMAP_GIL067.AT2", {}, 7999, 0.005, 0.3585328),
    ("formats/ce36456p_CE36456.V2", {}, 3251, 0.02, 267.957 / 980.665),
    ("formats/ce36456p_CE36456.V2", {"column": 2}, 3250, 0.02, 256.231 / 980.665),
    ("formats/017m30bt.s0a", {}, 1887, 0.02, 242.3945 / 980.665),
    ("meloland-1979/CHAN14.V2", {}, 5696, 0.01, 225.090 / 980.665),
    ("meloland-1979/CHAN24.V2", {}, 5694, 0.01, 292.690 / 980.665),
    ("formats/0111a.smc", {}, 6001, 0.005, 104.41 / 980.665),
    ("formats/us1000hyfh_akbmrp_AKBMR--n.1000hyfh.BNZ.--.acc.V2c", {}, 42000, 0.005, 6.851512 / 980.665),
    (
        "formats/HI.ARS1..HNE.D.20190728.160908.C.ACC.ASC",
        {"dt": 0.005, "unit": "cm/s2"},
        19128,
        0.005,
        0.300022 / 980.665,
    ),
]

LAWS = {"SM_b_cos": "linear", "SM_a_exact_cos": "sine", "SM1_c_plastic_cos": "plastic"}


def records(folder: Path) -> int:
    """Count, step and peak of every file that is there; how many agree."""
    there = [row for row in RECORDS if (folder / row[0]).exists()]
    for path, arguments, size, dt, peak in there:
        record = rk.read_record(folder / path, **arguments)
        assert record.samples.shape == (size,) and record.dt == dt, path
        np.testing.assert_allclose(np.abs(record.samples).max(), peak, rtol=3e-6, err_msg=path)
    return len(there)


def springs(folder: Path) -> int:
    """Scenes of figures 5, 7, 9, 11 and 16 of Diamantopoulos & Fragiadakis (2017); how many histories agree."""
    if not (folder / "springs.json").exists():
        return 0
    cases, stored = json.loads((folder / "springs.json").read_text())["cases"], np.load(folder / "springs.npz")
    pairs = [(case, name) for case in cases for name in LAWS if name in case["results"]]
    for case, name in pairs:
        one, ground, known = case["params"], case["ground"], case["results"][name]
        size, period = ground["ap"] / one["g"], 2 * np.pi / ground["omega"]
        sine = "sine" in ground["type"]
        motion = rk.SinePulse(size, period) if sine else rk.RickerPulse(size, period, center=ground["tc"])
        block = rk.Block(np.arctan(1 / one["h_over_b"]), np.sqrt(one["p2"]), one["eta"])
        model = rk.Spring("mmSM" if one["n_masses"] else "SM1", LAWS[name], one["n_masses"])
        response = rk.simulate(block, motion, model, duration=one["T"], samples=400)
        assert response.impact_count == known["n_impacts"] or one["eta"] < 0.8, name  # that one comes to rest
        for found, key in ((response.rotation, "theta"), (response.velocity, "thetadot")):
            exact = stored[known["npz"][key]]
            np.testing.assert_allclose(found, exact, rtol=0, atol=1e-7 * np.abs(exact).max(), err_msg=name)
    return len(pairs)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    where = Path(sys.argv[1])
    print(f"{records(where / 'records')} records and {springs(where / 'reference')} histories agree")
