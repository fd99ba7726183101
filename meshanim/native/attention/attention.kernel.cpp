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

// Whether rows of the tensor are written past the caches: it is larger than they are, and its rows are whole lines.
// Otherwise every line of it is read before it is written, and pushes out a line that is wanted.
bool streams(const AttentionTensor &tensor, int64_t batch, int64_t tokens, int64_t features) {
    constexpr int64_t LARGE = 1 << 23, LINE = 16;  // floats
    return batch * tokens * features >= LARGE && reinterpret_cast<uintptr_t>(tensor.data) % (LINE * sizeof(float)) == 0 &&
           tensor.batch_stride % LINE == 0 && tensor.token_stride % LINE == 0;
}

// Room for the scores of one row, in floats: a whole number of vectors, so that the last one may spill.
int64_t room(int64_t edges, int64_t width) { return (edges * width + LANES - 1) / LANES * LANES; }

// Where one thread keeps the scores of a chunk's rows.
struct Scratch {
    std::vector<float> scores;
    int64_t starts[CHUNK + 1];

    Scratch(const AttentionGraph &graph, int64_t width) {
        int64_t size = room(CHUNK, width);
        for (int64_t first = 0; first < graph.vertices; first += CHUNK)
            size = std::max(size, place(graph, first, std::min(first + CHUNK, graph.vertices), width));
        scores.resize(size);
    }

    // Sets where the scores of each row start; returns where they end.
    int64_t place(const AttentionGraph &graph, int64_t first, int64_t last, int64_t width) {
        starts[0] = 0;
        for (int64_t row = first; row < last; ++row)
            starts[row - first + 1] = starts[row - first] + room(graph.offsets[row + 1] - graph.offsets[row], width);
        return starts[std::max<int64_t>(last - first, 0)];
    }
};

// scores[edge * width + head] = factor * (row . other(edge)) for each head; the last vector is filled up with
// copies of the last edge's.
template <int VECTORS, int HEADS, class Other>
void dots(Shape<VECTORS, HEADS> shape, const float *row, Other other, int count, float factor, float *scores) {
    const int dim = shape.dim();
    if constexpr (HEADS == 0) {
        const int width = shape.width();
        for (int edge = 0; edge < count; ++edge)
            for (int head = 0; head < width; ++head) {
                Floats product = zeros();
                if (head < shape.heads())
                    for (int v = 0; v < shape.vectors(); ++v)
                        product = fma(shape.get(row + head * dim, v), shape.get(other(edge) + head * dim, v), product);
                scores[edge * width + head] = factor * sum(product);
            }
    } else {
        constexpr int TOGETHER = std::max(LANES / HEADS, 1);  // edges a vector
        for (int first = 0; first < count; first += TOGETHER)
            for (int start = 0; start < HEADS; start += LANES) {
                Floats products[LANES];
#pragma GCC unroll 16
                for (int lane = 0; lane < LANES; ++lane) {
                    const int offset = (start + lane % HEADS) * dim;
                    const float *a = row + offset, *b = other(std::min(first + lane / HEADS, count - 1)) + offset;
                    products[lane] = load(a) * load(b);
#pragma GCC unroll 4
                    for (int v = 1; v < VECTORS; ++v)
                        products[lane] = fma(load(a + v * LANES), load(b + v * LANES), products[lane]);
                }
                store(scores + first * HEADS + start, sums(products) * broadcast(factor));
            }
    }
}

// out = sum over edges of weight(edge)[head] * other(edge), head by head, and of one more edge where it is given.
template <int VECTORS, int HEADS, class Weight, class Other>
void combine(Shape<VECTORS, HEADS> shape, Weight weight, Other other, int count, float *out,
             bool streaming = false, const float *more_weight = nullptr, const float *more = nullptr) {
    if constexpr (VECTORS == 0 || HEADS == 0) {
        const int dim = shape.dim();
        for (int head = 0; head < shape.heads(); ++head)
            for (int v = 0; v < shape.vectors(); ++v) {
                Floats total = zeros();
                if (more) total = broadcast(more_weight[head]) * shape.get(more + head * dim, v);
                for (int edge = 0; edge < count; ++edge)
                    total = fma(broadcast(weight(edge)[head]), shape.get(other(edge) + head * dim, v), total);
                shape.put(out + head * dim, v, total);
            }
    } else {
        constexpr int ALL = VECTORS * HEADS, BLOCK = std::min(ALL, 8);  // vectors held in registers
        for (int start = 0; start < ALL; start += BLOCK) {
            Floats totals[BLOCK];
            for (Floats &total : totals) total = zeros();
            const auto add = [&](const float *weights, const float *row) {
#pragma GCC unroll 8
                for (int i = 0; i < BLOCK; ++i)
                    totals[i] = fma(broadcast(weights[(start + i) / VECTORS]), load(row + (start + i) * LANES),
                                    totals[i]);
            };
            if (more) add(more_weight, more);
            for (int edge = 0; edge < count; ++edge) add(weight(edge), other(edge));
            if (streaming) {
#pragma GCC unroll 8
                for (int i = 0; i < BLOCK; ++i) stream(out + (start + i) * LANES, totals[i]);
            } else {
#pragma GCC unroll 8
                for (int i = 0; i < BLOCK; ++i) store(out + (start + i) * LANES, totals[i]);
            }
        }
    }
}

