/* A CUDA driver of which the kernels above are the only ones; what a GPU would refuse is refused with an error code. */
#include <string.h>

#define EXPORTED extern "C" __attribute__((visibility("default")))
enum { FINE = 0, INVALID_VALUE = 1, INVALID_IMAGE = 200, NOT_FOUND = 500 };
#define STREAM ((void *)0x5eed)

static int loads;
static int64_t launches;

EXPORTED int times_loaded(void) { return loads; }
EXPORTED int64_t times_launched(void) { return launches; }

EXPORTED int cuLibraryLoadData(void **library, const void *image, void *, void *, unsigned options, void *, void *, unsigned more) {
  if (memcmp(image, "image of a kernel", 17) || options || more) return INVALID_IMAGE;
  loads++;
  *library = &loads;
  return FINE;
}

EXPORTED int cuLibraryGetKernel(void **kernel, void *library, const char *name) {
  static char names[][24] = {"iblf_jax_constants", "iblf_jax_signals", "iblf_jax_advance"};
  if (library != &loads) return INVALID_VALUE;
  for (auto &known : names)
    if (!strcmp(known, name)) { *kernel = known; return FINE; }
  return NOT_FOUND;
}

EXPORTED int cuGetErrorString(int code, const char **text) {
  *text = code == INVALID_IMAGE ? "device kernel image is invalid" : code == NOT_FOUND ? "named symbol not found" : "invalid argument";
  return FINE;
}

template <typename T> static T at(void **arguments, int i) { return *(T *)arguments[i]; }

EXPORTED int cuLaunchKernel(void *kernel, unsigned blocks, unsigned by, unsigned bz, unsigned threads, unsigned ty, unsigned tz,
                            unsigned shared_bytes, void *stream, void **a, void **extra) {
  const char *name = (const char *)kernel;
  if (!blocks || !threads || by != 1 || bz != 1 || ty != 1 || tz != 1 || shared_bytes || extra || stream != STREAM) return INVALID_VALUE;
  if (threads > MOST_THREADS) return INVALID_VALUE;
  launches++;
  blockDim.x = threads;
  for (blockIdx.x = 0; blockIdx.x < blocks; blockIdx.x++)
    for (threadIdx.x = 0; threadIdx.x < threads; threadIdx.x++) {
      if (!strcmp(name, "iblf_jax_constants")) iblf_jax_constants(at<const real *>(a, 0), at<word *>(a, 1));
      else if (!strcmp(name, "iblf_jax_signals"))
        iblf_jax_signals(at<const word *>(a, 0), at<int64_t>(a, 1), at<int64_t>(a, 2), at<word *>(a, 3));
      else
        iblf_jax_advance(at<const word *>(a, 0), at<const word *>(a, 1), at<const real *>(a, 2), at<const real *>(a, 3),
                         at<const int32_t *>(a, 4), at<real *>(a, 5), at<int32_t *>(a, 6), at<record_arrays>(a, 7), at<int64_t>(a, 8),
                         at<int64_t>(a, 9), at<int64_t>(a, 10), at<int64_t>(a, 11));
    }
  return FINE;
}
