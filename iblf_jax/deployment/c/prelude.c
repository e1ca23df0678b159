#include "${name}.h"

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

typedef ${name}_real real;
typedef ${name}_real F;
typedef ${integer} I;
typedef I integer;
#define FN(name) ${suffix}
${plain}
${lookup}
const ${name}_parameters ${name}_defaults = ${defaults};

${start}
${sample}
