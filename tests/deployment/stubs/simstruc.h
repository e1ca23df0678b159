/* Stub of Simulink's simstruc.h for tests: what the S-function of the documentation uses. */
#ifndef SIMSTRUC_H
#define SIMSTRUC_H

typedef int int_T;
typedef struct {
  double *work;
  double inputs[2][8], outputs[2][8], time, period;
  int work_width;
} SimStruct;
enum { SS_DOUBLE };

static int accepted(SimStruct *S) { return S->inputs[0] != S->inputs[1]; }
#define ssSetNumSFcnParams(S, count) ((void)(S))
#define ssSetNumInputPorts(S, count) accepted(S)
#define ssSetNumOutputPorts(S, count) accepted(S)
#define ssSetInputPortWidth(S, port, width) ((void)(port))
#define ssSetInputPortRequiredContiguous(S, port, flag) ((void)(port))
#define ssSetInputPortDirectFeedThrough(S, port, flag) ((void)(port))
#define ssSetOutputPortWidth(S, port, width) ((void)(S))
#define ssSetNumSampleTimes(S, count) ((void)(S))
#define ssSetNumDWork(S, count) ((void)(S))
#define ssSetDWorkWidth(S, place, width) ((S)->work_width = (width))
#define ssSetDWorkDataType(S, place, type) ((void)(S))
#define ssSetSampleTime(S, place, seconds) ((S)->period = (seconds))
#define ssSetOffsetTime(S, place, seconds) ((void)(S))
#define ssGetDWork(S, place) ((void *)(S)->work)
#define ssGetInputPortRealSignal(S, port) ((const double *)(S)->inputs[port])
#define ssGetOutputPortRealSignal(S, port) ((S)->outputs[port])
#define ssGetT(S) ((S)->time)

#endif
