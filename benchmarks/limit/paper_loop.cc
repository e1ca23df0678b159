/* The limit: the paper's closed loop (integral barrier, printed reading), RK4, written by hand for speed.  The mass of the plant's second
   link and the start differ between runs; the model keeps the nominal mass.  Derivatives by hand, one sine and cosine a joint and the
   addition theorem, the 2x2 solve and both barrier slopes with one division each, signals of time in a table.  It carries the state
   and nothing else: no metrics, no status, no guard, no records. */
#include "vector.h"
#include "mathlib.h"

#define CHUNK 128
enum { A1, A2, B1, B2, QD1, QD2, DQD1, DQD2, DDQD1, DDQD2, KAPPA1, KAPPA2, DKAPPA1, DKAPPA2, KU1, KU2, KL1, KL2, COLUMNS };

static void signals(double t, real *row) {
  double s = 0.14 * sin(t), c = 0.14 * cos(t), wave[2] = {s, c}, dwave[2] = {c, -s};
  row[A1] = 0.3 * sin(t); row[A2] = 0.3 * cos(t); row[B1] = 0.3 * cos(0.5 * t); row[B2] = 0.3 * sin(0.5 * t);
  for (int i = 0; i < 2; i++) {
    double w = wave[i], dw = dwave[i], o = wave[1 - i], other = i ? c : -s;
    double kl = 0.3 + w - o, dkl = dw - other, ddkl = o - w, ku = 0.4 - w + o, dku = other - dw, ddku = w - o;
    double a = dku / ku, b = dkl / kl, kappa = sqrt(a * a + b * b + 0.1);
    row[QD1 + i] = 0.5 + w; row[DQD1 + i] = dw; row[DDQD1 + i] = -w; row[KAPPA1 + i] = 2.0 + kappa;
    row[DKAPPA1 + i] = (a * (ddku / ku - a * a) + b * (ddkl / kl - b * b)) / kappa;
    row[KU1 + i] = ku * ku; row[KL1 + i] = kl * kl;
  }
}

typedef struct { F p1, p2, p3, g4, g5; } arm;
typedef struct { F q1, q2, v1, v2, n1, n2; } state;

/* The model: nominal numbers. */
#define P1 REAL(0.226625)
#define P2 REAL(0.04084250)
#define P3 REAL(0.04611250)
#define G4 REAL(6.351975)
#define G5 REAL(1.2924675)

INLINE state slope(const arm *p, const real *r, state x) {
  reduced u = reduce(x.q1), w = reduce(x.q2);
  F s1 = sine_of(u), c1 = cosine_of(u), s2 = sine_of(w), c2 = cosine_of(w), c12 = c1 * c2 - s1 * s2;
  F k = p->p3 * c2, m12 = p->p2 + k, m11 = p->p1 + m12 + k, m22 = p->p2;
  F K = P3 * c2, M12 = K + P2, M11 = M12 + K + P1;
  F sum = x.v1 + x.v2, c_1 = s2 * (x.v2 * x.v1 + sum * x.v2), c_2 = s2 * x.v1 * x.v1;
  F e1 = x.q1 - r[QD1], e2 = x.q2 - r[QD2];
  F w1 = x.v1 - (r[DQD1] - r[KAPPA1] * e1), w2 = x.v2 - (r[DQD2] - r[KAPPA2] * e2);
  F a1 = r[DDQD1] - r[KAPPA1] * (x.v1 - r[DQD1]) - r[DKAPPA1] * e1, a2 = r[DDQD2] - r[KAPPA2] * (x.v2 - r[DQD2]) - r[DKAPPA2] * e2;
  F zero = splat(0), b1 = e1 > zero ? splat(r[KU1]) : splat(r[KL1]), b2 = e2 > zero ? splat(r[KU2]) : splat(r[KL2]);
  F d1 = b1 - e1 * e1, d2 = b2 - e2 * e2, inverse = REAL(2.0) / (d1 * d2);
  F f1 = x.n1 + REAL(20.0) * (M11 * x.v1 + M12 * x.v2), f2 = x.n2 + REAL(20.0) * (M12 * x.v1 + P2 * x.v2);
  F drift1 = G4 * c1 + G5 * c12 - P3 * c_1, drift2 = G5 * c12 + P3 * c_2;
  F t1 = drift1 + M11 * a1 + M12 * a2 - f1 - REAL(20.0) * w1 - e1 * d2 * inverse;
  F t2 = drift2 + M12 * a1 + P2 * a2 - f2 - REAL(20.0) * w2 - e2 * d1 * inverse;
  F push1 = M11 * r[A1] + M12 * r[A2] - P3 * (s2 * (x.v2 * r[B1] + sum * r[B2]));
  F push2 = M12 * r[A1] + P2 * r[A2] + P3 * (s2 * x.v1 * r[B1]), outer = p->g5 * c12;
  F r1 = t1 + push1 + p->p3 * c_1 - p->g4 * c1 - outer, r2 = t2 + push2 - p->p3 * c_2 - outer;
  F over = REAL(1.0) / (m11 * m22 - m12 * m12);
  state out = {x.v1, x.v2, (m22 * r1 - m12 * r2) * over, (m11 * r2 - m12 * r1) * over,
               REAL(-20.0) * (f1 + t1 - drift1), REAL(-20.0) * (f2 + t2 - drift2)};
  return out;
}

