/* Runs all blocks of W runs through all steps, on several threads.  The generated part gives CONSTANTS, LEAVES, FLOATS, INTS, COLUMNS,
   SERIES (sizes), record_arrays, shared_constants, shared_signals (a table of what only time decides) and advance (W runs over some steps).

   A group of blocks goes through all steps before the next one, a stretch of steps at a time: its states and the stretch's table stay
   in the cache; the caller says how many (STRETCH, GROUP).  A block that has fewer than W runs repeats its last one; the copies are not written back.

   Callers fill up a batch with copies of its last run, so that they compile one shape, or of its last two, if two are those of one case.  The
   blocks at the end that hold only copies are not computed, if nothing is recorded. */

typedef struct {
  const real *shared, *leaves, *floats_in, *series;
  const int32_t *ints_in;
  real *floats_out;
  record_arrays records;
  int32_t *ints_out;
  int64_t runs, blocks, groups, group_blocks, first, steps, every;
  int64_t next;
  int failed;
} job;

typedef struct {
  word constants[CONSTANTS + 1];
  word table[STRETCH * (COLUMNS + 1) + W];
  F leaves[GROUP][LEAVES + 1];
  F floats[GROUP][FLOATS + 1];
  I ints[GROUP][INTS + 1];
} workspace;

static void read_block(const job *j, workspace *w, int g, int64_t run) {
  for (int i = 0; i < LEAVES; i++) w->leaves[g][i] = gather_f(j->leaves + i * j->runs, run, j->runs);
  for (int i = 0; i < FLOATS; i++) w->floats[g][i] = gather_f(j->floats_in + i * j->runs, run, j->runs);
  for (int i = 0; i < INTS; i++)
    for (int l = 0; l < W; l++) w->ints[g][i][l] = j->ints_in[i * j->runs + at_most(run + l, j->runs - 1)];
}

static void write_block(const job *j, workspace *w, int g, int64_t run) {
  int64_t count = at_most(W, j->runs - run);
  for (int i = 0; i < FLOATS; i++) memcpy(j->floats_out + i * j->runs + run, &w->floats[g][i], count * sizeof(real));
  for (int i = 0; i < INTS; i++)
    for (int l = 0; l < count; l++) j->ints_out[i * j->runs + run + l] = (int32_t)w->ints[g][i][l];
}

/* How many runs there are without those at the end that are copies of the run `period` before them: the index after the last run of which
   a number differs, at least `least`. */
static int64_t runs_without_copies(const void *numbers, int64_t rows, int64_t runs, int64_t size, int64_t period, int64_t least) {
  for (int64_t i = 0; i < rows; i++) {
    const char *row = (const char *)numbers + i * runs * size;
    int64_t run = runs;
    while (run > least && !memcmp(row + (run - 1) * size, row + (run - 1 - period) * size, size)) run--;
    least = run;
  }
  return least;
}

static int64_t different_runs(const job *j, int64_t period) {
  int64_t found = at_most(period, j->runs);
  found = runs_without_copies(j->leaves, LEAVES, j->runs, sizeof(real), period, found);
  found = runs_without_copies(j->floats_in, FLOATS, j->runs, sizeof(real), period, found);
  return runs_without_copies(j->ints_in, INTS, j->runs, sizeof(int32_t), period, found);
}

/* Gives the runs from `first` on the results of those `period` before them. */
static void copy_results(const job *j, int64_t first, int64_t period) {
  for (int64_t i = 0; i < FLOATS; i++)
    for (int64_t run = first; run < j->runs; run++) j->floats_out[i * j->runs + run] = j->floats_out[i * j->runs + run - period];
  for (int64_t i = 0; i < INTS; i++)
    for (int64_t run = first; run < j->runs; run++) j->ints_out[i * j->runs + run] = j->ints_out[i * j->runs + run - period];
}

static void run_group(const job *j, workspace *w, int64_t group) {
  int64_t first_block = group * j->group_blocks;
  int blocks = (int)at_most(j->group_blocks, j->blocks - first_block);
  for (int g = 0; g < blocks; g++) read_block(j, w, g, (first_block + g) * W);
  for (int64_t done = 0; done < j->steps; done += STRETCH) {
    int count = (int)at_most(STRETCH, j->steps - done);
    for (int s = 0; s < count; s += W) shared_signals(w->constants, (integer)(j->first + done + s), w->table + s * COLUMNS);
    for (int g = 0; g < blocks; g++) {
      int64_t run = (first_block + g) * W;
      advance(w->constants, w->leaves[g], w->floats[g], w->ints[g], w->table, count, j->first + done, j->every, j->records,
              j->series + (j->steps - 1 - done) * SERIES * j->runs, j->runs, run);
    }
  }
  for (int g = 0; g < blocks; g++) write_block(j, w, g, (first_block + g) * W);
}

