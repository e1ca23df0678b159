/* The closed loop of ${title}
   Written by iblf_jax ${version}: robot, disturbance, sensor, law, observer and actuator, stepped by ${method}.

     ${name}_parameters p = ${name}_defaults;
     ${name}_state s;
     ${name}_start(&p, settings, &s);                settings: the step dt [s]${noise_setting}
     ${name}_step(&p, settings, &s, told);           what is told is the start of the step

   SI units, radians. */
#ifndef ${guard}
#define ${guard}

#include <stdint.h>

#define ${upper}_JOINTS ${joints}
#define ${upper}_SETTINGS ${settings}
#define ${upper}_TOLD ${told}
#define ${upper}_MEMORY ${memory_size}

typedef ${type} ${name}_real;

typedef struct {
${parameters}
} ${name}_parameters;

extern const ${name}_parameters ${name}_defaults;

typedef struct {
  ${name}_real memory[${memory_size}];
  int64_t index;
} ${name}_state;

/* What a step tells, one number a joint each: ${outputs}; and the status of the run so far. */
void ${name}_start(const ${name}_parameters *p, const ${name}_real *settings, ${name}_state *s);
void ${name}_step(const ${name}_parameters *p, const ${name}_real *settings, ${name}_state *s, ${name}_real *told);

#endif
