/* Rocking of a block under a record in the numbers of fixed_point.h.
 *
 *     x'' = -[sin(alpha - x) + s u(t) cos(alpha - x)],  x = s theta >= 0,  time in units of 1/p
 *
 * Compiled by real_records.py, once for each LIMBS. A step is a Taylor series up to the order whose terms vanish.
 * Where the acceleration may change its sign within a step, the step is cut at its root; on what is left the opening
 * x is convex or concave, so its roots and tops are counted by the signs of x and x' at both ends. After an impact x has
 * a known root, which is divided out.
 */
#include <float.h>

#include "fixed_point.h"

#define ORDERS 400
#define CUT 40 /* halvings of a step in search of the root of its acceleration */
#define ROUGH (100 * LDBL_EPSILON)

/* Scene and state */

static num alpha, sine_alpha, cosine_alpha, threshold, restitution, span, inverse_span, half_turn, crawl;
static int span_bits;
static num x, v, local, peak;          /* opening, velocity, time since the knot; greatest top */
static num u_now, u_step;              /* acceleration at the knot, and its change to the next one */
static int side, leaving, piece, peak_piece, fallen;
static real peak_local;
static long impacts, steps;

/* A step: series of velocity and mean velocity in units of 2^-m of time, up to `width` of it */

static num V[ORDERS], M[ORDERS], S[ORDERS], C[ORDERS], width;
static real A[ORDERS];                 /* acceleration times 2^-m, rough */
static int last, m, from_ground;

static num acceleration_of_ground(void) {
    return plus(u_now, halved(times(times(u_step, inverse_span), local), -span_bits));
}

static int expand(num push, num slope) {
    int quiet = 0;
    V[0] = v;
    if (x.n) sine_cosine(minus(alpha, x), &S[0], &C[0]);
    else S[0] = sine_alpha, C[0] = cosine_alpha;
    for (int k = 0; k < ORDERS - 1; k++) {
        sum moment = {0}, sine = {0}, cosine = {0};
        M[k] = over_int(V[k], k + 1);
        add_product(&moment, &push, &C[k]);
        if (k) add_product(&moment, &slope, &C[k - 1]);
        V[k + 1] = over_int(halved(negative(plus(S[k], value_of(&moment))), m), k + 1);
        if (!k && leaving && V[1].s < 0) V[1] = ZERO;
        quiet = V[k + 1].n == 0 || (V[k + 1].n == 1 && V[k + 1].d[0] < 4) ? quiet + 1 : 0;
        if (quiet >= 3 && k > 4) {
            last = k;
            for (int i = 0; i <= last; i++) A[i] = (i + 1) * rough(V[i + 1]);
            return 1;
        }
        for (int j = 0; j <= k; j++) {
            add_product(&sine, &V[j], &C[k - j]);
            add_product(&cosine, &V[j], &S[k - j]);
        }
        S[k + 1] = over_int(halved(negative(value_of(&sine)), m), k + 1);
        C[k + 1] = over_int(halved(value_of(&cosine), m), k + 1);
    }
    return 0;
}

static num horner(const num *c, num t) {
    num total = c[last];
    for (int k = last - 1; k >= 0; k--) total = plus(times(total, t), c[k]);
    return total;
}

static num opening(num t) { return plus(x, halved(times(t, horner(M, t)), m)); }

static num acceleration(num t) {
    num total = ZERO;
    for (int k = last; k >= 0; k--) total = plus(times(total, t), times_int(V[k + 1], k + 1));
    return total;
}

static real rough_acceleration(real t, real *slope) {
    real total = 0;
    *slope = 0;
    for (int k = last; k >= 0; k--) *slope = *slope * t + total, total = total * t + A[k];
    return total;
}

/* What has a root: the opening (its root at the start divided out), the velocity or the acceleration */

enum { OPENING, VELOCITY, ACCELERATION };

static num with_slope(int what, num t, real *slope) {
    real at = rough(t), none;
    if (what == ACCELERATION) {
        rough_acceleration(at, slope);
        return acceleration(t);
    }
    num velocity = horner(V, t);
    if (what == VELOCITY) {
        *slope = rough_acceleration(at, &none);
        return velocity;
    }
    if (!from_ground) {
        *slope = ldexpl(rough(velocity), -m);
        return opening(t);
    }
    num mean = horner(M, t);
    *slope = at ? rough(minus(velocity, mean)) / at : A[0] / 2;
    return mean;
}

static int sign_at(int what, num t) {
    real slope;
    return sign(with_slope(what, t, &slope));
}

