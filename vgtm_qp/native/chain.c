/* The step of a long arm, a chain of equal periods, at a cost linear in these: linearise, eliminate, solve, check, settle.

   Every formula of a period is a function that CasADi generates, see qp/long/elimination.py; here are the sweeps along
   the chain, the curve's coordinates, which all periods share, and the rows with bounds, which form a small dense QP.
   Unknowns are those of an L with Hessian L L': the free motions of all periods unless stations stay on the curve, the
   free coordinates of the curve, and the progress. Rows come in the order of working_set.RowTable. */

typedef struct {
    /* Numbers of: periods; coordinates of a period's own nodes, as many as its members, and of those that it uses of
       the period before; its actuated members, stations and free motions, none of these where stations stay on the
       curve; actuators, fixed members that rows hold; rows and nodes of the tip; control vertices and free
       coordinates of the curve; rows of its end and of its legs. */
    int periods, own, before, moving, stations, freedom, actuators, held, tips, tip_nodes;
    int vertices, curve, ends, legs;
    int follows;                           /* whether stations stay on the curve */

    /* Numbers of a period in head, tail, table and gains, see elimination.Inputs; where parts begin there. */
    int heads, tails, tables, gains_size;
    int rhs_at, faces_at, gradient_at, over_slope_at, gap_at, tilt_at, normal_at;
    const int *node, *node_at;             /* (n, m) nodes; (N) places in (n + 1, m), where the first period is the base's */
    const int *window, *entry;             /* (n, w + m) nodes; (3m, 3w + 3m) place in the Jacobian's numbers, or -1 */
    const int *member, *stroke_at, *held_at;     /* (n, 3m) members; (n_a), (l) places among these */
    const int *moving_at;                  /* (n, 3m) the stroke among all actuated members, or -1 */
    const int *is_fixed;                   /* (n, 3m) whether a member keeps its length */
    const int *base_entries; int base_count;     /* numbers of the first period's Jacobian over nodes of the base */
    const int *live;                       /* (3w) coordinates of a window that the next period uses */

    /* See qp/long/ends.py: the rows of tip and legs, and the curve's base; what the tip misses, and its pose. */
    Kernel begin, missing;
    /* See period_values, and Following.factor or Elimination.factor, and so on. */
    Kernel values, eliminate, changes, forward, balance, close;
    /* Products of a period's sparse matrices: lists (E, 3) of row, column and place among the numbers, by row; where each
       list begins, see List, those of stages first; rows of fixed members and coordinates of each stage. */
    const int *entries, *list_at, *stage_hard, *stage_from;
    int stages, width;                     /* columns of matrices: free coordinates of the curve and 1, up to a multiple of 4 */
    const double *centre;                  /* weights of the nodes of a station's centre */
    void (*quadprog)(DAQPResult *, DAQPProblem *, DAQPSettings *);
    void (*defaults)(DAQPSettings *);

    const double *home, *fixed, *angles, *alignment;     /* (n, ..) arguments of values that stay the same */
    const double *hard;                    /* (n, 2f) 1 where a gap, or the angles, are equalities */
    const double *weight, *slope;          /* (n, f, V) of the control vertices at the stations */
    const double *polygon, *along;         /* (V, V) Hessian per axis: of the vertices alone, of the gaps too */
    double node_rate, actuator_weight, tangent, tracking;
    const double *levers;                  /* (n_e) lengths to compare the tip's rows by */
    const int *tip_node;
    const int *end_node;                   /* (3) of the last station, in the order of its places */
    const double *end_weight;              /* (3) */
    int end_station, end_gaps;             /* its place among (n, f); whether rows close its gap, else its angles alone */

    /* Input: q and where Jacobians are evaluated (N, 3), control vertices (V, 3) and their gradient, boxes (n_a), whether
       it is a QP of motion, progress, rates of the goal; rows of clearance (R, slots). */
    double *q, *at, *points, *pull, *lower, *upper, *motion, *progress, *velocity, *spin;
    int near, slots;
    int *near_nodes;
    double *near_rows, *near_lower;

    double *head, *tail, *table, *lengths;     /* (n, ..) */
    double *gains;                         /* (n, ..) */
    int carries;                           /* numbers of a carry */
    /* Displacements (n + 1, 3m, width) of nodes, strokes (n, a, width) and angles (n, 2f, width), by the free coordinates
       of the curve and a constant; or the part (n, freedom, width) of these in the free motions, and the displacements
       (n, 3m) by the errors of fixed members. */
    double *moved, *stroke_rows, *angle_rows, *outer, *placed;
    double *factor, *rhs, *free;           /* (C, C), see factorise; (C); (width): the coordinates, 1, zeros */
    double *shift;                         /* (V, 3) displacements of the control vertices */
    double *motions;                       /* (n, freedom) */
    double *displaced, *changed, *parts;   /* (n + 1, 3m), (n, 3m), (n, 5f) */
    double *strokes;                       /* (n, a) of all actuated members, where stations stay on the curve */
    double *nodal, *force, *pushed;        /* (n, 3m), (n, a), (n, 5f) */
    double *passed, *entering;             /* (n, freedom, BLOCK), (n, 3m, BLOCK) work */

    int room, total, active;      /* capacity of rows in the dense QP */
    int *row, *state, *kept;               /* (room) rows in it; (total) whether a row is in it; work */
    double *column, *gram;                 /* (room, size + 1), (room, room) */
    double *multiplier, *level;            /* (room), and the rows' values at the minimum without them */
    double *scaled, *dense;                /* work */
    double *low, *high, *value, *every;    /* (total) bounds, values and multipliers of all rows */
    double *out;                           /* (total) by how much rows are beyond their bounds */
    int *remembered, *pressed, pressing;   /* (total) rows that were active before; nodes (R, slots) of those of clearance */
    double presses, accuracy, no_row, dependent, independent;

    /* Tolerances, see Fused. */
    double at_bound, left, worst_condition, too_far, member_error, tip_error, start, enough_length, enough_tip;
    int closing_steps;

    double *x, *y;                         /* (n_a) strokes, and their multipliers */
    double *settled, *next, *errors;       /* (n, 3m) positions; (n, 3m) what they miss */
    double *begun;                         /* (N, 3) q by the answer alone */
    double *aim, *wanted, *curve_aim;      /* (n, 3m), (n_a), (n, 3f) */
    double *gain, *gain_moved;             /* (n_a, n_e), (n, 3m, n_e) */
    double *quantities;                    /* (M) lengths where it settled */
    double primal, dual, reached, furthest, step, error, off;
    int flag, iterations;
    double *work;
} Chain;

/* Rows that pass through the elimination at once; times that rounding may be removed; DAQP's mark of an equality. */
enum { BLOCK = 8, REFINEMENTS = 4, EQUALITY = 5 };

/* What counts as an infinite bound; by how much a row that nothing moves may be out of its bounds. */
static const double UNBOUNDED = 1e30, UNMOVABLE = 1e-9;

/* Periods whose rows are summed up at once. */
enum { CHUNK = 16 };

/* Sparse matrices of a stage, see elimination.Stage and Elimination._gains, and their transposes: T couples fixed members
   to what is before. And those of a period: strokes and angles of displacements, centres of the stations, and displacements
   by gaps. */
typedef enum {
    TIED, TIED_BACK, PLACES, PLACES_BACK, FREE, FREE_BACK, SWAY, SWAY_BACK, LEAN, LEAN_BACK, STAGE_LISTS,
    STROKES = 0, ANGLES, ANGLES_BACK, CENTRES, CENTRES_BACK, STATIONS
} List;

static int of_stage(int stage, List list) { return stage * STAGE_LISTS + list; }

static int of_period(const Chain *c, List list) { return c->stages * STAGE_LISTS + list; }

/* Four numbers that are added or multiplied at once, anywhere in memory. */
typedef double Four __attribute__((vector_size(32), aligned(8)));

#define INLINE static inline __attribute__((always_inline))

/* Add `sign` times a matrix' row, its entries among `values`, times `from`, whose rows are `width` apart, to the first
   4 * `blocks` numbers of `row`. */
INLINE void multiply_row(const int *entry, const int *end, const double *values, double sign, const double *from, double *row,
                         int width, int blocks)
{
    Four sum[5];
    for (int b = 0; b < blocks; b++) sum[b] = *(const Four *)(row + 4 * b);
    for (; entry < end; entry += 3) {
        const double share = sign * values[entry[2]], *other = from + entry[1] * width;
        for (int b = 0; b < blocks; b++) sum[b] += share * *(const Four *)(other + 4 * b);
    }
    for (int b = 0; b < blocks; b++) *(Four *)(row + 4 * b) = sum[b];
}

