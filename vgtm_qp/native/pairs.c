/* Pairs of bodies and pieces over straight motions: which may have come near, and the contacts of these. */

/* Lengths of the arrays of follow_function: ends of a pair before and after a motion; known, whose last three
   numbers are a normal; the two contacts, whose normals are numbers 5 to 7 of each, from 0. */
enum { ENDS = 24, KNOWN = 19, KNOWN_NORMAL = 16, CONTACTS = 18, CONTACT = 9, NORMAL = 5 };

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

/* Pairs of one shape, each with a lower bound of its distance. */
typedef struct {
    int count, is_self;
    const int *body, *other, *points;    /* (C), (C), (C, 4) */
    double *lower, *known;               /* (C), (C, 19): see follow_function; of a piece as it is at time 0 */
    const double *velocity, *speed;      /* (C, 3), (C) of the pieces, m/s; null where none moves */
    double next;                         /* if no pair is near, pairs below next * limit are evaluated too */

    Kernel contact;                      /* (ends 24, known 19) -> 18 numbers of contacts, and a bound */
    double *ends, *pair;
    const double *found;

    Kernel proof;                        /* (pair, answer 7) -> contact 9, its last number the flaw; or no eval */
    double *proof_pair, *answer;
    const double *proven;

    int near, is_close, overlaps;
    double lowest;                       /* least lower bound over the motion of the evaluated pairs */
    Index *rows;                         /* (C): the evaluated pairs */
    double *contacts;                    /* (2 C, 9): two for each */
} Pairs;

/* The motion of a part of an arm: displacement of its centre, turn, and how far points leave that motion; the centre, and
   how far points are from it. */
typedef struct { double centre[3], shift[3], turn[3], off, reach; } Rigid;

/* The path of an arm in straight pieces, each from one place of all its points to the next. */
typedef struct {
    int pieces, points, bodies, groups;
    const int *ends;                 /* (B, 2) points */
    const double *places;            /* (K + 1, P, 3) */
    double start, end;               /* times at both ends, s */
    double furthest;                 /* bound of the sum of the squares of displacements */
    Pairs **group;                   /* (G) */
    /* Distances to prove from pieces and between bodies, and those below which pairs are evaluated at the end. */
    double floor, self_floor, limit, self_limit;

    double *place, time;             /* (P, 3), s: the present ones, where pairs nearer than the reach are evaluated */
    double reach, self_reach, wanted, self_wanted;    /* wanted: the reach of the next place */
    /* Lower bounds of the distances of pairs that no group has: from pieces, the fastest of which has that speed, m/s;
       between bodies in parts of the arm that are near to each other, and in others. The points of each part, and where
       they begin; the greatest radius of its bodies; the later parts that it is near to, itself the first of them. */
    double far, self_far, parted, fastest;
    int parts;
    const int *part_points, *points_at, *neighbour, *neighbours_at;
    const double *thickness;
    Rigid *part;                           /* (parts) */
    int lost;                        /* whether a pair had no value, so that nothing is known of any */

    double *middle, *turned, *moved; /* (B, 3), (B), (B): of each axis in the present piece the displacement
                                        of its middle, half that between its ends, the greater of its ends' */
    double since, until;             /* times at both ends of that piece */
    int done;                        /* number of pieces that were followed */
} Way;

static void displace(Way *w, const double *before, const double *after)
{
    for (int b = 0; b < w->bodies; b++) {
        double square[3] = {0.0, 0.0, 0.0};
        const int *ends = w->ends + 2 * b;
        for (int a = 0; a < 3; a++) {
            double first = after[3 * ends[0] + a] - before[3 * ends[0] + a];
            double second = after[3 * ends[1] + a] - before[3 * ends[1] + a];
            w->middle[3 * b + a] = 0.5 * (first + second);
            square[0] += first * first;
            square[1] += second * second;
            square[2] += 0.25 * (second - first) * (second - first);
        }
        w->turned[b] = sqrt(square[2]);
        w->moved[b] = sqrt(square[0] > square[1] ? square[0] : square[1]);
    }
}