static num root(int what, num low, num high) { /* opposite signs at both ends: Newton inside the bracket */
    int before = sign_at(what, low);
    num t = halved(plus(low, high), 1);
    for (int i = 0; i < 2 * BITS; i++) {
        real slope, change;
        num f = with_slope(what, t, &slope), next;
        if (!f.n || (f.n == 1 && f.d[0] < 3)) return t;
        if (sign(f) == before) low = t;
        else high = t;
        change = slope ? -rough(f) / slope : 2;
        next = fabsl(change) < 2 ? plus(t, exact(change)) : high;
        if (sign(minus(next, low)) <= 0 || sign(minus(high, next)) <= 0) next = halved(plus(low, high), 1);
        change = fabsl(rough(minus(next, t)));
        if (change <= ldexpl(2, -BITS)) return next;
        t = next;
    }
    return t;
}

static void note_top(num t, num top) {
    if (sign(minus(top, peak)) <= 0) return;
    peak = top, peak_piece = piece, peak_local = rough(plus(local, halved(t, m)));
    if (sign(minus(top, half_turn)) >= 0) fallen = 1;
}

/* Impact between two times where the opening is convex or concave (1: at *hit); notes a top on the way */
static int impact_between(num low, num high, num *hit) {
    int concave = sign_at(ACCELERATION, halved(plus(low, high), 1)) < 0, turns;
    int first = sign(horner(V, low)), second = sign(horner(V, high));
    num start = low;
    turns = concave ? first > 0 && second < 0 : first < 0 && second > 0;
    if (concave && turns) {
        num bound = plus(opening(low), halved(times(horner(V, low), minus(high, low)), m));
        start = root(VELOCITY, low, high);
        if (sign(minus(bound, peak)) > 0) note_top(start, opening(start));
    } else if (turns) {
        num far = plus(opening(low), halved(times(horner(V, low), minus(high, low)), m));
        if (sign(far) > 0) return 0;
        high = root(VELOCITY, low, high);
    } else if (second > 0) {
        if (concave || first >= 0) return 0;
    }
    if (from_ground && !high.n) return 0;
    if (sign_at(OPENING, high) >= 0) return 0;
    if (sign_at(OPENING, start) <= 0) *hit = start;
    else *hit = root(OPENING, start, high);
    return 1;
}

/* First impact between two times, cutting where the acceleration changes its sign */
static int impact_within(num low, num high, num *hit, int depth) {
    real middle = (rough(low) + rough(high)) / 2, radius = (rough(high) - rough(low)) / 2, jerk, bend = 0, size = 0;
    real a = rough_acceleration(middle, &jerk);
    num cut;
    for (int k = 0; k <= last; k++) bend += k * (k - 1) * fabsl(A[k]), size += fabsl(A[k]);
    if (fabsl(a) > fabsl(jerk) * radius + bend * radius * radius / 2 + ROUGH * size) return impact_between(low, high, hit);
    if (fabsl(jerk) > bend * radius + ROUGH * size * last || depth >= CUT) {
        if (sign_at(ACCELERATION, low) * sign_at(ACCELERATION, high) >= 0) return impact_between(low, high, hit);
        cut = root(ACCELERATION, low, high);
        return impact_between(low, cut, hit) || impact_between(cut, high, hit);
    }
    cut = halved(plus(low, high), 1);
    return impact_within(low, cut, hit, depth + 1) || impact_within(cut, high, hit, depth + 1);
}

static void land(num speed) {
    impacts++;
    x = ZERO, v = times(restitution, speed), side = -side;
    if (sign(minus(v, crawl)) < 0) side = 0, v = ZERO;
}

/* At rest: go to the uplift in this piece (0: there is none) */
static int uplift(void) {
    num now = acceleration_of_ground(), next = plus(u_now, u_step), size = next;
    size.s = 1;
    leaving = larger(&now, &threshold) > 0;
    if (!leaving) {
        if (sign(minus(size, threshold)) <= 0) return 0;
        num level = threshold;
        level.s = next.s;
        local = times(span, quotient(minus(level, u_now), u_step));
        now = next, leaving = 1;
    }
    side = -sign(now), x = v = ZERO;
    return 1;
}

/* Whether the block surely stays above the ground and below its peak through the step, by the sizes of the terms */
static int nothing_happens(real length) {
    real size = 0, start = rough(x), way = length * rough(v), bend;
    for (int k = 0; k <= last; k++) size += fabsl(A[k]);
    bend = ldexpl(size, m) * length * length * (1 + ROUGH);
    return start + (way < 0 ? way : 0) > bend && start + (way > 0 ? way : 0) + bend < rough(peak) * (1 - ROUGH);
}

