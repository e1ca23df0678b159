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