/* Write the centre of part k at a place, and how far its points are from it. */
static void place_part(const Way *w, int k, const double *place)
{
    Rigid *part = w->part + k;
    const int *first = w->part_points + w->points_at[k], *last = w->part_points + w->points_at[k + 1];
    double square = 0.0, *centre = part->centre;
    centre[0] = centre[1] = centre[2] = 0.0;
    for (const int *p = first; p < last; p++)
        for (int a = 0; a < 3; a++) centre[a] += place[3 * *p + a] / (double)(last - first);
    for (const int *p = first; p < last; p++) square = fmax(square, square_of(centre, place + 3 * *p));
    part->reach = sqrt(square);
}

/* Write the motion of part k from one place to another, its turn by least squares. */
static void move_part(const Way *w, int k, const double *before, const double *after)
{
    Rigid *part = w->part + k;
    const int *first = w->part_points + w->points_at[k], *last = w->part_points + w->points_at[k + 1];
    double inertia[9] = {0.0}, moment[3] = {0.0}, r[3], moved[3], part_of[3], square = 0.0, trace = 0.0;
    place_part(w, k, before);
    memset(part->shift, 0, sizeof(part->shift));
    for (const int *p = first; p < last; p++)
        for (int a = 0; a < 3; a++) part->shift[a] += (after[3 * *p + a] - before[3 * *p + a]) / (double)(last - first);
    for (const int *p = first; p < last; p++) {
        for (int a = 0; a < 3; a++) {
            r[a] = before[3 * *p + a] - part->centre[a];
            moved[a] = after[3 * *p + a] - before[3 * *p + a];
        }
        cross(r, moved, part_of);
        for (int a = 0; a < 3; a++) {
            moment[a] += part_of[a];
            inertia[4 * a] += dot(r, r, 3);
            for (int b = 0; b < 3; b++) inertia[3 * a + b] -= r[a] * r[b];
        }
    }
    for (int a = 0; a < 3; a++) trace += inertia[4 * a];
    for (int a = 0; a < 3; a++) inertia[4 * a] += 1e-9 * trace;
    memcpy(part->turn, moment, sizeof(moment));
    /* Points that coincide have no turn. */
    if (trace > 0.0) solve_for(inertia, part->turn, 3, 1);
    for (const int *p = first; p < last; p++) {
        for (int a = 0; a < 3; a++) {
            r[a] = before[3 * *p + a] - part->centre[a];
            moved[a] = after[3 * *p + a] - before[3 * *p + a] - part->shift[a];
        }
        cross(part->turn, r, part_of);
        square = fmax(square, square_of(part_of, moved));
    }
    part->off = sqrt(square);
}

/* By how much two bodies of near parts come nearer at most on the straight way from one place to another. For any w, two
   points r apart that move by w x r + d against each other come nearer by |d| at most: |r + s w x r| is never below |r|. */
static double bending(const Way *w, const double *before, const double *after)
{
    double most = 0.0;
    for (int k = 0; k < w->parts; k++) move_part(w, k, before, after);
    for (int k = 0; k < w->parts; k++)
        for (int n = w->neighbours_at[k]; n < w->neighbours_at[k + 1]; n++) {
            const Rigid *p = w->part + k, *q = w->part + w->neighbour[n];
            double apart[3], turn[3], shift[3], by[3], change = p->off + q->off;
            for (int a = 0; a < 3; a++) {
                apart[a] = q->centre[a] - p->centre[a];
                turn[a] = 0.5 * (p->turn[a] + q->turn[a]);
                shift[a] = q->shift[a] - p->shift[a];
            }
            cross(turn, apart, by);
            change += sqrt(square_of(by, shift)) + 0.5 * sqrt(square_of(p->turn, q->turn)) * (p->reach + q->reach);
            most = fmax(change, most);
        }
    return most;
}

/* A lower bound of the distances of bodies whose pairs no group has. */
static double self_far_of(const Way *w)
{
    return least_of(w->self_far, w->parted);
}

/* Find how far bodies of parts that are not near to each other are apart at the present place. */
EXPORT int measure_parts(Way *w)
{
    double least = INFINITY;
    for (int k = 0; k < w->parts; k++) {
        place_part(w, k, w->place);
        w->part[k].reach += w->thickness[k];
    }
    for (int k = 0; k < w->parts; k++) {
        const int *near = w->neighbour + w->neighbours_at[k], *last = w->neighbour + w->neighbours_at[k + 1];
        for (int q = k; q < w->parts; q++) {
            if (near < last && *near == q) {
                near++;
                continue;
            }
            double both = w->part[k].reach + w->part[q].reach;
            double square = square_of(w->part[k].centre, w->part[q].centre);
            if (least + both > 0.0 && square < (least + both) * (least + both)) least = sqrt(square) - both;
        }
    }
    w->parted = least;
    return DONE;
}

