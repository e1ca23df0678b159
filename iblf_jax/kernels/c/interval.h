/* Intervals of W boxes: a vector of intervals has the bounds of each box in its lanes, as -lower and upper, so that both are rounded upward.
   Every function expects the rounding mode FE_UPWARD (boxes.h sets it) and encloses the exact result for all real numbers in its arguments.

   A bound that is infinite or NaN means "no bound".  No operation may replace NaN by a smaller number: a comparison with NaN is false, so
   `x < y ? x : y` is y where either is NaN; `largest` returns NaN or infinity where an argument is NaN.  -lower and upper are never -infinity.

   The polynomials are truncated Taylor series.  Their errors are proved for any rounding mode, in which an operation has a relative error of at
   most u = 2^-52: a polynomial by Horner's rule with n operations errs by at most g(n) = n u / (1 - n u) times the sum of the absolute terms.
   UNDERFLOW exceeds the errors of denormal results, for which this is not so. */
#include <fenv.h>
#define UNDERFLOW 1e-300

typedef struct { F n, u; } interval;
typedef struct { I yes, no; } truth;  /* for all numbers of the arguments; neither where it is undecided */

INLINE F all_lanes(real x) { F y; for (int l = 0; l < W; l++) y[l] = x; return y; }
/* In memory, and not a constant: `x < infinity` would become `x <= DBL_MAX`, for which there is no minimum in one instruction. */
extern "C" __attribute__((visibility("default"))) real no_bound;
real no_bound = INFINITY;
#define UNBOUNDED all_lanes(no_bound)
INLINE F smaller(F x, F y) { return x < y ? x : y; }
INLINE F larger(F x, F y) { return x > y ? x : y; }
INLINE F largest(F x, F y) { return larger(smaller(x, UNBOUNDED), y); }
INLINE interval whole_line(void) { interval r = {UNBOUNDED, UNBOUNDED}; return r; }
INLINE interval unless(I undefined, interval x) {
  interval r = {undefined ? UNBOUNDED : x.n, undefined ? UNBOUNDED : x.u};
  return r;
}
INLINE interval at(F x) { interval r = {-x, x}; return r; }


/* Arithmetic */

INLINE interval i_add(interval x, interval y) { interval r = {x.n + y.n, x.u + y.u}; return r; }
INLINE interval i_sub(interval x, interval y) { interval r = {x.n + y.u, x.u + y.n}; return r; }
INLINE interval i_neg(interval x) { interval r = {x.u, x.n}; return r; }

/* The factor of each bound of x that gives the larger product depends on the sign of this bound alone. */
INLINE interval i_mul(interval x, interval y) {
  F zero = {};
  I right = x.u >= zero, left = x.n >= zero;
  F yl = -y.n, yr = -y.u;
  F u = largest(x.u * (right ? y.u : yl), x.n * (left ? y.n : yr));
  F n = largest(x.u * (right ? y.n : yr), x.n * (left ? y.u : yl));
  interval r = {n, u};
  return r;
}
/* The product with a positive number. */
INLINE interval i_scaled(interval x, F k) { interval r = {x.n * k, x.u * k}; return r; }

INLINE interval i_div(interval x, interval y) {
  F zero = {};
  I negative = y.u < zero, positive = y.n < zero;
  F n = negative ? x.u : x.n, u = negative ? x.n : x.u;
  F nearest = negative ? -y.u : -y.n, farthest = negative ? y.n : y.u;
  interval r = {n / (n >= zero ? nearest : farthest), u / (u >= zero ? nearest : farthest)};
  return unless(~(negative | positive), r);
}

/* The product with a number that is the same for all boxes, of which `positive` and `negative` are the parts max(k, 0) and max(-k, 0). */
typedef struct { F positive, negative; } factor;
INLINE factor factor_of(F k) { F zero = {}; factor r = {larger(k, zero), larger(-k, zero)}; return r; }
INLINE interval i_times(interval x, factor k) {
  interval r = {x.n * k.positive + x.u * k.negative, x.u * k.positive + x.n * k.negative};
  return r;
}
/* The product with an interval that is the same for all boxes.  The upper bound is the larger of two products of the upper bound of x, if y >= 0,
   or of -lower, if y <= 0; of one of each, if y contains 0.  The other products are with 0. */
