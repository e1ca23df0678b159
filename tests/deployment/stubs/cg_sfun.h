/* Runs the S-function with the samples of the self-test, for tests: it is included at the end of the
   file of the S-function, as Simulink's own file of this name is. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "vectors.h"

int main(void) {
  static SimStruct S;
  double worst = 0.0, largest = 1.0;
  int k, i;
  mdlInitializeSizes(&S);
  mdlInitializeSampleTimes(&S);
  S.work = malloc((size_t)S.work_width * sizeof(double));
  if (S.work == NULL) return 1;
  for (k = 0; k < S.work_width; k++) S.work[k] = NAN;
  mdlInitializeConditions(&S);
  for (k = 0; k < SAMPLES; k++) {
    memcpy(S.inputs[0], q[k], sizeof q[k]);
    memcpy(S.inputs[1], dq[k], sizeof dq[k]);
    S.time = k * S.period;
    mdlOutputs(&S, 0);
    for (i = 0; i < ARM_LAW_JOINTS && k % CHECKED == 0; i++) {
      largest = fmax(largest, fabs(torque[k / CHECKED][i]));
      worst = fmax(worst, fabs(S.outputs[0][i] - torque[k / CHECKED][i]));
    }
  }
  mdlTerminate(&S);
  free(S.work);
  (void)first_q, (void)first_dq;
  printf("%.3g %g\n", worst / largest, S.outputs[1][0]);
  return 0;
}
