/* What a CUDA source needs to compile as C++: a launch becomes two loops, over blocks and over the threads of each. */
#include <math.h>
#include <stdint.h>

#define __global__
#define __device__
#define __forceinline__ inline
#define __launch_bounds__(threads, blocks)

struct place { unsigned x; };
static thread_local place blockIdx, threadIdx, blockDim;

template <typename T, typename S> static inline T same_bits(S x) { T y; __builtin_memcpy(&y, &x, sizeof y); return y; }
static inline int __float_as_int(float x) { return same_bits<int>(x); }
static inline float __int_as_float(int x) { return same_bits<float>(x); }
static inline long long __double_as_longlong(double x) { return same_bits<long long>(x); }
static inline double __longlong_as_double(long long x) { return same_bits<double>(x); }

/* The reciprocals of a GPU with errors as large as NVIDIA's documentation allows: an ulp in float32, 32 of the 52 bits in float64. */
static inline float rough_reciprocal(float y) {
  float r = __builtin_fabsf(y) < 0x1p-126f ? __builtin_copysignf(INFINITY, y) : 1.0f / y;
  if (__builtin_fabsf(r) < 0x1p-126f) return __builtin_copysignf(0.0f, y);
  return __builtin_isfinite(r) ? __int_as_float(__float_as_int(r) + (__float_as_int(y) & 1 ? 1 : -1)) : r;
}
static inline double without_low_bits(double x) { return __longlong_as_double(__double_as_longlong(x) & ~0xffffffffLL); }
static inline double rough_reciprocal(double y) {
  double r = __builtin_fabs(y) < 0x1p-1022 ? __builtin_copysign(INFINITY, y) : 1.0 / (y == y ? without_low_bits(y) : y);
  if (__builtin_fabs(r) < 0x1p-1022) return __builtin_copysign(0.0, y);
  return r == r ? without_low_bits(r) : r;
}
