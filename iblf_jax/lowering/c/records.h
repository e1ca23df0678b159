/* Where samples go.  The generated part gives RECORDED and RECORDED_SIZES: how many arrays are recorded, and how many numbers each has. */
typedef struct { real *at[RECORDED + 1]; } record_arrays;

/* One sample of W runs, array after array, into a row of the arrays, each (rows, numbers, runs), for the runs that exist.  On a CPU no part
   of the loop over steps, whose registers it would take. */
SEPARATE void write_sample(const record_arrays *records, const F *sample, int64_t row, int64_t runs, int64_t run) {
  const int sizes[] = RECORDED_SIZES;
  int live = run + W <= runs ? W : (int)(runs - run);
#pragma unroll
  for (int i = 0; i < RECORDED; i++) {
    real *place = records->at[i] + row * sizes[i] * runs + run;
#pragma unroll
    for (int k = 0; k < sizes[i]; k++) store_some(place + k * runs, *sample++, live);
  }
}
