// The derivative of blending, a tile at a time and in it a block at a time, in two passes over the block's list:
//   near to far: alphas and weights again, kept;
//   far to near: with B the colour behind (dotted with the image gradient g), d L / d ln alpha = weight (g.c - B) and
//     B <- B + alpha (g.c - B), without the division by 1 - alpha that a pass the other way would need. Sums over the
//     block's pixels: quads of them are spread against vectors of LANES / 4 quantities each, so that no lanes are
//     summed until the tile is done.
#include <cstring>

#include "isa.h"
#include "splat.h"
#include "tile.h"

namespace MESHANIM_NAMESPACE {
namespace {

using splat::Backward;
using splat::ImageGradient;
using splat::MOMENTS;
using splat::Scene;

constexpr int QUADS = LANES / 4;
constexpr int MOMENT_VECTORS = (MOMENTS + QUADS - 1) / QUADS;
template <int CHANNELS> constexpr int VECTORS = MOMENT_VECTORS + (CHANNELS + QUADS - 1) / QUADS;

// A thread's memory for a tile of up to `entries` entries.
struct Scratch {
    float *local, *shapes, *pairs, *sums;
    int32_t *lists;
    int64_t stride;

    static int64_t floats(int64_t entries) {
        return (entries + ROOM) * (RECORD + SHAPE + 2 * PIXELS + VECTORS<splat::GROUP> * LANES + BLOCKS);
    }
    Scratch(float *memory, int64_t entries) : stride(entries + ROOM) {
        local = memory;
        shapes = local + stride * RECORD;
        pairs = shapes + stride * SHAPE;
        sums = pairs + stride * 2 * PIXELS;
        lists = reinterpret_cast<int32_t *>(sums + stride * VECTORS<splat::GROUP> * LANES);
    }
};

// Gradients of an image at the pixels of a tile's blocks; zero outside the image.
class PixelGradient {
   public:
    PixelGradient(const ImageGradient &gradient, const Tile &tile) : gradient_(gradient), tile_(tile) {
        for (int i = 0; i < PIXELS; ++i) offsets_[i] = int32_t(i / BLOCK * gradient.y + i % BLOCK * gradient.x);
        corner_ = gradient.data ? gradient.data + tile.image * gradient.image + tile.y * gradient.y + tile.x * gradient.x : nullptr;
    }
    Floats at(const Block &block, int part, int64_t channel) const {
        if (!corner_) return broadcast(0.0f);
        const float *corner = corner_of(block) + channel * gradient_.channel;
        const int32_t *offsets = offsets_ + part * LANES;
        if (whole(block)) return gradient_.x == 1 ? simd::load_quads(corner + offsets[0], gradient_.y) : simd::gather(corner, offsets);
        float lanes[LANES] = {};
        for (int l = 0; l < LANES; ++l) {
            const int i = part * LANES + l;
            if (block.row + i / BLOCK < tile_.height && block.column + i % BLOCK < tile_.width) lanes[l] = corner[offsets[l]];
        }
        return simd::load(lanes);
    }

    // Whether the first three channels lie together, and `three` may read them.
    bool together(const Block &block) const { return corner_ && gradient_.x == 3 && gradient_.channel == 1 && whole(block); }
    void three(const Block &block, int part, Floats (&channels)[3]) const {
        const float *row = corner_of(block) + offsets_[part * LANES];
        simd::columns_of_quads(simd::load_quads(row, gradient_.y), simd::load_quads(row + 4, gradient_.y),
                               simd::load_quads(row + 8, gradient_.y), channels);
    }

   private:
    bool whole(const Block &block) const { return block.row + BLOCK <= tile_.height && block.column + BLOCK <= tile_.width; }
    const float *corner_of(const Block &block) const { return corner_ + block.row * gradient_.y + block.column * gradient_.x; }

