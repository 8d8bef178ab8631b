/* Fixed-point numbers of LIMBS 64-bit words behind the point and one before it, exact to 2^-(64 LIMBS).
 *
 * Sums and integer multiples are exact, products and quotients are cut after the last word. `real` is the widest float
 * of the compiler; it guides iterations and decides nothing.
 */
#include <math.h>
#include <stdint.h>
#include <string.h>

#ifndef LIMBS
#define LIMBS 2
#endif
#define WORDS (LIMBS + 1)
#define BITS (64 * LIMBS)
typedef unsigned __int128 wide;
typedef long double real;

/* Numbers: sign and magnitude; n counts the words up to the highest that is not zero. */

typedef struct {
    uint64_t d[WORDS];
    int n, s;
} num;

static const num ZERO = {{0}, 0, 1};

static num trimmed(num a) {
    a.n = 0;
    for (int i = 0; i < WORDS; i++) a.n = a.d[i] ? i + 1 : a.n; /* no branches: they would be guessed wrong */
    a.s = a.n ? a.s : 1;
    return a;
}

static int sign(num a) { return a.n ? a.s : 0; }

static num negative(num a) {
    if (a.n) a.s = -a.s;
    return a;
}

static int larger(const num *a, const num *b) { /* sign of |a| - |b| */
    if (a->n != b->n) return a->n > b->n ? 1 : -1;
    for (int i = a->n - 1; i >= 0; i--)
        if (a->d[i] != b->d[i]) return a->d[i] > b->d[i] ? 1 : -1;
    return 0;
}

static num plus(num a, num b) {
    if (a.s == b.s) {
        wide carry = 0;
        for (int i = 0; i < WORDS; i++) {
            carry += (wide)a.d[i] + b.d[i];
            a.d[i] = (uint64_t)carry;
            carry >>= 64;
        }
        return trimmed(a);
    }
    if (larger(&a, &b) < 0) {
        num c = a;
        a = b, b = c;
    }
    uint64_t borrow = 0;
    for (int i = 0; i < WORDS; i++) {
        wide t = (wide)a.d[i] - b.d[i] - borrow;
        a.d[i] = (uint64_t)t;
        borrow = (uint64_t)(t >> 64) & 1;
    }
    return trimmed(a);
}

static num minus(num a, num b) { return plus(a, negative(b)); }

/* Sums of products, positive and negative ones apart, with one word more behind. */

typedef struct {
    uint64_t part[2][WORDS + 2];
} sum;

static void add_product(sum *total, const num *a, const num *b) {
    uint64_t *to = total->part[a->s != b->s];
    for (int i = 0; i < a->n; i++) {
        int j = i < LIMBS - 1 ? LIMBS - 1 - i : 0, k = i + j - (LIMBS - 1);
        uint64_t carry = 0;
        if (!a->d[i] || j >= b->n) continue;
        for (; j < b->n; j++, k++) {
            wide t = (wide)a->d[i] * b->d[j] + to[k] + carry;
            to[k] = (uint64_t)t;
            carry = (uint64_t)(t >> 64);
        }
        for (; carry && k < WORDS + 2; k++) {
            to[k] += carry;
            carry = to[k] < carry;
        }
    }
}

static num value_of(const sum *total) {
    const uint64_t *gain = total->part[0] + 1, *loss = total->part[1] + 1;
    num a = {{0}, 0, 1};
    uint64_t borrow = 0;
    for (int i = 0; i < WORDS; i++) {
        wide t = (wide)gain[i] - loss[i] - borrow;
        a.d[i] = (uint64_t)t;
        borrow = (uint64_t)(t >> 64) & 1;
    }
    if (borrow) {
        a.s = -1;
        for (int i = 0; i < WORDS; i++) {
            a.d[i] = ~a.d[i] + borrow;
            borrow = borrow && !a.d[i];
        }
    }
    return trimmed(a);
}

static num times(num a, num b) {
    sum total = {0};
    add_product(&total, &a, &b);
    return value_of(&total);
}

static num times_int(num a, uint64_t k) {
    uint64_t carry = 0;
    for (int i = 0; i < WORDS; i++) {
        wide t = (wide)a.d[i] * k + carry;
        a.d[i] = (uint64_t)t;
        carry = (uint64_t)(t >> 64);
    }
    return trimmed(a);
}

static num over_int(num a, uint64_t k) { /* k < 2^32 */
    uint64_t rest = 0;
    for (int i = a.n - 1; i >= 0; i--) {
        uint64_t high = rest << 32 | a.d[i] >> 32, low;
        low = (high % k) << 32 | (a.d[i] & 0xffffffffu);
        a.d[i] = (high / k) << 32 | low / k;
        rest = low % k;
    }
    return trimmed(a);
}

static num halved(num a, int m) { /* a 2^-m; m may be negative */
    num b = ZERO;
    int words = m >= 0 ? m / 64 : -(-m / 64), bits = m % 64;
    for (int i = 0; i < WORDS; i++) {
        int k = i + words;
        uint64_t here = k >= 0 && k < WORDS ? a.d[k] : 0, above = k + 1 >= 0 && k + 1 < WORDS ? a.d[k + 1] : 0;
        uint64_t below = k - 1 >= 0 && k - 1 < WORDS ? a.d[k - 1] : 0;
        b.d[i] = bits > 0 ? here >> bits | above << (64 - bits) : bits < 0 ? here << -bits | below >> (64 + bits) : here;
    }
    b.s = a.s;
    return trimmed(b);
}

static real rough(num a) {
    real x = 0;
    for (int i = a.n - 1; i >= 0 && i >= a.n - 3; i--) x += ldexpl((real)a.d[i], 64 * (i - LIMBS));
    return a.s * x;
}

static num exact(real x) {
    num a = ZERO;
    a.s = x < 0 ? -1 : 1;
    x = fabsl(x);
    for (int i = LIMBS; i >= 0; i--) {
        a.d[i] = (uint64_t)x;
        x = (x - (real)a.d[i]) * 0x1p64L;
    }
    return trimmed(a);
}

static num quotient(num a, num b) {
    real inverse = 1 / rough(b);
    num q = exact(rough(a) * inverse);
    for (int i = 0; i < 3 + BITS / 50; i++) q = plus(q, exact(rough(minus(a, times(q, b))) * inverse));
    return q;
}

static void sine_cosine(num y, num *sine, num *cosine) {
    num term = exact(1), both[2] = {ZERO, ZERO};
    for (int k = 0; term.n; term = over_int(times(term, y), ++k)) {
        num *to = &both[k % 2];
        *to = k % 4 < 2 ? plus(*to, term) : minus(*to, term);
    }
    *sine = both[1], *cosine = both[0];
}
