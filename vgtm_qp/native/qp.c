/* The step of a short arm, or of one in joint space, in one call: condense, solve, check, settle.

   Every formula of the arm and its curve is a function that CasADi generates; here are the loops and the dense algebra
   between them. A Fused belongs to one resolver: nothing is static, so that threads with a resolver each are safe.
   Matrices are row by row. */

#include <daqp/api.h>

typedef struct {
    /* Numbers of: unknowns n; actuators n_a; columns of the free nodes; least-squares rows L; rows of the tip, of
       stations, of legs, of clearance; control vertices, torsion coordinates; coordinates of q. */
    int unknowns, actuators, nodes, squares, tips, hard, legs, near, vertices, torsion, coordinates;
    /* Whether q moves with the nodes; a row of clearance names this many nodes. */
    int by_nodes, slots;
    /* Root of the node rate's weight, inverted; weights (n_a) of the actuators' changes. */
    double scale;
    const double *actuator_weight;
    /* Distance from a bound, and remaining path, that count as zero; worst condition of a gain. */
    double at_bound, left, worst_condition;
    int settling_steps, closing_steps;
    double too_far, small_error;
    const double *levers;          /* (m) lengths to compare the equalities by */

    /* (StepGraph.inputs) -> results of row_function; (q, lower, upper) -> (closer q, quantities, errors);
       (StepGraph.inputs, gone) -> results of missing_function. */
    Kernel condense, close, missing;
    void (*quadprog)(DAQPResult *, DAQPProblem *, DAQPSettings *);
    void (*defaults)(DAQPSettings *);
    /* Another solver instead, or null: it sets x, multipliers and iterations, and returns a code as above. */
    int (*other)(void);
    double feasibility;

    /* Where actuators move nodes by twists; null elsewhere. Then the stack has no rows of the nodes, and its entries for
       the actuators are products of wrenches and twists. */
    const double *twists;          /* (n_a, 6): turn, and velocity at the origin */
    const double *free, *known;    /* (N - N_c, 3) free nodes, and their motions with the base */
    const double *wrenches;        /* (n_e + L, 6): of the rows of the tip, then of the stack */
    const double *tip_rates;       /* (n_e): the last column of the rows of the tip */
    const int *movers, *row_movers;    /* (N - N_c), (n_e + L): numbers of actuators, from the first, that move them */

    double *stack;
    const double *linear, *curvature, *offset, *normal, *leg_rows, *leg_lower;
    const int *hard_at;            /* (H) columns of the stack */
    const double *curve_hessian;   /* (D, D) */
    const double *goal_pull, *goal_weight;     /* (V, 3), (V) of the control vertices' goals */
    int places;
    const int *place, *of;         /* (E): coordinates of q, and those of a motion whose shares change them */
    const double *share;

    const Index *near_nodes;       /* (R, slots) */
    const double *near_rows;       /* (R, slots, 3) */
    const double *near_lower;      /* (R) */
    const int *node_column;        /* (N), -1 for nodes of the base */

    double *hessian, *gradient;                /* (n, n), (n) */
    double *constraint, *lower, *upper;        /* (rows, n), (n + rows) */
    int *sense;
    double *x, *multipliers;                   /* (n), (n + rows) */

    double *q, *points;                        /* what close and missing read: q, and (V, 3) */
    double *gone;                              /* (1) */
    const double *progress, *velocity, *spin;  /* (1), (3), (3) */
    const double *closer, *errors, *missed;
    double *torsions;                          /* (T) changes */
    double *started, *started_points;          /* q and the curve before they were settled */

    /* Tolerances of quantities and equalities, greatest error at the start, and errors at which the iterations end. */
    double member, tip, start, enough_length, enough_tip;

    double primal, dual, reached, furthest, off;
    int flag, iterations;
    double *work;
} Fused;

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

/* Numbers that sum up nodes: their number, places (3), products of these (xx, xy, xz, yy, yz, zz), known motions (3) and
   the moments of these (3). */
enum { SUMS = 16 };

static void cross(const double *a, const double *b, double *c)
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

