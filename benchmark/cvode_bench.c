/* CVODE (SUNDIALS) on a bench scene, called from C; the program measures its own time.
 *
 * usage: cvode_bench LAW METHOD ROOTS RTOL T_END OUTPUT_DT REPEATS POSES < parameters
 *   LAW      kv or hc
 *   METHOD   adams (functional iteration), bdf (dense Newton, difference quotients)
 *   ROOTS    1: CVODE's rootfinding locates every change of contact, and CVodeReInit restarts there; 0: no rootfinding
 *   POSES    file for rows of x, y, theta as doubles
 * parameters: width height gx gy mass inertia gravity arm K exponent C-or-lambda, then one harmonic: Fx Fy M omega
 * Prints: one time in s per repeat, then `steps evaluations roots`.
 */
#include <cvode/cvode.h>
#include <math.h>
#include <nvector/nvector_serial.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sundials/sundials_version.h>
#include <sunlinsol/sunlinsol_dense.h>
#include <sunmatrix/sunmatrix_dense.h>
#include <sunnonlinsol/sunnonlinsol_fixedpoint.h>
#include <time.h>

typedef struct {
    double w, h, gx, gy, m, inertia, g, arm, K, n, C, fx, fy, moment, omega;
    int hc, roots, mode[8]; /* with roots, frozen within a step: 0 off, 1 on, 2 clipped */
} scene;

static const int SX[4] = {-1, 1, 1, -1}, SY[4] = {1, 1, -1, -1};

static inline double force(const scene *s, double d, double v)
{
    return s->hc ? s->K * d * sqrt(d) * (1 + s->C * v) : s->K * d + s->C * v;
}

static inline double pushed(const scene *s, int pair, double d, double v)
{
    if (s->roots) /* the mode decides, so that the force does not switch within a step */
        return s->mode[pair] == 1 ? force(s, s->hc && d < 0 ? 0 : d, v) : 0;
    double f = d > 0 ? force(s, d, v) : 0;
    return f > 0 ? f : 0;
}

/* penetration and rate of each pair, and the corners in head axes */
static inline void gaps(const scene *s, const double *y, double c, double si, double *d, double *v, double *arm)
{
    double X = c * y[0] + si * y[1], Y = c * y[1] - si * y[0];
    double VX = c * y[3] + si * y[4], VY = c * y[4] - si * y[3];
    for (int k = 0; k < 4; k++) {
        double px = c * SX[k] * s->w / 2 + si * SY[k] * s->h / 2 - X, py = -si * SX[k] * s->w / 2 + c * SY[k] * s->h / 2 - Y;
        arm[2 * k] = px;
        arm[2 * k + 1] = py;
        d[2 * k] = SY[k] * py - (s->h + s->gy) / 2;
        v[2 * k] = SY[k] * (-VY - y[5] * px);
        d[2 * k + 1] = SX[k] * px - (s->w + s->gx) / 2;
        v[2 * k + 1] = SX[k] * (-VX + y[5] * py);
    }
}

static int rhs(double t, N_Vector yy, N_Vector out, void *data)
{
    const scene *s = data;
    const double *y = N_VGetArrayPointer_Serial(yy);
    double *f = N_VGetArrayPointer_Serial(out), c = cos(y[2]), si = sin(y[2]), fx = 0, fy = 0, torque = 0;
    double d[8], v[8], arm[8];
    gaps(s, y, c, si, d, v, arm);
    for (int k = 0; k < 4; k++) {
        double a = pushed(s, 2 * k, d[2 * k], v[2 * k]) * SY[k], b = pushed(s, 2 * k + 1, d[2 * k + 1], v[2 * k + 1]) * SX[k];
        fy += a;
        fx += b;
        torque += arm[2 * k] * a - arm[2 * k + 1] * b;
    }
    double S = sin(s->omega * t);
    f[0] = y[3];
    f[1] = y[4];
    f[2] = y[5];
    f[3] = (s->fx * S + c * fx - si * fy) / s->m;
    f[4] = (s->fy * S + si * fx + c * fy) / s->m - s->g;
    f[5] = (s->moment * S - s->m * s->g * s->arm + torque) / s->inertia;
    return 0;
}

/* 16 roots: penetration of each pair, and where its force would change sign */
static int guards(double t, N_Vector yy, double *g, void *data)
{
    (void)t;
    const scene *s = data;
    const double *y = N_VGetArrayPointer_Serial(yy);
    double d[8], v[8], arm[8];
    gaps(s, y, cos(y[2]), sin(y[2]), d, v, arm);
    for (int i = 0; i < 8; i++) {
        g[i] = d[i];
        g[8 + i] = s->mode[i] == 0 ? 1 : s->hc ? 1 + s->C * v[i] : d[i] + s->C / s->K * v[i];
    }
    return 0;
}

