// A network of two hidden layers over many rows, for the colours of Gaussians (gaussians/avatar/colors.py):
//     out = relu(relu(frame + latents by_latent) inner + inner_bias) outer
// The frame's part of the first layer is given; all rows of a frame share it. Rows are contiguous floats.
// What is written are harmonics: `constant` + scale out, then `rest` as it is.
#pragma once
#include <cstdint>

struct ColorSizes {
    int64_t frames, rows, latent, hidden;
    int64_t rest;  // floats a row beside the three of the network
    int threads;
};

struct ColorNetwork {
    ColorSizes sizes;
    const float *latents;     // (rows, latent), the same for all frames
    const float *frame;       // (frames, hidden)
    const float *by_latent;   // (latent, hidden)
    const float *inner;       // (hidden, hidden)
    const float *inner_bias;  // (hidden)
    const float *outer;       // (hidden, 3)
    const float *constant;    // (rows, 3); null for zeros
    const float *others;      // (rows, rest)
    float scale;
};

struct ColorGradients {
    const float *grad_out;  // (frames, rows, 3 + rest)
    float *latents, *frame, *by_latent, *inner, *inner_bias, *outer;
    float *constant, *others;  // null where nobody asks
};

// Rows of a tile, and of a chunk, whose gradients of the weights are summed apart: the same for any number of threads.
constexpr int64_t COLOR_TILE = 64, COLOR_CHUNK = 1024;

// Floats that the kernels need beside their outputs, on the widest vectors.
static inline int64_t color_workspace(const ColorSizes &s, bool backward) {
    const int64_t hidden = (s.hidden + 31) / 32 * 32, latent = (s.latent + 15) / 16 * 16, out = 16;
    const int64_t weights = hidden * (latent + s.latent + 2 * hidden + out + 3 + 1 + s.frames);
    const int64_t tile = COLOR_TILE * (2 * latent + 4 * hidden + 2 * out);
    const int64_t chunks = backward ? 1 + s.rows / COLOR_CHUNK : 0;
    const int64_t sums = hidden * (s.latent + hidden + 1 + 3 + s.frames);
    return weights + s.threads * tile + chunks * sums;
}