typedef struct { F a, b, c, d; } factors;
INLINE factors factors_of(interval given) {
  F zero = {};
  /* Infinity in place of NaN: `larger` would drop NaN. */
  interval y = {smaller(given.n, UNBOUNDED), smaller(given.u, UNBOUNDED)};
  I positive = y.n <= zero, negative = ~positive & (y.u <= zero);
  factors r = {negative ? zero : y.u, positive ? -y.n : zero, negative ? y.n : zero, positive ? zero : (negative ? -y.u : y.n)};
  return r;
}
INLINE interval i_multiple(interval x, factors y) {
  interval r = {larger(x.n * y.a + x.u * y.c, x.n * y.b + x.u * y.d), larger(x.u * y.a + x.n * y.c, x.u * y.b + x.n * y.d)};
  return r;
}

INLINE factors reciprocals_of(interval y) { return factors_of(i_div(at(all_lanes(1)), y)); }
/* What depends on constants only, in the form in which the rest of the program reads it. */
typedef union { interval number; truth flag; factor single; factors several; } shared_number;

INLINE interval i_abs(interval x) {
  F zero = {};
  interval r = {smaller(x.u, smaller(x.n, zero)), largest(x.n, x.u)};
  return r;
}
INLINE interval i_square(interval x) {
  interval a = i_abs(x), r = {a.n * -a.n, a.u * a.u};
  return r;
}
INLINE interval i_power(interval x, int exponent) {
  interval a = exponent % 2 ? x : i_abs(x);
  F n = a.n, u = a.u, up = larger(a.u, -a.u), down = larger(a.n, -a.n);
  for (int k = 1; k < exponent; k++) { n = n * down; u = u * up; }
  interval r = {n, u};
  return r;
}
INLINE interval i_max(interval x, interval y) { interval r = {smaller(x.n, y.n), largest(x.u, y.u)}; return r; }
INLINE interval i_min(interval x, interval y) { interval r = {largest(x.n, y.n), smaller(x.u, y.u)}; return r; }
INLINE interval i_hull(interval x, interval y) { interval r = {largest(x.n, y.n), largest(x.u, y.u)}; return r; }
INLINE interval i_meet(interval x, interval y) {
  interval r = {smaller(x.n, smaller(y.n, UNBOUNDED)), smaller(x.u, smaller(y.u, UNBOUNDED))};
  return r;
}
/* The sum with 0 times the bound is NaN where there is no bound. */
INLINE interval i_upper(interval x) { F zero = {}; interval r = {x.u * zero - x.u, x.u}; return r; }
INLINE interval i_lower(interval x) { F zero = {}; interval r = {x.n, x.n * zero - x.n}; return r; }
INLINE interval i_sign(interval x) {
  F zero = {}, one = all_lanes(1);
  interval r = {x.n < zero ? -one : (x.n == zero ? zero : one), x.u < zero ? -one : (x.u == zero ? zero : one)};
  return r;
}

/* Comparisons and selections */

INLINE truth t_lt(interval x, interval y) { truth r = {x.u < -y.n, -x.n >= y.u}; return r; }
INLINE truth t_le(interval x, interval y) { truth r = {x.u <= -y.n, -x.n > y.u}; return r; }
INLINE truth t_gt(interval x, interval y) { return t_lt(y, x); }
INLINE truth t_ge(interval x, interval y) { return t_le(y, x); }
INLINE truth t_eq(interval x, interval y) {
  truth r = {(x.u == -x.n) & (y.u == -y.n) & (x.u == y.u), (x.u < -y.n) | (y.u < -x.n)};
  return r;
}
INLINE truth t_not(truth x) { truth r = {x.no, x.yes}; return r; }
INLINE truth t_ne(interval x, interval y) { return t_not(t_eq(x, y)); }
INLINE truth t_and(truth x, truth y) { truth r = {x.yes & y.yes, x.no | y.no}; return r; }
INLINE truth t_or(truth x, truth y) { truth r = {x.yes | y.yes, x.no & y.no}; return r; }
INLINE truth t_xor(truth x, truth y) {
  truth r = {(x.yes & y.no) | (x.no & y.yes), (x.yes & y.yes) | (x.no & y.no)};
  return r;
}
INLINE truth t_same(truth x, truth y) { return t_not(t_xor(x, y)); }
INLINE truth certain(int value) { I yes = {}, no = {}; truth r = {value ? ~yes : yes, value ? no : ~no}; return r; }
INLINE truth t_is_finite(interval x) { truth r = {(x.n < UNBOUNDED) & (x.u < UNBOUNDED), (I){}}; return r; }
INLINE interval i_select(truth c, interval x, interval y) {
  interval both = i_hull(x, y);
  interval r = {c.yes ? x.n : (c.no ? y.n : both.n), c.yes ? x.u : (c.no ? y.u : both.u)};
  return r;
}
INLINE interval number_of(truth c) { return i_select(c, at(all_lanes(1)), at(all_lanes(0))); }
INLINE truth t_select(truth c, truth x, truth y) {
  truth r = {(c.yes & x.yes) | (c.no & y.yes) | (x.yes & y.yes), (c.yes & x.no) | (c.no & y.no) | (x.no & y.no)};
  return r;
}

