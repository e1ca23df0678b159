/* What a GPU does in another way than scalar.h and mathlib.h say.

   tests/kernels/cuda_language.h has the functions of this file's CUDA for a processor. */

/* 1 / y: in float32 to 1 ulp, in float64 to 20 bits; a subnormal y or result counts as zero. */
#ifdef __CUDA_ARCH__
#if DOUBLE
INLINE F rough_reciprocal(F y) { F r; asm("rcp.approx.ftz.f64 %0, %1;" : "=d"(r) : "d"(y)); return r; }
#else
INLINE F rough_reciprocal(F y) { F r; asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(y)); return r; }
#endif
#endif

/* A quotient without a branch.  The division of IEEE 754 calls a function where its result may be subnormal, which cuts a step into pieces that
   are scheduled apart.  This one is at most 1 ulp from it where x, y, 1 / y and x / y are normal numbers.  Where the correction has no value,
   because a number is zero, infinite or NaN, the product is the quotient. */
INLINE F f_div(F x, F y) {
  F r = rough_reciprocal(y), product = x * r;
#if DOUBLE
  F e = FN(fma)(-y, r, REAL(1.0));
  r = FN(fma)(r, FN(fma)(e, e, e), r);
#endif
  F q = x * r;
  q = FN(fma)(r, FN(fma)(-y, q, x), q);
  return q == q ? q : product;
}

/* The largest and the smallest of two numbers; NaN if one of them is. */
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800 && !DOUBLE
INLINE F larger(F x, F y) { F m; asm("max.NaN.f32 %0, %1, %2;" : "=f"(m) : "f"(x), "f"(y)); return m; }
INLINE F smaller(F x, F y) { F m; asm("min.NaN.f32 %0, %1, %2;" : "=f"(m) : "f"(x), "f"(y)); return m; }
#else
INLINE F larger(F x, F y) { return f_max(x, y); }
INLINE F smaller(F x, F y) { return f_min(x, y); }
#endif

/* Number k of a row of the table of signals.  All threads read the same word; 16 bytes are read at once. */
#if !defined(__CUDA_ARCH__)
INLINE word signal(const word *row, int k) { return row[k]; }
#elif DOUBLE
INLINE word signal(const word *row, int k) {
  double2 some = __ldg((const double2 *)row + k / 2);
  word found;
  found.f = k % 2 == 0 ? some.x : some.y;
  return found;
}
#else
INLINE word signal(const word *row, int k) {
  float4 some = __ldg((const float4 *)row + k / 4);
  word found;
  found.f = k % 4 == 0 ? some.x : k % 4 == 1 ? some.y : k % 4 == 2 ? some.z : some.w;
  return found;
}
#endif

/* Angles beyond SINCOS_LIMIT.  A branch for them in every step would cut the step into pieces, too.  A first attempt (`careful` is false)
   therefore only notes whether there was such an angle; if so, the thread makes the steps of the launch once more, carefully.  A step that
   calls functions (CALLS) has no first attempt: it is long, and a second copy of it would double the compiler's time. */
template <bool careful> struct angles {
  I far = 0;
  __device__ __forceinline__ int need_care(I which) {
    if (careful) return any_run(which);
    far |= which;
    return 0;
  }
};
/* The generated functions are members of `rollout`, which inherits from `angles`. */
#define is_far(x) MASK(FN(fabs)(x) > (F)SINCOS_LIMIT)
#undef RARELY
#undef FUNCTION
#undef SEPARATE
#define RARELY(which) this->need_care(which)
#define FUNCTION __device__ __forceinline__
#define SEPARATE FUNCTION
