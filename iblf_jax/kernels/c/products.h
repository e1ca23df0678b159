/* Products of matrices (..., m, n) and (..., n, p), summed in the order of the terms.  Callers fill up a batch with copies: an entry of the
   first axis with the factors of the entry before it has the same product. */

template <typename T> static void multiply(const T *left, const T *__restrict__ right, T *__restrict__ product, const int64_t *sizes) {
  const int64_t m = sizes[0], n = sizes[1], p = sizes[2];
  for (int64_t i = 0; i < m; i++, left += n, product += p) {
    for (int64_t j = 0; j < p; j++) product[j] = left[0] * right[j];
    for (int64_t k = 1; k < n; k++) {
      const T factor = left[k], *row = right + k * p;
      for (int64_t j = 0; j < p; j++) product[j] += factor * row[j];
    }
  }
}

template <typename T> static void multiply_all(const void *left, const void *right, void *product, const int64_t *sizes, int64_t entries, int64_t each) {
  const int64_t of_left = sizes[0] * sizes[1], of_right = sizes[1] * sizes[2], of_product = sizes[0] * sizes[2];
  const T *a = (const T *)left, *b = (const T *)right;
  T *c = (T *)product;
  for (int64_t entry = 0; entry < entries; entry++, a += each * of_left, b += each * of_right, c += each * of_product) {
    if (entry && !memcmp(a, a - each * of_left, each * of_left * sizeof(T)) && !memcmp(b, b - each * of_right, each * of_right * sizeof(T)))
      memcpy(c, c - each * of_product, each * of_product * sizeof(T));
    else
      for (int64_t i = 0; i < each; i++) multiply(a + i * of_left, b + i * of_right, c + i * of_product, sizes);
  }
}

extern "C" __attribute__((visibility("default"))) XLA_FFI_Error *iblf_jax_multiply(XLA_FFI_CallFrame *frame) {
  if (is_question(frame)) return NULL;
  if (frame->args.size != 2 || frame->rets.size != 1) return failure(frame, "iblf_jax products: wrong number of operands");
  const XLA_FFI_Buffer *a = (XLA_FFI_Buffer *)frame->args.args[0], *b = (XLA_FFI_Buffer *)frame->args.args[1], *c = (XLA_FFI_Buffer *)frame->rets.rets[0];
  const int64_t axes = a->rank - 2;
  if (axes < 0 || b->rank != a->rank || c->rank != a->rank || b->dtype != a->dtype || c->dtype != a->dtype)
    return failure(frame, "iblf_jax products: wrong types");
  int64_t entries = 1, each = 1;
  for (int64_t i = 0; i < axes; i++) {
    if (b->dims[i] != a->dims[i] || c->dims[i] != a->dims[i]) return failure(frame, "iblf_jax products: wrong batches");
    *(i ? &each : &entries) *= a->dims[i];
  }
  const int64_t *x = a->dims + axes, *y = b->dims + axes, *z = c->dims + axes;
  if (x[1] < 1 || y[0] != x[1] || z[0] != x[0] || z[1] != y[1]) return failure(frame, "iblf_jax products: wrong shapes");
  const int64_t sizes[] = {x[0], x[1], y[1]};
  if (a->dtype == XLA_FFI_DataType_F64) multiply_all<double>(a->data, b->data, c->data, sizes, entries, each);
  else if (a->dtype == XLA_FFI_DataType_F32) multiply_all<float>(a->data, b->data, c->data, sizes, entries, each);
  else return failure(frame, "iblf_jax products: wrong type");
  return NULL;
}
