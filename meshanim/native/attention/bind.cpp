// Binding of the mesh attention kernels: checks that what Python passes fits together, then dispatches.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <stdexcept>

#include "../isa.h"
#include "attention.h"

namespace nb = nanobind;

MESHANIM_DECLARE(void attention_forward(const AttentionForward &))
MESHANIM_DECLARE(void attention_backward(const AttentionBackward &))
MESHANIM_DECLARE(void exponential(const float *x, float *y, int64_t count))

namespace {

using Features = nb::ndarray<float, nb::ndim<4>, nb::device::cpu>;
using Indices = nb::ndarray<const int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Edges = nb::ndarray<float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Vector = nb::ndarray<float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

void require(bool condition, const char *what) {
    if (!condition) throw std::invalid_argument(what);
}

AttentionGraph graph_of(Indices order, Indices offsets, Indices keys, Indices received_offsets,
                        Indices received_edges, Indices received_queries, bool global_token) {
    AttentionGraph graph{order.data(),          offsets.data(),        keys.data(), received_offsets.data(),
                         received_edges.data(), received_queries.data()};
    graph.vertices = int64_t(order.size());
    graph.edges = int64_t(keys.size());
    graph.global_token = global_token;
    require(offsets.size() == order.size() + 1 && received_offsets.size() == order.size() + 1 &&
                received_edges.size() == keys.size() && received_queries.size() == keys.size(),
            "mesh attention: the graph's arrays do not fit together");
    return graph;
}

AttentionTensor rows_of(const Features &tensor, const Features &like) {
    for (int axis = 0; axis < 4; ++axis)
        require(tensor.shape(axis) == like.shape(axis), "mesh attention: tensors differ in shape");
    require(tensor.size() == 0 || ((tensor.stride(3) == 1 || tensor.shape(3) == 1) &&
                                   (tensor.stride(2) == int64_t(tensor.shape(3)) || tensor.shape(2) == 1)),
            "mesh attention: heads and dim must be contiguous");
    return {tensor.data(), tensor.stride(0), tensor.stride(1)};
}

template <class Arguments>
void fill(Arguments &a, const Features &query, const Features &key, const Features &value, const Features &out,
          const Edges &probabilities, double scale, int threads) {
    a.batch = int64_t(query.shape(0));
    a.heads = int64_t(query.shape(2));
    a.dim = int64_t(query.shape(3));
    a.width = 1;
    while (a.width < a.heads) a.width *= 2;
    a.scale = float(scale);
    a.threads = threads;
    a.query = rows_of(query, query);
    a.key = rows_of(key, query);
    a.value = rows_of(value, query);
    a.out = rows_of(out, query);
    require(int64_t(query.shape(1)) == a.graph.tokens(), "mesh attention: the graph has another number of tokens");
    require(threads > 0, "mesh attention: threads must be positive");
    require(probabilities.size() == 0 ||
                (int64_t(probabilities.shape(0)) == a.batch &&
                 int64_t(probabilities.shape(1)) == a.graph.all_edges() && int64_t(probabilities.shape(2)) == a.width),
            "mesh attention: probabilities have the wrong shape");
    a.probabilities = probabilities.size() ? probabilities.data() : nullptr;
}

void forward(Features query, Features key, Features value, Indices order, Indices offsets, Indices keys,
             Indices received_offsets, Indices received_edges, Indices received_queries, bool global_token,
             double scale, int threads, Features out, Edges probabilities) {
    AttentionForward a{};
    a.graph = graph_of(order, offsets, keys, received_offsets, received_edges, received_queries, global_token);
    fill(a, query, key, value, out, probabilities, scale, threads);
    if (query.size() == 0) return;
    nb::gil_scoped_release release;
    MESHANIM_DISPATCH(attention_forward, a);
}

void backward(Features query, Features key, Features value, Indices order, Indices offsets, Indices keys,
              Indices received_offsets, Indices received_edges, Indices received_queries, bool global_token,
              double scale, int threads, Features out, Edges probabilities, Features grad_out, Edges score_gradients,
              Features grad_query, Features grad_key, Features grad_value) {
    AttentionBackward a{};
    a.graph = graph_of(order, offsets, keys, received_offsets, received_edges, received_queries, global_token);
    fill(a, query, key, value, out, probabilities, scale, threads);
    a.grad_out = rows_of(grad_out, query);
    a.grad_query = rows_of(grad_query, query);
    a.grad_key = rows_of(grad_key, query);
    a.grad_value = rows_of(grad_value, query);
    require(score_gradients.size() == probabilities.size(), "mesh attention: score gradients have the wrong shape");
    a.score_gradients = score_gradients.data();
    if (query.size() == 0) return;
    nb::gil_scoped_release release;
    MESHANIM_DISPATCH(attention_backward, a);
}

}  // namespace

void bind_attention(nb::module_ &m) {
    m.def("attention_forward", &forward, "Mesh attention into `out`; keeps the probabilities unless they are empty.",
          nb::arg("query").noconvert(), nb::arg("key").noconvert(), nb::arg("value").noconvert(),
          nb::arg("order").noconvert(), nb::arg("offsets").noconvert(), nb::arg("keys").noconvert(),
          nb::arg("received_offsets").noconvert(), nb::arg("received_edges").noconvert(),
          nb::arg("received_queries").noconvert(), nb::arg("global_token"), nb::arg("scale"), nb::arg("threads"),
          nb::arg("out").noconvert(), nb::arg("probabilities").noconvert());
    m.def("attention_backward", &backward, "Gradients of mesh attention from the probabilities that were kept.",
          nb::arg("query").noconvert(), nb::arg("key").noconvert(), nb::arg("value").noconvert(),
          nb::arg("order").noconvert(), nb::arg("offsets").noconvert(), nb::arg("keys").noconvert(),
          nb::arg("received_offsets").noconvert(), nb::arg("received_edges").noconvert(),
          nb::arg("received_queries").noconvert(), nb::arg("global_token"), nb::arg("scale"), nb::arg("threads"),
          nb::arg("out").noconvert(), nb::arg("probabilities").noconvert(), nb::arg("grad_out").noconvert(),
          nb::arg("score_gradients").noconvert(), nb::arg("grad_query").noconvert(), nb::arg("grad_key").noconvert(),
          nb::arg("grad_value").noconvert());
    m.def("exponential", [](Vector x, Vector y) {
        require(x.size() == y.size(), "exponential: x and y differ in size");
        MESHANIM_DISPATCH(exponential, x.data(), y.data(), int64_t(x.size()));
    }, "The kernels' exponential function of x into y, for tests.", nb::arg("x").noconvert(), nb::arg("y").noconvert());
}
