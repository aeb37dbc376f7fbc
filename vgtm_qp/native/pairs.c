/* Pairs of bodies and of convex pieces of obstacles over straight motions: which may have come near, and the contacts of
   these. */

/* Lengths of the arrays of follow_function: ends of a pair before and after a motion; known, which are a piece, a radius
   and a normal; the two contacts and a bound. */
enum { ENDS = 24, KNOWN = 19, SOLID = 15, KNOWN_NORMAL = 16, CONTACTS = 18, CONTACT = 9 };

/* Contacts of a pair at most, and their numbers, where bodies are hulls; where they are capsules, CONTACTS and CONTACT. */
enum { MOST_CONTACTS = 3, WIDE = 13 };

/* Numbers of the axis of a body at a place: its middle, half of it, the radius of a ball round the body, and how far the
   body reaches from the axis. */
enum { AXIS = 8 };

/* Least bound of the distances of pairs that are not listed, over the distance below which pairs are evaluated. */
static const double AMPLE = 1.3;

/* How far ahead pairs of bodies are listed: for so many motions like the greatest recent one, but for this share of the
   slack at least; and the share of the greatest recent motion that still counts after one more. */
static const double LASTING = 20.0, LEAST_SLACK = 0.1, OF_LATE = 0.9;

/* A body, and a piece or another body, with a lower bound of their distance. */
typedef struct { int body, other; double lower; } Listed;

/* The listed pairs of one shape. */
typedef struct {
    int count, room, is_self;
    Listed *listed;                      /* (room) */
    double *normal;                      /* (room, 3): unit, of the last evaluation in which the bodies were apart */
    double next;                         /* if no pair is near, pairs below next * limit are evaluated too */

    Kernel contact;                      /* (ends 24, known 19) -> 18 numbers of contacts, and a bound */
    double *ends, *pair;
    const double *found;

    /* Where bodies are hulls: see Convex, of pieces alone; and turning_gap. */
    Kernel furthest, turning;

    Kernel proof;                        /* (pair, answer 7) -> contact 9, its last number the flaw; or no eval */
    double *proof_pair, *answer;
    const double *proven;

    int near, is_close, overlaps;
    double lowest;                       /* least lower bound over the motion of the evaluated pairs */
    Index *rows;                         /* (room): the evaluated pairs */
    double *contacts;                    /* (room, each, size) */
} Pairs;

/* The motion of a part of an arm: displacement of its centre, turn, and how far points leave that motion; the centre, and
   how far points are from it. */
typedef struct { double centre[3], shift[3], turn[3], off, reach; } Rigid;

/* The path of an arm in straight pieces, each from one place of all its points to the next. */
typedef struct {
    int pieces, points;
    const double *places;            /* (K + 1, P, 3) */
    double start, end;               /* times at both ends, s */
    double furthest;                 /* bound of the sum of the squares of displacements */
    /* Distances to prove from pieces and between bodies, and those below which pairs are evaluated at the end. */
    double floor, self_floor, limit, self_limit;

    double *place, time;             /* (P, 3), s: the present ones, where pairs nearer than the reach are evaluated */
    double reach, self_reach, wanted, self_wanted;    /* wanted: the reach of the next place */
    double *line;                    /* (2, P, 3) */
    int lost;                        /* whether a pair had no value, so that nothing is known of any */

    /* Points that span a body: two, or four where some are hulls, of which capsules have theirs twice. Contacts of a pair,
       and numbers of a contact: a distance, weights of all points of both, the normal, whether it is the only one of its
       pair. */
    int bodies, span, each, size;
    const int *ends, *touching, *touching_at;    /* (B, span); the bodies that each may touch, and where they begin */
    const double *radius;            /* (B) */
    const Hulls *hulls;              /* null if all bodies are capsules */
    double *axis;                    /* (B, 8) */
    /* Convex pieces of obstacles: parameters at time 0 (15), centre then and radius of the ball round it, allowance,
       velocity and speed, m/s, the greatest of these, and the number of its group. */
    int solids;
    const double *solid, *centre, *extent, *allowance, *velocity, *speed;
    double fastest;
    const int *kind;

    int groups;
    Pairs **group, *among;           /* (G); those of two bodies, or null where these do not count */
    /* Pairs that become near in a step, and how much further away others are that are listed with them. */
    double influence, self_influence, slack, most;
    /* Lower bounds of the distances of pairs that are not listed: from pieces; between bodies in parts of the arm that
       are near to each other, and in others. */
    double far, self_far, parted;
    double bent;                     /* the greatest of late by which two bodies of near parts came nearer in a motion */
    /* The parts: their points and bodies, and where they begin; the greatest radius of their bodies; the later parts that
       each is near to, itself the first of them. */
    int parts, neighbour_room;
    const int *part_points, *points_at, *part_bodies, *bodies_at;
    const double *thickness;
    int *neighbour, *neighbours_at;
    Rigid *part;                           /* (parts) */

    double *middle, *turned, *moved; /* (B, 3), (B), (B): of each axis in the present piece the displacement
                                        of its middle, half that between its ends, the greater of its ends' */
    double since, until;             /* times at both ends of that piece */
    int done;                        /* number of pieces that were followed */
} Way;

