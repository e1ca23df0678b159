/* Elementary functions, on vectors of runs or (scalar.h) one run.  tests/kernels/test_operations.py holds their errors to: sin, cos 2.1 ulp, for every
   finite x; exp, expm1, log, log1p, atan 3.6 ulp; tanh, tan, logistic 5.6 ulp.  Sources: W. J. Cody, W. Waite, Software Manual for the
   Elementary Functions, 1980 (range reduction); S. Moshier, Cephes (coefficients of sin, cos, atan). */

#if DOUBLE
#define MANTISSA 52
#define EXPONENT_BIAS 1023
#define SIGN_BIT ((integer)1 << 63)
#define SMALLEST_NORMAL 0x1p-1022
#define SCALE_UP 0x1p54
#define SCALE_UP_BITS 54
#else
#define MANTISSA 23
#define EXPONENT_BIAS 127
#define SIGN_BIT ((integer)1 << 31)
#define SMALLEST_NORMAL 0x1p-126f
#define SCALE_UP 0x1p25f
#define SCALE_UP_BITS 25
#endif

INLINE F f_abs(F x) { return from_bits(bits(x) & ~splat_i(SIGN_BIT)); }
INLINE F with_sign(F x, F s) { return from_bits(bits(x) ^ (bits(s) & SIGN_BIT)); }
INLINE F f_max(F x, F y) { F m = x > y ? x : y; return x != x ? x : m; }
INLINE F f_min(F x, F y) { F m = x < y ? x : y; return x != x ? x : m; }
INLINE I i_max(I x, I y) { return x > y ? x : y; }
INLINE I i_min(I x, I y) { return x < y ? x : y; }
INLINE F f_sign(F x) { F one = splat(1), zero = splat(0); return x > zero ? one : (x < zero ? -one : x); }
INLINE I f_is_finite(F x) { return MASK(f_abs(x) < splat(INFINITY)); }
LANEWISE(f_sqrt, sqrt)
LANEWISE(f_floor, floor)
LANEWISE(f_ceil, ceil)
LANEWISE(f_round_even, rint)
LANEWISE(f_asin, asin) LANEWISE(f_acos, acos) LANEWISE(f_sinh, sinh) LANEWISE(f_cosh, cosh) LANEWISE(f_asinh, asinh)
LANEWISE(f_acosh, acosh) LANEWISE(f_atanh, atanh) LANEWISE(f_exp2, exp2) LANEWISE(f_erf, erf) LANEWISE(f_erfc, erfc) LANEWISE(f_cbrt, cbrt)
LANEWISE2(f_pow, pow) LANEWISE2(f_rem, fmod)
INLINE F f_rsqrt(F x) { return REAL(1.0) / f_sqrt(x); }

/* Adding and taking away MAGIC rounds to a whole number, which then stands in the low bits. */
#if DOUBLE
#define MAGIC 0x1.8p52
#define SINCOS_LIMIT 1e14
#define HALF_PI_1 1.5707963267948966
#define HALF_PI_2 6.123233995736766e-17
#define HALF_PI_3 -1.4973849048591833e-33
#define LN2_HI 6.93147180369123816490e-01
#define LN2_LO 1.90821492927058770002e-10
#define EXP_LOW -746.0
#define EXP_HIGH 709.782712893384
#else
#define MAGIC 0x1.8p23f
#define SINCOS_LIMIT 1e6f
#define HALF_PI_1 1.57079637050628662109375f
#define HALF_PI_2 -4.37113900018624283e-8f
#define HALF_PI_3 -1.71512451000588192e-15f
#define LN2_HI 6.9313812256e-01f
#define LN2_LO 9.0580006145e-06f
#define EXP_LOW -104.0f
#define EXP_HIGH 88.72283f
#endif

/* A product with a part of pi / 2 is exact within a fused multiply-add, or for two quadrants. */
#if !(defined(__FMA__) || defined(__ARM_FEATURE_FMA) || defined(__CUDACC_RTC__))
#undef SINCOS_LIMIT
#define SINCOS_LIMIT REAL(3.0)
#endif

typedef struct { F s, c; I quadrant; } reduced;

