/* Reference trajectories in extended precision, by a method other than the package's.
 *
 * Gragg-Bulirsch-Stoer extrapolation of order 16 in world axes about the centre of mass, contact modes frozen within a step,
 * events located by re-stepping to the root of the guard (no dense output, no series). Long double by default; with
 * -DQUAD all arithmetic is __float128 (link libquadmath).
 *
 * usage: reference TOL CAP PERTURBATION < scenes > rows
 *   TOL           admissible error of one step, relative to the clearance
 *   CAP           longest step in contact as a phase of the contact's oscillation, in rad; CAP ms in flight
 *   PERTURBATION  added to the initial x, in clearances
 * Each scene is one line of numbers (see random_scenes.py: `reference_line`). The output of each scene is in doubles:
 *   status (0 done, 1 step too small), steps, evaluations, events, rows, then rows x (x, y, theta) of the cavity's centre.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef QUAD
#include <quadmath.h>
typedef __float128 real;
#define SIN sinq
#define COS cosq
#define SQRT sqrtq
#define POW powq
#define ABS fabsq
#else
#include <math.h>
typedef long double real;
#define SIN sinl
#define COS cosl
#define SQRT sqrtl
#define POW powl
#define ABS fabsl
#endif

enum { COLUMNS = 8, PAIRS = 8, HARMONICS = 4 };
enum { OFF, ON, CLIPPED };
enum { KELVIN_VOIGT, CONSTANT_FACTOR, RESTITUTION };

typedef struct {
    real fx, fy, omega, phase, moment;
} harmonic;

typedef struct {
    real width, height, gx, gy, mass, inertia, gravity, arm, rx, ry, stiffness, exponent, damping, floor;
    int law, count;
    harmonic load[HARMONICS];
    real initial[6], end, output;
} scene;

typedef struct {
    int mode[PAIRS];
    real factor[PAIRS];
} contacts;

typedef struct {
    real d[PAIRS], rate[PAIRS], second[PAIRS]; /* penetration and its two derivatives */
} gaps;

static long evaluations;

static const int SIDE_X[4] = {-1, 1, 1, -1}, SIDE_Y[4] = {1, 1, -1, -1};

/* Corner c seen from the centre of mass in head axes, and its velocity there. */
static void corner_of(const scene *s, const real *z, int c, real co, real si, real *p, real *u)
{
    real X = SIDE_X[c] * s->width / 2 - z[0], Y = SIDE_Y[c] * s->height / 2 - z[1];
    p[0] = co * X + si * Y;
    p[1] = co * Y - si * X;
    u[0] = -(co * z[3] + si * z[4]) + z[5] * p[1];
    u[1] = -(co * z[4] - si * z[3]) - z[5] * p[0];
}

static real elastic(const scene *s, real d)
{
    if (s->exponent == 1)
        return s->stiffness * d;
    if (s->exponent == 2)
        return s->stiffness * d * d;
    return d > 0 ? s->stiffness * d * SQRT(d) : 0; /* exponent 1.5 */
}

static real normal_force(const scene *s, const contacts *k, int pair, real d, real rate)
{
    if (s->law == KELVIN_VOIGT)
        return s->stiffness * d + s->damping * rate;
    return elastic(s, d) * (1 + k->factor[pair] * rate);
}

