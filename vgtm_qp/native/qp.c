/* The step of a short arm, or of one in joint space, in one call: condense, solve, check, settle.

   Every formula of the arm and its curve is a function that CasADi generates; here are the loops and the dense algebra
   between them. A Fused belongs to one resolver: nothing is static, so that threads with a resolver each are safe.
   Matrices are row by row. */

#include <daqp/api.h>

typedef struct {
    /* Numbers of: unknowns n, which are actuators n_a, free coordinates of the curve, slacks of an elastic tip and the
       progress; columns of the free nodes; least-squares rows L; rows of the tip, of stations, of legs, of clearance;
       control vertices, torsion coordinates; coordinates of q. */
    int unknowns, actuators, slacks, nodes, squares, tips, hard, legs, near, vertices, torsion, coordinates;
    const double *slack_pull, *slack_weight;   /* gradient and curvature of the slacks' penalty */
    /* Whether q moves with the nodes; a row of clearance names this many nodes. */
    int by_nodes, slots;
    /* Root of the node rate's weight, inverted; weights (n_a) of the actuators' changes. */
    double scale;
    const double *actuator_weight;
    /* Distance from a bound, remaining path, and slack of the tip, that count as zero; worst condition of a gain. */
    double at_bound, left, on_path, worst_condition;
    int settling_steps, closing_steps;
    /* Errors of quantities: beyond the first, Newton's method is not tried; below the second, one step of it leaves so
       little that the equalities can be measured after it; below the third, it leaves nothing. */
    double too_far, small_error, tiny_error;
    const double *levers;          /* (m) lengths to compare the equalities by */
    double lever;                  /* m, to compare torsions with lengths by */

    /* (StepGraph.inputs) -> results of row_function; (q, lower, upper) -> (closer q, quantities, errors);
       (StepGraph.inputs, gone) -> results of missing_function. */
    Kernel condense, close, missing;
    /* (vertices, torsion, base frame) -> a curve that constant tables do not describe, with its rows, and its nodes alone,
       among the arguments of those; without eval where tables do. Whether the results are right: 1, else 0. */
    Kernel curve, curve_nodes;
    const double *curve_is_right, *nodes_are_right;
    void (*quadprog)(DAQPResult *, DAQPProblem *, DAQPSettings *);
    void (*defaults)(DAQPSettings *);
    /* Another solver instead, or null: it sets x, multipliers and iterations, and returns a code of base.h. */
    int (*other)(void);
    double feasibility;

    /* Results of row_function, by name. */
    const double *tip_jacobian, *tip_rate, *linear, *curvature, *offset, *normal, *leg_rows, *leg_lower;
    const double *gaps, *turns, *faces, *bends, *stretches, *moved;
    /* Its last results: gradients and right-hand sides of the elimination, or K and r; or where actuators move nodes by
       twists these (n_a, 6), turn and velocity at the origin, and the free nodes. The others are null. */
    const double *gradients, *rhs, *twists, *free;
    const int *free_node, *movers;         /* (N - N_c): numbers, and how many actuators, from the first, move each */

    /* The elimination, see arm.symbols.EliminationStage: stages, where the rows and nonzeros of each begin, and these; the
       actuator that each quantity is, or -1. No stages: gradients and rhs are K and r. */
    int stages;
    const int *stage_rows, *stage_entries, *stage_quantity, *stage_coordinate, *entry_row, *entry_column, *entry_flat;
    const int *actuator_of;
    double *response, *blocks;             /* (nodes, 1 + n_a): r and K; and work: two blocks of a stage */

    /* Nodes of the tip; of S tracked stations nodes and weights (S, 3), turns R of each, and weights (S, V) of place and
       slope of their points on the curve; weights of the rows of gaps, turns and stretches (L), 1 where they are hard.
       Rows (3 S, D) of the points and of the stretches over a curve that such weights describe only at its end, else
       null. */
    int tip_nodes, stations, turned, spacings;
    const int *tip_node, *station_node;
    const double *station_weight, *curve_weight, *curve_slope, *row_weight;
    const double *point_rows, *stretch_rows;

    double *stack;                         /* (n, L), the last for the constant */
    const int *first_row;                  /* (n) the first row in which each column can have entries */
    const int *hard_at;                    /* (H) rows that are equalities */
    const double *curve_hessian;   /* (D, D) */
    const double *goal_pull, *goal_weight;     /* (V, 3), (V) of the control vertices' goals */
    int places;
    const int *place, *of;         /* (E): coordinates of q, and those of a motion whose shares change them */
    const double *share;

    int *near_nodes;               /* (R, slots) */
    double *near_rows;             /* (R, slots, 3) */
    double *near_lower;            /* (R) */
    const int *node_column;        /* (N), -1 for nodes of the base */

    double *hessian, *gradient;                /* (n, n), (n) */
    double *constraint, *lower, *upper;        /* (rows, n), (n + rows) */
    int *sense;
    double *x, *multipliers;                   /* (n), (n + rows) */
    Working *working;
    /* Of each unknown and row: -1 where it is at its lower bound, 1 where at its upper one, else 0; its column in the
       working set, or -1. */
    int *side, *column, *at;                   /* and the unknowns that settling holds, (n) */

    double *q, *points;                        /* what close and missing read: q, and (V, 3) */
    double *gone;                              /* (1) */
    const double *progress, *velocity, *spin;  /* (1), (3), (3) */
    const double *closer, *errors;
    double *torsions;                          /* (T) */
    double *started, *started_points, *started_torsions;   /* q and the curve before they were settled */

    /* Tolerances of quantities and equalities, greatest error at the start, and errors at which the iterations end. */
    double member_error, tip_error, start, enough_length, enough_tip;

    double primal, dual, reached, furthest, off;
    int flag, iterations, held;
    double *work;
} Fused;

