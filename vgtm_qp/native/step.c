/* A step of an arm in one call: near pairs, QP, settling, the checks of the new state and the proof of the way there.

   It is for arms among pairs that a Way holds. The caller fills in goal and
   boxes among the arguments of the QP's function. A long arm's QP is a Chain's; then the Fused has the input, in the
   order of StepGraph.inputs, and names the places of the answer, but has no functions. Anything unusual ends the step with
   a code and leaves the state as it was; the caller then asks for a further QP, or takes the step by other means. */

#include <time.h>

typedef struct {
    Fused *fused;
    Chain *chain;                  /* or null */
    Way *way;                      /* null if no two bodies, and no body and piece, can ever be near */
    /* See arm.Arithmetic; without an eval the nodes are q, or move straight. (tip's nodes) -> its rotation. */
    Kernel place, bend, frame;
    /* See arm.Ends; without an eval the points of the bodies are the nodes. */
    Kernel spread, end;
    int slots, span;                       /* nodes of a row of clearance; coordinates of all points */
    const int *end_nodes;                  /* (P, 3) */
    const double *offset;                  /* (P, 3) */

    /* Numbers of: coordinates of the nodes; quantities; coordinates of q that only the base moves, and these; the axes of
       the tip's position, and these. */
    int width, quantities, based;
    const int *base;
    int axes;
    const int *axis;
    int distances;                         /* see arm.Arithmetic */
    const int *first, *last, *actuator;    /* (M), (M), (n_a) */
    const double *multiplier, *home;       /* (M) */
    const double *levers;                  /* (coordinates) bounds of how far a node moves per change of each; or null */
    const double *tip_weight;              /* (K) of the tip's nodes */
    int turns;                             /* coordinates of the tip's turn that are tracked: 0, 2 for its z-axis, or 3 */
    double unit;                           /* of the arm, m: by which angles become lengths */

    /* The curve of the next state from where it was settled, see ending_function and gap_function; between them, where
       constant tables do not give these, the nodes of that curve. Without eval if there is none. */
    Kernel ending, curve_nodes, gaps;
    int must_track;                        /* whether stations must be on the curve */

    /* Clearances, the margin of their rows, the distance of pairs that are far, rounding of a distance; the bounds of
       pairs in a step that moves the arm, see rows/clearance.py. */
    double safe, self_safe, margin, influence, rounding;
    Kernel allowed;
    double between, deviation;             /* violation that is allowed between states; greatest deviation from chords */
    /* Whether another program supplies the contacts of rows that press. Its unit of length per m; the greatest flaw of a
       proven answer, and the least distance of axes that have one, m. */
    int asks;
    double scale, flaw, apart;
    /* Ratio of the displacement for which pairs are listed to the expected one; share of the last motion expected;
       and that of the limits of pairs that the next step may have. */
    double motion_margin, share, ahead;
    /* Greatest displacements of nodes and of control vertices; tolerances of a state: of quantities, of the tip, of
       stations on the curve, and rounding over the configuration's norm. */
    double furthest, leap, member, tip, tracking, relative;
    double tolerance;                      /* of the QP's residuals */

    /* The state, and the next one: q, nodes, (V, 3) control vertices, quantities, the last motion of q; of the next also
       the rates of the quantities over the duration, and the tip's position and rotation (3, 3), row by row. */
    double *q, *nodes, *vertices, *values, *motion;
    double time, next_time, drift;         /* s; how far the fastest piece moves between them, m */
    int moves;                             /* whether the base moves; q and the nodes when it alone has moved */
    double *based_q, *based_nodes;
    double *next_q, *next_nodes, *next_vertices, *next_values, *next_motion, *next_rates, *next_tip;
    double duration;
    double *points, *next_points;          /* (P, 3) those of the bodies; the nodes where they are the same */
    double *places;                        /* (MOST_PIECES + 1, P, 3) */

    /* Rows of clearance: their contacts (R, size), numbers of group and pair, in which round they were asked for, 0 in none
       and -1 for a hull that presses, and body, other and whether that is a body (R, 3); middle and span of the body and
       of the other body (R, 12), and the answer (R, 7): a distance, a point of the body and one of the other. Counts of
       rounds, of rows asked for, of answers that were proven, and of rows of hulls that press. */
    int room, round, asked_for, proven, unasked;
    double *contacts, *questions, *answers;
    int *group, *pair, *asked, *named;

    /* Whether the QP corrects what one before it left, and whether the last answer was settled; the points (P, 3) and the
       nodes (N, 3) where the QP is linearised, and the time. */
    int corrects, settled;
    const double *at, *nodes_at;
    double at_time;
    double reach, limit, self_limit, gap;
    double *spent;                         /* (3) s in each phase so far: distance, QP, acceptance */
} StepData;

