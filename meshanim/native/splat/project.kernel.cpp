// Projection: Gaussians to records, depths, tiles and radii, in tasks of CHUNK Gaussians of one image.
#include <cmath>

#include "harmonics.h"
#include "isa.h"
#include "projection.h"
#include "splat.h"

namespace MESHANIM_NAMESPACE {
namespace {

using splat::Rectangle;
using splat::Scene;

// Colours of LANES Gaussians: up to GROUP channels a vector each, depth among them. Those beyond are blended from
// where they are.
struct Palette {
    Floats channel[splat::GROUP];

    void plain(const Scene &scene, int64_t frame, int64_t first, int count) {
        const int64_t width = scene.channels;
        const float *rows = at(scene.colors, frame, first, width);
        if (width == 3 && count == LANES) {
            Floats columns[3];
            simd::load_columns(rows, columns);
            for (int j = 0; j < 3; ++j) channel[j] = columns[j];
            channel[3] = broadcast(0.0f);
            return;
        }
        float columns[splat::GROUP][LANES] = {};
        for (int l = 0; l < LANES; ++l)
            for (int j = 0; j < int(width) && j < splat::GROUP; ++j) columns[j][l] = rows[(l < count ? l : count - 1) * width + j];
        for (int j = 0; j < splat::GROUP; ++j) channel[j] = simd::load(columns[j]);
    }

