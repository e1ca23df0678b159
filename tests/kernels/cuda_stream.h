/* XLA on a CPU has no streams: the launcher, called with an interface that has one. */
static XLA_FFI_Error *a_stream(XLA_FFI_Stream_Get_Args *args) {
  args->stream = (void *)0x5eed;
  return NULL;
}

extern "C" __attribute__((visibility("default"))) XLA_FFI_Error *on_cpu(XLA_FFI_CallFrame *frame) {
  if (frame->extension_start && frame->extension_start->type == XLA_FFI_Extension_Metadata) return iblf_jax_kernel(frame);
  XLA_FFI_Api api = *frame->api;
  XLA_FFI_CallFrame with_stream = *frame;
  api.XLA_FFI_Stream_Get = a_stream;
  with_stream.api = &api;
  return iblf_jax_kernel(&with_stream);
}
