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
    Floats light[BLOCKS], color[CHANNELS][BLOCKS];
};

template <int CHANNELS, bool CAPPED>
void blend_block(const Block &block, int index, const float *local, const int32_t *list, int count, float max_alpha,
                 State<CHANNELS> &state) {
    const Floats u = block.u, v = block.v, most = broadcast(max_alpha), end = broadcast(splat::MIN_LIGHT);
    Floats light = state.light[index], color[CHANNELS];
    for (int j = 0; j < CHANNELS; ++j) color[j] = state.color[j][index];
    for (int i = 0; i < count; ++i) {
        const float *e = local + list[i];
        const Floats alpha = visible_alpha<CAPPED>(e, u, v, most), left = simd::fnma(light, alpha, light);
        const Mask taken = simd::greater(left, end);
        const Floats weight = simd::keep(taken, light - left);
        for (int j = 0; j < CHANNELS; ++j) color[j] = fma(weight, broadcast(e[splat::COLOR + j]), color[j]);
        light = simd::select(taken, left, simd::negative(light));
    }
    state.light[index] = light;
    for (int j = 0; j < CHANNELS; ++j) state.color[j][index] = color[j];
}

// A plane of a tile from its blocks, a vector of a row of pixels at a time.
template <class Value>
void write_plane(const Scene &scene, const Tile &tile, float *plane, Value value) {
    constexpr int QUADS = LANES / 4;
    for (int row = 0; row < BLOCK_ROWS; ++row) {
        const int top = row * BLOCK_HEIGHT, rows = tile.height - top < BLOCK_HEIGHT ? tile.height - top : BLOCK_HEIGHT;
        for (int column = 0; column < BLOCK_COLUMNS; column += QUADS) {
            const int left = column * BLOCK_WIDTH, columns = tile.width - left < LANES ? tile.width - left : LANES;
            if (columns <= 0) break;
            Floats blocks[QUADS];
            for (int j = 0; j < QUADS; ++j) blocks[j] = value(row * BLOCK_COLUMNS + column + j);
            simd::transpose_quads(blocks);
            float *out = plane + int64_t(tile.y + top) * scene.width + tile.x + left;
            for (int j = 0; j < rows; ++j, out += scene.width) {
                if (columns == LANES) simd::store(out, blocks[j]);
                else simd::store_first(out, blocks[j], columns);
            }
        }
    }
}

template <int CHANNELS>
void write_tile(const Scene &scene, const Tile &tile, int group, const State<CHANNELS> &state, float *planes) {
    const int64_t area = int64_t(scene.width) * scene.height;
    float *const image = planes + tile.image * (scene.blended() + 1) * area;
    for (int j = 0; j < CHANNELS; ++j) {
        const int64_t channel = int64_t(group) * splat::GROUP + j;
        const Floats behind = broadcast(channel < scene.channels ? scene.background[tile.image * scene.channels + channel] : 0.0f);
        write_plane(scene, tile, image + channel * area, [&](int b) { return fma(simd::magnitude(state.light[b]), behind, state.color[j][b]); });
    }
    if (group == 0)
        write_plane(scene, tile, image + scene.blended() * area, [&](int b) { return broadcast(1.0f) - simd::magnitude(state.light[b]); });
}

template <int CHANNELS>
void blend_tile(const Scene &scene, const Forward &out, int64_t index, int group) {
    const Tile tile(scene, index);
    const int64_t begin = out.bins.tiles[index], end = out.bins.tiles[index + 1];
    State<CHANNELS> state;
    bool open[BLOCKS];
    for (int b = 0; b < BLOCKS; ++b) {
        const Floats one = broadcast(1.0f);
        for (int j = 0; j < CHANNELS; ++j) state.color[j][b] = broadcast(0.0f);
        state.light[b] = simd::select(block_at(b).inside(tile), one, simd::negative(one));
        open[b] = simd::any(simd::greater(state.light[b], broadcast(0.0f)));
    }
    alignas(64) float local[BATCH * RECORD];
    int32_t lists[BLOCKS * (BATCH + LANES)], counts[BLOCKS];
    int64_t first = begin;
    bool any = true;
    for (; first < end && any; first += BATCH) {
        const int count = int(end - first < BATCH ? end - first : BATCH);
        uint64_t masks[BATCH];
        const bool capped = load_entries<true>(scene, tile, out.records, out.bins.entries + first, count, out.bins.count - first, group, local, masks, nullptr);
        if (group == 0) std::memcpy(out.masks + first, masks, sizeof(uint64_t) * size_t(count));
        list_blocks(masks, count, lists, BATCH + LANES, counts);
        any = false;
        for (int b = 0; b < BLOCKS; ++b) {
            if (!open[b]) continue;
            if (counts[b]) {
                const auto blend = capped ? blend_block<CHANNELS, true> : blend_block<CHANNELS, false>;
                blend(block_at(b), b, local, lists + b * (BATCH + LANES), counts[b], scene.max_alpha, state);
                open[b] = simd::any(simd::greater(state.light[b], broadcast(0.0f)));
            }
            any = any || open[b];
        }
    }
    out.used[index] = int32_t((first < end ? first : end) - begin);
    write_tile<CHANNELS>(scene, tile, group, state, out.planes);
}

}  // namespace

void splat_blend(const Scene &scene, const Forward &out) {
    const int64_t tiles = scene.tiles();
    for (int group = 0; group < scene.groups(); ++group) {
        const int channels = scene.width_of(group);
#pragma omp parallel for num_threads(scene.threads) schedule(dynamic, 4)
        for (int64_t tile = 0; tile < tiles; ++tile) {
            if (channels == 1) blend_tile<1>(scene, out, tile, group);
            else if (channels == 2) blend_tile<2>(scene, out, tile, group);
            else if (channels == 3) blend_tile<3>(scene, out, tile, group);
            else blend_tile<4>(scene, out, tile, group);
        }
    }
}

}  // namespace MESHANIM_NAMESPACE
