/* Arrays with a run axis first, of any shape, into rows of runs and back: one call where XLA would compile a program an array. */

enum { TILE = 64 };

/* Copies between an array (runs, numbers) and rows (numbers, runs). */
template <typename A, typename B> static void turn(const A *from, B *to, int64_t runs, int64_t numbers, bool packing) {
  for (int64_t first = 0; first < runs; first += TILE) {
    int64_t last = first + TILE < runs ? first + TILE : runs;
    for (int64_t i = 0; i < numbers; i++)
      for (int64_t r = first; r < last; r++) {
        int64_t array = r * numbers + i, row = i * runs + r;
        if (packing) to[row] = (B)from[array];
        else to[array] = (B)from[row];
      }
  }
}

static int64_t size_of(const XLA_FFI_Buffer *b) {
  int64_t size = 1;
  for (int64_t i = 0; i < b->rank; i++) size *= b->dims[i];
  return size;
}

/* One array and the next rows of its kind; false if there are not so many. */
static bool turned(XLA_FFI_Buffer *array, XLA_FFI_Buffer **rows, int64_t *used, int64_t runs, bool packing) {
  bool is_float = array->dtype == XLA_FFI_DataType_F64 || array->dtype == XLA_FFI_DataType_F32;
  XLA_FFI_Buffer *group = rows[is_float ? 0 : 1];
  int64_t numbers = runs ? size_of(array) / runs : 0, start = used[!is_float] * runs;
  used[!is_float] += numbers;
  if (used[!is_float] > group->dims[0] || numbers * runs != size_of(array)) return false;
  void *a = array->data, *b = group->data;
#define TURN(A, B) (packing ? turn((const A *)a, (B *)b + start, runs, numbers, true) : turn((const B *)b + start, (A *)a, runs, numbers, false))
  switch (array->dtype) {
    case XLA_FFI_DataType_F64: if (group->dtype != array->dtype) return false; TURN(double, double); break;
    case XLA_FFI_DataType_F32: if (group->dtype != array->dtype) return false; TURN(float, float); break;
    case XLA_FFI_DataType_S32: TURN(int32_t, int32_t); break;
    case XLA_FFI_DataType_S8: TURN(int8_t, int32_t); break;
    case XLA_FFI_DataType_S16: TURN(int16_t, int32_t); break;
    case XLA_FFI_DataType_S64: TURN(int64_t, int32_t); break;
    case XLA_FFI_DataType_PRED: TURN(uint8_t, int32_t); break;
    default: return false;
  }
#undef TURN
  return true;
}

/* Arrays on one side; floats (numbers, runs) and ints (numbers, runs) on the other. */
static XLA_FFI_Error *all_turned(XLA_FFI_CallFrame *frame, bool packing) {
  if (is_question(frame)) return NULL;
  XLA_FFI_Buffer **in = (XLA_FFI_Buffer **)frame->args.args, **out = (XLA_FFI_Buffer **)frame->rets.rets;
  int64_t ins = frame->args.size, outs = frame->rets.size, used[2] = {0, 0};
  if ((packing ? outs : ins) != 2) return failure(frame, "iblf_jax leaves: wrong number of operands");
  XLA_FFI_Buffer **rows = packing ? out : in, **arrays = packing ? in : out;
  if (rows[0]->rank != 2 || rows[1]->rank != 2 || rows[1]->dtype != XLA_FFI_DataType_S32 || rows[1]->dims[1] != rows[0]->dims[1])
    return failure(frame, "iblf_jax leaves: wrong rows");
  for (int64_t i = 0; i < (packing ? ins : outs); i++)
    if (!turned(arrays[i], rows, used, rows[0]->dims[1], packing)) return failure(frame, "iblf_jax leaves: an array does not fit its rows");
  if (used[0] != rows[0]->dims[0] || used[1] != rows[1]->dims[0]) return failure(frame, "iblf_jax leaves: rows without an array");
  return NULL;
}

extern "C" __attribute__((visibility("default"))) XLA_FFI_Error *iblf_jax_pack(XLA_FFI_CallFrame *frame) { return all_turned(frame, true); }
extern "C" __attribute__((visibility("default"))) XLA_FFI_Error *iblf_jax_unpack(XLA_FFI_CallFrame *frame) { return all_turned(frame, false); }