static void switch_modes(scene *s, const int *found)
{
    for (int i = 0; i < 8; i++) {
        if (found[i])
            s->mode[i] = found[i] > 0 ? 1 : 0;
        else if (found[8 + i] && s->mode[i])
            s->mode[i] = found[8 + i] > 0 ? 1 : 2;
    }
}

static double seconds(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

/* adds the steps and evaluations that CVODE has counted since its last start */
static void count(void *mem, int adams, long *counts)
{
    long steps = 0, calls = 0, jacobian = 0;
    CVodeGetNumSteps(mem, &steps);
    CVodeGetNumRhsEvals(mem, &calls);
    if (!adams)
        CVodeGetNumLinRhsEvals(mem, &jacobian);
    counts[0] += steps;
    counts[1] += calls + jacobian;
}

static int run(scene *s, int adams, double rtol, double end, double dt, double *rows, long *counts)
{
    SUNContext ctx;
    SUNContext_Create(NULL, &ctx);
    N_Vector y = N_VNew_Serial(6, ctx), atol = N_VNew_Serial(6, ctx);
    N_VConst(0, y);
    memset(s->mode, 0, sizeof s->mode);
    for (int i = 0; i < 6; i++) /* poses are about 1e-2, velocities about 1 */
        NV_Ith_S(atol, i) = rtol * (i < 3 ? 1e-3 : 1e-1);
    void *mem = CVodeCreate(adams ? CV_ADAMS : CV_BDF, ctx);
    SUNMatrix A = NULL;
    SUNLinearSolver linear = NULL;
    SUNNonlinearSolver fixed = NULL;
    int code = CVodeInit(mem, rhs, 0, y);
    code |= CVodeSVtolerances(mem, rtol, atol);
    code |= CVodeSetUserData(mem, s);
    code |= CVodeSetMaxNumSteps(mem, 100000000);
    if (adams) {
        fixed = SUNNonlinSol_FixedPoint(y, 0, ctx);
        code |= CVodeSetNonlinearSolver(mem, fixed);
    } else {
        A = SUNDenseMatrix(6, 6, ctx);
        linear = SUNLinSol_Dense(y, A, ctx);
        code |= CVodeSetLinearSolver(mem, linear, A);
    }
    if (s->roots)
        code |= CVodeRootInit(mem, 16, guards);
    long n = lround(end / dt);
    double t = 0;
    memset(counts, 0, 3 * sizeof *counts);
    memcpy(rows, N_VGetArrayPointer_Serial(y), 3 * sizeof(double));
    for (long i = 1; i <= n && code >= 0;) {
        code = CVode(mem, i * dt, y, &t, CV_NORMAL);
        if (code == CV_ROOT_RETURN) {
            int found[16];
            CVodeGetRootInfo(mem, found);
            count(mem, adams, counts);
            counts[2]++;
            switch_modes(s, found);
            code = CVodeReInit(mem, t, y);
            continue;
        }
        memcpy(rows + 3 * i++, N_VGetArrayPointer_Serial(y), 3 * sizeof(double));
    }
    count(mem, adams, counts);
    CVodeFree(&mem);
    if (fixed)
        SUNNonlinSolFree(fixed);
    if (linear) {
        SUNLinSolFree(linear);
        SUNMatDestroy(A);
    }
    N_VDestroy(y);
    N_VDestroy(atol);
    SUNContext_Free(&ctx);
    return code;
}

int main(int argc, char **argv)
{
    if (argc == 2 && !strcmp(argv[1], "--version")) {
        puts(SUNDIALS_VERSION);
        return 0;
    }
    if (argc != 9)
        return 2;
    scene s = {0};
    double *number[] = {&s.w, &s.h, &s.gx, &s.gy, &s.m,      &s.inertia, &s.g,    &s.arm,
                        &s.K, &s.n, &s.C,  &s.fx, &s.fy, &s.moment,  &s.omega};
    for (unsigned i = 0; i < sizeof number / sizeof *number; i++)
        if (scanf("%lf", number[i]) != 1)
            return 2;
    s.hc = !strcmp(argv[1], "hc");
    s.roots = atoi(argv[3]);
    double end = atof(argv[5]), dt = atof(argv[6]);
    long n = lround(end / dt) + 1, counts[3];
    double *rows = calloc(3 * n, sizeof *rows);
    for (int i = 0; i < atoi(argv[7]); i++) {
        double begin = seconds();
        int code = run(&s, !strcmp(argv[2], "adams"), atof(argv[4]), end, dt, rows, counts);
        double took = seconds() - begin;
        if (code < 0) {
            fprintf(stderr, "CVODE: %s\n", CVodeGetReturnFlagName(code));
            return 1;
        }
        printf("%.9f\n", took);
    }
    printf("%ld %ld %ld\n", counts[0], counts[1], counts[2]);
    FILE *file = fopen(argv[8], "wb");
    if (!file)
        return 2;
    fwrite(rows, sizeof *rows, 3 * n, file);
    return fclose(file) ? 2 : 0;
}
