/* ${title}
   Written by iblf_jax ${version}; what it offers stands in ${name}.h. */
${prelude}static int are_finite(const real *x, int count) {
  int k, yes = 1;
  for (k = 0; k < count; k++) yes = yes && FN(fabs)(x[k]) < (real)INFINITY;
  return yes;
}

int ${name}_init(const ${name}_parameters *p, ${name}_state *s, const real *q, const real *dq${reference_parameters}) {
  static const real still[${joints}] = {0};
  real result[${memory_count} + ${joints}];
  int sound;
  ${default_dq}
  memset(s, 0, sizeof *s);
  sound = are_finite(q, ${joints}) && dq != NULL && are_finite(dq, ${joints})${reference_finite};
  if (!sound) return ${upper}_NOT_FINITE;
  ${name}_start(p, still, q, dq, ${reference_values}result);
  if (!are_finite(result, ${memory_count} + ${joints})) return ${upper}_NOT_FINITE;
  ${keep_start}memcpy(s->tau, result + ${memory_count}, sizeof s->tau);
  return 0;
}

int ${name}_step(const ${name}_parameters *p, ${name}_state *s, real t, const real *q, const real *dq${reference_parameters}, real *tau) {
  enum { N = ${joints}, M = ${memory_count} };
  static const real still[N] = {0};
  real result[M + 3 * N + ${flags}];
  int k, status = 0, sound = are_finite(&t, 1) && are_finite(q, N)${reference_finite};
  ${default_dq}
  sound = sound && dq != NULL && are_finite(dq, N);
  if (sound) ${name}_sample(p, s->memory, &t, q, dq, ${reference_values}result);
  if (sound && are_finite(result, M + 3 * N)) {
    ${keep_sample}memcpy(s->tau, result + M, sizeof s->tau);
    memcpy(s->alpha, result + M + N, sizeof s->alpha);
    memcpy(s->f_hat, result + M + 2 * N, sizeof s->f_hat);
    for (k = 0; k < ${flags}; k++) status |= result[M + 3 * N + k] > (real)0 ? 2 << k : 0;
  } else {
    status = ${upper}_NOT_FINITE;
  }
  memcpy(tau, s->tau, sizeof s->tau);
  return status;
}