enum { DISTANCE, QP, ACCEPTANCE };

/* Greatest number of pieces into which a motion is cut if points leave their chords. */
enum { MOST_PIECES = 16 };

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void spend(double *phase, double *mark)
{
    double time = now();
    *phase += time - *mark;
    *mark = time;
}

/* A row over the displacement of a point of a body, `part` (3), as one over its nodes (3) and their displacements (3, 3). */
static int over_nodes(StepData *s, int point, const double *part, int *nodes, double *row)
{
    for (int k = 0; k < 3; k++) {
        nodes[k] = s->end_nodes[3 * point + k];
        memcpy((double *)s->end.arg[0] + 3 * k, s->nodes_at + 3 * nodes[k], 3 * sizeof(double));
    }
    memcpy((double *)s->end.arg[1], s->offset + 3 * point, 3 * sizeof(double));
    if (call(&s->end)) return NO_VALUE;
    for (int i = 0; i < 9; i++) row[i] = dot(part, s->end.res[1] + 3 * i, 3);
    return DONE;
}

/* Contact k of the rows. */
static double *contact_of(const StepData *s, int k)
{
    return s->contacts + s->way->size * k;
}

/* The row of contact k, see rows/clearance.py; of a QP that moves the arm, limited so that a zero step is allowed and
   pairs slow down. */
static int clearance_row(StepData *s, int k)
{
    Fused *f = s->fused;
    const double *contact = contact_of(s, k), *normal = contact + normal_at(s->way);
    const Pairs *p = s->way->group[s->group[k]];
    int *nodes = f->near_nodes + s->slots * k;
    double *rows = f->near_rows + 3 * s->slots * k, part[3];
    for (int i = 0; i < 2 * s->way->span; i++) {
        int point = point_of(s->way, p, s->pair[k], i);
        for (int a = 0; a < 3; a++) part[a] = contact[1 + i] * normal[a];
        if (s->end.eval) {
            if (over_nodes(s, point, part, nodes + 3 * i, rows + 9 * i)) return NO_VALUE;
            continue;
        }
        nodes[i] = point;
        memcpy(rows + 3 * i, part, sizeof(part));
    }
    double lower = (p->is_self ? s->self_safe : s->safe) + s->margin - contact[0];
    if (!s->corrects) {
        double **arg = (double **)s->allowed.arg;
        const double *velocity = s->way->velocity + (p->is_self ? 0 : 3 * p->listed[s->pair[k]].other);
        *arg[0] = lower;
        *arg[2] = p->is_self ? 0.0 : s->duration * dot(normal, velocity, 3);
        if (call(&s->allowed)) return NO_VALUE;
        lower = *s->allowed.res[0];
    }
    f->near_lower[k] = lower;
    /* Of the base's nodes the displacement is known; see ClearanceRows. */
    for (int i = 0; i < s->slots && s->moves && !s->corrects; i++) {
        if (f->node_column[nodes[i]] >= 0) continue;
        for (int a = 0; a < 3; a++)
            f->near_lower[k] -= rows[3 * i + a] * (s->based_nodes[3 * nodes[i] + a] - s->nodes[3 * nodes[i] + a]);
    }
    return DONE;
}