/* The number of free coordinates of the curve. */
static int free_of(const Fused *f)
{
    return f->unknowns - 1 - f->slacks - f->actuators;
}

/* The greatest slack of the tip in the answer. */
static double tip_slack(const Fused *f)
{
    double most = 0.0;
    for (int k = f->unknowns - 1 - f->slacks; k < f->unknowns - 1; k++) most = fmax(most, f->x[k]);
    return most;
}

/* Working sets that are tried before DAQP; a multiplier that is no rounding, and residuals of a good answer. */
enum { GUESSES = 4 };
static const double WILL = 1e-12, GOOD = 1e-11;

/* Numbers that sum up nodes: their number, places (3), products of these (xx, xy, xz, yy, yz, zz), known motions (3) and
   the moments of these (3). */
enum { SUMS = 16 };

/* How the free nodes move: r, then K, stage after stage. The blocks of a stage are D (m, m) over its own coordinates, and
   the right-hand sides (m, 1 + n_a): its actuators' changes less what earlier coordinates contribute. */
static void respond(Fused *f)
{
    int count = f->actuators, w = 1 + count;
    if (!f->stages) {
        for (int k = 0; k < f->nodes; k++) {
            f->response[k * w] = f->rhs[k];
            for (int i = 0; i < count; i++) f->response[k * w + 1 + i] = f->gradients[i * f->nodes + k];
        }
        return;
    }
    for (int s = 0; s < f->stages; s++) {
        int first = f->stage_rows[s], m = f->stage_rows[s + 1] - first;
        const int *coordinate = f->stage_coordinate + first;
        double *D = f->blocks, *X = D + m * m;
        memset(D, 0, sizeof(double) * (m * m + m * w));
        for (int j = 0; j < m; j++) {
            int quantity = f->stage_quantity[first + j], actuator = f->actuator_of[quantity];
            X[j * w] = f->rhs[quantity];
            if (actuator >= 0) X[j * w + 1 + actuator] = 1.0;
        }
        for (int e = f->stage_entries[s]; e < f->stage_entries[s + 1]; e++) {
            int row = f->entry_row[e], column = f->entry_column[e];
            double value = f->gradients[f->entry_flat[e]];
            if (column < 0) {
                D[row * m - 1 - column] += value;
                continue;
            }
            const double *before = f->response + column * w;
            for (int k = 0; k < w; k++) X[row * w + k] -= value * before[k];
        }
        solve_for(D, X, m, w);
        for (int j = 0; j < m; j++) memcpy(f->response + coordinate[j] * w, X + j * w, sizeof(double) * w);
    }
}

