// What blending and its derivative share: a tile's entries, the blocks of pixels they reach, and lists of them.
//
// A block is 4 pixels wide and has one pixel a lane. A tile's entries are copied to `local` records, where X and Y
// have become P and Q, the whitened coordinates of the tile's centre: at pixel (u, v) from there, p = P + A u + B v
// and q = Q + C v.
#pragma once

#include <utility>

#include "../simd.h"
#include "splat.h"

#ifdef _MSC_VER
#include <intrin.h>
#endif

namespace MESHANIM_NAMESPACE {
namespace {

using simd::Floats;
using simd::LANES;
using simd::Mask;
using simd::broadcast;
using simd::fma;
using splat::RECORD;
using splat::TILE;

constexpr int BLOCK_WIDTH = 4, BLOCK_HEIGHT = LANES / 4;
constexpr int BLOCK_COLUMNS = TILE / BLOCK_WIDTH, BLOCK_ROWS = TILE / BLOCK_HEIGHT, BLOCKS = BLOCK_COLUMNS * BLOCK_ROWS;
constexpr int FIELDS = 8;   // of a record, up to its colours
constexpr int PREFETCH = 48;   // entries ahead
constexpr int SHAPE = 5;    // P, Q, A, B, C
enum Local { P = splat::X, Q = splat::Y };

struct Tile {
    int64_t image;
    int x, y, width, height;   // its first pixel, and how much of it lies inside the image
    float centre_x, centre_y;

    Tile(const splat::Scene &scene, int64_t index) {
        const int64_t columns = scene.columns(), of_image = columns * scene.rows(), in_image = index % of_image;
        image = index / of_image;
        x = int(in_image % columns) * TILE, y = int(in_image / columns) * TILE;
        width = scene.width - x < TILE ? scene.width - x : TILE;
        height = scene.height - y < TILE ? scene.height - y : TILE;
        centre_x = float(x) + TILE / 2, centre_y = float(y) + TILE / 2;
    }
    bool whole() const { return width == TILE && height == TILE; }
};

// Positions of a block's pixels from the tile's centre, and which lie in the image.
struct Block {
    int column, row;   // of its first pixel in the tile
    Floats u, v;

