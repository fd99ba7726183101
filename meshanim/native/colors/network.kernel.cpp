// The colour network and its gradients, a tile of rows at a time with everything between the layers in the cache.
//
// All matrix products are one register-blocked loop; weights are copied once a call into rows that are whole vectors.
// The backward pass computes the hidden layers again. Gradients of the weights are summed a chunk of rows, and the
// chunks' sums in their order, so results do not depend on threads.
#include <algorithm>
#include <cstring>

#ifdef _OPENMP
#include <omp.h>
#endif

#include "colors/colors.h"
#include "simd.h"

namespace MESHANIM_NAMESPACE {
namespace {

using namespace simd;

constexpr int64_t TILE = COLOR_TILE, CHUNK = COLOR_CHUNK;
constexpr int BLOCK = LANES == 16 ? 8 : 4;  // rows whose sums are in registers at once, two vectors each

int64_t whole(int64_t count, int64_t step) { return (count + step - 1) / step * step; }

int thread_number() {
#ifdef _OPENMP
    return omp_get_thread_num();
#else
    return 0;
#endif
}

// Entry (row, depth) lies at data[row * row_step + depth * depth_step].
struct Left {
    const float *data;
    int64_t row_step, depth_step;
};
struct Right {
    const float *data;  // (depth, step)
    int64_t step;
};
struct Product {
    float *data;  // (rows, step); `columns` of them are computed, whole vectors
    int64_t step, rows, depth, columns;
};

// What becomes of a sum before it is stored.
struct Plain {
    Floats operator()(Floats sum, int64_t) const { return sum; }
};
struct Rectify {  // NaN stays
    Floats operator()(Floats sum, int64_t) const { return maximum(zeros(), sum); }
};
struct Gate {  // the derivative of Rectify, whose results `open` holds at the same places
    const float *open;
    Floats operator()(Floats sum, int64_t at) const { return keep(greater(load(open + at), zeros()), sum); }
};

// `from` has a row of starting values, `from_step` floats from one row to the next; null for zeros.
template <int ROWS, int VECTORS, class Finish>
inline void block(const Left &a, const Right &b, const Product &c, const float *from, int64_t from_step, int64_t row,
                  int64_t column, Finish finish) {
    Floats sum[ROWS][VECTORS];
    for (int r = 0; r < ROWS; ++r)
        for (int v = 0; v < VECTORS; ++v)
            sum[r][v] = from ? load(from + (row + r) * from_step + column + v * LANES) : zeros();
    const float *left = a.data + row * a.row_step, *right = b.data + column;
    for (int64_t k = 0; k < c.depth; ++k, left += a.depth_step, right += b.step) {
        Floats each[VECTORS];
        for (int v = 0; v < VECTORS; ++v) each[v] = load(right + v * LANES);
        for (int r = 0; r < ROWS; ++r) {
            const Floats factor = broadcast(left[r * a.row_step]);
            for (int v = 0; v < VECTORS; ++v) sum[r][v] = fma(factor, each[v], sum[r][v]);
        }
    }
    for (int r = 0; r < ROWS; ++r)
        for (int v = 0; v < VECTORS; ++v) {
            const int64_t at = (row + r) * c.step + column + v * LANES;
            store(c.data + at, finish(sum[r][v], at));
        }
}

template <int VECTORS, class Finish>
inline void columns(const Left &a, const Right &b, const Product &c, const float *from, int64_t from_step, int64_t column,
                    Finish finish) {
    int64_t row = 0;
    for (; row + BLOCK <= c.rows; row += BLOCK) block<BLOCK, VECTORS>(a, b, c, from, from_step, row, column, finish);
    for (; row < c.rows; ++row) block<1, VECTORS>(a, b, c, from, from_step, row, column, finish);
}

template <class Finish>
inline void multiply(const Left &a, const Right &b, const Product &c, const float *from, int64_t from_step, Finish finish) {
    int64_t column = 0;
    for (; column + 2 * LANES <= c.columns; column += 2 * LANES) columns<2>(a, b, c, from, from_step, column, finish);
    if (column < c.columns) columns<1>(a, b, c, from, from_step, column, finish);
}

// Hands out a buffer piece by piece.
struct Room {
    float *at;
    float *take(int64_t count) {
        float *const taken = at;
        at += count;
        return taken;
    }
};

// (rows, columns) into rows of `step`, the rest zeros.
float *padded(Room &room, const float *from, int64_t rows, int64_t columns, int64_t step) {
    float *const to = room.take(rows * step);
    std::fill(to, to + rows * step, 0.0f);
    for (int64_t row = 0; row < rows; ++row) std::copy_n(from + row * columns, columns, to + row * step);
    return to;
}

float *transposed(Room &room, const float *from, int64_t rows, int64_t columns, int64_t step) {
    float *const to = room.take(columns * step);
    std::fill(to, to + columns * step, 0.0f);
    for (int64_t row = 0; row < rows; ++row)
        for (int64_t column = 0; column < columns; ++column) to[column * step + row] = from[row * columns + column];
    return to;
}

struct Weights {
    ColorSizes sizes;
    int64_t hidden, latent, out;  // lengths of rows, whole vectors
    const float *frame, *by_latent, *inner, *inner_bias, *outer;
    const float *from_latent, *from_inner, *from_outer;  // transposed, for the way back

