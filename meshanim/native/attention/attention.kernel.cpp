// Sparse mesh attention, forward and backward, one pass over the rows each way.
//
// Rows come in chunks of fixed size, and a (batch, chunk) is the unit of work: each output row is computed by one
// thread in a fixed order, and what is summed over all rows (the global token) is summed chunk by chunk in order,
// so that results are bitwise the same for any number of threads. No atomics, nothing of size N x N or N x K x d.
//
// Scores of a row lie flat, edge by edge, `width` heads an edge. Dot products are computed LANES at a time and
// summed across lanes together (simd::sums), so that no horizontal sum is done alone.
#include <vector>

#include "attention.h"
#include "simd.h"

namespace MESHANIM_NAMESPACE {
namespace {

using namespace simd;

constexpr int64_t CHUNK = 64;  // rows; part of the result's definition, not of the machine's

int64_t chunks(int64_t rows) { return (rows + CHUNK - 1) / CHUNK; }

// One head's D floats as vectors. VECTORS is their number, 0 where known only at run time; then the last one may
// be partial. HEADS likewise, and WIDTH is then `width`.
template <int VECTORS, int HEADS>
struct Shape {
    int heads_, dim_, width_;

    Shape(int64_t heads, int64_t dim, int64_t width) : heads_(int(heads)), dim_(int(dim)), width_(int(width)) {}
    int heads() const { return HEADS ? HEADS : heads_; }
    int width() const { return HEADS ? HEADS : width_; }
    int dim() const { return VECTORS ? VECTORS * LANES : dim_; }
    int vectors() const { return VECTORS ? VECTORS : (dim_ + LANES - 1) / LANES; }
    Floats get(const float *p, int v) const {
        return VECTORS ? load(p + v * LANES) : load_first(p + v * LANES, std::min(dim_ - v * LANES, LANES));
    }
    void put(float *p, int v, Floats x) const {
        if (VECTORS)
            store(p + v * LANES, x);
        else
            store_first(p + v * LANES, x, std::min(dim_ - v * LANES, LANES));
    }
};

// Rows of keys or values: those of one batch element, by token.
struct Rows {
    const float *data;
    int64_t stride;

    Rows(const AttentionTensor &tensor, int64_t batch) : data(tensor.row(batch, 0)), stride(tensor.token_stride) {}
    const float *operator[](int64_t token) const { return data + token * stride; }
};

// Buffers of one thread, for as many edges as the longest row has, and a vector beyond.
struct Scratch {
    std::vector<float> scores, weights;
    std::vector<int32_t> tokens;

    Scratch(const AttentionGraph &graph, int64_t width) {
        const int64_t edges = std::max<int64_t>(graph.max_degree, CHUNK) + 2;
        scores.resize(edges * width + LANES);
        weights.resize(edges * width + LANES);
        tokens.resize(edges);
    }
};

// scores[edge * width + head] = factor * (row . rows[tokens[edge]]) for each head; up to a whole vector is written
// beyond the end.
template <int VECTORS, int HEADS>
void dots(Shape<VECTORS, HEADS> shape, const float *row, Rows rows, const int32_t *tokens, int count, float factor,
          float *scores) {
    const int dim = shape.dim();
    if (HEADS == 0) {
        const int width = shape.width();
        for (int edge = 0; edge < count; ++edge) {
            const float *other = rows[tokens[edge]];
            for (int head = 0; head < width; ++head) {
                Floats product = zeros();
                if (head < shape.heads())
                    for (int v = 0; v < shape.vectors(); ++v)
                        product = fma(shape.get(row + head * dim, v), shape.get(other + head * dim, v), product);
                scores[edge * width + head] = factor * sum(product);
            }
        }
        return;
    }
    const int flat = count * HEADS;
    for (int first = 0; first < flat; first += LANES) {
        Floats products[LANES];
#pragma GCC unroll 16
        for (int lane = 0; lane < LANES; ++lane) {
            const int edge = (first + lane) / std::max(HEADS, 1), head = (first + lane) % std::max(HEADS, 1);
            const float *other = rows[tokens[std::min(edge, count - 1)]] + head * dim, *own = row + head * dim;
            products[lane] = load(own) * load(other);
#pragma GCC unroll 4
            for (int v = 1; v < VECTORS; ++v)
                products[lane] = fma(load(own + v * LANES), load(other + v * LANES), products[lane]);
        }
        store(scores + first, sums(products) * broadcast(factor));
    }
}

// out = sum over edges of weights[edge * width + head] * rows[tokens[edge]], head by head.
template <int VECTORS, int HEADS>
void combine(Shape<VECTORS, HEADS> shape, const float *weights, Rows rows, const int32_t *tokens, int count,
             float *out) {
    const int dim = shape.dim(), width = shape.width();
    if (VECTORS == 0 || HEADS == 0) {
        for (int head = 0; head < shape.heads(); ++head)
            for (int v = 0; v < shape.vectors(); ++v) {
                Floats total = zeros();
                for (int edge = 0; edge < count; ++edge)
                    total = fma(broadcast(weights[edge * width + head]),
                                shape.get(rows[tokens[edge]] + head * dim, v), total);
                shape.put(out + head * dim, v, total);
            }
        return;
    }
    constexpr int ALL = VECTORS * HEADS, BLOCK = ALL < 8 ? std::max(ALL, 1) : 8;  // vectors held in registers
    for (int start = 0; start < ALL; start += BLOCK) {
        Floats totals[BLOCK];
#pragma GCC unroll 8
        for (int i = 0; i < BLOCK; ++i) totals[i] = zeros();
        for (int edge = 0; edge < count; ++edge) {
            const float *other = rows[tokens[edge]] + start * LANES;
            const float *weight = weights + edge * HEADS;
#pragma GCC unroll 8
            for (int i = 0; i < BLOCK; ++i)
                totals[i] = fma(broadcast(weight[(start + i) / std::max(VECTORS, 1)]), load(other + i * LANES), totals[i]);
        }
#pragma GCC unroll 8
        for (int i = 0; i < BLOCK; ++i) store(out + (start + i) * LANES, totals[i]);
    }
}

// Walks the flat (edge, head) array: columns of LANES lanes, in which equal lanes modulo `period` are one head.
template <class Shape>
struct Flat {
    int size, period, step;  // floats; heads a vector; distance of vectors of the same heads

