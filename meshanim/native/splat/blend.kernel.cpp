// Blending: each tile's entries from near to far. A block of pixels keeps its light and colours in registers while
// its own list of entries passes.
#include <cstring>

#include "isa.h"
#include "splat.h"
#include "tile.h"

namespace MESHANIM_NAMESPACE {
namespace {

using splat::Forward;
using splat::Scene;

constexpr int BATCH = 128;   // entries that are listed at once

// What has been blended into a block so far. The light of a pixel that takes no more is kept with the other sign.
template <int CHANNELS>
struct State {
    Floats light[BLOCKS][PARTS], color[CHANNELS][BLOCKS][PARTS];

    bool open(int block) const {
        bool any = false;
        for (const Floats &part : light[block]) any = any || simd::any(simd::greater(part, broadcast(0.0f)));
        return any;
    }
};

template <int CHANNELS, bool CAPPED>
void blend_block(const Block &block, int index, const float *local, const int32_t *list, int count, float max_alpha,
                 State<CHANNELS> &state) {
    const Floats most = broadcast(max_alpha), end = broadcast(splat::MIN_LIGHT);
    Floats u[PARTS], v[PARTS], light[PARTS], color[CHANNELS][PARTS];
    for (int part = 0; part < PARTS; ++part) {
        u[part] = block.u[part], v[part] = block.v[part];
        light[part] = state.light[index][part];
        for (int j = 0; j < CHANNELS; ++j) color[j][part] = state.color[j][index][part];
    }
    for (int i = 0; i < count; ++i) {
        const float *e = local + list[i];
        Floats alpha[PARTS];
        visible_alphas<CAPPED>(e, u, v, most, alpha);
        for (int part = 0; part < PARTS; ++part) {
            const Floats left = simd::fnma(light[part], alpha[part], light[part]);
            const Mask taken = simd::greater(left, end);
            const Floats weight = simd::keep(taken, light[part] - left);
            for (int j = 0; j < CHANNELS; ++j) color[j][part] = fma(weight, broadcast(e[splat::COLOR + j]), color[j][part]);
            light[part] = simd::select(taken, left, simd::negative(light[part]));
        }
    }
    for (int part = 0; part < PARTS; ++part) {
        state.light[index][part] = light[part];
        for (int j = 0; j < CHANNELS; ++j) state.color[j][index][part] = color[j][part];
    }
}

// A plane of a tile from its blocks, a vector of a row of pixels at a time.
template <class Value>
void write_plane(const Scene &scene, const Tile &tile, float *plane, Value value) {
    constexpr int QUADS = LANES / BLOCK;
    for (int first = 0; first < BLOCKS; first += QUADS) {
        const int left = first % BLOCK_COLUMNS * BLOCK, columns = tile.width - left < LANES ? tile.width - left : LANES;
        if (columns <= 0) continue;
        for (int part = 0; part < PARTS; ++part) {
            const int top = first / BLOCK_COLUMNS * BLOCK + part * QUADS, rows = tile.height - top < QUADS ? tile.height - top : QUADS;
            Floats quads[QUADS];
            for (int j = 0; j < QUADS; ++j) quads[j] = value(first + j, part);
            simd::transpose_quads(quads);
            float *out = plane + int64_t(tile.y + top) * scene.width + tile.x + left;
            for (int j = 0; j < rows; ++j, out += scene.width) {
                if (columns == LANES) simd::store(out, quads[j]);
                else simd::store_first(out, quads[j], columns);
            }
        }
    }
}

// WIDTH channels of a tile, from `first` on; the channels of a pixel lie together in the image.
template <int WIDTH, class Value>
void write_colors(const Scene &scene, const Tile &tile, int64_t first, float *image, Value value) {
    for (int b = 0; b < BLOCKS; ++b) {
        const int left = b % BLOCK_COLUMNS * BLOCK, top = b / BLOCK_COLUMNS * BLOCK;
        const int columns = tile.width - left < BLOCK ? tile.width - left : BLOCK, rows = tile.height - top < BLOCK ? tile.height - top : BLOCK;
        if (columns <= 0) continue;
        float pixels[PIXELS * WIDTH];
        for (int part = 0; part < PARTS; ++part) {
            Floats channels[WIDTH];
            for (int j = 0; j < WIDTH; ++j) channels[j] = value(b, part, j);
            simd::store_columns(pixels + part * LANES * WIDTH, channels);
        }
        for (int row = 0; row < rows; ++row) {
            float *out = image + (int64_t(tile.y + top + row) * scene.width + tile.x + left) * scene.channels + first;
            const float *in = pixels + row * BLOCK * WIDTH;
            if (scene.channels == WIDTH && columns == BLOCK) std::memcpy(out, in, sizeof(float) * BLOCK * WIDTH);
            else
                for (int i = 0; i < columns; ++i) std::memcpy(out + i * scene.channels, in + i * WIDTH, sizeof(float) * WIDTH);
        }
    }
}

template <int CHANNELS>
void write_tile(const Scene &scene, const Tile &tile, int group, const State<CHANNELS> &state, const Forward &out) {
    const int64_t area = int64_t(scene.width) * scene.height, first = int64_t(group) * splat::GROUP;
    float *const image = out.rgb + tile.image * area * scene.channels;
    auto over = [&](int b, int part, int j) {
        const Floats behind = broadcast(scene.background[tile.image * scene.channels + first + j]);
        return fma(simd::magnitude(state.light[b][part]), behind, state.color[j][b][part]);
    };
    const bool depth = first + CHANNELS > scene.channels;   // the last of these channels
    if (!depth) write_colors<CHANNELS>(scene, tile, first, image, over);
    else if constexpr (CHANNELS > 1) write_colors<CHANNELS - 1>(scene, tile, first, image, over);
    if (depth) write_plane(scene, tile, out.depth + tile.image * area, [&](int b, int part) { return state.color[CHANNELS - 1][b][part]; });
    if (group == 0)
        write_plane(scene, tile, out.alpha + tile.image * area, [&](int b, int part) { return broadcast(1.0f) - simd::magnitude(state.light[b][part]); });
}

template <int CHANNELS>
void blend_tile(const Scene &scene, const Forward &out, int64_t index, int group) {
    const Tile tile(scene, index);
    const int64_t begin = out.bins.tiles[index], end = out.bins.tiles[index + 1];
    State<CHANNELS> state;
    bool open[BLOCKS];
    for (int b = 0; b < BLOCKS; ++b) {
        const Floats one = broadcast(1.0f);
        for (int part = 0; part < PARTS; ++part) {
            for (int j = 0; j < CHANNELS; ++j) state.color[j][b][part] = broadcast(0.0f);
            state.light[b][part] = simd::select(block_at(b).inside(tile, part), one, simd::negative(one));
        }
        open[b] = state.open(b);
    }
    alignas(64) float local[BATCH * RECORD];
    int32_t lists[BLOCKS * (BATCH + ROOM)], counts[BLOCKS];
    int64_t first = begin;
    bool any = true;
    for (; first < end && any; first += BATCH) {
        const int count = int(end - first < BATCH ? end - first : BATCH);
        uint16_t masks[BATCH];
        const bool capped = load_entries<true>(scene, tile, out.records, out.bins.entries + first, count, out.bins.count - first, group, local, masks, nullptr);
        if (group == 0) std::memcpy(out.masks + first, masks, sizeof(uint16_t) * size_t(count));
        list_blocks(masks, count, lists, BATCH + ROOM, counts);
        any = false;
        for (int b = 0; b < BLOCKS; ++b) {
            if (!open[b]) continue;
            if (counts[b]) {
                const auto blend = capped ? blend_block<CHANNELS, true> : blend_block<CHANNELS, false>;
                blend(block_at(b), b, local, lists + b * (BATCH + ROOM), counts[b], scene.max_alpha, state);
                open[b] = state.open(b);
            }
            any = any || open[b];
        }
    }
    out.used[index] = int32_t((first < end ? first : end) - begin);
    write_tile<CHANNELS>(scene, tile, group, state, out);
}

}  // namespace

void splat_blend(const Scene &scene, const team::Member &member, const Forward &out) {
    for (int group = 0; group < scene.groups(); ++group) {
        const int channels = scene.width_of(group);
        if (group) team::wait(member);
        team::take(member, scene.tiles(), 4, [&](int64_t tile) {
            if (channels == 1) blend_tile<1>(scene, out, tile, group);
            else if (channels == 2) blend_tile<2>(scene, out, tile, group);
            else if (channels == 3) blend_tile<3>(scene, out, tile, group);
            else blend_tile<4>(scene, out, tile, group);
        });
    }
}

}  // namespace MESHANIM_NAMESPACE
