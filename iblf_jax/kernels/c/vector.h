/* Vectors of runs: F holds one float of each of W runs, I one whole number, and a comparison gives an I of 0 or -1.
   GCC's vector extension, which Clang has too: every operator works lane by lane, on any processor. */
#include <math.h>
#include <pthread.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if DOUBLE
typedef double real;
typedef int64_t integer;
#define REAL(x) x
#define FN(name) name
#else
typedef float real;
typedef int32_t integer;
#define REAL(x) x##f
#define FN(name) name##f
#endif

#ifndef VECTOR_BYTES
#if defined(__AVX512F__)
#define VECTOR_BYTES 64
#elif defined(__AVX__)
#define VECTOR_BYTES 32
#else
#define VECTOR_BYTES 16
#endif
#endif
#define W ((int)(VECTOR_BYTES / sizeof(real)))

typedef real F __attribute__((vector_size(VECTOR_BYTES)));
typedef integer I __attribute__((vector_size(VECTOR_BYTES)));
typedef union { real f; integer i; } word;

#define INLINE static inline __attribute__((always_inline))
#define FUNCTION static
#define SEPARATE static __attribute__((noinline))
#define RESTRICT __restrict__
#define TABLE static const integer
#define MASK(comparison) (comparison)
#define AT(x, l) (x)[l]
INLINE F splat(real x) { return x - (F){}; }
INLINE I splat_i(integer x) { return x - (I){}; }
INLINE F load(const real *p) { F x; memcpy(&x, p, sizeof x); return x; }
INLINE void store(real *p, F x) { memcpy(p, &x, sizeof x); }
struct all_runs {};
struct one_run {};
INLINE void store_some(real *p, F x, all_runs) { store(p, x); }
INLINE void store_some(real *p, F x, one_run) { *p = x[0]; }
INLINE void store_some(real *p, F x, int count) { for (int l = 0; l < count; l++) p[l] = x[l]; }
/* Into a column of a table, one row a run: there may be hundreds of columns, each written once in W steps, so the loop is not repeated. */
SEPARATE void write_column(word *place, int columns, F x) { for (int l = 0; l < W; l++) place[l * columns].f = x[l]; }
SEPARATE void write_column(word *place, int columns, I x) { for (int l = 0; l < W; l++) place[l * columns].i = x[l]; }
INLINE I from(integer first) { I x; for (int l = 0; l < W; l++) x[l] = first + l; return x; }
INLINE I bits(F x) { return (I)x; }
INLINE F from_bits(I x) { return (F)x; }
INLINE F to_float(I x) { return __builtin_convertvector(x, F); }
INLINE I to_int(F x) { return __builtin_convertvector(x, I); }

/* Whether a comparison holds for any run: an instruction or two where the processor has them, of a name that GCC and Clang share. */
#if VECTOR_BYTES == 64 && defined(__AVX512DQ__)
typedef long long longs __attribute__((vector_size(VECTOR_BYTES)));
typedef int ints __attribute__((vector_size(VECTOR_BYTES)));
INLINE int any_run(I x) { return DOUBLE ? __builtin_ia32_cvtq2mask512((longs)x) != 0 : __builtin_ia32_cvtd2mask512((ints)x) != 0; }
#elif VECTOR_BYTES == 32 && defined(__AVX__)
typedef float floats __attribute__((vector_size(VECTOR_BYTES)));
INLINE int any_run(I x) { return __builtin_ia32_movmskps256((floats)x) != 0; }
#elif VECTOR_BYTES == 16 && defined(__SSE__)
typedef float floats __attribute__((vector_size(VECTOR_BYTES)));
INLINE int any_run(I x) { return __builtin_ia32_movmskps((floats)x) != 0; }
#else
INLINE int any_run(I x) { integer y = 0; for (int l = 0; l < W; l++) y |= x[l]; return y != 0; }
#endif

INLINE F f_lookup(const integer *table, integer size, I index) {
  I x; for (int l = 0; l < W; l++) x[l] = table[index[l] < 0 ? 0 : index[l] < size ? index[l] : size - 1]; return from_bits(x); }

/* A function of the C library, lane by lane; the compiler makes a vector instruction of it where there is one. */
#define LANEWISE(name, call) INLINE F name(F x) { \
  real a[W]; memcpy(a, &x, sizeof a); for (int l = 0; l < W; l++) a[l] = FN(call)(a[l]); memcpy(&x, a, sizeof a); return x; }
#define LANEWISE2(name, call) INLINE F name(F x, F y) { \
  real a[W], b[W]; memcpy(a, &x, sizeof a); memcpy(b, &y, sizeof b); \
  for (int l = 0; l < W; l++) a[l] = FN(call)(a[l], b[l]); memcpy(&x, a, sizeof a); return x; }

/* The same, for those runs alone for which `which` holds, else y: what few runs need, in a function of its own. */
#define LANEWISE_WHERE(name, call) static __attribute__((noinline, cold, const)) F name(I which, F x, F y) { \
  for (int l = 0; l < W; l++) if (which[l]) y[l] = FN(call)(x[l]); return y; }
