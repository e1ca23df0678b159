/* Evaluates a program on boxes, and searches a box depth-first.  The functions of the program are in front of this text: `shared_numbers` computes
   what depends on constants only, `evaluate` the rest for W boxes.  The first ALTERNATIVES outputs are alternatives, the others describe the region. */

#define VISIBLE extern "C" __attribute__((visibility("default")))
/* Coordinates, their weights, the number of bisections, and the number of bisections until the weights are measured again. */
#define RECORD (3 * COORDINATES + 2)
#define DEPTH (3 * COORDINATES)
#define AGE (3 * COORDINATES + 1)

/* The rounding mode of a call, and denormal numbers as numbers, which other libraries may have switched off in this thread.  No operation moves
   across the calls: the compiler does not know what they read and write. */
typedef struct { fenv_t before; } environment;
SEPARATE int enter(environment *e) {
  fegetenv(&e->before);
  fesetenv(FE_DFL_ENV);
  return fesetround(FE_UPWARD);
}
SEPARATE void leave(environment *e) { fesetenv(&e->before); }

typedef struct {
  int64_t max_boxes, max_undecided, renewal;
  const real *smallest;          /* width up to which a coordinate is not bisected */
  const real *scale;             /* width at which a coordinate counts as 1 wide */
  const volatile int *stop;
  real guard;                    /* a coordinate is bisected only if it is at least 1/guard of the widest one */
} search_options;
typedef struct {
  int64_t boxes, undecided, status;
  real done;                     /* part of the volume of the whole box on which the statement is proved */
  real bound, value;             /* of the worst box that is left: its upper bound, and the one at its centre */
  real low[COORDINATES], high[COORDINATES];
} search_result;
enum { FINISHED, UNDECIDED, REFUTED, OUT_OF_BOXES, STOPPED, OUT_OF_MEMORY };

typedef struct { F value, lowest, outside, inside; } verdict;
/* value < 0: the statement holds; outside < 0: no point is in the region; lowest <= 0: every alternative is at least 0; inside <= 0: all points
   are in the region. */
SEPARATE verdict evaluated(const shared_number *table, const interval *x) {
  interval out[OUTPUTS];
  evaluate(table, x, out);
  verdict v = {UNBOUNDED, -UNBOUNDED, UNBOUNDED, -UNBOUNDED};
  for (int i = 0; i < ALTERNATIVES; i++) { v.value = smaller(out[i].u, v.value); v.lowest = largest(out[i].n, v.lowest); }
  for (int i = ALTERNATIVES; i < OUTPUTS; i++) { v.outside = smaller(out[i].n, v.outside); v.inside = largest(out[i].u, v.inside); }
  return v;
}

/* Boxes in memory, `stride` numbers apart, as vectors; the last one fills the rest. */
INLINE void gathered(const real *low, const real *high, int64_t stride, int count, interval *x) {
  for (int i = 0; i < COORDINATES; i++)
    for (int l = 0; l < W; l++) {
      int64_t k = (l < count ? l : count - 1) * stride + i;
      x[i].n[l] = -low[k];
      x[i].u[l] = high[k];
    }
}

/* What is left of a margin after a bisection, in parts of what it was. */
INLINE real remaining(real after, real before) {
  if (!(before < INFINITY)) return after < INFINITY ? REAL(0.5) : REAL(1.0);
  real part = after / before;
  return part < 0 ? 0 : part < 1 ? part : 1;
}

/* The weight of a coordinate: what a bisection along it removes of the margin, per width.  The half that loses less counts three times: both halves
   must be finished. */