/* Which points span pair k: those of the body, then those of the other body, or the same again for a piece. */
static int point_of(const Way *w, const Pairs *p, int k, int end)
{
    int body = end < w->span || !p->is_self ? p->listed[k].body : p->listed[k].other;
    return w->ends[w->span * body + end % w->span];
}

/* Whether a body is a hull. */
static int is_hull(const Way *w, int body)
{
    return w->hulls && w->hulls->sizes[body] > 0.0;
}

/* Whether a body of pair k is a hull. */
static int has_hull(const Way *w, const Pairs *p, int k)
{
    return is_hull(w, p->listed[k].body) || (p->is_self && is_hull(w, p->listed[k].other));
}

/* Where the normal (3) of a contact begins. */
static int normal_at(const Way *w)
{
    return w->size - 4;
}

/* The radius of the body of pair k less the allowance of the piece, or the sum of both radii. */
static double thickness_of(const Way *w, const Pairs *p, int k)
{
    return w->radius[p->listed[k].body] + (p->is_self ? w->radius[p->listed[k].other] : -w->allowance[p->listed[k].other]);
}

/* Write the motion of all bodies, which `span` points span each. */
static inline void displace_by(Way *w, const double *before, const double *after, int span)
{
    for (int b = 0; b < w->bodies; b++) {
        double moved[SPAN][3], *middle = w->middle + 3 * b, furthest = 0.0, turned = 0.0;
        middle[0] = middle[1] = middle[2] = 0.0;
        for (int k = 0; k < span; k++)
            for (int a = 0; a < 3; a++) {
                int point = 3 * w->ends[span * b + k] + a;
                moved[k][a] = after[point] - before[point];
                middle[a] += moved[k][a] / span;
            }
        for (int k = 0; k < span; k++) {
            furthest = fmax(furthest, dot(moved[k], moved[k], 3));
            turned = fmax(turned, square_of(middle, moved[k]));
        }
        w->turned[b] = sqrt(turned);
        w->moved[b] = sqrt(furthest);
    }
}