    const ImageGradient &gradient_;
    const Tile &tile_;
    const float *corner_;
    int32_t offsets_[PIXELS];
};

// The polynomials in (u, v) that the moments are sums of: weights[block][vector][row of the block] for its four pixels.
struct Basis {
    float weights[BLOCKS][MOMENT_VECTORS][BLOCK][LANES];
    Basis() {
        for (int b = 0; b < BLOCKS; ++b)
            for (int m = 0; m < MOMENT_VECTORS; ++m)
                for (int row = 0; row < BLOCK; ++row)
                    for (int l = 0; l < LANES; ++l) {
                        const float u = float(b % BLOCK_COLUMNS * BLOCK + l % BLOCK) + 0.5f - TILE / 2;
                        const float v = float(b / BLOCK_COLUMNS * BLOCK + row) + 0.5f - TILE / 2;
                        const float values[MOMENTS] = {1, u, v, u * u, u * v, v * v};
                        const int quantity = m * QUADS + l / BLOCK;
                        weights[b][m][row][l] = quantity < MOMENTS ? values[quantity] : 0;
                    }
    }
};

template <int CHANNELS>
class TileGradient {
   public:
    TileGradient(const Scene &scene, const Backward &in, int64_t index, float *memory)
        : scene_(scene), in_(in), index_(index), tile_(scene, index), begin_(in.bins.tiles[index]),
          count_(in.used[index]), scratch_(memory, count_),
          rgb_(in.rgb, tile_), alpha_(in.alpha, tile_), depths_(in.depths, tile_) {}

    void run() {
        const int64_t total = in_.bins.tiles[index_ + 1] - begin_;
        for (int64_t i = count_; i < total; ++i) std::memset(slot(i), 0, WIDTH * sizeof(float));
        Floats through[CHANNELS];   // light that reaches the background
        for (int j = 0; j < CHANNELS; ++j) through[j] = broadcast(0.0f);
        const bool capped = load_entries<false>(scene_, tile_, in_.records, in_.bins.entries + begin_, count_, in_.bins.count - begin_, in_.group, scratch_.local, nullptr,
                            scratch_.shapes);
        std::memset(scratch_.sums, 0, sizeof(float) * size_t(count_ * VECTORS<CHANNELS> * LANES));
        int32_t counts[BLOCKS];
        list_blocks(in_.masks + begin_, int(count_), scratch_.lists, scratch_.stride, counts);
        for (int b = 0; b < BLOCKS; ++b) capped ? block<true>(b, counts[b], through) : block<false>(b, counts[b], through);
        for (int64_t first = 0; first < count_; first += LANES) finish(first);
        for (int j = 0; j < CHANNELS; ++j) {
            const int64_t channel = int64_t(in_.group) * splat::GROUP + j;
            if (in_.background && channel < scene_.channels)
                in_.background[index_ * scene_.channels + channel] = simd::sum(through[j]);
        }
    }

   private:
    static constexpr int WIDTH = MOMENTS + CHANNELS, COLOR_VECTORS = VECTORS<CHANNELS> - MOMENT_VECTORS;

    float *slot(int64_t i) const { return in_.slots + int64_t(in_.bins.entries[begin_ + i].slot) * WIDTH; }

    template <bool CAPPED>
    void block(int index, int count, Floats (&through)[CHANNELS]) {
        const Block &block = block_at(index);
        if (block.row >= tile_.height || block.column >= tile_.width || (count == 0 && !in_.background)) return;
        Floats gradient[CHANNELS][PARTS], behind[PARTS], light[PARTS];
        const bool three = CHANNELS >= 3 && in_.group == 0 && rgb_.together(block);
        for (int part = 0; part < PARTS; ++part) {
            Floats rgb[3];
            if (three) rgb_.three(block, part, rgb);
            behind[part] = in_.group == 0 ? broadcast(0.0f) - alpha_.at(block, part, 0) : broadcast(0.0f);
            for (int j = 0; j < CHANNELS; ++j) {
                const int64_t channel = int64_t(in_.group) * splat::GROUP + j;
                const bool color = channel < scene_.channels;
                gradient[j][part] = three && j < 3 ? rgb[j] : color ? rgb_.at(block, part, channel) : depths_.at(block, part, 0);
                if (color) behind[part] = fma(gradient[j][part], broadcast(scene_.background[tile_.image * scene_.channels + channel]), behind[part]);
            }
        }
        const int32_t *list = scratch_.lists + index * scratch_.stride;
        near_to_far<CAPPED>(block, list, count, light);
        for (int j = 0; j < CHANNELS; ++j)
            for (int part = 0; part < PARTS; ++part) through[j] = fma(gradient[j][part], light[part], through[j]);
        far_to_near<CAPPED>(index, list, count, gradient, behind);
    }