/* Entries of the stack and of the tip's rows for actuators that move nodes by twists. */
static void expand(Fused *f)
{
    int n = f->unknowns, count = f->actuators, rows = f->squares;
    for (int i = 0; i < count; i++)
        for (int k = 0; k < rows; k++)
            f->stack[i * rows + k] =
                i < f->row_movers[f->tips + k] ? dot(f->wrenches + 6 * (f->tips + k), f->twists + 6 * i, 6) : 0.0;
    for (int k = 0; k < f->tips; k++) {
        double *row = f->constraint + k * n;
        memset(row, 0, sizeof(double) * n);
        for (int i = 0; i < f->row_movers[k]; i++) row[i] = dot(f->wrenches + 6 * k, f->twists + 6 * i, 6);
        row[n - 1] = f->tip_rates[k];
    }
}

/* Hessian and gradient of the node rate where actuators move nodes by twists. An actuator moves the nodes of those
   after it, too: sums over the nodes that it moves take the place of a Jacobian. */
static void node_rate(Fused *f)
{
    int n = f->unknowns, count = f->actuators;
    double *sums = f->work, weight = 1.0 / (f->scale * f->scale), moment[3];
    memset(sums, 0, sizeof(double) * SUMS * (count + 1));
    for (int k = 0; k < f->nodes / 3; k++) {
        const double *x = f->free + 3 * k, *known = f->known + 3 * k;
        double *s = sums + SUMS * f->movers[k];
        s[0] += 1.0;
        cross(x, known, moment);
        for (int a = 0, p = 4; a < 3; a++) {
            s[1 + a] += x[a];
            s[10 + a] += known[a];
            s[13 + a] += moment[a];
            for (int b = a; b < 3; b++) s[p++] += x[a] * x[b];
        }
    }
    for (int j = count - 1; j >= 0; j--) {
        const double *s = sums + SUMS * (j + 1), *w = f->twists + 6 * j, *v = w + 3;
        double force[6], turned[3], trace = s[4] + s[7] + s[9];
        cross(s + 1, v, force);
        cross(w, s + 1, turned);
        force[0] += trace * w[0] - s[4] * w[0] - s[5] * w[1] - s[6] * w[2];
        force[1] += trace * w[1] - s[5] * w[0] - s[7] * w[1] - s[8] * w[2];
        force[2] += trace * w[2] - s[6] * w[0] - s[8] * w[1] - s[9] * w[2];
        for (int a = 0; a < 3; a++) force[3 + a] = turned[a] + s[0] * v[a];
        for (int i = 0; i <= j; i++)
            f->hessian[i * n + j] = f->hessian[j * n + i] = weight * dot(force, f->twists + 6 * i, 6);
        f->gradient[j] = weight * (dot(w, s + 13, 3) + dot(v, s + 10, 3));
        for (int k = 0; k < SUMS; k++) sums[SUMS * j + k] += s[k];
    }
}

/* Hessian and gradient of the objective: the Gram matrix of the stack, whose last row is its constant, and the parts
   of the curve and the actuators. Equalities have no weight. */