/* Replace points by where they are at a time from the piece of pair k: in a frame that moves with that, and is the
   world's at time 0. */
static void from_piece(const Pairs *p, int k, double time, int points, double *x)
{
    if (!p->velocity) return;
    for (int i = 0; i < 3 * points; i++) x[i] -= time * p->velocity[3 * k + i % 3];
}

/* Evaluate pair k over a straight motion between two times, from the known normal at its start. */
static int contact(Pairs *p, int k, const double *before, const double *after, double since, double until)
{
    for (int i = 0; i < 4; i++) {
        memcpy(p->ends + 3 * i, before + 3 * p->points[4 * k + i], 3 * sizeof(double));
        memcpy(p->ends + ENDS / 2 + 3 * i, after + 3 * p->points[4 * k + i], 3 * sizeof(double));
    }
    from_piece(p, k, since, 4, p->ends);
    from_piece(p, k, until, 4, p->ends + ENDS / 2);
    memcpy(p->pair, p->known + KNOWN * k, KNOWN * sizeof(double));
    if (call(&p->contact)) return NO_VALUE;
    memcpy(p->known + KNOWN * k + KNOWN_NORMAL, p->found + NORMAL, 3 * sizeof(double));
    return DONE;
}

/* The two ends of the body's axis (6) of pair k at `place`, for its `contact`: the nearest point twice where another
   contact has the other one. */
static void ends_for(const Pairs *p, int k, const double *place, const double *contact, double *ends)
{
    const double *a = place + 3 * p->points[4 * k], *b = place + 3 * p->points[4 * k + 1];
    double t = contact[2];
    int is_only = contact[CONTACT - 1] != 0.0;
    for (int i = 0; i < 3; i++) {
        double point = (1.0 - t) * a[i] + t * b[i];
        ends[i] = is_only ? a[i] : point;
        ends[3 + i] = is_only ? b[i] : point;
    }
}

/* Middle and span (6) of the axis between two ends (6), times `scale`. */
static void axis_of(const double *ends, double scale, double *axis)
{
    for (int i = 0; i < 3; i++) {
        axis[i] = scale * 0.5 * (ends[i] + ends[3 + i]);
        axis[3 + i] = scale * (ends[3 + i] - ends[i]);
    }
}

/* Replace the `contact` of pair k by an answer (7) about it at the present place and time, if that is proven: its flaw is
   no greater than `flaw`, and the axes are further apart than `apart`. Return whether it is. */
static int prove(const Way *w, Pairs *p, int k, const double *answer, double flaw, double apart, double *contact)
{
    const double *known = p->known + KNOWN * k, *place = w->place;
    double *pair = p->proof_pair, *radius = pair + (p->is_self ? 12 : KNOWN_NORMAL - 1 + 6);
    ends_for(p, k, place, contact, pair);
    if (p->is_self)
        for (int i = 0; i < 2; i++) memcpy(pair + 6 + 3 * i, place + 3 * p->points[4 * k + 2 + i], 3 * sizeof(double));
    else memcpy(pair + 6, known, (KNOWN_NORMAL - 1) * sizeof(double));
    *radius = known[KNOWN_NORMAL - 1];
    memcpy(p->answer, answer, 7 * sizeof(double));
    from_piece(p, k, w->time, 2, pair);
    from_piece(p, k, w->time, 2, p->answer + 1);
    if (call(&p->proof)) return 0;
    /* NaN fails the comparisons. */
    if (!(p->proven[CONTACT - 1] <= flaw && p->proven[0] + *radius > apart)) return 0;
    double weights[2] = {contact[1], contact[2]};
    memcpy(contact, p->proven, (CONTACT - 1) * sizeof(double));
    if (contact[CONTACT - 1] == 0.0) memcpy(contact + 1, weights, sizeof(weights));
    return 1;
}

/* Lower the bounds by what bodies and pieces moved, and evaluate the pairs that may be nearer than the limit. If
   there are any, and none was near before, evaluate all that may be nearer than the reach. */