// The flat (edge, head) array as vectors: equal lanes modulo `period` are one head, and the vectors of the same
// heads are `step` floats apart.
template <class Shape>
struct Flat {
    int size, period, step;

    Flat(Shape shape, int count)
        : size(count * shape.width()), period(std::min(shape.width(), LANES)), step(std::max(shape.width(), LANES)) {}
};

// Turns scores into exponentials of their distance from the largest. Divides them by their sum, or writes the
// largest score and the sum, one a head, where these are wanted.
template <class Shape>
void softmax(Shape shape, float *scores, int count, float *largest = nullptr, float *total = nullptr) {
    const Flat<Shape> flat(shape, count);
    for (int i = flat.size; i % LANES; ++i) scores[i] = -INF;
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
        if (largest) {
            store_first(largest + column, top, flat.period);
            store_first(total + column, sum, flat.period);
            continue;
        }
        const Floats factor = broadcast(1.0f) / sum;
        for (int i = column; i < flat.size; i += flat.step) store(scores + i, load(scores + i) * factor);
    }
}

// The softmax's derivative, in place: gradients = factor * probabilities * (gradients - delta), where delta is the
// sum of probabilities * gradients over the row's edges, or is given.
template <class Shape>
void softmax_backward(Shape shape, const float *probabilities, float *gradients, int count, float factor,
                      const float *given_delta = nullptr) {
    const Flat<Shape> flat(shape, count);
    for (int i = flat.size; i % LANES; ++i) gradients[i] = 0;
    const auto probability = [&](int i) {
        return i + LANES <= flat.size ? load(probabilities + i) : load_first(probabilities + i, flat.size - i);
    };
    for (int column = 0; column < shape.width(); column += LANES) {
        Floats delta = zeros();
        if (given_delta) {
            float lanes[LANES];
            for (int lane = 0; lane < LANES; ++lane) lanes[lane] = given_delta[column + lane % flat.period];
            delta = load(lanes);
        } else {
            for (int i = column; i < flat.size; i += flat.step)
                delta = fma(probability(i), load(gradients + i), delta);
            delta = fold_sum(delta, flat.period);
        }
        for (int i = column; i < flat.size; i += flat.step)
            store(gradients + i, broadcast(factor) * probability(i) * (load(gradients + i) - delta));
    }
}

// The token of a row: a vertex in visiting order, or behind them the global token.
int64_t token_of(const AttentionGraph &graph, int64_t row) { return row < graph.vertices ? graph.order[row] : row; }