static void objective(Fused *f)
{
    int n = f->unknowns, count = f->actuators, rows = f->squares, last = n - 1, curve = last - count;
    double *free_rows = f->work, *H = f->hessian, *g = f->gradient;
    memset(H, 0, sizeof(double) * n * n);
    memset(g, 0, sizeof(double) * n);
    if (f->twists) node_rate(f);
    double *to = free_rows;
    for (int i = 0; i < n; i++)
        for (int k = 0, from = 0; k <= f->hard; k++) {
            int until = k < f->hard ? f->hard_at[k] : rows;
            memcpy(to, f->stack + i * rows + from, sizeof(double) * (until - from));
            to += until - from;
            from = until + 1;
        }
    rows -= f->hard;
    for (int i = 0; i < n; i++) {
        int to = i < last ? i + 1 : last;
        for (int j = 0; j < to; j++) {
            double sum = dot(free_rows + i * rows, free_rows + j * rows, rows);
            if (i < last) H[j * n + i] = H[i * n + j] += sum;
            else g[j] += sum + f->linear[j];
        }
    }
    g[last] = f->linear[last];
    for (int k = 0; k < n; k++) H[last * n + k] = H[k * n + last] = 0.0;
    H[last * n + last] = f->curvature[0];
    for (int k = 0; k < count; k++) H[k * n + k] += f->actuator_weight[k];
    if (!curve) return;
    int size = 5 + curve;
    for (int i = 0; i < curve; i++)
        for (int j = 0; j < curve; j++) {
            /* The first free coordinate moves the second control vertex along the normal. */
            double sum = 0.0;
            for (int a = 0; a < (i ? 1 : 3); a++)
                for (int b = 0; b < (j ? 1 : 3); b++)
                    sum += (i ? 1.0 : f->normal[a]) * (j ? 1.0 : f->normal[b])
                        * f->curve_hessian[(i ? 5 + i : 3 + a) * size + (j ? 5 + j : 3 + b)];
            H[(count + i) * n + count + j] += sum;
        }
    for (int k = 3; k < 3 * f->vertices; k++) {
        double pull = f->goal_pull[k] + f->goal_weight[k / 3] * f->offset[k];
        if (k < 6) g[count] += pull * f->normal[k - 3];
        else g[count + k - 5] += pull;
    }
}

/* Rows after those of the tip, which `condense` wrote in place: stations, legs, clearances. */
static void constrain(Fused *f)
{
    int n = f->unknowns, count = f->actuators, last = n - 1;
    double *row = f->constraint + f->tips * n;
    double *lower = f->lower + n + f->tips, *upper = f->upper + n + f->tips;
    for (int k = 0; k < f->hard; k++, row += n, lower++, upper++) {
        for (int i = 0; i < last; i++) row[i] = f->stack[i * f->squares + f->hard_at[k]];
        row[last] = 0.0;
        *lower = *upper = -f->stack[last * f->squares + f->hard_at[k]];
    }
    for (int k = 0; k < f->legs; k++, row += n, lower++) {
        memset(row, 0, sizeof(double) * n);
        memcpy(row + count, f->leg_rows + k * (last - count), sizeof(double) * (last - count));
        *lower = f->leg_lower[k];
    }
    for (int k = 0; k < f->near; k++, row += n, lower++) {
        const Index *nodes = f->near_nodes + k * f->slots;
        const double *parts = f->near_rows + 3 * k * f->slots;
        double known = 0.0;
        memset(row, 0, sizeof(double) * n);
        for (int s = 0; s < f->slots; s++) {
            int column = f->node_column[nodes[s]];
            const double *part = parts + 3 * s;
            if (column < 0 || (part[0] == 0.0 && part[1] == 0.0 && part[2] == 0.0)) continue;
            if (f->twists) {
                double wrench[6] = {0.0, 0.0, 0.0, part[0], part[1], part[2]};
                cross(f->free + column, part, wrench);
                for (int i = 0; i < f->movers[column / 3]; i++) row[i] += dot(wrench, f->twists + 6 * i, 6);
                known += dot(part, f->known + column, 3);
                continue;
            }
            for (int i = 0; i < count; i++)
                row[i] += f->scale * dot(part, f->stack + i * f->squares + column, 3);
            known += f->scale * dot(part, f->stack + last * f->squares + column, 3);
        }
        *lower = f->near_lower[k] - known;
    }
}

/* Norm of the answer's violations of its bounds. Relative to the forces, the greater of two norms: of the
   stationarity, and of the multipliers times their distances from their bounds. */