    Weights(const ColorNetwork &n, Room &room) : sizes(n.sizes) {
        const int64_t h = sizes.hidden;
        hidden = whole(h, 2 * LANES), latent = whole(sizes.latent, LANES), out = whole(3, LANES);
        frame = padded(room, n.frame, sizes.frames, h, hidden);
        by_latent = padded(room, n.by_latent, sizes.latent, h, hidden);
        inner = padded(room, n.inner, h, h, hidden);
        inner_bias = padded(room, n.inner_bias, 1, h, hidden);
        outer = padded(room, n.outer, h, 3, out);
        from_latent = transposed(room, n.by_latent, sizes.latent, h, latent);
        from_inner = transposed(room, n.inner, h, h, hidden);
        from_outer = transposed(room, n.outer, h, 3, hidden);
    }
};

struct Tile {
    float *latents, *first, *second, *colors, *to_latents, *to_first, *to_second, *to_colors;

    Tile(const Weights &w, float *memory) {
        Room room{memory};
        latents = room.take(TILE * w.latent), to_latents = room.take(TILE * w.latent);
        first = room.take(TILE * w.hidden), second = room.take(TILE * w.hidden);
        to_first = room.take(TILE * w.hidden), to_second = room.take(TILE * w.hidden);
        colors = room.take(TILE * w.out), to_colors = room.take(TILE * w.out);
        std::fill(latents, latents + TILE * w.latent, 0.0f);
        std::fill(to_colors, to_colors + TILE * w.out, 0.0f);
    }

    static int64_t floats(const Weights &w) { return TILE * (2 * w.latent + 4 * w.hidden + 2 * w.out); }

    void read(const ColorNetwork &n, const Weights &w, int64_t begin, int64_t count) {
        unpack(n.latents + begin * n.sizes.latent, count, n.sizes.latent, latents, w.latent);
    }

    void read_gradients(const ColorNetwork &n, const Weights &w, const float *grad_out, int64_t count) {
        const int64_t width = 3 + n.sizes.rest;
        for (int64_t row = 0; row < count; ++row)
            for (int64_t part = 0; part < 3; ++part) to_colors[row * w.out + part] = n.scale * grad_out[row * width + part];
        std::fill(to_colors + count * w.out, to_colors + TILE * w.out, 0.0f);
    }

    void hide(const Weights &w, int64_t frame) {
        const int64_t h = w.hidden;
        multiply({latents, w.latent, 1}, {w.by_latent, h}, {first, h, TILE, w.sizes.latent, h}, w.frame + frame * h, 0,
                 Rectify{});
        multiply({first, h, 1}, {w.inner, h}, {second, h, TILE, w.sizes.hidden, h}, w.inner_bias, 0, Rectify{});
    }

