/* What a page calls of the module: the tables are in its memory, runs are made in stretches. */
#include "${name}.h"

#include <string.h>

#define EXPORT(name) __attribute__((export_name(#name)))
enum { ROWS = ${rows} };

static ${name}_parameters parameters;
static ${name}_real settings[${upper}_SETTINGS], records[ROWS * ${upper}_TOLD];
static ${name}_state state;

EXPORT(parameters) ${name}_real *module_parameters(void) { return (${name}_real *)&parameters; }
EXPORT(settings) ${name}_real *module_settings(void) { return settings; }
EXPORT(records) ${name}_real *module_records(void) { return records; }
EXPORT(rows) int module_rows(void) { return ROWS; }

/* The parameters as they were written. */
EXPORT(defaults) void module_defaults(void) { parameters = ${name}_defaults; }

/* The state at t = 0, by the parameters as they are now. */
EXPORT(start) void module_start(void) { ${name}_start(&parameters, settings, &state); }

/* Makes so many steps; writes those whose number since the start is a multiple of `every` into the records, and returns how many. */
EXPORT(run) int module_run(int steps, int every) {
  int k, row = 0;
  ${name}_real told[${upper}_TOLD];
  for (k = 0; k < steps && row < ROWS; k++) {
    const int is_due = every > 0 && state.index % every == 0;
    ${name}_step(&parameters, settings, &state, told);
    if (is_due) memcpy(records + row++ * ${upper}_TOLD, told, sizeof told);
  }
  return row;
}
