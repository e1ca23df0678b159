/* The closed loop of ${title}
   Written by iblf_jax ${version}; what it offers stands in ${name}.h. */
${prelude}void ${name}_start(const ${name}_parameters *p, const real *settings, ${name}_state *s) {
  s->index = 0;
  ${name}_begin(p, settings, s->memory);
}

void ${name}_step(const ${name}_parameters *p, const real *settings, ${name}_state *s, real *told) {
  real result[${upper}_MEMORY + ${upper}_TOLD];
  ${name}_advance(p, s->memory, settings, (I)s->index, result);
  memcpy(s->memory, result, sizeof s->memory);
  memcpy(told, result + ${upper}_MEMORY, ${upper}_TOLD * sizeof *told);
  s->index += 1;
}