static void displace(Way *w, const double *before, const double *after)
{
    if (w->span == 2) displace_by(w, before, after, 2);
    else displace_by(w, before, after, SPAN);
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

/* Write where the parts are at the present place, and how far their bodies reach from there. */
static void place_parts(Way *w)
{
    for (int k = 0; k < w->parts; k++) {
        place_part(w, k, w->place);
        w->part[k].reach += w->thickness[k];
    }
}

/* Find how far bodies of parts that are not near to each other are apart, where the parts were placed. */
static void measure_parts(Way *w)
{
    double least = INFINITY;
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
}

/* List the pair of a body and another one, or a piece, whose axis (8) is `second`, if the plane across the line between
   their middles does not hold them apart by the horizon. */
static int list_if_near(const Way *w, Pairs *p, int body, int other, const double *second, double horizon)
{
    const double *first = w->axis + AXIS * body;
    double between[3], room = horizon + first[6] + second[6], square = square_of(first, second), lower = -INFINITY;
    if (square >= room * room) return DONE;
    for (int a = 0; a < 3; a++) between[a] = second[a] - first[a];
    double apart = sqrt(square);
    double along = fabs(dot(between, first + 3, 3)) + fabs(dot(between, second + 3, 3));
    if (apart > 0.0) lower = apart - along / apart - first[7] - second[7];
    if (lower >= horizon) return DONE;
    if (p->is_self)
        for (int i = w->touching_at[body]; i < w->touching_at[body + 1]; i++)
            if (w->touching[i] == other) return DONE;
    if (p->count == p->room) return FULL;
    int k = p->count++;
    p->listed[k] = (Listed){body, other, lower};
    p->normal[3 * k] = p->normal[3 * k + 1] = 0.0;
    p->normal[3 * k + 2] = 1.0;
    return DONE;
}

/* Forget the pairs of a group. */
static void clear(Pairs *p)
{
    p->count = p->near = p->is_close = p->overlaps = 0;
}

/* Pairs by body and then by other. */
static int compare(const void *first, const void *second)
{
    const Listed *p = first, *q = second;
    return p->body != q->body ? p->body - q->body : p->other - q->other;
}

/* Sort the pairs of bodies, or those with pieces: of rows that depend on one another a solver takes the first ones. */
static void sort_pairs(Way *w, int is_self)
{
    for (int g = 0; g < w->groups; g++)
        if (w->group[g]->is_self == is_self) qsort(w->group[g]->listed, w->group[g]->count, sizeof(Listed), compare);
}

/* List the pairs of a body and a piece that may be nearer than the horizon at the present place. */
static int list_solids(Way *w, double horizon)
{
    for (int g = 0; g < w->groups; g++)
        if (!w->group[g]->is_self) clear(w->group[g]);
    w->far = -INFINITY;
    for (int o = 0; o < w->solids; o++) {
        double ball[AXIS] = {0.0};
        for (int a = 0; a < 3; a++) ball[a] = w->centre[3 * o + a] + w->time * w->velocity[3 * o + a];
        ball[6] = ball[7] = w->extent[o];
        for (int b = 0; b < w->bodies; b++)
            if (list_if_near(w, w->group[w->kind[o]], b, o, ball, horizon)) return FULL;
    }
    sort_pairs(w, 0);
    w->far = w->solids ? horizon : INFINITY;
    return DONE;
}

/* List the pairs of two bodies that may be nearer than the horizon at the present place, and see which parts are near:
   within twice the horizon, so that parts may come nearer before their bodies must be listed. */
static int list_bodies(Way *w, double horizon)
{
    Pairs *p = w->among;
    int count = 0;
    clear(p);
    w->self_far = -INFINITY;
    place_parts(w);
    for (int k = 0; k < w->parts; k++) {
        w->neighbours_at[k] = count;
        for (int q = k; q < w->parts; q++) {
            double reach = w->part[k].reach + w->part[q].reach, room = 2.0 * horizon + reach;
            double square = square_of(w->part[k].centre, w->part[q].centre);
            if (q > k && square >= room * room) continue;
            if (count == w->neighbour_room) return FULL;
            w->neighbour[count++] = q;
            if (q > k && square >= (horizon + reach) * (horizon + reach)) continue;
            for (int i = w->bodies_at[k]; i < w->bodies_at[k + 1]; i++)
                for (int j = q > k ? w->bodies_at[q] : i + 1; j < w->bodies_at[q + 1]; j++) {
                    int first = w->part_bodies[i], second = w->part_bodies[j];
                    int a = first < second ? first : second, b = first + second - a;
                    if (list_if_near(w, p, a, b, w->axis + AXIS * b, horizon)) return FULL;
                }
        }
    }
    w->neighbours_at[w->parts] = count;
    sort_pairs(w, 1);
    measure_parts(w);
    w->self_far = horizon;
    return DONE;
}

/* Write the axes of all bodies at the present place; those of hulls are points, the middles of balls round them. */
static void place_axes(Way *w)
{
    for (int b = 0; b < w->bodies; b++) {
        const int *ends = w->ends + w->span * b;
        const double *p = w->place + 3 * ends[0], *q = w->place + 3 * ends[1];
        double *axis = w->axis + AXIS * b;
        for (int a = 0; a < 3; a++) {
            axis[a] = 0.5 * (p[a] + q[a]);
            axis[3 + a] = 0.5 * (q[a] - p[a]);
        }
        axis[6] = norm(axis + 3, 3) + w->radius[b];
        axis[7] = w->radius[b];
        if (!is_hull(w, b)) continue;
        double square = 0.0;
        for (int a = 0; a < 3; a++) {
            axis[a] = 0.5 * (axis[a] + 0.5 * (w->place[3 * ends[2] + a] + w->place[3 * ends[3] + a]));
            axis[3 + a] = 0.0;
        }
        for (int k = 0; k < SPAN; k++) square = fmax(square, square_of(axis, w->place + 3 * ends[k]));
        axis[6] = axis[7] = sqrt(square) + w->radius[b];
    }
}

/* The least bound of the distances of pairs that are not listed, where those nearer than `wanted` are evaluated. */
static double ample(const Way *w, double wanted)
{
    return fmax(fmax(wanted, fmin(AMPLE * wanted, w->most)), 0.0);
}

/* List pairs anew at the present place, if others may be nearer there than `least`, or come near soon. */
static int list_near(Way *w, double least, double self_least)
{
    double needed = fmax(least, ample(w, w->wanted)), self_needed = fmax(self_least, ample(w, w->self_wanted));
    double slack = fmin(w->slack, fmax(LASTING * w->bent, LEAST_SLACK * w->slack));
    double horizon = fmax(self_needed, w->self_influence) + slack;
    int code = DONE, is_short = !(w->far >= needed);        /* NaN fails the comparison */
    if (is_short) {
        place_axes(w);
        w->reach = -INFINITY;
        code = list_solids(w, fmax(needed, w->influence) + w->slack);
    }
    if (code || !w->among) return code;
    if (w->parted < self_needed) {
        place_parts(w);
        measure_parts(w);
    }
    /* A list that reaches too far has many pairs, which cost more in each motion than a shorter list costs once. */
    int is_long = w->self_far < INFINITY && w->self_far > horizon + slack;
    if (self_far_of(w) >= self_needed && !is_long) return DONE;
    if (!is_short) place_axes(w);
    w->self_reach = -INFINITY;
    return list_bodies(w, horizon);
}

/* Replace points by where they are at a time from the piece of pair k: in a frame that moves with that, and is the
   world's at time 0. */
static void from_piece(const Way *w, const Pairs *p, int k, double time, int points, double *x)
{
    if (p->is_self || w->fastest == 0.0) return;
    for (int i = 0; i < 3 * points; i++) x[i] -= time * w->velocity[3 * p->listed[k].other + i % 3];
}

/* Write a contact of capsules, its weights those of the first two points of both bodies. */
static void widen(const Way *w, const double *narrow, double *wide)
{
    memset(wide, 0, w->size * sizeof(double));
    memcpy(wide, narrow, 3 * sizeof(double));
    memcpy(wide + 1 + w->span, narrow + 3, 2 * sizeof(double));
    memcpy(wide + normal_at(w), narrow + CONTACT - 4, 4 * sizeof(double));
}

/* Write where the points of pair k are that span it (2 span, 3). */
static void points_of(const Way *w, const Pairs *p, int k, const double *place, double time, double *points)
{
    for (int i = 0; i < 2 * w->span; i++) memcpy(points + 3 * i, place + 3 * point_of(w, p, k, i), 3 * sizeof(double));
    from_piece(w, p, k, time, 2 * w->span, points);
}

/* Evaluate capsules between places of the points that span pair k: write its contacts, and a bound of its distance on the
   way. */
static int capsule_contacts(const Way *w, Pairs *p, int k, const double *before, const double *after, double *contacts,
                            double *bound)
{
    const double *places[2] = {before, after};
    for (int i = 0; i < 4; i++)
        memcpy(p->ends + 6 * i, places[i / 2] + 3 * w->span * (i % 2), 6 * sizeof(double));
    if (!p->is_self) memcpy(p->pair, w->solid + SOLID * p->listed[k].other, SOLID * sizeof(double));
    p->pair[SOLID] = thickness_of(w, p, k);
    memcpy(p->pair + KNOWN_NORMAL, p->normal + 3 * k, 3 * sizeof(double));
    if (call(&p->contact)) return NO_VALUE;
    for (int i = 0; i < w->each; i++) {
        if (i < 2) widen(w, p->found + CONTACT * i, contacts + w->size * i);
        else contacts[w->size * i] = INFINITY;
    }
    *bound = p->found[CONTACTS];
    return DONE;
}

/* The two sets of a pair, their numbers (2), where the points that span it are at `points` (8, 3): two bodies, or a body
   and a piece. */
static void sets_of(const Hulls *h, const Pairs *p, const int *numbers, const double *points, const double *piece,
                    Convex *body, Convex *other)
{
    Convex *sets[2] = {body, other};
    for (int i = 0; i < (p->is_self ? 2 : 1); i++) {
        int first = h->vertices_at[numbers[i]];
        int count = h->vertices_at[numbers[i] + 1] - first;
        *sets[i] = (Convex){count, points + 3 * SPAN * i, h->vertices + SPAN * first, 0};
    }
    if (p->is_self) return;
    *other = (Convex){0, 0, 0, &p->furthest};
    memcpy((double *)p->furthest.arg[0], piece, SOLID * sizeof(double));
}

/* Find the contact of an axis at rest, from end to end (6), with a piece; it is among what was found. */
static int touch(Pairs *p, const double *ends, const double *piece)
{
    for (int i = 0; i < 2; i++) memcpy(p->ends + ENDS / 2 * i, ends, 6 * sizeof(double));
    memcpy(p->pair, piece, SOLID * sizeof(double));
    p->pair[SOLID] = 0.0;
    return call(&p->contact);
}

/* Take what is known of a hull's vertex or edge beside a piece from the function of axes. At a rim a search finds half of
   the digits of a normal, whose square is the error of a distance. */
static int sharpen(const Hulls *h, Pairs *p, const double *piece, const Convex *body, const Convex *other, double *normal,
                   double *gap, Mean *m)
{
    int first = m->vertex[0][0], last = first, vertex[2];
    double ends[6], own[3], others[3];
    for (int i = 1; i < m->count; i++) {
        if (m->vertex[i][0] == first || m->vertex[i][0] == last) continue;
        if (last != first) return DONE;
        last = m->vertex[i][0];
    }
    mean_of(body->points, body->weights + SPAN * first, SPAN, ends);
    mean_of(body->points, body->weights + SPAN * last, SPAN, ends + 3);
    if (touch(p, ends, piece)) return NO_VALUE;
    double found = gap_along(body, other, p->found + CONTACT - 4, own, others, vertex);
    /* A search that ended early may have another edge. */
    if (!(found >= *gap - EXACT * (h->unit + fabs(*gap)))) return DONE;
    *gap = found;
    memcpy(normal, p->found + CONTACT - 4, 3 * sizeof(double));
    m->count = 2;
    for (int i = 0; i < 2; i++) {
        m->vertex[i][0] = i ? last : first;
        memcpy(m->own[i], ends + 3 * i, 3 * sizeof(double));
        memcpy(m->others[i], others, 3 * sizeof(double));
        m->weight[i] = p->found[1 + i];
    }
    return DONE;
}

/* Find the nearest points of a pair with a hull, as approach does. */
static int find_nearest(const Hulls *h, Pairs *p, const double *piece, const Convex *body, const Convex *other,
                        double *normal, double *gap, Mean *m)
{
    int code = approach(body, other, h->unit, normal, gap, m);
    return code || p->is_self ? code : sharpen(h, p, piece, body, other, normal, gap, m);
}

/* Add contacts of a hull, of that size, at vertices far from its nearest point x that are almost as near, see _further in
   geometry/hulls.py; the first contact is there. The other set reaches up to `high` along its normal. */
static int add_further(const Way *w, Pairs *p, const double *piece, const Convex *body, double size, const double *x,
                       double high, double *contacts)
{
    const double *normal = contacts + normal_at(w);
    double reach = contacts[0] + w->hulls->parallel * size, axis[3] = {0.0};
    for (int c = 1; c < w->each; c++) contacts[w->size * c] = INFINITY;
    for (int c = 1; c < w->each; c++) {
        double most = w->hulls->aside * size, distance = 0.0, place[6], way[3];
        int best = -1;
        for (int v = 0; v < body->count; v++) {
            double point[3], beside[3];
            mean_of(body->points, body->weights + SPAN * v, SPAN, point);
            double height = dot(point, normal, 3) - high;
            if (height > reach) continue;
            for (int a = 0; a < 3; a++) beside[a] = point[a] - x[a];
            double along = dot(beside, axis, 3);
            for (int a = 0; a < 3; a++) beside[a] -= along * axis[a];
            double far = norm(beside, 3);
            if (far <= most) continue;
            most = far;
            best = v;
            distance = height;
            for (int i = 0; i < 2; i++) memcpy(place + 3 * i, point, sizeof(point));
            memcpy(way, beside, sizeof(way));
        }
        if (best < 0) return DONE;
        /* The next one is far from the line through both. */
        for (int a = 0; a < 3; a++) axis[a] = way[a] / most;
        if (!p->is_self) {
            if (touch(p, place, piece)) return NO_VALUE;
            distance = *p->found;
        }
        if (!(distance <= reach)) continue;
        double *contact = contacts + w->size * c;
        memcpy(contact, contacts, w->size * sizeof(double));
        memcpy(contact + 1, body->weights + SPAN * best, SPAN * sizeof(double));
        *contact = distance;
    }
    return DONE;
}

/* Evaluate pair k, which has a hull, as capsule_contacts does. Bodies that overlap have no distance: minus infinity. */
static int hull_contacts(const Way *w, Pairs *p, int k, const double *before, const double *after, double *contacts,
                         double *bound)
{
    const Hulls *h = w->hulls;
    Convex bodies[2], others[2];
    Mean mean;
    int numbers[2] = {p->listed[k].body, p->listed[k].other};
    const double *piece = w->solid + SOLID * (p->is_self ? 0 : numbers[1]);
    double *known = p->normal + 3 * k, first[3], gap, thick = thickness_of(w, p, k), x[3], point[3];
    memset(contacts, 0, w->each * w->size * sizeof(double));
    sets_of(h, p, numbers, before, piece, bodies, others);
    sets_of(h, p, numbers, after, piece, bodies + 1, others + 1);
    memcpy(first, known, sizeof(first));
    int code = find_nearest(h, p, piece, bodies + 1, others + 1, known, &gap, &mean);
    if (code == OVERLAPPING) {
        for (int c = 0; c < w->each; c++) contacts[w->size * c] = -INFINITY;
        *bound = -INFINITY;
        return DONE;
    }
    if (code || turning_gap(&p->turning, bodies, others, first, known, bound)) return NO_VALUE;
    *contacts = gap;
    for (int i = 0; i < mean.count; i++)
        for (int j = 0; j < SPAN; j++) {
            contacts[1 + j] += mean.weight[i] * bodies[1].weights[SPAN * mean.vertex[i][0] + j];
            if (p->is_self) contacts[1 + SPAN + j] -= mean.weight[i] * others[1].weights[SPAN * mean.vertex[i][1] + j];
        }
    memcpy(contacts + normal_at(w), known, sizeof(first));
    mean_of(mean.own[0], mean.weight, mean.count, x);
    furthest(others + 1, known, point);
    code = add_further(w, p, piece, bodies + 1, h->sizes[numbers[0]], x, dot(known, point, 3), contacts);
    for (int c = 0; c < w->each; c++) contacts[w->size * c] -= thick;
    *bound -= thick;
    return code;
}

/* Lower bounds (2) of the distance of pair k, which has a hull, over a straight motion between two times and at its end:
   the gaps of the plane across the known normal. */
static void known_gaps(const Way *w, Pairs *p, int k, const double *before, const double *after, double since, double until,
                       double *gaps)
{
    const double *places[2] = {before, after}, *piece = w->solid + SOLID * (p->is_self ? 0 : p->listed[k].other);
    double times[2] = {since, until}, points[3 * 2 * SPAN], own[3], others[3];
    int numbers[2] = {p->listed[k].body, p->listed[k].other}, vertex[2];
    for (int i = 0; i < 2; i++) {
        Convex body, other;
        points_of(w, p, k, places[i], times[i], points);
        sets_of(w->hulls, p, numbers, points, piece, &body, &other);
        gaps[i] = gap_along(&body, &other, p->normal + 3 * k, own, others, vertex) - thickness_of(w, p, k);
    }
    gaps[0] = least_of(gaps[0], gaps[1]);
}

/* Evaluate pair k over a straight motion between two times, from the known normal at its start: write its contacts
   (each, size), and a bound of its distance meanwhile. */
static int contact(const Way *w, Pairs *p, int k, const double *before, const double *after, double since, double until,
                   double *contacts, double *bound)
{
    double start[3 * 2 * SPAN], end[3 * 2 * SPAN];
    points_of(w, p, k, before, since, start);
    points_of(w, p, k, after, until, end);
    if (has_hull(w, p, k)) return hull_contacts(w, p, k, start, end, contacts, bound);
    int code = capsule_contacts(w, p, k, start, end, contacts, bound);
    memcpy(p->normal + 3 * k, contacts + normal_at(w), 3 * sizeof(double));
    return code;
}

/* The two ends of the body's axis (6) of pair k at `place`, for its `contact`: the nearest point twice where another
   contact has the other one. */
static void ends_for(const Way *w, const Pairs *p, int k, const double *place, const double *contact, double *ends)
{
    const double *a = place + 3 * point_of(w, p, k, 0), *b = place + 3 * point_of(w, p, k, 1);
    double t = contact[2];
    int is_only = contact[w->size - 1] != 0.0;
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
    const double *place = w->place;
    double *pair = p->proof_pair, *radius = pair + (p->is_self ? 12 : SOLID + 6);
    ends_for(w, p, k, place, contact, pair);
    if (p->is_self)
        for (int i = 0; i < 2; i++)
            memcpy(pair + 6 + 3 * i, place + 3 * point_of(w, p, k, w->span + i), 3 * sizeof(double));
    else memcpy(pair + 6, w->solid + SOLID * p->listed[k].other, SOLID * sizeof(double));
    *radius = thickness_of(w, p, k);
    memcpy(p->answer, answer, 7 * sizeof(double));
    from_piece(w, p, k, w->time, 2, pair);
    from_piece(w, p, k, w->time, 2, p->answer + 1);
    if (call(&p->proof)) return 0;
    /* NaN fails the comparisons. */
    if (!(p->proven[CONTACT - 1] <= flaw && p->proven[0] + *radius > apart)) return 0;
    double weights[2] = {contact[1], contact[2]}, is_only = contact[w->size - 1];
    widen(w, p->proven, contact);
    contact[w->size - 1] = is_only;
    if (is_only == 0.0) memcpy(contact + 1, weights, sizeof(weights));
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
        int a = p->listed[k].body, b = p->listed[k].other;
        double nearer = w->moved[a];
        if (p->is_self)
            nearer = sqrt(square_of(w->middle + 3 * a, w->middle + 3 * b)) + w->turned[a] + w->turned[b];
        else nearer += w->speed[b] * fabs(w->until - w->since);
        p->listed[k].lower -= nearer;
        /* A negated comparison is true for NaN. */
        if (!(p->listed[k].lower >= limit)) is_known = 0;
    }
    p->near = p->is_close = p->overlaps = 0;
    p->lowest = INFINITY;
    if (is_known) return DONE;
    for (int k = 0; k < p->count; k++) {
        double *contacts = p->contacts + w->each * w->size * p->near, *lower = &p->listed[k].lower, bound;
        if (*lower >= reach) continue;
        if (has_hull(w, p, k)) {
            double gaps[2];
            known_gaps(w, p, k, before, after, w->since, w->until, gaps);
            if (gaps[0] >= floor && gaps[1] >= reach) {
                p->lowest = least_of(p->lowest, gaps[0]);
                *lower = gaps[1];
                continue;
            }
        }
        if (contact(w, p, k, before, after, w->since, w->until, contacts, &bound)) return NO_VALUE;
        /* The known normal may be old; the one at the start of this motion proves more. */
        if (bound < floor && *lower < floor
            && (contact(w, p, k, before, before, w->since, w->since, contacts, &bound)
                || contact(w, p, k, before, after, w->since, w->until, contacts, &bound)))
            return NO_VALUE;
        /* The bound from the motion alone holds as well. */
        p->lowest = least_of(p->lowest, bound > *lower ? bound : *lower);
        *lower = *contacts;
        if (!(*contacts > 0.0)) p->overlaps = 1;
        least = least_of(least, *contacts);
        p->rows[p->near++] = k;
    }
    p->is_close = least < limit;
    return DONE;
}

