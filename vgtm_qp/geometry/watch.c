/* Pairs of bodies and pieces over a straight motion: which may have come near, and the contacts of these. */

/* Numbers of the ends of a pair before and after a motion; of what is known of it, of which the last three are a normal;
   and of its two contacts, of which the sixth to eighth are a normal: see follow_function. */
enum { ENDS = 24, KNOWN = 19, KNOWN_NORMAL = 16, CONTACTS = 18, NORMAL = 5 };

enum { DONE, NO_VALUE };

/* The lesser of two numbers; NaN if one of them is, for ever. */
static double least_of(double a, double b)
{
    return b >= a || a != a ? a : b;
}

/* How the axes of bodies move: of each the displacement of its middle, half that of one end from the other, and the
   greatest of its ends'. */
typedef struct {
    int points, bodies;
    const int *ends;                 /* (B, 2) points */
    const double *before, *after;    /* (P, 3) */
    double *middle, *turned, *furthest;    /* (B, 3), (B), (B) */
    double square;                   /* sum of all squares, which is NaN if a position is */
} Motion;

EXPORT int follow(Motion *m)
{
    m->square = 0.0;
    for (int k = 0; k < 3 * m->points; k++) {
        double moved = m->after[k] - m->before[k];
        m->square += moved * moved;
    }
    for (int b = 0; b < m->bodies; b++) {
        double square[3] = {0.0, 0.0, 0.0};
        const int *ends = m->ends + 2 * b;
        for (int a = 0; a < 3; a++) {
            double first = m->after[3 * ends[0] + a] - m->before[3 * ends[0] + a];
            double second = m->after[3 * ends[1] + a] - m->before[3 * ends[1] + a];
            m->middle[3 * b + a] = 0.5 * (first + second);
            square[0] += first * first;
            square[1] += second * second;
            square[2] += 0.25 * (second - first) * (second - first);
        }
        m->turned[b] = sqrt(square[2]);
        m->furthest[b] = sqrt(square[0] > square[1] ? square[0] : square[1]);
    }
    return DONE;
}

/* Pairs of one shape, each with a lower bound of its distance. */
typedef struct {
    int count, is_self;
    const int *body, *other, *points;    /* (C), (C), (C, 4) */
    const double *before, *after;        /* (P, 3) */
    const double *middle, *turned, *furthest;    /* of Motion */
    double *lower, *known;               /* (C), (C, 19): see follow_function */
    double limit, next;                  /* pairs nearer than this are evaluated; ratio to it if none is near */

    Kernel contact;                      /* (ends 24, known 19) -> 18 numbers of contacts, and a bound */
    double *ends, *pair;
    const double *found;

    int near, is_close, overlaps;
    double lowest;                       /* least lower bound on the way of the pairs that were evaluated */
    Index *rows;                         /* (C): these pairs */
    double *contacts;                    /* (2 C, 9): two for each */
} Pairs;

/* Lower the bounds by what the bodies moved, and evaluate the pairs that may be near. */
EXPORT int evaluate(Pairs *p)
{
    double least = INFINITY, reach = p->is_close ? p->limit : fmax(p->limit, p->next * p->limit);
    int is_known = 1;
    for (int k = 0; k < p->count; k++) {
        int a = p->body[k], b = p->other[k];
        double nearer = p->furthest[a];
        if (p->is_self) {
            double square = 0.0;
            for (int i = 0; i < 3; i++) {
                double apart = p->middle[3 * a + i] - p->middle[3 * b + i];
                square += apart * apart;
            }
            nearer = sqrt(square) + p->turned[a] + p->turned[b];
        }
        p->lower[k] -= nearer;
        /* A negated comparison is true for NaN. */
        if (!(p->lower[k] >= p->limit)) is_known = 0;
    }
    p->near = p->is_close = p->overlaps = 0;
    p->lowest = INFINITY;
    if (is_known) return DONE;
    for (int k = 0; k < p->count; k++) {
        if (p->lower[k] >= reach) continue;
        double *known = p->known + KNOWN * k, *contacts = p->contacts + CONTACTS * p->near;
        for (int i = 0; i < 4; i++) {
            memcpy(p->ends + 3 * i, p->before + 3 * p->points[4 * k + i], 3 * sizeof(double));
            memcpy(p->ends + ENDS / 2 + 3 * i, p->after + 3 * p->points[4 * k + i], 3 * sizeof(double));
        }
        memcpy(p->pair, known, KNOWN * sizeof(double));
        if (call(&p->contact)) return NO_VALUE;
        memcpy(contacts, p->found, CONTACTS * sizeof(double));
        memcpy(known + KNOWN_NORMAL, p->found + NORMAL, 3 * sizeof(double));
        /* The bound from the motion alone holds as well. */
        double bound = p->found[CONTACTS] > p->lower[k] ? p->found[CONTACTS] : p->lower[k];
        p->lowest = least_of(p->lowest, bound);
        p->lower[k] = p->found[0];
        if (!(p->found[0] > 0.0)) p->overlaps = 1;
        least = least_of(least, p->found[0]);
        p->rows[p->near++] = k;
    }
    p->is_close = least < p->limit;
    return DONE;
}
