// b = D' (v - v0) for many frames: the sampled vertices are gathered, and only tiles of D that are not zero are read.
#include <algorithm>
#include <vector>

#include "../simd.h"
#include "boxqp.h"

namespace MESHANIM_NAMESPACE {
namespace {

using namespace simd;
constexpr int TILE = TiledMatrix::TILE, STRIP = TiledMatrix::STRIP;
constexpr int64_t AHEAD = 64;  // vertices that are fetched from memory before their turn

void gather(const Projection &p, int64_t frame, float *row) {
    const float *vertices = p.frames + frame * 3 * p.vertices;
    for (int64_t i = 0; i < p.samples; ++i) {
        const float *from = vertices + 3 * int64_t(p.sampled[i]);
#if defined(__GNUC__)
        if (i + AHEAD < p.samples) __builtin_prefetch(vertices + 3 * int64_t(p.sampled[i + AHEAD]));
#endif
        for (int axis = 0; axis < 3; ++axis) row[3 * i + axis] = from[axis] - p.neutral[3 * i + axis];
    }
}

// LANES frames at once: a lane of the result is a frame. Sums of a strip are floats, of strips doubles.
void many_frames(const TiledMatrix &m, const float *rows, int64_t stride, double *total) {
    for (int64_t strip = 0; strip < m.strips; ++strip) {
        const float *at = rows + strip * STRIP;
        for (int32_t i = m.offsets[strip]; i < m.offsets[strip + 1];) {
            const int32_t column = m.column[i];
            Floats sum[LANES];
            for (int f = 0; f < LANES; ++f) sum[f] = zeros();
            for (; i < m.offsets[strip + 1] && m.column[i] == column; ++i) {
                const float *tile = m.tiles + int64_t(i) * TILE, *part = at + m.place[i] * TILE;
                for (int k = 0; k < TILE; k += LANES) {
                    const Floats d = load(tile + k);
                    for (int f = 0; f < LANES; ++f) sum[f] = fma(d, load(part + f * stride + k), sum[f]);
                }
            }
            float lanes[LANES];
            store(lanes, sums(sum));
            for (int f = 0; f < LANES; ++f) total[f * m.columns + column] += lanes[f];
        }
    }
}

void one_frame(const TiledMatrix &m, const float *row, double *total) {
    for (int64_t strip = 0; strip < m.strips; ++strip)
        for (int32_t i = m.offsets[strip]; i < m.offsets[strip + 1];) {
            const int32_t column = m.column[i];
            Floats even = zeros(), odd = zeros();
            for (; i < m.offsets[strip + 1] && m.column[i] == column; ++i) {
                const float *tile = m.tiles + int64_t(i) * TILE, *part = row + strip * STRIP + m.place[i] * TILE;
                for (int k = 0; k < TILE; k += 2 * LANES) {
                    even = fma(load(tile + k), load(part + k), even);
                    odd = fma(load(tile + k + LANES), load(part + k + LANES), odd);
                }
            }
            total[column] += sum(even + odd);
        }
}

}  // namespace

void project(const Projection &p) {
    const TiledMatrix &m = p.matrix;
    const int64_t stride = m.strips * STRIP, groups = (p.count + LANES - 1) / LANES;
    std::fill(p.out, p.out + p.count * m.columns, 0.0);
#pragma omp parallel num_threads(int(std::max<int64_t>(1, std::min<int64_t>(p.threads, groups))))
    {
        std::vector<float> rows(size_t(stride * std::min<int64_t>(p.count, LANES)), 0.0f);
#pragma omp for schedule(static)
        for (int64_t group = 0; group < groups; ++group) {
            const int64_t first = group * LANES, frames = std::min<int64_t>(LANES, p.count - first);
            for (int64_t f = 0; f < frames; ++f) gather(p, first + f, rows.data() + f * stride);
            double *total = p.out + first * m.columns;
            if (frames == LANES)
                many_frames(m, rows.data(), stride, total);
            else
                for (int64_t f = 0; f < frames; ++f)
                    one_frame(m, rows.data() + f * stride, total + f * m.columns);
        }
    }
}

}  // namespace MESHANIM_NAMESPACE