/* Add `sign` times a list's matrix, its entries among `values`, times `from` to `to`; both have rows of `width`, a multiple
   of 4. */
static void multiply(const Chain *c, int list, const double *values, double sign, const double *from, double *to, int width)
{
    const int *entry = c->entries + 3 * c->list_at[list], *last = c->entries + 3 * c->list_at[list + 1], *end;
    for (; entry < last; entry = end) {
        double *row = to + entry[0] * width;
        for (end = entry; end < last && end[0] == entry[0];) end += 3;
        for (int j = 0; j < width; j += 20) {
            int blocks = (width - j) / 4;
            if (blocks >= 5) multiply_row(entry, end, values, sign, from + j, row + j, width, 5);
            else if (blocks == 4) multiply_row(entry, end, values, sign, from + j, row + j, width, 4);
            else if (blocks == 3) multiply_row(entry, end, values, sign, from + j, row + j, width, 3);
            else if (blocks == 2) multiply_row(entry, end, values, sign, from + j, row + j, width, 2);
            else multiply_row(entry, end, values, sign, from + j, row + j, width, 1);
        }
    }
}

/* Add `weight` times the products of columns i to i + 3 of `count` rows and 4 * `blocks` columns from j to `whole`. */
INLINE void add_block(const double *rows, int count, int width, double weight, double *whole, int i, int j, int blocks)
{
    Four sum[4][2] = {{{0.0}}};
    for (int r = 0; r < count; r++, rows += width)
        for (int b = 0; b < blocks; b++) {
            Four other = *(const Four *)(rows + j + 4 * b);
            for (int a = 0; a < 4; a++) sum[a][b] += rows[i + a] * other;
        }
    for (int a = 0; a < 4; a++)
        for (int b = 0; b < blocks; b++) *(Four *)(whole + (i + a) * width + j + 4 * b) += weight * sum[a][b];
}

/* Add `weight` times the products of the columns of `count` rows to `whole` (width, width), up to its diagonal. */
static void add_squares(const double *rows, int count, int width, double weight, double *whole)
{
    for (int i = 0; i < width; i += 4)
        for (int j = 0; j <= i; j += 8)
            if (j < i) add_block(rows, count, width, weight, whole, i, j, 2);
            else add_block(rows, count, width, weight, whole, i, j, 1);
}

/* Add the sum of `count` rows times their shares to the first 4 * `blocks` numbers of `sum`. */
INLINE void add_some(const double *rows, const double *shares, int count, int width, double *sum, int blocks)
{
    Four part[5];
    for (int b = 0; b < blocks; b++) part[b] = *(const Four *)(sum + 4 * b);
    for (int r = 0; r < count; r++, rows += width)
        for (int b = 0; b < blocks; b++) part[b] += shares[r] * *(const Four *)(rows + 4 * b);
    for (int b = 0; b < blocks; b++) *(Four *)(sum + 4 * b) = part[b];
}

/* Add the sum of `count` rows (width) times their shares to `sum`. */
static void add_rows(const double *rows, const double *shares, int count, int width, double *sum)
{
    int j = 0;
    for (; j + 20 <= width; j += 20) add_some(rows + j, shares, count, width, sum + j, 5);
    for (; j + 8 <= width; j += 8) add_some(rows + j, shares, count, width, sum + j, 2);
    for (; j < width; j += 4) add_some(rows + j, shares, count, width, sum + j, 1);
}

/* The gradient (C) in the curve's free coordinates of one (V, 3) in the control vertices, added to `free`. */
static void add_free(const Chain *c, const double *by_vertex, double *free)
{
    const double *normal = c->table + c->normal_at;
    free[0] += dot(normal, by_vertex + 3, 3);
    for (int k = 6; k < 3 * c->vertices; k++) free[k - 5] += by_vertex[k];
}

/* The displacements (V, 3) of the control vertices by free coordinates, without the offset. */
static void vertices_of(const Chain *c, const double *free, double *shift)
{
    const double *normal = c->table + c->normal_at;
    memset(shift, 0, sizeof(double) * 3 * c->vertices);
    for (int a = 0; a < 3 && c->vertices; a++) shift[3 + a] = normal[a] * free[0];
    for (int k = 6; k < 3 * c->vertices; k++) shift[k] = free[k - 5];
}

/* The gradient (C) of the terms in the vertices alone at displacements (V, 3) of these. */
static void polygon_gradient(const Chain *c, const double *shift, double *free)
{
    double pull[3 * c->vertices + 1];
    for (int v = 0; v < c->vertices; v++)
        for (int a = 0; a < 3; a++) {
            pull[3 * v + a] = c->pull[3 * v + a];
            for (int u = 0; u < c->vertices; u++) pull[3 * v + a] += c->polygon[v * c->vertices + u] * shift[3 * u + a];
        }
    memset(free, 0, sizeof(double) * c->curve);
    if (c->vertices) add_free(c, pull, free);
}

/* A point (3) on the curve of vertices (V, 3), or its slope, by its weights. */
static void on_curve(const Chain *c, const double *weight, const double *vertices, double *point)
{
    point[0] = point[1] = point[2] = 0.0;
    for (int v = 0; v < c->vertices; v++)
        for (int a = 0; a < 3; a++) point[a] += weight[v] * vertices[3 * v + a];
}

/* The numbers of every period at the input; and the bounds of the tip's rows and of the legs. */
static int linearise(Chain *c)
{
    const Kernel *begin = &c->begin, *values = &c->values;
    int V = c->vertices, wide = c->before + c->own, f = c->stations;
    double X[wide], Y[wide], curve[12 * f + 1], closes[2 * f + 1];
    for (int k = 0; k < c->tip_nodes; k++) {
        memcpy((double *)begin->arg[0] + 3 * k, c->q + 3 * c->tip_node[k], 3 * sizeof(double));
        memcpy((double *)begin->arg[1] + 3 * k, c->at + 3 * c->tip_node[k], 3 * sizeof(double));
    }
    if (call(begin)) return NO_VALUE;
    const double *offset = begin->res[4], *normal = begin->res[5];
    for (int k = 0; k < c->periods; k++) {
        for (int p = 0; p < wide / 3; p++) {
            int node = c->window[k * (wide / 3) + p];
            memcpy(X + 3 * p, c->q + 3 * node, 3 * sizeof(double));
            memcpy(Y + 3 * p, c->at + 3 * node, 3 * sizeof(double));
        }
        for (int s = 0; s < f; s++) {
            const double *weight = c->weight + (k * f + s) * V, *slope = c->slope + (k * f + s) * V;
            on_curve(c, weight, c->points, curve + 12 * s);
            on_curve(c, weight, offset, curve + 12 * s + 3);
            on_curve(c, slope, c->points, curve + 12 * s + 6);
            on_curve(c, slope, offset, curve + 12 * s + 9);
        }
        for (int i = 0; i < 2 * f; i++) closes[i] = c->motion[0] != 0.0 ? 1.0 : c->hard[2 * f * k + i];
        if (V) memcpy(c->table + k * c->tables + c->normal_at, normal, 3 * sizeof(double));
        const double *arg[] = {X, Y, c->home + k * c->own, c->fixed + k * c->own, c->angles + 6 * f * k,
                               c->alignment + 9 * f * k, curve, c->motion, closes};
        double *res[] = {c->head + k * c->heads, c->tail + k * c->tails, NULL, c->lengths + k * c->own};
        memcpy(values->arg, arg, sizeof(arg));
        memcpy(values->res, res, sizeof(res));
        if (call(values)) return NO_VALUE;
    }
    /* The first period's members stand on base nodes, which are no unknowns. */
    for (int i = 0; i < c->base_count; i++) c->head[c->base_entries[i]] = 0.0;
    return DONE;
}

/* Rows (width) over the free coordinates of the curve, and a constant: the points of a period's stations (3f) less their
   gaps, and the angles (2f) without displacements. */
static void curve_rows(const Chain *c, int k, double *points, double *angles)
{
    int V = c->vertices, width = c->width;
    const double *tail = c->tail + (Index)k * c->tails, *normal = c->table + c->normal_at;
    memset(points, 0, sizeof(double) * 3 * c->stations * width);
    memset(angles, 0, sizeof(double) * 2 * c->stations * width);
    for (int s = 0; s < c->stations; s++) {
        const double *weight = c->weight + (k * c->stations + s) * V, *slope = c->slope + (k * c->stations + s) * V;
        for (int a = 0; a < 3; a++) {
            double *row = points + (3 * s + a) * width;
            row[0] = weight[1] * normal[a];
            for (int v = 2; v < V; v++) row[3 * v - 5 + a] = weight[v];
            row[c->curve] = -tail[c->gap_at + 3 * s + a];
        }
        for (int a = 0; a < 2; a++) {
            const double *over_slope = tail + c->over_slope_at + 3 * (2 * s + a);
            double *row = angles + (2 * s + a) * width;
            row[0] = slope[1] * dot(over_slope, normal, 3);
            for (int v = 2; v < V; v++)
                for (int b = 0; b < 3; b++) row[3 * v - 5 + b] = slope[v] * over_slope[b];
            row[c->curve] = tail[c->tilt_at + 2 * s + a];
        }
    }
}

