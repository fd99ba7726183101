// Z-buffer over horizontal bands: fixed-point edge functions with the top-left rule, so that triangles which share
// an edge cover each pixel centre exactly once (Pineda 1988; OpenGL's invariance rule).
#include <algorithm>
#include <cmath>
#include <vector>

#include "isa.h"
#include "raster.h"

namespace MESHANIM_NAMESPACE {
namespace {

using raster::View;

constexpr int SUBPIXEL = 1024;        // fixed point: 1/1024 pixel
constexpr double GUARD = 1 << 18;     // pixels; farther points are clipped, so that products stay under 2^60
constexpr int BAND = 16;              // rows a task
constexpr int CHUNK = 2048;           // faces a task in the set-up

struct Projected {
    int32_t x, y;      // fixed point
    float key;         // greater is nearer: 1 / z, or -z if orthographic
    float clip;        // nonzero: needs the clipper
    double camera[3];
};

struct Record {                    // a triangle in the image, positive area
    int32_t x[3], y[3];
    float key[3];
    int32_t face;
    int32_t corner[3];             // which corner of the face each vertex is (rows of `weights` when clipped)
    int32_t clipped;               // index into weights, or -1
};

struct Clipped {
    double p[3];                   // camera space
    float weight[3];               // barycentric coordinates in the face
};

double plane_distance(const View &v, const double *p, int plane) {
    if (plane == 0) return p[2] - v.near;
    const double w = v.orthographic ? 1.0 : p[2];
    const double x = v.fx * p[0] + v.skew * p[1] + v.cx * w, y = v.fy * p[1] + v.cy * w;
    switch (plane) {
        case 1: return GUARD * w - x;
        case 2: return GUARD * w + x;
        case 3: return GUARD * w - y;
        default: return GUARD * w + y;
    }
}

void project(const View &v, const double *p, Projected &out) {
    const double w = v.orthographic ? 1.0 : 1.0 / p[2];
    out.x = int32_t(std::lrint(((v.fx * p[0] + v.skew * p[1]) * w + v.cx) * SUBPIXEL));
    out.y = int32_t(std::lrint((v.fy * p[1] * w + v.cy) * SUBPIXEL));
    out.key = v.orthographic ? float(-p[2]) : float(w);
}

// Rows of pixel centres that the fixed-point interval [lo, hi] can cover.
int first_centre(int32_t lo) { return (lo - SUBPIXEL / 2 + SUBPIXEL - 1) >> 10; }
int last_centre(int32_t hi) { return (hi - SUBPIXEL / 2) >> 10; }

// std::vector of a built-in type would be one instantiation for all instruction sets; these types are local.
struct Weights {
    float of[3][3];                // [corner of the clipped triangle][corner of the face]
};
struct Index {
    int32_t value;
};
struct Offset {
    int64_t value;
};

struct Output {
    std::vector<Record> records;
    std::vector<Weights> weights;
};

void emit(const View &view, bool cull, const Projected *const p[3], int32_t face, const Clipped *const c[3], Output &out) {
    Record r;
    const int64_t area = int64_t(p[1]->x - p[0]->x) * (p[2]->y - p[0]->y) - int64_t(p[1]->y - p[0]->y) * (p[2]->x - p[0]->x);
    // Counter-clockwise seen from outside, y down in the image: a front face has negative area.
    if (area == 0 || (cull && area > 0)) return;
    const int order[3] = {0, area > 0 ? 1 : 2, area > 0 ? 2 : 1};
    for (int k = 0; k < 3; ++k) {
        const Projected &q = *p[order[k]];
        r.x[k] = q.x, r.y[k] = q.y, r.key[k] = q.key, r.corner[k] = order[k];
    }
    if (first_centre(std::min({r.x[0], r.x[1], r.x[2]})) > std::min(view.width - 1, last_centre(std::max({r.x[0], r.x[1], r.x[2]})))) return;
    if (first_centre(std::min({r.y[0], r.y[1], r.y[2]})) > std::min(view.height - 1, last_centre(std::max({r.y[0], r.y[1], r.y[2]})))) return;
    if (std::max({r.x[0], r.x[1], r.x[2]}) < 0 || std::max({r.y[0], r.y[1], r.y[2]}) < 0) return;
    r.face = face;
    r.clipped = -1;
    if (c) {
        r.clipped = int32_t(out.weights.size());
        Weights w;
        for (int k = 0; k < 3; ++k)
            for (int j = 0; j < 3; ++j) w.of[k][j] = c[order[k]]->weight[j];
        out.weights.push_back(w);
    }
    out.records.push_back(r);
}

// Sutherland-Hodgman. A new point is always computed from the inner to the outer end, so neighbours agree on it.
void clip_and_emit(const View &view, bool cull, const Projected *const p[3], int32_t face, Output &out) {
    Clipped a[10], b[10];
    int n = 3;
    for (int k = 0; k < 3; ++k) {
        for (int j = 0; j < 3; ++j)
            if (!std::isfinite(p[k]->camera[j])) return;
        std::copy(p[k]->camera, p[k]->camera + 3, a[k].p);
        for (int j = 0; j < 3; ++j) a[k].weight[j] = float(j == k);
    }
    for (int plane = 0; plane < 5; ++plane) {
        int m = 0;
        for (int k = 0; k < n; ++k) {
            const Clipped &s = a[k], &t = a[(k + 1) % n];
            const double ds = plane_distance(view, s.p, plane), dt = plane_distance(view, t.p, plane);
            if (ds >= 0) b[m++] = s;
            if ((ds >= 0) != (dt >= 0)) {
                const Clipped &inner = ds >= 0 ? s : t, &outer = ds >= 0 ? t : s;
                const double di = ds >= 0 ? ds : dt, u = di / (di - (ds >= 0 ? dt : ds));
                for (int j = 0; j < 3; ++j) {
                    b[m].p[j] = inner.p[j] + u * (outer.p[j] - inner.p[j]);
                    b[m].weight[j] = float(inner.weight[j] + u * (outer.weight[j] - inner.weight[j]));
                }
                ++m;
            }
        }
        n = m;
        if (n < 3) return;
        std::copy(b, b + n, a);
    }
    Projected q[10];
    for (int k = 0; k < n; ++k) project(view, a[k].p, q[k]);
    for (int k = 1; k + 1 < n; ++k) {
        const Projected *const corner[3] = {&q[0], &q[k], &q[k + 1]};
        const Clipped *const c[3] = {&a[0], &a[k], &a[k + 1]};
        emit(view, cull, corner, face, c, out);
    }
}

// Edge function of the directed edge s -> t at pixel centre (x, y), and its steps; `bias` makes >= 0 the top-left rule.
struct Edge {
    int64_t dx, dy, value;
    void start(const Record &r, int s, int t, int x, int y) {
        dx = r.x[t] - r.x[s], dy = r.y[t] - r.y[s];
        value = dx * (int64_t(y) * SUBPIXEL + SUBPIXEL / 2 - r.y[s]) - dy * (int64_t(x) * SUBPIXEL + SUBPIXEL / 2 - r.x[s]);
    }
    int64_t bias() const { return dy < 0 || (dy == 0 && dx > 0) ? 0 : -1; }
};

void fill(const Record &r, int32_t index, int width, int row0, int row1, int32_t *record, float *key) {
    const int x0 = std::max(0, first_centre(std::min({r.x[0], r.x[1], r.x[2]})));
    const int x1 = std::min(width - 1, last_centre(std::max({r.x[0], r.x[1], r.x[2]})));
    const int y0 = std::max(row0, first_centre(std::min({r.y[0], r.y[1], r.y[2]})));
    const int y1 = std::min(row1 - 1, last_centre(std::max({r.y[0], r.y[1], r.y[2]})));
    if (x0 > x1 || y0 > y1) return;
    Edge a, b, c;                                     // opposite to corners 0, 1, 2
    a.start(r, 1, 2, x0, y0);
    b.start(r, 2, 0, x0, y0);
    c.start(r, 0, 1, x0, y0);
    const double inverse = 1.0 / double(a.value + b.value + c.value);
    const float step_x = float(-SUBPIXEL * (double(a.dy) * r.key[0] + double(b.dy) * r.key[1] + double(c.dy) * r.key[2]) * inverse);
    const float step_y = float(SUBPIXEL * (double(a.dx) * r.key[0] + double(b.dx) * r.key[1] + double(c.dx) * r.key[2]) * inverse);
    const float first = float((double(a.value) * r.key[0] + double(b.value) * r.key[1] + double(c.value) * r.key[2]) * inverse);
    int64_t ea = a.value + a.bias(), eb = b.value + b.bias(), ec = c.value + c.bias();
    const int64_t ax = -a.dy * SUBPIXEL, bx = -b.dy * SUBPIXEL, cx = -c.dy * SUBPIXEL;
    const int64_t ay = a.dx * SUBPIXEL, by = b.dx * SUBPIXEL, cy = c.dx * SUBPIXEL;
    for (int y = y0; y <= y1; ++y, ea += ay, eb += by, ec += cy) {
        int64_t fa = ea, fb = eb, fc = ec;
        const float base = first + step_y * float(y - y0);
        float *krow = key + int64_t(y) * width;
        int32_t *rrow = record + int64_t(y) * width;
        for (int x = x0; x <= x1; ++x, fa += ax, fb += bx, fc += cx) {
            if ((fa | fb | fc) < 0) continue;
            const float k = base + step_x * float(x - x0);
            if (k > krow[x]) krow[x] = k, rrow[x] = index;
        }
    }
}

}  // namespace

// face: -1 where nothing is seen; depth: metres along the viewing axis, infinity where nothing is seen;
// barycentric may be null. Rows are filled by bands, so the result does not depend on the number of threads.
void rasterize(const float *vertices, int64_t n_vertices, const int32_t *faces, int64_t n_faces, const View &view,
               bool cull, int32_t *face, float *depth, float *barycentric, int threads) {
    std::vector<Projected> projected(n_vertices);
    const double *m = view.world_to_camera;
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t i = 0; i < n_vertices; ++i) {
        Projected &q = projected[i];
        const float *p = vertices + 3 * i;
        for (int k = 0; k < 3; ++k) q.camera[k] = m[4 * k] * p[0] + m[4 * k + 1] * p[1] + m[4 * k + 2] * p[2] + m[4 * k + 3];
        q.clip = 0;
        for (int plane = 0; plane < 5; ++plane)
            if (!(plane_distance(view, q.camera, plane) >= 0)) q.clip = 1;
        if (!q.clip) project(view, q.camera, q);
    }

