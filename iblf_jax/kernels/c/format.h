/* Elementary functions, on vectors of runs or (scalar.h) one run.  tests/test_lowering_math.py holds their errors to: sin, cos 2.1 ulp, for every
   finite x; exp, expm1, log, log1p, atan 3.6 ulp; tanh, tan, logistic 5.6 ulp.  Sources: W. J. Cody, W. Waite, Software Manual for the
   Elementary Functions, 1980 (range reduction); S. Moshier, Cephes (coefficients of sin, cos, atan). */

#if DOUBLE
#define MANTISSA 52
#define EXPONENT_BIAS 1023
#define SIGN_BIT ((integer)1 << 63)
#define SMALLEST_NORMAL 0x1p-1022
#define SCALE_UP 0x1p54
#define SCALE_UP_BITS 54
#else
#define MANTISSA 23
#define EXPONENT_BIAS 127
#define SIGN_BIT ((integer)1 << 31)
#define SMALLEST_NORMAL 0x1p-126f
#define SCALE_UP 0x1p25f
#define SCALE_UP_BITS 25
#endif