static void residuals(Fused *f, int rows)
{
    int n = f->unknowns;
    double beyond = 0.0, off = 0.0, loose = 0.0, *force = f->work;
    const double *y = f->multipliers;
    for (int k = 0; k < n; k++) force[k] = dot(f->hessian + k * n, f->x, n) + f->gradient[k] + y[k];
    for (int k = 0; k < n + rows; k++) {
        const double *row = f->constraint + (k - n) * n;
        double value = k < n ? f->x[k] : dot(row, f->x, n);
        double out = fmax(value - f->upper[k], f->lower[k] - value);
        /* A comparison with NaN fails. */
        if (!(out <= 0.0)) beyond += out * out;
        double slack = y[k] * fmin(fmax(y[k] > 0.0 ? f->upper[k] - value : value - f->lower[k], 0.0), 1.0);
        loose += slack * slack;
        if (k >= n && y[k] != 0.0)
            for (int i = 0; i < n; i++) force[i] += y[k] * row[i];
    }
    for (int k = 0; k < n; k++) off += force[k] * force[k];
    f->primal = sqrt(beyond);
    /* NaN stays. */
    f->dual = sqrt(loose > off ? loose : off) / (1.0 + norm(f->gradient, n) + norm(y, n + rows));
}

/* Condense the QP, but for its rows of clearance, at the state that was loaded. */
static int assemble(Fused *f)
{
    if (call(&f->condense)) return NO_VALUE;
    if (f->twists) expand(f);
    objective(f);
    return DONE;
}

/* Solve the QP that was assembled with its rows of clearance. */
static int answer(Fused *f)
{
    int rows = f->tips + f->hard + f->legs + f->near;
    constrain(f);
    if (f->other) {
        int code = f->other();
        if (code == DONE) residuals(f, rows);
        return code;
    }
    DAQPProblem problem = {f->unknowns, f->unknowns + rows, f->unknowns, f->hessian, f->gradient,
                           f->constraint, f->upper, f->lower, f->sense};
    DAQPSettings settings;
    DAQPResult result;
    memset(&result, 0, sizeof(result));
    f->defaults(&settings);
    settings.primal_tol = f->feasibility;
    settings.eps_prox = 0.0;
    result.x = f->x;
    result.lam = f->multipliers;
    f->quadprog(&result, &problem, &settings);
    f->flag = result.exitflag;
    f->iterations = result.iter;
    if (result.exitflag == EXIT_INFEASIBLE) return INFEASIBLE;
    residuals(f, rows);
    return DONE;
}

/* Condense the QP at the state that was loaded, and solve it. */
EXPORT int solve(Fused *f)
{
    int code = assemble(f);
    return code ? code : answer(f);
}

/* The greatest displacement of a node's coordinate by the changes x of the actuators, with the known motions if `whole`;
   NaN stays. Actuators move nodes by twists. */
static double furthest_by_twists(Fused *f, const double *x, int whole)
{
    double *twist = f->work, furthest = 0.0, turned[3];
    memset(twist, 0, sizeof(double) * 6);
    for (int i = 0; i < f->actuators; i++)
        for (int a = 0; a < 6; a++) twist[6 * (i + 1) + a] = twist[6 * i + a] + x[i] * f->twists[6 * i + a];
    for (int k = 0; k < f->nodes; k += 3) {
        const double *of = twist + 6 * f->movers[k / 3];
        cross(of, f->free + k, turned);
        for (int a = 0; a < 3; a++) {
            double moved = fabs(turned[a] + of[3 + a] + (whole ? f->known[k + a] : 0.0));
            if (moved > furthest || moved != moved) furthest = moved;
        }
    }
    return furthest;
}

/* Move q and the curve by the changes x of the unknowns; `whole` adds the motions by residuals. */
static void advance(Fused *f, const double *x, int whole)
{
    int count = f->actuators, last = f->unknowns - 1;
    double *moved = f->work;
    if (f->twists) f->furthest = furthest_by_twists(f, x, whole);
    else {
        memset(moved, 0, sizeof(double) * f->nodes);
        if (whole) memcpy(moved, f->stack + last * f->squares, sizeof(double) * f->nodes);
        for (int i = 0; i < count; i++)
            for (int k = 0; k < f->nodes; k++) moved[k] += x[i] * f->stack[i * f->squares + k];
        f->furthest = 0.0;
        for (int k = 0; k < f->nodes; k++) {
            moved[k] *= f->scale;
            /* NaN stays. */
            if (fabs(moved[k]) > f->furthest || moved[k] != moved[k]) f->furthest = fabs(moved[k]);
        }
    }
    const double *coordinates = f->by_nodes ? moved : x;
    for (int k = 0; k < f->places; k++) f->q[f->place[k]] += f->share[k] * coordinates[f->of[k]];
    if (!f->vertices) return;
    const double *free = x + count;
    if (whole)
        for (int k = 0; k < 3 * f->vertices; k++) f->points[k] += f->offset[k];
    for (int k = 0; k < 3; k++) f->points[3 + k] += f->normal[k] * free[0];
    for (int k = 0; k < 3 * (f->vertices - 2); k++) f->points[6 + k] += free[1 + k];
    for (int k = 0; k < f->torsion; k++) f->torsions[k] += free[1 + 3 * (f->vertices - 2) + k];
}