/* Follow the curve from the base to the tip: displacements, strokes and angles; and add their squares to `whole`, whose
   row of the constant is the gradient. */
static int follow_curve(Chain *c, double *whole)
{
    int width = c->width, own = c->own, f = c->stations, n = c->curve;
    double window[(c->before + own) * width + 4], errors[own * width + 4], gaps[3 * f * width + 4];
    memset(window, 0, sizeof(window));
    for (int k = 0; k < c->periods; k++) {
        double *head = c->head + (Index)k * c->heads, *gains = c->gains + (Index)k * c->gains_size;
        double *strokes = c->stroke_rows + (Index)k * c->moving * width, *angles = c->angle_rows + (Index)k * 2 * f * width;
        const double *rhs = head + c->rhs_at;
        c->eliminate.arg[0] = head;
        c->eliminate.res[0] = gains;
        if (call(&c->eliminate)) return NO_VALUE;
        memset(window + c->before * width, 0, sizeof(double) * own * width);
        for (int s = 0; s < c->stages; s++) {
            int count = c->stage_from[s + 1] - c->stage_from[s];
            memset(errors, 0, sizeof(double) * count * width);
            for (int i = 0; i < count; i++) errors[i * width + n] = rhs[c->stage_hard[c->stage_from[s] + i]];
            multiply(c, of_stage(s, TIED), head, -1.0, window, errors, width);
            multiply(c, of_stage(s, PLACES), gains, 1.0, errors, window, width);
        }
        curve_rows(c, k, gaps, angles);
        multiply(c, of_period(c, CENTRES), c->centre, -1.0, window, gaps, width);
        multiply(c, of_period(c, STATIONS), gains, 1.0, gaps, window, width);
        memset(strokes, 0, sizeof(double) * c->moving * width);
        for (int i = 0; i < own; i++) {
            int at = c->moving_at[k * own + i];
            if (at >= 0) strokes[(at - k * c->moving) * width + n] = -rhs[i];
        }
        multiply(c, of_period(c, STROKES), head, 1.0, window, strokes, width);
        multiply(c, of_period(c, ANGLES), head, 1.0, window, angles, width);
        add_rows(strokes, c->tail + (Index)k * c->tails + c->gradient_at, c->moving, width, whole + n * width);
        double *moved = c->moved + (Index)(k + 1) * own * width;
        memcpy(moved, window + c->before * width, sizeof(double) * own * width);
        for (int i = 0; i < c->before; i++)
            memcpy(window + i * width, moved + (c->live[i] - c->before) * width, sizeof(double) * width);
        int count = k % CHUNK + 1, first = k + 1 - count;
        if (count < CHUNK && k < c->periods - 1) continue;
        add_squares(c->moved + (Index)(first + 1) * own * width, count * own, width, c->node_rate, whole);
        add_squares(c->stroke_rows + (Index)first * c->moving * width, count * c->moving, width, c->actuator_weight, whole);
        add_squares(c->angle_rows + (Index)first * 2 * f * width, count * 2 * f, width, c->tangent, whole);
    }
    return DONE;
}

/* Take gradients in the window of period k, rows of `width`, through its stages, from the last to the first: their parts
   (freedom, width) in the free motions; those that are left are in what the period uses of the one before. Add what they
   are times the displacements by errors of fixed members to `known` (width). */
static void through(const Chain *c, int k, double *window, double *passed, double *known, int width)
{
    const double *head = c->head + (Index)k * c->heads, *gains = c->gains + (Index)k * c->gains_size;
    double errors[c->own * width + 4];
    memset(passed, 0, sizeof(double) * c->freedom * width);
    for (int s = c->stages - 1; s >= 0; s--) {
        memset(errors, 0, sizeof(double) * (c->stage_from[s + 1] - c->stage_from[s]) * width);
        multiply(c, of_stage(s, FREE_BACK), gains, 1.0, window, passed, width);
        multiply(c, of_stage(s, PLACES_BACK), gains, 1.0, window, errors, width);
        multiply(c, of_stage(s, SWAY_BACK), gains, -1.0, passed, errors, width);
        multiply(c, of_stage(s, TIED_BACK), head, -1.0, errors, window, width);
        multiply(c, of_stage(s, LEAN_BACK), gains, -1.0, passed, window, width);
    }
    add_rows(window + c->before * width, c->placed + k * c->own, c->own, width, known);
}

/* Eliminate the free motions from the tip to the base; and add squares of what is left to `whole`. */
static int eliminate_motions(Chain *c, double *whole)
{
    int width = c->width, own = c->own, f = c->stations, n = c->curve, size = (c->before + own) * width;
    double window[size + 4], left[c->before * width + 4], points[3 * f * width + 4], angles[2 * f * width + 4];
    double constant[c->freedom + 1], *carry = c->work;
    memset(left, 0, sizeof(left));
    memset(carry, 0, sizeof(double) * c->carries);
    for (int k = c->periods - 1; k >= 0; k--) {
        double *outer = c->outer + (Index)k * c->freedom * width;
        const double *head = c->head + (Index)k * c->heads, *gains = c->gains + (Index)k * c->gains_size;
        const double *arg[] = {carry, head, c->tail + (Index)k * c->tails, c->table + (Index)k * c->tables};
        double *res[] = {carry + c->carries, (double *)gains, constant, c->placed + k * own};
        memcpy(c->eliminate.arg, arg, sizeof(arg));
        memcpy(c->eliminate.res, res, sizeof(res));
        if (call(&c->eliminate)) return NO_VALUE;
        memcpy(carry, carry + c->carries, sizeof(double) * c->carries);
        if (n) {
            memset(window, 0, sizeof(double) * size);
            for (int i = 0; i < c->before; i++)
                memcpy(window + c->live[i] * width, left + i * width, sizeof(double) * width);
            curve_rows(c, k, points, angles);
            multiply(c, of_period(c, CENTRES_BACK), c->centre, -c->tracking, points, window, width);
            for (int i = 0; i < 2 * f * width; i++) points[i] = c->tangent * angles[i];
            multiply(c, of_period(c, ANGLES_BACK), head, 1.0, points, window, width);
            through(c, k, window, outer, whole + n * width, width);
            memcpy(left, window, sizeof(double) * c->before * width);
            add_squares(angles, 2 * f, width, c->tangent, whole);
        }
        for (int i = 0; i < c->freedom; i++) outer[i * width + n] = constant[i];
        int count = (c->periods - 1 - k) % CHUNK + 1;
        if (count == CHUNK || !k) add_squares(outer, count * c->freedom, width, -1.0, whole);
    }
    return DONE;
}

/* Hessian (C, C) and gradient (C) of the terms in the vertices, and where stations may leave the curve, of their gaps. */
static void curve_terms(Chain *c, double *hessian, double *gradient)
{
    int V = c->vertices, n = c->curve;
    double pull[3 * V + 1];
    const double *normal = c->table + c->normal_at, *along = c->follows ? c->polygon : c->along;
    polygon_gradient(c, c->begin.res[4], gradient);
    memset(pull, 0, sizeof(pull));
    for (int k = 0; k < c->periods * c->stations && !c->follows; k++) {
        const double *gap = c->tail + (Index)(k / c->stations) * c->tails + c->gap_at + 3 * (k % c->stations);
        for (int v = 0; v < V; v++)
            for (int a = 0; a < 3; a++) pull[3 * v + a] -= c->tracking * c->weight[k * V + v] * gap[a];
    }
    if (V) add_free(c, pull, gradient);
    memset(hessian, 0, sizeof(double) * n * n);
    for (int v = 1; v < V; v++)
        for (int u = 1; u < V; u++)
            for (int a = 0; a < 3; a++) {
                /* The first free coordinate moves the second control vertex along the normal. */
                int row = v > 1 ? 3 * v - 5 + a : 0, column = u > 1 ? 3 * u - 5 + a : 0;
                hessian[row * n + column] +=
                    (v > 1 ? 1.0 : normal[a]) * (u > 1 ? 1.0 : normal[a]) * along[v * V + u];
            }
}