/* One step of rocking, to an impact or to the end of the piece (0: it did not converge) */
static int rock(real longest) {
    num room = minus(span, local), push = acceleration_of_ground(), slope, hit, step = room;
    real length = rough(room);
    push.s *= side;
    if (!x.n && v.n) {
        real pull = rough(plus(sine_alpha, times(push, cosine_alpha)));
        if (pull > 0 && 2.5L * rough(v) / pull < longest) longest = 2.5L * rough(v) / pull;
    }
    if (longest < length) step = exact(length = longest);
    for (;; step = halved(step, 1), length /= 2) {
        m = -ilogbl(length) - 1;
        width = halved(step, -m);
        slope = halved(times(u_step, inverse_span), m - span_bits);
        slope.s *= side;
        if (expand(push, slope)) break;
        if (length < 1e-6L) return 0;
    }
    from_ground = !x.n, leaving = 0;
    if (!nothing_happens(length) && impact_within(ZERO, width, &hit, 0)) {
        num speed = negative(horner(V, hit));
        local = plus(local, halved(hit, m));
        land(speed.s < 0 ? ZERO : speed);
        return 1;
    }
    num end = opening(width);
    if (sign(minus(end, half_turn)) >= 0) fallen = 1;
    v = horner(V, width), x = end.s < 0 ? ZERO : end;
    local = minus(room, step).n ? plus(local, step) : span;
    return 1;
}

/* The rest of a piece; returns 0 where it fails */
static int go_on(real longest, long budget) {
    local = ZERO;
    while (!fallen && sign(minus(span, local)) > 0) {
        if (++steps > budget) return 0;
        if (!side && !uplift()) return 1;
        if (!x.n && !leaving && v.s < 0) land(negative(v));
        else if (!x.n && !leaving && !v.n) side = 0;
        else if (!rock(longest)) return 0;
    }
    return 1;
}

/* After the record the energy decides: whether it falls */
static int falls(void) {
    num away = halved(minus(alpha, x), 1), balance = halved(alpha, 1), sine, cosine, missing, all;
    int inside = sign(minus(alpha, x)) > 0;
    if (!side) return 0;
    sine_cosine(away, &sine, &cosine);
    missing = minus(times_int(times(sine, sine), 4), times(v, v));
    sine_cosine(balance, &sine, &cosine);
    all = times_int(times(sine, sine), 4);
    if (v.s < 0 && (inside || missing.s < 0))
        missing = minus(all, times(times(restitution, restitution), minus(all, missing)));
    else if (!inside)
        return 1;
    return missing.s < 0;
}

static void begin(double a, double p, double e, double dt, int64_t change) {
    num moved = ZERO, pi = ZERO, term = exact(2);
    moved.d[0] = change < 0 ? (uint64_t)-change : (uint64_t)change, moved.s = change < 0 ? -1 : 1;
    alpha = plus(exact(a), trimmed(moved)), restitution = exact(e), span = times(exact(p), exact(dt));
    sine_cosine(alpha, &sine_alpha, &cosine_alpha);
    threshold = quotient(sine_alpha, cosine_alpha);
    span_bits = -ilogbl(rough(span)) - 1;
    inverse_span = quotient(halved(exact(1), span_bits), span);
    for (int k = 1; term.n; term = over_int(times_int(term, k), 2 * k + 1), k++) pi = plus(pi, term);
    half_turn = halved(pi, 1);
    crawl = ZERO, crawl.d[0] = 1 << 24, crawl = trimmed(crawl);
    x = v = local = peak = ZERO;
    side = leaving = fallen = piece = peak_piece = 0, peak_local = 0, impacts = steps = 0;
}

/* Follow a block through a record and to its first top after it.
 *
 * change: of alpha, in units of 2^-BITS; parts: steps a piece, at least; rotations: at the knots [rad], count of them.
 * found: peak over alpha, its time [s], impacts, steps.
 * Returns 1 if it falls, 0 if it stands, -1 where the steps do not suffice.
 */
int follow(const double *samples, int count, double dt, double scale, double a, double p, double e, int64_t change,
           int parts, long budget, double *rotations, double *found) {
    real longest = (real)p * dt / parts * (1 + 1e-15L);
    int verdict, sides;
    begin(a, p, e, dt, change);
    if (longest > 0.25L) longest = 0.25L;
    num next = times(exact(samples[0]), exact(scale));
    for (piece = 0; piece < count - 1 && !fallen; piece++) {
        rotations[piece] = (double)(side * rough(x));
        u_now = next, next = times(exact(samples[piece + 1]), exact(scale)), u_step = minus(next, u_now);
        if (!go_on(longest, budget)) return -1;
    }
    if (!fallen) rotations[piece] = (double)(side * rough(x));
    verdict = fallen || falls();
    u_now = u_step = ZERO, sides = impacts;
    for (; !verdict && side && sign(v) && impacts < sides + 2 && piece < count + 100000; piece++) {
        if (sign(v) < 0 && impacts > sides) break;
        if (!go_on(longest, budget)) return -1;
    }
    found[0] = (double)(rough(peak) / rough(alpha)), found[1] = peak_piece * dt + (double)(peak_local / p);
    found[2] = impacts, found[3] = steps;
    return verdict;
}