/* Square roots are correctly rounded upward; an ulp less is a lower bound.  The argument is not negative by construction, so its part below 0 does
   not occur. */
#define ULP 0x1p-52
#if VECTOR_BYTES == 64 && !defined(__clang__)
INLINE F root(F x) { return __builtin_ia32_sqrtpd512_mask(x, x, -1, 4); }
#elif VECTOR_BYTES == 32 && !defined(__clang__)
INLINE F root(F x) { return __builtin_ia32_sqrtpd256(x); }
#else
INLINE F root(F x) { real a[W]; memcpy(a, &x, sizeof a); for (int l = 0; l < W; l++) a[l] = sqrt(a[l]); memcpy(&x, a, sizeof a); return x; }
#endif
INLINE interval i_sqrt(interval x) {
  F zero = {}, low = root(larger(-x.n, zero)), high = root(x.u < zero ? zero : x.u);
  interval r = {low * ULP - low, high};
  return unless(x.u < zero, r);
}
INLINE interval i_rsqrt(interval x) {
  F zero = {}, one = all_lanes(1);
  interval s = i_sqrt(x), r = {-one / s.u, one / -s.n};
  r.u = -s.n > zero ? r.u : UNBOUNDED;
  return unless(~(x.u > zero), r);
}

/* A polynomial by Horner's rule, the highest power first.  Its coefficients are static: with the flags of the rounding mode, the compiler would
   leave the divisions of other constants to the processor. */
template <int N> INLINE F polynomial(F x, const real (&coefficients)[N]) {
  F p = all_lanes(coefficients[0]);
#pragma GCC unroll 24
  for (int k = 1; k < N; k++) p = p * x + coefficients[k];
  return p;
}

/* Exponential function: x = k ln 2 + r.  k LN2_HI and x - k LN2_HI are exact (40 bits and 12; multiples of 2^-54 below 1/2), so that r errs by at
   most 1.1 * 2^-54; in the rounding mode upward |r| <= ln 2 / 2 + 1e-12.  The terms of exp(r) from r^14 on are below 2e-17.
   expm1(r) = r + r^2 q errs by at most g(28) (exp|r| - 1 - |r|) + u |expm1 r| <= 2e-15 |expm1 r|, and exp(r) by 1e-15 <= 1.5e-15 exp(r). */
#define MAGIC 0x1.8p52
#define EXP_ERROR 3e-15
#define EXPM1_ERROR 4e-15
static constexpr real EXPM1_SERIES[] = {
  1.0 / 6227020800.0, 1.0 / 479001600.0, 1.0 / 39916800.0, 1.0 / 3628800.0, 1.0 / 362880.0, 1.0 / 40320.0, 1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0,
  1.0 / 24.0, 1.0 / 6.0, 0.5};
