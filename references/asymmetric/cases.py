"""The scenes: name, body (or numbers), motions, initial state, model. Everything is float64, taken as exact."""

import random

from references.asymmetric.bodies import numbers


def record(seed, size, count=40):
    """Random samples with four decimals, the first and last zero."""
    draw = random.Random(seed)
    return [0.0] + [round(draw.uniform(-size, size), 4) for _ in range(count - 2)] + [0.0]


def case(name, body, horizontal, vertical=None, initial=(0.0, 0.0), model="housner", forces=False, change=None):
    """One scene. `vertical`: (factor, motion). `change`: replaces numbers of the block."""
    alpha1, alpha2, p1, p2, e12, e21, r1, r2 = numbers(body)
    block = {"alpha": [alpha1, alpha2], "p": [p1, p2], "restitution": [e12, e21], "R": [r1, r2], "gravity": 9.81}
    block |= change or {}
    return {
        "name": name,
        "body": None if change else body,
        "model": model,
        "block": block,
        "horizontal": list(horizontal),
        "vertical": None if vertical is None else {"factor": vertical[0], "motion": list(vertical[1])},
        "initial": list(initial),
        "forces": forces,
    }


A, B, C = record(1, 0.5), record(2, 0.5), record(3, 0.9)

# name, body, motion without its amplitude, bracket of the amplitude, side whose overturning begins or ends in it, model
BOUNDARIES = [
    ("safe to side 2 after an impact in the free stage", "rock", ("sine", None, 1.0), (0.2, 0.25), -1, "housner"),
    ("side 2 to side 1 after an impact in the motion", "rock", ("sine", None, 1.8), (0.15, 0.2), 1, "housner"),
    ("side 2 to side 1", "rock", ("sine", None, 1.0), (-0.65, -0.7), 1, "housner"),
    ("safe to side 1 without impact", "stocky", ("sine", None, 0.8), (-2.3, -2.4), 1, "housner"),
    ("safe to side 2 without impact", "leaning", ("sine", None, 0.8), (0.3, 0.35), -1, "housner"),
    ("side 2 to side 1, rectangle", "uneven", ("rectangle", None, 0.5), (-0.25, -0.3), 1, "housner"),
    ("side 2 to side 1, record", "rock", ("record", A, 0.05, None), (1.1, 1.2), 1, "housner"),
    (
        "safe to side 2 after an impact in the free stage, linear",
        "rock",
        ("sine", None, 1.0),
        (0.2, 0.225),
        -1,
        "linear",
    ),
]