INLINE reduced reduce(F x) {
  F t = x * REAL(0.6366197723675814) + MAGIC, k = t - MAGIC;
  F r = ((x - k * HALF_PI_1) - k * HALF_PI_2) - k * HALF_PI_3;
  F z = r * r;
#if DOUBLE
  F s = ((((1.58962301576546568060e-10 * z - 2.50507477628578072866e-8) * z + 2.75573136213857245213e-6) * z
          - 1.98412698295895385996e-4) * z + 8.33333333332211858878e-3) * z - 1.66666666666666307295e-1;
  F c = ((((-1.13585365213876817300e-11 * z + 2.08757008419747316778e-9) * z - 2.75573141792967388112e-7) * z
          + 2.48015872888517045348e-5) * z - 1.38888888888730564116e-3) * z + 4.16666666666665929218e-2;
#else
  F s = (-1.9515295891e-4f * z + 8.3321608736e-3f) * z - 1.6666654611e-1f;
  F c = (2.443315711809948e-5f * z - 1.388731625493765e-3f) * z + 4.166664568298827e-2f;
#endif
  reduced out = {s * z * r + r, c * z * z + (REAL(1.0) - REAL(0.5) * z), bits(t)};
  return out;
}

/* Every second quadrant takes the other polynomial, every second pair of them the other sign. */
#define TO_SIGN (8 * (int)sizeof(real) - 2)
INLINE F sine_of(reduced a) {
  F y = (a.quadrant & 1) != 0 ? a.c : a.s;
  return from_bits(bits(y) ^ ((a.quadrant & 2) << TO_SIGN));
}
INLINE F cosine_of(reduced a) {
  F y = (a.quadrant & 1) != 0 ? a.s : a.c;
  return from_bits(bits(y) ^ (((a.quadrant + 1) & 2) << TO_SIGN));
}
/* Right up to SINCOS_LIMIT; beyond it, and where x is infinite, the C library's, of x, takes the place of y.  One test does for several angles
   (`emit_c`). */
INLINE F near_sin(F x) { return sine_of(reduce(x)); }
INLINE F near_cos(F x) { return cosine_of(reduce(x)); }
INLINE I is_far(F x) { return MASK(f_abs(x) > splat(SINCOS_LIMIT)); }
#define RARELY(which) __builtin_expect(any_run(which), 0)
LANEWISE_WHERE(sin_where, sin)
LANEWISE_WHERE(cos_where, cos)
INLINE F f_sin(F x) {
  F y = near_sin(x);
  return RARELY(is_far(x)) ? sin_where(is_far(x), x, y) : y;
}
INLINE F f_cos(F x) {
  F y = near_cos(x);
  return RARELY(is_far(x)) ? cos_where(is_far(x), x, y) : y;
}
INLINE F f_tan(F x) { return f_sin(x) / f_cos(x); }

INLINE F power_of_two(I k) { return from_bits((k + EXPONENT_BIAS) << MANTISSA); }

/* exp(r) - 1 for |r| <= ln2 / 2 */
INLINE F expm1_small(F r) {
#if DOUBLE
  F p = splat(1.0 / 6227020800.0);
  p = p * r + 1.0 / 479001600.0; p = p * r + 1.0 / 39916800.0; p = p * r + 1.0 / 3628800.0; p = p * r + 1.0 / 362880.0;
  p = p * r + 1.0 / 40320.0; p = p * r + 1.0 / 5040.0;
#else
  F p = splat(1.0f / 5040.0f);
#endif
  p = p * r + REAL(1.0) / REAL(720.0); p = p * r + REAL(1.0) / REAL(120.0); p = p * r + REAL(1.0) / REAL(24.0);
  p = p * r + REAL(1.0) / REAL(6.0); p = p * r + REAL(0.5);
  return p * (r * r) + r;
}

INLINE F exp_scaled(F x, int minus_one) {
  F low = splat(EXP_LOW), high = splat(EXP_HIGH), y = x < low ? low : x;
  y = y > high ? high : y;
  F t = y * REAL(1.4426950408889634) + MAGIC, k = t - MAGIC, r = (y - k * LN2_HI) - k * LN2_LO;
  I n = to_int(k), half = n >> 1;
  F a = power_of_two(half), b = power_of_two(n - half), p = expm1_small(r);
  F value = minus_one ? (a * p) * b + (a * b - REAL(1.0)) : ((REAL(1.0) + p) * a) * b;
  F infinite = splat(INFINITY);
  value = x > high ? infinite : value;
  return x != x ? x : value;
}
INLINE F f_exp(F x) { return exp_scaled(x, 0); }
INLINE F f_expm1(F x) { return exp_scaled(x, 1); }
INLINE F f_logistic(F x) { return REAL(1.0) / (REAL(1.0) + f_exp(-x)); }
INLINE F f_tanh(F x) {
  F a = f_abs(x), big = splat(REAL(22.0)), y = a > big ? big : a, e = f_expm1(y + y);
  return with_sign(e / (e + REAL(2.0)), x);
}