/* The rows of all contacts nearer than the limits. */
static int list_rows(StepData *s)
{
    Way *w = s->way;
    int count = 0;
    s->fused->slots = s->slots;
    s->fused->near = s->round = s->asked_for = s->proven = s->unasked = 0;
    if (!w) return DONE;
    int code = see(w, s->at, s->at_time, s->limit, s->self_limit);
    if (code) return code;
    for (int g = 0; g < w->groups; g++) {
        const Pairs *p = w->group[g];
        double limit = p->is_self ? s->self_limit : s->limit;
        if (p->near && p->overlaps) return OVERLAPPING;
        for (int i = 0; i < w->each * p->near; i++) {
            const double *contact = p->contacts + w->size * i;
            if (!(contact[0] < limit)) continue;
            if (count == s->room) return CROWDED;
            memcpy(contact_of(s, count), contact, w->size * sizeof(double));
            s->group[count] = g;
            s->pair[count] = (int)p->rows[i / w->each];
            s->named[3 * count] = p->listed[s->pair[count]].body;
            s->named[3 * count + 1] = p->listed[s->pair[count]].other;
            s->named[3 * count + 2] = p->is_self;
            s->asked[count] = 0;
            if (clearance_row(s, count++)) return NO_VALUE;
        }
    }
    s->fused->near = count;
    return DONE;
}

/* The points of the bodies at q, where they are no copy of it: `points` (P, 3). */
static int spread_at(StepData *s, const double *q, double *points)
{
    const Kernel *kernel = s->spread.eval ? &s->spread : &s->place;
    memcpy((double *)kernel->arg[0], q, sizeof(double) * s->fused->coordinates);
    if (call(kernel)) return NO_VALUE;
    memcpy(points, kernel->res[0], sizeof(double) * s->span);
    return DONE;
}

/* Write the point at which the QP is linearised: residuals at q, Jacobians in the middle of the expected motion. */
static int load(StepData *s)
{
    Fused *f = s->fused;
    double **arg = (double **)f->condense.arg;
    memcpy(arg[0], s->q, sizeof(double) * f->coordinates);
    for (int i = 0; i < f->coordinates; i++) arg[1][i] = s->q[i] + 0.5 * s->share * s->motion[i];
    memcpy(arg[2], s->based_nodes, sizeof(double) * s->width);
    memcpy(arg[3], s->vertices, sizeof(double) * 3 * f->vertices);
    arg[6][0] = 1.0;
    arg[7][0] = 0.0;
    s->corrects = 0;
    s->at = s->points;
    s->at_time = s->time;
    s->nodes_at = s->nodes;
    return s->spread.eval ? spread_at(s, s->q, s->points) : DONE;
}

/* Set the distances below which pairs can become active where nodes move by the reach, and pieces by the drift. */
static void set_limits(StepData *s, double drift)
{
    s->limit = fmin(s->influence, s->safe + s->reach + drift);
    s->self_limit = fmin(s->influence, s->self_safe + 2.0 * (s->reach + drift));
}

/* The reach of the step, and the limits. */
static void look_ahead(StepData *s)
{
    Fused *f = s->fused;
    double last = 0.0, asked = 0.0;
    for (int i = 0; i < f->coordinates; i++) {
        double moved = fabs(s->share * s->motion[i]);
        last = s->levers ? last + moved * s->levers[i] : fmax(last, moved);
    }
    for (int a = 0; a < 3; a++) asked = fmax(asked, fabs(f->velocity[a]));
    s->reach = s->influence;
    if (s->share >= 1.0) s->reach = s->motion_margin * (s->moves || last == 0.0 ? s->influence : fmax(last, asked));
    set_limits(s, s->drift);
}

/* Set up the QP at the input. */
static int assemble_qp(StepData *s)
{
    Chain *c = s->chain;
    if (!c) return assemble(s->fused);
    c->near = s->fused->near;
    if (c->slots != s->slots) c->pressing = 0;
    c->slots = s->slots;
    if (!*c->motion) memset(c->pull, 0, sizeof(double) * 3 * c->vertices);
    return chain_assemble(c);
}

/* Solve the QP that was set up, with its rows of clearance. */
static int answer_qp(StepData *s)
{
    return s->chain ? chain_answer(s->chain) : answer(s->fused);
}

/* Follow the answer from the configuration `q`, in which the base is where it is after the step, and settle. */
static int depart_from(StepData *s, const double *q)
{
    Fused *f = s->fused;
    Chain *c = s->chain;
    if (!c) return depart(f, q, s->tolerance);
    memcpy(c->begun, q, sizeof(double) * f->coordinates);
    int code = chain_depart(c, s->tolerance);
    f->reached = c->reached;
    f->furthest = c->furthest;
    return code;
}

