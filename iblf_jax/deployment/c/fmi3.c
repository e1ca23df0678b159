/* FMI 3.0 for co-simulation around ${title}
   Written by iblf_jax ${version}.  A variable is a place in one table: parameters, inputs, outputs.  Interface: FMI standard 3.0,
   https://fmi-standard.org, Modelica Association. */
#include "${name}.h"

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

typedef void *instance_t;
typedef void (*log_t)(void *environment, int status, const char *category, const char *message);
enum { OK = 0, WARNING = 1, ERROR = 3 };
enum { INPUTS = ${inputs}, OUTPUTS = ${outputs}, VARIABLES = ${variables}, PARAMETERS = ${parameter_count} };
static const char TOKEN[] = "${token}";

/* Of every variable but time: where its numbers begin, how many, and whether it may be set. */
static const struct { int place, size, settable; } variable[VARIABLES] = {
${variable_table}
};

typedef struct {
  ${name}_parameters p;
  double inputs[INPUTS + 1], outputs[OUTPUTS];
  ${name}_state s;
  double time;
  int64_t index;
  bool initializing;
  void *environment;
  log_t log;
} fmu;

/* The parameters are numbers alone, so their struct is an array. */
typedef char parameters_are_numbers[sizeof(${name}_parameters) == PARAMETERS * sizeof(double) ? 1 : -1];

static double *at(fmu *f, int place) {
  if (place < PARAMETERS) return (double *)&f->p + place;
  place -= PARAMETERS;
  return place < INPUTS ? f->inputs + place : f->outputs + (place - INPUTS);
}

static int failed(fmu *f, const char *message) {
  if (f->log) f->log(f->environment, ERROR, "logStatusError", message);
  return ERROR;
}

${block}

static void restart(fmu *f) {
  f->p = ${name}_defaults;
  memset(f->inputs, 0, sizeof f->inputs);
${starts}  memset(f->outputs, 0, sizeof f->outputs);
  memset(&f->s, 0, sizeof f->s);
  f->time = 0.0;
  f->index = 0;
  f->initializing = false;
}

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT int fmi3SetDebugLogging(instance_t i, bool on, size_t n, const char *const *categories) {
  (void)i; (void)on; (void)n; (void)categories;
  return OK;
}

EXPORT instance_t fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, bool visible, bool logging, bool events,
    bool early, const uint32_t *intermediate, size_t count, void *environment, log_t log, void *update) {
  fmu *f = token && strcmp(token, TOKEN) == 0 ? (fmu *)malloc(sizeof *f) : NULL;
  (void)name; (void)resources; (void)visible; (void)logging; (void)events; (void)early; (void)intermediate; (void)count; (void)update;
  if (!f) return NULL;
  f->environment = environment;
  f->log = log;
  restart(f);
  return f;
}

EXPORT void fmi3FreeInstance(instance_t i) { free(i); }

EXPORT int fmi3EnterInitializationMode(instance_t i, bool has_tolerance, double tolerance, double begin, bool has_end, double end) {
  fmu *f = (fmu *)i;
  (void)has_tolerance; (void)tolerance; (void)has_end; (void)end;
  f->time = begin;
  f->initializing = true;
  return OK;
}

EXPORT int fmi3ExitInitializationMode(instance_t i) {
  fmu *f = (fmu *)i;
  f->initializing = false;
  return begin(f);
}

EXPORT int fmi3Terminate(instance_t i) { (void)i; return OK; }
EXPORT int fmi3EnterStepMode(instance_t i) { (void)i; return OK; }
EXPORT int fmi3Reset(instance_t i) { restart((fmu *)i); return OK; }

EXPORT int fmi3GetFloat64(instance_t i, const uint32_t *references, size_t n, double *values, size_t count) {
  fmu *f = (fmu *)i;
  size_t k, done = 0;
  if (f->initializing && begin(f) != OK) return ERROR;
  for (k = 0; k < n; k++) {
    const uint32_t v = references[k];
    const size_t size = v == 0 ? 1 : v <= VARIABLES ? (size_t)variable[v - 1].size : count + 1;
    if (done + size > count) return failed(f, "an unknown variable, or too few values");
    memcpy(values + done, v == 0 ? &f->time : at(f, variable[v - 1].place), size * sizeof *values);
    done += size;
  }
  return done == count ? OK : failed(f, "too many values");
}

EXPORT int fmi3SetFloat64(instance_t i, const uint32_t *references, size_t n, const double *values, size_t count) {
  fmu *f = (fmu *)i;
  size_t k, done = 0;
  for (k = 0; k < n; k++) {
    const uint32_t v = references[k];
    if (v == 0 || v > VARIABLES || !variable[v - 1].settable) return failed(f, "a variable that cannot be set");
    if (done + (size_t)variable[v - 1].size > count) return failed(f, "too few values");
    memcpy(at(f, variable[v - 1].place), values + done, (size_t)variable[v - 1].size * sizeof *values);
    done += (size_t)variable[v - 1].size;
  }
  return done == count ? OK : failed(f, "too many values");
}

