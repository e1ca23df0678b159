/* Launches the kernels of kernels.h from within XLA.  The generated part gives SHARED_LEAVES ... COLUMNS (sizes), DOUBLE, and `image`, the
   kernels' machine code.

   CUDA's driver is the one that runs in this process already; it is found by name, so that this file builds without CUDA.  The image is
   loaded once a process as a library of the driver, which serves every device and lives as long as the process; a launch takes device
   and context from the stream. */
#include <dlfcn.h>
#include <pthread.h>
#include <stdio.h>

#ifndef DRIVER
#define DRIVER "libcuda.so.1"
#endif

typedef int (*load_type)(void **library, const void *image, void *, void *, unsigned, void *, void *, unsigned);
typedef int (*find_type)(void **kernel, void *library, const char *name);
typedef int (*launch_type)(void *kernel, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned shared_bytes, void *stream,
                           void **arguments, void **extra);
typedef int (*describe_type)(int code, const char **text);

static pthread_once_t once = PTHREAD_ONCE_INIT;
static launch_type cu_launch;
static describe_type cu_describe;
static void *constants_kernel, *signals_kernel, *advance_kernel;
static char trouble[512];

static int succeeded(const char *what, int code, char *text, size_t size) {
  const char *reason = NULL;
  if (code == 0) return 1;
  if (!cu_describe || cu_describe(code, &reason) || !reason) reason = "unknown error";
  snprintf(text, size, "iblf_jax kernel: %s: %s (CUDA error %d); backend=\"vmap\" does without it", what, reason, code);
  return 0;
}

static void *entry(void *driver, const char *name) {
  void *found = dlsym(driver, name);
  if (!found && !trouble[0]) snprintf(trouble, sizeof trouble, "iblf_jax kernel: the CUDA driver has no %s: CUDA 12 is needed", name);
  return found;
}

/* Leaves a message in `trouble` if it fails. */
static void prepare(void) {
  void *driver = dlopen(DRIVER, RTLD_NOW | RTLD_LOCAL), *library = NULL;
  if (!driver) {
    snprintf(trouble, sizeof trouble, "iblf_jax kernel: the CUDA driver does not load: %s", dlerror());
    return;
  }
  load_type cu_load = (load_type)entry(driver, "cuLibraryLoadData");
  find_type cu_find = (find_type)entry(driver, "cuLibraryGetKernel");
  cu_describe = (describe_type)entry(driver, "cuGetErrorString");
  cu_launch = (launch_type)entry(driver, "cuLaunchKernel");
  if (trouble[0]) return;
  if (!succeeded("loading", cu_load(&library, image, NULL, NULL, 0, NULL, NULL, 0), trouble, sizeof trouble)) return;
  const char *names[] = {"iblf_jax_constants", "iblf_jax_signals", "iblf_jax_advance"};
  void **kernels[] = {&constants_kernel, &signals_kernel, &advance_kernel};
  for (int i = 0; i < 3; i++)
    if (!succeeded(names[i], cu_find(kernels[i], library, names[i]), trouble, sizeof trouble)) return;
}

/* The whole number of a name, or -1. */
static int64_t attribute(const XLA_FFI_CallFrame *frame, const char *name) {
  for (int64_t i = 0; i < frame->attrs.size; i++) {
    const XLA_FFI_ByteSpan *found = frame->attrs.names[i];
    const XLA_FFI_Scalar *scalar = (const XLA_FFI_Scalar *)frame->attrs.attrs[i];
    if (found->len == strlen(name) && !memcmp(found->ptr, name, found->len) && frame->attrs.types[i] == XLA_FFI_AttrType_SCALAR &&
        scalar->dtype == XLA_FFI_DataType_S64)
      return *(const int64_t *)scalar->value;
  }
  return -1;
}

static int launched(void *kernel, int64_t count, int64_t threads, void *stream, void **arguments, char *text, size_t size) {
  int64_t blocks = (count + threads - 1) / threads;
  if (blocks > INT32_MAX) {
    snprintf(text, size, "iblf_jax kernel: too many runs for one launch");
    return 0;
  }
  return succeeded("launch", cu_launch(kernel, (unsigned)blocks, 1, 1, (unsigned)threads, 1, 1, 0, stream, arguments, NULL), text, size);
}