    const int64_t chunks = (n_faces + CHUNK - 1) / CHUNK;
    std::vector<Output> outputs(chunks);
#pragma omp parallel for num_threads(threads) schedule(dynamic)
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
        Output &out = outputs[chunk];
        for (int64_t f = chunk * CHUNK; f < std::min(n_faces, (chunk + 1) * CHUNK); ++f) {
            const Projected *const p[3] = {&projected[faces[3 * f]], &projected[faces[3 * f + 1]], &projected[faces[3 * f + 2]]};
            if (p[0]->clip || p[1]->clip || p[2]->clip)
                clip_and_emit(view, cull, p, int32_t(f), out);
            else
                emit(view, cull, p, int32_t(f), nullptr, out);
        }
    }

    std::vector<Record> records;
    std::vector<Weights> weights;
    size_t total = 0;
    for (const Output &out : outputs) total += out.records.size();
    records.reserve(total);
    for (Output &out : outputs) {
        for (Record &r : out.records)
            if (r.clipped >= 0) r.clipped += int32_t(weights.size());
        records.insert(records.end(), out.records.begin(), out.records.end());
        weights.insert(weights.end(), out.weights.begin(), out.weights.end());
    }

    const int bands = (view.height + BAND - 1) / BAND;
    std::vector<Offset> start(bands + 1, Offset{0});
    auto rows = [&](const Record &r, int &lo, int &hi) {
        lo = std::max(0, first_centre(std::min({r.y[0], r.y[1], r.y[2]}))) / BAND;
        hi = std::min(view.height - 1, last_centre(std::max({r.y[0], r.y[1], r.y[2]}))) / BAND;
    };
    int lo, hi;
    for (const Record &r : records)
        for (rows(r, lo, hi); lo <= hi; ++lo) ++start[lo + 1].value;
    for (int b = 0; b < bands; ++b) start[b + 1].value += start[b].value;
    std::vector<Index> binned(start[bands].value);
    std::vector<Offset> next(start.begin(), start.end() - 1);
    for (size_t i = 0; i < records.size(); ++i)
        for (rows(records[i], lo, hi); lo <= hi; ++lo) binned[next[lo].value++].value = int32_t(i);