EXPORT int fmi3DoStep(instance_t i, double now, double step, bool no_return, bool *event, bool *terminate, bool *early, double *reached) {
  fmu *f = (fmu *)i;
  const double wanted = step / STEP, count = floor(wanted + 0.5);
  double k;
  int status = OK;
  (void)no_return;
  *event = *terminate = *early = false;
  *reached = now;
  if (!(count >= 1.0) || fabs(wanted - count) > 1e-6 * count) return failed(f, "a step must be a whole number of " STEP_TEXT " s");
  for (k = 0; k < count; k++) {
    const int here = advance(f);
    if (here == ERROR) return failed(f, "a result is no number");
    if (here != OK) status = here;
  }
  f->time = *reached = now + step;
  told(f);
  return status;
}

EXPORT int fmi3GetFMUState(instance_t i, void **state) {
  if (!*state) *state = malloc(sizeof(fmu));
  if (!*state) return failed((fmu *)i, "no memory");
  memcpy(*state, i, sizeof(fmu));
  return OK;
}

EXPORT int fmi3SetFMUState(instance_t i, void *state) {
  fmu *f = (fmu *)i;
  void *environment = f->environment;
  log_t log = f->log;
  memcpy(f, state, sizeof *f);
  f->environment = environment;
  f->log = log;
  return OK;
}

EXPORT int fmi3FreeFMUState(instance_t i, void **state) {
  (void)i;
  free(*state);
  *state = NULL;
  return OK;
}

/* What this kind of FMU has no use for. */
#define OF_TYPE(what, type) \
  EXPORT int fmi3Get##what(instance_t i, const uint32_t *r, size_t n, type *x, size_t m) { (void)r; (void)x; (void)m; return n ? failed((fmu *)i, "no such variable") : OK; } \
  EXPORT int fmi3Set##what(instance_t i, const uint32_t *r, size_t n, const type *x, size_t m) { (void)r; (void)x; (void)m; return n ? failed((fmu *)i, "no such variable") : OK; }
OF_TYPE(Float32, float) OF_TYPE(Int8, int8_t) OF_TYPE(UInt8, uint8_t) OF_TYPE(Int16, int16_t) OF_TYPE(UInt16, uint16_t) OF_TYPE(Int32, int32_t)
OF_TYPE(UInt32, uint32_t) OF_TYPE(Int64, int64_t) OF_TYPE(UInt64, uint64_t) OF_TYPE(Boolean, bool) OF_TYPE(String, char *)
#define UNUSED(name) EXPORT int name(instance_t i) { return failed((fmu *)i, #name " is not there"); }
UNUSED(fmi3GetBinary) UNUSED(fmi3SetBinary) UNUSED(fmi3GetClock) UNUSED(fmi3SetClock) UNUSED(fmi3EnterEventMode)
UNUSED(fmi3GetNumberOfVariableDependencies) UNUSED(fmi3GetVariableDependencies) UNUSED(fmi3SerializedFMUStateSize) UNUSED(fmi3SerializeFMUState)
UNUSED(fmi3DeserializeFMUState) UNUSED(fmi3GetDirectionalDerivative) UNUSED(fmi3GetAdjointDerivative) UNUSED(fmi3EnterConfigurationMode)
UNUSED(fmi3ExitConfigurationMode) UNUSED(fmi3GetIntervalDecimal) UNUSED(fmi3GetIntervalFraction) UNUSED(fmi3GetShiftDecimal)
UNUSED(fmi3GetShiftFraction) UNUSED(fmi3SetIntervalDecimal) UNUSED(fmi3SetIntervalFraction) UNUSED(fmi3SetShiftDecimal)
UNUSED(fmi3SetShiftFraction) UNUSED(fmi3EvaluateDiscreteStates) UNUSED(fmi3UpdateDiscreteStates) UNUSED(fmi3EnterContinuousTimeMode)
UNUSED(fmi3CompletedIntegratorStep) UNUSED(fmi3SetTime) UNUSED(fmi3SetContinuousStates) UNUSED(fmi3GetContinuousStateDerivatives)
UNUSED(fmi3GetEventIndicators) UNUSED(fmi3GetContinuousStates) UNUSED(fmi3GetNominalsOfContinuousStates) UNUSED(fmi3GetNumberOfEventIndicators)
UNUSED(fmi3GetNumberOfContinuousStates) UNUSED(fmi3GetOutputDerivatives) UNUSED(fmi3ActivateModelPartition)
EXPORT instance_t fmi3InstantiateModelExchange(void) { return NULL; }
EXPORT instance_t fmi3InstantiateScheduledExecution(void) { return NULL; }