SEPARATE void measure(const shared_number *table, real *box, real value, real outside) {
  real low[2 * COORDINATES * COORDINATES], high[2 * COORDINATES * COORDINATES], left[2 * COORDINATES];
  for (int k = 0; k < 2 * COORDINATES; k++) {
    int i = k / 2;
    memcpy(low + k * COORDINATES, box, COORDINATES * sizeof(real));
    memcpy(high + k * COORDINATES, box + COORDINATES, COORDINATES * sizeof(real));
    real middle = box[i] + REAL(0.5) * (box[COORDINATES + i] - box[i]);
    (k % 2 ? low : high)[k * COORDINATES + i] = middle;
  }
  for (int first = 0; first < 2 * COORDINATES; first += W) {
    int count = 2 * COORDINATES - first < W ? 2 * COORDINATES - first : W;
    interval x[COORDINATES];
    gathered(low + first * COORDINATES, high + first * COORDINATES, COORDINATES, count, x);
    verdict v = evaluated(table, x);
    for (int l = 0; l < count; l++) {
      real a = remaining(v.value[l], value), b = OUTPUTS > ALTERNATIVES ? remaining(v.outside[l], outside) : 1;
      left[first + l] = a < b ? a : b;
    }
  }
  for (int i = 0; i < COORDINATES; i++) {
    real width = box[COORDINATES + i] - box[i], one = left[2 * i], other = left[2 * i + 1];
    real gain = 4 - one - other - 2 * (one > other ? one : other);
    box[2 * COORDINATES + i] = width > 0 ? (gain + REAL(1e-3)) / width : 0;
  }
}

/* The coordinate along which a box is bisected; -1 if all are too narrow.  It is the one whose bisection removes most of the margin, of those that are
   not much narrower than the widest one: where only bisections along several coordinates together reduce the margin, no weight would choose them. */
INLINE int chosen(const real *box, const search_options *options) {
  int best = -1;
  real most = 0, broadest = 0;
  for (int i = 0; i < COORDINATES; i++) {
    real width = box[COORDINATES + i] - box[i];
    if (width > options->smallest[i] && width > broadest * options->scale[i]) broadest = width / options->scale[i];
  }
  for (int i = 0; i < COORDINATES; i++) {
    real width = box[COORDINATES + i] - box[i], size = width * box[2 * COORDINATES + i];
    int may = width > options->smallest[i] && width * options->guard >= broadest * options->scale[i];
    if (may && size > most) { most = size; best = i; }
  }
  return best;
}

/* Makes the worst of some boxes that are left the result's: the one with the largest bound at its centre. */
SEPARATE void note_worst(const shared_number *table, const real *boxes, int64_t count, search_result *r) {
  for (int64_t first = 0; first < count; first += W) {
    const real *here = boxes + first * RECORD;
    int some = count - first < W ? (int)(count - first) : W;
    interval x[COORDINATES], centre[COORDINATES];
    gathered(here, here + COORDINATES, RECORD, some, x);
    for (int i = 0; i < COORDINATES; i++) centre[i] = at((x[i].u - x[i].n) * REAL(0.5));
    verdict box = evaluated(table, x), point = evaluated(table, centre);
    for (int l = 0; l < some; l++)
      if (point.value[l] > r->value) {
        r->value = point.value[l];
        r->bound = box.value[l];
        memcpy(r->low, here + l * RECORD, sizeof r->low);
        memcpy(r->high, here + l * RECORD + COORDINATES, sizeof r->high);
      }
  }
}