#pragma omp parallel for num_threads(threads) schedule(dynamic)
    for (int band = 0; band < bands; ++band) {
        const int row0 = band * BAND, row1 = std::min(view.height, row0 + BAND);
        std::fill(face + int64_t(row0) * view.width, face + int64_t(row1) * view.width, -1);
        std::fill(depth + int64_t(row0) * view.width, depth + int64_t(row1) * view.width, -INFINITY);
        for (int64_t i = start[band].value; i < start[band + 1].value; ++i)
            fill(records[binned[i].value], binned[i].value, view.width, row0, row1, face, depth);
        for (int y = row0; y < row1; ++y)
            for (int x = 0; x < view.width; ++x) {
                const int64_t pixel = int64_t(y) * view.width + x;
                float *w = barycentric ? barycentric + 3 * pixel : nullptr;
                const int32_t index = face[pixel];
                if (index < 0) {
                    depth[pixel] = INFINITY;
                    if (w) w[0] = w[1] = w[2] = 0;
                    continue;
                }
                const Record &r = records[index];
                face[pixel] = r.face;
                if (!w) {
                    depth[pixel] = view.orthographic ? -depth[pixel] : 1.0f / depth[pixel];
                    continue;
                }
                Edge e[3];
                e[0].start(r, 1, 2, x, y);
                e[1].start(r, 2, 0, x, y);
                e[2].start(r, 0, 1, x, y);
                double share[3], sum = 0, area = 0, z = 0;
                for (int k = 0; k < 3; ++k) {
                    share[k] = double(e[k].value) * (view.orthographic ? 1.0 : double(r.key[k]));
                    sum += share[k], area += double(e[k].value), z += double(e[k].value) * -double(r.key[k]);
                }
                depth[pixel] = float(view.orthographic ? z / area : area / sum);
                w[0] = w[1] = w[2] = 0;
                for (int k = 0; k < 3; ++k) {
                    const double s = share[k] / sum;
                    if (r.clipped < 0)
                        w[r.corner[k]] = float(s);
                    else
                        for (int j = 0; j < 3; ++j) w[j] += float(s * weights[r.clipped].of[k][j]);
                }
            }
    }
}

}  // namespace MESHANIM_NAMESPACE
