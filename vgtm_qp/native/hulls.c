/* Convex bodies: where two are nearest, and how far a plane that turns holds them apart over a motion. */

/* Points that span a hull; pairs of points in a mean; most searches for a point that is further. */
enum { SPAN = 4, MEANS = 4, SEARCHES = 60 };

/* Error of a distance over the size of what is far from what; distance, over the unit of length, up to which bodies
   overlap; share of an edge beside the others below which it is none. See geometry/hulls.py. */
static const double EXACT = 1e-12, OVERLAP = 1e-9, FLAT = 1e-14;

/* The hulls of an arm: where the vertices of each body begin, these as weights (4) of the points that span it, sizes (B),
   zero for capsules, whose vertices are their ends; the unit of length; see _further in geometry/hulls.py. */
typedef struct {
    const int *vertices_at;
    const double *vertices, *sizes;
    double unit, parallel, aside;
} Hulls;

/* A convex set: the hull of `count` vertices, each a mean of four points (4, 3) with weights (count, 4); or a piece of an
   obstacle, of which a function gives the point that is furthest along a normal, for (piece, normal). */
typedef struct { int count; const double *points, *weights; const Kernel *furthest; } Convex;

/* Pairs of points of two sets, their vertices, and their weights, of sum 1. */
typedef struct { int count, vertex[MEANS][2]; double own[MEANS][3], others[MEANS][3], weight[MEANS]; } Mean;

/* Heights (4) of the points that span a hull. */
static void heights_of(const double *points, const double *normal, double *heights)
{
    for (int k = 0; k < SPAN; k++) heights[k] = dot(points + 3 * k, normal, 3);
}

/* Write the point of a set that is furthest along a normal, NaN if it has none; return its vertex, 0 for a piece. */
static int furthest(const Convex *c, const double *normal, double *point)
{
    double heights[SPAN], most = -INFINITY;
    int best = 0;
    if (c->furthest) {
        memcpy((double *)c->furthest->arg[1], normal, 3 * sizeof(double));
        if (call(c->furthest)) *c->furthest->res[0] = NAN;
        memcpy(point, c->furthest->res[0], 3 * sizeof(double));
        return 0;
    }
    heights_of(c->points, normal, heights);
    for (int v = 0; v < c->count; v++) {
        double height = dot(c->weights + SPAN * v, heights, SPAN);
        if (height > most) {
            most = height;
            best = v;
        }
    }
    mean_of(c->points, c->weights + SPAN * best, SPAN, point);
    return best;
}

/* Write the sides' points that are nearest to each other along a normal from the other set to the body, and their
   vertices (2); return the gap between the planes there. */
static double gap_along(const Convex *body, const Convex *other, const double *normal, double *own, double *others,
                        int *vertex)
{
    double back[3] = {-normal[0], -normal[1], -normal[2]};
    vertex[0] = furthest(body, back, own);
    vertex[1] = furthest(other, normal, others);
    return dot(normal, own, 3) - dot(normal, others, 3);
}

/* Write the weights, of sum 1, of the point nearest to the origin in the plane through points (count, 3): least squares
   over the edges from the last of them, made orthogonal one after another. */
static void weights_in_plane(double (*points)[3], int count, double *weights)
{
    double way[MEANS][3], part[MEANS][MEANS], share[MEANS], rest[3], sum = 0.0;
    const double *last = points[count - 1];
    memcpy(rest, last, sizeof(rest));
    for (int j = 0; j < count - 1; j++) {
        for (int a = 0; a < 3; a++) way[j][a] = points[j][a] - last[a];
        double whole = norm(way[j], 3);
        for (int i = 0; i < j; i++) {
            part[i][j] = dot(way[i], way[j], 3);
            for (int a = 0; a < 3; a++) way[j][a] -= part[i][j] * way[i][a];
        }
        part[j][j] = norm(way[j], 3);
        int is_flat = !(part[j][j] > FLAT * whole);
        for (int a = 0; a < 3; a++) way[j][a] = is_flat ? 0.0 : way[j][a] / part[j][j];
        share[j] = -dot(way[j], rest, 3);
        for (int a = 0; a < 3; a++) rest[a] += share[j] * way[j][a];
    }
    for (int j = count - 2; j >= 0; j--) {
        for (int i = j + 1; i < count - 1; i++) share[j] -= part[j][i] * weights[i];
        weights[j] = share[j] == 0.0 ? 0.0 : share[j] / part[j][j];
        sum += weights[j];
    }
    weights[count - 1] = 1.0 - sum;
}

/* Move the weights of a mean, the last of which may be zero, to where the mean of the differences is nearest to the
   origin, and drop the pairs that have no part in it (P. Wolfe, see geometry/hulls.py). */