/* Evaluates at most W boxes, which it may change, and writes the halves of those that are left to `children`; returns their number. */
SEPARATE int64_t branch(const shared_number *table, real *boxes, int some, const search_options *options, real *children, search_result *r) {
  int64_t count = 0;
  interval x[COORDINATES];
  gathered(boxes, boxes + COORDINATES, RECORD, some, x);
  verdict v = evaluated(table, x);
  r->boxes += some;
  for (int l = 0; l < some; l++) {
    real *box = boxes + l * RECORD;
    if (v.value[l] < 0 || v.outside[l] < 0) {
      r->done += ldexp(1.0, -(int)box[DEPTH]);
      continue;
    }
    if (v.lowest[l] <= 0 && v.inside[l] <= 0) {
      note_worst(table, box, 1, r);
      r->status = REFUTED;
    }
    if (box[AGE] == 0) {
      measure(table, box, v.value[l], v.outside[l]);
      r->boxes += 2 * COORDINATES;
      box[AGE] = options->renewal;
    }
    int i = chosen(box, options);
    real middle = i < 0 ? 0 : box[i] + REAL(0.5) * (box[COORDINATES + i] - box[i]);
    if (i < 0 || !(box[i] < middle && middle < box[COORDINATES + i])) {
      note_worst(table, box, 1, r);
      r->undecided++;
      continue;
    }
    box[DEPTH] += 1;
    box[AGE] -= 1;
    real *child = children + count * RECORD;
    memcpy(child, box, RECORD * sizeof(real));
    memcpy(child + RECORD, box, RECORD * sizeof(real));
    child[COORDINATES + i] = middle;
    child[RECORD + i] = middle;
    count += 2;
  }
  if (r->undecided >= options->max_undecided && r->status == FINISHED) r->status = UNDECIDED;
  return count;
}

/* Depth-first: the stack grows by at most W boxes a time. */
SEPARATE void search(const shared_number *table, const real *box, const search_options *options, search_result *r) {
  int64_t capacity = 512, count = 1;
  real *stack = (real *)malloc(capacity * RECORD * sizeof(real)), boxes[W * RECORD];
  if (!stack) r->status = OUT_OF_MEMORY;
  else memcpy(stack, box, RECORD * sizeof(real));
  while (r->status == FINISHED && count > 0) {
    if (r->boxes >= options->max_boxes) { r->status = OUT_OF_BOXES; break; }
    if (*options->stop) { r->status = STOPPED; break; }
    int some = count < W ? (int)count : W;
    count -= some;
    memcpy(boxes, stack + count * RECORD, some * RECORD * sizeof(real));
    count += branch(table, boxes, some, options, stack + count * RECORD, r);
    if (count + W <= capacity) continue;
    real *more = (real *)realloc(stack, 2 * capacity * RECORD * sizeof(real));
    if (!more) { r->status = OUT_OF_MEMORY; break; }
    stack = more;
    capacity *= 2;
  }
  if (r->status == FINISHED && r->undecided) r->status = UNDECIDED;
  if (r->status == OUT_OF_BOXES) note_worst(table, stack, count, r);
  free(stack);
}

/* Breadth-first, until there are `target` boxes: in one generation after the other, each is replaced by what is left of it.  `boxes` has room for
   2 target of them. */
SEPARATE int64_t divide(const shared_number *table, real *boxes, int64_t target, const search_options *options, search_result *r) {
  int64_t count = 1;
  real batch[W * RECORD], *next = (real *)malloc(2 * target * RECORD * sizeof(real));
  if (!next) r->status = OUT_OF_MEMORY;
  while (r->status == FINISHED && count > 0 && count < target) {
    if (r->boxes >= options->max_boxes) { r->status = OUT_OF_BOXES; break; }
    int64_t children = 0;
    for (int64_t first = 0; first < count; first += W) {
      int some = count - first < W ? (int)(count - first) : W;
      memcpy(batch, boxes + first * RECORD, some * RECORD * sizeof(real));
      children += branch(table, batch, some, options, next + children * RECORD, r);
    }
    memcpy(boxes, next, children * RECORD * sizeof(real));
    count = children;
  }
  free(next);
  if (r->status == FINISHED && r->undecided) r->status = UNDECIDED;
  return count;
}

/* The number of boxes that `search` would evaluate for some boxes, which are changed: a path on each follows a random half, and what is evaluated there
   after k bisections counts 2^k times, so that the expectation is the number itself. */
