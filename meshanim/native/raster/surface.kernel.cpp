// Posed geometry: a sparse operator times points, and area-weighted vertex normals.
#include "raster.h"
#include "vector.h"

namespace MESHANIM_NAMESPACE {

void apply_operator(const int32_t *row_start, const int32_t *columns, const float *values, int64_t rows,
                    const float *points, float *out, int threads) {
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t i = 0; i < rows; ++i) {
        Vec sum{0, 0, 0};
        for (int32_t k = row_start[i]; k < row_start[i + 1]; ++k) sum = sum + load(points + 3 * columns[k]) * values[k];
        out[3 * i] = sum.x, out[3 * i + 1] = sum.y, out[3 * i + 2] = sum.z;
    }
}

// incident_start (V + 1), incident: the faces around each vertex; face_normals (F, 3) is scratch.
void vertex_normals(const float *vertices, int64_t n_vertices, const int32_t *faces, int64_t n_faces,
                    const int32_t *incident_start, const int32_t *incident, float *face_normals, float *normals,
                    int threads) {
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t f = 0; f < n_faces; ++f) {
        const Vec a = load(vertices + 3 * faces[3 * f]);
        const Vec n = cross(load(vertices + 3 * faces[3 * f + 1]) - a, load(vertices + 3 * faces[3 * f + 2]) - a);
        face_normals[3 * f] = n.x, face_normals[3 * f + 1] = n.y, face_normals[3 * f + 2] = n.z;
    }
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t i = 0; i < n_vertices; ++i) {
        Vec sum{0, 0, 0};
        for (int32_t k = incident_start[i]; k < incident_start[i + 1]; ++k) sum = sum + load(face_normals + 3 * incident[k]);
        sum = unit(sum);
        normals[3 * i] = sum.x, normals[3 * i + 1] = sum.y, normals[3 * i + 2] = sum.z;
    }
}

// target (rows, columns, channels) += amplitude * patch (h, w, channels) at (row, column).
void add_patch(float *target, int64_t columns, int channels, const float *patch, int64_t height, int64_t width,
               int64_t row, int64_t column, float amplitude) {
    for (int64_t y = 0; y < height; ++y) {
        float *t = target + ((row + y) * columns + column) * channels;
        const float *p = patch + y * width * channels;
        for (int64_t x = 0; x < width * channels; ++x) t[x] += amplitude * p[x];
    }
}

}  // namespace MESHANIM_NAMESPACE