    // Keeps (alpha, weight) of each pair, zero where nothing was blended; cuts the list where no pixel takes more.
    // light: what is left of it.
    template <bool CAPPED>
    void near_to_far(const Block &block, const int32_t *list, int &count, Floats (&light)[PARTS]) {
        const Floats most = broadcast(scene_.max_alpha), end = broadcast(splat::MIN_LIGHT), one = broadcast(1.0f);
        Floats u[PARTS], v[PARTS];
        for (int part = 0; part < PARTS; ++part) {
            u[part] = block.u[part], v[part] = block.v[part];
            light[part] = simd::select(block.inside(tile_, part), one, simd::negative(one));
        }
        const float *const local = scratch_.local;
        float *pair = scratch_.pairs;
        for (int i = 0; i < count; ++i, pair += 2 * PIXELS) {
            Floats alpha[PARTS];
            visible_alphas<CAPPED>(local + list[i], u, v, most, alpha);
            for (int part = 0; part < PARTS; ++part) {
                const Floats left = simd::fnma(light[part], alpha[part], light[part]);
                const Mask taken = simd::greater(left, end);
                simd::store(pair + part * LANES, simd::keep(taken, alpha[part]));
                simd::store(pair + PIXELS + part * LANES, simd::keep(taken, alpha[part] * light[part]));
                light[part] = simd::select(taken, left, simd::negative(light[part]));
            }
            if (i % 16 != 15) continue;
            bool open = false;
            for (const Floats &part : light) open = open || simd::any(simd::greater(part, broadcast(0.0f)));
            if (!open) count = i + 1;
        }
        for (Floats &part : light) part = simd::magnitude(part);
    }

    // d L / d ln alpha of every pixel, zero where max_alpha acts, and at once its sums and those of the colours.
    template <bool CAPPED>
    void far_to_near(int index, const int32_t *list, int count, const Floats (&gradient)[CHANNELS][PARTS], Floats (&behind)[PARTS]) {
        static const Basis basis;
        Floats shape[MOMENT_VECTORS][BLOCK], paint[COLOR_VECTORS][BLOCK];
        for (int m = 0; m < MOMENT_VECTORS; ++m)
            for (int row = 0; row < BLOCK; ++row) shape[m][row] = simd::load(basis.weights[index][m][row]);
        for (int m = 0; m < COLOR_VECTORS; ++m)
            for (int part = 0; part < PARTS; ++part) {
                Floats quads[QUADS];
                for (int j = 0; j < QUADS; ++j) quads[j] = m * QUADS + j < CHANNELS ? gradient[m * QUADS + j][part] : broadcast(0.0f);
                simd::transpose_quads(quads);
                for (int j = 0; j < QUADS; ++j) paint[m][part * QUADS + j] = quads[j];
            }
        const Floats most = broadcast(scene_.max_alpha);
        const float *const local = scratch_.local, *pair = scratch_.pairs + int64_t(count) * 2 * PIXELS;
        float *const all_sums = scratch_.sums;
        for (int i = count - 1; i >= 0; --i) {
            const float *const e = local + list[i];
            pair -= 2 * PIXELS;
            Floats change[BLOCK], weights[BLOCK];
            for (int part = 0; part < PARTS; ++part) {
                Floats color = broadcast(e[splat::COLOR]) * gradient[0][part];
                for (int j = 1; j < CHANNELS; ++j) color = fma(broadcast(e[splat::COLOR + j]), gradient[j][part], color);
                const Floats alpha = simd::load(pair + part * LANES), weight = simd::load(pair + PIXELS + part * LANES);
                const Floats rise = color - behind[part];
                behind[part] = fma(alpha, rise, behind[part]);
                Floats quads[QUADS];
                simd::spread_quads(CAPPED ? simd::keep(simd::greater(most, alpha), weight * rise) : weight * rise, quads);
                for (int j = 0; j < QUADS; ++j) change[part * QUADS + j] = quads[j];
            }
            for (int row = 0; row < BLOCK; ++row) weights[row] = simd::load_quad(pair + PIXELS + BLOCK * row);
            float *const sums = all_sums + uint32_t(list[i]) / RECORD * (VECTORS<CHANNELS> * LANES);
            for (int m = 0; m < MOMENT_VECTORS; ++m) {
                Floats sum = simd::load(sums + m * LANES);
                for (int row = 0; row < BLOCK; ++row) sum = fma(change[row], shape[m][row], sum);
                simd::store(sums + m * LANES, sum);
            }
            for (int m = 0; m < COLOR_VECTORS; ++m) {
                Floats sum = simd::load(sums + (MOMENT_VECTORS + m) * LANES);
                for (int row = 0; row < BLOCK; ++row) sum = fma(weights[row], paint[m][row], sum);
                simd::store(sums + (MOMENT_VECTORS + m) * LANES, sum);
            }
        }
    }