/* Eliminate the periods, and factorise the Hessian of the curve's coordinates. */
static int eliminate(Chain *c)
{
    int n = c->curve, width = c->width;
    double whole[width * width];
    memset(whole, 0, sizeof(whole));
    curve_terms(c, c->factor, c->rhs);
    int code = c->follows ? follow_curve(c, whole) : eliminate_motions(c, whole);
    if (code) return code;
    for (int i = 0; i < n; i++) {
        c->rhs[i] += whole[n * width + i];
        for (int j = 0; j <= i; j++) c->factor[j * n + i] += whole[i * width + j];
    }
    if (!factorise(c->factor, n, n)) return FAILED;
    solve_lower(c->factor, n, n, 0, c->rhs);
    /* NaN fails the comparison. */
    const double *end = c->follows ? c->moved + (Index)((c->periods + 1) * c->own - 1) * width : c->outer;
    for (int i = 0; i <= n; i++)
        if (!(fabs(end[i]) < INFINITY)) return FAILED;
    return DONE;
}

/* Where the rows of each kind begin, see RowTable: tip, locked members, curve's end, progress, legs, actuators,
   clearance. */
static int end_at(const Chain *c) { return c->tips + c->held; }
static int equal(const Chain *c) { return end_at(c) + c->ends; }
static int strokes_at(const Chain *c) { return equal(c) + 1 + c->legs; }
static int near_at(const Chain *c) { return strokes_at(c) + c->actuators; }

/* Bounds of all rows. */
static void bound(Chain *c)
{
    const double *error = c->begin.res[0], *least = c->begin.res[7];
    double *low = c->low, *high = c->high;
    const double *tail = c->tail + (Index)(c->end_station / (c->stations ? c->stations : 1)) * c->tails;
    int s = c->stations ? c->end_station % c->stations : 0;
    c->total = near_at(c) + c->near;
    for (int k = 0; k < c->total; k++) high[k] = UNBOUNDED;
    for (int k = 0; k < c->tips; k++) low[k] = high[k] = error[k];
    for (int k = c->tips; k < end_at(c); k++) low[k] = high[k] = 0.0;
    for (int k = 0; k < c->ends; k++) {
        int which = k + (c->end_gaps ? 0 : 3);
        low[end_at(c) + k] = high[end_at(c) + k] =
            -(which < 3 ? tail[c->gap_at + 3 * s + which] : tail[c->tilt_at + 2 * s + which - 3]);
    }
    low[equal(c)] = -c->progress[0];
    high[equal(c)] = 1.0 - c->progress[0];
    memcpy(low + equal(c) + 1, least, sizeof(double) * c->legs);
    for (int k = 0; k < c->actuators; k++) {
        double length = c->lengths[c->stroke_at[k]];
        low[strokes_at(c) + k] = c->lower[k] - length;
        high[strokes_at(c) + k] = c->upper[k] - length;
    }
    memcpy(low + near_at(c), c->near_lower, sizeof(double) * c->near);
}

/* The nodes of row r, three numbers for each in `part`, and its coefficients (C) in the curve, added to `curve`; return
   the number of nodes. `part` has room for those of a period's window. */
static int row_of(const Chain *c, int r, const int **nodes, double *part, double *curve)
{
    int wide = c->before + c->own, n = c->curve;
    if (r < c->tips) {
        *nodes = c->tip_node;
        memcpy(part, c->begin.res[2] + 3 * c->tip_nodes * r, sizeof(double) * 3 * c->tip_nodes);
        return c->tip_nodes;
    }
    if (r >= near_at(c)) {
        r -= near_at(c);
        *nodes = c->near_nodes + r * c->slots;
        memcpy(part, c->near_rows + 3 * r * c->slots, sizeof(double) * 3 * c->slots);
        return c->slots;
    }
    if (r >= strokes_at(c) || r < end_at(c)) {
        int at = r < end_at(c) ? c->held_at[r - c->tips] : c->stroke_at[r - strokes_at(c)];
        const double *jacobian = c->head + (Index)(at / c->own) * c->heads;
        const int *entry = c->entry + (at % c->own) * wide;
        *nodes = c->window + at / c->own * (wide / 3);
        for (int i = 0; i < wide; i++) part[i] = entry[i] < 0 ? 0.0 : jacobian[entry[i]];
        return wide / 3;
    }
    if (r > equal(c)) {
        for (int i = 0; i < n; i++) curve[i] += c->begin.res[6][(r - equal(c) - 1) * n + i];
        return 0;
    }
    if (r == equal(c)) return 0;
    int which = r - end_at(c) + (c->end_gaps ? 0 : 3), V = c->vertices;
    int k = c->end_station / c->stations, s = c->end_station % c->stations;
    double axis[3] = {0.0, 0.0, 0.0}, by_vertex[3 * V];
    const double *weight = (which < 3 ? c->weight : c->slope) + c->end_station * V;
    const double *face = c->head + (Index)k * c->heads + c->faces_at + 9 * (2 * s + which - 3);
    *nodes = c->end_node;
    if (which < 3) {
        axis[which] = -1.0;
        for (int i = 0; i < 9; i++) part[i] = i % 3 == which ? c->end_weight[i / 3] : 0.0;
    } else {
        memcpy(axis, c->tail + (Index)k * c->tails + c->over_slope_at + 3 * (2 * s + which - 3), sizeof(axis));
        memcpy(part, face, 9 * sizeof(double));
    }
    for (int v = 0; v < V; v++)
        for (int a = 0; a < 3; a++) by_vertex[3 * v + a] = weight[v] * axis[a];
    add_free(c, by_vertex, curve);
    return 3;
}

static double over_progress(const Chain *c, int r)
{
    return r == equal(c) ? 1.0 : r < c->tips ? -c->begin.res[1][r] : 0.0;
}

/* Rows (b) that enter at the nodes, b their place in the block, up to period `top`, through the elimination: their parts in
   the free motions, to `column` (BLOCK, size + 1), and in the curve's coordinates, taken from `curve` (BLOCK, C); add
   their values by errors of fixed members to `known` (BLOCK). */
static void pass_rows(Chain *c, int top, int count, double *column, double *curve, double *known)
{
    int n = c->curve, width = c->width, size = c->periods * c->freedom + n + 1, freedom = c->freedom;
    double window[(c->before + c->own) * BLOCK], left[c->before * BLOCK + 1], passed[freedom * BLOCK + 1], sum[width];
    memset(left, 0, sizeof(left));
    for (int k = top; k >= 0; k--) {
        memset(window, 0, sizeof(double) * c->before * BLOCK);
        memcpy(window + c->before * BLOCK, c->entering + (Index)k * c->own * BLOCK, sizeof(double) * c->own * BLOCK);
        for (int i = 0; i < c->before; i++)
            for (int b = 0; b < BLOCK; b++) window[c->live[i] * BLOCK + b] += left[i * BLOCK + b];
        through(c, k, window, passed, known, BLOCK);
        memcpy(left, window, sizeof(double) * c->before * BLOCK);
        for (int b = 0; b < count; b++)
            for (int i = 0; i < freedom; i++) column[(Index)b * size + k * freedom + i] = passed[i * BLOCK + b];
    }
    for (int b = 0; b < count; b++) {
        double *to = column + (Index)b * size;
        memset(to + (top + 1) * freedom, 0, sizeof(double) * (size - 1 - n - (top + 1) * freedom));
        memset(sum, 0, sizeof(double) * width);
        add_rows(c->outer, to, (top + 1) * freedom, width, sum);
        known[b] -= sum[n];
        for (int i = 0; i < n; i++) curve[b * n + i] -= sum[i];
    }
}

/* L^-1 of rows, up to BLOCK of them, to `column` (count, size + 1), the last numbers those of the progress; and their
   values at the minimum without rows, to `level` (count). */
static int columns_of(Chain *c, const int *rows, int count, double *column, double *level)
{
    int n = c->curve, width = c->width, size = c->periods * c->freedom + n + 1, m = c->own / 3, top = -1;
    double part[3 * (c->before + c->own) + 3 * c->slots + 3 * c->tip_nodes + 9], curve[BLOCK * n + 1], known[BLOCK] = {0.0};
    double sum[width];
    memset(curve, 0, sizeof(curve));
    for (int b = 0; b < count; b++) {
        const int *nodes = NULL;
        int slots = row_of(c, rows[b], &nodes, part, curve + b * n);
        memset(sum, 0, sizeof(sum));
        for (int j = 0; j < slots; j++) {
            int at = c->node_at[nodes[j]] - m;
            const double *share = part + 3 * j;
            if (at < 0 || (share[0] == 0.0 && share[1] == 0.0 && share[2] == 0.0)) continue;
            if (c->follows) {
                add_rows(c->moved + (Index)3 * (at + m) * width, share, 3, width, sum);
                continue;
            }
            for (; top < at / m; top++)
                memset(c->entering + (Index)(top + 1) * c->own * BLOCK, 0, sizeof(double) * c->own * BLOCK);
            for (int a = 0; a < 3; a++) c->entering[((Index)3 * at + a) * BLOCK + b] += share[a];
        }
        known[b] = sum[n];
        for (int i = 0; i < n; i++) curve[b * n + i] += sum[i];
    }
    if (!c->follows) pass_rows(c, top, count, column, curve, known);
    for (int b = 0; b < count; b++) {
        const double *from = curve + b * n, scale = 1.0 / sqrt(c->begin.res[3][0]);
        double *to = column + (Index)(b + 1) * size - 1 - n;
        memcpy(to, from, sizeof(double) * n);
        solve_lower(c->factor, n, n, 0, to);
        to[n] = scale * over_progress(c, rows[b]);
        level[b] = known[b] - dot(to, c->rhs, n) - to[n] * scale * c->begin.res[8][0];
    }
    return DONE;
}