/* The multipliers of the rows of clearance. */
static const double *near_multipliers(const StepData *s)
{
    const Fused *f = s->fused;
    if (s->chain) return s->chain->every + near_at(s->chain);
    return f->multipliers + f->unknowns + f->tips + f->hard + f->legs;
}

/* Ask for the contacts of all rows, or of those that press: whose multipliers are not zero. Those that were asked for
   before are left out, and those of hulls, which are counted; return whether there are others. */
static int ask_for(StepData *s, int all)
{
    Fused *f = s->fused;
    const double *multiplier = near_multipliers(s);
    int before = s->asked_for;
    s->round++;
    for (int k = 0; k < f->near; k++) {
        if (s->asked[k] || !(all || fabs(multiplier[k]) > 0.0)) continue;
        const Pairs *p = s->way->group[s->group[k]];
        if (has_hull(s->way, p, s->pair[k])) {
            s->asked[k] = -1;
            s->unasked++;
            continue;
        }
        double ends[6];
        ends_for(s->way, p, s->pair[k], s->at, contact_of(s, k), ends);
        axis_of(ends, s->scale, s->questions + 12 * k);
        if (p->is_self) {
            for (int i = 0; i < 2; i++)
                memcpy(ends + 3 * i, s->at + 3 * point_of(s->way, p, s->pair[k], s->way->span + i), 3 * sizeof(double));
            axis_of(ends, s->scale, s->questions + 12 * k + 6);
        }
        s->asked[k] = s->round;
        s->asked_for++;
    }
    return s->asked_for > before;
}

/* Use the answers of this round that are proven. */
static int use_answers(StepData *s)
{
    for (int k = 0; k < s->fused->near; k++) {
        if (s->asked[k] != s->round) continue;
        double answer[7];
        for (int i = 0; i < 7; i++) answer[i] = s->answers[7 * k + i] / s->scale;
        Pairs *p = s->way->group[s->group[k]];
        if (!prove(s->way, p, s->pair[k], answer, s->flaw, s->apart, contact_of(s, k))) continue;
        s->proven++;
        if (clearance_row(s, k)) return NO_VALUE;
    }
    return DONE;
}

/* C (3, 3) = A B, column by column. */
static void product(const double *A, const double *B, double *C)
{
    for (int j = 0; j < 3; j++)
        for (int i = 0; i < 3; i++) C[3 * j + i] = A[i] * B[3 * j] + A[3 + i] * B[3 * j + 1] + A[6 + i] * B[3 * j + 2];
}

/* The rotation (3, 3), column by column, by |vector| about it. */
static void rotation_by(const double *vector, double *R)
{
    double angle = norm(vector, 3), c = cos(angle), axis[3];
    double s = angle > 0.0 ? sin(angle) / angle : 1.0;
    for (int a = 0; a < 3; a++) axis[a] = angle > 0.0 ? vector[a] / angle : 0.0;
    for (int j = 0; j < 3; j++)
        for (int i = 0; i < 3; i++) R[3 * j + i] = (1.0 - c) * axis[i] * axis[j] + (i == j ? c : 0.0);
    for (int k = 0; k < 3; k++) {
        int i = (k + 1) % 3, j = (k + 2) % 3;
        R[3 * i + j] += s * vector[k];
        R[3 * j + i] -= s * vector[k];
    }
}

/* The goal's rotation (3, 3), column by column, where the answer led. */
static void turned_goal(const StepData *s, double *goal)
{
    const Fused *f = s->fused;
    double spin[3], turning[9];
    for (int a = 0; a < 3; a++) spin[a] = *f->gone * f->spin[a];
    rotation_by(spin, turning);
    product(turning, f->condense.arg[9], goal);
}