    // Moments of LANES entries about the tile's centre become moments of (p, q); writes them to their slots. What is
    // read beyond the last entry goes nowhere.
    void finish(int64_t first) {
        const int count = int(count_ - first < LANES ? count_ - first : LANES);
#ifdef __GNUC__
        for (int64_t i = first + LANES; i < first + 2 * LANES && i < count_; ++i) {
            __builtin_prefetch(slot(i), 1);
            __builtin_prefetch(slot(i) + WIDTH - 1, 1);
        }
#endif
        Floats m[MOMENT_VECTORS * QUADS], values[WIDTH];
        auto quantities = [&](int vector, Floats *out) {
            Floats rows[LANES], sums[QUADS];
            for (int l = 0; l < LANES; ++l) rows[l] = simd::load(scratch_.sums + (first + l) * (VECTORS<CHANNELS> * LANES) + vector * LANES);
            simd::quad_sums(rows, sums);
            for (int j = 0; j < QUADS; ++j) out[j] = sums[j];
        };
        for (int k = 0; k < MOMENT_VECTORS; ++k) quantities(k, m + k * QUADS);
        Floats colors[(VECTORS<CHANNELS> - MOMENT_VECTORS) * QUADS];
        for (int k = MOMENT_VECTORS; k < VECTORS<CHANNELS>; ++k) quantities(k, colors + (k - MOMENT_VECTORS) * QUADS);
        const float *shape = scratch_.shapes + first * SHAPE;
        const Floats p = simd::load(shape), q = simd::load(shape + LANES), a = simd::load(shape + 2 * LANES);
        const Floats b = simd::load(shape + 3 * LANES), c = simd::load(shape + 4 * LANES), two = broadcast(2.0f);
        const Floats across = fma(a, m[1], b * m[2]);                         // sum of a u + b v
        const Floats mixed = fma(a, m[4], b * m[5]);                          // of (a u + b v) v
        const Floats square = fma(a, fma(a, m[3], two * b * m[4]), b * b * m[5]);
        values[0] = m[0];
        values[1] = fma(p, m[0], across);
        values[2] = fma(q, m[0], c * m[2]);
        values[3] = fma(p, fma(p, m[0], two * across), square);
        values[4] = fma(q, values[1], c * fma(p, m[2], mixed));
        values[5] = fma(q, fma(q, m[0], two * c * m[2]), c * c * m[5]);
        for (int j = 0; j < CHANNELS; ++j) values[MOMENTS + j] = colors[j];
        for (int part = 0; part < WIDTH; part += LANES) {
            Floats columns[LANES];
            for (int j = 0; j < LANES; ++j) columns[j] = part + j < WIDTH ? values[part + j] : broadcast(0.0f);
            simd::transpose(columns);
            const int width = WIDTH - part < LANES ? WIDTH - part : LANES;
            for (int l = 0; l < count; ++l) simd::store_first(slot(first + l) + part, columns[l], width);
        }
    }

    const Scene &scene_;
    const Backward &in_;
    int64_t index_;
    Tile tile_;
    int64_t begin_, count_;
    Scratch scratch_;
    PixelGradient rgb_, alpha_, depths_;
};

}  // namespace

// Floats that a thread needs for tiles of so many entries.
int64_t splat_scratch(int64_t entries) { return Scratch::floats(entries); }

void splat_blend_backward(const Scene &scene, const team::Member &member, const Backward &in) {
    float *const memory = in.scratch + member.rank * in.scratch_floats;
    team::take(member, scene.tiles(), 4, [&](int64_t tile) {
        if (in.channels == 1) TileGradient<1>(scene, in, tile, memory).run();
        else if (in.channels == 2) TileGradient<2>(scene, in, tile, memory).run();
        else if (in.channels == 3) TileGradient<3>(scene, in, tile, memory).run();
        else TileGradient<4>(scene, in, tile, memory).run();
    });
}

}  // namespace MESHANIM_NAMESPACE
