// What blending and its derivative share: a tile's entries, the blocks of pixels they reach, and lists of them.
//
// A block is 4 x 4 pixels, row by row in PARTS vectors. A tile's entries are copied to `local` records, where X and Y
// have become P and Q, the whitened coordinates of the tile's centre: at pixel (u, v) from there, p = P + A u + B v
// and q = Q + C v.
#pragma once

#include <utility>

#include "../simd.h"
#include "splat.h"

namespace MESHANIM_NAMESPACE {
namespace {

using simd::Floats;
using simd::LANES;
using simd::Mask;
using simd::broadcast;
using simd::fma;
using splat::BLOCK;
using splat::BLOCK_COLUMNS;
using splat::BLOCKS;
using splat::RECORD;
using splat::TILE;

constexpr int PIXELS = BLOCK * BLOCK, PARTS = PIXELS / LANES;
constexpr int FIELDS = 8;   // of a record, up to its colours
constexpr int PREFETCH = 48;   // entries ahead
constexpr int ROOM = 16;       // entries beyond the end of a list or of masks
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
};

// Positions of a block's pixels from the tile's centre, and which lie in the image.
struct Block {
    int column, row;   // of its first pixel in the tile
    Floats u[PARTS], v[PARTS];

    explicit Block(int index) : column(index % BLOCK_COLUMNS * BLOCK), row(index / BLOCK_COLUMNS * BLOCK) {
        float us[PIXELS], vs[PIXELS];
        for (int i = 0; i < PIXELS; ++i) {
            us[i] = float(column + i % BLOCK) + 0.5f - TILE / 2;
            vs[i] = float(row + i / BLOCK) + 0.5f - TILE / 2;
        }
        for (int part = 0; part < PARTS; ++part) u[part] = simd::load(us + part * LANES), v[part] = simd::load(vs + part * LANES);
    }
    Mask inside(const Tile &tile, int part) const {
        return simd::both(simd::greater(broadcast(float(tile.width) - TILE / 2), u[part]),
                          simd::greater(broadcast(float(tile.height) - TILE / 2), v[part]));
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
inline void visible_alphas(const float *local, const Floats (&u)[PARTS], const Floats (&v)[PARTS], Floats max_alpha, Floats (&alpha)[PARTS]) {
    const Floats a = broadcast(local[splat::A]), b = broadcast(local[splat::B]), c = broadcast(local[splat::C]);
    const Floats p0 = broadcast(local[P]), q0 = broadcast(local[Q]), peak = broadcast(local[splat::LEVEL]);
    for (int part = 0; part < PARTS; ++part) {
        const Floats p = fma(a, u[part], fma(b, v[part], p0)), q = fma(c, v[part], q0), level = peak - q * q - p * p;
        alpha[part] = simd::keep(simd::at_least(level, broadcast(splat::LOG2_MIN_ALPHA)), simd::exp2(level));
        if (CAPPED) alpha[part] = simd::minimum(alpha[part], max_alpha);
    }
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

// Masks of the blocks in which an ellipse alpha >= 1 / 255 may have a pixel centre: in each row of blocks, the
// columns between the ellipse's leftmost and rightmost point there.
inline void block_masks(const Tile &tile, const Floats (&f)[FIELDS], uint16_t *masks) {
    const Floats zero = broadcast(0.0f), one = broadcast(1.0f), half = broadcast(0.5f);
    const Floats x = f[splat::X] - broadcast(float(tile.x)) - half, y = f[splat::Y] - broadcast(float(tile.y)) - half;
    const Floats wide = one / f[splat::A], lean = zero - f[splat::B] * wide, steep = f[splat::C] * f[splat::C];
    const Floats peak = f[splat::PEAK], trough = zero - peak;
    // A little wider than the threshold, so that rounding leaves no pixel out.
    const Floats room = fma(f[splat::LEVEL] - broadcast(splat::LOG2_MIN_ALPHA), broadcast(1.0005f), broadcast(1e-3f));
    const Floats right_edge = x + broadcast(1e-3f), left_edge = broadcast(BLOCK - 1.0f) - x + broadcast(1e-3f);
    Floats mask = zero;
    for (int row = BLOCKS / BLOCK_COLUMNS - 1; row >= 0; --row) {
        const Floats y0 = broadcast(float(row * BLOCK)) - y, y1 = y0 + broadcast(BLOCK - 1.0f);
        const Floats high = simd::minimum(simd::maximum(peak, y0), y1), low = simd::minimum(simd::maximum(trough, y0), y1);
        const Floats high_room = room - steep * high * high, low_room = simd::maximum(zero, room - steep * low * low);
        const Floats right = fma(wide, simd::square_root(simd::maximum(zero, high_room)), fma(lean, high, right_edge));
        const Floats left = fma(wide, simd::square_root(low_room), left_edge - lean * low);
        const Floats quarter = broadcast(1.0f / BLOCK);
        const Floats last = simd::minimum(simd::maximum(right * quarter, zero - one), broadcast(BLOCK_COLUMNS - 1.0f));
        const Floats first = simd::minimum(simd::maximum(left * quarter, broadcast(-1.0f * BLOCK_COLUMNS)), zero);
        const Floats bits = simd::power_of_two(simd::floor(last) + one) - simd::power_of_two(zero - simd::floor(first));
        mask = fma(mask, broadcast(16.0f), simd::keep(simd::at_least(high_room, zero), simd::maximum(zero, bits)));
    }
    int32_t whole[LANES];
    simd::store_rounded(whole, mask);
    for (int l = 0; l < LANES; ++l) masks[l] = uint16_t(whole[l]);
}

// Copies a tile's entries to local records, the colours of `group` among them. Finds their masks, or keeps their
// shapes by vectors, SHAPE of them for LANES entries. All have room for a multiple of LANES. `ahead`: entries there
// are from the first on, other tiles' included. Returns whether max_alpha may act on one.
template <bool MASKS>
inline bool load_entries(const splat::Scene &scene, const Tile &tile, const float *records, const splat::Entry *entries,
                         int64_t count, int64_t ahead, int group, float *local, uint16_t *masks, float *shapes) {
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

#if defined(__AVX2__) && !defined(__AVX512F__)
// Where in `local` those of eight entries are whose bits are set, one after the other.
struct Packed {
    uint8_t offsets[256][8] = {};
    Packed() {
        for (int bits = 0; bits < 256; ++bits)
            for (int i = 0, next = 0; i < 8; ++i)
                if (bits >> i & 1) offsets[bits][next++] = uint8_t(i * RECORD);
    }
};
#endif

// Where in `local` the entries are that reach each block, near to far: lists[block * stride + 0 .. counts[block]).
// `masks` is read, and lists are written, up to ROOM beyond their ends.
inline void list_blocks(const uint16_t *masks, int count, int32_t *lists, int64_t stride, int32_t (&counts)[BLOCKS]) {
    for (int b = 0; b < BLOCKS; ++b) counts[b] = 0;
#if defined(__AVX512F__)
    const __m512i iota = _mm512_mullo_epi32(_mm512_set1_epi32(RECORD), _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15));
    for (int i = 0; i < count; i += 16) {
        const __m512i mask = _mm512_cvtepu16_epi32(_mm256_loadu_si256(reinterpret_cast<const __m256i *>(masks + i)));
        const __m512i place = _mm512_add_epi32(iota, _mm512_set1_epi32(i * RECORD));
        const __mmask16 valid = simd::first_lanes(count - i < 16 ? count - i : 16);
        for (int b = 0; b < BLOCKS; ++b) {
            const __mmask16 here = _mm512_mask_test_epi32_mask(valid, mask, _mm512_set1_epi32(1 << b));
            _mm512_storeu_si512(lists + b * stride + counts[b], _mm512_maskz_compress_epi32(here, place));
            counts[b] += __builtin_popcount(here);
        }
    }
#elif defined(__AVX2__)
    static const Packed packed;
    for (int i = 0; i < count; i += 16) {
        // Bytes of 16 masks, blocks 0 to 7 and 8 to 15: a block's bit is moved to the top of each byte and collected.
        const __m256i both = _mm256_loadu_si256(reinterpret_cast<const __m256i *>(masks + i));
        const __m256i low = _mm256_and_si256(both, _mm256_set1_epi16(0xff)), high = _mm256_srli_epi16(both, 8);
        const __m256i bytes = _mm256_permute4x64_epi64(_mm256_packus_epi16(low, high), 0xd8);   // low of 16, high of 16
        const uint32_t valid = (1u << (count - i < 16 ? count - i : 16)) - 1;
        const __m256i near = _mm256_set1_epi32(i * RECORD), far = _mm256_set1_epi32((i + 8) * RECORD);
        __m256i shifted = bytes;
        for (int b = BLOCKS / 2 - 1; b >= 0; --b) {
            const uint32_t here = uint32_t(_mm256_movemask_epi8(shifted));
            shifted = _mm256_add_epi8(shifted, shifted);
            for (int half = 0; half < 2; ++half) {
                const uint32_t bits = here >> (16 * half) & valid, first = bits & 0xff, rest = bits >> 8;
                int32_t &length = counts[b + half * BLOCKS / 2];
                int32_t *list = lists + (b + half * BLOCKS / 2) * stride + length;
                auto write = [&](uint32_t some, __m256i place) {
                    const __m256i offsets = _mm256_cvtepu8_epi32(_mm_loadl_epi64(reinterpret_cast<const __m128i *>(packed.offsets[some])));
                    _mm256_storeu_si256(reinterpret_cast<__m256i *>(list), _mm256_add_epi32(offsets, place));
                };
                const int of_first = __builtin_popcount(first);
                write(first, near);
                list += of_first;
                write(rest, far);
                length += of_first + __builtin_popcount(rest);
            }
        }
    }
#else
    for (int i = 0; i < count; ++i)
        for (int b = 0; b < BLOCKS; ++b) {
            lists[b * stride + counts[b]] = i * RECORD;
            counts[b] += masks[i] >> b & 1;
        }
#endif
}

}  // namespace
}  // namespace MESHANIM_NAMESPACE