typedef struct { F scale, expm1; } exponential;
INLINE F clamped(F x, real low, real high) {
  F a = all_lanes(low), b = all_lanes(high), y = x < a ? a : x;
  return y > b ? b : y;
}
/* For -700 <= x <= 709: exp(x) = scale (1 + expm1). */
INLINE exponential exponential_of(F x) {
  F t = (x * 1.4426950408889634 - 0.5) + MAGIC, k = t - MAGIC;
  F r = (x - k * 0x1.62e42fefa2000p-1) - k * 0x1.9ef35793c7673p-41;
  I n = bits(t) - bits(all_lanes(MAGIC));
  F p = polynomial(r, EXPM1_SERIES);
  exponential e = {from_bits((n + 1023) << 52), p * (r * r) + r};
  return e;
}
INLINE F exp_above(F x) {
  exponential e = exponential_of(clamped(x, -700, 709));
  F y = (e.expm1 + 1.0) * e.scale * (1 + EXP_ERROR);
  return x > all_lanes(709) ? UNBOUNDED : y;
}
INLINE F minus_exp_below(F x) {
  F zero = {}, low = all_lanes(-700);
  exponential e = exponential_of(clamped(x, -700, 709));
  F y = (-1.0 - e.expm1) * e.scale * (1 - EXP_ERROR);
  return x >= low ? y : zero;
}
SEPARATE interval i_exp(interval x) { interval r = {minus_exp_below(-x.n), exp_above(x.u)}; return r; }
INLINE interval expm1_at(F x) {
  exponential e = exponential_of(clamped(x, -700, 709));
  F one = all_lanes(1), a = e.scale * e.expm1, b = e.scale - 1.0, y = a + b;
  F error = (larger(a, -a) + larger(b, -b)) * EXPM1_ERROR + UNDERFLOW;
  interval r = {smaller(error - y, one), x > all_lanes(709) ? UNBOUNDED : error + y};
  return r;
}
/* An increasing function, from enclosures at the ends. */
INLINE interval increasing(interval low, interval high) { interval r = {low.n, high.u}; return r; }
SEPARATE interval i_expm1(interval x) { return increasing(expm1_at(-x.n), expm1_at(x.u)); }

/* Logarithm: 1 + x = 2^k (1 + f), s = f / (2 + f), log(1 + f) = 2 (s + s^3 / 3 + ...) with |s| <= 0.1716; the terms from s^23 on are below 3e-19.
   s has a relative error of 2 u, the sum one below 8 u in all; k times the upper part of ln 2 is exact. */
#define LOG_ERROR 4e-15
static constexpr real LOG_SERIES[] = {
  2.0 / 21.0, 2.0 / 19.0, 2.0 / 17.0, 2.0 / 15.0, 2.0 / 13.0, 2.0 / 11.0, 2.0 / 9.0, 2.0 / 7.0, 2.0 / 5.0, 2.0 / 3.0};
INLINE interval log_of_parts(F k, F f) {
  F s = f / (f + 2.0), z = s * s, p = polynomial(z, LOG_SERIES);
  F y = p * z * s + 2.0 * s, value = k * 0x1.62e42fefa2000p-1 + (y + k * 0x1.9ef35793c7673p-41);
  F error = (larger(y, -y) + larger(k, -k)) * LOG_ERROR + UNDERFLOW;
  interval r = {error - value, error + value};
  return r;
}
/* The parts of a positive number: 1 + f is between 0.707 and 1.415. */
INLINE F mantissa_and_exponent(F x, F *k) {
  F tiny = all_lanes(0x1p-1022), root_half = all_lanes(0.70710678118654752);
  I is_tiny = x < tiny, u = bits(is_tiny ? x * 0x1p54 : x) - bits(root_half);
  *k = to_float((u >> 52) - (is_tiny & 54));
  return from_bits((u & (((integer)1 << 52) - 1)) + bits(root_half)) - 1.0;
}
INLINE interval log_or_unbounded(interval y, F x) {
  F zero = {};
  interval r = {x > zero ? y.n : UNBOUNDED, x < UNBOUNDED ? y.u : UNBOUNDED};
  return r;
}
INLINE interval log_at(F x) {
  F k, f = mantissa_and_exponent(x, &k);
  return log_or_unbounded(log_of_parts(k, f), x);
}
SEPARATE interval i_log(interval x) {
  F zero = {};
  return unless(~(x.u > zero), increasing(log_at(-x.n), log_at(x.u)));
}
/* log(1 + x), where 1 + x is rounded to `sum` in the direction of the bound. */
INLINE interval log1p_at(F x, F sum) {
  F zero = {}, quarter = all_lanes(0.25), k, f = mantissa_and_exponent(sum, &k);
  I is_near = larger(x, -x) < quarter;
  return log_or_unbounded(log_of_parts(is_near ? zero : k, is_near ? x : f), sum);
}
SEPARATE interval i_log1p(interval x) {
  F minus_one = all_lanes(-1);
  return unless(~(x.u > minus_one), increasing(log1p_at(-x.n, -(x.n - 1.0)), log1p_at(x.u, x.u + 1.0)));
}