static void draw_nearest(Mean *m)
{
    double apart[MEANS][3], wanted[MEANS];
    for (;;) {
        double share = INFINITY;
        int last = -1;
        for (int k = 0; k < m->count; k++)
            for (int a = 0; a < 3; a++) apart[k][a] = m->own[k][a] - m->others[k][a];
        weights_in_plane(apart, m->count, wanted);
        for (int k = 0; k < m->count; k++) {
            if (wanted[k] > 0.0) continue;
            double own = m->weight[k] > 0.0 ? m->weight[k] / (m->weight[k] - wanted[k]) : 0.0;
            if (own < share) {
                share = own;
                last = k;
            }
        }
        if (last < 0) share = 1.0;
        for (int k = 0; k < m->count; k++) m->weight[k] += share * (wanted[k] - m->weight[k]);
        if (last < 0) return;
        m->count--;
        for (int k = last; k < m->count; k++) {
            memcpy(m->vertex[k], m->vertex[k + 1], sizeof(m->vertex[k]));
            memcpy(m->own[k], m->own[k + 1], sizeof(m->own[k]));
            memcpy(m->others[k], m->others[k + 1], sizeof(m->others[k]));
            m->weight[k] = m->weight[k + 1];
        }
    }
}

/* Find the mean of points of two sets that are nearest to each other, from a normal (3) on, which becomes the one along
   which the planes leave the greatest gap. Return OVERLAPPING where there is none. */
static int approach(const Convex *body, const Convex *other, double unit, double *normal, double *gap, Mean *m)
{
    double along[3], distance = INFINITY;
    memcpy(along, normal, sizeof(along));
    *gap = -INFINITY;
    m->count = 0;
    for (int search = 0; search < SEARCHES; search++) {
        Mean next = *m;
        int k = next.count++;
        double found = gap_along(body, other, along, next.own[k], next.others[k], next.vertex[k]);
        if (found != found) return NO_VALUE;
        if (found > *gap) {
            *gap = found;
            memcpy(normal, along, sizeof(along));
        }
        if (found >= distance - EXACT * (unit + distance)) break;
        next.weight[k] = k ? 0.0 : 1.0;
        draw_nearest(&next);
        double x[3], y[3], nearer;
        mean_of(next.own[0], next.weight, next.count, x);
        mean_of(next.others[0], next.weight, next.count, y);
        nearer = sqrt(square_of(x, y));
        if (next.count == MEANS || nearer <= OVERLAP * unit) return OVERLAPPING;
        /* Rounding may leave nothing that is nearer; the gap is a bound all the same. */
        if (!(nearer < distance)) break;
        distance = nearer;
        for (int a = 0; a < 3; a++) along[a] = (x[a] - y[a]) / nearer;
        *m = next;
    }
    /* There is none where squares of distances are infinite. */
    return m->count ? DONE : NO_VALUE;
}

/* How far the points (4) that span a hull before and after a motion move along a vector. */
static void moved_along(const Convex *hulls, const double *way, double *moved)
{
    double before[SPAN];
    heights_of(hulls[0].points, way, before);
    heights_of(hulls[1].points, way, moved);
    for (int k = 0; k < SPAN; k++) moved[k] -= before[k];
}

/* A lower bound of the distance of two sets over a straight motion, by a plane that turns from the first normal to the
   last: see exact._turning_gap, whose bound of one vertex `turning` gives. A piece is at rest; the sets before and after
   the motion are the bodies (2) and the others (2). */
static int turning_gap(const Kernel *turning, const Convex *bodies, const Convex *others, const double *first,
                       const double *last, double *bound)
{
    const double *normals[2] = {first, last};
    double turn[3], high[2], low[2][SPAN], moved[SPAN], opposed = 0.0, point[3], *known = (double *)turning->arg[0];
    for (int a = 0; a < 3; a++) turn[a] = last[a] - first[a];
    for (int i = 0; i < 2; i++) {
        furthest(others + i, normals[i], point);
        high[i] = dot(normals[i], point, 3);
        heights_of(bodies[i].points, normals[i], low[i]);
    }
    if (!others->furthest) {
        moved_along(others, turn, moved);
        opposed = INFINITY;
        for (int v = 0; v < others->count; v++) opposed = fmin(opposed, dot(others->weights + SPAN * v, moved, SPAN));
    }
    moved_along(bodies, turn, moved);
    known[2] = dot(turn, turn, 3);
    *bound = INFINITY;
    for (int v = 0; v < bodies->count; v++) {
        const double *weights = bodies->weights + SPAN * v;
        known[0] = least_of(dot(weights, low[0], SPAN) - high[0], dot(weights, low[1], SPAN) - high[1]);
        known[1] = dot(weights, moved, SPAN) - opposed;
        if (call(turning)) return NO_VALUE;
        *bound = least_of(*bound, *turning->res[0]);
    }
    return DONE;
}