/* Rate of z = (x, y, theta, vx, vy, omega) of the centre of mass with the modes frozen. */
static void rhs(const scene *s, const contacts *k, real t, const real *z, real *out)
{
    real co = COS(z[2]), si = SIN(z[2]), fx = 0, fy = 0, torque = 0;
    for (int c = 0; c < 4; c++) {
        if (k->mode[2 * c] != ON && k->mode[2 * c + 1] != ON)
            continue;
        real p[2], u[2];
        corner_of(s, z, c, co, si, p, u);
        if (k->mode[2 * c] == ON) {
            real d = SIDE_Y[c] * (p[1] + s->ry) - (s->height + s->gy) / 2;
            real f = SIDE_Y[c] * normal_force(s, k, 2 * c, d, SIDE_Y[c] * u[1]);
            fy += f;
            torque += p[0] * f;
        }
        if (k->mode[2 * c + 1] == ON) {
            real d = SIDE_X[c] * (p[0] + s->rx) - (s->width + s->gx) / 2;
            real f = SIDE_X[c] * normal_force(s, k, 2 * c + 1, d, SIDE_X[c] * u[0]);
            fx += f;
            torque -= p[1] * f;
        }
    }
    real lx = 0, ly = 0, moment = 0;
    for (int i = 0; i < s->count; i++) {
        const harmonic *load = &s->load[i];
        real a = SIN(load->omega * t + load->phase);
        lx += load->fx * a;
        ly += load->fy * a;
        moment += load->moment * a;
    }
    /* loads' moments are about the cavity's centre, which lies at -R (rx, ry) from the centre of mass */
    real ox = co * s->rx - si * s->ry, oy = si * s->rx + co * s->ry;
    out[0] = z[3];
    out[1] = z[4];
    out[2] = z[5];
    out[3] = (lx + co * fx - si * fy) / s->mass;
    out[4] = (ly + si * fx + co * fy) / s->mass - s->gravity;
    out[5] = (moment - (ox * ly - oy * lx) - s->mass * s->gravity * s->arm + torque) / s->inertia;
    evaluations++;
}

/* Penetrations with their first two derivatives. */
static void measure(const scene *s, const contacts *k, real t, const real *z, gaps *g)
{
    real co = COS(z[2]), si = SIN(z[2]), r[6];
    rhs(s, k, t, z, r);
    for (int c = 0; c < 4; c++) {
        real p[2], u[2];
        corner_of(s, z, c, co, si, p, u);
        /* u' = -R^T a + omega (rotated terms): differentiate p' = -R^T v - omega x p once more */
        real vx = co * z[3] + si * z[4], vy = co * z[4] - si * z[3];
        real ax = co * r[3] + si * r[4], ay = co * r[4] - si * r[3];
        real wx = -(ax + z[5] * vy) + r[5] * p[1] + z[5] * u[1];
        real wy = -(ay - z[5] * vx) - r[5] * p[0] - z[5] * u[0];
        g->d[2 * c] = SIDE_Y[c] * (p[1] + s->ry) - (s->height + s->gy) / 2;
        g->rate[2 * c] = SIDE_Y[c] * u[1];
        g->second[2 * c] = SIDE_Y[c] * wy;
        g->d[2 * c + 1] = SIDE_X[c] * (p[0] + s->rx) - (s->width + s->gx) / 2;
        g->rate[2 * c + 1] = SIDE_X[c] * u[0];
        g->second[2 * c + 1] = SIDE_X[c] * wx;
    }
}

/* Writes value and slope of guard `which` (0, 1) of a pair to v; it is positive past the event. Returns 0 if there is
 * no such guard. */
static int guard(const scene *s, const contacts *k, const gaps *g, int pair, int which, real *v)
{
    real d = g->d[pair], r = g->rate[pair], a = g->second[pair];
    int mode = k->mode[pair], viscous = s->law == KELVIN_VOIGT;
    real sign = mode == ON ? -1 : 1;
    if (mode == OFF) {
        v[0] = d;
        v[1] = r;
        return which == 0;
    }
    if (which == 0) {
        if (viscous && mode == ON)
            return 0;
        v[0] = -d;
        v[1] = -r;
        return 1;
    }
    if (viscous) {
        v[0] = sign * (s->stiffness * d + s->damping * r);
        v[1] = sign * (s->stiffness * r + s->damping * a);
        return 1;
    }
    v[0] = sign * (1 + k->factor[pair] * r);
    v[1] = sign * k->factor[pair] * a;
    return k->factor[pair] > 0;
}

