// Arguments of the blendshape solve: gradients of the data term, and box-constrained quadratic programs.
#pragma once
#include <cstdint>

// The nonzero tiles of a (3 S, N) matrix, in the order of the strips of STRIP floats that they lie in.
struct TiledMatrix {
    static constexpr int TILE = 64, STRIP = 256;
    const float *tiles;      // (n, TILE)
    const int32_t *column;   // (n), rising within a strip
    const int32_t *place;    // (n), which TILE of the strip
    const int32_t *offsets;  // (strips + 1), where the tiles of each strip begin
    int64_t strips, columns;
};

struct Projection {
    TiledMatrix matrix;
    const float *frames;     // (count, 3 V)
    const int32_t *sampled;  // (samples) vertices that count
    const float *neutral;    // (samples, 3)
    double *out;             // (count, columns)
    int64_t count, vertices, samples;
    int threads;
};

// For each row b of `linear`: minimise w'Gw / 2 - b'w over 0 <= w <= 1, G positive definite.
struct BoxPrograms {
    const double *gram;      // (n, n)
    const double *linear;    // (count, n)
    const int32_t *pairs;    // (pairs, 2): of each, the smaller is set to zero and the rest solved again
    const double *feedback;  // (n, n), times the weights before is added to b; null: frames are independent
    const double *extra;     // (n, n), times strength[frame] is added to G; null for none
    const double *strength;  // (count)
    double *previous;        // (n), in and out
    int8_t *bound;           // (n), in and out: where each weight is expected, at 0 (-1), at 1 (1) or between (0)
    double *out;             // (count, n)
    int64_t count, n, n_pairs;
    int threads;
};
