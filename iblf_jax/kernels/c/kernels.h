/* The kernels of a rollout.  The generated part gives CONSTANTS, LEAVES, FLOATS, INTS, COLUMNS (sizes), CALLS, record_arrays, and the functions of
   `rollout`: shared_constants, shared_signals (a row of what only time decides) and advance (one run over some steps).

   A thread takes one run through a stretch of steps with all its numbers in registers.  Arrays hold one row a number and the run fastest,
   so that neighbouring threads read neighbouring words; of the table of signals all threads read the same word. */
#define MOST_THREADS 128

/* CONSTANTS words, by one thread. */
extern "C" __global__ void iblf_jax_constants(const real *shared, word *constants) {
  if (blockIdx.x == 0 && threadIdx.x == 0) rollout<true>().shared_constants(shared, constants);
}

/* `count` rows of COLUMNS words, for the steps from `first` on, one thread a row. */
extern "C" __global__ void iblf_jax_signals(const word *constants, int64_t first, int64_t count, word *table) {
  int64_t row = (int64_t)blockIdx.x * blockDim.x + threadIdx.x;
  if (row < count) rollout<true>().shared_signals(constants, (integer)(first + row), table + row * COLUMNS);
}

INLINE void load_state(const real *floats_in, const int32_t *ints_in, F *floats, I *ints, int64_t runs, int64_t run) {
#pragma unroll
  for (int i = 0; i < FLOATS; i++) floats[i] = floats_in[i * runs + run];
#pragma unroll
  for (int i = 0; i < INTS; i++) ints[i] = ints_in[i * runs + run];
}

/* `runs` runs over `count` steps; floats_in may be floats_out, ints_in may be ints_out.  The 1 asks for all registers that a thread can have:
   without it ptxas gives a step that needs more than those 32, and keeps the rest in memory. */
extern "C" __global__ void __launch_bounds__(MOST_THREADS, 1)
iblf_jax_advance(const word *__restrict__ constants, const word *__restrict__ table, const real *__restrict__ leaves_in,
                 const real *floats_in, const int32_t *ints_in, real *floats_out, int32_t *ints_out, record_arrays records, int64_t runs,
                 int64_t first, int64_t count, int64_t every) {
  int64_t run = (int64_t)blockIdx.x * blockDim.x + threadIdx.x;
  F leaves[LEAVES + 1], floats[FLOATS + 1];
  I ints[INTS + 1];
  if (run >= runs) return;
#pragma unroll
  for (int i = 0; i < LEAVES; i++) leaves[i] = leaves_in[i * runs + run];
  I is_far = CALLS;
  if constexpr (!CALLS) {
    rollout<false> attempt;
    load_state(floats_in, ints_in, floats, ints, runs, run);
    attempt.advance(constants, leaves, floats, ints, table, (int)count, first, every, records, 0, runs, run);
    is_far = attempt.far;
  }
  if (is_far) {
    load_state(floats_in, ints_in, floats, ints, runs, run);
    rollout<true>().advance(constants, leaves, floats, ints, table, (int)count, first, every, records, 0, runs, run);
  }
#pragma unroll
  for (int i = 0; i < FLOATS; i++) floats_out[i * runs + run] = floats[i];
#pragma unroll
  for (int i = 0; i < INTS; i++) ints_out[i * runs + run] = ints[i];
}
