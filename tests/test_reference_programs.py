"""The Taylor reference gives again what is stored of it: a few numbers of every file, to the last digit stored."""

import json
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("gmpy2")  # without it all takes eight times as long

from references import critical, differences, edge_cases, hard_cases, peer_problems, peers, springs
from references.arithmetic import Arithmetic

FOLDER = Path(hard_cases.__file__).parent
NUMBERS = Arithmetic(40)


def stored(name):
    return json.loads((FOLDER / f"{name}.json").read_text())


def gradients(scene):
    """Values of the three outputs and their gradients."""
    path = scene.run()
    rows, _, _ = differences.gradient(scene, path)
    values = (path.peak, path.fastest, path.peak_time + 0 * path.peak)
    return dict(zip(differences.OUTPUTS, zip(values, rows)))


@pytest.mark.parametrize("kind", ["sine", "exponential", "half sine", "triangle", "ricker symmetric"])
def test_derivatives(kind):
    known = next(row for row in stored("derivatives")["scenes"] if row["kind"] == kind and row["impacts"] < 10)
    with NUMBERS.context():
        scene = differences.Scene(NUMBERS, known["model"], kind, known["block"] + known["motion"])
        for name, (value, row) in gradients(scene).items():
            assert NUMBERS.text(value, 20) == known[name]["value"]
            assert differences.texts(NUMBERS, row) == known[name]["gradient"]


@pytest.mark.parametrize("spring", springs.SPRINGS, ids=" ".join)
def test_springs(spring):
    rows = [row for row in stored("springs")["scenes"] if tuple(row["spring"]) == spring and row["kind"] != "record"]
    known = min(rows, key=lambda row: row["impacts_large"])
    with NUMBERS.context():
        scene = springs.SpringScene(NUMBERS, spring, known["kind"], known["block"] + known["motion"])
        for name, (value, row) in gradients(scene).items():
            assert NUMBERS.text(value, 22) == known[name]["value"]
            assert differences.texts(NUMBERS, row) == known[name]["gradient"]


@pytest.mark.parametrize("problem", ["P1", "P2", "P3"])
def test_peers(problem):
    """These were found by another program, of its own series, roots and free stage, in 36 digits."""
    for known in stored("peers")[problem][::90]:
        found = peers.answer(peer_problems.load(problem)[0], known["index"])
        assert found["condition"] == known["condition"]
        assert (found["peak"] and Decimal(found["peak"])) == (known["peak"] and Decimal(known["peak"]))


@pytest.mark.parametrize("kind", hard_cases.KINDS)
def test_hard_cases(kind):
    cases = [case for case in hard_cases.CASES if case.kind == kind][5::12]
    for case, model in [(case, case.models[0]) for case in cases]:
        known = hard_cases.answers()[hard_cases.key(case, model)]
        assert hard_cases.reference(known["scene"], case.counted) == known


def test_edge_cases():
    groups, scenes, _, known = edge_cases.kept_cases(again=False)
    for i in range(0, len(scenes), 500):
        found = edge_cases.references(edge_cases.GROUPS[groups[i]], scenes[i : i + 1])
        np.testing.assert_array_equal(found[0], known[i])


def test_critical_amplitudes():
    """The verdict changes within 1e-24 of them."""
    for known in stored("critical")["scenes"][::12]:
        with NUMBERS.context():
            scene = critical.Scene(NUMBERS, known["block"], known["kind"], known["shape"], known["length"])
            end, close = known["ends"][0], NUMBERS.power_of_ten(-24)
            amplitude = NUMBERS.number(end["amplitude"])
            lower, upper = (scene.label(amplitude * (1 + side * close)) for side in (-1, 1))
            safe, lost = (lower, upper) if end["kind"] == "below" else (upper, lower)
            assert safe == -1 and lost == end["impacts"]


def test_asymmetric_blocks():
    """Without the conditions: they take nine times as long."""
    from references.asymmetric import cases, reference

    known = {case["name"]: case["result"] for case in stored("asymmetric/asymmetric")["cases"]}
    for case in cases.CASES[:40:8]:
        block, out = reference.run(case, times=reference.times_of(case), forces=case["forces"])
        found = reference.told(out, reference.quantities(block, out))
        assert found == {name: known[case["name"]][name] for name in found}