/* The displacement (3) of a node at the minimum of the Lagrangian. */
static void displacement(const Chain *c, int node, double *moved)
{
    int at = 3 * c->node_at[node], width = c->width;
    for (int a = 0; a < 3; a++)
        moved[a] = c->follows ? dot(c->moved + (Index)(at + a) * width, c->free, width) : c->displaced[at + a];
}

/* Minimise the Lagrangian, given columns times multipliers (size + 1), which are overwritten; the values of all rows. */
static int minimise(Chain *c, double *combined)
{
    int n = c->curve, width = c->width, free_motions = c->periods * c->freedom, wide = c->before + c->own;
    double *known = combined + free_motions, scale = 1.0 / sqrt(c->begin.res[3][0]), part[wide + 3 * c->slots + 9];
    double moved[3], curve[n + 1];
    c->step = -scale * (scale * c->begin.res[8][0] + known[n]);
    for (int i = 0; i < n; i++) c->free[i] = -(c->rhs[i] + known[i]);
    solve_upper(c->factor, n, n, c->free);
    c->free[n] = 1.0;
    for (int k = 0; k < c->periods * c->moving && c->follows; k++)
        c->strokes[k] = dot(c->stroke_rows + (Index)k * width, c->free, width);
    if (!c->follows) {
        for (int k = 0; k < free_motions; k++)
            c->motions[k] = combined[k] + dot(c->outer + (Index)k * width, c->free, width);
        /* From the base to the tip. */
        double *carry = c->work;
        memset(carry, 0, sizeof(double) * c->before);
        for (int k = 0; k < c->periods; k++) {
            const double *arg[] = {carry, c->head + (Index)k * c->heads, c->gains + (Index)k * c->gains_size,
                                   c->motions + k * c->freedom};
            double *res[] = {carry + c->before, c->displaced + (k + 1) * c->own, c->changed + k * c->own,
                             c->parts + 5 * c->stations * k};
            memcpy(c->forward.arg, arg, sizeof(arg));
            memcpy(c->forward.res, res, sizeof(res));
            if (call(&c->forward)) return NO_VALUE;
            memcpy(carry, carry + c->before, sizeof(double) * c->before);
        }
    }
    for (int r = 0; r < c->total; r++) {
        double *value = c->value + r;
        if (r >= strokes_at(c) && r < near_at(c)) {
            int at = c->stroke_at[r - strokes_at(c)];
            *value = c->follows ? c->strokes[c->moving_at[at]] : c->changed[at];
            continue;
        }
        if (r >= c->tips && r < end_at(c)) {
            *value = c->changed[c->held_at[r - c->tips]];
            continue;
        }
        const int *nodes = NULL;
        memset(curve, 0, sizeof(double) * n);
        int slots = row_of(c, r, &nodes, part, curve);
        *value = over_progress(c, r) * c->step + dot(curve, c->free, n);
        for (int j = 0; j < slots; j++) {
            displacement(c, nodes[j], moved);
            *value += dot(part + 3 * j, moved, 3);
        }
    }
    return DONE;
}

/* The multipliers with all rows active at the bounds they violate, to c->multiplier; return 0 if that may be wrong. */
static int all_active(Chain *c, const double *value, double *factor)
{
    int R = c->active;
    double least = INFINITY, greatest = 0.0, *found = c->multiplier;
    double goal[R + 1];
    for (int i = 0; i < R; i++) {
        int r = c->row[i], is_above = r < equal(c) || value[i] > c->high[r];
        if (!(is_above || value[i] < c->low[r])) return 0;
        goal[i] = value[i] - (is_above ? c->high[r] : c->low[r]);
        memcpy(factor + i * R, c->gram + (Index)i * c->room, sizeof(double) * R);
    }
    if (!factorise(factor, R, R)) return 0;
    for (int i = 0; i < R; i++) {
        least = fmin(least, factor[i * R + i]);
        greatest = fmax(greatest, factor[i * R + i]);
    }
    /* Of the inverses of the pivots. */
    if (!(least > c->independent * greatest)) return 0;
    solve_lower(factor, R, R, 0, goal);
    solve_upper(factor, R, R, goal);
    for (int i = 0; i < R; i++) {
        int r = c->row[i];
        double right = value[i] > c->high[r] ? goal[i] : -goal[i];
        if (!(fabs(goal[i]) < INFINITY) || (r >= equal(c) && !(right >= 0.0))) return 0;
    }
    memcpy(found, goal, sizeof(double) * R);
    return 1;
}

/* In place, the rows (R, R) of a Cholesky factor of A with pivots by size, each row at the place of its own; return its
   rank, the number of columns above the tolerance. */
static int pivoted_factor(double *A, double *rows, int R, double tolerance)
{
    double left[R + 1];
    int rank = 0;
    memset(rows, 0, sizeof(double) * R * R);
    for (int i = 0; i < R; i++) left[i] = A[i * R + i];
    for (; rank < R; rank++) {
        int best = 0;
        for (int i = 1; i < R; i++)
            if (left[i] > left[best]) best = i;
        if (!(left[best] > tolerance)) break;
        double pivot = sqrt(left[best]);
        for (int i = 0; i < R; i++) {
            /* Rows that were pivots are marked. */
            if (left[i] < 0.0 && i != best && left[i] == -INFINITY) continue;
            double value = i == best ? pivot : (A[i * R + best] - dot(rows + i * R, rows + best * R, rank)) / pivot;
            rows[i * R + rank] = value;
            if (i != best) left[i] -= value * value;
        }
        left[best] = -INFINITY;
    }
    return rank;
}

/* The multipliers that bring the values of the rows into their bounds at least cost; see dual_solution. */
static int solve_dual(Chain *c, const double *value)
{
    int R = c->active, K = 0;
    double *scaled = c->dense, *rows = scaled + (Index)R * R, *compact = rows + (Index)R * R;
    double *identity = compact + (Index)R * R, *vectors = identity + (Index)R * R;
    c->iterations++;
    if (all_active(c, value, scaled)) return DONE;
    c->iterations--;
    double *scale = vectors, *low = scale + R, *high = low + R, *x = high + R, *found = x + R, *gradient = found + R;
    for (int i = 0; i < R; i++) {
        double size = sqrt(fmax(c->gram[(Index)i * c->room + i], 0.0));
        c->multiplier[i] = 0.0;
        if (!(size < INFINITY)) return FAILED;
        if (size < c->no_row) {
            int r = c->row[i];
            if (fmax(c->low[r] - value[i], value[i] - c->high[r]) > UNMOVABLE) return INFEASIBLE;
            continue;
        }
        scale[K] = 1.0 / size;
        c->kept[K++] = i;
    }
    if (!K) return DONE;
    int *sense = c->kept + R;
    for (int i = 0; i < K; i++) {
        int at = c->kept[i], r = c->row[at];
        for (int j = 0; j < K; j++) scaled[i * K + j] = c->gram[(Index)at * c->room + c->kept[j]] * scale[i] * scale[j];
        low[i] = fabs(c->low[r]) >= UNBOUNDED ? c->low[r] : (c->low[r] - value[at]) * scale[i];
        high[i] = fabs(c->high[r]) >= UNBOUNDED ? c->high[r] : (c->high[r] - value[at]) * scale[i];
        sense[i] = r < equal(c) ? EQUALITY : 0;
    }
    int rank = pivoted_factor(scaled, rows, K, c->dependent * K);
    memset(identity, 0, sizeof(double) * rank * rank);
    memset(gradient, 0, sizeof(double) * rank);
    for (int i = 0; i < rank; i++) identity[i * rank + i] = 1.0;
    for (int i = 0; i < K; i++) memcpy(compact + i * rank, rows + i * K, sizeof(double) * rank);
    DAQPProblem problem = {rank, K, 0, identity, gradient, compact, high, low, sense};
    int iterations;
    c->flag = ask_daqp(c->quadprog, c->defaults, &problem, c->accuracy, x, found, &iterations);
    c->iterations += iterations;
    if (c->flag == EXIT_INFEASIBLE) return INFEASIBLE;
    if (c->flag <= 0) return FAILED;
    for (int i = 0; i < K; i++) c->multiplier[c->kept[i]] = found[i] * scale[i];
    return DONE;
}

