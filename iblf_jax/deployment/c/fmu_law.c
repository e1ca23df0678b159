#define STEP ${step}
#define STEP_TEXT "${step}"

static void write_outputs(fmu *f) {
  memcpy(f->outputs, f->s.tau, sizeof f->s.tau);
  memcpy(f->outputs + ${joints}, f->s.alpha, sizeof f->s.alpha);
  memcpy(f->outputs + 2 * ${joints}, f->s.f_hat, sizeof f->s.f_hat);
}

static int begin(fmu *f) {
  const double *q = f->inputs;
  if (${name}_init(&f->p, &f->s, q, q + ${joints}${further}) != 0) return failed(f, "an input is not finite");
  write_outputs(f);
  return OK;
}

/* One sample: the torque of the period that begins now.  Non-finite input returns the last valid torque and a warning. */
static int advance(fmu *f) {
  const double *q = f->inputs;
  double tau[${joints}];
  const int status = ${name}_step(&f->p, &f->s, STEP * (double)f->index, q, ${sampled}, tau);
  f->index += 1;
  f->outputs[OUTPUTS - 1] = (double)status;
  if ((status & ${upper}_NOT_FINITE) == 0) return OK;
  if (f->log) f->log(f->environment, WARNING, "logStatusWarning", "an input or a result is not finite: the torque is the last valid one");
  return WARNING;
}
