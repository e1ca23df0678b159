INLINE F f_abs(F x) { return FN(fabs)(x); }
INLINE F with_sign(F x, F s) { return from_bits(bits(x) ^ (bits(s) & SIGN_BIT)); }
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

/* A quotient without a branch.  The division of IEEE 754 calls a function where its result may be subnormal, which cuts a step into pieces that
   are scheduled apart.  This one is at most 1 ulp from it, but takes a denominator below the smallest normal number for zero and one above 2^126
   (1 / the smallest normal number) for infinite.  Where the correction has no value, the quotient is zero, infinite or NaN without it. */
#ifdef __CUDA_ARCH__
#if DOUBLE
INLINE F f_div(F x, F y) {
  F r, e, q;
  asm("rcp.approx.ftz.f64 %0, %1;" : "=d"(r) : "d"(y));
  F rough = x * r;
  e = 1.0 - y * r;
  r = r + r * (e + e * e);
  q = x * r;
  q = q + r * (x - y * q);
  return q == q ? q : rough;
}
#else
INLINE F f_div(F x, F y) {
  F r;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(y));
  F rough = x * r;
  F q = rough + r * (x - y * rough);
  return q == q ? q : rough;
}
#endif
#else
INLINE F f_div(F x, F y) { return x / y; }
#endif

/* The largest and the smallest of two numbers; NaN if one of them is. */
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800 && !DOUBLE
INLINE F f_max(F x, F y) {
  F m;
  asm("max.NaN.f32 %0, %1, %2;" : "=f"(m) : "f"(x), "f"(y));
  return m;
}
INLINE F f_min(F x, F y) {
  F m;
  asm("min.NaN.f32 %0, %1, %2;" : "=f"(m) : "f"(x), "f"(y));
  return m;
}
#else
INLINE F f_max(F x, F y) { F m = x > y ? x : y; return x != x ? x : m; }
INLINE F f_min(F x, F y) { F m = x < y ? x : y; return x != x ? x : m; }
#endif
