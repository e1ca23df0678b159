/* Compares ${name}.c on this machine with the package: the torques of samples of ${duration} s of a simulated run, and the handling of
   non-finite input.  Prints the largest difference and the time of a call. */
#include "${name}.h"

#include <math.h>
#include <stdio.h>
#include <string.h>
#include <time.h>

#include "vectors.h"

int main(void) {
  enum { N = ${joints}, ROUNDS = ${rounds} };
  const double tolerance = ${tolerance}, period = ${period};
  double worst = 0.0, largest = 1.0, seconds;
  ${name}_parameters p = ${name}_defaults;
  ${name}_state s, before;
  ${name}_real tau[N], bad[N];
  clock_t begin;
  int k, i, round, status, failed = 0;

  for (k = 0; k < SAMPLES / CHECKED; k++)
    for (i = 0; i < N; i++) largest = fmax(largest, fabs((double)torque[k][i]));
  if (${name}_init(&p, &s, first_q, first_dq${first_further}) != 0) return 1;
  for (k = 0; k < SAMPLES; k++) {
    status = ${name}_step(&p, &s, (${name}_real)(k * period), q[k], ${arguments_of_k}, tau);
    if (status & ${upper}_NOT_FINITE) return 1;
    for (i = 0; i < N && k % CHECKED == 0; i++) {
      const double off = fabs((double)tau[i] - (double)torque[k / CHECKED][i]) / largest;
      if (!(off <= worst)) worst = off;
    }
  }
  if (!(worst <= tolerance)) failed = 1;

  memcpy(bad, q[0], sizeof bad);
  bad[0] = (${name}_real)NAN;
  before = s;
  status = ${name}_step(&p, &s, (${name}_real)0, bad, ${arguments_of_0}, tau);
  if (status != ${upper}_NOT_FINITE || memcmp(&before, &s, sizeof s) != 0 || memcmp(tau, s.tau, sizeof tau) != 0) failed = 1;

  begin = clock();
  for (round = 0; round < ROUNDS; round++)
    for (k = 0; k < SAMPLES; k++) (void)${name}_step(&p, &s, (${name}_real)(k * period), q[k], ${arguments_of_k}, tau);
  seconds = (double)(clock() - begin) / (double)CLOCKS_PER_SEC;
  printf("%s: torque within %.2g of the package's (of the largest, %.3g; at most %.0e), %.3g us a call, state %u bytes\n",
      failed ? "FAILED" : "ok", worst, largest, tolerance, 1e6 * seconds / ((double)ROUNDS * (double)SAMPLES), (unsigned)sizeof s);
  return failed;
}