    explicit Block(int index) : column(index % BLOCK_COLUMNS * BLOCK_WIDTH), row(index / BLOCK_COLUMNS * BLOCK_HEIGHT) {
        float us[LANES], vs[LANES];
        for (int l = 0; l < LANES; ++l) {
            us[l] = float(column + l % BLOCK_WIDTH) + 0.5f - TILE / 2;
            vs[l] = float(row + l / BLOCK_WIDTH) + 0.5f - TILE / 2;
        }
        u = simd::load(us), v = simd::load(vs);
    }
    Mask inside(const Tile &tile) const {
        return simd::both(simd::greater(broadcast(float(tile.width) - TILE / 2), u),
                          simd::greater(broadcast(float(tile.height) - TILE / 2), v));
    }
};

struct AllBlocks {
    Block blocks[BLOCKS];
    template <int... I> explicit AllBlocks(std::integer_sequence<int, I...>) : blocks{Block(I)...} {}
};

inline const Block &block_at(int index) {
    static const AllBlocks all{std::make_integer_sequence<int, BLOCKS>()};
    return all.blocks[index];
}

// Alphas of an entry at a block's pixels; 0 where they are less than MIN_ALPHA. CAPPED: max_alpha may act.
template <bool CAPPED>
inline Floats visible_alpha(const float *local, Floats u, Floats v, Floats max_alpha) {
    const Floats p = fma(broadcast(local[splat::A]), u, fma(broadcast(local[splat::B]), v, broadcast(local[P])));
    const Floats q = fma(broadcast(local[splat::C]), v, broadcast(local[Q]));
    const Floats level = broadcast(local[splat::LEVEL]) - q * q - p * p;
    const Floats alpha = simd::keep(simd::at_least(level, broadcast(splat::LOG2_MIN_ALPHA)), simd::exp2(level));
    return CAPPED ? simd::minimum(alpha, max_alpha) : alpha;
}

// Copies LANES records and returns the first FIELDS, a vector each.
inline void copy_records(const float *const (&rows)[LANES], float *out, Floats (&fields)[FIELDS]) {
    for (int part = 0; part < RECORD; part += LANES) {
        Floats loaded[LANES];
        for (int l = 0; l < LANES; ++l) loaded[l] = simd::load(rows[l] + part), simd::store(out + l * RECORD + part, loaded[l]);
        if (part >= FIELDS) continue;
        simd::transpose(loaded);
        for (int j = 0; j < LANES && part + j < FIELDS; ++j) fields[part + j] = loaded[j];
    }
}

// Which entry and which row of blocks a lane looks after when LANES entries are tested on all rows at once.
struct Spread {
    int32_t entry[BLOCK_ROWS][LANES];
    float top[BLOCK_ROWS][LANES];
    Spread() {
        for (int t = 0; t < BLOCK_ROWS * LANES; ++t) {
            entry[t / LANES][t % LANES] = t / BLOCK_ROWS;
            top[t / LANES][t % LANES] = float(t % BLOCK_ROWS * BLOCK_HEIGHT);
        }
    }
};

// Masks of the blocks in which an ellipse alpha >= 1 / 255 may have a pixel centre: in each row of blocks, the
// columns between the ellipse's leftmost and rightmost point there.
inline void block_masks(const Tile &tile, const Floats (&f)[FIELDS], uint64_t *masks) {
    static const Spread spread;
    const Floats zero = broadcast(0.0f), one = broadcast(1.0f), half = broadcast(0.5f);
    const Floats x = f[splat::X] - broadcast(float(tile.x)) - half, y = f[splat::Y] - broadcast(float(tile.y)) - half;
    const Floats wide = one / f[splat::A], lean = zero - f[splat::B] * wide, steep = f[splat::C] * f[splat::C];
    // A little wider than the threshold, so that rounding leaves no pixel out.
    const Floats room = fma(f[splat::LEVEL] - broadcast(splat::LOG2_MIN_ALPHA), broadcast(1.0005f), broadcast(1e-3f));
    int32_t columns[BLOCK_ROWS * LANES];
    for (int group = 0; group < BLOCK_ROWS; ++group) {
        const int32_t *entry = spread.entry[group];
        auto of = [&](Floats field) { return simd::lookup(field, entry); };
        const Floats y0 = simd::load(spread.top[group]) - of(y), y1 = y0 + broadcast(BLOCK_HEIGHT - 1.0f);
        const Floats peak = of(f[splat::PEAK]), rooms = of(room), steeps = of(steep), leans = of(lean), wides = of(wide), xs = of(x);
        const Floats high = simd::minimum(simd::maximum(peak, y0), y1), low = simd::minimum(simd::maximum(zero - peak, y0), y1);
        const Floats high_room = rooms - steeps * high * high, low_room = simd::maximum(zero, rooms - steeps * low * low);
        const Floats right = fma(leans, high, xs) + fma(wides, simd::square_root(simd::maximum(zero, high_room)), broadcast(1e-3f));
        const Floats left = fma(leans, low, xs) - fma(wides, simd::square_root(low_room), broadcast(1e-3f));
        const Floats quarter = broadcast(1.0f / BLOCK_WIDTH);
        const Floats last = simd::minimum(simd::maximum(right * quarter, zero - one), broadcast(BLOCK_COLUMNS - 1.0f));
        const Floats first = simd::minimum(simd::maximum((broadcast(BLOCK_WIDTH - 1.0f) - left) * quarter, broadcast(-1.0f * BLOCK_COLUMNS)), zero);
        const Floats bits = simd::scale_by_power(one, simd::floor(last) + one) - simd::scale_by_power(one, zero - simd::floor(first));
        simd::store_rounded(columns + group * LANES, simd::keep(simd::at_least(high_room, zero), simd::maximum(zero, bits)));
    }
    for (int l = 0; l < LANES; ++l) {
        uint64_t mask = 0;
        for (int row = 0; row < BLOCK_ROWS; ++row) mask |= uint64_t(uint32_t(columns[l * BLOCK_ROWS + row])) << (BLOCK_COLUMNS * row);
        masks[l] = mask;
    }
}

// Copies a tile's entries to local records, the colours of `group` among them. Finds their masks, or keeps their
// shapes by vectors, SHAPE of them for LANES entries. All have room for a multiple of LANES. `ahead`: entries there
// are from the first on, other tiles' included. Returns whether max_alpha may act on one.
template <bool MASKS>
inline bool load_entries(const splat::Scene &scene, const Tile &tile, const float *records, const splat::Entry *entries,
                         int64_t count, int64_t ahead, int group, float *local, uint64_t *masks, float *shapes) {
    const int64_t frame = tile.image / scene.cameras, base = tile.image * scene.gaussians;
    Floats highest = broadcast(scene.safe_level);
    for (int64_t first = 0; first < count; first += LANES) {
        const float *rows[LANES];
        for (int l = 0; l < LANES; ++l) {
            const int64_t index = first + l < count ? first + l : count - 1;
            rows[l] = records + int64_t(entries[index].item) * RECORD;
#ifdef __GNUC__
            const int64_t next = first + l + PREFETCH < ahead ? first + l + PREFETCH : index;
            __builtin_prefetch(records + int64_t(entries[next].item) * RECORD);
#endif
        }
        float *const out = local + first * RECORD;
        Floats fields[FIELDS];
        copy_records(rows, out, fields);
        highest = simd::maximum(highest, fields[splat::LEVEL]);
        if (MASKS) block_masks(tile, fields, masks + first);
        const Floats dx = broadcast(tile.centre_x) - fields[splat::X], dy = broadcast(tile.centre_y) - fields[splat::Y];
        fields[P] = fma(fields[splat::A], dx, fields[splat::B] * dy), fields[Q] = fields[splat::C] * dy;
        if (!MASKS)
            for (int j = 0; j < SHAPE; ++j) simd::store(shapes + first * SHAPE + j * LANES, fields[j]);
        float p[LANES], q[LANES];
        simd::store(p, fields[P]), simd::store(q, fields[Q]);
        for (int l = 0; l < LANES; ++l) out[l * RECORD + P] = p[l], out[l * RECORD + Q] = q[l];
        if (group == 0) continue;
        for (int l = 0; l < LANES; ++l) {
            const int64_t index = first + l < count ? first + l : count - 1;
            const int64_t gaussian = int64_t(entries[index].item) - base;
            const float *colors = scene.colors.data + frame * scene.colors.frame + gaussian * scene.channels;
            for (int j = 0; j < scene.width_of(group); ++j) {
                const int64_t channel = int64_t(group) * splat::GROUP + j;
                out[l * RECORD + splat::COLOR + j] = channel < scene.channels ? colors[channel] : out[l * RECORD + splat::DEPTH];
            }
        }
    }
    return simd::any(simd::greater(highest, broadcast(scene.safe_level)));
}

inline int lowest_bit(uint64_t bits) {
#ifdef _MSC_VER
    unsigned long index;
    _BitScanForward64(&index, bits);
    return int(index);
#else
    return __builtin_ctzll(bits);
#endif
}

// Where in `local` the entries are that reach each block, near to far: lists[block * stride + 0 .. counts[block]).
// `masks` is read, and lists are written, up to LANES beyond their ends.
inline void list_blocks(const uint64_t *masks, int count, int32_t *lists, int64_t stride, int32_t (&counts)[BLOCKS]) {
    for (int b = 0; b < BLOCKS; ++b) counts[b] = 0;
#if defined(__AVX512F__)
    const __m512i iota = _mm512_mullo_epi32(_mm512_set1_epi32(RECORD), _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15));
    for (int i = 0; i < count; i += LANES) {
        const __m256i low = _mm512_cvtepi64_epi32(_mm512_loadu_si512(masks + i)), high = _mm512_cvtepi64_epi32(_mm512_loadu_si512(masks + i + 8));
        const __m512i mask = _mm512_inserti64x4(_mm512_castsi256_si512(low), high, 1);
        const __m512i place = _mm512_add_epi32(iota, _mm512_set1_epi32(i * RECORD));
        const __mmask16 valid = simd::first_lanes(count - i < LANES ? count - i : LANES);
        for (int b = 0; b < BLOCKS; ++b) {
            const __mmask16 here = _mm512_mask_test_epi32_mask(valid, mask, _mm512_set1_epi32(1 << b));
            _mm512_storeu_si512(lists + b * stride + counts[b], _mm512_maskz_compress_epi32(here, place));
            counts[b] += __builtin_popcount(here);
        }
    }
#else
    for (int i = 0; i < count; ++i)
        for (uint64_t mask = masks[i]; mask; mask &= mask - 1) {
            const int b = lowest_bit(mask);
            lists[b * stride + counts[b]++] = i * RECORD;
        }
#endif
}

}  // namespace
}  // namespace MESHANIM_NAMESPACE