/* In place, the Cholesky factor of A (n, n) below its diagonal; 0 if A is not positive definite. */
static int factorise(double *A, int n)
{
    for (int j = 0; j < n; j++) {
        double pivot = A[j * n + j] - dot(A + j * n, A + j * n, j);
        if (!(pivot > 0.0)) return 0;
        pivot = sqrt(pivot);
        A[j * n + j] = pivot;
        for (int i = j + 1; i < n; i++) A[i * n + j] = (A[i * n + j] - dot(A + i * n, A + j * n, j)) / pivot;
    }
    return 1;
}

/* The gain of settling_gain in factors: L of the Hessian of the free unknowns, half = rows L^-T, and the factor of
   half half^T. */
typedef struct {
    int free, *of;
    double *factor, *half, *normal;
} Gain;

static int gain_of(Fused *f, Gain *g, double *work)
{
    int n = f->unknowns, m = f->tips + f->hard, last = n - 1, free = 0;
    g->factor = work;
    g->half = work + n * n;
    g->normal = g->half + m * n;
    g->of = (int *)(g->normal + m * m);
    for (int k = 0; k < last; k++)
        if (k >= f->actuators || (f->x[k] > f->lower[k] + f->at_bound && f->x[k] < f->upper[k] - f->at_bound))
            g->of[free++] = k;
    g->free = free;
    if (free < m) return 0;
    for (int i = 0; i < free; i++)
        for (int j = 0; j <= i; j++) g->factor[i * free + j] = f->hessian[g->of[i] * n + g->of[j]];
    if (!factorise(g->factor, free)) return 0;
    for (int k = 0; k < m; k++) {
        double *half = g->half + k * free;
        for (int i = 0; i < free; i++)
            half[i] = (f->levers[k] * f->constraint[k * n + g->of[i]] - dot(g->factor + i * free, half, i))
                / g->factor[i * free + i];
    }
    for (int i = 0; i < m; i++)
        for (int j = 0; j <= i; j++) g->normal[i * m + j] = dot(g->half + i * free, g->half + j * free, free);
    if (!factorise(g->normal, m)) return 0;
    double least = INFINITY, greatest = 0.0;
    for (int i = 0; i < m; i++) {
        least = fmin(least, g->normal[i * m + i]);
        greatest = fmax(greatest, g->normal[i * m + i]);
    }
    return greatest * greatest < f->worst_condition * least * least;
}

/* The least changes (n) of the unknowns that correct the errors `missing` (m). */
static void change_by(const Fused *f, const Gain *g, const double *missing, double *change, double *work)
{
    int n = f->unknowns, m = f->tips + f->hard, free = g->free;
    double *shares = work, *part = work + m;
    for (int i = 0; i < m; i++)
        shares[i] = (f->levers[i] * missing[i] - dot(g->normal + i * m, shares, i)) / g->normal[i * m + i];
    memset(part, 0, sizeof(double) * free);
    for (int i = m - 1; i >= 0; i--) {
        shares[i] /= g->normal[i * m + i];
        for (int j = 0; j < i; j++) shares[j] -= g->normal[i * m + j] * shares[i];
        for (int k = 0; k < free; k++) part[k] += shares[i] * g->half[i * free + k];
    }
    memset(change, 0, sizeof(double) * n);
    for (int i = free - 1; i >= 0; i--) {
        part[i] /= g->factor[i * free + i];
        for (int j = 0; j < i; j++) part[j] -= g->factor[i * free + j] * part[i];
        change[g->of[i]] = part[i];
    }
}