/* Add the products of a `wrench` (6) and the twists of the first actuators to `sum`, and set it to zero. */
static void add_twisted(const Fused *f, double *wrench, int movers, double *sum)
{
    for (int i = 0; i < movers; i++) sum[i] += dot(wrench, f->twists + 6 * i, 6);
    memset(wrench, 0, sizeof(double) * 6);
}

/* A row over the displacements of `count` nodes, with three numbers for each in `part`, as one over the actuators: its
   value (1 + n_a) without their changes, then for each of them. Without `has_base`, nodes of the base do not count. */
static void row_over(const Fused *f, const double *part, const int *nodes, int count, int has_base, double *sum)
{
    int w = 1 + f->actuators, movers = 0;
    double wrench[6] = {0.0}, moment[3];
    memset(sum, 0, sizeof(double) * w);
    for (int j = 0; j < count; j++, part += 3) {
        int column = f->node_column[nodes[j]];
        if (part[0] == 0.0 && part[1] == 0.0 && part[2] == 0.0) continue;
        if (column < 0 || f->twists) {
            if (column >= 0 || has_base) sum[0] += dot(part, f->moved + 3 * nodes[j], 3);
            if (column < 0) continue;
            if (f->movers[column / 3] != movers) {
                /* Actuators move the nodes so far by their common wrench. */
                add_twisted(f, wrench, movers, sum + 1);
                movers = f->movers[column / 3];
            }
            cross(f->free + column, part, moment);
            for (int a = 0; a < 3; a++) {
                wrench[a] += moment[a];
                wrench[3 + a] += part[a];
            }
            continue;
        }
        for (int a = 0; a < 3; a++) {
            const double *moved = f->response + (column + a) * w;
            for (int k = 0; k < w; k++) sum[k] += part[a] * moved[k];
        }
    }
    if (f->twists) add_twisted(f, wrench, movers, sum + 1);
}

/* Row k of the stack: `sum` over the actuators, `curve` (q) over the free coordinates of the curve, a constant; all times
   the row's weight. */
static void stack_row(Fused *f, int k, const double *sum, const double *curve, double constant)
{
    int count = f->actuators, rows = f->squares, free = free_of(f);
    double weight = f->row_weight[k], *to = f->stack + (f->twists ? 0 : f->nodes) + k;
    for (int i = 0; i < count; i++) to[i * rows] = weight * sum[1 + i];
    for (int i = 0; i < free; i++) to[(count + i) * rows] = weight * curve[i];
    to[(f->unknowns - 1) * rows] = weight * (constant + sum[0]);
}

/* A row (D) over all coordinates of the curve as one over the free ones, to `curve`; return its value for the offset. */
static double free_row(const Fused *f, const double *row, double *curve)
{
    curve[0] = dot(row + 3, f->normal, 3);
    memcpy(curve + 1, row + 6, sizeof(double) * (free_of(f) - 1));
    return dot(row, f->offset, 3 * f->vertices);
}

/* The same for the row that draws a point of the curve, the sum of its vertices times the weights (V), along `axis`. */
static double point_row(const Fused *f, const double *weight, const double *axis, double *curve)
{
    double known = 0.0;
    for (int v = 0; v < f->vertices; v++) {
        known += weight[v] * dot(f->offset + 3 * v, axis, 3);
        for (int a = 0; a < 3 && v > 1; a++) curve[1 + 3 * (v - 2) + a] = weight[v] * axis[a];
    }
    curve[0] = weight[1] * dot(axis, f->normal, 3);
    return known;
}