INLINE state moved(state x, F h, state k) {
  state y = {x.q1 + h * k.q1, x.q2 + h * k.q2, x.v1 + h * k.v1, x.v2 + h * k.v2, x.n1 + h * k.n1, x.n2 + h * k.n2};
  return y;
}

static state advance(const arm *p, state x, const real *table, int count, real dt) {
  F half = splat(dt * REAL(0.5)), whole = splat(dt), sixth = splat(dt / REAL(6.0)), third = splat(dt / REAL(3.0));
  for (int s = 0; s < count; s++, table += 2 * COLUMNS) {
    state k1 = slope(p, table, x), y = moved(x, sixth, k1);
    state k2 = slope(p, table + COLUMNS, moved(x, half, k1));
    y = moved(y, third, k2);
    state k3 = slope(p, table + COLUMNS, moved(x, half, k2));
    y = moved(y, third, k3);
    state k4 = slope(p, table + 2 * COLUMNS, moved(x, whole, k3));
    x = moved(y, sixth, k4);
  }
  return x;
}

typedef struct { const real *mass; real *x, *table; long runs, steps, first, last; double dt; } part;

static void *work(void *argument) {
  part *j = (part *)argument;
  for (long run = j->first; run < j->last; run += W) {
    F m = load(j->mass + run);
    real l1 = 0.35, l2 = 0.31;
    arm p = {l1 * l1 + m * l1 * l1, m * l2 * l2 / 4 + REAL(0.02042125), m * l1 * l2 / 2, (l1 + m * l1) * REAL(9.81), m * l2 / 2 * REAL(9.81)};
    real *x = j->x + run;
    state s = {load(x), load(x + j->runs), load(x + 2 * j->runs), load(x + 3 * j->runs), load(x + 4 * j->runs), load(x + 5 * j->runs)};
    for (long done = 0; done < j->steps; done += CHUNK)
      s = advance(&p, s, j->table + done * 2 * COLUMNS, (int)(j->steps - done < CHUNK ? j->steps - done : CHUNK), j->dt);
    store(x, s.q1); store(x + j->runs, s.q2); store(x + 2 * j->runs, s.v1); store(x + 3 * j->runs, s.v2);
    store(x + 4 * j->runs, s.n1); store(x + 5 * j->runs, s.n2);
  }
  return NULL;
}

/* x: (6, runs), in and out; mass: (runs,) of the second link; runs a multiple of 64. */
extern "C" __attribute__((visibility("default"))) int paper_loop(const real *mass, real *x, long runs, long steps, double dt, long threads) {
  real *table = (real *)malloc((2 * steps + 1) * COLUMNS * sizeof(real));
  if (!table || threads > 256) return 1;
  for (long i = 0; i <= 2 * steps; i++) signals(0.5 * dt * i, table + i * COLUMNS);
  part parts[256];
  pthread_t started[256];
  long blocks = runs / 64;
  for (long i = 0; i < threads; i++) {
    part p = {mass, x, table, runs, steps, blocks * i / threads * 64, blocks * (i + 1) / threads * 64, dt};
    parts[i] = p;
    if (i) pthread_create(&started[i], NULL, work, &parts[i]);
  }
  work(&parts[0]);
  for (long i = 1; i < threads; i++) pthread_join(started[i], NULL);
  free(table);
  return 0;
}