    void color(const Weights &w) {
        multiply({second, w.hidden, 1}, {w.outer, w.out}, {colors, w.out, TILE, w.sizes.hidden, w.out}, nullptr, 0, Plain{});
    }

    void write(const ColorNetwork &n, const Weights &w, int64_t begin, int64_t count, float *out) const {
        const int64_t rest = n.sizes.rest;
        for (int64_t row = 0; row < count; ++row, out += 3 + rest) {
            const float *const constant = n.constant ? n.constant + 3 * (begin + row) : nullptr;
            for (int64_t part = 0; part < 3; ++part)
                out[part] = n.scale * colors[row * w.out + part] + (constant ? constant[part] : 0.0f);
            std::copy_n(n.others + rest * (begin + row), rest, out + 3);
        }
    }

  private:
    // Rows beyond `count` become zeros.
    static void unpack(const float *from, int64_t count, int64_t width, float *to, int64_t step) {
        for (int64_t row = 0; row < count; ++row)
            for (int64_t part = 0; part < width; ++part) to[row * step + part] = from[row * width + part];
        std::fill(to + count * step, to + TILE * step, 0.0f);
    }
};

// Sums over rows for the gradients of the weights.
struct Sums {
    float *by_latent, *inner, *inner_bias, *from_outer, *frame;

    Sums(const Weights &w, float *memory) {
        Room room{memory};
        by_latent = room.take(w.sizes.latent * w.hidden), inner = room.take(w.sizes.hidden * w.hidden);
        inner_bias = room.take(w.hidden), from_outer = room.take(3 * w.hidden), frame = room.take(w.sizes.frames * w.hidden);
    }

