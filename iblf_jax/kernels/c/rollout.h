/* Angles beyond SINCOS_LIMIT on a GPU.  A branch for them in every step would cut the step into pieces that are scheduled apart.  A first attempt
   (`careful` is false) therefore only notes whether there was such an angle; if so, the thread makes the steps of the launch once more, carefully. */
template <bool careful> struct angles {
  I far = 0;
  __device__ __forceinline__ int need_care(I which) {
    if (careful) return any_run(which);
    far |= which;
    return 0;
  }
};
#undef RARELY
#undef FUNCTION
#undef SEPARATE
#define RARELY(which) this->need_care(which)
#define FUNCTION __device__ __forceinline__
#define SEPARATE FUNCTION