/* The rows of the stations: (32)-(39) over actuators and curve. */
static void track(Fused *f)
{
    int size = 3 * f->vertices + f->torsion, turns = f->turned, S = f->stations;
    double *sum = f->work, *curve = sum + 1 + f->actuators, *row = curve + size, part[9], axis[3];
    memset(curve, 0, sizeof(double) * size);
    for (int s = 0; s < S; s++) {
        const int *nodes = f->station_node + 3 * s;
        for (int a = 0; a < 3; a++) {
            double known;
            for (int j = 0; j < 9; j++) part[j] = j % 3 == a ? f->station_weight[3 * s + j / 3] : 0.0;
            row_over(f, part, nodes, 3, 1, sum);
            for (int b = 0; b < 3; b++) axis[b] = b == a ? -1.0 : 0.0;
            if (f->point_rows) {
                for (int d = 0; d < size; d++) row[d] = -f->point_rows[(3 * s + a) * size + d];
                known = free_row(f, row, curve);
            } else known = point_row(f, f->curve_weight + s * f->vertices, axis, curve);
            stack_row(f, 3 * s + a, sum, curve, f->gaps[3 * s + a] + known);
        }
        for (int r = 0; r < turns; r++) {
            double known;
            for (int j = 0; j < 9; j++) part[j] = f->faces[(9 * s + j) * turns + r];
            row_over(f, part, nodes, 3, 1, sum);
            if (f->point_rows) {
                for (int d = 0; d < size; d++) row[d] = f->bends[(s * size + d) * turns + r];
                known = free_row(f, row, curve);
            } else {
                for (int b = 0; b < 3; b++) axis[b] = f->bends[(3 * s + b) * turns + r];
                known = point_row(f, f->curve_slope + s * f->vertices, axis, curve);
            }
            stack_row(f, 3 * S + turns * s + r, sum, curve, f->turns[turns * s + r] + known);
        }
    }
    memset(sum, 0, sizeof(double) * (1 + f->actuators));
    for (int k = 0; k < f->spacings; k++) {
        double known = free_row(f, f->stretch_rows + k * size, curve);
        stack_row(f, (3 + turns) * S + k, sum, curve, f->stretches[k] + known);
    }
}

/* The stack of the least-squares rows, and the rows of the tip with their bounds, from the results of row_function. */
static void compose(Fused *f)
{
    int n = f->unknowns, count = f->actuators, last = n - 1, w = 1 + count, rows = f->squares;
    if (!f->twists) {
        double weight = 1.0 / f->scale;
        respond(f);
        for (int k = 0; k < f->nodes; k++) {
            for (int i = 0; i < count; i++) f->stack[i * rows + k] = weight * f->response[k * w + 1 + i];
            for (int i = count; i < last; i++) f->stack[i * rows + k] = 0.0;
            f->stack[last * rows + k] = weight * f->response[k * w];
        }
    }
    double *sum = f->work, *part = sum + w;
    for (int k = 0; k < f->tips; k++) {
        double *row = f->constraint + k * n;
        for (int j = 0; j < 3 * f->tip_nodes; j++) part[j] = f->tip_jacobian[j * f->tips + k];
        row_over(f, part, f->tip_node, f->tip_nodes, 1, sum);
        memset(row, 0, sizeof(double) * n);
        memcpy(row, sum + 1, sizeof(double) * count);
        for (int i = 0; i < f->slacks; i++) row[last - f->slacks + i] = i == k ? 1.0 : i == f->tips + k ? -1.0 : 0.0;
        row[last] = -f->tip_rate[k];
        f->lower[n + k] -= sum[0];
        f->upper[n + k] -= sum[0];
    }
    if (f->vertices) track(f);
}

/* Hessian and gradient of the node rate where actuators move nodes by twists. An actuator moves the nodes of those
   after it, too: sums over the nodes that it moves take the place of a Jacobian. */
static void node_rate(Fused *f)
{
    int n = f->unknowns, count = f->actuators;
    double *sums = f->work, weight = 1.0 / (f->scale * f->scale), moment[3];
    memset(sums, 0, sizeof(double) * SUMS * (count + 1));
    for (int k = 0; k < f->nodes / 3; k++) {
        const double *x = f->free + 3 * k, *known = f->moved + 3 * f->free_node[k];
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
    int n = f->unknowns, count = f->actuators, rows = f->squares, last = n - 1, curve = free_of(f);
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
            int from = f->first_row[i] > f->first_row[j] ? f->first_row[i] : f->first_row[j];
            double sum = dot(free_rows + i * rows + from, free_rows + j * rows + from, rows - from);
            if (i < last) H[j * n + i] = H[i * n + j] += sum;
            else g[j] += sum + f->linear[j];
        }
    }
    g[last] = f->linear[last];
    for (int k = 0; k < n; k++) H[last * n + k] = H[k * n + last] = 0.0;
    H[last * n + last] = f->curvature[0];
    for (int k = 0; k < count; k++) H[k * n + k] += f->actuator_weight[k];
    for (int k = 0, at = count + curve; k < f->slacks; k++, at++) {
        H[at * n + at] += f->slack_weight[k];
        g[at] += f->slack_pull[k];
    }
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

