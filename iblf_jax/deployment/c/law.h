/* ${title}
   Written by iblf_jax ${version}.  C99, nothing but libm, no allocation, no global state.

     ${name}_parameters p = ${name}_defaults;      gains and model, the numbers of the scenario
     ${name}_state s;
     ${name}_init(&p, &s, q, ${dq_argument}${reference_arguments});    once, at t = 0
     status = ${name}_step(&p, &s, t, q, ${dq_argument}${reference_arguments}, tau);    once a period of p.${period} s

   SI units, radians.  t is the time since init: bounds and reference begin there.
   A sample: ${operations}. */
#ifndef ${guard}
#define ${guard}

#ifdef __cplusplus
extern "C" {
#endif

#define ${upper}_JOINTS ${joints}

typedef ${type} ${name}_real;

/* What can be set between two steps; what the law does not read is not there. */
typedef struct {
${parameters}
} ${name}_parameters;

extern const ${name}_parameters ${name}_defaults;

typedef struct {
  /* What goes from sample to sample:
${memory}  */
  ${name}_real memory[${memory_size}];
  /* What was said last: torque [N m], virtual velocity [rad/s], estimate of the uncertain term [N m]. */
  ${name}_real tau[${joints}], alpha[${joints}], f_hat[${joints}];
} ${name}_state;

/* Bits of a status; 0 if none. */
enum {
  ${upper}_NOT_FINITE = 1,   /* an input or a result was no number: tau is the last good one, and the state is as it was */
  ${upper}_OUTSIDE = 2,      /* a joint is on its bound or outside */
  ${upper}_GUARDED = 4,      /* the guard held the barrier's slope */
  ${upper}_SATURATED = 8,    /* the law cut its torque to a limit */
  ${upper}_INFEASIBLE = 16   /* a safety filter's conditions had no common torque */
};

/* The state before the first sample, and in it the torque that holds the model still.${dq_note}
   Returns ${upper}_NOT_FINITE, the torque being 0, where an input or a result is no number. */
int ${name}_init(const ${name}_parameters *p, ${name}_state *s, const ${name}_real *q, const ${name}_real *dq${reference_declarations});

/* A sample: writes the torque tau [N m], and returns its status.  q and dq are what is measured at t. */
int ${name}_step(const ${name}_parameters *p, ${name}_state *s, ${name}_real t, const ${name}_real *q, const ${name}_real *dq${reference_declarations},
    ${name}_real *tau);

#ifdef __cplusplus
}
#endif
#endif
