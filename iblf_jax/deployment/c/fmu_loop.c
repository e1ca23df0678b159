#define STEP ${step}
#define STEP_TEXT "${step}"
static const double settings[] = {${setting_values}};

/* The outputs at the present time, from a step of a copy of the state. */
static void write_outputs(fmu *f) {
  ${name}_state next = f->s;
  ${name}_step(&f->p, settings, &next, f->outputs);
}

static int begin(fmu *f) {
  ${name}_start(&f->p, settings, &f->s);
  write_outputs(f);
  return OK;
}

static int advance(fmu *f) {
  double outputs[OUTPUTS];
  ${name}_step(&f->p, settings, &f->s, outputs);
  return outputs[0] - outputs[0] < 1.0 ? OK : ERROR;
}
