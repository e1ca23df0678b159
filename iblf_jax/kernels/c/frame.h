/* What a kernel says to XLA and hears from it: errors, shapes, the version of the interface.  The generated part gives
   RECORDED and RECORDED_SIZES: how many arrays are recorded, and how many numbers each has. */
#include <stdint.h>
#include <string.h>

#include "xla/ffi/api/c_api.h"

static XLA_FFI_Error *failure(XLA_FFI_CallFrame *frame, const char *text) {
  XLA_FFI_Error_Create_Args args;
  memset(&args, 0, sizeof args);
  args.struct_size = XLA_FFI_Error_Create_Args_STRUCT_SIZE;
  args.message = text;
  args.errc = XLA_FFI_Error_Code_INTERNAL;
  return frame->api->XLA_FFI_Error_Create(&args);
}

static int has_shape(const XLA_FFI_Buffer *b, int64_t rows, int64_t columns) {
  return b->rank == 2 && b->dims[0] == rows && b->dims[1] == columns;
}

/* Whether arrays are the recorded ones, with room for so many rows: (rows or more, numbers * runs) each. */
static int has_records(XLA_FFI_Buffer **arrays, int64_t rows, int64_t runs) {
  static const int64_t sizes[] = RECORDED_SIZES;
  for (int i = 0; i < RECORDED; i++)
    if (arrays[i]->rank != 2 || arrays[i]->dims[0] < rows || arrays[i]->dims[1] != sizes[i] * runs) return 0;
  return 1;
}

/* Whether XLA asks for the version of the interface only; the answer is given. */
static int is_question(XLA_FFI_CallFrame *frame) {
  if (!frame->extension_start || frame->extension_start->type != XLA_FFI_Extension_Metadata) return 0;
  XLA_FFI_Metadata *metadata = ((XLA_FFI_Metadata_Extension *)frame->extension_start)->metadata;
  metadata->api_version.major_version = XLA_FFI_API_MAJOR;
  metadata->api_version.minor_version = XLA_FFI_API_MINOR;
  return 1;
}