/* Follow the path to its end, or to the end of the first piece that is not proven to keep the floors. The place that is
   reached becomes the present one. */
static int follow(Way *w)
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
        if (isfinite(w->self_far)) {
            double nearer = bending(w, before, after);
            w->self_far -= nearer;
            w->bent = fmax(nearer, OF_LATE * w->bent);
        }
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

/* Follow the path from the present place as advance_pairs does, after pairs were listed that may come near on it. */
EXPORT int prove_path(Way *w)
{
    int step = 3 * w->points;
    double square = 0.0;
    for (int k = step; k < (w->pieces + 1) * step; k += 3)
        square = fmax(square, square_of(w->places + k % step, w->places + k));
    /* Far motions are not proven by such lists. */
    double furthest = fmin(AMPLE * sqrt(square), w->most), drift = w->fastest * fabs(w->end - w->start);
    int code = list_near(w, fmax(w->floor, 0.0) + furthest + drift, fmax(w->self_floor, 0.0) + 2.0 * furthest);
    return code ? code : advance_pairs(w);
}

/* Whether the present place and time are these, where pairs were evaluated. */
static int is_at(const Way *w, const double *place, double time)
{
    return !w->lost && w->time == time && !memcmp(w->place, place, sizeof(double) * 3 * w->points);
}