/* Operands: shared (1, SHARED_LEAVES), leaves (LEAVES, runs), floats (FLOATS, runs), ints (INTS, runs).  Results: floats, ints, room for
   constants (1, CONSTANTS) and for the signals of a stretch of steps (stretch, COLUMNS), both of word, and the recorded arrays (rows or
   more, numbers * runs).
   Attributes: steps, every (0: no records), threads (in a block). */
extern "C" __attribute__((visibility("default"))) XLA_FFI_Error *iblf_jax_kernel(XLA_FFI_CallFrame *frame) {
  if (is_question(frame)) return NULL;
  if (frame->args.size != 4 || frame->rets.size != 4 + RECORDED) return failure(frame, "iblf_jax kernel: wrong number of operands");
  XLA_FFI_Buffer **in = (XLA_FFI_Buffer **)frame->args.args, **out = (XLA_FFI_Buffer **)frame->rets.rets;
  if (in[2]->rank != 2 || out[3]->rank != 2) return failure(frame, "iblf_jax kernel: wrong rank");
  int64_t runs = in[2]->dims[1], stretch = out[3]->dims[0];
  int64_t steps = attribute(frame, "steps"), every = attribute(frame, "every"), threads = attribute(frame, "threads");
  if (steps < 0 || every < 0 || threads < 1 || threads > 1024) return failure(frame, "iblf_jax kernel: wrong attributes");
  int64_t rows = every > 0 ? (steps + every - 1) / every : 0;
  if (!has_shape(in[0], 1, SHARED_LEAVES) || !has_shape(in[1], LEAVES, runs) || !has_shape(in[2], FLOATS, runs) ||
      !has_shape(in[3], INTS, runs) || !has_shape(out[0], FLOATS, runs) || !has_shape(out[1], INTS, runs) ||
      !has_shape(out[2], 1, CONSTANTS) || !has_shape(out[3], stretch, COLUMNS) || stretch < 1 || !has_records(out + 4, rows, runs))
    return failure(frame, "iblf_jax kernel: wrong shapes");
  if (runs == 0) return NULL;

  pthread_once(&once, prepare);
  if (trouble[0]) return failure(frame, trouble);
  XLA_FFI_Stream_Get_Args asked;
  memset(&asked, 0, sizeof asked);
  asked.struct_size = XLA_FFI_Stream_Get_Args_STRUCT_SIZE;
  asked.ctx = frame->ctx;
  XLA_FFI_Error *error = frame->api->XLA_FFI_Stream_Get(&asked);
  if (error) return error;

  char text[512];
  void *stream = asked.stream, *shared = in[0]->data, *leaves = in[1]->data, *constants = out[2]->data;
  void *table = out[3]->data, *floats_in = in[2]->data, *ints_in = in[3]->data, *floats = out[0]->data, *ints = out[1]->data;
  struct { void *at[RECORDED + 1]; } records;
  for (int i = 0; i < RECORDED; i++) records.at[i] = out[4 + i]->data;
  void *for_constants[] = {&shared, &constants};
  if (!launched(constants_kernel, 1, 1, stream, for_constants, text, sizeof text)) return failure(frame, text);
  int64_t first = 0;
  do {
    int64_t count = steps - first < stretch ? steps - first : stretch;
    void *for_signals[] = {&constants, &first, &count, &table};
    void *for_advance[] = {&constants, &table, &leaves, &floats_in, &ints_in, &floats, &ints, &records, &runs, &first, &count, &every};
    if (count > 0 && !launched(signals_kernel, count, 64, stream, for_signals, text, sizeof text)) return failure(frame, text);
    if (!launched(advance_kernel, runs, threads, stream, for_advance, text, sizeof text)) return failure(frame, text);
    floats_in = floats;
    ints_in = ints;
    first += count;
  } while (first < steps);
  return NULL;
}
