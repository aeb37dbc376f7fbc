/* The beginning of all our C sources: native.py puts it before each. */

#include <math.h>
#include <string.h>

#define EXPORT __attribute__((visibility("default")))

typedef long long Index;

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