SEPARATE real descend(const shared_number *table, real *boxes, int64_t count, uint64_t random, const search_options *options, search_result *r) {
  real batch[W * RECORD], children[2 * W * RECORD], expected = 0;
  for (real parts = 1; count > 0 && r->status == FINISHED; parts *= 2) {
    int64_t before = r->boxes, left = 0;
    for (int64_t first = 0; first < count; first += W) {
      int some = count - first < W ? (int)(count - first) : W;
      memcpy(batch, boxes + first * RECORD, some * RECORD * sizeof(real));
      int64_t halves = branch(table, batch, some, options, children, r);
      for (int64_t k = 0; k < halves; k += 2) {
        random = random * 6364136223846793005u + 1442695040888963407u;
        memcpy(boxes + left++ * RECORD, children + (k + (random >> 63)) * RECORD, RECORD * sizeof(real));
      }
    }
    expected += parts * (r->boxes - before);
    count = left;
  }
  return expected;
}

#define BEGIN                                   \
  environment e;                                \
  if (enter(&e)) return -1;                     \
  shared_number table[TABLE_SIZE];              \
  shared_numbers(shared, table);
#define START_RESULT memset(result, 0, sizeof *result); result->value = -INFINITY;

/* A box is a record: lower and upper corner, and zeros where it is the whole. */
VISIBLE int record_size(void) { return RECORD; }
VISIBLE int64_t divide_box(const real *shared, real *boxes, int64_t target, const search_options *options, search_result *result) {
  BEGIN START_RESULT
  int64_t count = divide(table, boxes, target, options, result);
  leave(&e);
  return count;
}
VISIBLE int search_box(const real *shared, const real *box, const search_options *options, search_result *result) {
  BEGIN START_RESULT
  search(table, box, options, result);
  leave(&e);
  return 0;
}
/* result->done is the number of boxes that are expected; infinite where the search of these boxes proves nothing. */
VISIBLE int expected_boxes(const real *shared, real *boxes, int64_t count, uint64_t random, const search_options *options, search_result *result) {
  BEGIN START_RESULT
  real expected = descend(table, boxes, count, random, options, result);
  result->done = result->status == FINISHED && !result->undecided ? expected : INFINITY;
  leave(&e);
  return 0;
}
VISIBLE int worst_box(const real *shared, const real *boxes, int64_t count, search_result *result) {
  BEGIN START_RESULT
  note_worst(table, boxes, count, result);
  leave(&e);
  return 0;
}

SEPARATE void enclose_all(const shared_number *table, int64_t boxes, const real *low, const real *high, real *lower, real *upper) {
  for (int64_t first = 0; first < boxes; first += W) {
    int count = boxes - first < W ? (int)(boxes - first) : W;
    interval x[COORDINATES], out[OUTPUTS];
    gathered(low + first * COORDINATES, high + first * COORDINATES, COORDINATES, count, x);
    evaluate(table, x, out);
    for (int l = 0; l < count; l++)
      for (int i = 0; i < OUTPUTS; i++) {
        lower[(first + l) * OUTPUTS + i] = -out[i].n[l];
        upper[(first + l) * OUTPUTS + i] = out[i].u[l];
      }
  }
}
VISIBLE int enclose_boxes(const real *shared, int64_t boxes, const real *low, const real *high, real *lower, real *upper) {
  BEGIN
  enclose_all(table, boxes, low, high, lower, upper);
  leave(&e);
  return 0;
}

/* The bounds of x + y, x - y, x y, x / y, sqrt(x), sin(x) and exp(x), of W numbers each: what the compiler and the processor make of the rounding
   mode. */
SEPARATE void rounded(const real *x, const real *y, real *lower, real *upper) {
  interval a = at(load(x)), b = at(load(y)), results[] = {i_add(a, b), i_sub(a, b), i_mul(a, b), i_div(a, b), i_sqrt(a), i_sin(a), i_exp(a)};
  for (int k = 0; k < 7; k++) { store(lower + k * W, -results[k].n); store(upper + k * W, results[k].u); }
}
VISIBLE int vector_size(void) { return W; }
VISIBLE int rounded_operations(const real *x, const real *y, real *lower, real *upper) {
  environment e;
  if (enter(&e)) return 1;
  rounded(x, y, lower, upper);
  leave(&e);
  return 0;
}