/* Sine and cosine: x = k pi / 2 + r for |x| <= 1e5.  pi / 2 is a sum of three numbers, of which two have 36 bits: their products with k are exact,
   and x minus the first is a multiple of 2^-53 below 1.  r errs by at most 2.5e-16; the rounding mode upward makes -0.79 <= r <= 0.79.
   The terms from r^17 (sine) or r^18 (cosine) on are below 7e-17.  With the terms in front of it, sine errs by g(22) 0.09 + u 0.8 + 2.5e-16 < 1e-15,
   cosine by g(22) 0.34 + u + 2.5e-16 < 2.3e-15.  For |x| <= 1/2, where r = x, sine errs by 1e-15 |x|. */
#define SINE_ERROR 2.5e-15
#define LARGEST_ANGLE 1e5
static constexpr real SINE_SERIES[] = {
  -1.0 / 1307674368000.0, 1.0 / 6227020800.0, -1.0 / 39916800.0, 1.0 / 362880.0, -1.0 / 5040.0, 1.0 / 120.0, -1.0 / 6.0};
static constexpr real COSINE_SERIES[] = {
  1.0 / 20922789888000.0, -1.0 / 87178291200.0, 1.0 / 479001600.0, -1.0 / 3628800.0, 1.0 / 40320.0, -1.0 / 720.0, 1.0 / 24.0, -0.5};
typedef struct { F s, c; I quadrant; } angle;
INLINE angle angle_of(F x) {
  F t = (x * 0.63661977236758134 - 0.5) + MAGIC, k = t - MAGIC;
  F r = ((x - k * 0x1.921fb54440000p+0) - k * 0x1.68c234c4c0000p-39) - k * 0x1.98a2e03707345p-77;
  F z = r * r, s = polynomial(z, SINE_SERIES), c = polynomial(z, COSINE_SERIES);
  angle a = {s * z * r + r, c * z + 1.0, bits(t)};
  return a;
}
INLINE F signed_by(F x, I bit) { return from_bits(bits(x) ^ ((bit & 2) << 62)); }
INLINE F sine_of(angle a) { return signed_by((a.quadrant & 1) != 0 ? a.c : a.s, a.quadrant); }
INLINE F cosine_of(angle a) { return signed_by((a.quadrant & 1) != 0 ? a.s : a.c, a.quadrant + 1); }
INLINE I is_far(interval x) {
  F limit = all_lanes(LARGEST_ANGLE);
  return ~((x.n <= limit) & (x.n >= -limit) & (x.u <= limit) & (x.u >= -limit));
}
/* Whether an interval contains (first + period m) pi / 2 for a whole m.  The margin 1e-9 exceeds the rounding errors of the quotients (3e-11); the
   constant rounds up to a whole number. */
INLINE I contains(interval x, real first, real period) {
  F low = -x.n * 0.63661977236758134 - 1e-9, high = x.u * 0.63661977236758134 + 1e-9;
  F m = ((low - first) * (1 / period) + MAGIC) - MAGIC;
  return ~(m * period + first > high);
}
INLINE interval from_ends(F at_low, F low_error, F at_high, F high_error, I has_minimum, I has_maximum) {
  F one = all_lanes(1);
  F n = smaller(larger(low_error - at_low, high_error - at_high), one), u = smaller(larger(at_low + low_error, at_high + high_error), one);
  interval r = {has_minimum ? one : n, has_maximum ? one : u};
  return r;
}
INLINE F sine_error(F x) { F one = all_lanes(1); return smaller(larger(x, -x) * 2.0, one) * SINE_ERROR + UNDERFLOW; }
typedef struct { interval sin, cos; } sine_and_cosine;
SEPARATE sine_and_cosine i_sincos(interval x) {
  angle low = angle_of(-x.n), high = angle_of(x.u);
  F error = all_lanes(SINE_ERROR);
  I far = is_far(x);
  sine_and_cosine r = {
    from_ends(sine_of(low), sine_error(x.n), sine_of(high), sine_error(x.u), far | contains(x, 3, 4), far | contains(x, 1, 4)),
    from_ends(cosine_of(low), error, cosine_of(high), error, far | contains(x, 2, 4), far | contains(x, 0, 4))};
  return r;
}
INLINE interval i_sin(interval x) { return i_sincos(x).sin; }
INLINE interval i_cos(interval x) { return i_sincos(x).cos; }
INLINE interval tangent_at(F x) {
  angle a = angle_of(x);
  F s = sine_of(a), c = cosine_of(a), error = sine_error(x);
  interval sine = {error - s, error + s}, cosine = {SINE_ERROR - c, SINE_ERROR + c};
  return i_div(sine, cosine);
}
SEPARATE interval i_tan(interval x) {
  return unless(is_far(x) | contains(x, 1, 2), increasing(tangent_at(-x.n), tangent_at(x.u)));
}