// Calls step(token, first edge, number of edges, scores) for each vertex's row of a chunk. Work goes step by step
// over all rows of a chunk, since the steps of different rows overlap in the processor and those of one do not.
template <class Step>
void each_row(const AttentionGraph &graph, int64_t first, int64_t last, Scratch &scratch, Step step) {
    for (int64_t row = first; row < std::min(last, graph.vertices); ++row) {
        const int64_t edge = graph.offsets[row];
        step(graph.order[row], edge, int(graph.offsets[row + 1] - edge),
             scratch.scores.data() + scratch.starts[row - first]);
    }
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
    const bool streaming = streams(a.out, a.batch, graph.tokens(), shape.heads() * shape.dim());
    const int width = shape.width();
    float *kept = a.probabilities ? a.probabilities + batch * graph.all_edges() * width : nullptr;
    const int64_t first = chunk * CHUNK, last = std::min(first + CHUNK, graph.tokens());
    scratch.place(graph, first, std::min(last, graph.vertices), width);
    each_row(graph, first, last, scratch, [&](int64_t token, int64_t edge, int count, float *scores) {
        const auto key = [&](int i) { return keys[graph.keys[edge + i]]; };
        dots(shape, a.query.row(batch, token), key, count, a.scale, scores);
    });
    each_row(graph, first, last, scratch,
             [&](int64_t, int64_t, int count, float *scores) { softmax(shape, scores, count); });
    each_row(graph, first, last, scratch, [&](int64_t token, int64_t edge, int count, float *scores) {
        if (kept) std::memcpy(kept + edge * width, scores, count * width * sizeof(float));
        const auto weight = [&](int i) { return scores + i * width; };
        const auto value = [&](int i) { return values[graph.keys[edge + i]]; };
        combine(shape, weight, value, count, a.out.row(batch, token), streaming);
    });
    if (!graph.global_token) return;
    float *scores = scratch.scores.data();
    const int count = int(last - first);
    const int64_t index = batch * chunks(graph.tokens()) + chunk;
    const auto key = [&](int i) { return keys[token_of(graph, first + i)]; };
    const auto value = [&](int i) { return values[token_of(graph, first + i)]; };
    const auto weight = [&](int i) { return scores + i * width; };
    dots(shape, a.query.row(batch, graph.vertices), key, count, a.scale, scores);
    if (kept) std::memcpy(kept + (graph.edges + first) * width, scores, count * width * sizeof(float));
    softmax(shape, scores, count, partials.largest(index), partials.total(index));
    combine(shape, weight, value, count, partials.sum(index));
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
    const bool streaming = streams(a.grad_query, a.batch, graph.tokens(), shape.heads() * shape.dim());
    const int width = shape.width();
    const int64_t start = batch * graph.all_edges() * width;
    const float *probabilities = a.probabilities + start;
    float *kept = a.score_gradients + start;
    const int64_t first = chunk * CHUNK, last = std::min(first + CHUNK, graph.tokens());
    scratch.place(graph, first, std::min(last, graph.vertices), width);
    each_row(graph, first, last, scratch, [&](int64_t token, int64_t edge, int count, float *gradients) {
        const auto value = [&](int i) { return values[graph.keys[edge + i]]; };
        dots(shape, a.grad_out.row(batch, token), value, count, 1.0f, gradients);
    });
    each_row(graph, first, last, scratch, [&](int64_t, int64_t edge, int count, float *gradients) {
        softmax_backward(shape, probabilities + edge * width, gradients, count, a.scale);
    });
    each_row(graph, first, last, scratch, [&](int64_t token, int64_t edge, int count, float *gradients) {
        std::memcpy(kept + edge * width, gradients, count * width * sizeof(float));
        const auto weight = [&](int i) { return gradients + i * width; };
        const auto key = [&](int i) { return keys[graph.keys[edge + i]]; };
        combine(shape, weight, key, count, a.grad_query.row(batch, token), streaming);
    });
    if (!graph.global_token) return;
    float *gradients = scratch.scores.data();
    const int count = int(last - first);
    const int64_t edge = graph.edges + first;
    const auto key = [&](int i) { return keys[token_of(graph, first + i)]; };
    const auto value = [&](int i) { return values[token_of(graph, first + i)]; };
    const auto weight = [&](int i) { return gradients + i * width; };
    dots(shape, a.grad_out.row(batch, graph.vertices), value, count, 1.0f, gradients);
    softmax_backward(shape, probabilities + edge * width, gradients, count, a.scale, delta);
    std::memcpy(kept + edge * width, gradients, count * width * sizeof(float));
    combine(shape, weight, key, count, partials.sum(batch * chunks(graph.tokens()) + chunk));
}

// Gradients of keys and values, gathered by key over the transposed graph.
template <class Shape>
void backward_keys(Shape shape, const AttentionBackward &a, int64_t batch, int64_t chunk) {
    const AttentionGraph &graph = a.graph;
    const Rows queries(a.query, batch), grad_outs(a.grad_out, batch);
    const int64_t features = shape.heads() * shape.dim();
    const bool streaming = streams(a.grad_key, a.batch, graph.tokens(), features) &&
                           streams(a.grad_value, a.batch, graph.tokens(), features);
    const int width = shape.width();
    const int64_t start = batch * graph.all_edges() * width;
    const float *probabilities = a.probabilities + start, *gradients = a.score_gradients + start;
    const float *global_query = graph.global_token ? queries[graph.vertices] : nullptr;
    const float *global_grad = graph.global_token ? grad_outs[graph.vertices] : nullptr;
    const int64_t first = chunk * CHUNK, last = std::min(first + CHUNK, graph.tokens());
    for (int64_t row = first; row < last; ++row) {
        const bool vertex = row < graph.vertices;
        const int64_t from = vertex ? graph.received_offsets[row] : 0, token = token_of(graph, row);
        const int count = vertex ? int(graph.received_offsets[row + 1] - from) : 0;
        const int32_t *edges = graph.received_edges + from, *tokens = graph.received_queries + from;
        const int64_t global = (graph.edges + row) * width;
        combine(shape, [&](int i) { return gradients + int64_t(edges[i]) * width; },
                [&](int i) { return queries[tokens[i]]; }, count, a.grad_key.row(batch, token), streaming, gradients + global,
                global_query);
        combine(shape, [&](int i) { return probabilities + int64_t(edges[i]) * width; },
                [&](int i) { return grad_outs[tokens[i]]; }, count, a.grad_value.row(batch, token), streaming,
                probabilities + global, global_grad);
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
        // Both passes over as many batch elements as there are threads, so that the second finds in the cache what
        // the first has read and written.
        for (int64_t batch = 0; batch < a.batch; batch += a.threads) {
            const int64_t end = std::min<int64_t>(batch + a.threads, a.batch) * per_batch;
#pragma omp for schedule(dynamic, 8)
            for (int64_t item = batch * per_batch; item < end; ++item)
                backward_queries(shape, a, item / per_batch, item % per_batch, &delta[item / per_batch * a.width],
                                 scratch, partials);
#pragma omp for schedule(dynamic, 8)
            for (int64_t item = batch * per_batch; item < end; ++item)
                backward_keys(shape, a, item / per_batch, item % per_batch);
        }
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
