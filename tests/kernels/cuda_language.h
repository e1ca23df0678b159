/* What a CUDA source needs to compile as C++: a launch becomes two loops, over blocks and over the threads of each. */
#include <math.h>
#include <stdint.h>

#define __global__
#define __device__
#define __constant__ static
#define __forceinline__ inline
#define __launch_bounds__(threads, blocks)

struct place { unsigned x; };
static thread_local place blockIdx, threadIdx, blockDim;

template <typename T, typename S> static inline T same_bits(S x) { T y; __builtin_memcpy(&y, &x, sizeof y); return y; }
static inline int __float_as_int(float x) { return same_bits<int>(x); }
static inline float __int_as_float(int x) { return same_bits<float>(x); }
static inline long long __double_as_longlong(double x) { return same_bits<long long>(x); }
static inline double __longlong_as_double(long long x) { return same_bits<double>(x); }