static void *worker(void *argument) {
  job *j = (job *)argument;
  void *space = NULL;
  if (posix_memalign(&space, 64, sizeof(workspace))) { __atomic_store_n(&j->failed, 1, __ATOMIC_RELAXED); return NULL; }
  workspace *w = (workspace *)space;
  memset(w, 0, sizeof *w);
  shared_constants(j->shared, w->constants);
  for (;;) {
    int64_t group = __atomic_fetch_add(&j->next, 1, __ATOMIC_RELAXED);
    if (group >= j->groups) break;
    run_group(j, w, group);
  }
  free(space);
  return NULL;
}

static void run_all(job *j, int64_t threads) {
  pthread_t started[256];
  int64_t count = 0;
  if (j->runs <= 0) return;
  int64_t different = j->runs, period = 1;
  if (j->every <= 0 && SERIES == 0) {
    int64_t of_pairs = different_runs(j, 2);
    different = different_runs(j, 1);
    if (of_pairs < different) different = of_pairs, period = 2;
  }
  j->blocks = (different + W - 1) / W;
  if (threads > 256) threads = 256;
  if (threads < 1) threads = 1;
  j->group_blocks = at_most(GROUP, (j->blocks + threads - 1) / threads);
  j->groups = (j->blocks + j->group_blocks - 1) / j->group_blocks;
  for (; count < at_most(threads, j->groups) - 1; count++)
    if (pthread_create(&started[count], NULL, worker, j)) break;
  worker(j);
  for (int64_t i = 0; i < count; i++) pthread_join(started[i], NULL);
  copy_results(j, j->blocks * W, period);
}

/* Operands: shared (1, n), leaves (LEAVES, runs), floats (FLOATS, runs), ints (INTS, runs), settings (1, 4) = first step, steps, record
   every, threads; if a step reads a series, its rows (steps or more, SERIES * runs).  Results: floats, ints, and the recorded arrays (rows or more, numbers * runs). */
extern "C" __attribute__((visibility("default"))) XLA_FFI_Error *iblf_jax_kernel(XLA_FFI_CallFrame *frame) {
  if (is_question(frame)) return NULL;
  if (frame->args.size != 5 + (SERIES > 0) || frame->rets.size != 2 + RECORDED) return failure(frame, "iblf_jax kernel: wrong number of operands");
  XLA_FFI_Buffer **in = (XLA_FFI_Buffer **)frame->args.args, **out = (XLA_FFI_Buffer **)frame->rets.rets;
  if (in[2]->rank != 2 || in[4]->rank != 2) return failure(frame, "iblf_jax kernel: wrong rank");
  int64_t runs = in[2]->dims[1];
  const int32_t *settings = (const int32_t *)in[4]->data;
  job j;
  memset(&j, 0, sizeof j);
  j.first = settings[0]; j.steps = settings[1]; j.every = settings[2]; j.runs = runs;
  int64_t rows = j.every > 0 ? (j.steps + j.every - 1) / j.every : 0;
  if (!has_shape(in[0], 1, SHARED_LEAVES) || !has_shape(in[1], LEAVES, runs) || !has_shape(in[2], FLOATS, runs) ||
      !has_shape(in[3], INTS, runs) || !has_shape(in[4], 1, 4) || !has_shape(out[0], FLOATS, runs) || !has_shape(out[1], INTS, runs) ||
      !has_records(out + 2, rows, runs) ||
      (SERIES > 0 && (in[5]->rank != 2 || in[5]->dims[0] < j.steps || in[5]->dims[1] != SERIES * runs)))
    return failure(frame, "iblf_jax kernel: wrong shapes");
  static const real nothing[1] = {0};
  j.series = SERIES > 0 ? (const real *)in[SERIES > 0 ? 5 : 0]->data : nothing;
  j.shared = (const real *)in[0]->data; j.leaves = (const real *)in[1]->data; j.floats_in = (const real *)in[2]->data;
  j.ints_in = (const int32_t *)in[3]->data; j.floats_out = (real *)out[0]->data; j.ints_out = (int32_t *)out[1]->data;
  /* Samples are numbered from step 0 on; the arrays begin at the one of the first step. */
  const int64_t sizes[] = RECORDED_SIZES, skipped = j.every > 0 ? j.first / j.every : 0;
  for (int i = 0; i < RECORDED; i++) j.records.at[i] = (real *)out[2 + i]->data - skipped * sizes[i] * runs;
  run_all(&j, settings[3]);
  return j.failed ? failure(frame, "iblf_jax kernel: out of memory") : NULL;
}
