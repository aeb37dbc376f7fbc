/* A strictly convex QP whose working set is known: rows that hold with equality, at the minimum of x'Hx/2 + g'x.

   With H = U'U, a row a is the column U^-T a, and the products of columns are those of the range space. Columns that
   were made once serve every working set of the same H. */

typedef struct {
    int unknowns, most;                  /* n; room for columns */
    int is_begun, count;                 /* whether U is known; columns so far */
    int size;                            /* of the working set */
    double *factor;                      /* (n, n) U above the diagonal, and on it the inverses of its diagonal */
    double *columns, *products;          /* (n, most), (most, most) */
    double *pull, *along;                /* (n) U^-T g; (most) products of the columns with it */
    double *inner;                       /* (most, most) the factor of the products of the working set, like U */
    int *chosen;                         /* (most) columns of the working set */
    double *share, *spread;              /* (most) of the chosen columns; of all columns */
    double *point;                       /* (n) */
} Working;

/* In place, the factor of the upper triangle of A (n, n); 0 if A is not positive definite. */
static int factorise(double *A, int n, int stride)
{
    for (int j = 0; j < n; j++) {
        double *row = A + j * stride;
        if (!(row[j] > 0.0)) return 0;
        double pivot = row[j] = 1.0 / sqrt(row[j]);
        for (int k = j + 1; k < n; k++) row[k] *= pivot;
        for (int i = j + 1; i < n; i++) {
            double factor = row[i], *to = A + i * stride;
            for (int k = i; k < n; k++) to[k] -= factor * row[k];
        }
    }
    return 1;
}

/* In place, b becomes U^-T b; its entries before the first are zero. */
static void solve_lower(const double *U, int n, int stride, int first, double *b)
{
    for (int j = first; j < n; j++) {
        double value = b[j] *= U[j * stride + j];
        for (int i = j + 1; i < n; i++) b[i] -= value * U[j * stride + i];
    }
}

/* In place, b becomes U^-1 b. */
static void solve_upper(const double *U, int n, int stride, double *b)
{
    for (int j = n - 1; j >= 0; j--)
        b[j] = (b[j] - dot(U + j * stride + j + 1, b + j + 1, n - j - 1)) * U[j * stride + j];
}

/* Begin with H, g and, as its columns, the rows (m, n), each times its lever; 0 if H is not positive definite. */
static int begin(Working *w, const double *H, const double *g, const double *rows, const double *levers, int m)
{
    int n = w->unknowns, most = w->most;
    memcpy(w->factor, H, sizeof(double) * n * n);
    if (!factorise(w->factor, n, n)) return 0;
    memcpy(w->pull, g, sizeof(double) * n);
    solve_lower(w->factor, n, n, 0, w->pull);
    for (int k = 0; k < m; k++) {
        for (int j = 0; j < n; j++) w->columns[j * most + k] = levers[k] * rows[k * n + j];
        memset(w->products + k * most, 0, sizeof(double) * m);
    }
    memset(w->along, 0, sizeof(double) * m);
    for (int j = 0; j < n; j++) {
        const double *U = w->factor + j * n;
        double *from = w->columns + j * most;
        for (int k = 0; k < m; k++) from[k] *= U[j];
        for (int k = 0; k < m; k++) w->along[k] += w->pull[j] * from[k];
        for (int i = j + 1; i < n; i++) {
            double *to = w->columns + i * most;
            for (int k = 0; k < m; k++) to[k] -= U[i] * from[k];
        }
        for (int i = 0; i < m; i++)
            for (int k = i; k < m; k++) w->products[i * most + k] += from[i] * from[k];
    }
    for (int i = 0; i < m; i++)
        for (int k = 0; k < i; k++) w->products[i * most + k] = w->products[k * most + i];
    return 1;
}

/* Add the column of the row in `point` (n), whose entries before the first are zero; return its number, -1 if there is
   no room. */
static int extend(Working *w, int first)
{
    int n = w->unknowns, most = w->most, column = w->count;
    double *to = w->products + column * most;
    if (column == most) return -1;
    solve_lower(w->factor, n, n, first, w->point);
    w->count++;
    memset(to, 0, sizeof(double) * w->count);
    w->along[column] = dot(w->pull, w->point, n);
    for (int j = 0; j < n; j++) {
        double *row = w->columns + j * most;
        row[column] = w->point[j];
        for (int k = 0; k <= column; k++) to[k] += w->point[j] * row[k];
    }
    for (int k = 0; k < column; k++) w->products[k * most + column] = to[k];
    return column;
}

/* Factorise the products of the chosen columns; 0 if they are dependent. */
static int choose(Working *w, int size)
{
    w->size = size;
    for (int i = 0; i < size; i++)
        for (int k = i; k < size; k++)
            w->inner[i * w->most + k] = w->products[w->chosen[i] * w->most + w->chosen[k]];
    if (size <= w->unknowns && factorise(w->inner, size, w->most)) return 1;
    w->size = 0;
    return 0;
}

/* The shares (size) of the first chosen columns are wanted products with these columns. They become the multipliers whose
   sum of columns has these products; `spread` has them for all columns. The point becomes U^-1 times that sum and
   `pulled` times the pull. */
static void combine(Working *w, int size, double pulled)
{
    solve_lower(w->inner, size, w->most, 0, w->share);
    solve_upper(w->inner, size, w->most, w->share);
    memset(w->spread, 0, sizeof(double) * w->count);
    for (int k = 0; k < size; k++) w->spread[w->chosen[k]] = w->share[k];
    for (int j = 0; j < w->unknowns; j++)
        w->point[j] = pulled * w->pull[j] + dot(w->columns + j * w->most, w->spread, w->count);
    solve_upper(w->factor, w->unknowns, w->unknowns, w->point);
}