    Flat(Shape shape, int count)
        : size(count * shape.width()), period(std::min(shape.width(), LANES)), step(std::max(shape.width(), LANES)) {}
};

// Turns scores into exponentials of their distance from the largest; writes that and the sum, one a head.
template <class Shape>
void exponentials(Shape shape, float *scores, int count, float *largest, float *total) {
    const Flat<Shape> flat(shape, count);
    for (int i = flat.size; i < flat.size + LANES; ++i) scores[i] = -INF;
    for (int column = 0; column < shape.width(); column += LANES) {
        Floats top = broadcast(-INF);
        for (int i = column; i < flat.size; i += flat.step) top = maximum(top, load(scores + i));
        top = fold_maximum(top, flat.period);
        Floats sum = zeros();
        for (int i = column; i < flat.size; i += flat.step) {
            const Floats e = exp(load(scores + i) - top);
            store(scores + i, e);
            sum += e;
        }
        sum = fold_sum(sum, flat.period);
        store_first(largest + column, top, flat.period);
        store_first(total + column, sum, flat.period);
    }
}

// values[edge, head] *= factors[head].
template <class Shape>
void multiply(Shape shape, float *values, int count, const float *factors) {
    const Flat<Shape> flat(shape, count);
    for (int column = 0; column < shape.width(); column += LANES) {
        float lanes[LANES];
        for (int lane = 0; lane < LANES; ++lane) lanes[lane] = factors[column + lane % flat.period];
        const Floats factor = load(lanes);
        for (int i = column; i < flat.size; i += flat.step) store(values + i, load(values + i) * factor);
    }
}

// The softmax's derivative, in place: gradients = factor * probabilities * (gradients - delta), where delta is the
// sum of probabilities * gradients over the row's edges, or is given.
template <class Shape>
void softmax_backward(Shape shape, const float *probabilities, float *gradients, int count, float factor,
                      const float *given_delta) {
    const Flat<Shape> flat(shape, count);
    for (int column = 0; column < shape.width(); column += LANES) {
        Floats delta = zeros();
        if (given_delta) {
            float lanes[LANES];
            for (int lane = 0; lane < LANES; ++lane) lanes[lane] = given_delta[column + lane % flat.period];
            delta = load(lanes);
        } else {
            for (int i = column; i < flat.size; i += flat.step) {
                const int n = std::min(LANES, flat.size - i);
                const Floats p = load_first(probabilities + i, n);
                // Lanes beyond the row hold repeats, infinities perhaps; they must not reach the sum.
                delta = fma(p, load_first(gradients + i, n), delta);
            }
            delta = fold_sum(delta, flat.period);
        }
        for (int i = column; i < flat.size; i += flat.step) {
            const Floats p = load_first(probabilities + i, std::min(LANES, flat.size - i));
            store(gradients + i, broadcast(factor) * p * (load(gradients + i) - delta));
        }
    }
}

// The tokens of rows first..last: vertices in visiting order, and the global token as the last row.
const int32_t *chunk_tokens(const AttentionGraph &graph, int64_t first, int64_t last, Scratch &scratch) {
    for (int64_t row = first; row < last; ++row)
        scratch.tokens[row - first] = row < graph.vertices ? graph.order[row] : int32_t(graph.vertices);
    return scratch.tokens.data();
}

// What one chunk contributes to a row that sees all: the largest score, the sum of exponentials, the weighted sum.
struct Partials {
    int64_t width, features, size;
    std::vector<float> data;