/* Put rows, up to BLOCK at once, into the dense QP. */
static int enter(Chain *c, const int *rows, int count)
{
    int size = c->periods * c->freedom + c->curve + 1;
    if (c->active + count > c->room) return CROWDED;
    for (int first = 0; first < count; first += BLOCK) {
        int some = count - first < BLOCK ? count - first : BLOCK;
        double *added = c->column + (Index)c->active * size;
        if (columns_of(c, rows + first, some, added, c->level + c->active)) return NO_VALUE;
        for (int b = 0; b < some; b++, c->active++) {
            int at = c->active;
            c->row[at] = rows[first + b];
            c->state[rows[first + b]] = 1;
            c->multiplier[at] = 0.0;
            for (int j = 0; j <= at; j++)
                c->gram[(Index)at * c->room + j] = c->gram[(Index)j * c->room + at] =
                    dot(c->column + (Index)j * size, c->column + (Index)at * size, size);
        }
    }
    return DONE;
}

/* Whether row r was active in the last QP. */
static int was_active(const Chain *c, int r)
{
    if (r < near_at(c)) return c->remembered[r];
    const int *nodes = c->near_nodes + (r - near_at(c)) * c->slots;
    for (int k = 0; k < c->pressing; k++)
        if (!memcmp(c->pressed + k * c->slots, nodes, sizeof(int) * c->slots)) return 1;
    return 0;
}

/* The rows that enter next: `room` of those that are out of their bounds and not in the dense QP, the worst first. */
static int worst_rows(const Chain *c, int room, int *rows)
{
    int count = 0;
    for (int r = 0; r < c->total; r++) {
        if (c->state[r] || !(c->out[r] > c->accuracy)) continue;
        int k = count < room ? count++ : room;
        if (k == room && !(c->out[r] > c->out[rows[room - 1]])) continue;
        if (k == room) k = room - 1;
        for (; k > 0 && c->out[rows[k - 1]] < c->out[r]; k--) rows[k] = rows[k - 1];
        rows[k] = r;
    }
    return count;
}

/* By how much each row is out of its bounds; return the number of rows that are. */
static int violations(Chain *c, int *outside)
{
    int count = 0;
    *outside = 0;
    for (int r = 0; r < c->total; r++) {
        c->out[r] = fmax(c->low[r] - c->value[r], c->value[r] - c->high[r]);
        if (!(c->out[r] > c->accuracy)) continue;
        count++;
        if (!c->state[r]) ++*outside;
    }
    return count;
}

/* Solve the QP with the rows of clearance; see solve_rows. */
static int solve_rows(Chain *c)
{
    int size = c->periods * c->freedom + c->curve + 1, refined = 0, count = 0, outside;
    double *combined = c->scaled, *value = combined + size;
    int *rows = c->kept + 2 * c->room;
    bound(c);
    c->active = c->iterations = 0;
    memset(c->state, 0, sizeof(int) * c->total);
    for (int r = 0; r < c->total; r++)
        if (r < equal(c) || was_active(c, r)) {
            if (count == c->room) return CROWDED;
            c->state[r] = 1;
            rows[count++] = r;
        }
    for (;;) {
        int code = enter(c, rows, count), is_first = c->active == count;
        if (code) return code;
        for (int i = 0; i < c->active; i++)
            value[i] = is_first ? c->level[i]
                                : c->value[c->row[i]] + dot(c->gram + (Index)i * c->room, c->multiplier, c->active);
        code = solve_dual(c, value);
        if (code) return code;
        memset(combined, 0, sizeof(double) * size);
        for (int i = 0; i < c->active; i++) {
            const double *column = c->column + (Index)i * size, share = c->multiplier[i];
            for (int k = 0; k < size && share != 0.0; k++) combined[k] += share * column[k];
        }
        if (minimise(c, combined)) return NO_VALUE;
        int violated = violations(c, &outside), few = outside / (4 * BLOCK), room = BLOCK * (few > 1 ? few : 1);
        if (!violated) break;
        if (room > c->room) return CROWDED;
        count = worst_rows(c, room, rows);
        if (!count && ++refined > REFINEMENTS) return FAILED;
    }
    memset(c->every, 0, sizeof(double) * c->total);
    for (int i = 0; i < c->active; i++) c->every[c->row[i]] = c->multiplier[i];
    return DONE;
}

/* Displacements of all nodes and changes of all members by the answer, where stations stay on the curve; complete the
   gradients by nodes, and add what all gradients are in the curve's coordinates to `sum` (width). */
static int displace_all(Chain *c, double *sum)
{
    int width = c->width;
    for (int k = 0; k < c->periods * c->own && !c->follows; k++) c->nodal[k] += c->node_rate * c->displaced[c->own + k];
    if (!c->follows) return DONE;
    for (int k = 0; k < c->periods; k++) {
        double *u = c->displaced + (k + 1) * c->own, before[c->before + 1];
        for (int i = 0; i < c->own; i++)
            u[i] = dot(c->moved + (Index)((k + 1) * c->own + i) * width, c->free, width);
        for (int i = 0; i < c->own; i++) c->nodal[k * c->own + i] += c->node_rate * u[i];
        add_rows(c->moved + (Index)(k + 1) * c->own * width, c->nodal + k * c->own, c->own, width, sum);
        add_rows(c->stroke_rows + (Index)k * c->moving * width, c->force + k * c->moving, c->moving, width, sum);
        for (int i = 0; i < c->before; i++) {
            /* What this period uses of the one before. */
            int at = c->live[i] - c->before;
            before[i] = c->displaced[k * c->own + at];
        }
        if (!k) memset(before, 0, sizeof(double) * c->before);
        double spare[c->before + 1];
        const double *arg[] = {before, c->head + (Index)k * c->heads, u};
        double *res[] = {spare, c->changed + k * c->own, c->parts + 5 * c->stations * k};
        memcpy(c->changes.arg, arg, sizeof(arg));
        memcpy(c->changes.res, res, sizeof(res));
        if (call(&c->changes)) return NO_VALUE;
    }
    return DONE;
}

/* Gradients by nodes (n, 3m) and actuated members (n, a) at the answer; return the square of the members' forces. */
static double gradients(Chain *c)
{
    int m = c->own / 3;
    double square = 0.0, part[c->before + c->own + 3 * c->slots + 3 * c->tip_nodes + 9], spare[c->curve + 1];
    memset(c->nodal, 0, sizeof(double) * c->periods * c->own);
    for (int r = 0; r < c->total; r++) {
        double y = c->every[r];
        const int *nodes = NULL;
        if (y == 0.0 || (r >= c->tips && r < end_at(c)) || (r >= equal(c) && r < near_at(c))) continue;
        int slots = row_of(c, r, &nodes, part, spare);
        for (int j = 0; j < slots; j++) {
            int at = c->node_at[nodes[j]] - m;
            for (int a = 0; a < 3 && at >= 0; a++) c->nodal[3 * at + a] += y * part[3 * j + a];
        }
    }
    memset(c->force, 0, sizeof(double) * c->periods * c->moving);
    for (int k = 0; k < c->actuators; k++) {
        int at = c->stroke_at[k], moving = c->moving_at[at];
        const double *gradient = c->tail + (Index)(moving / c->moving) * c->tails + c->gradient_at;
        double force = c->actuator_weight * c->value[strokes_at(c) + k] + gradient[moving % c->moving]
            + c->every[strokes_at(c) + k];
        c->force[moving] = force;
        square += force * force;
    }
    for (int k = 0; k < c->held; k++) {
        double force = c->every[c->tips + k];
        c->force[c->moving_at[c->held_at[k]]] = force;
        square += force * force;
    }
    return square;
}

/* What a period's stations miss, gap (3) and angles (2), at displacements of vertices by the free coordinates alone. */
static void misfit(const Chain *c, int k, int s, const double *shift, double *missed)
{
    int at = k * c->stations + s;
    const double *tail = c->tail + (Index)k * c->tails, *over_slope = tail + c->over_slope_at + 6 * s;
    double point[3], slope[3];
    on_curve(c, c->weight + at * c->vertices, shift, point);
    on_curve(c, c->slope + at * c->vertices, shift, slope);
    for (int a = 0; a < 3; a++) missed[a] = tail[c->gap_at + 3 * s + a] - point[a] + c->parts[5 * at + a];
    for (int a = 0; a < 2; a++)
        missed[3 + a] = tail[c->tilt_at + 2 * s + a] + dot(over_slope + 3 * a, slope, 3) + c->parts[5 * at + 3 + a];
}