static int evaluate(const Way *w, Pairs *p, double floor, double limit, double reach, const double *before,
                    const double *after)
{
    double least = INFINITY;
    int is_known = 1;
    if (p->is_close) reach = limit;
    for (int k = 0; k < p->count; k++) {
        int a = p->body[k], b = p->other[k];
        double nearer = w->moved[a];
        if (p->is_self)
            nearer = sqrt(square_of(w->middle + 3 * a, w->middle + 3 * b)) + w->turned[a] + w->turned[b];
        else if (p->velocity) nearer += p->speed[k] * fabs(w->until - w->since);
        p->lower[k] -= nearer;
        /* A negated comparison is true for NaN. */
        if (!(p->lower[k] >= limit)) is_known = 0;
    }
    p->near = p->is_close = p->overlaps = 0;
    p->lowest = INFINITY;
    if (is_known) return DONE;
    for (int k = 0; k < p->count; k++) {
        if (p->lower[k] >= reach) continue;
        if (contact(p, k, before, after, w->since, w->until)) return NO_VALUE;
        /* The known normal may be of long ago: that at the start of this motion proves more. */
        if (p->found[CONTACTS] < floor && p->lower[k] < floor
            && (contact(p, k, before, before, w->since, w->since) || contact(p, k, before, after, w->since, w->until)))
            return NO_VALUE;
        memcpy(p->contacts + CONTACTS * p->near, p->found, CONTACTS * sizeof(double));
        /* The bound from the motion alone holds as well. */
        double bound = p->found[CONTACTS] > p->lower[k] ? p->found[CONTACTS] : p->lower[k];
        p->lowest = least_of(p->lowest, bound);
        p->lower[k] = p->found[0];
        if (!(p->found[0] > 0.0)) p->overlaps = 1;
        least = least_of(least, p->found[0]);
        p->rows[p->near++] = k;
    }
    p->is_close = least < limit;
    return DONE;
}

/* Follow the path to its end, or to the end of the first piece that is not proven to keep the floors. The place that is
   reached becomes the present one. */
EXPORT int follow(Way *w)
{
    int step = 3 * w->points, is_proven = 1;
    double square = 0.0;
    for (int k = 0; k < w->pieces * step; k += 3) square += square_of(w->places + k, w->places + k + step);
    w->done = 0;
    if (!(square < w->furthest)) return TOO_FAR;
    w->until = w->start;
    while (is_proven && w->done < w->pieces) {
        const double *before = w->places + w->done * step, *after = before + step;
        int is_last = ++w->done == w->pieces;
        w->since = w->until;
        w->until = is_last ? w->end : w->start + (double)w->done / w->pieces * (w->end - w->start);
        displace(w, before, after);
        double furthest = greatest(w->moved, w->bodies);
        w->far -= furthest + w->fastest * fabs(w->until - w->since);
        w->parted -= 2.0 * furthest;
        if (w->parts) w->self_far -= bending(w, before, after);
        if (!(w->far >= w->floor && self_far_of(w) >= w->self_floor)) is_proven = 0;
        for (int g = 0; g < w->groups; g++) {
            Pairs *pairs = w->group[g];
            /* Before the last place only the floor matters. */
            double floor = pairs->is_self ? w->self_floor : w->floor;
            double limit = !is_last ? floor : pairs->is_self ? w->self_limit : w->limit;
            double reach = is_last ? fmax(limit, pairs->next * limit) : limit;
            if (evaluate(w, pairs, floor, limit, reach, before, after)) {
                w->lost = 1;
                return NO_VALUE;
            }
            if (!(pairs->lowest >= floor)) is_proven = 0;
        }
    }
    memcpy(w->place, w->places + w->done * step, sizeof(double) * step);
    w->time = w->until;
    w->reach = fmin(w->done == w->pieces ? w->limit : w->floor, w->far);
    w->self_reach = fmin(w->done == w->pieces ? w->self_limit : w->self_floor, self_far_of(w));
    return is_proven ? DONE : NOT_PROVEN;
}

/* Follow the path as follow does, and evaluate the pairs that are wanted at its end. */
static int advance_pairs(Way *w)
{
    w->limit = fmax(w->wanted, w->floor);
    w->self_limit = fmax(w->self_wanted, w->self_floor);
    return follow(w);
}
