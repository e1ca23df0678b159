#define STEP ${step}
#define STEP_TEXT "${step}"
static const double settings[] = {${setting_values}};

/* The outputs are those of the time that has been reached. */
static void told(fmu *f) {
  ${name}_state next = f->s;
  ${name}_step(&f->p, settings, &next, f->outputs);
}

static int begin(fmu *f) {
  ${name}_start(&f->p, settings, &f->s);
  told(f);
  return OK;
}

static int advance(fmu *f) {
  double passed[OUTPUTS];
  ${name}_step(&f->p, settings, &f->s, passed);
  return passed[0] - passed[0] < 1.0 ? OK : ERROR;
}