    Partials(int64_t count, int64_t width, int64_t features)
        : width(width), features(features), size(2 * width + features), data(count * size) {}
    float *largest(int64_t i) { return data.data() + i * size; }
    float *total(int64_t i) { return largest(i) + width; }
    float *sum(int64_t i) { return total(i) + width; }
};

// Adds the chunks of one batch element in order: the global token's output, its final largest score and total.
template <class Shape>
void finish_global(Shape shape, Partials &partials, int64_t first, int64_t count, float *largest, float *total,
                   float *out) {
    const int width = shape.width(), heads = shape.heads(), dim = shape.dim();
    std::vector<float> weights(count * width);
    for (int head = 0; head < width; ++head) {
        largest[head] = -INF;
        for (int64_t c = 0; c < count; ++c) {
            const float top = partials.largest(first + c)[head];
            if (!(top <= largest[head])) largest[head] = top;
        }
        total[head] = 0;
        for (int64_t c = 0; c < count; ++c) {
            weights[c * width + head] = std::exp(partials.largest(first + c)[head] - largest[head]);
            total[head] += weights[c * width + head] * partials.total(first + c)[head];
        }
    }
    for (int i = 0; i < heads * dim; ++i) {
        double sum = 0;
        for (int64_t c = 0; c < count; ++c) sum += double(weights[c * width + i / dim]) * partials.sum(first + c)[i];
        out[i] = float(sum / total[i / dim]);
    }
}

template <class Shape>
void forward_chunk(Shape shape, const AttentionForward &a, int64_t batch, int64_t chunk, Scratch &scratch,
                   Partials &partials) {
    const AttentionGraph &graph = a.graph;
    const Rows keys(a.key, batch), values(a.value, batch);
    const int width = shape.width();
    float *kept = a.probabilities ? a.probabilities + batch * graph.all_edges() * width : nullptr;
    const int64_t first = chunk * CHUNK, last = std::min(first + CHUNK, graph.tokens());
    float *scores = scratch.scores.data(), *factors = scratch.weights.data();
    for (int64_t row = first; row < std::min(last, graph.vertices); ++row) {
        const int64_t token = graph.order[row], edge = graph.offsets[row];
        const int count = int(graph.offsets[row + 1] - edge);
        const int32_t *seen = graph.keys + edge;
        dots(shape, a.query.row(batch, token), keys, seen, count, a.scale, scores);
        exponentials(shape, scores, count, factors, factors + width);
        for (int head = 0; head < width; ++head) factors[head] = 1.0f / factors[width + head];
        multiply(shape, scores, count, factors);
        if (kept) std::memcpy(kept + edge * width, scores, count * width * sizeof(float));
        combine(shape, scores, values, seen, count, a.out.row(batch, token));
    }
    if (!graph.global_token) return;
    const int count = int(last - first);
    const int64_t index = batch * chunks(graph.tokens()) + chunk;
    const int32_t *seen = chunk_tokens(graph, first, last, scratch);
    dots(shape, a.query.row(batch, graph.vertices), keys, seen, count, a.scale, scores);
    if (kept) std::memcpy(kept + (graph.edges + first) * width, scores, count * width * sizeof(float));
    exponentials(shape, scores, count, partials.largest(index), partials.total(index));
    combine(shape, scores, values, seen, count, partials.sum(index));
}

template <class Shape>
void forward(const AttentionForward &a) {
    const Shape shape(a.heads, a.dim, a.width);
    const AttentionGraph &graph = a.graph;
    const int64_t per_batch = chunks(graph.tokens()), items = a.batch * per_batch, features = a.heads * a.dim;
    const bool global = graph.global_token;
    Partials partials(global ? items : 0, a.width, features);
    std::vector<float> largest(a.batch * a.width), total(a.batch * a.width);
#pragma omp parallel num_threads(a.threads)
    {
        Scratch scratch(graph, a.width);
#pragma omp for schedule(dynamic, 4)
        for (int64_t item = 0; item < items; ++item)
            forward_chunk(shape, a, item / per_batch, item % per_batch, scratch, partials);
        if (global) {
#pragma omp for schedule(static)
            for (int64_t batch = 0; batch < a.batch; ++batch)
                finish_global(shape, partials, batch * per_batch, per_batch, &largest[batch * a.width],
                              &total[batch * a.width], a.out.row(batch, graph.vertices));
        }
        if (global && a.probabilities) {
#pragma omp for schedule(static)
            for (int64_t item = 0; item < items; ++item) {
                const int64_t batch = item / per_batch, first = item % per_batch * CHUNK;
                const int64_t count = std::min(CHUNK, graph.tokens() - first);
                float *row = a.probabilities + (batch * graph.all_edges() + graph.edges + first) * a.width;
                for (int64_t i = 0; i < count * a.width; ++i) row[i] -= largest[batch * a.width + i % a.width];
                for (int64_t i = 0; i < count * a.width; i += LANES) {
                    const int n = int(std::min<int64_t>(LANES, count * a.width - i));
                    store_first(row + i, exp(load_first(row + i, n)), n);
                }
                for (int64_t i = 0; i < count * a.width; ++i) row[i] /= total[batch * a.width + i % a.width];
            }
        }
    }
}

// Gradients of the scores and of the queries, row by row; the global token's query gets one partial a chunk.
template <class Shape>
void backward_queries(Shape shape, const AttentionBackward &a, int64_t batch, int64_t chunk, const float *delta,
                      Scratch &scratch, Partials &partials) {
    const AttentionGraph &graph = a.graph;
    const Rows keys(a.key, batch), values(a.value, batch);
    const int width = shape.width();
    const int64_t start = batch * graph.all_edges();
    const int64_t first = chunk * CHUNK, last = std::min(first + CHUNK, graph.tokens());
    float *gradients = scratch.scores.data();
    for (int64_t row = first; row < std::min(last, graph.vertices); ++row) {
        const int64_t token = graph.order[row], edge = graph.offsets[row];
        const int count = int(graph.offsets[row + 1] - edge);
        const int32_t *seen = graph.keys + edge;
        dots(shape, a.grad_out.row(batch, token), values, seen, count, 1.0f, gradients);
        softmax_backward(shape, a.probabilities + (start + edge) * width, gradients, count, a.scale, nullptr);
        std::memcpy(a.score_gradients + (start + edge) * width, gradients, count * width * sizeof(float));
        combine(shape, gradients, keys, seen, count, a.grad_query.row(batch, token));
    }
    if (!graph.global_token) return;
    const int count = int(last - first);
    const int64_t edge = start + graph.edges + first;
    const int32_t *seen = chunk_tokens(graph, first, last, scratch);
    dots(shape, a.grad_out.row(batch, graph.vertices), values, seen, count, 1.0f, gradients);
    softmax_backward(shape, a.probabilities + edge * width, gradients, count, a.scale, delta);
    std::memcpy(a.score_gradients + edge * width, gradients, count * width * sizeof(float));
    combine(shape, gradients, keys, seen, count, partials.sum(batch * chunks(graph.tokens()) + chunk));
}

// Gradients of keys and values, gathered by key over the transposed graph.
template <class Shape>
void backward_keys(Shape shape, const AttentionBackward &a, int64_t batch, int64_t chunk, Scratch &scratch) {
    const AttentionGraph &graph = a.graph;
    const Rows queries(a.query, batch), grad_outs(a.grad_out, batch);
    const int width = shape.width();
    const int64_t start = batch * graph.all_edges();
    const int64_t first = chunk * CHUNK, last = std::min(first + CHUNK, graph.tokens());
    int32_t *seen = scratch.tokens.data();
    float *gradients = scratch.scores.data(), *probabilities = scratch.weights.data();
    for (int64_t row = first; row < last; ++row) {
        int count = 0;
        const auto take = [&](int64_t edge, int64_t query) {
            seen[count] = int32_t(query);
            std::memcpy(gradients + count * width, a.score_gradients + (start + edge) * width, width * sizeof(float));
            std::memcpy(probabilities + count * width, a.probabilities + (start + edge) * width, width * sizeof(float));
            ++count;
        };
        if (row < graph.vertices)
            for (int64_t i = graph.received_offsets[row]; i < graph.received_offsets[row + 1]; ++i)
                take(graph.received_edges[i], graph.received_queries[i]);
        if (graph.global_token) take(graph.edges + row, graph.vertices);
        const int64_t token = row < graph.vertices ? graph.order[row] : graph.vertices;
        combine(shape, gradients, queries, seen, count, a.grad_key.row(batch, token));
        combine(shape, probabilities, grad_outs, seen, count, a.grad_value.row(batch, token));
    }
}

template <class Shape>
void backward(const AttentionBackward &a) {
    const Shape shape(a.heads, a.dim, a.width);
    const AttentionGraph &graph = a.graph;
    const int64_t per_batch = chunks(graph.tokens()), items = a.batch * per_batch, features = a.heads * a.dim;
    const bool global = graph.global_token;
    Partials partials(global ? items : 0, a.width, features);
    std::vector<float> delta(a.batch * a.width);
    for (int64_t batch = 0; global && batch < a.batch; ++batch)
        for (int64_t head = 0; head < a.heads; ++head) {
            const float *out = a.out.row(batch, graph.vertices) + head * a.dim;
            const float *grad = a.grad_out.row(batch, graph.vertices) + head * a.dim;
            double sum = 0;
            for (int64_t i = 0; i < a.dim; ++i) sum += double(out[i]) * grad[i];
            delta[batch * a.width + head] = float(sum);
        }
#pragma omp parallel num_threads(a.threads)
    {
        Scratch scratch(graph, a.width);
#pragma omp for schedule(dynamic, 4)
        for (int64_t item = 0; item < items; ++item)
            backward_queries(shape, a, item / per_batch, item % per_batch, &delta[item / per_batch * a.width], scratch,
                             partials);
#pragma omp for schedule(dynamic, 4)
        for (int64_t item = 0; item < items; ++item)
            backward_keys(shape, a, item / per_batch, item % per_batch, scratch);
        if (global) {
#pragma omp for schedule(static)
            for (int64_t batch = 0; batch < a.batch; ++batch) {
                float *grad = a.grad_query.row(batch, graph.vertices);
                for (int64_t i = 0; i < features; ++i) {
                    double sum = 0;
                    for (int64_t c = 0; c < per_batch; ++c) sum += partials.sum(batch * per_batch + c)[i];
                    grad[i] = float(sum);
                }
            }
        }
    }
}

// Calls function(Shape) with the shape compiled for these sizes, or with the general one.
template <template <class> class Function, class Arguments>
void dispatch(const Arguments &a) {
    const int64_t vectors = a.dim % LANES ? 0 : a.dim / LANES;
#define MESHANIM_SHAPE(VECTORS, HEADS) \
    if (vectors == VECTORS && a.heads == HEADS) return Function<Shape<VECTORS, HEADS>>::run(a)
    MESHANIM_SHAPE(1, 1);
    MESHANIM_SHAPE(1, 2);
    MESHANIM_SHAPE(1, 4);
    MESHANIM_SHAPE(1, 8);
    MESHANIM_SHAPE(2, 1);
    MESHANIM_SHAPE(2, 2);
    MESHANIM_SHAPE(2, 4);
    MESHANIM_SHAPE(2, 8);
    MESHANIM_SHAPE(4, 1);
    MESHANIM_SHAPE(4, 2);
    MESHANIM_SHAPE(4, 4);
    MESHANIM_SHAPE(4, 8);
#undef MESHANIM_SHAPE
    Function<Shape<0, 0>>::run(a);
}

template <class Shape>
struct RunForward {
    static void run(const AttentionForward &a) { forward<Shape>(a); }
};
template <class Shape>
struct RunBackward {
    static void run(const AttentionBackward &a) { backward<Shape>(a); }
};

}  // namespace

void attention_forward(const AttentionForward &arguments) { dispatch<RunForward>(arguments); }
void attention_backward(const AttentionBackward &arguments) { dispatch<RunBackward>(arguments); }

void exponential(const float *x, float *y, int64_t count) {
    for (int64_t i = 0; i < count; i += LANES) {
        const int n = int(std::min<int64_t>(LANES, count - i));
        simd::store_first(y + i, simd::exp(simd::load_first(x + i, n)), n);
    }
}

}  // namespace MESHANIM_NAMESPACE