/* The angle, rad, from the tip's z-axis or orientation, as its nodes have it, to the goal's. */
static double turn_missing(StepData *s)
{
    const Fused *f = s->fused;
    double goal[9], w[3] = {0.0, 0.0, 0.0}, cosine = 0.0;
    for (int k = 0; k < f->tip_nodes; k++)
        memcpy((double *)s->frame.arg[0] + 3 * k, s->next_nodes + 3 * f->tip_node[k], sizeof(double) * 3);
    if (call(&s->frame)) return NAN;
    const double *tip = s->frame.res[0];
    turned_goal(s, goal);
    if (s->turns == 2) {
        cross(tip + 6, goal + 6, w);
        cosine = dot(tip + 6, goal + 6, 3);
    } else {
        /* Of the rotation from one to the other: its axis times twice its sine, and twice its cosine. */
        for (int j = 0; j < 3; j++) {
            double part[3];
            cross(tip + 3 * j, goal + 3 * j, part);
            for (int a = 0; a < 3; a++) w[a] += part[a];
        }
        cosine = dot(tip, goal, 9) - 1.0;
    }
    return atan2(norm(w, 3), cosine);
}

/* Whether the state that was settled keeps its quantities, its limits and its goal, measured anew by plain arithmetic. */
static int is_flawless(StepData *s)
{
    Fused *f = s->fused;
    const double *x = s->next_nodes, *ends = s->next_points, *lower = f->condense.arg[4], *upper = f->condense.arg[5];
    double rounding = s->relative * norm(f->q, f->coordinates), beyond = 0.0, wrong = 0.0, off = 0.0;
    for (int i = 0; i < s->based; i++)
        if (f->q[s->base[i]] != s->based_q[s->base[i]]) return 0;
    for (int m = 0, k = 0; m < s->quantities; m++) {
        double value = s->distances ? sqrt(square_of(ends + 3 * s->first[m], ends + 3 * s->last[m]))
                                    : f->q[s->first[m]] - s->multiplier[m] * f->q[s->last[m]];
        int is_actuator = k < f->actuators && s->actuator[k] == m;
        double least = is_actuator ? lower[k] : s->home[m], greatest = is_actuator ? upper[k] : s->home[m];
        double out = fmax(value - greatest, least - value);
        if (!(out <= 0.0)) beyond += out * out;
        wrong += (value - s->next_values[m]) * (value - s->next_values[m]);
        k += is_actuator;
    }
    /* An elastic tip with a slack need not be at its goal. */
    int is_free = tip_slack(f) > f->tip_error;
    for (int i = 0; i < s->axes && !is_free; i++) {
        double error = f->condense.arg[8][s->axis[i]] + *f->gone * f->velocity[s->axis[i]];
        for (int k = 0; k < f->tip_nodes; k++) error -= s->tip_weight[k] * x[3 * f->tip_node[k] + s->axis[i]];
        off += error * error;
    }
    if (s->turns && !is_free) {
        double error = s->unit * turn_missing(s);
        off += error * error;
    }
    /* NaN fails the comparisons. */
    return sqrt(beyond) <= s->member + rounding && sqrt(wrong) <= s->member + rounding && sqrt(off) <= s->tip + rounding;
}

/* The curve of the next state, whose end linear rows leave a small way from the tip, and the gaps of its stations. */
static int end_curve(StepData *s)
{
    if (!s->ending.eval) return DONE;
    if (call(&s->ending)) return NO_VALUE;
    if (*s->ending.res[1] != 0.0) return FLAWED;
    if (s->curve_nodes.eval && (call(&s->curve_nodes) || *s->curve_nodes.res[2] != 1.0)) return NO_VALUE;
    if (call(&s->gaps)) return NO_VALUE;
    s->gap = *s->gaps.res[0];
    return s->must_track && !(s->gap <= s->tracking) ? OFF_CURVE : DONE;
}

/* Whether every pair keeps its clearance at the present place of the way. */
static int is_clear(const StepData *s)
{
    if (!(s->way->far >= s->safe - s->rounding && self_far_of(s->way) >= s->self_safe - s->rounding)) return 0;
    for (int g = 0; g < s->way->groups; g++) {
        const Pairs *p = s->way->group[g];
        double floor = (p->is_self ? s->self_safe : s->safe) - s->rounding;
        for (int k = 0; k < p->count; k++)
            if (!(p->listed[k].lower >= floor)) return 0;
    }
    return 1;
}