    static int64_t floats(const Weights &w) {
        return w.hidden * (w.sizes.latent + w.sizes.hidden + 1 + 3 + w.sizes.frames);
    }
};

void add_rows(const float *rows, int64_t width, float *sum) {
    for (int64_t column = 0; column < width; column += LANES) {
        Floats total = load(sum + column);
        for (int64_t row = 0; row < TILE; ++row) total += load(rows + row * width + column);
        store(sum + column, total);
    }
}

// sum[row][column] += over the tile: left[., row] right[., column].
void add_products(const float *left, int64_t left_step, int64_t rows, const float *right, int64_t width, float *sum) {
    multiply({left, 1, left_step}, {right, width}, {sum, width, rows, TILE, width}, sum, width, Plain{});
}

void backward_tile(const Weights &w, Tile &t, Sums &sums, int64_t frame) {
    const int64_t h = w.hidden;
    t.hide(w, frame);
    multiply({t.to_colors, w.out, 1}, {w.from_outer, h}, {t.to_second, h, TILE, 3, h}, nullptr, 0, Gate{t.second});
    multiply({t.to_second, h, 1}, {w.from_inner, h}, {t.to_first, h, TILE, w.sizes.hidden, h}, nullptr, 0, Gate{t.first});
    multiply({t.to_first, h, 1}, {w.from_latent, w.latent}, {t.to_latents, w.latent, TILE, w.sizes.hidden, w.latent},
             nullptr, 0, Plain{});
    add_products(t.to_colors, w.out, 3, t.second, h, sums.from_outer);
    add_products(t.first, h, w.sizes.hidden, t.to_second, h, sums.inner);
    add_products(t.latents, w.latent, w.sizes.latent, t.to_first, h, sums.by_latent);
    add_rows(t.to_second, h, sums.inner_bias);
    add_rows(t.to_first, h, sums.frame + frame * h);
}

// Columns first to first + columns of the gradient, which go on as they are; summed over frames.
void pass_on(const float *grad_out, int64_t width, int64_t first, int64_t columns, int64_t count, int64_t frame, float *to) {
    if (!to) return;
    for (int64_t row = 0; row < count; ++row) {
        const float *const from = grad_out + row * width + first;
        float *const at = to + row * columns;
        if (frame)
            for (int64_t part = 0; part < columns; ++part) at[part] += from[part];
        else
            std::copy_n(from, columns, at);
    }
}

void backward_chunk(const ColorNetwork &n, const ColorGradients &g, const Weights &w, Tile &t, Sums &sums, int64_t chunk) {
    const int64_t rows = n.sizes.rows, end = std::min(rows, (chunk + 1) * CHUNK), latent = n.sizes.latent;
    const int64_t width = 3 + n.sizes.rest;
    for (int64_t begin = chunk * CHUNK; begin < end; begin += TILE) {
        const int64_t count = std::min(TILE, end - begin);
        t.read(n, w, begin, count);
        for (int64_t frame = 0; frame < n.sizes.frames; ++frame) {
            const float *const grad_out = g.grad_out + width * (frame * rows + begin);
            t.read_gradients(n, w, grad_out, count);
            pass_on(grad_out, width, 0, 3, count, frame, g.constant ? g.constant + 3 * begin : nullptr);
            pass_on(grad_out, width, 3, width - 3, count, frame, g.others ? g.others + (width - 3) * begin : nullptr);
            backward_tile(w, t, sums, frame);
            for (int64_t row = 0; row < count; ++row)
                for (int64_t part = 0; part < latent; ++part) {
                    float &to = g.latents[(begin + row) * latent + part];
                    to = t.to_latents[row * w.latent + part] + (frame ? to : 0.0f);
                }
        }
    }
}

void unpad(const float *from, int64_t rows, int64_t columns, int64_t step, float *to) {
    for (int64_t row = 0; row < rows; ++row) std::copy_n(from + row * step, columns, to + row * columns);
}

}  // namespace

void color_network(const ColorNetwork &n, float *out, float *workspace) {
    Room room{workspace};
    const Weights w(n, room);
    const int64_t tiles = whole(n.sizes.rows, TILE) / TILE;
#pragma omp parallel num_threads(n.sizes.threads)
    {
        Tile tile(w, room.at + thread_number() * Tile::floats(w));
#pragma omp for schedule(static)
        for (int64_t i = 0; i < tiles; ++i) {
            const int64_t begin = i * TILE, count = std::min(TILE, n.sizes.rows - begin);
            tile.read(n, w, begin, count);
            for (int64_t frame = 0; frame < n.sizes.frames; ++frame) {
                tile.hide(w, frame);
                tile.color(w);
                tile.write(n, w, begin, count, out + (3 + n.sizes.rest) * (frame * n.sizes.rows + begin));
            }
        }
    }
}

void color_network_backward(const ColorNetwork &n, const ColorGradients &g, float *workspace) {
    Room room{workspace};
    const Weights w(n, room);
    float *const tiles = room.take(n.sizes.threads * Tile::floats(w));
    const int64_t chunks = whole(n.sizes.rows, CHUNK) / CHUNK, floats = Sums::floats(w);
    std::fill(room.at, room.at + std::max<int64_t>(chunks, 1) * floats, 0.0f);
#pragma omp parallel num_threads(n.sizes.threads)
    {
        Tile tile(w, tiles + thread_number() * Tile::floats(w));
#pragma omp for schedule(static)
        for (int64_t chunk = 0; chunk < chunks; ++chunk) {
            Sums sums(w, room.at + chunk * floats);
            backward_chunk(n, g, w, tile, sums, chunk);
        }
    }
    for (int64_t chunk = 1; chunk < chunks; ++chunk)
        for (int64_t i = 0; i < floats; i += LANES)
            store(room.at + i, load(room.at + i) + load(room.at + chunk * floats + i));
    const Sums total(w, room.at);
    const int64_t h = n.sizes.hidden;
    unpad(total.by_latent, n.sizes.latent, h, w.hidden, g.by_latent);
    unpad(total.inner, h, h, w.hidden, g.inner);
    unpad(total.inner_bias, 1, h, w.hidden, g.inner_bias);
    unpad(total.frame, n.sizes.frames, h, w.hidden, g.frame);
    for (int64_t row = 0; row < h; ++row)
        for (int64_t part = 0; part < 3; ++part) g.outer[row * 3 + part] = total.from_outer[part * w.hidden + row];
}

}  // namespace MESHANIM_NAMESPACE