/* Squares of the residuals of the equalities and of stationarity over the periods, whose part in the curve's coordinates
   is added to `dual` (C); see ChainSolver._residuals. */
static int period_residuals(Chain *c, const double *shift, double *dual, double *left, double *off)
{
    int n = c->curve, width = c->width, V = c->vertices, f = c->stations;
    double pull[3 * V + 1], missed[5], sum[width];
    memset(pull, 0, sizeof(pull));
    memset(sum, 0, sizeof(sum));
    if (displace_all(c, sum)) return NO_VALUE;
    for (int k = 0; k < c->periods; k++) {
        const double *tail = c->tail + (Index)k * c->tails;
        for (int s = 0; s < f; s++) {
            double *pushed = c->pushed + 5 * (k * f + s), angle[3];
            const double *over_slope = tail + c->over_slope_at + 6 * s;
            misfit(c, k, s, shift, missed);
            for (int a = 0; a < 3; a++) pushed[a] = c->tracking * missed[a];
            for (int a = 0; a < 2; a++) pushed[3 + a] = c->tangent * missed[3 + a];
            if (c->follows) {
                *left += dot(missed, missed, 3);
                add_rows(c->angle_rows + (Index)2 * (k * f + s) * width, pushed + 3, 2, width, sum);
                continue;
            }
            const double *weight = c->weight + (k * f + s) * V, *slope = c->slope + (k * f + s) * V;
            for (int a = 0; a < 3; a++) angle[a] = pushed[3] * over_slope[a] + pushed[4] * over_slope[3 + a];
            for (int v = 0; v < V; v++)
                for (int a = 0; a < 3; a++) pull[3 * v + a] += slope[v] * angle[a] - weight[v] * pushed[a];
        }
        for (int i = 0; i < c->own; i++) {
            int at = k * c->own + i;
            double missing = c->changed[at];
            if (c->follows && !c->is_fixed[at])
                missing -= c->strokes[c->moving_at[at]];
            if (c->follows || c->is_fixed[at]) *left += missing * missing;
        }
    }
    if (c->follows) {
        for (int i = 0; i < n; i++) dual[i] += sum[i];
        return DONE;
    }
    if (V) add_free(c, pull, dual);
    double *carry = c->work, *residual = carry + 2 * c->before;
    memset(carry, 0, sizeof(double) * c->before);
    for (int k = c->periods - 1; k >= 0; k--) {
        const double *arg[] = {carry, c->head + (Index)k * c->heads, c->gains + (Index)k * c->gains_size,
                               c->nodal + k * c->own, c->force + k * c->moving, c->pushed + 5 * f * k};
        double *res[] = {carry + c->before, residual};
        memcpy(c->balance.arg, arg, sizeof(arg));
        memcpy(c->balance.res, res, sizeof(res));
        if (call(&c->balance)) return NO_VALUE;
        memcpy(carry, carry + c->before, sizeof(double) * c->before);
        *off += dot(residual, residual, c->freedom);
    }
    return DONE;
}

/* Primal and dual residual of the answer; see ChainSolver._check. */
static int check(Chain *c)
{
    int n = c->curve, V = c->vertices;
    double shift[3 * V + 1], dual[n + 1], part[c->before + c->own + 3 * c->slots + 3 * c->tip_nodes + 9];
    double left = 0.0, off = 0.0, loose = 0.0, forces = 0.0, multipliers = 0.0;
    const double *offset = c->begin.res[4];
    forces = gradients(c);
    vertices_of(c, c->free, shift);
    for (int k = 0; k < 3 * V; k++) c->shift[k] = offset[k] + shift[k];
    polygon_gradient(c, c->shift, dual);
    if (period_residuals(c, shift, dual, &left, &off)) return NO_VALUE;
    for (int r = 0; r < c->total; r++) {
        double y = c->every[r], value = c->value[r], curve[n + 1];
        add_residuals(y, value, c->low[r], c->high[r], &left, &loose);
        multipliers += y * y;
        if (y == 0.0 || !n || !((r >= end_at(c) && r < equal(c)) || (r > equal(c) && r < strokes_at(c)))) continue;
        const int *nodes = NULL;
        memset(curve, 0, sizeof(double) * n);
        row_of(c, r, &nodes, part, curve);
        for (int i = 0; i < n; i++) dual[i] += y * curve[i];
    }
    off += dot(dual, dual, n);
    c->primal = sqrt(left);
    /* NaN stays. */
    c->dual = sqrt(loose > off ? loose : off) / (1.0 + sqrt(forces) + sqrt(multipliers));
    return DONE;
}

/* Remember which rows are active, for the next QP. */
static void remember(Chain *c)
{
    c->pressing = 0;
    for (int r = 0; r < c->total; r++) {
        int is_active = fabs(c->every[r]) > c->presses && r >= equal(c);
        if (r < near_at(c)) c->remembered[r] = is_active;
        else if (is_active)
            memcpy(c->pressed + c->pressing++ * c->slots, c->near_nodes + (r - near_at(c)) * c->slots,
                   sizeof(int) * c->slots);
    }
}

/* Linearise and eliminate at the input. */
EXPORT int chain_assemble(Chain *c)
{
    int code = linearise(c);
    if (!code && !(c->begin.res[3][0] > 0.0)) code = FAILED;
    return code ? code : eliminate(c);
}

/* Solve the QP that was assembled, with its rows of clearance. */
EXPORT int chain_answer(Chain *c)
{
    int code = solve_rows(c);
    if (!code) code = check(c);
    if (code) return code;
    remember(c);
    memcpy(c->x, c->value + strokes_at(c), sizeof(double) * c->actuators);
    memcpy(c->y, c->every + strokes_at(c), sizeof(double) * c->actuators);
    return DONE;
}

/* The changes (n_a, n_e) of the actuators by motions (n, freedom, BLOCK), one for each row of the tip, and the
   displacements of the nodes, to c->gain and c->gain_moved. */
static void stroke_rates(Chain *c)
{
    double window[(c->before + c->own) * BLOCK], errors[c->own * BLOCK], left[c->before * BLOCK + 1];
    double *strokes = c->entering;
    memset(left, 0, sizeof(left));
    for (int k = 0; k < c->periods; k++) {
        const double *head = c->head + (Index)k * c->heads, *gains = c->gains + (Index)k * c->gains_size;
        double *motions = c->passed + (Index)k * c->freedom * BLOCK, *changed = strokes + (Index)k * c->moving * BLOCK;
        memset(window, 0, sizeof(window));
        memset(changed, 0, sizeof(double) * c->moving * BLOCK);
        memcpy(window, left, sizeof(double) * c->before * BLOCK);
        for (int s = 0; s < c->stages; s++) {
            memset(errors, 0, sizeof(errors));
            multiply(c, of_stage(s, TIED), head, -1.0, window, errors, BLOCK);
            multiply(c, of_stage(s, SWAY), gains, 1.0, errors, motions, BLOCK);
            multiply(c, of_stage(s, LEAN), gains, 1.0, window, motions, BLOCK);
            multiply(c, of_stage(s, PLACES), gains, 1.0, errors, window, BLOCK);
            multiply(c, of_stage(s, FREE), gains, -1.0, motions, window, BLOCK);
        }
        multiply(c, of_period(c, STROKES), head, 1.0, window, changed, BLOCK);
        for (int i = 0; i < c->before; i++)
            memcpy(left + i * BLOCK, window + c->live[i] * BLOCK, sizeof(double) * BLOCK);
        for (int i = 0; i < c->own; i++)
            memcpy(c->gain_moved + (k * c->own + i) * c->tips, window + (c->before + i) * BLOCK, sizeof(double) * c->tips);
    }
    for (int k = 0; k < c->actuators; k++)
        for (int t = 0; t < c->tips; t++)
            c->gain[k * c->tips + t] = strokes[(Index)c->moving_at[c->stroke_at[k]] * BLOCK + t];
}

/* The changes (n_a, n_e) of the actuators that move the tip by one unit of each of its rows, actuators at a bound held;
   see StagedSolver.gain. Return a code; INFEASIBLE if there is no such motion. */
