/* Where samples go.  The generated part gives RECORDED and RECORDED_SIZES: how many arrays are recorded, and how many numbers each has. */

/* Before a loop: every round of it is written out.  Clang refuses two such words before one loop. */
#if defined(__clang__) || defined(__CUDACC_RTC__)
#define UNROLLED _Pragma("unroll")
#else
#define UNROLLED _Pragma("GCC unroll 1000")
#endif

typedef struct { real *at[RECORDED + 1]; } record_arrays;

/* One sample of the `live` first of W runs, array after array, into a row of the arrays, each (rows, numbers, runs). */
template <typename count> INLINE void write_some(const record_arrays *records, const F *sample, int64_t row, int64_t runs, int64_t run, count live) {
  const int sizes[] = RECORDED_SIZES;
  int n = 0;
  UNROLLED for (int i = 0; i < RECORDED; i++) {
    real *place = records->at[i] + row * sizes[i] * runs + run;
    UNROLLED for (int k = 0; k < sizes[i]; k++) store_some(place + k * runs, sample[n++], live);
  }
}

/* The same for the runs that exist.  On a CPU no part of the loop over steps, whose registers it would take. */
SEPARATE void write_sample(const record_arrays *records, const F *sample, int64_t row, int64_t runs, int64_t run) {
  int64_t live = runs - run;
  if (live >= W) write_some(records, sample, row, runs, run, all_runs());
  else if (live == 1) write_some(records, sample, row, runs, run, one_run());
  else write_some(records, sample, row, runs, run, (int)live);
}