/* log(x) for x > 0, finite */
INLINE F log_positive(F x) {
  F tiny = splat(SMALLEST_NORMAL);
  I is_tiny = MASK(x < tiny);
  F y = is_tiny ? x * SCALE_UP : x;
  I extra = is_tiny & SCALE_UP_BITS, u = bits(y) - bits(splat(REAL(0.70710678118654752))), e = u >> MANTISSA;
  F m = from_bits((u & (((integer)1 << MANTISSA) - 1)) + bits(splat(REAL(0.70710678118654752))));
  F k = to_float(e - extra), f = m - REAL(1.0), s = f / (REAL(2.0) + f), z = s * s, h = REAL(0.5) * f * f;
#if DOUBLE
  F p = splat(2.0 / 23.0);
  p = p * z + 2.0 / 21.0; p = p * z + 2.0 / 19.0; p = p * z + 2.0 / 17.0; p = p * z + 2.0 / 15.0; p = p * z + 2.0 / 13.0;
  p = p * z + 2.0 / 11.0;
#else
  F p = splat(2.0f / 11.0f);
#endif
  p = p * z + REAL(2.0) / REAL(9.0); p = p * z + REAL(2.0) / REAL(7.0); p = p * z + REAL(2.0) / REAL(5.0);
  p = p * z + REAL(2.0) / REAL(3.0);
  return k * LN2_HI - ((h - (s * (h + p * z) + k * LN2_LO)) - f);
}
INLINE F f_log(F x) {
  F zero = splat(0), infinite = splat(INFINITY), nan = splat(NAN), one = splat(1);
  F safe = (x > zero) & (x < infinite) ? x : one, y = log_positive(safe);
  y = x == infinite ? infinite : y;
  y = x == zero ? -infinite : y;
  return x >= zero ? y : nan;
}
INLINE F f_log1p(F x) {
  F u = x + REAL(1.0), infinite = splat(INFINITY), zero = splat(0);
  F c = (x - (u - REAL(1.0))) / u;
  c = (u > zero) & (u < infinite) ? c : zero;
  F y = f_log(u) + c;
  F one = splat(1);
  return u == one ? x : y;
}

INLINE F f_atan(F x) {
  F a = f_abs(x), one = splat(1), zero = splat(0);
  F high = splat(REAL(2.414213562373095)), middle = splat(REAL(0.41421356237309503));
  I far = MASK(a > high), mid = MASK(a > middle) & ~far;
  F numerator = far ? -one : (mid ? a - REAL(1.0) : a), denominator = far ? a : (mid ? a + REAL(1.0) : one);
  F w = numerator / denominator, z = w * w;
  F offset = far ? splat(REAL(1.5707963267948966)) : (mid ? splat(REAL(0.78539816339744831)) : zero);
#if DOUBLE
  F p = (((-8.750608600031904122785e-1 * z - 1.615753718733365076637e1) * z - 7.500855792314704667340e1) * z
         - 1.228866684490136173410e2) * z - 6.485021904942025371773e1;
  F q = ((((z + 2.485846490142306297962e1) * z + 1.650270098316988542046e2) * z + 4.328810604912902668951e2) * z
         + 4.853903996359136964868e2) * z + 1.945506571482613964425e2;
  F small = far ? splat(6.123233995736765886130e-17) : (mid ? splat(3.061616997868382943065e-17) : zero);
  F y = w * (z * (p / q)) + w + small;
#else
  F y = (((8.05374449538e-2f * z - 1.38776856032e-1f) * z + 1.99777106478e-1f) * z - 3.33329491539e-1f) * z * w + w;
#endif
  return with_sign(offset + y, x);
}
INLINE F f_atan2(F y, F x) {
  F zero = splat(0), pi = splat(REAL(3.14159265358979323846));
  F a = f_atan(y / x);
  I left = MASK(bits(x) < 0);
  F both_zero = with_sign(left ? pi : zero, y), shifted = left ? a + with_sign(pi, y) : a;
  F infinite = splat(INFINITY);
  I corner = (f_abs(x) == infinite) & (f_abs(y) == infinite);
  F at_corner = with_sign(left ? splat(REAL(2.35619449019234492885)) : splat(REAL(0.78539816339744831)), y);
  F result = (x == zero) & (y == zero) ? both_zero : shifted;
  result = corner ? at_corner : result;
  return (x != x) | (y != y) ? x + y : result;
}