CASES = [
    case("sine, safe, one impact", "rock", ("sine", 0.2, 1.0), forces=True),
    case("sine, falls on side 2 after one impact in the free stage", "rock", ("sine", 0.25, 1.0)),
    case("sine, falls on side 2 after two impacts in the free stage", "rock", ("sine", 0.35, 1.0)),
    case("sine, falls on side 2 without impact", "rock", ("sine", 0.5, 1.0), forces=True),
    case("sine, comes to rest, leaves it to side 2", "rock", ("sine", -0.255, 1.0)),
    case("sine, five impacts", "rock", ("sine", -0.265, 1.0), forces=True),
    case("sine, leaning, twelve impacts", "leaning", ("sine", 0.115, 1.8)),
    case("sine, falls on side 2 with one impact", "rock", ("sine", -0.3, 1.0)),
    case("sine, inward at the end, falls on side 2 after an impact", "rock", ("sine", -0.6, 1.0)),
    case("sine, falls on side 1 without impact", "rock", ("sine", -0.8, 1.0), forces=True),
    case("sine, falls on side 1 with one impact", "rock", ("sine", 0.2, 1.8)),
    case("sine, comes to rest, then falls on side 2", "rock", ("sine", -0.255, 1.8)),
    case("sine, flat on side 2 in the motion", "rock", ("sine", 1.0, 1.0)),
    case("sine, flat on side 1 in the motion", "rock", ("sine", -1.2, 1.0)),
    case("sine, leaning, two impacts", "leaning", ("sine", 0.15, 0.8), forces=True),
    case("sine, leaning, safe beyond the saddle", "leaning", ("sine", 0.3, 0.8)),
    case("sine, leaning, three impacts, falls on side 2", "leaning", ("sine", -0.4, 0.8)),
    case("sine, leaning, falls on side 1", "leaning", ("sine", -1.3, 0.8), forces=True),
    case("sine, steep (restitution above 1), six impacts", "steep", ("sine", 0.15, 0.8), forces=True),
    case("sine, steep, five impacts, falls on side 2", "steep", ("sine", -0.35, 0.8)),
    case("sine, steep, safe", "steep", ("sine", -0.25, 0.8), forces=True),
    case("sine, uneven", "uneven", ("sine", 0.18, 0.9)),
    case("sine, stocky", "stocky", ("sine", 1.1, 0.8), forces=True),
    case("sine, stocky, safe beyond the saddle of side 1", "stocky", ("sine", -2.3, 0.8)),
    case("sine, column", "column", ("sine", 0.18, 2.5)),
    case("sine, no rebound from side 1", "rock", ("sine", 0.24, 1.0), change={"restitution": [0.0, 0.5]}),
    case("exponential, near a rectangle", "rock", ("exponential", 0.27, 0.5, -3.0)),
    case("exponential, spike", "leaning", ("exponential", -0.6, 0.6, 4.0), forces=True),
    case("rectangle, safe", "uneven", ("rectangle", -0.3, 0.25)),
    case("rectangle, falls on side 1", "uneven", ("rectangle", -0.5, 0.6)),
    case("record, rock", "rock", ("record", A, 0.05, 1.0), forces=True),
    case("record, column", "column", ("record", A, 0.1, 0.7)),
    case("record, leaning", "leaning", ("record", C, 0.03, 0.5)),
    case("record, uneven", "uneven", ("record", C, 0.04, 0.4)),
    case("record and vertical record", "rock", ("record", A, 0.05, 1.0), (0.6, ("record", B, 0.045, 1.0)), forces=True),
    case("sine and vertical sine", "rock", ("sine", 0.17, 1.0), (0.4, ("sine", 0.9, 0.37)), forces=True),
    case(
        "sine and vertical sine, the other way", "rock", ("sine", -0.22, 1.0), (-0.5, ("sine", 0.9, 0.7)), forces=True
    ),
    case(
        "exponential and vertical rectangle",
        "leaning",
        ("exponential", 0.12, 0.4, -2.0),
        (-0.3, ("rectangle", 1.0, 0.4)),
    ),
    case("sine and vertical record, steep", "steep", ("sine", 0.2, 0.8), (0.5, ("record", B, 0.03, 1.0)), forces=True),
    case("free rocking", "rock", ("rectangle", 0.0, 6.0), initial=(0.05, 0.0), forces=True),
    case(
        "free rocking, falls on the weaker side 2 after an impact", "rock", ("rectangle", 0.0, 6.0), initial=(0.2, 0.0)
    ),
    case(
        "free rocking, thrown inward, falls on side 2 after two impacts",
        "rock",
        ("rectangle", 0.0, 0.01),
        initial=(-0.12, 0.5),
    ),
    case("initial velocity and sine", "leaning", ("sine", -0.1, 0.7), initial=(0.0, 0.4)),
    case("linear sine", "rock", ("sine", 0.2, 1.0), model="linear"),
    case("linear sine, falls on side 1", "rock", ("sine", -0.8, 1.0), model="linear"),
    case("linear record", "rock", ("record", A, 0.05, 1.0), model="linear"),
    case("linear sine and vertical sine", "rock", ("sine", 0.2, 1.0), (0.4, ("sine", 0.9, 0.37)), model="linear"),
    case("linear, free rocking", "steep", ("rectangle", 0.0, 4.0), initial=(-0.08, 0.1), model="linear"),
    case("symmetric sine", "rectangle", ("sine", 0.22, 1.0)),
    case("symmetric sine, five impacts", "rectangle", ("sine", 0.215, 2.5)),
    case("symmetric record", "rectangle", ("record", A, 0.05, 0.9)),
    case("symmetric linear sine", "rectangle", ("sine", -0.28, 1.0), model="linear"),
    case("symmetric exponential", "rectangle", ("exponential", 0.4, 0.4, -3.0)),
    case("symmetric, falls on side 2", "rectangle", ("sine", 0.75, 1.0)),
]


def boundary_case(boundary, amplitude, label):
    """The scene of a boundary at an amplitude."""
    name, body, horizontal, _, _, model = boundary
    return case(f"{name}, {label}", body, [amplitude if x is None else x for x in horizontal], model=model)