/* Settle q and the curve: quantities exact, equalities satisfied. Each iteration closes the quantities by a step of
   Newton's method, and then corrects the equalities: closing again in between would not change what they miss. Steps (n)
   after the first have Broyden's updates of the gain, in the form that needs the steps alone. */
EXPORT int settle(Fused *f)
{
    int n = f->unknowns, m = f->tips + f->hard, steps = 0, may_correct = 1, is_measured = 0;
    double *step = f->work + f->nodes + SUMS * (f->actuators + 1) + n * f->squares;
    double *work = step + (f->settling_steps + 1) * n;
    Gain gain;
    for (int count = 0; count <= f->closing_steps + f->settling_steps; count++) {
        if (call(&f->close)) return UNSETTLED;
        /* The norm is NaN if one of the errors is. */
        double error = f->errors[0];
        if (!(error < f->too_far && f->errors[1] < INFINITY)) return UNSETTLED;
        int is_closed = error <= f->enough_length;
        if (!is_closed) memcpy(f->q, f->closer, sizeof(double) * f->coordinates);
        else if (is_measured) break;
        if (error > f->small_error) continue;
        if (call(&f->missing)) return UNSETTLED;
        f->off = 0.0;
        for (int k = 0; k < m; k++) f->off += f->levers[k] * f->missed[k] * f->levers[k] * f->missed[k];
        f->off = sqrt(f->off);
        if (!(f->off <= f->start)) return UNSETTLED;
        is_measured = 1;
        if (!steps && f->off > f->enough_tip) may_correct = gain_of(f, &gain, work);
        if (f->off <= f->enough_tip || !may_correct || steps == f->settling_steps) {
            if (is_closed) break;
            continue;
        }
        double *next = step + steps * n;
        change_by(f, &gain, f->missed, next, work + n * n + m * (n + m) + n);
        for (int k = 0; k < steps; k++) {
            const double *before = step + k * n;
            double share = dot(before, next, n) / dot(before, before, n);
            if (k < steps - 1)
                for (int i = 0; i < n; i++) next[i] += share * before[n + i];
            else if (share < 1.0)
                for (int i = 0; i < n; i++) next[i] /= 1.0 - share;
        }
        steps++;
        advance(f, next, 0);
        is_measured = 0;
    }
    return is_measured && f->errors[0] <= f->member && f->off <= f->tip ? DONE : UNSETTLED;
}

/* Follow the answer of the QP from q, and settle. */
static int depart(Fused *f, double tolerance)
{
    if (!(f->primal <= tolerance && f->dual <= tolerance)) return INACCURATE;
    double before = *f->progress, reached = fmin(fmax(before + f->x[f->unknowns - 1], 0.0), 1.0), fastest = 0.0;
    for (int k = 0; k < 3; k++) fastest = fmax(fastest, fmax(fabs(f->velocity[k]), fabs(f->spin[k])));
    /* Interior-point solvers stop just short of the end; the arm would need one more step. */
    if ((1.0 - reached) * fastest <= f->left) reached = 1.0;
    f->reached = reached;
    *f->gone = reached - before;
    memcpy(f->q, f->condense.arg[0], sizeof(double) * f->coordinates);
    memcpy(f->points, f->condense.arg[3], sizeof(double) * 3 * f->vertices);
    memset(f->torsions, 0, sizeof(double) * f->torsion);
    advance(f, f->x, 1);
    memcpy(f->started, f->q, sizeof(double) * f->coordinates);
    memcpy(f->started_points, f->points, sizeof(double) * 3 * f->vertices);
    double furthest = f->furthest;
    int code = settle(f);
    /* Not that of the last correction, which may have failed. */
    f->furthest = furthest;
    return code;
}

/* Solve, follow the answer from q, and settle. */
EXPORT int move(Fused *f, double tolerance)
{
    int code = solve(f);
    return code ? code : depart(f, tolerance);
}