/* Go straight to `place` at a time, where the pairs that are wanted are evaluated. */
static int go_to(Way *w, const double *place, double time)
{
    size_t size = sizeof(double) * 3 * w->points;
    memcpy(w->line, w->place, size);
    memcpy(w->line + 3 * w->points, place, size);
    w->pieces = 1;
    w->places = w->line;
    w->start = w->time;
    w->end = time;
    w->floor = w->self_floor = -INFINITY;
    int code = advance_pairs(w);
    return code == NOT_PROVEN ? DONE : code;
}

/* Make `place` and a time the present ones, with all pairs nearer than the limits evaluated, and those listed that can be
   near in a step from there. */
static int see(Way *w, const double *place, double time, double limit, double self_limit)
{
    int code = DONE;
    if (w->lost) {
        for (int g = 0; g < w->groups; g++) clear(w->group[g]);
        w->far = -INFINITY;
        w->self_far = w->among ? -INFINITY : INFINITY;
        w->lost = 0;
    }
    w->wanted = fmax(w->wanted, limit);
    w->self_wanted = fmax(w->self_wanted, self_limit);
    if (!is_at(w, place, time)) code = go_to(w, place, time);
    if (!code) code = list_near(w, 0.0, 0.0);
    if (code || (limit <= w->reach && self_limit <= w->self_reach)) return code;
    return go_to(w, place, time);
}