/* Rows after those of the tip: stations, legs, clearances. */
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
        memcpy(row + count, f->leg_rows + k * free_of(f), sizeof(double) * free_of(f));
        *lower = f->leg_lower[k];
    }
    double *sum = f->work;
    for (int k = 0; k < f->near; k++, row += n, lower++) {
        row_over(f, f->near_rows + 3 * k * f->slots, f->near_nodes + k * f->slots, f->slots, 0, sum);
        memset(row + count, 0, sizeof(double) * (n - count));
        memcpy(row, sum + 1, sizeof(double) * count);
        *lower = f->near_lower[k] - sum[0];
        f->column[n + f->tips + f->hard + f->legs + k] = -1;
    }
}

/* Add the squares of a value's violation of its bounds, and of its multiplier times the distance from them; see
   residual.loose. */
static void add_residuals(double multiplier, double value, double lower, double upper, double *beyond, double *loose)
{
    double out = fmax(value - upper, lower - value);
    /* A comparison with NaN fails. */
    if (!(out <= 0.0)) *beyond += out * out;
    double slack = multiplier * fmin(fmax(multiplier > 0.0 ? upper - value : value - lower, 0.0), 1.0);
    *loose += slack * slack;
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
        add_residuals(y[k], value, f->lower[k], f->upper[k], &beyond, &loose);
        if (k >= n && y[k] != 0.0)
            for (int i = 0; i < n; i++) force[i] += y[k] * row[i];
    }
    for (int k = 0; k < n; k++) off += force[k] * force[k];
    f->primal = sqrt(beyond);
    /* NaN stays. */
    f->dual = sqrt(loose > off ? loose : off) / (1.0 + norm(f->gradient, n) + norm(y, n + rows));
}

/* Condense the QP, but for its rows of clearance, at the state that was loaded. */
EXPORT int assemble(Fused *f)
{
    if (f->curve.eval && (call(&f->curve) || *f->curve_is_right != 1.0)) return NO_VALUE;
    if (call(&f->condense)) return NO_VALUE;
    compose(f);
    objective(f);
    f->working->is_begun = 0;
    return DONE;
}

/* Make the Hessian and the equalities the first columns for working sets, unless they are; return whether the Hessian is
   positive definite. Then there is room for as many columns as unknowns: where there was not, others are forgotten. */
static int begun(Fused *f)
{
    Working *w = f->working;
    int m = f->tips + f->hard, is_full = w->count + f->unknowns > w->most;
    if (w->is_begun && !is_full) return w->is_begun > 0;
    for (int k = 0; k < f->unknowns + m + f->legs + f->near; k++) f->column[k] = -1;
    if (!w->is_begun) w->is_begun = begin(w, f->hessian, f->gradient, f->constraint, f->levers, m) ? 1 : -1;
    w->count = m;
    w->size = 0;
    return w->is_begun > 0;
}

/* The column of unknown k, or of row k - n where k is n or more, made if there is none; -1 if there is no room. */
static int column_of(Fused *f, int k)
{
    int n = f->unknowns;
    if (f->column[k] >= 0) return f->column[k];
    if (k < n) memset(f->working->point, 0, sizeof(double) * n);
    else memcpy(f->working->point, f->constraint + (k - n) * n, sizeof(double) * n);
    if (k < n) f->working->point[k] = 1.0;
    return f->column[k] = extend(f->working, k < n ? k : 0);
}

/* Take out of the working set what has a multiplier of the wrong sign, and put in what is beyond its bounds; return
   whether the set changed. */
