/* One run a thread, for a GPU: what vector.h says of W runs, with W = 1.  F is one float, I one whole number, and a comparison gives an I
   of 0 or -1, as there. */
#ifdef __CUDACC_RTC__
typedef int int32_t;
typedef long long int64_t;
#endif
#ifndef NAN
#define NAN __int_as_float(0x7fffffff)
#define INFINITY __int_as_float(0x7f800000)
#endif

#if DOUBLE
typedef double real;
typedef int64_t integer;
#define REAL(x) x
#define FN(name) name
#define bits(x) ((integer)__double_as_longlong(x))
#define from_bits(x) __longlong_as_double(x)
#else
typedef float real;
typedef int32_t integer;
#define REAL(x) x##f
#define FN(name) name##f
#define bits(x) __float_as_int(x)
#define from_bits(x) __int_as_float(x)
#endif
typedef real F;
typedef integer I;
typedef union { real f; integer i; } word;

#define W 1
#define INLINE static __device__ __forceinline__
#define FUNCTION INLINE
#define SEPARATE INLINE
#define RESTRICT __restrict__
#define TABLE static __device__ const integer
#define MASK(comparison) (-(I)(comparison))
#define AT(x, l) (x)
#define splat(x) ((F)(x))
#define splat_i(x) ((I)(x))
#define from(first) (first)
#define to_float(x) ((F)(x))
#define to_int(x) ((I)(x))
INLINE int any_run(I x) { return x != 0; }
INLINE void write_column(word *place, int columns, F x) { place->f = x; }
INLINE void write_column(word *place, int columns, I x) { place->i = x; }
INLINE F f_lookup(const integer *table, integer size, I i) { return from_bits(table[i < 0 ? 0 : i < size ? i : size - 1]); }
struct all_runs {};
struct one_run {};
template <typename count> INLINE void store_some(real *p, F x, count) { *p = x; }
#define LANEWISE(name, call) INLINE F name(F x) { return FN(call)(x); }
#define LANEWISE2(name, call) INLINE F name(F x, F y) { return FN(call)(x, y); }
#define LANEWISE_WHERE(name, call) static __device__ __attribute__((noinline)) F name(I which, F x, F y) { return which ? FN(call)(x) : y; }