    void harmonic(const Scene &scene, const View &view, const Inputs &in, int64_t frame, int64_t first, int count, uint32_t visible) {
        Floats d[3];
        for (int j = 0; j < 3; ++j) d[j] = in.mean[j] - broadcast(view.position[j]);
        const Floats inverse = broadcast(1.0f) / simd::square_root(dot(d, d));
        Floats basis[16];
        harmonics(scene.coefficients, d[0] * inverse, d[1] * inverse, d[2] * inverse, basis);
        float values[16][LANES], colors[3][LANES] = {};
        for (int k = 0; k < scene.coefficients; ++k) simd::store(values[k], basis[k]);
        const float *rows = at(scene.colors, frame, first, 3 * scene.coefficients);
        for (int l = 0; l < count; ++l) {
            if (!(visible >> l & 1)) continue;
            const float *row = rows + int64_t(l) * 3 * scene.coefficients;
            float red = 0.5f, green = 0.5f, blue = 0.5f;
            for (int k = 0; k < scene.coefficients; ++k) {
                const float value = values[k][l];
                red += value * row[3 * k], green += value * row[3 * k + 1], blue += value * row[3 * k + 2];
            }
            colors[0][l] = red, colors[1][l] = green, colors[2][l] = blue;
        }
        for (int j = 0; j < 3; ++j) channel[j] = simd::maximum(broadcast(0.0f), simd::load(colors[j]));
        channel[3] = broadcast(0.0f);
    }
};

// The sum of zero times each: NaN if one is not finite.
inline Floats trace(Floats sum, Floats value) { return fma(value, broadcast(0.0f), sum); }

bool colors_are_finite(const Scene &scene, int64_t frame, int64_t first, int64_t count) {
    const float *values = at(scene.colors, frame, first, scene.channels);
    const int64_t size = count * scene.channels;
    Floats sum = broadcast(0.0f);
    int64_t i = 0;
    for (; i + LANES <= size; i += LANES) sum = trace(sum, simd::load(values + i));
    sum = trace(sum, simd::load_first(values + i, int(size - i)));
    return simd::sum(sum) == 0;
}

void project_chunk(const Scene &scene, int64_t image, int64_t chunk, const splat::Projected &out) {
    const View view(scene, image);
    const int64_t frame = image / scene.cameras, base = image * scene.gaussians;
    const int64_t begin = chunk * splat::CHUNK, end = begin + splat::CHUNK < scene.gaussians ? begin + splat::CHUNK : scene.gaussians;
    const float width = float(scene.width), height = float(scene.height);
    const Floats zero = broadcast(0.0f);
    Floats bad = zero;
    int64_t items = 0, entries = 0;
    uint32_t least = 0xffffffffu, most = 0;
    for (int64_t first = begin; first < end; first += LANES) {
        const int count = int(end - first < LANES ? end - first : LANES);
        const Inputs in = load_inputs(scene, frame, first, count);
        const Ellipse e(view, scene, in);
        for (int j = 0; j < 3; ++j) bad = trace(trace(bad, in.mean[j]), in.scale[j]);
        for (int j = 0; j < 4; ++j) bad = trace(bad, e.unit[j]);
        bad = trace(bad, in.opacity);
        const simd::Mask opaque = simd::at_least(e.opacity, broadcast(splat::MIN_ALPHA));
        const Floats level = simd::log2(simd::select(opaque, e.opacity, broadcast(1.0f)));
        const Floats room = simd::maximum(zero, level - broadcast(splat::LOG2_MIN_ALPHA));
        // room / KAPPA = 2 ln(255 opacity)
        const Floats reach = simd::minimum(broadcast(splat::MAX_EXTENT), simd::square_root(room * broadcast(1 / KAPPA)));
        const Floats deviation_x = simd::square_root(e.xx);
        const Floats extent_x = reach * deviation_x, extent_y = reach * simd::square_root(e.yy);
        const Floats one = broadcast(1.0f), radius_x = zero - simd::floor(zero - extent_x), radius_y = zero - simd::floor(zero - extent_y);
        simd::Mask seen = simd::both(simd::at_least(e.camera[2], broadcast(scene.near)), simd::at_least(broadcast(scene.far), e.camera[2]));
        seen = simd::both(simd::both(seen, opaque), simd::both(simd::greater(e.determinant, zero), simd::greater(broadcast(simd::INF), e.determinant)));
        seen = simd::both(seen, simd::both(simd::at_least(radius_x, one), simd::at_least(radius_y, one)));
        seen = simd::both(seen, simd::both(simd::greater(e.position[0] + radius_x, zero), simd::greater(broadcast(width), e.position[0] - radius_x)));
        seen = simd::both(seen, simd::both(simd::greater(e.position[1] + radius_y, zero), simd::greater(broadcast(height), e.position[1] - radius_y)));
        const uint32_t visible = simd::bits(seen) & ((count < 32 ? 1u << count : 0u) - 1u);

        Palette palette;
        if (scene.coefficients) palette.harmonic(scene, view, in, frame, first, count, visible);
        else palette.plain(scene, frame, first, count);
        if (scene.coefficients)
            for (int j = 0; j < 3; ++j) bad = trace(bad, palette.channel[j]);
        if (scene.depth && scene.channels < splat::GROUP) palette.channel[scene.channels] = e.camera[2];

        // Tiles with a pixel centre inside the box, which is a little wider than the ellipse.
        const Floats margin = broadcast(0.01f), limit = broadcast(float(1 << 20)), per_tile = broadcast(1.0f / splat::TILE), half = broadcast(0.5f);
        auto tile = [&](Floats pixel, int count_of) {
            const Floats inside = simd::minimum(simd::maximum((pixel - half) * per_tile, zero - one), limit);
            return simd::minimum(simd::floor(inside), broadcast(float(count_of)));
        };
        int32_t x0[LANES], x1[LANES], y0[LANES], y1[LANES], rx[LANES], ry[LANES];
        simd::store_rounded(x0, simd::maximum(zero, tile(e.position[0] - extent_x - margin, scene.columns())));
        simd::store_rounded(x1, simd::minimum(broadcast(float(scene.columns())), one + tile(e.position[0] + extent_x + margin, scene.columns())));
        simd::store_rounded(y0, simd::maximum(zero, tile(e.position[1] - extent_y - margin, scene.rows())));
        simd::store_rounded(y1, simd::minimum(broadcast(float(scene.rows())), one + tile(e.position[1] + extent_y + margin, scene.rows())));
        const Floats limit_of_radius = broadcast(1e9f);
        simd::store_rounded(rx, simd::minimum(simd::keep(seen, radius_x), limit_of_radius));
        simd::store_rounded(ry, simd::minimum(simd::keep(seen, radius_y), limit_of_radius));
        float z[LANES];
        simd::store(z, e.camera[2]);
        for (int l = 0; l < count; ++l) {
            const int64_t item = base + first + l;
            Rectangle box{0, 0, 0, 0};
            uint32_t depth = 0;
            if (visible >> l & 1) {
                if (x0[l] < x1[l] && y0[l] < y1[l]) {
                    box = {uint16_t(x0[l]), uint16_t(x1[l]), uint16_t(y0[l]), uint16_t(y1[l])};
                    std::memcpy(&depth, &z[l], sizeof depth);
                    least = depth < least ? depth : least, most = depth > most ? depth : most;
                    ++items;
                    entries += box.count();
                }
            } else {
                rx[l] = ry[l] = 0;
            }
            out.rectangles[item] = box;
            out.depths[item] = depth;
            out.radii[2 * item] = rx[l], out.radii[2 * item + 1] = ry[l];
        }
        if (!visible) continue;
        Floats fields[splat::RECORD] = {e.position[0], e.position[1], e.a, e.b, e.c, level, e.xy / deviation_x * reach, e.camera[2]};
        for (int j = 0; j < splat::GROUP; ++j) fields[splat::COLOR + j] = palette.channel[j];
        for (int j = splat::COLOR + splat::GROUP; j < splat::RECORD; ++j) fields[j] = zero;
        float *records = out.records + (base + first) * splat::RECORD;
        for (int part = 0; part < splat::RECORD / LANES; ++part) {
            Floats rows[LANES];
            for (int j = 0; j < LANES; ++j) rows[j] = fields[part * LANES + j];
            simd::transpose(rows);
            for (int l = 0; l < count; ++l) simd::store(records + l * splat::RECORD + part * LANES, rows[l]);
        }
    }
    const bool finite = scene.coefficients || image % scene.cameras || colors_are_finite(scene, frame, begin, end - begin);
    const int64_t task = image * scene.chunks() + chunk;
    out.chunk_items[task] = items;
    out.chunk_entries[task] = entries;
    out.chunk_least[task] = least, out.chunk_most[task] = most;
    out.chunk_bad[task] = !(simd::sum(bad) == 0) || !finite;
}

}  // namespace

void splat_project(const Scene &scene, const team::Member &member, const splat::Projected &out) {
    const int64_t chunks = scene.chunks();
    team::each(member, scene.images() * chunks, [&](int64_t task) { project_chunk(scene, task / chunks, task % chunks, out); });
}

}  // namespace MESHANIM_NAMESPACE