static int mode_after(const contacts *k, int pair, int which)
{
    if (k->mode[pair] == OFF)
        return ON;
    if (which == 0)
        return OFF;
    return k->mode[pair] == ON ? CLIPPED : ON;
}

/* One extrapolated step of the modified midpoint rule; returns the error of position and velocity in clearances. */
static real step(const scene *s, const contacts *k, real t, const real *z, const real *slope, real h, real *out)
{
    real older[COLUMNS][6], row[COLUMNS][6], error = 0;
    for (int j = 0; j < COLUMNS; j++) {
        int n = 2 * (j + 1);
        real w = h / n, a[6], b[6], f[6];
        for (int i = 0; i < 6; i++) {
            a[i] = z[i];
            b[i] = z[i] + w * slope[i];
        }
        for (int m = 1; m < n; m++) {
            rhs(s, k, t + m * w, b, f);
            for (int i = 0; i < 6; i++) {
                real next = a[i] + 2 * w * f[i];
                a[i] = b[i];
                b[i] = next;
            }
        }
        rhs(s, k, t + h, b, f);
        for (int i = 0; i < 6; i++) {
            row[0][i] = (a[i] + b[i] + w * f[i]) / 2;
            for (int m = 0; m < j; m++) {
                real ratio = (real)(j + 1) / (j - m);
                row[m + 1][i] = row[m][i] + (row[m][i] - older[m][i]) / (ratio * ratio - 1);
            }
        }
        memcpy(older, row, sizeof row);
    }
    real length = s->gx < s->gy ? s->gx : s->gy, speed = SQRT(10 * length);
    real radius = SQRT(s->width * s->width + s->height * s->height) / 2;
    for (int i = 0; i < 6; i++) {
        out[i] = row[COLUMNS - 1][i];
        real e = ABS(out[i] - row[COLUMNS - 2][i]) / (i < 3 ? length : speed) * (i % 3 == 2 ? radius : 1);
        error = e > error || e != e ? e : error;
    }
    return error;
}

/* Fastest rate in 1/s of the contacts that act: oscillation or decay. */
static real contact_rate(const scene *s, const contacts *k, const gaps *g)
{
    real stiffness = 0, damping = 0, radius2 = (s->width * s->width + s->height * s->height) / 4;
    real light = s->inertia / radius2 < s->mass ? s->inertia / radius2 : s->mass;
    for (int i = 0; i < PAIRS; i++) {
        if (k->mode[i] != ON)
            continue;
        real d = g->d[i] > 0 ? g->d[i] : 0;
        stiffness += s->exponent == 1 ? s->stiffness : s->exponent * s->stiffness * POW(d, s->exponent - 1);
        damping += s->law == KELVIN_VOIGT ? s->damping : k->factor[i] * elastic(s, d);
    }
    real oscillation = SQRT(stiffness / light), decay = damping / light;
    return oscillation > decay ? oscillation : decay;
}

typedef struct {
    const scene *s;
    const contacts *k;
    real t;
    const real *z, *slope;
    int pair, which;
} probe;

/* Writes a guard (v[0]) and its slope (v[1]) at t + x, computed by a separate step. */
static void at(const probe *p, real x, real *v)
{
    real z[6];
    gaps g;
    step(p->s, p->k, p->t, p->z, p->slope, x, z);
    measure(p->s, p->k, p->t + x, z, &g);
    guard(p->s, p->k, &g, p->pair, p->which, v);
}

/* Point in [0, h] where the guard's slope falls through zero. */
static real summit(const probe *p, real h)
{
    real low = 0, high = h, v[2];
    for (int i = 0; i < 60; i++) {
        real x = (low + high) / 2;
        at(p, x, v);
        if (v[0] > 0)
            return x; /* a point with a positive value is enough */
        if (v[1] > 0)
            low = x;
        else
            high = x;
    }
    return high;
}