static int reconsider(Fused *f, int rows)
{
    int n = f->unknowns, equal = n + f->tips + f->hard, has_changed = 0;
    for (int k = 0; k < n + rows; k++) {
        if (k >= n && k < equal) continue;
        double value = k < n ? f->x[k] : dot(f->constraint + (k - n) * n, f->x, n);
        int side = f->side[k];
        if (f->lower[k] == f->upper[k]) continue;
        if (side && side * f->multipliers[k] < -WILL) f->side[k] = 0;
        else if (!side && value < f->lower[k] - f->feasibility) f->side[k] = -1;
        else if (!side && value > f->upper[k] + f->feasibility) f->side[k] = 1;
        has_changed |= f->side[k] != side;
    }
    return has_changed;
}

/* Solve the QP from the working set of the one before; 0 where that and some changes of it do not lead to the answer. */
static int guess(Fused *f, int rows)
{
    Working *w = f->working;
    int n = f->unknowns, m = f->tips + f->hard, every = n + rows;
    if (!begun(f)) return 0;
    for (int k = 0; k < every; k++) {
        double y = f->multipliers[k];
        f->side[k] = f->lower[k] == f->upper[k] ? 1 : (y > 0.0) - (y < 0.0);
    }
    for (int count = 1; count <= GUESSES; count++) {
        int size = 0;
        for (int k = 0; k < every; k++) {
            if (k == n) {
                for (int i = 0; i < m; i++, size++) {
                    w->chosen[size] = i;
                    w->share[size] = -f->levers[i] * f->lower[n + i] - w->along[i];
                }
                k += m;
                if (k == every) break;
            }
            if (!f->side[k]) continue;
            int column = size < n ? column_of(f, k) : -1;
            if (column < 0) return 0;
            w->chosen[size] = column;
            w->share[size++] = -(f->side[k] < 0 ? f->lower[k] : f->upper[k]) - w->along[column];
        }
        if (!choose(w, size)) return 0;
        combine(w, size, 1.0);
        memset(f->multipliers, 0, sizeof(double) * every);
        for (int k = 0; k < n; k++) f->x[k] = -w->point[k];
        for (int k = 0; k < every; k++) {
            if (k >= n && k < n + m) f->multipliers[k] = f->levers[k - n] * w->spread[k - n];
            else if (f->side[k]) f->multipliers[k] = w->spread[f->column[k]];
            if (k < n && f->side[k]) f->x[k] = f->side[k] < 0 ? f->lower[k] : f->upper[k];
        }
        if (reconsider(f, rows)) continue;
        f->iterations = count;
        f->flag = 1;
        residuals(f, rows);
        return f->primal <= f->feasibility * sqrt((double)every) && f->dual <= GOOD;
    }
    return 0;
}

/* Have DAQP write the answer of a problem to x and its multipliers; return its exit flag. */
static int ask_daqp(void (*quadprog)(DAQPResult *, DAQPProblem *, DAQPSettings *), void (*defaults)(DAQPSettings *),
                    DAQPProblem *problem, double accuracy, double *x, double *multipliers, int *iterations)
{
    DAQPSettings settings;
    DAQPResult result;
    memset(&result, 0, sizeof(result));
    defaults(&settings);
    settings.primal_tol = accuracy;
    settings.eps_prox = 0.0;
    result.x = x;
    result.lam = multipliers;
    quadprog(&result, problem, &settings);
    *iterations = result.iter;
    return result.exitflag;
}

/* Whether a row that nothing can change is out of its bounds: DAQP leaves such rows out. */
static int contradicts(const Fused *f, int rows)
{
    int n = f->unknowns;
    for (int k = 0; k < rows; k++) {
        if (f->lower[n + k] <= f->feasibility && f->upper[n + k] >= -f->feasibility) continue;
        if (norm(f->constraint + (Index)k * n, n) == 0.0) return 1;
    }
    return 0;
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
    if (guess(f, rows)) return DONE;
    DAQPProblem problem = {f->unknowns, f->unknowns + rows, f->unknowns, f->hessian, f->gradient,
                           f->constraint, f->upper, f->lower, f->sense};
    f->flag = ask_daqp(f->quadprog, f->defaults, &problem, f->feasibility, f->x, f->multipliers, &f->iterations);
    if (f->flag == EXIT_INFEASIBLE || contradicts(f, rows)) return INFEASIBLE;
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
            double moved = fabs(turned[a] + of[3 + a] + (whole ? f->moved[3 * f->free_node[k / 3] + a] : 0.0));
            if (moved > furthest || moved != moved) furthest = moved;
        }
    }
    return furthest;
}