/* Prove the way to the next state in a number of pieces on which q moves straight, each with `spare` added to its floors. */
static int pass(StepData *s, int pieces, double spare)
{
    const Fused *f = s->fused;
    Way *w = s->way;
    int size = s->span;
    /* A try before this one may have led away. */
    int code = is_at(w, s->points, s->time) ? DONE : go_to(w, s->points, s->time);
    if (code) return code;
    memcpy(s->places, s->points, sizeof(double) * size);
    for (int k = 1; k < pieces; k++) {
        double share = (double)k / pieces, *q = f->work;
        for (int i = 0; i < f->coordinates; i++) q[i] = (1.0 - share) * s->q[i] + share * s->next_q[i];
        if (spread_at(s, q, s->places + k * size)) return NO_VALUE;
    }
    memcpy(s->places + pieces * size, s->next_points, sizeof(double) * size);
    w->pieces = pieces;
    w->places = s->places;
    w->start = s->time;
    w->end = s->next_time;
    w->floor = s->safe + spare;
    w->self_floor = fmax(s->self_safe + spare, 0.0);
    code = prove_path(w);
    /* Where the proof lacks room, the QP need not be solved again: the caller's own proof makes room. */
    return code == FULL ? NOT_PROVEN : code;
}

/* Whether the next state, the way to which is proven or not, as `code` says, keeps all clearances itself. */
static int judge(StepData *s, int code)
{
    if (code && code != NOT_PROVEN) return code;
    if (code && see(s->way, s->next_points, s->next_time, s->safe, s->self_safe)) return NOT_PROVEN;
    return is_clear(s) ? code : TOO_NEAR;
}

/* Prove the way to the next state; see Separation.between. */
static int prove_way(StepData *s)
{
    if (!s->bend.eval) {
        int code = s->way ? pass(s, 1, -s->rounding) : DONE;
        return code ? judge(s, code) : DONE;
    }
    double **arg = (double **)s->bend.arg;
    memcpy(arg[0], s->q, sizeof(double) * s->fused->coordinates);
    memcpy(arg[1], s->next_q, sizeof(double) * s->fused->coordinates);
    if (call(&s->bend)) return NO_VALUE;
    double deviation = 0.25 * fmax(s->bend.res[0][0], s->bend.res[0][1]);
    if (!(deviation < s->deviation)) return FLAWED;
    if (!s->way) return DONE;
    /* In k pieces, the deviation from the chords is 1 / k^2 of the whole. Most motions need only one piece. */
    double needed = deviation >= s->unit ? 1.0 : fmin(ceil(sqrt(fmax(deviation / s->between, 1.0))), MOST_PIECES);
    int pieces = (int)needed, code = pass(s, 1, deviation - s->between);
    if (code == NOT_PROVEN && pieces > 1) code = pass(s, pieces, deviation / (needed * needed) - s->between);
    return judge(s, code);
}

/* Whether the answer led too far, or to no place at all: q, and the curve's vertices `points`. */
static int leaps(const StepData *s, const double *q, const double *points)
{
    const Fused *f = s->fused;
    double furthest = 0.0;
    if (!(f->furthest < s->furthest)) return 1;
    for (int k = 0; k < 3 * f->vertices; k++) furthest = fmax(furthest, fabs(points[k] - s->vertices[k]));
    return !(furthest < s->leap && norm(q, f->coordinates) + norm(points, 3 * f->vertices) < INFINITY);
}

/* Write the nodes and the points of the bodies at q to those of the next state. */
static int put_nodes(StepData *s, const double *q)
{
    const double *nodes = q;
    if (s->place.eval) {
        memcpy((double *)s->place.arg[0], q, sizeof(double) * s->fused->coordinates);
        if (call(&s->place)) return NO_VALUE;
        nodes = s->place.res[0];
    }
    memcpy(s->next_nodes, nodes, sizeof(double) * s->width);
    return s->spread.eval ? spread_at(s, q, s->next_points) : DONE;
}