/* Point in [0, h] near the lowest value of a guard that falls first and rises later; this value is negative by far more
 * than rounding noise. */
static real valley(const probe *p, real h)
{
    real low = 0, high = h, v[2] = {0, 0};
    for (int i = 0; i < 20; i++) {
        real x = (low + high) / 2;
        at(p, x, v);
        if (v[0] <= 0 && v[1] < 0)
            low = x;
        else
            high = x;
    }
    return low;
}

/* Point just above the root in [low, high] of a guard that is `start` <= 0 at low and `value` > 0 at high, by the
 * Illinois method and bisection. */
static real root(const probe *p, real low, real start, real high, real value)
{
    real below = start < 0 ? start : -1e-30L, v[2] = {0, 0};
    int side = 0;
    for (int i = 0; i < 200 && high - low > 1e-19L + 1e-18L * p->t; i++) {
        real x = i < 40 ? (below * high - value * low) / (below - value) : (low + high) / 2;
        if (!(x > low && x < high))
            x = (low + high) / 2;
        at(p, x, v);
        if (v[0] > 0) {
            high = x;
            value = v[0];
            if (side == 1)
                below /= 2;
            side = 1;
        } else {
            low = x;
            below = v[0] < 0 ? v[0] : -1e-30L;
            if (side == -1)
                value /= 2;
            side = -1;
        }
    }
    return high;
}

/* First event in the step [t, t + h] that ends with gaps `end`; returns its time after t, or -1. */
static real first_event(const scene *s, const contacts *k, real t, const real *z, const real *slope, const gaps *begin,
                        const gaps *end, real h, int *pair, int *which)
{
    real best = -1;
    for (int i = 0; i < PAIRS; i++) {
        for (int w = 0; w < 2; w++) {
            real a[2], b[2];
            if (!guard(s, k, begin, i, w, a) || !guard(s, k, end, i, w, b))
                continue;
            probe p = {s, k, t, z, slope, i, w};
            real high = -1, value = b[0];
            if (b[0] > 0) {
                high = h;
            } else if (a[1] > 0 && b[1] < 0 && a[0] + 2 * a[1] * h > 0 && b[0] - 2 * b[1] * h > 0) {
                real v[2] = {0, 0}, x = summit(&p, h);
                at(&p, x, v);
                if (v[0] > 0) {
                    high = x;
                    value = v[0];
                }
            }
            if (high < 0)
                continue;
            real low = 0, start[2] = {a[0], a[1]};
            if (a[1] < 0) {
                low = valley(&p, high);
                at(&p, low, start);
            }
            real x = root(&p, low, start[0], high, value);
            if (best < 0 || x < best) {
                best = x;
                *pair = i;
                *which = w;
            }
        }
    }
    return best;
}

static void emit(const scene *s, const real *z)
{
    real co = COS(z[2]), si = SIN(z[2]);
    double row[3] = {(double)(z[0] - co * s->rx + si * s->ry), (double)(z[1] - si * s->rx - co * s->ry), (double)z[2]};
    fwrite(row, sizeof *row, 3, stdout);
}

