/* The beginning of our C: what follows it in one text are pairs.c, qp.c, chain.c and step.c. */

#include <math.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))

typedef long long Index;

/* What functions return; see Code in __init__.py. */
enum {
    DONE, NO_VALUE, INFEASIBLE, INACCURATE, UNSETTLED, FAILED, TOO_FAR, NOT_PROVEN, ELSEWHERE, CROWDED, OVERLAPPING,
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