/* Check where the answer led, and prove the way there. */
static int arrive(StepData *s)
{
    Fused *f = s->fused;
    if (leaps(s, f->q, f->points)) return FLAWED;
    memcpy(s->next_q, f->q, sizeof(double) * f->coordinates);
    if (put_nodes(s, f->q)) return NO_VALUE;
    memcpy(s->next_values, f->close.res[1], sizeof(double) * s->quantities);
    if (!is_flawless(s)) return FLAWED;
    int code = end_curve(s);
    if (code) return code;
    for (int i = 0; i < f->coordinates; i++) s->next_motion[i] = s->next_q[i] - s->q[i];
    for (int m = 0; m < s->quantities; m++) s->next_rates[m] = (s->next_values[m] - s->values[m]) / s->duration;
    memcpy(s->next_tip, f->missing.res[1], sizeof(double) * 3);
    for (int a = 0; a < 3; a++)
        for (int b = 0; b < 3; b++) s->next_tip[3 + 3 * a + b] = f->missing.res[2][3 * b + a];
    return prove_way(s);
}

/* Answer the QP; go there, unless rows press whose contacts are to be asked for first. */
static int proceed(StepData *s, double *mark)
{
    Fused *f = s->fused;
    int code = answer_qp(s);
    if (!code && s->asks && !f->other && ask_for(s, 0)) code = ASKS;
    else if (!code) {
        code = depart_from(s, s->corrects ? f->condense.arg[0] : s->based_q);
        s->settled = !code;
        if (code == UNSETTLED && leaps(s, f->started, f->started_points)) code = FLAWED;
    }
    spend(&s->spent[QP], mark);
    if (code) return code;
    code = arrive(s);
    spend(&s->spent[ACCEPTANCE], mark);
    return code;
}

/* List the rows of the QP that was loaded, assemble it, and go where its answer leads. */
static int solve_step(StepData *s, double *mark)
{
    int code = list_rows(s);
    spend(&s->spent[DISTANCE], mark);
    if (code) return code;
    if (s->way) {
        s->way->wanted = s->ahead * s->limit;
        s->way->self_wanted = s->ahead * s->self_limit;
    }
    code = assemble_qp(s);
    /* A solver that only comes near zero does not say which rows press, and is too slow to be asked twice. */
    if (!code && s->asks && s->fused->other && ask_for(s, 1)) code = ASKS;
    spend(&s->spent[QP], mark);
    return code ? code : proceed(s, mark);
}

/* Take the step from the state. */
EXPORT int take(StepData *s)
{
    double mark = now();
    look_ahead(s);
    int code = load(s);
    return code ? code : solve_step(s, &mark);
}

/* Go on with a step that asked for contacts. */
EXPORT int resume(StepData *s)
{
    double mark = now();
    int code = use_answers(s);
    spend(&s->spent[DISTANCE], &mark);
    return code ? code : proceed(s, &mark);
}

/* Take the step by a further QP, linearised where the last one led, which returns to the constraints by the least
   displacement: after an answer that was not settled, a state too near to something, or stations off the curve. It may be
   called again where there was no room for its rows. */
EXPORT int correct(StepData *s)
{
    Fused *f = s->fused;
    double mark = now(), **arg = (double **)f->condense.arg;
    const double *q = s->settled ? f->q : f->started;
    if (!s->settled && put_nodes(s, q)) return NO_VALUE;
    memcpy(arg[0], q, sizeof(double) * f->coordinates);
    memcpy(arg[1], q, sizeof(double) * f->coordinates);
    memcpy(arg[2], s->next_nodes, sizeof(double) * s->width);
    memcpy(arg[3], s->settled ? f->points : f->started_points, sizeof(double) * 3 * f->vertices);
    if (f->torsion) {
        const double *torsions = s->settled ? f->torsions : f->started_torsions;
        memcpy((double *)f->curve.arg[1], torsions, sizeof(double) * f->torsion);
    }
    for (int a = 0; a < 3; a++) arg[8][a] += *f->gone * f->velocity[a];
    if (s->turns) {
        double goal[9];
        turned_goal(s, goal);
        memcpy(arg[9], goal, sizeof(goal));
    }
    *f->gone = arg[6][0] = 0.0;
    arg[7][0] = f->reached;
    s->corrects = 1;
    s->at = s->next_points;
    s->at_time = s->next_time;
    s->nodes_at = s->next_nodes;
    /* A pair that one correction pushed apart must stay listed for the next, or two corrections alternate. */
    s->reach = fmax(s->reach, f->furthest);
    set_limits(s, 0.0);
    return solve_step(s, &mark);
}