static void run(const scene *s, real tol, real cap)
{
    contacts k;
    memset(&k, 0, sizeof k);
    real z[6], y[6], slope[6], t = 0, guess = 1e-4L;
    long steps = 0, events = 0, status = 0, rows = (long)(s->end / s->output + 0.5L) + 1, row = 0;
    memcpy(z, s->initial, sizeof z);
    evaluations = 0;
    /* rows are kept until the run ends, because the header in front of them has its counts */
    real(*kept)[6] = malloc(rows * sizeof *kept);
    memcpy(kept[row++], z, sizeof z);
    while (row < rows && !status) {
        gaps begin, end;
        measure(s, &k, t, z, &begin);
        rhs(s, &k, t, z, slope);
        real rate = contact_rate(s, &k, &begin), target = row * s->output, h = guess, error;
        real longest = rate > 1000 ? cap / rate : cap / 1000;
        int last;
        for (;;) {
            h = h < longest ? h : longest;
            last = t + h >= target;
            if (last)
                h = target - t;
            error = step(s, &k, t, z, slope, h, y);
            if (error <= tol)
                break;
            real shrink = error == error ? POW(tol / error, (real)1 / 16) * 0.9L : 0.1L;
            h *= shrink < 0.1L ? 0.1L : shrink;
            if (h < 1e-17L) {
                status = 1;
                break;
            }
        }
        steps++;
        real grow = error > 0 ? POW(tol / error, (real)1 / 16) * 0.9L : 3;
        grow = grow > 3 ? 3 : grow;
        guess = last && grow >= 1 && guess > h * grow ? guess : h * grow;
        measure(s, &k, t + h, y, &end);
        int pair = 0, which = 0;
        real x = first_event(s, &k, t, z, slope, &begin, &end, h, &pair, &which);
        if (x >= 0) {
            step(s, &k, t, z, slope, x, y);
            measure(s, &k, t + x, y, &end);
            memcpy(z, y, sizeof z);
            t += x;
            int next = mode_after(&k, pair, which);
            if (k.mode[pair] == OFF && s->law == RESTITUTION)
                k.factor[pair] = s->damping / (end.rate[pair] > s->floor ? end.rate[pair] : s->floor);
            if (k.mode[pair] == OFF && s->law == CONSTANT_FACTOR)
                k.factor[pair] = s->damping;
            k.mode[pair] = next;
            events++;
        } else {
            memcpy(z, y, sizeof z);
            t = last ? target : t + h;
            if (last)
                memcpy(kept[row++], z, sizeof z);
        }
    }
    double header[5] = {(double)status, (double)steps, (double)evaluations, (double)events, (double)row};
    fwrite(header, sizeof *header, 5, stdout);
    for (long i = 0; i < row; i++)
        emit(s, kept[i]);
    fflush(stdout);
    free(kept);
}

static int number(real *out)
{
    double value;
    if (scanf("%lf", &value) != 1)
        return 0;
    *out = value;
    return 1;
}

static int read_scene(scene *s, real perturbation)
{
    real law, count, pose[6];
    real *first[] = {&s->width, &s->height, &s->gx, &s->gy, &s->mass, &s->inertia, &s->gravity, &s->arm, &s->rx, &s->ry,
                     &s->stiffness, &s->exponent, &s->damping, &s->floor, &law, &s->end, &s->output};
    for (unsigned i = 0; i < sizeof first / sizeof *first; i++)
        if (!number(first[i]))
            return 0;
    for (int i = 0; i < 6; i++)
        if (!number(&pose[i]))
            return 0;
    if (!number(&count) || count > HARMONICS)
        return 0;
    s->law = (int)law;
    s->count = (int)count;
    for (int i = 0; i < s->count; i++) {
        harmonic *load = &s->load[i];
        if (!(number(&load->fx) && number(&load->fy) && number(&load->omega) && number(&load->phase) && number(&load->moment)))
            return 0;
    }
    pose[0] += perturbation * (s->gx < s->gy ? s->gx : s->gy);
    real co = COS(pose[2]), si = SIN(pose[2]), ox = co * s->rx - si * s->ry, oy = si * s->rx + co * s->ry;
    memcpy(s->initial, pose, sizeof pose);
    s->initial[0] += ox;
    s->initial[1] += oy;
    s->initial[3] -= pose[5] * oy;
    s->initial[4] += pose[5] * ox;
    return 1;
}

int main(int argc, char **argv)
{
    if (argc != 4) {
        fprintf(stderr, "usage: %s TOL CAP PERTURBATION < scenes > rows\n", argv[0]);
        return 2;
    }
    scene s;
    while (read_scene(&s, atof(argv[3])))
        run(&s, atof(argv[1]), atof(argv[2]));
    return 0;
}