/* See the first of the places at a time. */
EXPORT int see_place(Way *w, double time, double limit, double self_limit)
{
    return see(w, w->places, time, limit, self_limit);
}

/* Pairs with hulls, of which nothing else is known: the bodies (count), others (count), and numbers (count, width), which
   begin with the points that span the body (4, 3), then those of the other body or the piece. Of each pair that is apart,
   nearest points of the body and of the other, and the normal (count, 9). */
typedef struct {
    const Hulls *hulls;
    Pairs *pairs;
    int count, width;
    const int *body, *other;
    const double *numbers;
    double *nearest;
    int *is_apart;
} Search;

EXPORT int search(Search *s)
{
    for (int k = 0; k < s->count; k++) {
        const double *points = s->numbers + s->width * k, *other = points + 3 * SPAN;
        double *x = s->nearest + 9 * k, *normal = x + 6, gap;
        int numbers[2] = {s->body[k], s->other[k]};
        Convex sets[2];
        Mean mean;
        sets_of(s->hulls, s->pairs, numbers, points, other, sets, sets + 1);
        normal[0] = normal[1] = 0.0;
        normal[2] = 1.0;
        int code = find_nearest(s->hulls, s->pairs, other, sets, sets + 1, normal, &gap, &mean);
        if (code == NO_VALUE) return code;
        s->is_apart[k] = code == DONE;
        if (code) continue;
        mean_of(mean.own[0], mean.weight, mean.count, x);
        mean_of(mean.others[0], mean.weight, mean.count, x + 3);
    }
    return DONE;
}
