"""Digits of one reference file confirmed by another: `python -m references.asymmetric.compare one.json other.json`."""

import json
import sys
from decimal import Decimal


def leaves(x, y, path=""):
    """Pairs of leaves with their places."""
    if isinstance(x, dict):
        for k in x:
            if k not in ("condition", "about"):
                yield from leaves(x[k], y[k], f"{path}/{k}")
    elif isinstance(x, list):
        if len(x) != len(y):
            yield path, len(x), len(y)
        for k, (a, b) in enumerate(zip(x, y)):
            yield from leaves(a, b, f"{path}/{k}")
    else:
        yield path, x, y


def main(one, two):
    """Largest relative difference of numbers, and everything else that differs."""
    worst, count, rows = Decimal(0), 0, []
    for a, b in zip(one["cases"], two["cases"], strict=True):
        for path, x, y in leaves(a, b, a["name"]):
            if isinstance(x, str) and isinstance(y, str) and x != y:
                try:
                    x, y = Decimal(x), Decimal(y)
                except ArithmeticError:
                    print("differs", path, x, y)
                    continue
                error = abs(x - y) / max(abs(x), abs(y))
                rows.append((error, path))
                worst = max(worst, error)
            elif x != y:
                print("differs", path, x, y)
            count += 1
    rows.sort(reverse=True)
    for error, path in rows[:8]:
        print(f"{error:.1e} {path}")
    for a, b in zip(one["critical_amplitudes"], two["critical_amplitudes"]):
        print("critical", a["name"], a["amplitude"], f"{abs(Decimal(a['amplitude']) - Decimal(b['amplitude'])):.1e}")
    print(count, "numbers, worst relative difference", f"{worst:.1e}")


if __name__ == "__main__":
    main(*(json.load(open(name)) for name in sys.argv[1:]))
