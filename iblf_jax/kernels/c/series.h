/* Where a step reads numbers from: a table with one row for each step, each (SERIES, runs).  The first step reads the last row. */

static inline int64_t at_most(int64_t a, int64_t b) { return a < b ? a : b; }

static F gather_f(const real *row, int64_t run, int64_t runs) {
  F x;
  if (run + W <= runs) return load(row + run);
  for (int l = 0; l < W; l++) x[l] = row[at_most(run + l, runs - 1)];
  return x;
}

/* The row of one step, for W runs. */
SEPARATE void read_series(const real *row, F *series, int64_t runs, int64_t run) {
  for (int i = 0; i < SERIES; i++) series[i] = gather_f(row + i * runs, run, runs);
}
