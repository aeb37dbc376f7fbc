/* The beginning of our C: what follows it in one text are hulls.c, pairs.c, working.c, qp.c, chain.c and
   step.c. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))

typedef long long Index;

/* What functions return; see Code in __init__.py. */
enum {
    DONE, NO_VALUE, INFEASIBLE, INACCURATE, UNSETTLED, FAILED, TOO_FAR, NOT_PROVEN, FULL, CROWDED, OVERLAPPING,
    ASKS, FLAWED, OFF_CURVE, TOO_NEAR
};

/* A function that CasADi generates, with its arguments, results and workspaces. */
typedef struct {
    int (*eval)(const double **, double **, Index *, double *, int);
    const double **arg;
    double **res;
    Index *iw;
    double *w;
} Kernel;

static inline int call(const Kernel *kernel)
{
    return kernel->eval(kernel->arg, kernel->res, kernel->iw, kernel->w, 0);
}

static double dot(const double *a, const double *b, int count)
{
    double sum = 0.0;
    for (int k = 0; k < count; k++) sum += a[k] * b[k];
    return sum;
}

static double norm(const double *a, int count)
{
    return sqrt(dot(a, a, count));
}

static void cross(const double *a, const double *b, double *c)
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

/* The lesser of two numbers; NaN if either is NaN. */
static double least_of(double a, double b)
{
    return b >= a || a != a ? a : b;
}

static double square_of(const double *before, const double *after)
{
    double square = 0.0;
    for (int a = 0; a < 3; a++) square += (after[a] - before[a]) * (after[a] - before[a]);
    return square;
}

/* The mean (3) of points (count, 3) by weights of sum 1. */
static void mean_of(const double *points, const double *weights, int count, double *mean)
{
    for (int a = 0; a < 3; a++) {
        mean[a] = 0.0;
        for (int k = 0; k < count; k++) mean[a] += weights[k] * points[3 * k + a];
    }
}

/* The greatest magnitude of numbers; NaN if one is. */
static double greatest(const double *values, int count)
{
    double most[4] = {0.0}, sum = 0.0;
    int k = 0;
    for (; k + 4 <= count; k += 4)
        for (int i = 0; i < 4; i++) most[i] = fabs(values[k + i]) > most[i] ? fabs(values[k + i]) : most[i];
    for (; k < count; k++) most[0] = fmax(most[0], fabs(values[k]));
    for (k = 0; k < count; k++) sum += fabs(values[k]);
    return sum == sum ? fmax(fmax(most[0], most[1]), fmax(most[2], most[3])) : sum;
}

/* In place, rows X (m, w) become A^-1 X; A (m, m) is overwritten. Rows are chosen by their largest entry. */
static void solve_for(double *A, double *X, int m, int w)
{
    for (int j = 0; j < m; j++) {
        int best = j;
        for (int i = j + 1; i < m; i++)
            if (fabs(A[i * m + j]) > fabs(A[best * m + j])) best = i;
        if (best != j) {
            for (int k = j; k < m; k++) { double t = A[j * m + k]; A[j * m + k] = A[best * m + k]; A[best * m + k] = t; }
            for (int k = 0; k < w; k++) { double t = X[j * w + k]; X[j * w + k] = X[best * w + k]; X[best * w + k] = t; }
        }
        double pivot = 1.0 / A[j * m + j];
        for (int i = j + 1; i < m; i++) {
            double factor = A[i * m + j] * pivot;
            if (factor == 0.0) continue;
            for (int k = j + 1; k < m; k++) A[i * m + k] -= factor * A[j * m + k];
            for (int k = 0; k < w; k++) X[i * w + k] -= factor * X[j * w + k];
        }
    }
    for (int j = m - 1; j >= 0; j--) {
        double pivot = 1.0 / A[j * m + j];
        for (int k = 0; k < w; k++) X[j * w + k] *= pivot;
        for (int i = 0; i < j; i++) {
            double factor = A[i * m + j];
            if (factor == 0.0) continue;
            for (int k = 0; k < w; k++) X[i * w + k] -= factor * X[j * w + k];
        }
    }
}