/* Move q and the curve by the changes x of the unknowns; `whole` adds the motions by residuals. */
static void advance(Fused *f, const double *x, int whole)
{
    int count = f->actuators;
    double *moved = f->work;
    if (f->twists) f->furthest = furthest_by_twists(f, x, whole);
    else {
        f->furthest = 0.0;
        for (int k = 0; k < f->nodes; k++) {
            const double *row = f->response + k * (1 + count);
            moved[k] = dot(row + 1, x, count) + (whole ? row[0] : 0.0);
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

/* Work with the bounds that the answer is at, whose unknowns settling does not change, and all equalities; 0 if these
   do not determine the least changes. See settling_gain. */
static int hold(Fused *f)
{
    Working *w = f->working;
    int n = f->unknowns, m = f->tips + f->hard, size = 0, is_same = 1, column;
    if (!begun(f)) return 0;
    for (int k = 0; k < n; k++) {
        if (k < n - 1 - f->slacks
            && (k >= f->actuators || (f->x[k] > f->lower[k] + f->at_bound && f->x[k] < f->upper[k] - f->at_bound)))
            continue;
        if ((column = column_of(f, k)) < 0) return 0;
        is_same &= size < w->size && w->chosen[size] == column;
        f->at[size] = k;
        w->chosen[size++] = column;
    }
    f->held = size;
    for (int k = 0; k < m; k++) {
        is_same &= size < w->size && w->chosen[size] == k;
        w->chosen[size++] = k;
    }
    /* What follows in the set does not change the factor so far. */
    if (!is_same && !choose(w, size)) return 0;
    double least = INFINITY, greatest = 0.0;
    for (int i = f->held; i < size; i++) {
        least = fmin(least, w->inner[i * w->most + i]);
        greatest = fmax(greatest, w->inner[i * w->most + i]);
    }
    /* Of the inverses of the pivots. */
    return greatest * greatest < f->worst_condition * least * least;
}

/* The least changes (n) of the unknowns that correct the errors `missing` (m) and leave those that are held. */
static void change_by(const Fused *f, const double *missing, double *change)
{
    Working *w = f->working;
    int m = f->tips + f->hard;
    memset(w->share, 0, sizeof(double) * f->held);
    for (int i = 0; i < m; i++) w->share[f->held + i] = f->levers[i] * missing[i];
    combine(w, f->held + m, 0.0);
    memcpy(change, w->point, sizeof(double) * f->unknowns);
    for (int k = 0; k < f->held; k++) change[f->at[k]] = 0.0;
}

/* The product of two changes of the unknowns, whose torsions count as lengths. */
static double measured(const Fused *f, const double *a, const double *b)
{
    int n = f->unknowns, T = f->torsion, first = f->actuators + free_of(f) - T;
    double product = dot(a, b, n);
    return T ? product + (f->lever * f->lever - 1.0) * dot(a + first, b + first, T) : product;
}

/* Settle q and the curve: quantities exact, equalities satisfied unless these are let go. Each iteration closes the
   quantities by a step of Newton's method, and then corrects the equalities: closing again in between would not change
   what they miss. Steps (n) after the first have Broyden's updates of the gain, in the form that needs the steps alone. */
static int settle_all(Fused *f, int lets_go)
{
    int n = f->unknowns, m = f->tips + f->hard, steps = 0, may_correct = 1, is_measured = 0, is_closed = 0;
    double *step = f->work + f->nodes + SUMS * (f->actuators + 1) + n * f->squares, *missed = f->missing.res[0];
    for (int count = 0; count <= f->closing_steps + f->settling_steps; count++) {
        if (call(&f->close)) return UNSETTLED;
        /* The norm is NaN if one of the errors is. */
        double error = f->errors[0];
        if (!(error < f->too_far && f->errors[1] < INFINITY)) return UNSETTLED;
        is_closed = error <= f->enough_length;
        if (is_closed && is_measured) break;
        if (!is_closed) {
            memcpy(f->q, f->closer, sizeof(double) * f->coordinates);
            is_closed = error <= f->tiny_error;
        }
        if (error > f->small_error) continue;
        if (f->curve_nodes.eval && (call(&f->curve_nodes) || *f->nodes_are_right != 1.0)) return NO_VALUE;
        if (call(&f->missing)) return UNSETTLED;
        f->off = 0.0;
        for (int k = 0; k < m && !lets_go; k++) f->off += f->levers[k] * missed[k] * f->levers[k] * missed[k];
        f->off = sqrt(f->off);
        if (!(f->off <= f->start)) return UNSETTLED;
        is_measured = 1;
        if (!steps && f->off > f->enough_tip) may_correct = hold(f);
        if (f->off <= f->enough_tip || !may_correct || steps == f->settling_steps) {
            if (is_closed) break;
            continue;
        }
        double *next = step + steps * n;
        change_by(f, missed, next);
        for (int k = 0; k < steps; k++) {
            const double *before = step + k * n;
            double share = measured(f, before, next) / measured(f, before, before);
            if (k < steps - 1)
                for (int i = 0; i < n; i++) next[i] += share * before[n + i];
            else if (share < 1.0)
                for (int i = 0; i < n; i++) next[i] /= 1.0 - share;
        }
        steps++;
        advance(f, next, 0);
        is_measured = 0;
    }
    return is_measured && (is_closed || f->errors[0] <= f->member_error) && f->off <= f->tip_error ? DONE : UNSETTLED;
}

/* The same, from where the answer led. */
EXPORT int settle(Fused *f)
{
    memcpy(f->started, f->q, sizeof(double) * f->coordinates);
    memcpy(f->started_points, f->points, sizeof(double) * 3 * f->vertices);
    memcpy(f->started_torsions, f->torsions, sizeof(double) * f->torsion);
    double slack = tip_slack(f);
    /* An elastic tip with a slack is not moved. */
    int code = slack > f->on_path ? UNSETTLED : settle_all(f, 0);
    if (code != UNSETTLED || !(slack > f->tip_error)) return code;
    memcpy(f->q, f->started, sizeof(double) * f->coordinates);
    memcpy(f->points, f->started_points, sizeof(double) * 3 * f->vertices);
    memcpy(f->torsions, f->started_torsions, sizeof(double) * f->torsion);
    return settle_all(f, 1);
}

/* The progress after a `step` from that `before`; 1 where what is left of the path at these rates is no more than `left`:
   interior-point solvers stop just short of the end, and the arm would need one more step. */
static double reached_by(double before, double step, const double *velocity, const double *spin, double left)
{
    double reached = fmin(fmax(before + step, 0.0), 1.0), fastest = 0.0;
    for (int k = 0; k < 3; k++) fastest = fmax(fastest, fmax(fabs(velocity[k]), fabs(spin[k])));
    return (1.0 - reached) * fastest <= left ? 1.0 : reached;
}

/* Follow the answer of the QP from q, in which the base is where it is after the step, and settle. */
static int depart(Fused *f, const double *q, double tolerance)
{
    if (!(f->primal <= tolerance && f->dual <= tolerance)) return INACCURATE;
    f->reached = reached_by(*f->progress, f->x[f->unknowns - 1], f->velocity, f->spin, f->left);
    *f->gone = f->reached - *f->progress;
    memcpy(f->q, q, sizeof(double) * f->coordinates);
    memcpy(f->points, f->condense.arg[3], sizeof(double) * 3 * f->vertices);
    if (f->torsion) memcpy(f->torsions, f->curve.arg[1], sizeof(double) * f->torsion);
    advance(f, f->x, 1);
    double furthest = f->furthest;
    int code = settle(f);
    /* Not that of the last correction, which may have failed. */
    f->furthest = furthest;
    return code;
}

/* Solve, follow the answer from q, and settle; the base is at rest. */
EXPORT int move(Fused *f, double tolerance)
{
    int code = solve(f);
    return code ? code : depart(f, f->condense.arg[0], tolerance);
}
