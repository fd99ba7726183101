// What attention kernels read and write, shared by the binding and the kernels.
//
// The global token's row is one more row behind those of the vertices: its edges are E + r, whose key is the
// token of row r (the vertex order[r], and the global token itself for r = V). Probabilities and score gradients
// are (batch, edges of all rows, width): `width` heads an edge, the heads padded to a power of two.
#pragma once
#include <cstdint>

struct AttentionGraph {
    const int32_t *order, *offsets, *keys, *received_offsets, *received_edges, *received_queries;
    int64_t vertices, edges;
    bool global_token;

    int64_t tokens() const { return vertices + global_token; }
    int64_t all_edges() const { return edges + (global_token ? tokens() : 0); }
};

// (batch, tokens, heads, dim) with heads and dim contiguous; strides in floats.
struct AttentionTensor {
    float *data;
    int64_t batch_stride, token_stride;

    float *row(int64_t batch, int64_t token) const { return data + batch * batch_stride + token * token_stride; }
};

struct AttentionForward {
    AttentionGraph graph;
    int64_t batch, heads, dim, width;
    float scale;
    int threads;
    AttentionTensor query, key, value, out;
    float *probabilities;  // null where they are not to be kept
};

struct AttentionBackward {
    AttentionGraph graph;
    int64_t batch, heads, dim, width;
    float scale;
    int threads;
    AttentionTensor query, key, value, out, grad_out, grad_query, grad_key, grad_value;
    const float *probabilities;
    float *score_gradients;  // written between the two passes
};
