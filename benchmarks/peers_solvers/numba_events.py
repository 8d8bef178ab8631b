"""The events of a step in the numba integrators: impacts and turning points, as source.

Positions (x), velocities (v), accelerations (a) and their slopes (j) are texts, at the end of the step (h) and at a
point of it (r).
"""

# Newton's method in the bracket (lo, hi), which its values shrink.
NEWTON = """
for _i in range({rounds}):
    q = r * r
    a = {value}
    if a {sign} 0.0:
        lo = r
    else:
        hi = r
    b = {slope}
    n = r - a / b if b {falls} 0.0 else lo
    if not (lo <= n <= hi):
        n = 0.5 * (lo + hi)
    d = abs(n - r)
    r = n
    if d <= {close} * r:
        break
"""
CREST = {"rounds": "60", "value": "{v_r}", "sign": ">", "slope": "{a_r}", "falls": "!=", "close": "near"}
ROOTS = {  # of a step: where it turns back, where it turns outward again, where it comes to the ground
    "crest": CREST,
    "trough": CREST | {"sign": "<"},
    "landing": {"rounds": "100", "value": "{x_r}", "sign": ">", "slope": "{v_r}", "falls": "<", "close": "tight"},
}

EVENTS = """
vh = {v_h}
xh = {x_h}
impact = False
if fresh:  # driven outwards up to the crest
    pass
elif v > 0.0:
    if vh > 0.0:
        if c2 < 0.0:
            bend = {a_h}
            # It may have been down and up again: a shorter step tells.
            while vh > 0.0 and bend <= 0.0 and v < -2.0 * c2 * h:
                h *= 0.5
                whole = False
                q = h * h
                vh = {v_h}
                xh = {x_h}
                bend = {a_h}
            if bend > 0.0 and vh > 0.0:
                lo = 0.0
                hi = h
                r = 0.5 * h
                for _i in range(60):
                    q = r * r
                    a = {a_r}
                    if a < 0.0:
                        lo = r
                    else:
                        hi = r
                    b = {j_r}
                    n = r - a / b if b != 0.0 else lo
                    if not (lo < n < hi):
                        n = 0.5 * (lo + hi)
                    if abs(n - r) < 1e-3 * h:
                        break
                    r = n
                q = r * r
                if {v_r} < 0.0:
                    h = r
                    whole = False
                    q = h * h
                    vh = {v_h}
                    xh = {x_h}
    if vh <= 0.0:
        lo = 0.0
        hi = h
        r = h * v / (v - vh)
        {root_of_crest}
        q = r * r
        {top}
        peak = max(peak, top)
        if xh <= 0.0:
            impact = True
            lo = r
            hi = h
            r = 2.0 * r if x == 0.0 and 2.0 * r < h else h
else:
    if vh > 0.0:
        lo = 0.0
        hi = h
        r = h * v / (v - vh)
        {root_of_trough}
        q = r * r
        if {x_r} <= 0.0:
            impact = True
            lo = 0.0
            hi = r
            r = hi
    elif c2 > 0.0 and xh > 0.0:
        bend = {a_h}
        while vh <= 0.0 and xh > 0.0 and bend >= 0.0 and -v < 2.0 * c2 * h:
            h *= 0.5
            whole = False
            q = h * h
            vh = {v_h}
            xh = {x_h}
            bend = {a_h}
        if bend < 0.0 and vh <= 0.0:
            lo = 0.0
            hi = h
            r = 0.5 * h
            for _i in range(60):
                q = r * r
                a = {a_r}
                if a > 0.0:
                    lo = r
                else:
                    hi = r
                b = {j_r}
                n = r - a / b if b != 0.0 else lo
                if not (lo < n < hi):
                    n = 0.5 * (lo + hi)
                if abs(n - r) < 1e-3 * h:
                    break
                r = n
            q = r * r
            if {v_r} > 0.0:
                h = r
                whole = False
                q = h * h
                vh = {v_h}
                xh = {x_h}
                lo = 0.0
                hi = h
                for _i in range(60):
                    r = 0.5 * (lo + hi)
                    q = r * r
                    if {v_r} < 0.0:
                        lo = r
                    else:
                        hi = r
                q = r * r
                if {x_r} <= 0.0:
                    impact = True
                    lo = 0.0
                    hi = r
    if xh <= 0.0 and not impact:
        impact = True
        lo = 0.0
        hi = h
        r = h
if impact:
    if x <= 0.0 and v <= 0.0:
        h = 0.0
        vh = v
    else:
        {root_of_landing}
        h = r
        q = h * h
        {arrival}
    x = 0.0
    v = restitution * abs(vh)
    s = -s
else:
    {depart}
    x = xh
    v = vh
"""


def horner(names, t):
    """A polynomial at t as an expression: even and odd powers apart, two chains that run side by side."""

    def chain(part):
        text = part[-1]
        for name in part[-2::-1]:
            text = f"({text}) * q + {name}"
        return text

    odd = names[1::2]
    return chain(names[0::2]) + (f" + {t} * ({chain(odd)})" if odd else "")


def indented(text, depth):
    """Text moved in by `depth` levels, without blank ends."""
    return ("\n" + "    " * depth).join(text.strip("\n").split("\n"))


def filled(template, parts):
    """A template with every `{name}` replaced by its text at the depth of its line."""
    lines = []
    for line in template.strip("\n").split("\n"):
        bare = line.strip()
        if bare.startswith("{") and bare.endswith("}") and bare[1:-1] in parts:
            lines.append(line.replace(bare, indented(parts[bare[1:-1]], (len(line) - len(bare)) // 4)))
        else:
            for name, text in parts.items():
                line = line.replace("{" + name + "}", text)
            lines.append(line)
    return "\n".join(lines) + "\n"


def events_of(table):
    """Statements that find the events of a step; `table`: texts for positions, velocities and so on in them."""
    table = {"top": f"top = {table['x_r']}", "arrival": f"vh = {table['v_h']}", "depart": "pass"} | table
    roots = {f"root_of_{name}": filled(filled(NEWTON, words), table) for name, words in ROOTS.items()}
    return "q = h * h\n" + filled(EVENTS, table | roots)


def events_text(order, hooks=None):
    """Statements that find the first impact and the turning points of a step; `hooks` replace some of them."""
    c = [f"c{k}" for k in range(order + 1)]
    v = ["c1"] + [f"{float(k)} * c{k}" for k in range(2, order + 1)]
    a = [f"{float(k * (k - 1))} * c{k}" for k in range(2, order + 1)]
    j = [f"{float(k * (k - 1) * (k - 2))} * c{k}" for k in range(3, order + 1)]
    table = {f"{letter}_{at}": horner(p, at) for letter, p in zip("xvaj", (c, v, a, j)) for at in "hr"}
    return events_of(table | (hooks or {}))
