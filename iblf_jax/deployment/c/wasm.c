/* The functions that a page calls: buffers are in the module's memory, and a run may be divided into several calls. */
#include "${name}.h"

#include <string.h>

#define EXPORT(name) __attribute__((export_name(#name)))
enum { ROWS = ${buffer_rows} };

static ${name}_parameters parameters;
static ${name}_real settings[${upper}_SETTINGS], records[ROWS * ${upper}_TOLD];
static ${name}_state state;

EXPORT(parameters) ${name}_real *module_parameters(void) { return (${name}_real *)&parameters; }
EXPORT(settings) ${name}_real *module_settings(void) { return settings; }
EXPORT(records) ${name}_real *module_records(void) { return records; }
EXPORT(rows) int module_rows(void) { return ROWS; }

/* Resets the parameters to those of the scenario. */
EXPORT(defaults) void module_defaults(void) { parameters = ${name}_defaults; }

/* Initialises the state at t = 0 with the present parameters. */
EXPORT(start) void module_start(void) { ${name}_start(&parameters, settings, &state); }

/* Runs so many steps, records those whose index since the start is a multiple of `every`, and returns the number of records. */
EXPORT(run) int module_run(int steps, int every) {
  int k, row = 0;
  ${name}_real outputs[${upper}_TOLD];
  for (k = 0; k < steps && row < ROWS; k++) {
    const int is_due = every > 0 && state.index % every == 0;
    ${name}_step(&parameters, settings, &state, outputs);
    if (is_due) memcpy(records + row++ * ${upper}_TOLD, outputs, sizeof outputs);
  }
  return row;
}