static int find_gain(Chain *c)
{
    int size = c->periods * c->freedom + c->curve + 1, n = c->curve, T = c->tips, S = 0, count = 0;
    int *slot = c->kept + 2 * c->room, *missing = slot + c->room, first = c->active;
    for (int r = 0; r < near_at(c); r++) {
        int k = r - strokes_at(c);
        int is_held = k >= 0 && (c->x[k] < c->low[r] + c->at_bound || c->x[k] > c->high[r] - c->at_bound);
        if (r >= equal(c) && !is_held) continue;
        if (S == c->room) return CROWDED;
        slot[S] = -1;
        for (int i = 0; i < first && slot[S] < 0; i++)
            if (c->row[i] == r) slot[S] = i;
        if (slot[S] < 0) {
            if (first + count == c->room) return CROWDED;
            slot[S] = first + count;
            missing[count++] = r;
        }
        S++;
    }
    for (int k = 0; k < count; k += BLOCK)
        if (columns_of(c, missing + k, count - k < BLOCK ? count - k : BLOCK, c->column + (Index)(first + k) * size,
                       c->level + first + k))
            return NO_VALUE;
    double *gram = c->dense, *shares = gram + (Index)S * S, greatest = 0.0, most = 0.0;
    for (int i = 0; i < S; i++)
        for (int j = 0; j <= i; j++) {
            gram[j * S + i] = dot(c->column + (Index)slot[i] * size, c->column + (Index)slot[j] * size, size - 1);
            greatest = fmax(greatest, fabs(gram[j * S + i]));
        }
    if (!factorise(gram, S, S)) return INFEASIBLE;
    for (int t = 0; t < T; t++) {
        double *share = shares + t * S;
        for (int i = 0; i < S; i++) share[i] = i == t;
        solve_lower(gram, S, S, t, share);
        solve_upper(gram, S, S, share);
        for (int i = 0; i < S; i++) most = fmax(most, fabs(share[i]));
    }
    if (!(most * greatest < c->worst_condition)) return INFEASIBLE;
    for (int t = 0; t < T; t++) {
        double *combined = c->scaled, *free = combined + size - 1 - n, known[c->width];
        memset(combined, 0, sizeof(double) * size);
        for (int i = 0; i < S; i++) {
            const double *column = c->column + (Index)slot[i] * size, share = shares[t * S + i];
            for (int k = 0; k < size - 1; k++) combined[k] -= share * column[k];
        }
        solve_upper(c->factor, n, n, free);
        memset(known, 0, sizeof(known));
        memcpy(known, free, sizeof(double) * n);
        for (int k = 0; k < size - 1 - n; k++)
            c->passed[(Index)k * BLOCK + t] = combined[k] - dot(c->outer + (Index)k * c->width, known, c->width);
    }
    stroke_rates(c);
    return DONE;
}

/* What the tip misses where the free nodes are at `own` (n, 3m): the norm of its rows' errors times their levers. */
static double tip_missing(Chain *c, const double *own)
{
    double square = 0.0;
    for (int k = 0; k < c->tip_nodes; k++) {
        int at = c->node_at[c->tip_node[k]] - c->own / 3;
        memcpy((double *)c->missing.arg[0] + 3 * k, own + 3 * at, 3 * sizeof(double));
    }
    if (call(&c->missing)) return NAN;
    for (int k = 0; k < c->tips; k++) square += c->levers[k] * c->missing.res[0][k] * c->levers[k] * c->missing.res[0][k];
    return sqrt(square);
}

/* Aim at the strokes that are wanted, within their boxes. */
static void aim(Chain *c)
{
    for (int k = 0; k < c->actuators; k++)
        c->aim[c->stroke_at[k]] = fmin(fmax(c->wanted[k], c->lower[k]), c->upper[k]);
}

/* One step of Newton's method from `own` (n, 3m) with the QP's factors, to `next`; the greatest error before it. */
static int close_once(Chain *c, const double *own, double *next, double *worst)
{
    int errors = c->follows ? c->own - c->moving + 3 * c->stations : c->own, pair = 2 * c->before;
    double *carry = c->work;
    memset(carry, 0, sizeof(double) * pair);
    for (int i = 0; i < c->before; i++) carry[i] = c->q[3 * c->window[i / 3] + i % 3];
    for (int k = 0; k < c->periods; k++) {
        const double *arg[] = {carry, c->head + (Index)k * c->heads, c->gains + (Index)k * c->gains_size,
                               own + k * c->own, c->aim + k * c->own, c->curve_aim + 3 * c->stations * k};
        double *res[] = {carry + pair, next + k * c->own, c->lengths + k * c->own, c->errors + k * errors};
        memcpy(c->close.arg, arg, sizeof(double *) * (c->follows ? 6 : 5));
        memcpy(c->close.res, res, sizeof(res));
        if (call(&c->close)) return NO_VALUE;
        memcpy(carry, carry + pair, sizeof(double) * pair);
    }
    *worst = greatest(c->errors, c->periods * errors);
    return DONE;
}

/* Move the actuators, and the nodes `own` (n, 3m), so that the tip moves by what it misses. */
static void steer(Chain *c, double *own)
{
    int T = c->tips;
    const double *missed = c->missing.res[0];
    for (int k = 0; k < c->actuators; k++) c->wanted[k] += dot(c->gain + k * T, missed, T);
    aim(c);
    for (int k = 0; k < c->periods * c->own; k++) own[k] += dot(c->gain_moved + (Index)k * T, missed, T);
}

/* Settle where the answer leads: lengths exact, the tip at its goal; see ChainEngine.settle. The place is `settled`. */
static int settle_chain(Chain *c)
{
    int has_gain = 0, steers = !c->follows;
    double worst;
    for (int count = 0;; count++) {
        int is_off = steers;
        if (close_once(c, c->settled, c->next, &worst)) return NO_VALUE;
        if (steers && count) {
            c->off = tip_missing(c, c->settled);
            if (!(c->off <= c->start)) return UNSETTLED;
            is_off = c->off > c->enough_tip;
        }
        if (!(is_off || !(worst <= c->enough_length)) || count == c->closing_steps || !(worst < c->too_far)) break;
        if (steers && tip_missing(c, c->next) > c->enough_tip) {
            int code = has_gain ? DONE : find_gain(c);
            if (code && code != INFEASIBLE) return code;
            has_gain = steers = !code;
            if (has_gain) steer(c, c->next);
        }
        double *other = c->settled;
        c->settled = c->next;
        c->next = other;
    }
    c->error = worst;
    c->off = tip_missing(c, c->settled);
    return DONE;
}

/* Whether the members are as long as they shall be, and the actuators in their boxes. */
static int is_closed(const Chain *c)
{
    if (!(c->error <= c->member_error)) return 0;
    for (int k = 0; k < c->actuators && c->follows; k++) {
        double length = c->lengths[c->stroke_at[k]];
        if (!(length <= c->upper[k] + c->enough_length && length >= c->lower[k] - c->enough_length)) return 0;
    }
    return 1;
}

/* Follow the answer from q, and settle. */
EXPORT int chain_depart(Chain *c, double tolerance)
{
    if (!(c->primal <= tolerance && c->dual <= tolerance)) return INACCURATE;
    c->reached = reached_by(*c->progress, c->step, c->velocity, c->spin, c->left);
    *(double *)c->missing.arg[5] = c->reached - *c->progress;
    c->furthest = 0.0;
    for (int k = 0; k < c->periods * c->own; k++) {
        double moved = c->displaced[c->own + k];
        c->settled[k] = c->q[3 * c->node[k / 3] + k % 3] + moved;
        c->begun[3 * c->node[k / 3] + k % 3] = c->settled[k];
        /* NaN stays. */
        if (fabs(moved) > c->furthest || moved != moved) c->furthest = fabs(moved);
    }
    for (int k = 0; k < 3 * c->vertices; k++) c->points[k] += c->shift[k];
    if (!(c->furthest < INFINITY)) return UNSETTLED;
    for (int k = 0; k < c->actuators; k++) c->wanted[k] = c->lengths[c->stroke_at[k]] + c->x[k];
    aim(c);
    for (int k = 0; k < c->periods * c->stations; k++)
        on_curve(c, c->weight + k * c->vertices, c->points, c->curve_aim + 3 * k);
    int code = settle_chain(c);
    if (code) return code;
    for (int k = 0; k < c->periods * c->own; k++) {
        c->q[3 * c->node[k / 3] + k % 3] = c->settled[k];
        c->quantities[c->member[k]] = c->lengths[k];
    }
    if (!is_closed(c)) return c->follows ? OFF_CURVE : UNSETTLED;
    return c->off <= c->tip_error ? DONE : UNSETTLED;
}

/* Solve, follow the answer from q, and settle. OFF_CURVE says that q is settled but for actuators beyond their boxes. */
EXPORT int chain_move(Chain *c, double tolerance)
{
    int code = chain_assemble(c);
    if (!code) code = chain_answer(c);
    return code ? code : chain_depart(c, tolerance);
}