/* Arctangent: of w = x, (|x| - 1) / (|x| + 1) or -1 / |x| with |w| <= 0.4143, which errs by 3 u |w|; the terms from w^41 on are below 1e-17.  The
   sum errs by g(40) 0.03 + u 0.45, with pi / 2 or pi / 4 by 1.2e-15 in all, and relative to |x| where w = x. */
#define ATAN_ERROR 3e-15
static constexpr real ATAN_SERIES[] = {
  -1.0 / 39.0, 1.0 / 37.0, -1.0 / 35.0, 1.0 / 33.0, -1.0 / 31.0, 1.0 / 29.0, -1.0 / 27.0, 1.0 / 25.0, -1.0 / 23.0, 1.0 / 21.0, -1.0 / 19.0,
  1.0 / 17.0, -1.0 / 15.0, 1.0 / 13.0, -1.0 / 11.0, 1.0 / 9.0, -1.0 / 7.0, 1.0 / 5.0, -1.0 / 3.0};
INLINE interval atan_at(F x) {
  F a = larger(x, -x), one = all_lanes(1), zero = {};
  I far = a > all_lanes(2.414213562373095), middle = (a > all_lanes(0.41421356237309503)) & ~far;
  F w = (far ? -one : (middle ? a - 1.0 : a)) / (far ? a : (middle ? a + 1.0 : one)), z = w * w;
  F offset = far ? all_lanes(1.5707963267948966) : (middle ? all_lanes(0.78539816339744831) : zero);
  F p = polynomial(z, ATAN_SERIES);
  F y = p * z * w + w + offset, error = (far | middle) != 0 ? all_lanes(ATAN_ERROR) : a * ATAN_ERROR + UNDERFLOW;
  y = x < zero ? -y : y;
  interval r = {error - y, error + y};
  return r;
}
SEPARATE interval i_atan(interval x) { return increasing(atan_at(-x.n), atan_at(x.u)); }

/* Hyperbolic functions, from enclosures of exp(x) - 1 at the ends of the interval: e + e / (1 + e) = 2 sinh(x), e (2 x) / (e (2 x) + 2) = tanh(x). */
INLINE interval sinh_at(F x) {
  F zero = {};
  interval e = expm1_at(larger(x, -x)), one = at(all_lanes(1)), y = i_scaled(i_add(e, i_div(e, i_add(e, one))), all_lanes(0.5));
  interval r = {x < zero ? y.u : y.n, x < zero ? y.n : y.u};
  return r;
}
SEPARATE interval i_sinh(interval x) { return increasing(sinh_at(-x.n), sinh_at(x.u)); }
SEPARATE interval i_cosh(interval x) {
  interval a = i_abs(x), low = {minus_exp_below(-a.n), exp_above(-a.n)}, high = {minus_exp_below(a.u), exp_above(a.u)}, one = at(all_lanes(1));
  interval r = increasing(i_add(low, i_div(one, low)), i_add(high, i_div(one, high)));
  return i_scaled(r, all_lanes(0.5));
}
INLINE interval tanh_at(F x) {
  interval e = expm1_at(clamped(x, -20, 20) * 2.0), two = at(all_lanes(2)), r = i_div(e, i_add(e, two));
  F one = all_lanes(1), high = all_lanes(20), low = all_lanes(-20);
  r.n = x >= low ? smaller(r.n, one) : one;
  r.u = x <= high ? smaller(r.u, one) : one;
  return r;
}
SEPARATE interval i_tanh(interval x) { return increasing(tanh_at(-x.n), tanh_at(x.u)); }

INLINE interval i_logistic(interval x) { interval one = at(all_lanes(1)); return i_div(one, i_add(one, i_exp(i_neg(x)))); }
/* x^y for a y that may be no whole number: without bounds where x may be negative, where it is not defined. */
INLINE interval i_pow(interval x, interval y) {
  F zero = {};
  return unless(~(x.n <= zero), i_exp(i_mul(y, i_log(x))));
}
